"""Animations of a run, by MuJoCo's offscreen renderer: gif by Pillow, mp4 by imageio-ffmpeg."""

import pathlib
import warnings
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from svkc.mjcf.bodies import rotation_matrix
from svkc.model.annotations import Checked, Names
from svkc.model.chain import Chain
from svkc.simulation.trajectory import Trajectory
from svkc.viz.shapes import (
    color,
    connected_link_positions,
    event_descriptions,
    positions_and_rotations,
)

GL_PACKAGES = "libegl1 libgl1"
FLASH_DURATION = 0.3  # s after an event during which connected links are drawn large


def _use_offscreen_context():
    """Make MuJoCo's renderer use the first offscreen GL context whose library is installed.

    Raises RuntimeError, which names the missing packages, if there is none.
    """
    import importlib

    for module in ("mujoco.egl", "mujoco.osmesa"):
        try:
            context = importlib.import_module(module).GLContext
        except (ImportError, AttributeError, RuntimeError, OSError, TypeError):
            continue
        importlib.import_module("mujoco.rendering.classic.gl_context").GLContext = context
        return
    raise RuntimeError(
        f"no library to draw with: install the packages {GL_PACKAGES} (apt-get install"
        f" --no-install-recommends {GL_PACKAGES})"
    )


def write_gif(path: pathlib.Path, images: Iterator[Any], fps: float) -> None:
    """Write a repeating gif with 96 colors a frame."""
    from PIL import Image

    first, *others = (image.quantize(96, Image.Quantize.MAXCOVERAGE) for image in images)
    first.save(path, save_all=True, append_images=others, duration=round(1000 / fps), loop=0)


def write_mp4(path: pathlib.Path, images: Iterator[Any], fps: float) -> None:
    """Write H.264 with imageio-ffmpeg's ffmpeg.

    Raises RuntimeError if imageio-ffmpeg is not installed.
    """
    try:
        import imageio_ffmpeg
    except ImportError as error:
        raise RuntimeError(
            "mp4 needs the package imageio-ffmpeg: pip install 'svkc[video]'"
        ) from error
    first = next(images)
    writer = imageio_ffmpeg.write_frames(
        str(path),
        first.size,
        fps=fps,  # pyright: ignore[reportArgumentType]  (inferred from its default, 16)
        macro_block_size=2,
        quality=7,
        ffmpeg_log_level="error",
    )
    with warnings.catch_warnings():
        # jax warns of forks, because threads may hold locks; this fork executes ffmpeg at once
        warnings.simplefilter("ignore", RuntimeWarning)
        writer.send(None)
    try:
        for image in (first, *images):
            writer.send(np.ascontiguousarray(image))
    finally:
        writer.close()


def frames(
    chain: Chain, traj: Trajectory, *, fps: float, size: Checked[Sequence[int]], trails: Names,
    **camera_options: Any,
) -> Iterator[Any]:  # fmt: skip
    """Yield PIL images `1/fps` s apart, each of the saved state nearest in time.

    Connected virtual links are drawn as spheres. A strip below the image shows the time, the
    connected links, the last event and a time line.

    size: (width, height) of the image without its strip (pixels).
    trails: names of bodies whose paths up to the image's time are drawn.
    view: arguments of `_choose_camera`.

    Raises ValueError if a body or camera does not exist, RuntimeError if no GL library is
    installed.
    """
    import mujoco
    from PIL import Image

    model = chain.model.model
    unknown = [name for name in trails if name not in chain.body_names]
    if unknown:
        raise ValueError(f"trails: no body {unknown[0]!r}; bodies: {', '.join(chain.body_names)}")
    _configure_offscreen(model, size)
    data = mujoco.MjData(model)
    ts, (positions, R) = np.asarray(traj.ts), positions_and_rotations(chain, traj.states)
    link_positions, events = (
        connected_link_positions(chain, traj.states, positions, R),
        event_descriptions(traj, chain),
    )
    camera = _choose_camera(model, positions, **camera_options)
    _use_offscreen_context()
    mujoco.mj_forward(model, data)
    with mujoco.Renderer(model, height=size[1], width=size[0]) as renderer:
        for t in np.arange(ts[0], ts[-1] + 0.5 / fps, 1 / fps):
            i = int(np.argmin(np.abs(ts - t)))
            _set_poses(model, data, positions[i], R[i])
            renderer.update_scene(data, camera)
            just_changed = any(0 <= t - time < FLASH_DURATION for time, _ in events)
            _draw_links(renderer.scene, link_positions[i], large=just_changed)
            for k, name in enumerate(trails):
                trail = positions[: i + 1, chain.body_names.index(name)]
                _draw_trail(renderer.scene, trail, color(k))
            image = Image.fromarray(renderer.render())
            links = [chain.link_names[k] for k in link_positions[i]]
            yield _add_caption(image, ts[i], ts[0], ts[-1], links, events)


