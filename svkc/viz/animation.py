"""Animations of a run, by MuJoCo's offscreen renderer: gif by Pillow, mp4 by imageio-ffmpeg."""

import pathlib
import warnings
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from svkc.mjcf.bodies import rotation_matrix
from svkc.model.annotations import Checked, MuJoCo, Names, Numbers, Scalar
from svkc.model.chain import Chain
from svkc.simulation.trajectory import Trajectory
from svkc.viz.offscreen import add_line, add_sphere, offscreen
from svkc.viz.outlines import ground_and_bodies, motion_box
from svkc.viz.run_data import (
    color,
    connected_link_positions,
    event_descriptions,
    positions_and_rotations,
    saved_states,
)

FLASH_DURATION = 0.3  # s after an event during which connected links are drawn large
# color of trails, of links and of the grid on the ground: red, green, blue, opacity
RED, GREY = (0.9, 0.1, 0.1, 1.0), (0.6, 0.65, 0.71, 1.0)


def write_gif(path: pathlib.Path, images: Iterator[Any], fps: float) -> None:
    """Write a repeating gif whose frames share 256 colors, with the error diffused."""
    from PIL import Image

    every = list(images)
    # the colors are those of eight frames
    some = [every[i] for i in np.linspace(0, len(every) - 1, 8).astype(int)]
    sheet = Image.new("RGB", (some[0].width, 8 * some[0].height))
    for k, image in enumerate(some):
        sheet.paste(image, (0, k * image.height))
    palette = sheet.quantize(256, Image.Quantize.MEDIANCUT)
    first, *others = (image.quantize(palette=palette) for image in every)
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
    **view: Any,
) -> Iterator[Any]:  # fmt: skip
    """Yield PIL images `1/fps` s apart up to the end of the run, each of the nearest saved state.

    Connected virtual links are drawn as spheres. A strip below the image shows the time, the
    connected links, the last event and a time line. If the model has no plane, a grid shows the
    ground.

    size: (width, height) of the image without its strip (pixels).
    trails: names of bodies whose paths up to the image's time are drawn.
    view: arguments of `choose_camera`.

    Raises ValueError if a body or camera does not exist, RuntimeError if no GL library is
    installed.
    """
    import mujoco

    model = chain.model.model
    trailed = [chain.body_index(name) for name in trails]
    ts, _, states = saved_states(traj)
    positions, R = positions_and_rotations(chain, states)
    links = connected_link_positions(chain, states, positions, R)
    events, data = event_descriptions(traj, chain), mujoco.MjData(model)
    box = _box_of_run(chain, positions, R)
    camera = choose_camera(model, box, size[0] / size[1], **view)
    grid = [] if any(model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE) else _grid_lines(box)
    mujoco.mj_forward(model, data)
    size_of_link = float(chain.length)
    with offscreen(model, (size[0], size[1])) as draw:
        for t in np.arange(ts[0], ts[-1] + 0.5 / fps, 1 / fps):
            i = int(np.argmin(np.abs(ts - t)))
            _set_poses(model, data, positions[i], R[i])
            paths = [positions[: i + 1, body] for body in trailed]
            just_changed = any(0 <= t - time < FLASH_DURATION for time, _ in events)

            def decorate(scene, i=i, paths=paths, just_changed=just_changed):
                for start, stop in grid:
                    add_line(scene, start, stop, GREY)
                _draw_links(scene, links[i], (0.24 if just_changed else 0.13) * size_of_link)
                _draw_trails(scene, paths, 0.02 * size_of_link)

            held_by = [chain.link_names[k] for k in links[i]]
            image = draw(data, camera, decorate)
            yield _add_caption(image, ts[i], ts[0], ts[-1], held_by, events)


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


def _box_of_run(chain: Chain, positions: np.ndarray, R: np.ndarray) -> np.ndarray:
    """Return the lowest and the highest coordinates [2 3] of the bodies and the ground near (m)."""
    some = np.unique(np.linspace(0, len(positions) - 1, 40).round().astype(int))
    ground, bodies = ground_and_bodies(chain, float(chain.length) / 5)
    return motion_box(ground, bodies, positions[some], R[some])


def choose_camera(
    model: MuJoCo,
    box: np.ndarray,
    aspect: float,
    *,
    camera: Checked[str | None],
    lookat: Numbers | None,
    distance: Scalar | None,
    azimuth: Scalar,
    elevation: Scalar,
) -> MuJoCo:
    """Return the model's camera of a name, or a free camera that sees the whole box.

    Raises ValueError if the model has no camera of that name.
    """
    import mujoco

    result = mujoco.MjvCamera()
    if camera is not None:
        cameras = [model.camera(i).name for i in range(model.ncam)]
        if camera not in cameras:
            raise ValueError(
                f"camera: no camera {camera!r} in the model; cameras:"
                f" {', '.join(cameras) or 'none'}"
            )
        result.type = mujoco.mjtCamera.mjCAMERA_FIXED
        result.fixedcamid = cameras.index(camera)
        return result
    center = box.mean(0) if lookat is None else np.asarray(lookat, float)
    a, e = np.deg2rad([float(azimuth), float(elevation)])
    forward = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    right = np.array([np.sin(a), -np.cos(a), 0])
    corners = np.stack(np.meshgrid(*box.T), -1).reshape(-1, 3) - center
    slope = np.tan(np.deg2rad(float(model.vis.global_.fovy)) / 2)
    beside = np.maximum(abs(corners @ np.cross(right, forward)), abs(corners @ right) / aspect)
    needed = np.max(1.02 * beside / slope - corners @ forward)
    result.lookat[:] = center
    result.distance = needed if distance is None else float(distance)
    result.azimuth, result.elevation = float(azimuth), float(elevation)
    return result


def _grid_lines(box: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the ends of the lines of a grid below the box, a power of ten (m) apart.

    The grid is at z = 0, or at the lowest point of bodies that move below z = 0.
    """
    (x, y, _), radius = box.mean(0), float(np.linalg.norm(box[1] - box[0])) / 2
    spacing = 10 ** np.floor(np.log10(radius))
    number = np.arange(-np.ceil(3 * radius / spacing), np.ceil(3 * radius / spacing) + 1)
    # full multiples of the spacing
    x, y = (spacing * (np.round(center / spacing) + number) for center in (x, y))
    z = min(0.0, float(box[0, 2]))
    return [(np.array([a, y[0], z]), np.array([a, y[-1], z])) for a in x] + [
        (np.array([x[0], b, z]), np.array([x[-1], b, z])) for b in y
    ]


def _draw_links(scene, positions: dict[int, np.ndarray], radius: float):
    """Add a red sphere at each connected virtual link."""
    for position in positions.values():
        add_sphere(scene, position, radius, RED)


def _draw_trails(scene, paths: list[np.ndarray], radius: float):
    """Add paths of bodies' origins as thin lines."""
    for k, path in enumerate(paths):
        hexadecimal = color(k)
        rgba = [int(hexadecimal[c : c + 2], 16) / 255 for c in (1, 3, 5)] + [0.9]
        for a, b in zip(path, path[1:], strict=False):
            add_line(scene, a, b, rgba, radius=radius)


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
