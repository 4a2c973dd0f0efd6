"""The example of the README and those of `examples/` run and use public names only."""

import ast
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


def test_every_example_is_tested():
    # the example of the viewer draws no picture; tests/mjcf/test_convert.py runs it
    assert {path.stem for path in (ROOT / "examples").glob("*.py")} == {
        *EXAMPLES,
        "08_mujoco_viewer",
    }


@pytest.mark.slow
@pytest.mark.parametrize("name", EXAMPLES)
def test_example_draws_its_picture(name, tmp_path):
    """An example runs from the command line, has at most 70 statements, uses public names only."""
    text = (ROOT / "examples" / f"{name}.py").read_text()
    # statements, because the formatter changes the number of lines
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
    # the errors of derivatives that an example prints
    errors = [float(number) for number in re.findall(r"worst relative error (\S+)", done.stdout)]
    assert len(errors) == (2 if name >= "05" else 0)
    assert max(errors, default=0) <= 1e-6, done.stdout
    # the figure walks at least four steps
    assert (
        name != "04_walk" or min(done.stdout.count("foot down"), done.stdout.count("foot up")) >= 4
    )
    looks_drawn(tmp_path / f"{name}.png")
