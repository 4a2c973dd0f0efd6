"""The page of a run: what is in its file, and what a browser makes of it."""

import base64
import html
import json
import pathlib
import re
import shutil
import subprocess
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import models
import numpy as np
import pytest
from tolerances import ROUND_OFF

import svkc

NAME = '</script><b id="x">{{three}}'
CUTS = {0.2: "right_hand_grip", 0.3: "left_hand_grip"}
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
KINDS = """<mujoco><asset>
  <mesh name="wedge" vertex="0 0 0 .4 0 0 0 .4 0 0 0 .4"/><material name="green" rgba="0 1 0 1"/>
  <hfield name="hill" nrow="2" ncol="3" size="1 2 .5 .1" elevation="0 0 1 0 1 1"/>
</asset><worldbody>
  <geom type="plane" size="0 0 1"/><geom type="hfield" hfield="hill" pos="-3 0 0"/>
  <body name="one" pos="0 0 1"><joint name="turn" axis="1 0 0"/>
    <geom type="sphere" size=".2" material="green"/><geom type="capsule" size=".1 .3" pos="1 0 0"/>
    <geom type="ellipsoid" size=".1 .2 .3" pos="2 0 0" rgba="1 0 0 .5"/><geom type="cylinder"
      size=".1 .3" pos="3 0 0"/>
    <geom type="box" size=".1 .2 .3" pos="4 0 0"/><geom type="mesh" mesh="wedge" pos="5 0 0"/><geom
      type="mesh" mesh="wedge" pos="6 0 0" group="2"/>
    <geom type="sphere" size="9" group="3"/><geom type="sphere" size="8" rgba="1 1 1 0"/>
  </body>
</worldbody></mujoco>"""


@pytest.fixture(scope="module")
def release(high_bar):
    """Two hands, one, none, in half a second."""
    chain, state = high_bar
    events = [svkc.at(t, cut=link) for t, link in CUTS.items()]
    return chain, svkc.simulate(
        chain, state, 0.5, ts=jnp.linspace(0, 0.5, 21), events=events, dt=0.0125
    )


@pytest.fixture(scope="module")
def stopped():
    """A four-bar that is let go and caught again, to a stop of the run before its time."""
    chain = models.four_bar()
    events = [svkc.at(0.023, cut="pin"), svkc.at(0.035, connect="pin", here=True, stop=True)]
    return chain, svkc.simulate(
        chain,
        chain.state({"crank": 0.4}),
        0.1,
        ts=jnp.linspace(0, 0.1, 11),
        events=events,
        dt=0.005,
    )


@pytest.fixture(scope="module")
def pendulum():
    """Nothing virtual in it, and a body whose name would end the script, were it let."""
    body = (
        f'<body name="{html.escape(NAME)}"><joint name="j" axis="0 1'
        f' 0"/>{models.BAR.format("0 0 -1")}</body>'
    )
    return svkc.load(f"<mujoco><worldbody>{body}</worldbody></mujoco>")


@pytest.fixture(scope="module")
def browser():
    """Chromium without a window."""
    playwright = pytest.importorskip(
        "playwright.sync_api", reason="the page is tried in a browser: pip install playwright"
    )
    program = next(filter(None, map(shutil.which, BROWSERS)), None)
    if program is None:
        pytest.skip(
            "the page is tried in a browser: apt-get install --no-install-recommends chromium"
        )
    with playwright.sync_playwright() as play:
        chromium = play.chromium.launch(
            executable_path=program,
            args=[
                "--no-sandbox",
                "--use-gl=angle",
                "--use-angle=swiftshader",
                "--enable-unsafe-swiftshader",
            ],
        )
        yield chromium
        chromium.close()


@pytest.fixture
def visit(browser):
    """Opens a page from its file, with no network; whatever the console has to say is an error."""
    said, pages = [], []

    def to(path, width=1000, height=640):
        page = browser.new_page(viewport={"width": width, "height": height})
        pages.append(page)
        page.set_default_timeout(60000)
        page.context.set_offline(True)
        page.on("console", lambda message: said.append(message.text))
        page.on("pageerror", lambda error: said.append(str(error)))
        page.goto(pathlib.Path(path).as_uri())
        return page

    yield to
    for page in pages:
        page.close()
    assert not said


