"""Images by MuJoCo's offscreen renderer, on a plain background."""

import contextlib
import copy
import importlib
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from svkc.model.annotations import MuJoCo

GL_PACKAGES = "libegl1 libgl1"
# red, green, blue
BACKGROUND = (236, 240, 245)


def _gl_context() -> Callable:
    """Return the class of the first offscreen GL context whose library is installed.

    Raises RuntimeError, which names the missing packages, if there is none.
    """
    for module in ("mujoco.egl", "mujoco.osmesa"):
        try:
            return importlib.import_module(module).GLContext
        except (ImportError, AttributeError, RuntimeError, OSError, TypeError):
            continue
    raise RuntimeError(
        f"no library to draw with: install the packages {GL_PACKAGES} (apt-get install"
        f" --no-install-recommends {GL_PACKAGES})"
    )


@contextlib.contextmanager
def offscreen(model, size: tuple[int, int]) -> Iterator[Callable]:
    """Yield a function of (data, camera, decorate) that returns a PIL image.

    Each pixel is the mean of four, so that edges have no steps. The background replaces the sky of
    the model, whose gradient a gif would show as bands. There are no shadows.

    size: (width, height) of the image (pixels).
    `decorate` adds geoms to MuJoCo's scene before it is drawn.

    Raises RuntimeError if no GL library is installed.
    """
    import mujoco
    from PIL import Image

    # a larger image could exceed the largest buffer of the GL library
    scale = 2 if max(size) <= 4096 else 1
    width, height = (scale * n for n in size)
    model = copy.copy(model)
    model.vis.quality.shadowsize = model.vis.quality.offsamples = 0
    if not model.nlight:
        model.vis.headlight.ambient[:], model.vis.headlight.diffuse[:] = 0.35, 0.65
    model.vis.global_.offwidth, model.vis.global_.offheight = width, height
    gl = _gl_context()(width, height)
    gl.make_current()
    context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
    mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, context)
    context.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR
    scene, rect = mujoco.MjvScene(model, 10_000), mujoco.MjrRect(0, 0, width, height)
    options, perturbation = mujoco.MjvOption(), mujoco.MjvPerturb()
    pixels, depth = np.zeros((height, width, 3), np.uint8), np.zeros((height, width), np.float32)

    def draw(data, camera, decorate: Callable) -> Any:
        every = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(
            m=model, d=data, opt=options, pert=perturbation, cam=camera, catmask=every, scn=scene
        )
        scene.flags[mujoco.mjtRndFlag.mjRND_SKYBOX] = 0
        decorate(scene)
        mujoco.mjr_render(rect, scene, context)
        mujoco.mjr_readPixels(pixels, depth, rect, context)
        pixels[depth == 0] = BACKGROUND
        return Image.fromarray(pixels[::-1]).reduce(scale)

    try:
        yield draw
    finally:
        context.free()
        gl.free()


def add_sphere(scene: MuJoCo, position: np.ndarray, radius: float, rgba: Sequence[float]) -> None:
    """Add a sphere to MuJoCo's scene, unless the scene is full."""
    import mujoco

    _add(scene, mujoco.mjtGeom.mjGEOM_SPHERE, np.full(3, radius), position, rgba)


def add_line(
    scene: MuJoCo,
    start: np.ndarray,
    stop: np.ndarray,
    rgba: Sequence[float],
    *,
    radius: float = 0.0,
) -> None:
    """Add a line to MuJoCo's scene, unless the scene is full.

    radius: of a thin cylinder with round ends (m). Zero: a line as wide as a pixel.
    """
    import mujoco

    kind = mujoco.mjtGeom.mjGEOM_CAPSULE if radius else mujoco.mjtGeom.mjGEOM_LINE
    if (geom := _add(scene, kind, np.zeros(3), np.zeros(3), rgba)) is not None:
        mujoco.mjv_connector(geom, kind, radius or 2.0, start, stop)


def _add(scene, kind, size: np.ndarray, position: np.ndarray, rgba) -> Any:
    """Return a new geom of MuJoCo's scene, or None if the scene is full."""
    import mujoco

    if scene.ngeom >= scene.maxgeom:
        return None
    geom = scene.geoms[scene.ngeom]
    mujoco.mjv_initGeom(
        geom,
        type=kind,
        size=size,
        pos=position,
        mat=np.eye(3).ravel(),
        rgba=np.asarray(rgba, np.float32),
    )
    scene.ngeom += 1
    return geom
