"""The command line, in separate processes."""

import re

import jax
import jax.numpy as jnp
import pytest
from processes import looks_drawn, run

import svkc
from svkc.__main__ import main

ROD = """<mujoco><worldbody>
  <body name="rod" pos="0 0 1"><joint name="pivot" axis="0 1 0"/><geom type="capsule"
    fromto="0 0 0 0.5 0 0" size="0.03"/></body>
  <body name="hook" pos="0.5 0 1"><joint name="slider" type="slide" axis="1 0 0"/><geom size="0.02"
    mass="0.1"/></body>
</worldbody><equality><connect name="pin" body1="rod" body2="hook" anchor="0.5 0 0"/></equality>
</mujoco>"""


def command(line, *args):
    """Run the svkc command with the words of `line`, then the arguments."""
    return run("-m", "svkc", *line.split(), *args, optimized=False)


UNSUPPORTED = """<mujoco><option density="1.2"/><worldbody><body name="rod"><joint name="pivot"
  frictionloss="1"/><geom size="0.1"/></body></worldbody></mujoco>"""


@pytest.mark.parametrize(
    "words", [["--ignore", "friction,fluid"], ["--ignore", "friction", "--ignore", "fluid"]]
)
def test_info_leaves_out_what_is_named(tmp_path, capsys, words):
    """By kinds separated by commas, or by several options."""
    path = tmp_path / "rod.xml"
    path.write_text(UNSUPPORTED)
    assert main(["info", *words, str(path)]) == 0
    shown = capsys.readouterr().out
    assert "left out: friction: joint friction loss" in shown
    assert "not simulated:" not in shown


def test_a_refused_model_names_the_option(tmp_path, capsys):
    path = tmp_path / "rod.xml"
    path.write_text(UNSUPPORTED)
    assert main(["info", "--ignore", "fluid", str(path)]) == 1
    assert f"svkc info {path} --ignore friction,fluid" in capsys.readouterr().out
    assert main(["run", "--quiet", "--out", str(tmp_path / "out"), str(path)]) == 1
    assert f"svkc run {path} --ignore friction,fluid" in capsys.readouterr().out
    # without the option `info` shows what svkc reads, all that it cannot simulate left out
    assert main(["info", str(path)]) == 0
    shown = capsys.readouterr().out
    assert f"svkc info {path} --ignore friction,fluid" in shown
    assert "left out: fluid" in shown


@pytest.mark.slow
def test_run_and_view_of_a_model_file(tmp_path):
    """`svkc run` of a model releases and catches a link; `svkc view` opens the saved run."""
    (tmp_path / "rod.xml").write_text(ROD)
    out = tmp_path / "out"
    done = command(
        "run --t1 0.3 --release pin@0.1 --catch pin@0.2 --mp4 --out", out, tmp_path / "rod.xml"
    )
    assert done.returncode == 0, done.stderr
    assert re.search(r"^0\.100000 +0  - +pin ", done.stdout, re.M), done.stdout
    assert re.search(r"^0\.200000 +1  pin +- ", done.stdout, re.M), done.stdout
    assert {"rod.npz", "rod.png", "rod_curves.png"} <= {path.name for path in out.iterdir()}
    traj = svkc.load_trajectory(out / "rod.npz")
    assert traj.phases.freedoms[:3].tolist() == [0, 2, 0]
    for name in ("rod.png", "rod_curves.png"):
        looks_drawn(out / name)
    assert ("libegl1" in done.stdout) or {"rod.gif", "rod.mp4"} <= {
        path.name for path in out.iterdir()
    }
    assert "libegl1" in done.stdout or (out / "rod.mp4").read_bytes()[4:8] == b"ftyp"
    view = command("view --no-open", out / "rod.npz")
    assert view.returncode == 0, view.stdout + view.stderr
    assert "largest loop gap" in view.stdout
    assert "rod.html" in view.stdout


@pytest.mark.slow
def test_view_of_a_batch(tmp_path):
    """It prints the table of the batch and draws nothing."""
    chain = svkc.load(ROD)
    states = jax.tree.map(lambda x: jnp.stack([x, x]), chain.state())
    lanes = svkc.rollout(chain, states, 0.1, dt=0.05, progress=False)
    lanes.save(tmp_path / "lanes.npz", chain)
    view = command("view --no-open", tmp_path / "lanes.npz")
    assert view.returncode == 0, view.stdout + view.stderr
    assert view.stdout.startswith("Trajectories of 2 lanes: ")
    assert "a picture shows one run" in view.stdout
    assert [path.name for path in tmp_path.iterdir()] == ["lanes.npz"]


@pytest.mark.slow
def test_wrong_arguments_are_reported(tmp_path):
    """A wrong argument gives a message that names it and a nonzero status, without traceback."""
    (tmp_path / "rod.xml").write_text(ROD)
    (tmp_path / "no.npz").write_text("nothing")
    wrong = {
        "no scene and no file 'nowhere'": ("run nowhere",),
        "no virtual link 'pen'": ("run --release pen@0.1", tmp_path / "rod.xml"),
        "expected NAME@TIME": ("run --release pin",),
        "--t1: got -1.0, expected a positive number": ("run --t1 -1", tmp_path / "rod.xml"),
        "no.npz": ("run --out", tmp_path / "no.npz", tmp_path / "rod.xml"),
        "is not a complete trajectory": ("view", tmp_path / "no.npz"),
        "No such file": ("view", tmp_path / "nothing.npz"),
        "invalid choice": ("dance",),
    }
    for words, args in wrong.items():
        done = command(*args)
        assert done.returncode != 0, args
        assert words in done.stdout + done.stderr, done.stdout + done.stderr
        assert "Traceback" not in done.stderr, done.stderr