def contents(path) -> dict:
    """The run inside a page."""
    inside = re.findall(
        r'<script type="application/json" id="run">(.*?)</script>',
        pathlib.Path(path).read_text(),
        re.S,
    )
    assert len(inside) == 1
    return json.loads(inside[0])


def picture(page):
    """What is drawn, without numbers and timeline."""
    import io

    from PIL import Image

    # two frames: the one that was asked for, and the one in which it is shown
    page.evaluate(
        "() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))"
    )
    return np.asarray(
        Image.open(io.BytesIO(page.locator("canvas").screenshot())).convert("RGB"), int
    )


def changed(one, other) -> int:
    """Pixels that differ."""
    return int(np.sum(np.abs(one - other).max(-1) > 24))


def number(page, name):
    return float(page.inner_text(f"#{name}").split()[0])


@pytest.mark.slow
def test_the_file_has_everything_in_it(release, tmp_path):
    chain, traj = release
    path = svkc.render(chain, traj, tmp_path / "run.html")
    assert path == tmp_path / "run.html"
    text, run = path.read_text(), contents(path)
    # nothing is fetched, the licence goes with what it is for, every part was put in
    assert not re.search(
        r'src=|<link(?! rel="icon" href="data:,")|@import|url\(', text.split("<script", 1)[0]
    )
    assert set(re.findall(r"https?://[\w./]+", text)) <= {"http://www.w3.org/1999/xhtml"}
    assert "The above copyright notice and this permission notice shall be included" in text
    assert "{{" not in text.replace("/*! three", "").split("</script>")[-1]
    assert "<title>run</title>" in text
    assert tuple(run["bodies"]) == chain.body_names
    np.testing.assert_array_equal(run["times"], traj.ts)
    np.testing.assert_array_equal(run["gaps"], traj.gaps)
    np.testing.assert_allclose(
        run["energy"], jax.vmap(lambda s: svkc.energy(chain, s))(traj.states), rtol=ROUND_OFF
    )
    poses = np.frombuffer(base64.b64decode(run["poses"]), "<f4").reshape(
        21, len(chain.body_names), 7
    )
    positions, quats = svkc.poses(chain, jax.tree.map(lambda x: x[13], traj.states))
    np.testing.assert_allclose(poses[13], np.concatenate([positions, quats], -1), atol=1e-6)
    assert [p["mobility"] for p in run["phases"]] == [12, 17, 22] == traj.phases.freedoms.tolist()
    assert [[link["name"] for link in p["links"]] for p in run["phases"]] == [
        ["right_hand_grip", "left_hand_grip"],
        ["left_hand_grip"],
        [],
    ]
    assert [(e["time"], e["text"], e["lost"]) for e in run["events"]] == [
        (t, f"cut {link}", 0) for t, link in CUTS.items()
    ]
    # both ends of a link that holds are at one place
    (parent, at), (real, there) = run["phases"][0]["links"][0]["ends"]
    assert (chain.body_names[parent], chain.body_names[real]) == ("world", "right_hand")
    x, R = poses[0, real, :3], svkc.mjcf.bodies.matrix(poses[0, real, 3:].astype(float))
    np.testing.assert_allclose(x + R @ there, at, atol=1e-6)


@pytest.mark.slow
def test_ten_seconds_are_below_five_megabytes(release, tmp_path):
    """At 40 saved times a second."""
    chain, traj = release
    again = np.arange(401) % 21
    parts = lambda t: (t.ts, t.states, t.gaps, t.t_final)
    long = eqx.tree_at(
        parts,
        traj,
        (
            jnp.linspace(0, 10, 401),
            jax.tree.map(lambda x: x[again], traj.states),
            traj.gaps[again],
            jnp.asarray(10.0),
        ),
    )
    path = svkc.render(chain, long, tmp_path / "long.html")
    assert len(contents(path)["times"]) == 401
    assert path.stat().st_size < 5e6


def test_names_stay_names(pendulum, tmp_path):
    chain = pendulum
    path = svkc.render(
        chain, svkc.simulate(chain, chain.state(), 0.01, dt=0.01), tmp_path / "a <b> & c.html"
    )
    assert contents(path)["bodies"][1] == chain.body_names[1] == NAME
    assert '<b id="x">' not in path.read_text()
    assert "<title>a &lt;b&gt; &amp; c</title>" in path.read_text()


