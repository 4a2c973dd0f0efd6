"""The example of the README and those of `examples/` run and use public names only."""

import re

import pytest
from processes import ROOT, looks_drawn, run


@pytest.mark.slow
def test_readme_example_runs():
    code = re.search(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.S).group(1)
    done = run("-c", code)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("[0."), done.stdout


EXAMPLES = {
    "01_high_bar": ("right_hand_grip, left_hand_grip 24 12 12", "nothing 22 0 22"),
    "02_swing": ("left_thigh_plate 31 21 10", "right_hand_rod, left_hand_rod 29 12 17"),
    "03_brachiation": (
        "right_hand_bar1 23 6 17",
        "right_hand_bar1, left_hand_bar2 24 12 12",
        "right_hand_bar3 23 6 17",
    ),
    "04_walk": (
        "left_foot_ground, right_foot_ground 22 11 11",
        "left_foot_ground 22 6 16",
        "right_foot_ground 22 6 16",
    ),
    "05_optimise_release": (
        "after 0 steps",
        "after 25 steps",
        "gradient at the start",
        "gradient at the end",
    ),
    "06_soft_catch": ("gradient at the start", "gradient at the end"),
    "07_identify": ("derivatives at the start", "derivatives at the end"),
    "09_backflip": ("landing", "largest defects of the intervals"),
    "10_hopper": ("landing", "largest defects of the intervals"),
    "11_giant_swing": ("catch", "largest defects of the intervals"),
}


def test_every_example_is_tested():
    # the example of the viewer draws no picture; tests/mjcf/test_convert.py runs it
    assert {path.stem for path in (ROOT / "examples").glob("*.py")} == {
        *EXAMPLES,
        "08_mujoco_viewer",
    }


@pytest.mark.slow
@pytest.mark.parametrize("name", EXAMPLES)
def test_example_draws_its_picture(name, tmp_path):
    """An example runs from the command line, is under 80 lines, and uses public names only."""
    text = (ROOT / "examples" / f"{name}.py").read_text()
    assert text.count("\n") < 80
    assert not re.search(r"from svkc\.(?!scenes)|import svkc\.(?!scenes)", text)
    done = run(ROOT / "examples" / f"{name}.py", tmp_path, optimized=name == "01_high_bar")
    assert done.returncode == 0, done.stderr
    for words in EXAMPLES[name]:
        # columns of a table are separated by several spaces
        assert words in re.sub(" +", " ", done.stdout), done.stdout
    # the errors of derivatives that an example prints
    errors = [float(number) for number in re.findall(r"worst relative error (\S+)", done.stdout)]
    assert len(errors) == (2 if "05" <= name < "08" else 0)
    assert max(errors, default=0) <= 1e-6, done.stdout
    # the figure walks: from one foot to two at least four times
    assert name != "04_walk" or done.stdout.count("left_foot_ground, right_foot_ground") >= 5
    looks_drawn(tmp_path / f"{name}.png")
