"""Public functions that draw a run. Drawing packages are imported when a function needs them."""

import os
import pathlib
from typing import Any

from svkc.model.annotations import Integer, Names, Numbers, Path, Scalar
from svkc.model.chain import Chain
from svkc.model.checked_jit import check_chain
from svkc.model.names import body_rows
from svkc.model.validation import integer, names, positive_scalar, scalar, vector
from svkc.simulation.trajectory import Trajectory
from svkc.viz.html_page import write_page
from svkc.viz.meshes import MIN_FACES
from svkc.viz.run_data import check_single_run


def _require_packages() -> None:
    """Raise RuntimeError if matplotlib or Pillow is not installed."""
    for name in ("matplotlib", "PIL"):
        try:
            __import__(name)
        except ImportError as error:
            raise RuntimeError(
                "pictures need the packages matplotlib and pillow: pip install 'svkc[viz]'"
            ) from error


def render(
    chain: Chain, traj: Trajectory, path: Path, *, fps: Scalar = 25, frames: Integer = 10,
    size: Numbers = (640, 480), trails: Names = (), camera: str | None = None,
    lookat: Numbers | None = None, distance: Scalar | None = None, azimuth: Scalar = 120,
    elevation: Scalar = -15, max_faces: Integer = 20_000,
) -> pathlib.Path:  # fmt: skip
    """Write a picture of a run in the format of the path's suffix, and return the path.

    .png: several poses in the x-z plane, in one picture. .gif, .mp4: an animation, above a strip
    with time, connected links and events. .html: an interactive page, that of `svkc.show`.

    traj: one run, not a batch.
    path: file to write; its suffix is .png, .gif, .mp4 or .html.
    fps: frames per second of an animation.
    frames: number of poses in a .png picture.
    size: (width, height) of an animation (pixels).
    trails: names of bodies whose paths are drawn in an animation.
    camera: name of a camera of the model, for an animation. None: a free camera, as follows.
    lookat: point at which the free camera looks (m, ground frame). None: the middle of the motion.
    distance: distance of the free camera from `lookat` (m). None: the whole motion is in view.
    azimuth, elevation: direction in which the free camera looks (degrees), as in MuJoCo: along y
        with 90 and 0. The default sees the x-z plane at three quarters, from slightly above.
    max_faces: meshes with more faces have at most this number in a page, as in `svkc.show`.

    Raises ValueError if the suffix is unknown, `traj` is a batch, a name does not exist, or a
    number is invalid. Raises RuntimeError, which names the missing packages, if a GL library,
    matplotlib, Pillow or imageio-ffmpeg is not installed.
    """
    from svkc.viz import animation
    from svkc.viz.strobe import strobe

    check_chain(chain)
    check_single_run(traj)
    frames, rate = integer("frames", frames, 1), float(positive_scalar("fps", fps))
    path = pathlib.Path(os.fspath(path))
    size = tuple(integer("size", n, 16, 8192) for n in vector("size", size, 2))
    trails, max_faces = names("trails", trails), integer("max_faces", max_faces, MIN_FACES)
    body_rows(chain.topology, *trails)
    view = _view(camera, lookat, distance, azimuth, elevation)
    if path.suffix not in (".png", ".gif", ".mp4", ".html"):
        raise ValueError(f"render: {path.name} should end in .png, .gif, .mp4 or .html")
    if path.suffix == ".html":
        return write_page(chain, traj, path, max_faces)
    _require_packages()
    if path.suffix == ".png":
        strobe(chain, traj, frames).savefig(path, dpi=110, bbox_inches="tight")
        return path
    images = animation.frames(chain, traj, fps=rate, size=size, trails=trails, **view)
    (animation.write_gif if path.suffix == ".gif" else animation.write_mp4)(path, images, rate)
    return path


def _view(camera, lookat, distance, azimuth, elevation) -> dict:
    """Validate the placement of the free camera and return the view by argument name."""
    return {
        "camera": camera,
        "lookat": lookat if lookat is None else vector("lookat", lookat, 3),
        "distance": distance if distance is None else positive_scalar("distance", distance),
        "azimuth": scalar("azimuth", azimuth),
        "elevation": scalar("elevation", elevation),
    }


def plot(traj: Trajectory, chain: Chain | None = None, *, joints: Names | None = None) -> Any:
    """Return a matplotlib figure of coordinates, energy, loop gaps and mobility over time.

    Events are numbered vertical lines. A panel of coordinates has at most eight curves, labelled by
    joint; lengths and angles are in panels of their own, and rotation vectors (rad) stand for
    quaternions. The parts of the energy add up to a constant, and the panel states by how much
    their sum drifts: kinetic energy, that of gravity and of springs, what control, dampers and
    limits took, and what was lost in events.

    traj: one run, not a batch.
    chain: the chain of the run, which adds the parts of the energy (J). Without a chain, the panel
        shows the energy at the ends of phases.
    joints: names of joints and virtual links whose coordinates are shown. None: all joints of the
        tree; of more than 48 coordinates, those 48 that change most.

    Raises ValueError if `traj` is a batch or a joint does not exist, RuntimeError if matplotlib is
    not installed.
    """
    from svkc.viz.plots import curves

    check_single_run(traj)
    _require_packages()
    if chain is not None:
        check_chain(chain)
    return curves(traj, chain, None if joints is None else names("joints", joints))