@pytest.mark.slow
def test_a_run_that_stopped_ends_where_it_did(stopped, tmp_path):
    """Times asked for past the end are left out, what the last event made is there, what is no
    number is null."""
    chain, traj = stopped
    run = contents(svkc.render(chain, traj, tmp_path / "stopped.html"))
    np.testing.assert_allclose(run["times"], [0, 0.01, 0.02, 0.03, 0.035])
    assert [p["mobility"] for p in run["phases"]] == [1, 3, 1]
    assert [e["text"] for e in run["events"]] == ["cut pin", "connect pin"]
    assert run["events"][1]["lost"] == float(traj.events.energy_lost[1])
    assert run["phases"][2]["links"][0]["ends"] is not None
    broken = eqx.tree_at(
        lambda t: (t.ts, t.gaps), traj, (traj.ts.at[4:].set(jnp.nan), traj.gaps.at[1].set(jnp.inf))
    )
    run = contents(svkc.render(chain, broken, tmp_path / "broken.html"))
    assert len(run["times"]) == 5
    assert run["gaps"][1] == [None, None]


def still(chain):
    return svkc.simulate(chain, chain.state(), 0.0, ts=jnp.zeros(1))


@pytest.mark.slow
def test_a_run_of_one_moment(pendulum, tmp_path):
    run = contents(svkc.render(pendulum, still(pendulum), tmp_path / "still.html"))
    assert (run["times"], run["events"], [p["mobility"] for p in run["phases"]]) == ([0.0], [], [1])


def kinds():
    chain = svkc.load(KINDS)
    return chain, svkc.simulate(chain, chain.state({"turn": 0.5}), 0.01, dt=0.01)


def test_every_kind_of_geom(tmp_path):
    run = contents(svkc.render(*kinds(), tmp_path / "kinds.html"))
    assert [g["kind"] for g in run["geoms"]] == [
        "plane",
        "mesh",
        "sphere",
        "capsule",
        "ellipsoid",
        "cylinder",
        "box",
        "mesh",
        "mesh",
    ]
    # the material's colour; a mesh that is used twice is there once
    assert run["geoms"][2]["rgba"] == [0, 1, 0, 1]
    assert [g.get("mesh") for g in run["geoms"]].count(1) == 2
    hill = np.frombuffer(base64.b64decode(run["meshes"][0]["vertices"]), "<f4").reshape(-1, 3)
    np.testing.assert_allclose(hill.min(0), [-1, -2, 0], atol=1e-6)
    np.testing.assert_allclose(hill.max(0), [1, 2, 0.5], atol=1e-6)
    faces = np.frombuffer(base64.b64decode(run["meshes"][1]["faces"]), "<u4").reshape(-1, 3)
    assert len(faces) == 4
    assert faces.max() == 3


