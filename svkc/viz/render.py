"""Pictures of a run. matplotlib, Pillow and mujoco's renderer are imported where they are used."""

import os
import pathlib

from svkc.model.chain import Chain
from svkc.model.checked_jit import check_chain
from svkc.model.validation import integer, names, positive_scalar, scalar, vector
from svkc.simulation.trajectory import Trajectory
from svkc.viz.html_page import write_page
from svkc.viz.shapes import check_single_run


def _require_packages() -> None:
    """RuntimeError: what draws is not installed."""
    for name in ("matplotlib", "PIL"):
        try:
            __import__(name)
        except ImportError as error:
            raise RuntimeError(
                "pictures need the packages matplotlib and pillow: pip install 'svkc[viz]'"
            ) from error


def render(
    chain: Chain, traj: Trajectory, path, *, fps: float = 25, frames: int = 10, size=(640, 480),
    trails=(), camera: str | None = None, lookat=None, distance=None, azimuth: float = 90,
    elevation: float = -8,
) -> pathlib.Path:  # fmt: skip
    """Writes a picture of the run by the ending of `path`: .png a strobe of `frames` poses seen
    from the side; .gif and .mp4 an animation of `fps` frames a second of size (width, height) in
    pixels, with a strip below that names the time, what holds and the events; .html a page of its
    own to turn, play and go through (`svkc.show` in a notebook).

    Of animations: trails: names of bodies whose paths are drawn; camera: the model's own of that
    name, else lookat (m), distance (m), azimuth and elevation (deg) place one. ValueError: another
    ending, a batch, no such body or camera, what is no number. RuntimeError: no GL library, no
    matplotlib, pillow or imageio-ffmpeg (names the packages).
    """
    from svkc.viz import animation, plots

    check_chain(chain)
    check_single_run(traj)
    frames, fps, path = (
        integer("frames", frames, 1),
        positive_scalar("fps", fps),
        pathlib.Path(os.fspath(path)),
    )
    size, trails = (
        tuple(integer("size", n, 16, 8192) for n in vector("size", size, 2)),
        names("trails", trails),
    )
    lookat = lookat if lookat is None else vector("lookat", lookat, 3)
    distance = distance if distance is None else positive_scalar("distance", distance)
    azimuth, elevation = scalar("azimuth", azimuth), scalar("elevation", elevation)
    if path.suffix != ".html":
        _require_packages()
    if path.suffix == ".png":
        return plots.strobe(chain, traj, path, frames)
    if path.suffix == ".html":
        return write_page(chain, traj, path)
    writer = {".gif": animation.write_gif, ".mp4": animation.write_mp4}.get(path.suffix)
    if writer is None:
        raise ValueError(f"render: {path.name} should end in .png, .gif, .mp4 or .html")
    view = {
        "camera": camera,
        "lookat": lookat,
        "distance": distance,
        "azimuth": azimuth,
        "elevation": elevation,
    }
    writer(path, animation.frames(chain, traj, fps=fps, size=size, trails=trails, **view), fps)
    return path


def plot(traj: Trajectory, chain: Chain | None = None):
    """A matplotlib figure: coordinates, energy, loop gaps, mobility over time, events as lines;
    names and energies in full where the chain is given."""
    from svkc.viz.plots import curves

    check_single_run(traj)
    _require_packages()
    if chain is not None:
        check_chain(chain)
    return curves(traj, chain)
