"""Behaviour of a run's page in a browser."""

import html
import io
import pathlib
import re
import shutil

import jax
import numpy as np
import pytest
from pages import CUTS, run_of_every_geom, static_run

import svkc

BROWSERS = ("chromium", "chromium-browser", "google-chrome")


@pytest.fixture(scope="module")
def browser():
    """Start Chromium without a window."""
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
def open_page(browser):
    """Open a page from its file, without a network. Any console message is a failure."""
    messages, pages = [], []

    def visit_(path, width=1000, height=640):
        page = browser.new_page(viewport={"width": width, "height": height})
        pages.append(page)
        page.set_default_timeout(60000)
        page.context.set_offline(True)
        page.on("console", lambda message: messages.append(message.text))
        page.on("pageerror", lambda error: messages.append(str(error)))
        page.goto(pathlib.Path(path).as_uri())
        return page

    yield visit_
    for page in pages:
        page.close()
    assert not messages


def screenshot(page):
    """Return the pixels of the drawing, without numbers and time line."""
    from PIL import Image

    # the requested frame is shown in the frame after it
    page.evaluate(
        "() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))"
    )
    return np.asarray(
        Image.open(io.BytesIO(page.locator("canvas").screenshot())).convert("RGB"), int
    )


def count_changed_pixels(one, other) -> int:
    """Return the number of pixels that differ."""
    return int(np.sum(np.abs(one - other).max(-1) > 24))


def read_number(page, name):
    return float(page.inner_text(f"#{name}").split()[0])


# Change the width of the drawing. After the page has seen the new size, in the same frame, return
# the number of its pixels that are not empty.
PIXELS_AFTER_A_RESIZE = """() => new Promise(done => {
  const view = document.querySelector("#view"), canvas = view.querySelector("canvas");
  let calls = 0;
  new ResizeObserver(() => {
    if (++calls === 1) return view.style.width = "500px";  // the first call is that of observe
    const { width, height } = canvas;
    const context = new OffscreenCanvas(width, height).getContext("2d");
    context.drawImage(canvas, 0, 0);
    done(context.getImageData(0, 0, width, height).data.filter((x, i) => i % 4 === 3 && x).length);
  }).observe(view);
})"""


@pytest.mark.slow
def test_a_frame_is_drawn_when_the_size_changes(open_page, tmp_path):
    page = open_page(svkc.render(*run_of_every_geom(), tmp_path / "run.html"))
    screenshot(page)
    assert page.evaluate(PIXELS_AFTER_A_RESIZE) > 1000