def _configure_offscreen(model, size):
    """Make MuJoCo's offscreen buffer at least `size` pixels; disable shadows and multisampling."""
    model.vis.quality.shadowsize = model.vis.quality.offsamples = 0
    buffer = model.vis.global_
    buffer.offwidth, buffer.offheight = np.maximum(size, (buffer.offwidth, buffer.offheight))


def _set_poses(model, data, positions: np.ndarray, R: np.ndarray):
    """Write the poses of geoms and cameras into MuJoCo's data, from svkc's body poses.

    `mj_kinematics` would be wrong for cuttable joints: MuJoCo's tree holds them together.
    """
    geoms = model.geom_bodyid, model.geom_pos, model.geom_quat, data.geom_xpos, data.geom_xmat
    cameras = model.cam_bodyid, model.cam_pos, model.cam_quat, data.cam_xpos, data.cam_xmat
    for bodies, pos, quat, xpos, xmat in (geoms, cameras):
        for k, body in enumerate(bodies):
            xpos[k] = positions[body] + R[body] @ pos[k]
            xmat[k] = (R[body] @ rotation_matrix(quat[k])).ravel()


def _choose_camera(model, positions, *, camera, lookat, distance, azimuth, elevation):
    """Return the name of the model's camera, or a free camera that sees all body positions.

    Raises ValueError if the model has no camera of that name.
    """
    import mujoco

    if camera is not None:
        names = [model.camera(i).name for i in range(model.ncam)]
        if camera not in names:
            raise ValueError(
                f"camera: no camera {camera!r} in the model; cameras: {', '.join(names) or 'none'}"
            )
        return camera
    points = positions[:, 1:].reshape(-1, 3)
    low, high = points.min(0), points.max(0)
    free_camera = mujoco.MjvCamera()
    free_camera.lookat[:] = (low + high) / 2 if lookat is None else lookat
    free_camera.distance = float(np.linalg.norm(high - low)) + 1 if distance is None else distance
    free_camera.azimuth, free_camera.elevation = azimuth, elevation
    return free_camera


def _rgba(hexadecimal: str, alpha: float):
    """Return red, green, blue and opacity in [0, 1] for a color #rrggbb."""
    return np.array(
        [int(hexadecimal[k : k + 2], 16) / 255 for k in (1, 3, 5)] + [alpha], np.float32
    )


def _draw_links(scene, positions: dict[int, np.ndarray], large: bool):
    """Add a red sphere at each connected virtual link, larger just after an event."""
    import mujoco

    for position in positions.values():
        if scene.ngeom < scene.maxgeom:
            size, rgba = (
                np.full(3, 0.07 if large else 0.04),
                np.array([0.9, 0.1, 0.1, 1], np.float32),
            )
            mujoco.mjv_initGeom(
                scene.geoms[scene.ngeom],
                mujoco.mjtGeom.mjGEOM_SPHERE,
                size,
                position,
                np.eye(3).ravel(),
                rgba,
            )
            scene.ngeom += 1


def _draw_trail(scene, path: np.ndarray, hexadecimal: str):
    """Add the path of a body's origin as a thin line."""
    import mujoco

    for a, b in zip(path, path[1:], strict=False):
        if scene.ngeom < scene.maxgeom:
            geom = scene.geoms[scene.ngeom]
            mujoco.mjv_initGeom(
                geom,
                mujoco.mjtGeom.mjGEOM_CAPSULE,
                np.zeros(3),
                np.zeros(3),
                np.eye(3).ravel(),
                _rgba(hexadecimal, 0.9),
            )
            mujoco.mjv_connector(geom, mujoco.mjtGeom.mjGEOM_CAPSULE, 0.006, a, b)
            scene.ngeom += 1


def _add_caption(image, t: float, start: float, end: float, links: list[str], events):
    """Return the image with a strip below: time, connected links, last event, time line."""
    from PIL import Image, ImageDraw, ImageFont

    width, strip, margin = image.width, 58, 10
    out = Image.new("RGB", (width, image.height + strip), "#f4f4f2")
    out.paste(image, (0, 0))
    draw, y, font = ImageDraw.Draw(out), image.height, ImageFont.load_default(14)
    draw.text(
        (margin, y + 6), f"{t:6.3f} s   held by {', '.join(links) or 'nothing'}", "#222222", font
    )
    past = [f"{time:.3f} s: {description}" for time, description in events if time <= t]
    draw.text((margin, y + 25), past[-1] if past else "", "#b03030", font)
    pixel = lambda s: margin + (width - 2 * margin) * (s - start) / max(end - start, 1e-12)
    draw.rectangle((margin, y + 49, width - margin, y + 51), "#c8c8c4")
    draw.rectangle((margin, y + 49, pixel(t), y + 51), "#1f5fa8")
    for time, _ in events:
        draw.rectangle((pixel(time) - 1, y + 45, pixel(time) + 1, y + 55), "#b03030")
    return out
