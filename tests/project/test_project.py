"""The house: the door is light; README and example run."""

import ast
import os
import pathlib
import re
import subprocess
import sys
import tempfile
import types

import jax
import pytest

ROOT = pathlib.Path(__file__).parents[2]


CACHE = tempfile.TemporaryDirectory()


def run(*args, cwd=ROOT, optimized=True, settings=None):
    env = dict(os.environ)
    if optimized:
        env["XLA_FLAGS"] = env.get("XLA_FLAGS", "").replace(
            "--xla_backend_optimization_level=0", ""
        )
    # an example and the command of the same scene compile the same program; jax alone, as an
    # example uses it, may leave half an entry: not among the tests' own
    kept = jax.config.jax_compilation_cache_dir
    env |= {
        "JAX_COMPILATION_CACHE_DIR": f"{kept}/processes" if kept else CACHE.name,
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    }
    env |= settings or {}
    return subprocess.run(
        [sys.executable, *map(str, args)],
        capture_output=True,
        text=True,
        cwd=cwd,
        timeout=1200,
        check=False,
        env=env,
    )


def test_the_door_is_light():
    code = (
        "import sys, jax; before = dict(jax.config.values); import svkc; import jax._src.xla_bridge"
        " as b;assert 'mujoco' not in sys.modules and 'matplotlib' not in sys.modules,"
        " 'heavy';assert {k: jax.config.values[k] for k in before} == before, 'settings'; assert"
        " not b._backends, 'backend'"
    )
    done = run("-W", "error", "-c", code)
    assert done.returncode == 0, done.stderr


def test_every_public_name_says_what_it_is():
    import svkc

    for name in dir(svkc):
        thing = getattr(svkc, name)
        if name.startswith("_") or type(thing).__name__ == "module":
            continue
        assert thing.__doc__, name


@pytest.mark.slow
def test_readme_example_runs():
    code = re.search(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.S).group(1)
    done = run("-c", code)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("[0."), done.stdout


DOOR = """
Baumgarte Chain Check Drift Dynamics Exact Grip Projection RESULTS Replay RodriguesEuler
SemiImplicitEuler State Structure Trajectory VirtualLink actuation at bias_force bind by_bodies
check_grad connect coordinates cut difference energy error_between forward_dynamics from_mujoco
halved inertia_by_composites inertia_by_unit_vectors integrate inverse_dynamics jacobian
kinetic_energy leaves load load_chain load_trajectory lock loop_forces loop_gaps mass_matrix
mobility momentum overload plot poses potential_energy prefer render rollout simulate step tangent
to_mujoco touch transition tune unbind unlock velocities velocity_gaps when xyzw
"""


def test_the_door_is_what_is_listed():
    import svkc

    names = [
        name
        for name in dir(svkc)
        if not name.startswith("_") and not isinstance(getattr(svkc, name), types.ModuleType)
    ]
    assert sorted(names) == sorted(DOOR.split())


def test_old_names_of_stabilizations():
    import svkc

    assert svkc.Exact is svkc.stabilization.CoordinatePartitioning
    assert svkc.Drift is svkc.stabilization.NoStabilization


EXAMPLES = {
    "01_high_bar": ("24 joint freedoms", "22 joint freedoms"),
    "02_swing": ("31 joint freedoms", "29 joint freedoms"),
    "03_brachiation": (
        "right_hand_bar1; mobility 17",
        "right_hand_bar1, left_hand_bar2; mobility 12",
        "s: right_hand_bar3; mobility 17",
    ),
    "04_walk": (
        "left foot down",
        "right foot up",
        "left and right, 22 joint freedoms, mobility 11",
        "left, 22 joint freedoms, mobility 16",
    ),
    "05_optimise_release": (
        "after 0 steps",
        "after 25 steps",
        "gradient at the start",
        "gradient at the end",
    ),
    "06_soft_catch": ("gradient at the start", "gradient at the end"),
    "07_identify": ("derivatives at the start", "derivatives at the end"),
}


def test_examples_are_all_here():
    # the viewer's draws no picture: tests/mjcf/test_convert.py
    assert {path.stem for path in (ROOT / "examples").glob("*.py")} == {
        *EXAMPLES,
        "08_mujoco_viewer",
    }


