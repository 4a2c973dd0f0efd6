"""F7: pictures of a run: a strobe (png), an animation (gif), curves. matplotlib, Pillow and mujoco's renderer are imported where they are used."""

import pathlib

import jax
import numpy as np

from svkc.chain import Chain, State
from svkc.kinematics import poses
from svkc.reading import matrix
from svkc.trajectory import Trajectory

GL_PACKAGES = "libegl1 libgl1"
COLORS = ("#1f5fa8", "#d9822b", "#2f8f4e", "#8e3b8e", "#b03030")


def render(chain: Chain, traj: Trajectory, path, *, fps: float = 25, frames: int = 10, size=(640, 480), lookat=None, distance=None, azimuth=90) -> pathlib.Path:
    """Writes a picture of the run by the ending of `path`: .png a strobe of `frames` poses seen from the side, .gif an animation of `fps` frames a second.

    lookat (m), distance (m), azimuth (deg) place the camera of the animation. ValueError: another ending. RuntimeError: no GL library (names the packages).
    """
    path = pathlib.Path(path)
    if path.suffix == ".png":
        return _strobe(chain, traj, path, frames)
    if path.suffix == ".gif":
        return _animation(chain, traj, path, fps, size, lookat, distance, azimuth)
    raise ValueError(f"render: {path.name} should end in .png or .gif")


def _segments(chain: Chain) -> list[tuple[int, np.ndarray, np.ndarray, float]]:
    """(body, one end, other end, half thickness) of everything that can be drawn as a thick line, in the body's frame."""
    import mujoco

    model, out = chain.model.model, []
    for g in range(model.ngeom):
        kind, size = mujoco.mjtGeom(int(model.geom_type[g])), model.geom_size[g]
        R = matrix(model.geom_quat[g])
        axis = R[:, 2]
        if kind in (mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_CYLINDER):
            half, radius = axis * size[1], size[0]
        elif kind in (mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_ELLIPSOID):
            half, radius = axis * 1e-3, float(np.mean(size)) if kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID else size[0]
        elif kind == mujoco.mjtGeom.mjGEOM_BOX:
            half, radius = R[:, 0] * size[0], size[2]
        else:
            continue
        out.append((int(model.geom_bodyid[g]), model.geom_pos[g] - half, model.geom_pos[g] + half, float(radius)))
    return out


def _world_poses(chain: Chain, states: State) -> tuple[np.ndarray, np.ndarray]:
    """Positions [times bodies 3] and rotations [times bodies 3 3]."""
    positions, quats = jax.jit(jax.vmap(lambda s: poses(chain, s)))(states)
    w, x, y, z = np.moveaxis(np.asarray(quats, float), -1, 0)
    R = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    return np.asarray(positions, float), np.moveaxis(R, (0, 1), (-2, -1))


def _strobe(chain: Chain, traj: Trajectory, path: pathlib.Path, frames: int) -> pathlib.Path:
    """Poses over one another in the plane of x and z, a colour for each phase, links that hold as dots."""
    import matplotlib

    matplotlib.use("Agg", force=False)
    from matplotlib.figure import Figure

    ts = np.asarray(traj.ts)
    pick = np.unique(np.searchsorted(ts, np.linspace(ts[0], ts[-1], frames)).clip(0, len(ts) - 1))
    positions, R = _world_poses(chain, jax.tree.map(lambda x: x[pick], traj.states))
    p = traj.phases
    # phases of no length, between events of one instant, are not seen
    phases = [i for i in range(int(p.count)) if p.stop[i] > p.start[i]] or [0]
    starts = np.asarray(p.start)[phases]
    figure = Figure(figsize=(10, 7.5), layout="constrained")
    axes = figure.add_subplot(aspect="equal", xlabel="x (m)", ylabel="z (m)")
    segments = _segments(chain)
    shown = np.concatenate([positions[:, 1:].reshape(-1, 3)] + [np.array([p, q]) for b, p, q, _ in segments if b == 0])[:, [0, 2]]
    low, high = shown.min(0) - 0.3, shown.max(0) + 0.3
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    # points a metre, limbs at two thirds of their thickness, so that poses can be told apart
    scale = 72 * min(9 / (high[0] - low[0]), 6.7 / (high[1] - low[1]))
    for frame, i in enumerate(pick):
        phase = max(int(np.sum(starts <= ts[i])) - 1, 0)
        shade = 0.2 + 0.7 * (frame + 1) / len(pick)
        for body, a, b, radius in segments:
            if body == 0 and frame:
                continue
            ends = np.array([positions[frame, body] + R[frame, body] @ x for x in (a, b)])
            color = "#9a9aa2" if body == 0 else COLORS[phase % len(COLORS)]
            if np.hypot(*(ends[1] - ends[0])[[0, 2]]) * scale < 1:
                # seen end-on: a line of no length would not be drawn
                ends[1, 0] = ends[0, 0] + 1 / scale
            width = max(1.0, 1.3 * radius * scale)
            axes.plot(ends[:, 0], ends[:, 2], color=color, alpha=0.8 if body == 0 else shade, solid_capstyle="round", linewidth=width)
    for phase, i in enumerate(phases):
        held = [n for n, on in zip(chain.link_names, np.asarray(p.connected[i]), strict=True) if on]
        axes.plot([], [], color=COLORS[phase % len(COLORS)], linewidth=5, label=f"from {starts[phase]:.2f} s: {', '.join(held) or 'free'}")
    # below the picture: inside it would hide limbs
    figure.legend(loc="outside lower center", ncols=2, fontsize=9, title="held by")
    axes.grid(alpha=0.2)
    axes.set_title(f"{len(pick)} poses, {ts[pick[0]]:.2f} s to {ts[pick[-1]]:.2f} s")
    figure.savefig(path, dpi=110)
    return path


