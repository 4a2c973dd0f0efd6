"""The tour: every cell runs headless and prints its stored output. `python
tests/project/test_notebook.py` stores new output."""

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
# what another machine rounds otherwise: how good differences are, how many steps were tried; and
# round-off itself is below 1e-6
ROUGH = re.compile(r"worst relative error .*?:|^work .*|^errors of steps.*|^rank margin.*")


def executed():
    """A fresh copy, executed by this Python in a new process; and that process's Python and svkc.
    Nothing of the user's Jupyter is read or written."""
    from ipykernel.kernelspec import write_kernel_spec
    from traitlets.config import Config

    # (a short path: that of a socket may have no more than some 100 letters)
    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        # the first place where Jupyter looks for kernels
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
    output = printed(notebook.cells.pop())
    return notebook, output.split("\n")


def printed(cell):
    return "".join(
        out.text for out in cell.get("outputs", ()) if out.output_type == "stream"
    ).strip()


def drawn(cell):
    return sum("image/png" in out.get("data", ()) for out in cell.get("outputs", ()))


def smaller(picture):
    """With 64 colours: a third of the size."""
    from PIL import Image

    file = io.BytesIO()
    Image.open(io.BytesIO(base64.b64decode(picture))).convert("RGB").quantize(64).save(
        file, "PNG", optimize=True
    )
    return base64.b64encode(file.getvalue()).decode()


@pytest.mark.slow
def test_the_tour_runs_and_prints_what_is_stored():
    stored = nbformat.read(TOUR, 4)
    fresh, (python, package) = executed()
    assert pathlib.Path(python).samefile(sys.executable)
    assert pathlib.Path(package).is_relative_to(ROOT)
    numbers = 0
    for old, new in zip(stored.cells, fresh.cells, strict=True):
        assert drawn(old) == drawn(new), new.source
        assert not [out for out in new.get("outputs", ()) if out.get("name") == "stderr"], printed(
            new
        )
        for line, again in zip(printed(old).split("\n"), printed(new).split("\n"), strict=True):
            assert NUMBER.sub("#", line) == NUMBER.sub("#", again)
            line, again = (NUMBER.findall(ROUGH.sub("", x)) for x in (line, again))
            np.testing.assert_allclose(
                np.array(again, float), np.array(line, float), rtol=1e-5, atol=1e-6
            )
            numbers += len(line)
    assert numbers > 30
    assert sum(map(drawn, stored.cells)) == 3


@pytest.mark.slow
def test_the_tour_is_small_and_says_nothing_of_a_machine():
    text = TOUR.read_text()
    assert len(text) < 300_000
    # (a picture may have any letters)
    assert not re.search(
        r'/tmp|/home|/root|/usr|site-packages|"stderr"', re.sub(r'"image/png": "[^"]*"', "", text)
    )
    assert all(
        not out.output_type == "error"
        for cell in nbformat.read(TOUR, 4).cells
        for out in cell.get("outputs", ())
    )


if __name__ == "__main__":
    notebook, _ = executed()
    for cell in notebook.cells:
        for out in cell.get("outputs", ()):
            if "image/png" in out.get("data", ()):
                out.data["image/png"] = smaller(out.data["image/png"])
    notebook.metadata = nbformat.read(TOUR, 4).metadata
    nbformat.write(notebook, TOUR)