@pytest.mark.slow
@pytest.mark.parametrize("name", EXAMPLES)
def test_example_draws_its_picture(name, tmp_path):
    """From the command line, whole; at most 70 statements; no library code: only public names."""
    text = (ROOT / "examples" / f"{name}.py").read_text()
    # statements, which the formatter does not multiply as it does lines
    assert sum(isinstance(node, ast.stmt) for node in ast.walk(ast.parse(text))) <= 70
    assert not re.search(r"from svkc\.(?!scenes)|import svkc\.(?!scenes)", text)
    done = run(
        ROOT / "examples" / f"{name}.py",
        tmp_path,
        optimized=name in ("01_high_bar", "05_optimise_release"),
    )
    assert done.returncode == 0, done.stderr
    for word in EXAMPLES[name]:
        assert word in done.stdout, done.stdout
    # what an example says of its own derivatives
    errors = [float(number) for number in re.findall(r"worst relative error (\S+)", done.stdout)]
    assert len(errors) == (2 if name >= "05" else 0)
    assert max(errors, default=0) <= 1e-6, done.stdout
    # at least four steps
    assert (
        name != "04_walk" or min(done.stdout.count("foot down"), done.stdout.count("foot up")) >= 4
    )
    _looks_drawn(tmp_path / f"{name}.png")


@pytest.mark.slow
def test_main_job(tmp_path):
    """python -m svkc: the table, the npz, the strobe and, where there is GL, the animation."""
    done = run("-m", "svkc", "--out", tmp_path)
    assert done.returncode == 0, done.stderr
    for word in (
        "24     12        12",
        "23      6        17",
        "22      0        22",
        "largest loop gap",
        "energy drift",
        "compilation",
    ):
        assert word in done.stdout, done.stdout
    _looks_drawn(tmp_path / "high_bar.png")
    _looks_drawn(tmp_path / "high_bar_curves.png")
    assert "high_bar.html" in done.stdout
    import svkc

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
    """python -m svkc swing: 30 joint freedoms and the swing's own, two fewer at the end."""
    done = run("-m", "svkc", "swing", "--out", tmp_path, optimized=False)
    assert done.returncode == 0, done.stderr
    for word in ("31     21        10", "29     12        17", "largest loop gap", "wrote"):
        assert word in done.stdout, done.stdout
    _looks_drawn(tmp_path / "swing.png")
    import svkc

    assert svkc.load_trajectory(tmp_path / "swing.npz").phases.joint_freedoms[:2].tolist() == [
        31,
        29,
    ]


def _looks_drawn(path):
    from PIL import Image

    with Image.open(path) as image:
        assert len(image.convert("RGB").getcolors(1 << 22)) > 20


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
    assert "1 joint freedoms in the tree" in done.stdout
    assert "mobility (N_F = N_J - m)     1" in done.stdout
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
        "1 virtual links: pin", "rank of the loops (m)        5",
        "pin: 6 rows, 1 of them redundant", "left out: collision",
        "joints that can be cut, load(..., cuttable=[...]): crank, coupler, rocker",
        "ends of the tree, which could be held: coupler, rocker",
    ):  # fmt: skip
        assert line in told, (line, told)
    (tmp_path / "bad.xml").write_text("<mujoco")
    assert run("-m", "svkc", "info", tmp_path / "bad.xml").returncode == 1


ROD = """<mujoco><worldbody><light pos="0 0 5"/>{}
  <body name="rod"><joint axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0.3 0.2 -1" size="0.05"/>
  </body></worldbody></mujoco>"""


def test_cameras(tmp_path):
    """The model's own by its name, and those that are placed, each see something else."""
    from PIL import Image

    import svkc

    camera = '<camera name="above" pos="0 -1 4" xyaxes="1 0 0 0 1 0"/>'
    chain = svkc.load(ROD.format(camera))
    traj, seen = svkc.simulate(chain, chain.state(), 0.1, ts=[0.0, 0.05, 0.1]), set()
    ways = (
        {"camera": "above"},
        {"lookat": (0, 0, -0.5)},
        {"lookat": (0, 0, -0.5), "distance": 6.0},
        {"azimuth": 20.0, "elevation": -60.0},
    )
    for i, way in enumerate(ways):
        try:
            path = svkc.render(
                chain, traj, tmp_path / f"{i}.gif", size=(96, 64), trails=("rod",), **way
            )
        except RuntimeError:
            # without an offscreen OpenGL there is no picture: test_messages has what is said then
            return
        with Image.open(path) as image:
            assert image.width == 96
            assert len(image.convert("RGB").getcolors(1 << 16)) > 10
            seen.add(image.convert("RGB").tobytes())
    assert len(seen) == len(ways)


def test_ruff_is_content():
    done = run(*"-m ruff check svkc tests examples benchmarks".split())
    assert done.returncode == 0, done.stdout
