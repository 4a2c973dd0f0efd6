"""The notebook examples/tour.ipynb: every cell runs without a display and prints its stored output.

`python tests/project/test_notebook.py` stores new output.
"""

import base64
import io
import os
import pathlib
import re
import sys
import tempfile

import nbclient
import nbformat
import numpy as np
import pytest

ROOT = pathlib.Path(__file__).parents[2]
TOUR = ROOT / "examples" / "tour.ipynb"
NUMBER = re.compile(r"(?<![A-Za-z_])[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?|\binf\b")
# lines whose numbers depend on the machine's round-off: errors of differences, numbers of steps
ROUGH = re.compile(
    r"worst relative error .*?:|^work .*|^errors of steps.*|^rank margin.*"
    # the last columns of the phases: steps and energy drift
    r"| \d+ +[-+]?\d\.\d+e[-+]\d+$"
)


def execute_tour():
    """Return the executed notebook, and the paths of the Python and the svkc that executed it.

    A new process of this Python executes a copy. No file of the user's Jupyter is read or written.
    """
    from ipykernel.kernelspec import write_kernel_spec
    from traitlets.config import Config

    # a short path, because a socket's path may have no more than some 100 characters
    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        # Jupyter searches JUPYTER_PATH for kernels first
        write_kernel_spec(os.path.join(folder, "kernels", "python3"))
        patch.setenv("JUPYTER_PATH", folder)
        patch.setenv("JUPYTER_NO_CONFIG", "1")
        for name in ("JUPYTER_CONFIG_DIR", "JUPYTER_DATA_DIR", "JUPYTER_RUNTIME_DIR", "IPYTHONDIR"):
            patch.setenv(name, os.path.join(folder, name.lower()))
        patch.setenv(
            "PYTHONPATH", os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
        )
        notebook = nbformat.read(TOUR, 4)
        for cell in notebook.cells:
            if cell.cell_type == "code":
                cell.outputs, cell.execution_count = [], None
        notebook.cells.append(
            nbformat.v4.new_code_cell("import sys\nprint(sys.executable, svkc.__file__, sep='\\n')")
        )
        config = (
            Config()
            if os.name == "nt"
            else Config(KernelManager={"transport": "ipc", "ip": os.path.join(folder, "k")})
        )
        nbclient.NotebookClient(
            notebook,
            timeout=900,
            kernel_name="python3",
            record_timing=False,
            resources={"metadata": {"path": folder}},
            config=config,
        ).execute()
    output = printed_text(notebook.cells.pop())
    return notebook, output.split("\n")


def printed_text(cell):
    """Return what a cell printed."""
    return "".join(
        out.text for out in cell.get("outputs", ()) if out.output_type == "stream"
    ).strip()


def picture_count(cell):
    """Return the number of pictures in a cell's output."""
    return sum("image/png" in out.get("data", ()) for out in cell.get("outputs", ()))


def compressed_png(picture):
    """Return a picture with 64 colors, a third of the size, in base64."""
    from PIL import Image

    file = io.BytesIO()
    Image.open(io.BytesIO(base64.b64decode(picture))).convert("RGB").quantize(64).save(
        file, "PNG", optimize=True
    )
    return base64.b64encode(file.getvalue()).decode()


@pytest.mark.slow
def test_the_tour_runs_and_prints_what_is_stored():
    stored = nbformat.read(TOUR, 4)
    fresh, (python, package) = execute_tour()
    assert pathlib.Path(python).samefile(sys.executable)
    assert pathlib.Path(package).is_relative_to(ROOT)
    numbers = 0
    for old, new in zip(stored.cells, fresh.cells, strict=True):
        assert picture_count(old) == picture_count(new), new.source
        assert not [out for out in new.get("outputs", ()) if out.get("name") == "stderr"], (
            printed_text(new)
        )
        for line, again in zip(
            printed_text(old).split("\n"), printed_text(new).split("\n"), strict=True
        ):
            # the widths of columns depend on signs of round-off
            words, words_again = (NUMBER.sub("#", x).split() for x in (line, again))
            assert words == words_again
            line, again = (NUMBER.findall(ROUGH.sub("", x)) for x in (line, again))
            np.testing.assert_allclose(
                np.array(again, float), np.array(line, float), rtol=1e-5, atol=1e-6
            )
            numbers += len(line)
    assert numbers > 30
    assert sum(map(picture_count, stored.cells)) == 3


@pytest.mark.slow
def test_the_tour_is_small_and_names_no_local_path():
    text = TOUR.read_text()
    assert len(text) < 300_000
    # the base64 text of a picture may contain such a path by chance
    assert not re.search(
        r'/tmp|/home|/root|/usr|site-packages|"stderr"', re.sub(r'"image/png": "[^"]*"', "", text)
    )
    assert all(
        not out.output_type == "error"
        for cell in nbformat.read(TOUR, 4).cells
        for out in cell.get("outputs", ())
    )


if __name__ == "__main__":
    notebook, _ = execute_tour()
    for cell in notebook.cells:
        for out in cell.get("outputs", ()):
            if "image/png" in out.get("data", ()):
                out.data["image/png"] = compressed_png(out.data["image/png"])
    notebook.metadata = nbformat.read(TOUR, 4).metadata
    nbformat.write(notebook, TOUR)
