"""Animations of a run."""

import mujoco
import numpy as np
from PIL import Image

import svkc
from svkc.viz.animation import choose_camera, frames, write_gif
from svkc.viz.offscreen import BACKGROUND

ROD = """<mujoco><worldbody><light pos="0 0 5"/>{}
  <body name="rod"><joint name="rod" axis="0 1 0"/>
  <geom type="capsule" fromto="0 0 0 0.3 0.2 -1" size="0.05"/></body></worldbody></mujoco>"""


def test_each_camera_gives_another_image(tmp_path):
    """The model's camera and each placement of the free camera give different images."""
    camera = '<camera name="above" pos="0 -1 4" xyaxes="1 0 0 0 1 0"/>'
    chain = svkc.load(ROD.format(camera))
    traj, images = svkc.simulate(chain, chain.state(), 0.1, ts=[0.0, 0.05, 0.1]), set()
    views = (
        {"camera": "above"},
        {"lookat": (0, 0, -0.5)},
        {"lookat": (0, 0, -0.5), "distance": 6.0},
        {"azimuth": 20.0, "elevation": -60.0},
    )
    for i, view in enumerate(views):
        try:
            path = svkc.render(
                chain, traj, tmp_path / f"{i}.gif", size=(96, 64), trails=("rod",), **view
            )
        except RuntimeError:
            # no offscreen OpenGL: test_messages checks the message
            return
        with Image.open(path) as image:
            assert image.width == 96
            assert len(image.convert("RGB").getcolors(1 << 16)) > 10
            images.add(image.convert("RGB").tobytes())
    assert len(images) == len(views)


def test_frames_end_with_the_run_and_have_no_steps(tmp_path):
    """The animation of a run that stopped ends there; the background is plain, edges are smooth."""
    chain = svkc.load(ROD.format(""))
    traj = svkc.simulate(
        chain,
        chain.state({"rod": 0.3}),
        0.4,
        ts=[0.0, 0.1, 0.2, 0.4],
        events=[svkc.at(0.2, stop=True)],
    )
    view = {"camera": None, "lookat": None, "distance": None, "azimuth": 120, "elevation": -15}
    try:
        images = list(frames(chain, traj, fps=20.0, size=(96, 64), trails=(), **view))
    except RuntimeError:
        # no offscreen OpenGL: test_messages checks the message
        return
    assert len(images) == 5
    first, last = (np.asarray(image, int)[:64] for image in (images[0], images[-1]))
    assert np.mean(np.all(first == BACKGROUND, -1)) > 0.4
    assert np.any(first != last)
    write_gif(tmp_path / "rod.gif", iter(images), 20.0)
    with Image.open(tmp_path / "rod.gif") as gif:
        shown = np.asarray(gif.convert("RGB"), int)[:64]
    # a rod's color differs from the plain background: its edge has colors in between
    assert abs(shown - first).max() < 24
    row = first[32, :, 0]
    assert 3 < len(np.unique(row)) < 60


def test_the_camera_sees_every_corner_of_the_box():
    """All corners of the box are in the image, and one is near its edge."""
    model = mujoco.MjModel.from_xml_string("<mujoco/>")
    box, slope = np.array([[-1.0, -0.2, 0.0], [2.0, 0.3, 1.5]]), np.tan(np.pi / 8)
    corners = np.stack(np.meshgrid(*box.T), -1).reshape(-1, 3)
    for aspect in (0.5, 2.0):
        view = {"camera": None, "lookat": None, "distance": None, "azimuth": 120, "elevation": -15}
        camera = choose_camera(model, box, aspect, **view)
        a, e = np.deg2rad([120, -15])
        forward = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
        right = np.array([np.sin(a), -np.cos(a), 0])
        offset = corners - (camera.lookat - camera.distance * forward)
        depth, x, z = (offset @ axis for axis in (forward, right, np.cross(right, forward)))
        extent = np.maximum(abs(x / depth) / aspect, abs(z / depth)) / slope
        assert 0.9 < extent.max() < 1
        assert depth.min() > 0
