"""Outlines of shapes against closed forms, decimation of meshes, and the strobe."""

import mujoco
import numpy as np
import pytest
from pages import sphere

from svkc.viz.meshes import Mesh, cluster, decimate
from svkc.viz.outlines import Shape, bounds, outlines, shapes
from svkc.viz.strobe import strobe

# a generic rotation, and the viewer's direction
TURN = "quat='.8 .3 .2 -.4'"
Y = np.array([0.0, 1.0, 0.0])
L_MESH = """<mesh name="L" vertex="0 0 0 .4 0 0 .4 0 .1 .1 0 .1 .1 0 .4 0 0 .4
  0 .1 0 .4 .1 0 .4 .1 .1 .1 .1 .1 .1 .1 .4 0 .1 .4" face="0 1 2 0 2 3 0 3 4 0 4 5 6 8 7 6 9 8 6 10
  9 6 11 10 0 7 1 0 6 7 1 8 2 1 7 8 2 9 3 2 8 9 3 10 4 3 9 10 4 11 5 4 10 11 5 6 0 5 11 6"/>"""


def polygons_of(geom: str, assets: str = "") -> list[np.ndarray]:
    """Return the outline of one geom of the world."""
    model = mujoco.MjModel.from_xml_string(
        f"<mujoco><asset>{assets}</asset><worldbody><geom {geom}/></worldbody></mujoco>"
    )
    (shape,) = shapes(model, 1e-3)
    return outlines(shape, np.zeros(3), np.eye(3))


def rotation(quat) -> np.ndarray:
    """Return MuJoCo's rotation matrix of a quaternion."""
    R = np.zeros(9)
    mujoco.mju_quat2Mat(R, np.array(quat) / np.linalg.norm(quat))
    return R.reshape(3, 3)


def winding(polygons: list[np.ndarray], points: np.ndarray) -> np.ndarray:
    """Return the polygons' winding number at each point, by crossings of a ray along x."""
    total = np.zeros(len(points), int)
    for polygon in polygons:
        for (ax, az), (bx, bz) in zip(polygon, np.roll(polygon, -1, 0), strict=True):
            x, z = points.T
            left = (bx - ax) * (z - az) > (x - ax) * (bz - az)
            total += ((az <= z) & (z < bz) & left).astype(int)
            total -= ((bz <= z) & (z < az) & ~left).astype(int)
    return total


def area(polygons: list[np.ndarray]) -> float:
    """Return the area in which the winding number is not zero, by a grid of points."""
    every = np.concatenate(polygons)
    low, high = every.min(0), every.max(0)
    step = (high - low) / 400
    grid = np.stack(np.meshgrid(*(low[:, None] + step[:, None] * (np.arange(400) + 0.5))), -1)
    return float(np.count_nonzero(winding(polygons, grid.reshape(-1, 2))) * np.prod(step))


R = rotation([0.8, 0.3, 0.2, -0.4])
ACROSS = np.linalg.norm(np.cross(R[:, 2], Y))
AREAS = {
    "sphere": ("type='sphere' size='.2'", np.pi * 0.2**2),
    "disc, edge on": ("type='cylinder' size='.3 .02'", 0.6 * 0.04),
    "disc, face on": ("type='cylinder' size='.3 .02' euler='90 0 0'", np.pi * 0.3**2),
    "cylinder": (
        f"type='cylinder' size='.1 .3' {TURN}",
        2 * 0.1 * 0.6 * ACROSS + np.pi * 0.1**2 * abs(R[1, 2]),
    ),
    "capsule": (
        f"type='capsule' size='.1 .3' {TURN}",
        2 * 0.1 * 0.6 * ACROSS + np.pi * 0.1**2,
    ),
    "ellipsoid": (
        f"type='ellipsoid' size='.1 .2 .3' {TURN}",
        np.pi * np.sqrt(np.sum((R[1] * [0.2 * 0.3, 0.1 * 0.3, 0.1 * 0.2]) ** 2)),
    ),
    "box": (
        f"type='box' size='.1 .2 .3' {TURN}",
        4 * np.sum(abs(R[1]) * [0.2 * 0.3, 0.1 * 0.3, 0.1 * 0.2]),
    ),
    "plane": ("type='plane' size='1 2 1' euler='90 0 0'", 2 * 4),
    "L": ("type='mesh' mesh='L'", 0.4 * 0.1 + 0.3 * 0.1),
    # the highest profile is 0, 0.5, 0.5, above a base of 0.1
    "height field": ("type='hfield' hfield='hill'", 2 * 0.1 + 0.25 + 0.5),
}
ASSETS = L_MESH + (
    '<hfield name="hill" nrow="2" ncol="3" size="1 2 .5 .1" elevation="0 0 1 0 1 1"/>'
)


@pytest.mark.parametrize("name", AREAS)
def test_areas_of_outlines(name):
    """An outline has the area of the projection; curves are polygons of 96 corners."""
    geom, expected = AREAS[name]
    assert area(polygons_of(geom, ASSETS)) == pytest.approx(expected, rel=5e-3)


