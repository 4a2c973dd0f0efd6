"""Animations of a run."""

import svkc

ROD = """<mujoco><worldbody><light pos="0 0 5"/>{}
  <body name="rod"><joint axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0.3 0.2 -1" size="0.05"/>
  </body></worldbody></mujoco>"""


def test_each_camera_gives_another_image(tmp_path):
    """The model's camera and each placement of the free camera give different images."""
    from PIL import Image

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