def test_nothing_of_it_is_read_before_it_is_asked_for():
    code = (
        "import sys; opened = []; sys.addaudithook(lambda name, args: opened.append(str(args[0]))"
        " if name == 'open' else None);import svkc.page; assert any('render' in path for path in"
        " opened); assert not [path for path in opened if 'three.min' in path or 'page.html' in"
        " path]"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_it_plays_and_goes_through_time(release, visit, tmp_path):
    """The numbers at every time are the trajectory's."""
    chain, traj = release
    page = visit(svkc.render(chain, traj, tmp_path / "run.html"))
    first = picture(page)
    assert len(np.unique(first.reshape(-1, 3), axis=0)) > 200
    assert number(page, "time") == 0
    # by hand: a click into each phase
    bar, seen = page.locator("#track").bounding_box(), []
    for t, mobility, held in (
        (0.1, 12, "right_hand_grip\nleft_hand_grip"),
        (0.25, 17, "left_hand_grip"),
        (0.45, 22, "nothing"),
    ):
        page.mouse.click(bar["x"] + bar["width"] * t / 0.5, bar["y"] + bar["height"] / 2)
        assert number(page, "time") == pytest.approx(t, abs=2e-3)
        assert number(page, "mobility") == mobility
        assert page.inner_text("#links").strip() == held
        seen.append(
            (
                picture(page),
                page.inner_text("#gap"),
                page.evaluate("svkc.bodies[5].matrixWorld.elements"),
            )
        )
    assert all(changed(seen[i][0], seen[j][0]) > 500 for i, j in ((0, 1), (1, 2)))
    assert len({gap for _, gap, _ in seen}) == 3
    assert seen[0][2] != seen[1][2]
    # at a saved time: bodies, energy and gap of the trajectory
    page.evaluate("svkc.seek(svkc.run.times[13])")
    state = jax.tree.map(lambda x: x[13], traj.states)
    place = page.evaluate("svkc.bodies.map(body => body.matrixWorld.elements.slice(12, 15))")
    np.testing.assert_allclose(place, svkc.poses(chain, state)[0], atol=1e-5)
    assert number(page, "energy") == pytest.approx(float(svkc.energy(chain, state)), abs=2e-4)
    assert number(page, "gap") == pytest.approx(float(traj.gaps[13, 1]), rel=0.1)
    # half way between two saved times
    page.evaluate("svkc.seek((svkc.run.times[2] + svkc.run.times[3]) / 2)")
    middle = page.evaluate("svkc.bodies.map(body => body.matrixWorld.elements.slice(12, 15))")
    both = [svkc.poses(chain, jax.tree.map(lambda x, i=i: x[i], traj.states))[0] for i in (2, 3)]
    np.testing.assert_allclose(middle, (both[0] + both[1]) / 2, atol=1e-5)
    # by itself, to its end, and from there once more
    page.evaluate("svkc.seek(0)")
    page.click("#play")
    page.wait_for_function("svkc.time > 0.02")
    page.wait_for_function("svkc.time === 0.5")
    page.wait_for_selector("#play[aria-label=play]")
    # (the button that was pressed last takes no keys but its own)
    page.keyboard.press("Home")
    assert number(page, "time") == 0
    # by the keys: on and off, a frame at a time
    page.locator("#track").focus()
    page.keyboard.press("ArrowRight")
    assert number(page, "time") == pytest.approx(0.025)
    page.select_option("#speed", "0.1")
    page.locator("#track").focus()
    page.keyboard.press(" ")
    page.wait_for_function("svkc.time > 0.03")
    page.keyboard.press(" ")
    paused = page.evaluate("svkc.time")
    page.wait_for_timeout(200)
    assert page.evaluate("svkc.time") == paused < 0.5


@pytest.mark.slow
def test_events_are_marked(release, visit, tmp_path):
    """A mark says what happened, leads there, and the links that hold are drawn until then."""
    page = visit(svkc.render(*release, tmp_path / "run.html"))
    marks, bar = page.locator(".mark"), page.locator("#track").bounding_box()
    assert marks.count() == len(CUTS)
    for i, (t, link) in enumerate(CUTS.items()):
        middle = marks.nth(i).bounding_box()
        assert middle["x"] + middle["width"] / 2 == pytest.approx(
            bar["x"] + bar["width"] * t / 0.5, abs=1
        )
        assert marks.nth(i).get_attribute("aria-label") == f"{t:.3f} s  cut {link}"
        label = f"getComputedStyle(document.querySelectorAll('.mark')[{i}], '::after').display"
        page.mouse.move(5, 5)
        assert page.evaluate(label) == "none"
        marks.nth(i).hover()
        assert page.evaluate(label) == "block"
        marks.nth(i).click()
        assert number(page, "time") == t
        assert page.locator("#events .past").count() == i + 1
    drawn = "[...svkc.holds.values()].filter(([ball]) => ball.visible).map(([ball]) => ball.name)"
    red = lambda: int(np.sum(np.all(np.abs(picture(page) - [224, 32, 32]) < 50, -1)))
    page.evaluate("svkc.seek(0.1)")
    assert page.evaluate(drawn) == ["right_hand_grip", "left_hand_grip"]
    assert red() > 20
    page.evaluate("svkc.seek(0.21)")
    assert page.evaluate(drawn) == ["left_hand_grip"]
    assert red() == 0


@pytest.mark.slow
def test_energy_jumps_where_a_link_is_connected(stopped, visit, tmp_path):
    """Between saved times too, numbers are those of one phase."""
    chain, traj = stopped
    page = visit(svkc.render(chain, traj, tmp_path / "run.html"))

    def energy(t):
        page.evaluate("t => svkc.seek(t)", t)
        return number(page, "energy")

    before, after, lost = energy(0.035 - 1e-9), energy(0.035), float(traj.events.energy_lost[1])
    assert lost > 1e-3
    assert before - after == pytest.approx(lost, abs=1e-6 * abs(before))
    assert number(page, "time") == 0.035
    assert [number(page, "mobility"), page.inner_text("#links").strip()] == [1, "pin"]
    assert energy(0.0229) == pytest.approx(float(traj.phases.energy[0, 1]), rel=1e-5)
    # no state was saved between the cut and this: where nothing holds, nothing is drawn
    assert energy(0.0231) == pytest.approx(float(traj.phases.energy[1, 0]), rel=1e-5)
    assert page.evaluate("[...svkc.holds.values()].filter(([ball]) => ball.visible).length") == 0


@pytest.mark.slow
def test_the_camera_turns_and_everything_is_seen(release, visit, tmp_path):
    """Also in a narrow window, and after its size changed."""
    path = svkc.render(*release, tmp_path / "run.html")
    page = visit(path)
    first = picture(page)
    page.mouse.move(300, 300)
    page.mouse.down()
    page.mouse.move(450, 330, steps=3)
    page.mouse.up()
    assert changed(first, picture(page)) > 1000
    corners = """() => { const out = [];
        svkc.bodies.forEach(body => body.children.forEach(thing => {
        const c = thing.localToWorld(thing.position.clone().set(0, 0, 0)).project(svkc.camera);
        out.push(Math.abs(c.x), Math.abs(c.y)); }));
        return Math.max(...out); }"""
    for size in ((1000, 640), (380, 700)):
        narrow = visit(path, *size)
        picture(narrow)
        for t in (0, 0.25, 0.5):
            narrow.evaluate("t => svkc.seek(t)", t)
            assert narrow.evaluate(corners) < 1
        assert narrow.evaluate("document.documentElement.scrollWidth <= innerWidth")
    narrow.set_viewport_size({"width": 900, "height": 500})
    picture(narrow)
    assert (
        narrow.evaluate(
            "Math.abs(svkc.camera.aspect - document.querySelector('canvas').clientWidth /"
            " document.querySelector('canvas').clientHeight)"
        )
        < 0.01
    )
    assert narrow.evaluate(corners) < 1


@pytest.mark.slow
def test_every_kind_of_geom_is_drawn(visit, tmp_path):
    page = visit(svkc.render(*kinds(), tmp_path / "kinds.html"))
    whole = picture(page)
    assert page.evaluate("svkc.bodies.map(body => body.children.length)") == [2, 7]
    for body, child in [(0, 1), *((1, i) for i in range(7))]:
        show = f"on => {{ svkc.bodies[{body}].children[{child}].visible = on; svkc.seek(0); }}"
        page.evaluate(show, False)
        assert changed(whole, picture(page)) > 30, child
        page.evaluate(show, True)


@pytest.mark.slow
def test_names_stay_names_in_the_browser(pendulum, visit, tmp_path):
    """And a run of one moment can be looked at."""
    chain = pendulum
    page = visit(svkc.render(chain, still(chain), tmp_path / "one.html"))
    assert page.evaluate("svkc.bodies[1].name") == chain.body_names[1]
    assert page.locator("#x, .mark").count() == 0
    assert page.inner_text("#links").strip() == "nothing"
    assert not page.locator("#log").is_visible()
    page.click("#play")
    assert page.get_attribute("#play", "aria-label") == "play"
    assert len(np.unique(picture(page).reshape(-1, 3), axis=0)) > 50


@pytest.mark.slow
def test_a_notebook_shows_it(release, visit, tmp_path):
    """As a frame in its own document."""
    shown = svkc.page.show(*release, height=400)
    cell = shown._repr_html_()
    assert html.unescape(re.search(r'srcdoc="([^"]*)"', cell).group(1)) == shown.text
    (tmp_path / "cell.html").write_text(
        f"<!DOCTYPE html><meta charset=utf-8><link rel=icon href='data:,'>{cell}{cell}"
    )
    page = visit(tmp_path / "cell.html")
    page.frame_locator("iframe").nth(1).locator("#mobility").wait_for()
    page.frames[2].evaluate("svkc.seek(0.4)")
    assert [frame.inner_text("#mobility") for frame in page.frames[1:]] == ["12", "22"]
    assert page.locator("iframe").first.bounding_box()["height"] == 400