def test_extents_of_outlines():
    """A turned ellipsoid reaches as far as its half axes do; a disc is as thin as it is."""
    (ellipse,) = polygons_of(f"type='ellipsoid' size='.1 .2 .3' {TURN}")
    reach = np.linalg.norm(R * [0.1, 0.2, 0.3], axis=1)[[0, 2]]
    np.testing.assert_allclose(ellipse.max(0), reach, rtol=1e-12)
    np.testing.assert_allclose(ellipse.min(0), -reach, rtol=1e-12)
    (disc,) = polygons_of("type='cylinder' size='.3 .02'")
    np.testing.assert_allclose(np.ptp(disc, axis=0), [0.6, 0.04])


def test_a_mesh_has_the_outline_of_its_solid():
    """A sphere's mesh has one outline, whichever way its faces turn; a ring keeps its hole."""
    vertices, faces = sphere(2000)
    ball = Shape(body=0, points=vertices, half_axes=np.zeros((3, 3)), faces=faces)
    inside_out = ball._replace(faces=faces[:, ::-1])
    for solid in (ball, inside_out):
        (outline,) = outlines(solid, np.zeros(3), R)
        assert abs(area([outline]) - np.pi) < 0.02
    # every second face of a ring is turned
    angles = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    around, across = np.meshgrid(angles, angles, indexing="ij")
    radius = 1 + 0.3 * np.cos(across)
    points = np.stack([radius * np.cos(around), 0.3 * np.sin(across), radius * np.sin(around)], -1)
    vertex = np.arange(1600).reshape(40, 40)
    a, b, c, d = (
        np.roll(vertex, (-i, -j), (0, 1)).ravel() for i, j in ((0, 0), (1, 0), (1, 1), (0, 1))
    )
    faces = np.concatenate([np.stack([a, b, c], -1), np.stack([c, a, d], -1)])
    faces[::2] = faces[::2, ::-1]
    ring = ball._replace(points=points.reshape(-1, 3), faces=faces)
    polygons = outlines(ring, np.zeros(3), np.eye(3))
    assert winding(polygons, np.array([[0.0, 0.0], [1.0, 0.1]])).astype(bool).tolist() == [0, 1]
    assert area(polygons) == pytest.approx(np.pi * (1.3**2 - 0.7**2), rel=0.02)


@pytest.mark.parametrize("limit", [100, 1000, 20_000])
def test_decimation(limit):
    """The faces are within the limit, the bounding box stays, and the surface moves little."""
    vertices, faces = sphere(40_000)
    mesh = decimate(Mesh(vertices * (1, 2, 3), faces), limit)
    assert limit / 4 < len(mesh.faces) <= limit
    for extreme in (np.min, np.max):
        np.testing.assert_array_equal(
            extreme(mesh.vertices[np.unique(mesh.faces)], 0), extreme(vertices * (1, 2, 3), 0)
        )
    # a cell's edge is about this fraction of the longest side
    distance = abs(np.linalg.norm(mesh.vertices / (1, 2, 3), axis=1) - 1)
    assert distance.max() < 6 / np.sqrt(limit)
    assert decimate(mesh, limit) is mesh


def test_clustering_keeps_thin_plates_and_small_meshes():
    """A plate keeps its thickness, and a mesh finer than the cells keeps its faces."""
    corners = np.stack(np.meshgrid([0, 1.0], [0, 1.0], [0, 1e-3]), -1).reshape(-1, 3)
    faces = np.array([[0, 1, 2], [3, 1, 2], [4, 5, 6], [5, 6, 7], [0, 4, 1], [1, 5, 4]])
    for cell in (1e-4, 0.1, 10.0):
        plate = cluster(Mesh(corners, faces), cell)
        np.testing.assert_array_equal(np.ptp(plate.vertices, axis=0), [1, 1, 1e-3])
        assert len(plate.faces) == len(faces)


def test_bounds_of_shapes_over_poses():
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body><joint/><geom type='capsule' size='.1 .3'/></body></worldbody>"
        "</mujoco>"
    )
    positions, quarter_turn = np.zeros((2, 2, 3)), rotation([1, 0, 1, 0])
    positions[1, 1] = 0, 0, 2
    low, high = bounds(
        shapes(model, 1.0), positions, np.stack([[np.eye(3)] * 2, [quarter_turn] * 2])
    )
    np.testing.assert_allclose([low, high], [[-0.4, -0.1, -0.4], [0.4, 0.1, 2.1]], atol=1e-12)


@pytest.mark.slow
def test_the_strobe_of_a_stopped_run_ends_at_its_stop(stopped):
    """Title and last pose are those of the end; the structure after the last event is named."""
    chain, traj = stopped
    figure = strobe(chain, traj, 10)
    (axes,) = figure.axes
    assert axes.get_title() == "5 poses, 0 s to 0.035 s"
    legend = [text.get_text() for text in axes.get_legend().get_texts()]
    assert legend == ["pin from 0, 0.035 s", "nothing from 0.023 s"]
    assert strobe(chain, traj, 2).axes[0].get_title() == "2 poses, 0 s to 0.035 s"