@pytest.mark.slow
def test_playing_seeking_and_keys(release, open_page, tmp_path):
    """At every time the page's numbers are the trajectory's."""
    chain, traj = release
    page = open_page(svkc.render(chain, traj, tmp_path / "run.html"))
    first = screenshot(page)
    assert len(np.unique(first.reshape(-1, 3), axis=0)) > 200
    assert read_number(page, "time") == 0
    # click into each phase
    bar, phases_shown = page.locator("#track").bounding_box(), []
    for t, mobility, held in (
        (0.1, 12, "right_hand_grip\nleft_hand_grip"),
        (0.25, 17, "left_hand_grip"),
        (0.45, 22, "nothing"),
    ):
        page.mouse.click(bar["x"] + bar["width"] * t / 0.5, bar["y"] + bar["height"] / 2)
        assert read_number(page, "time") == pytest.approx(t, abs=2e-3)
        assert read_number(page, "mobility") == mobility
        assert page.inner_text("#links").strip() == held
        phases_shown.append(
            (
                screenshot(page),
                page.inner_text("#gap"),
                page.evaluate("svkc.bodies[5].matrixWorld.elements"),
            )
        )
    assert all(
        count_changed_pixels(phases_shown[i][0], phases_shown[j][0]) > 500
        for i, j in ((0, 1), (1, 2))
    )
    assert len({gap for _, gap, _ in phases_shown}) == 3
    assert phases_shown[0][2] != phases_shown[1][2]
    # at a save time: bodies, energy and gap of the trajectory
    page.evaluate("svkc.seek(svkc.run.times[13])")
    state = jax.tree.map(lambda x: x[13], traj.states)
    place = page.evaluate("svkc.bodies.map(body => body.matrixWorld.elements.slice(12, 15))")
    np.testing.assert_allclose(place, svkc.poses(chain, state)[0], atol=1e-5)
    assert read_number(page, "energy") == pytest.approx(float(svkc.energy(chain, state)), abs=2e-4)
    assert read_number(page, "gap") == pytest.approx(float(traj.gaps[13, 1]), rel=0.1)
    # half way between two save times
    page.evaluate("svkc.seek((svkc.run.times[2] + svkc.run.times[3]) / 2)")
    midway = page.evaluate("svkc.bodies.map(body => body.matrixWorld.elements.slice(12, 15))")
    both = [svkc.poses(chain, jax.tree.map(lambda x, i=i: x[i], traj.states))[0] for i in (2, 3)]
    np.testing.assert_allclose(midway, (both[0] + both[1]) / 2, atol=1e-5)
    # play to the end, then press Home
    page.evaluate("svkc.seek(0)")
    page.click("#play")
    page.wait_for_function("svkc.time > 0.02")
    page.wait_for_function("svkc.time === 0.5")
    page.wait_for_selector("#play[aria-label=play]")
    # the focused button takes no keys but its own
    page.keyboard.press("Home")
    assert read_number(page, "time") == 0
    # keys: play, pause, single frames
    page.locator("#track").focus()
    page.keyboard.press("ArrowRight")
    assert read_number(page, "time") == pytest.approx(0.025)
    page.select_option("#speed", "0.1")
    page.locator("#track").focus()
    page.keyboard.press(" ")
    page.wait_for_function("svkc.time > 0.03")
    page.keyboard.press(" ")
    paused = page.evaluate("svkc.time")
    page.wait_for_timeout(200)
    assert page.evaluate("svkc.time") == paused < 0.5


@pytest.mark.slow
def test_event_marks(release, open_page, tmp_path):
    """A mark on the time line names its event and seeks to it; connected links are drawn until
    then.
    """
    page = open_page(svkc.render(*release, tmp_path / "run.html"))
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
        assert read_number(page, "time") == t
        assert page.locator("#events .past").count() == i + 1
    drawn = (
        "[...svkc.linkMarkers.values()].filter(([ball]) => ball.visible).map(([ball]) => ball.name)"
    )
    red = lambda: int(np.sum(np.all(np.abs(screenshot(page) - [224, 32, 32]) < 50, -1)))
    page.evaluate("svkc.seek(0.1)")
    assert page.evaluate(drawn) == ["right_hand_grip", "left_hand_grip"]
    assert red() > 20
    page.evaluate("svkc.seek(0.21)")
    assert page.evaluate(drawn) == ["left_hand_grip"]
    assert red() == 0


@pytest.mark.slow
def test_energy_jumps_where_a_link_is_connected(stopped, open_page, tmp_path):
    """Between save times, too, the numbers are those of one phase."""
    chain, traj = stopped
    page = open_page(svkc.render(chain, traj, tmp_path / "run.html"))

    def energy(t):
        page.evaluate("t => svkc.seek(t)", t)
        return read_number(page, "energy")

    before, after, lost = energy(0.035 - 1e-9), energy(0.035), float(traj.events.energy_lost[1])
    assert lost > 1e-3
    assert before - after == pytest.approx(lost, abs=1e-6 * abs(before))
    assert read_number(page, "time") == 0.035
    assert [read_number(page, "mobility"), page.inner_text("#links").strip()] == [1, "pin"]
    assert energy(0.0229) == pytest.approx(float(traj.phases.energy[0, 1]), rel=1e-5)
    # no state was saved since the cut: placements are unknown and no link is drawn
    assert energy(0.0231) == pytest.approx(float(traj.phases.energy[1, 0]), rel=1e-5)
    assert (
        page.evaluate("[...svkc.linkMarkers.values()].filter(([ball]) => ball.visible).length") == 0
    )


