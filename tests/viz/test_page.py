"""Contents of the file of a run's page."""

import base64
import json
import pathlib
import re
import subprocess
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pages import CUTS, NAME, run_of_every_geom, sphere_of_faces, static_run
from tolerances import ROUND_OFF

import svkc


def page_data(path) -> dict:
    """Return the data of the run inside a page."""
    inside = re.findall(
        r'<script type="application/json" id="run">(.*?)</script>',
        pathlib.Path(path).read_text(),
        re.S,
    )
    assert len(inside) == 1
    return json.loads(inside[0])


@pytest.mark.slow
def test_the_page_is_self_contained(release, tmp_path):
    chain, traj = release
    path = svkc.render(chain, traj, tmp_path / "run.html")
    assert path == tmp_path / "run.html"
    text, run = path.read_text(), page_data(path)
    # nothing is fetched, the licence of three.js is included, every placeholder is replaced
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
    # both ends of a connected link coincide
    (parent, at), (real, there) = run["phases"][0]["links"][0]["ends"]
    assert (chain.body_names[parent], chain.body_names[real]) == ("world", "right_hand")
    x, R = poses[0, real, :3], svkc.mjcf.bodies.rotation_matrix(poses[0, real, 3:].astype(float))
    np.testing.assert_allclose(x + R @ there, at, atol=1e-6)


@pytest.mark.slow
def test_ten_seconds_are_below_five_megabytes(release, tmp_path):
    """The page of ten seconds at 40 save times a second is below five megabytes."""
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
    assert len(page_data(path)["times"]) == 401
    assert path.stat().st_size < 5e6


def test_names_are_escaped(pendulum, tmp_path):
    chain = pendulum
    path = svkc.render(
        chain, svkc.simulate(chain, chain.state(), 0.01, dt=0.01), tmp_path / "a <b> & c.html"
    )
    assert page_data(path)["bodies"][1] == chain.body_names[1] == NAME
    assert '<b id="x">' not in path.read_text()
    assert "<title>a &lt;b&gt; &amp; c</title>" in path.read_text()


@pytest.mark.slow
def test_the_page_of_a_stopped_run_ends_at_its_stop(stopped, tmp_path):
    """Save times after the end are left out, the last event's phase is there, NaN is null."""
    chain, traj = stopped
    run = page_data(svkc.render(chain, traj, tmp_path / "stopped.html"))
    np.testing.assert_allclose(run["times"], [0, 0.01, 0.02, 0.03, 0.035])
    assert [p["mobility"] for p in run["phases"]] == [1, 3, 1]
    assert [e["text"] for e in run["events"]] == ["cut pin", "connect pin"]
    assert run["events"][1]["lost"] == float(traj.events.energy_lost[1])
    assert run["phases"][2]["links"][0]["ends"] is not None
    broken = eqx.tree_at(
        lambda t: (t.ts, t.gaps), traj, (traj.ts.at[4:].set(jnp.nan), traj.gaps.at[1].set(jnp.inf))
    )
    run = page_data(svkc.render(chain, broken, tmp_path / "broken.html"))
    assert len(run["times"]) == 5
    assert run["gaps"][1] == [None, None]


def test_show_returns_the_page_for_a_notebook(pendulum):
    page = svkc.show(pendulum, static_run(pendulum), title="at rest", height=300)
    assert "<iframe" in page._repr_html_()
    assert "at rest" in page._repr_html_()


@pytest.mark.slow
def test_a_run_of_zero_duration(pendulum, tmp_path):
    run = page_data(svkc.render(pendulum, static_run(pendulum), tmp_path / "still.html"))
    assert (run["times"], run["events"], [p["mobility"] for p in run["phases"]]) == ([0.0], [], [1])


def test_every_kind_of_geom(tmp_path):
    run = page_data(svkc.render(*run_of_every_geom(), tmp_path / "kinds.html"))
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
    # a geom has its material's color; a mesh that is used twice is stored once
    assert run["geoms"][2]["rgba"] == [0, 1, 0, 1]
    assert [g.get("mesh") for g in run["geoms"]].count(1) == 2
    hill, wedge = run["meshes"]
    assert (hill["low"], hill["high"]) == ([-1, -2, pytest.approx(-0.1)], [1, 2, 0.5])
    assert decoded(wedge["vertices"]).reshape(-1, 3).max(0).tolist() == [65535] * 3
    faces = decoded(wedge["faces"]).reshape(-1, 3)
    assert len(faces) == 4
    assert faces.max() == 3


def decoded(text: str) -> np.ndarray:
    """Return the 16-bit numbers of a mesh."""
    return np.frombuffer(base64.b64decode(text), "<u2")


@pytest.mark.slow
def test_meshes_are_stored_once_and_decimated(tmp_path):
    """The length of the run adds nothing to the meshes; each mesh is within the limit of faces."""
    chain = svkc.load(sphere_of_faces(40_000))
    short, long = (
        page_data(
            svkc.render(
                chain, svkc.simulate(chain, chain.state(), 0.1, ts=np.linspace(0, 0.1, n)), path
            )
        )
        for n, path in ((2, tmp_path / "short.html"), (201, tmp_path / "long.html"))
    )
    assert [len(run["times"]) for run in (short, long)] == [2, 201]
    assert short["meshes"] == long["meshes"]
    assert len(short["meshes"]) == 1
    assert [geom["mesh"] for geom in short["geoms"]] == [0, 0]
    assert 10_000 < len(decoded(short["meshes"][0]["faces"])) / 3 <= 20_000
    assert (tmp_path / "long.html").stat().st_size < 1.2e6
    few = svkc.show(chain, static_run(chain), max_faces=500).text
    assert len(few) < 6.1e5


def test_the_page_files_are_read_lazily():
    code = (
        "import sys; opened = [];"
        " audit = lambda name, args: opened.append(str(args[0])) if name == 'open' else None;"
        " sys.addaudithook(audit); import svkc.viz.html_page;"
        " assert any('render' in path for path in opened);"
        " assert not [path for path in opened if 'three.min' in path or 'page.html' in path]"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