@pytest.mark.slow
def test_the_scenes_command():
    scenes = command("scenes")
    for name in ("high_bar", "swing", "brachiation", "walking"):
        assert name in scenes.stdout


@pytest.mark.slow
def test_main_job(tmp_path):
    """`python -m svkc` prints the table and writes the run, the pictures and, with GL, the gif."""
    done = run("-m", "svkc", "--out", tmp_path)
    assert done.returncode == 0, done.stderr
    for word in (
        "24    12        12",
        "23     6        17",
        "22     0        22",
        "largest loop gap",
        "energy drift",
        "compilation",
    ):
        assert word in done.stdout, done.stdout
    looks_drawn(tmp_path / "high_bar.png")
    looks_drawn(tmp_path / "high_bar_curves.png")
    assert "high_bar.html" in done.stdout
    traj = svkc.load_trajectory(tmp_path / "high_bar.npz")
    assert traj.events.time.tolist() == [0.9, 1.15]
    if "libegl1" in done.stdout:
        assert not (tmp_path / "high_bar.gif").exists()
    else:
        from PIL import Image

        with Image.open(tmp_path / "high_bar.gif") as image:
            assert image.n_frames > 40
            assert len(image.convert("RGB").getcolors(1 << 20)) > 10


@pytest.mark.slow
def test_the_swing_from_the_command_line(tmp_path):
    """`python -m svkc swing` prints 31 joint freedoms, and 29 after the seat is lost."""
    done = run("-m", "svkc", "swing", "--out", tmp_path, optimized=False)
    assert done.returncode == 0, done.stderr
    for word in ("31    21        10", "29    12        17", "largest loop gap", "wrote"):
        assert word in done.stdout, done.stdout
    looks_drawn(tmp_path / "swing.png")
    assert svkc.load_trajectory(tmp_path / "swing.npz").phases.joint_freedoms[:2].tolist() == [
        31,
        29,
    ]


@pytest.mark.slow
def test_info(tmp_path):
    xml = (
        '<mujoco><worldbody><body name="a"><joint name="j" frictionloss="1"/><geom'
        ' size="0.1"/></body></worldbody></mujoco>'
    )
    (tmp_path / "m.xml").write_text(xml)
    done = run(
        "-m",
        "svkc",
        "info",
        tmp_path / "m.xml",
        settings={"JAX_COMPILATION_CACHE_DIR": "", "SVKC_CACHE_DIR": str(tmp_path / "kept")},
    )
    assert done.returncode == 0, done.stderr
    assert f"compiled programs: {tmp_path / 'kept'}" in done.stdout
    assert list(tmp_path.glob("kept/jaxlib-*/*-cache"))
    assert "friction" in done.stdout
    assert "1 body, 1 joint, 0 virtual links, 0 actuators, 1 joint freedom in" in done.stdout
    assert "mobility (N_F = N_J - m)  1" in done.stdout
    assert "independent coordinates: j" in done.stdout
    rod = (
        '<body name="{0}"{2}><joint name="{0}" axis="0 1 0"/><geom type="capsule" fromto="0 0 0'
        ' {1}" size=".03"/>{3}</body>'
    )
    bars = rod.format(
        "crank", "0 0 .4", "", rod.format("coupler", "1 0 .2", ' pos="0 0 .4"', "")
    ) + rod.format("rocker", "0 0 .6", ' pos="1 0 0"', "")
    pin = (
        '<equality><connect name="pin" body1="coupler" body2="rocker" anchor="1 0 .2"/></equality>'
    )
    (tmp_path / "m.xml").write_text(f"<mujoco><worldbody>{bars}</worldbody>{pin}</mujoco>")
    told = run("-m", "svkc", "info", tmp_path / "m.xml").stdout
    for line in (
        "3 bodies, 3 joints, 1 virtual link,", "distance on real to", "rank of the loops (m)     5",
        "pin:  6 rows, 1 of them redundant", "left out: collision",
        "joints that can be cut, load(..., cuttable=[...]): crank, coupler, rocker",
        "ends of the tree, which could be held: coupler, rocker",
    ):  # fmt: skip
        assert line in told, (line, told)
    (tmp_path / "bad.xml").write_text("<mujoco")
    assert run("-m", "svkc", "info", tmp_path / "bad.xml").returncode == 1


def test_ignore_takes_one_word(tmp_path, capsys):
    """The word after it is the model. A scene has nothing to leave out."""
    path = tmp_path / "missing.xml"
    assert main(["run", "--ignore", "friction", str(path)]) == 1
    assert f"no scene and no file '{path}'" in capsys.readouterr().out
    assert main(["run", "--ignore", "friction", "high_bar", "--out", str(tmp_path)]) == 1
    assert "--ignore is for model files" in capsys.readouterr().out
    assert not list(tmp_path.iterdir())