@pytest.mark.slow
def test_the_camera_turns_and_keeps_all_bodies_in_view(release, open_page, tmp_path):
    """All bodies are in view, also in a narrow window and after a change of size."""
    path = svkc.render(*release, tmp_path / "run.html")
    page = open_page(path)
    first = screenshot(page)
    page.mouse.move(300, 300)
    page.mouse.down()
    page.mouse.move(450, 330, steps=3)
    page.mouse.up()
    assert count_changed_pixels(first, screenshot(page)) > 1000
    corners = """() => { const out = [];
        svkc.bodies.forEach(body => body.children.forEach(thing => {
        const c = thing.localToWorld(thing.position.clone().set(0, 0, 0)).project(svkc.camera);
        out.push(Math.abs(c.x), Math.abs(c.y)); }));
        return Math.max(...out); }"""
    for size in ((1000, 640), (380, 700)):
        narrow = open_page(path, *size)
        screenshot(narrow)
        for t in (0, 0.25, 0.5):
            narrow.evaluate("t => svkc.seek(t)", t)
            assert narrow.evaluate(corners) < 1
        assert narrow.evaluate("document.documentElement.scrollWidth <= innerWidth")
    narrow.set_viewport_size({"width": 900, "height": 500})
    screenshot(narrow)
    assert (
        narrow.evaluate(
            "Math.abs(svkc.camera.aspect - document.querySelector('canvas').clientWidth /"
            " document.querySelector('canvas').clientHeight)"
        )
        < 0.01
    )
    assert narrow.evaluate(corners) < 1


@pytest.mark.slow
def test_every_kind_of_geom_is_drawn(open_page, tmp_path):
    page = open_page(svkc.render(*run_of_every_geom(), tmp_path / "run_of_every_geom.html"))
    all_geoms = screenshot(page)
    assert page.evaluate("svkc.bodies.map(body => body.children.length)") == [2, 7]
    for body, child in [(0, 1), *((1, i) for i in range(7))]:
        show = f"on => {{ svkc.bodies[{body}].children[{child}].visible = on; svkc.seek(0); }}"
        page.evaluate(show, False)
        assert count_changed_pixels(all_geoms, screenshot(page)) > 30, child
        page.evaluate(show, True)


@pytest.mark.slow
def test_names_are_escaped_in_the_browser(pendulum, open_page, tmp_path):
    """A name with HTML tags stays text; a run of zero duration has a page."""
    chain = pendulum
    page = open_page(svkc.render(chain, static_run(chain), tmp_path / "one.html"))
    assert page.evaluate("svkc.bodies[1].name") == chain.body_names[1]
    assert page.locator("#x, .mark").count() == 0
    assert page.inner_text("#links").strip() == "nothing"
    assert not page.locator("#log").is_visible()
    page.click("#play")
    assert page.get_attribute("#play", "aria-label") == "play"
    assert len(np.unique(screenshot(page).reshape(-1, 3), axis=0)) > 50


@pytest.mark.slow
def test_a_notebook_shows_the_page(release, open_page, tmp_path):
    """The notebook's representation is a frame with its own document."""
    shown = svkc.show(*release, height=400)
    cell = shown._repr_html_()
    assert html.unescape(re.search(r'srcdoc="([^"]*)"', cell).group(1)) == shown.text
    (tmp_path / "cell.html").write_text(
        f"<!DOCTYPE html><meta charset=utf-8><link rel=icon href='data:,'>{cell}{cell}"
    )
    page = open_page(tmp_path / "cell.html")
    page.frame_locator("iframe").nth(1).locator("#mobility").wait_for()
    page.frames[2].evaluate("svkc.seek(0.4)")
    assert [frame.inner_text("#mobility") for frame in page.frames[1:]] == ["12", "22"]
    assert page.locator("iframe").first.bounding_box()["height"] == 400