def _gl_context():
    """A class of offscreen GL context whose library is on this machine; RuntimeError naming the packages otherwise."""
    import importlib

    for module in ("mujoco.egl", "mujoco.osmesa"):
        try:
            return importlib.import_module(module).GLContext
        except (ImportError, AttributeError, RuntimeError, OSError, TypeError):
            continue
    raise RuntimeError(f"no library to draw with: install the packages {GL_PACKAGES} (apt-get install --no-install-recommends {GL_PACKAGES})")


def _animation(chain: Chain, traj: Trajectory, path: pathlib.Path, fps, size, lookat, distance, azimuth) -> pathlib.Path:
    """Frames by MuJoCo's renderer, the nearest saved state to each frame's time; links that hold as red spheres."""
    import mujoco
    from PIL import Image

    context = _gl_context()
    import mujoco.rendering.classic.gl_context as gl

    gl.GLContext = context
    model = chain.model.model
    model.vis.quality.shadowsize = model.vis.quality.offsamples = 0
    data = mujoco.MjData(model)
    ts = np.asarray(traj.ts)
    positions, R = _world_poses(chain, traj.states)
    moving = positions[:, 1:].reshape(-1, 3)
    low, high = moving.min(0), moving.max(0)
    camera = mujoco.MjvCamera()
    camera.lookat[:] = (low + high) / 2 if lookat is None else lookat
    camera.distance = 1.0 * float(np.linalg.norm(high - low)) + 1 if distance is None else distance
    camera.azimuth, camera.elevation = azimuth, -8
    rows = {row: body for body, row in enumerate(chain.topology.body_row)}
    shapes, images = [matrix(quat) for quat in model.geom_quat], []
    mujoco.mj_forward(model, data)
    with mujoco.Renderer(model, height=size[1], width=size[0]) as renderer:
        for t in np.arange(ts[0], ts[-1] + 0.5 / fps, 1 / fps):
            i = int(np.argmin(np.abs(ts - t)))
            # bodies where svkc has them: the tree may be another one where joints can be cut
            for g, body in enumerate(model.geom_bodyid):
                data.geom_xpos[g] = positions[i, body] + R[i, body] @ model.geom_pos[g]
                data.geom_xmat[g] = (R[i, body] @ shapes[g]).ravel()
            renderer.update_scene(data, camera)
            _draw_links(renderer.scene, traj, i, positions, R, rows)
            images.append(Image.fromarray(renderer.render()).quantize(64))
    images[0].save(path, save_all=True, append_images=images[1:], duration=round(1000 / fps), loop=0)
    return path


def _draw_links(scene, traj: Trajectory, i: int, positions, R, rows):
    """A red sphere where each connected virtual link is."""
    import mujoco

    s = traj.states.structure
    for link in np.flatnonzero(np.asarray(s.connected[i])):
        body = rows[int(s.real[i, link])]
        place = positions[i, body] + R[i, body] @ np.asarray(s.real_pos[i, link], float)
        if scene.ngeom < scene.maxgeom:
            sphere = scene.geoms[scene.ngeom]
            mujoco.mjv_initGeom(sphere, mujoco.mjtGeom.mjGEOM_SPHERE, np.full(3, 0.04), place, np.eye(3).ravel(), np.array([0.9, 0.1, 0.1, 1], np.float32))
            scene.ngeom += 1


def plot(traj: Trajectory, chain: Chain | None = None):
    """A matplotlib figure: coordinates, loop gaps, mobility over time, events as lines."""
    from matplotlib.figure import Figure

    ts = np.asarray(traj.ts)
    figure = Figure(figsize=(9, 8), layout="constrained")
    panels = figure.subplots(3, 1, sharex=True)
    panels[0].plot(ts, np.asarray(traj.states.q), linewidth=0.8)
    panels[0].set_ylabel("q (m, rad)")
    panels[1].semilogy(ts, np.maximum(np.asarray(traj.gaps), 1e-18), label=["rad", "m"])
    panels[1].set_ylabel("largest loop gap")
    panels[1].legend()
    count = int(traj.phases.count)
    freedoms = np.asarray(traj.phases.freedoms)[:count]
    edges = np.append(np.asarray(traj.phases.start)[:count], np.asarray(traj.phases.stop)[count - 1])
    panels[2].stairs(freedoms, edges, baseline=None)
    panels[2].set(ylabel="mobility", xlabel="t (s)")
    for t in np.asarray(traj.events.time)[np.isfinite(traj.events.time)]:
        for panel in panels:
            panel.axvline(t, color="0.6", linewidth=0.8, linestyle="--")
    if chain is not None and chain.nq <= 8:
        panels[0].legend(chain.joint_names, fontsize=7)
    return figure
