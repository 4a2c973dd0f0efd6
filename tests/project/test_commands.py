"""The command line, in processes of its own."""

import pytest
import test_project
from test_project import run

import svkc

pytestmark = pytest.mark.slow

ROD = """<mujoco><worldbody>
  <body name="rod" pos="0 0 1"><joint name="pivot" axis="0 1 0"/><geom type="capsule"
    fromto="0 0 0 0.5 0 0" size="0.03"/></body>
  <body name="hook" pos="0.5 0 1"><joint name="slider" type="slide" axis="1 0 0"/><geom size="0.02"
    mass="0.1"/></body>
</worldbody><equality><connect name="pin" body1="rod" body2="hook" anchor="0.5 0 0"/></equality>
</mujoco>"""


def command(line, *args):
    """Runs svkc with the words of the line, then the arguments."""
    return run("-m", "svkc", *line.split(), *args, optimized=False)


def test_a_model_of_ones_own(tmp_path):
    """Let go and caught by name and time; what was written opens again."""
    (tmp_path / "rod.xml").write_text(ROD)
    out = tmp_path / "out"
    done = command(
        "run --t1 0.3 --release pin@0.1 --catch pin@0.2 --mp4 --out", out, tmp_path / "rod.xml"
    )
    assert done.returncode == 0, done.stderr
    assert "events at 0.100000 s, 0.200000 s" in done.stdout, done.stdout
    assert {"rod.npz", "rod.png", "rod_curves.png"} <= {path.name for path in out.iterdir()}
    traj = svkc.load_trajectory(out / "rod.npz")
    assert traj.phases.freedoms[:3].tolist() == [0, 2, 0]
    for name in ("rod.png", "rod_curves.png"):
        test_project._looks_drawn(out / name)
    assert ("libegl1" in done.stdout) or {"rod.gif", "rod.mp4"} <= {
        path.name for path in out.iterdir()
    }
    assert "libegl1" in done.stdout or (out / "rod.mp4").read_bytes()[4:8] == b"ftyp"
    seen = command("view --no-open", out / "rod.npz")
    assert seen.returncode == 0, seen.stdout + seen.stderr
    assert "largest loop gap" in seen.stdout
    assert "rod.html" in seen.stdout


def test_what_is_wrong_is_said(tmp_path):
    """One line that names it and a status that is not zero; no traceback."""
    (tmp_path / "rod.xml").write_text(ROD)
    (tmp_path / "no.npz").write_text("nothing")
    wrong = {
        "no scene and no file 'nowhere'": ("run nowhere",),
        "no virtual link 'pen'": ("run --release pen@0.1", tmp_path / "rod.xml"),
        "expected NAME@TIME": ("run --release pin",),
        "--t1: got -1.0, expected a positive number": ("run --t1 -1", tmp_path / "rod.xml"),
        "no.npz": ("run --out", tmp_path / "no.npz", tmp_path / "rod.xml"),
        "is not a whole trajectory": ("view", tmp_path / "no.npz"),
        "No such file": ("view", tmp_path / "nothing.npz"),
        "invalid choice": ("dance",),
    }
    for words, args in wrong.items():
        done = command(*args)
        assert done.returncode != 0, args
        assert words in done.stdout + done.stderr, done.stdout + done.stderr
        assert "Traceback" not in done.stderr, done.stderr


def test_scenes_are_listed():
    listed = command("scenes")
    for name in ("high_bar", "swing", "brachiation", "walking"):
        assert name in listed.stdout
