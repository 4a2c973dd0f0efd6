"""Shapes of a model's geoms, their projections on the x-z plane, and the box that holds them."""

from typing import NamedTuple

import numpy as np

from svkc.mjcf.bodies import rotation_matrix
from svkc.model.annotations import MuJoCo
from svkc.model.chain import Chain
from svkc.viz.meshes import cluster, load_mesh, mesh_key

# directions in the x-z plane in which an outline is computed, counter-clockwise
ANGLES = np.linspace(0, 2 * np.pi, 96, endpoint=False)
DIRECTIONS = np.stack([np.cos(ANGLES), np.sin(ANGLES)])


class Shape(NamedTuple):
    """A geom in the frame of its body (m).

    body: number of the body.
    points, half_axes: without `faces`, the shape is the convex hull of equal ellipsoids around
        the points. The ellipsoids are the images of the unit ball under `half_axes` [3 3].
    faces: with `faces` [faces 3], the shape is these triangles of points.
    """

    body: int
    points: np.ndarray
    half_axes: np.ndarray
    faces: np.ndarray | None


def visible_geoms(model: MuJoCo) -> list[int]:
    """Return the geoms that MuJoCo shows by default: groups 0 to 2, not transparent."""
    return [
        g for g in range(model.ngeom) if model.geom_group[g] <= 2 and geom_color(model, g)[3] > 0
    ]


def geom_color(model: MuJoCo, geom: int) -> np.ndarray:
    """Return red, green, blue and opacity: the material's, unless the geom has a color."""
    material, own = int(model.geom_matid[geom]), model.geom_rgba[geom]
    is_default = np.array_equal(own, np.array([0.5, 0.5, 0.5, 1], np.float32))
    return model.mat_rgba[material] if material >= 0 and is_default else own


def shapes(model: MuJoCo, cell: float) -> list[Shape]:
    """Return the shapes of the visible geoms.

    cell: edge of the cells (m) whose mesh vertices become one, as in `cluster`.
    """
    meshes, result = {}, []
    for g in visible_geoms(model):
        R, half_axes, faces = rotation_matrix(model.geom_quat[g]), np.zeros((3, 3)), None
        if (key := mesh_key(model, g)) is None:
            points, half_axes = _primitive(model, g)
        else:
            if key not in meshes:
                meshes[key] = cluster(load_mesh(model, key), cell)
            points, faces = meshes[key]
        result.append(
            Shape(
                body=int(model.geom_bodyid[g]),
                points=model.geom_pos[g] + points @ R.T,
                half_axes=R @ half_axes,
                faces=faces,
            )
        )
    return result


def geom_kind(model: MuJoCo, geom: int) -> str:
    """Return the name of the geom's type in MJCF."""
    import mujoco

    return mujoco.mjtGeom(int(model.geom_type[geom])).name.removeprefix("mjGEOM_").lower()


def _primitive(model, geom: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the points and the half axes of a primitive in its own frame, as in `Shape`."""
    kind, (a, b, c) = geom_kind(model, geom), model.geom_size[geom]
    ends = np.array([[0, 0, -b], [0, 0, b]])
    corners = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), -1).reshape(-1, 3)
    if kind == "plane":
        # a plane of size zero is infinite
        far = 1e3 * model.stat.extent
        return corners[::2] * (a or far, b or far, 0), np.zeros((3, 3))
    return {
        "sphere": lambda: (np.zeros((1, 3)), np.diag([a, a, a])),
        "ellipsoid": lambda: (np.zeros((1, 3)), np.diag([a, b, c])),
        "capsule": lambda: (ends, np.diag([a, a, a])),
        "cylinder": lambda: (ends, np.diag([a, a, 0])),
        "box": lambda: (corners * (a, b, c), np.zeros((3, 3))),
    }[kind]()


def outlines(shape: Shape, position: np.ndarray, R: np.ndarray) -> list[np.ndarray]:
    """Return polygons [corners 2] that are together the shape's projection on x and z (m).

    A point is in the projection if the polygons' winding number there is not zero.

    position, R: pose of the body's frame in the ground frame.
    """
    points = (position + shape.points @ R.T)[:, [0, 2]]
    if shape.faces is not None:
        return [points[loop] for loop in _closed_paths(_contour_edges(points, shape.faces))]
    # the outermost point of an ellipsoid M u, |u| = 1, in direction d is M M^T d / |M^T d|
    M = (R @ shape.half_axes)[[0, 2]]
    lengths = np.linalg.norm(M.T @ DIRECTIONS, axis=0)
    on_ellipse = M @ (M.T @ DIRECTIONS) / np.where(lengths > 0, lengths, 1)
    outermost = np.argmax(points @ DIRECTIONS, 0)
    return [points[outermost] + on_ellipse.T]


def _contour_edges(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return the directed edges [edges 2] that bound the sum of all faces, seen in the plane.

    All faces count as counter-clockwise. An edge between two faces on its two sides cancels, so
    that those remain at which the surface turns away from the viewer, or ends. A point's winding
    number is the number of faces there, or half of this number if all edges are double.
    """
    (ax, az), (bx, bz), (cx, cz) = (points[corner].T for corner in faces.T)
    clockwise = (bx - ax) * (cz - az) < (bz - az) * (cx - ax)
    corners = np.where(clockwise[:, None], faces[:, ::-1], faces)
    start, stop = corners.ravel(), np.roll(corners, -1, -1).ravel()
    edges, number = np.unique(
        np.minimum(start, stop) * len(points) + np.maximum(start, stop), return_inverse=True
    )
    count = np.bincount(number[start < stop], minlength=len(edges))
    count -= np.bincount(number[start > stop], minlength=len(edges))
    if not np.any(count % 2):
        count //= 2
    directed = np.stack(np.divmod(edges, len(points)), -1)
    directed[count < 0] = directed[count < 0, ::-1]
    return np.repeat(directed, np.abs(count), 0)


def _closed_paths(edges: np.ndarray) -> list[list[int]]:
    """Return closed paths of the directed edges; as many edges end at a vertex as start there."""
    following, paths = {}, []
    for start, stop in edges.tolist():
        following.setdefault(start, []).append(stop)
    while following:
        first = vertex = next(iter(following))
        paths.append([])
        while not paths[-1] or vertex != first:
            paths[-1].append(vertex)
            stops = following[vertex]
            if len(stops) == 1:
                del following[vertex]
            vertex = stops.pop()
    return paths


def bounds(shapes: list[Shape], positions: np.ndarray, R: np.ndarray) -> np.ndarray:
    """Return the lowest and the highest coordinates [2 3] of shapes over all poses (m).

    Of no shapes, these are the coordinates of the bodies' origins.

    positions, R: result of `positions_and_rotations`.
    """
    corners = [] if shapes else [positions]
    for shape in shapes:
        turn = np.swapaxes(R[:, shape.body], -1, -2)
        at = positions[:, shape.body, None] + shape.points @ turn
        reach = np.linalg.norm(np.swapaxes(shape.half_axes.T @ turn, -1, -2), axis=-1)[:, None]
        corners += [at - reach, at + reach]
    low, high = (
        find(np.stack([find(x.reshape(-1, 3), 0) for x in corners]), 0) for find in (np.min, np.max)
    )
    return np.stack([low, high])


def ground_and_bodies(chain: Chain, cell: float) -> tuple[list[Shape], list[Shape]]:
    """Return the visible shapes that are fixed to the ground, and those of moving bodies.

    cell: as in `shapes`.
    """
    model = chain.model.model
    ground, bodies = [], []
    for shape in shapes(model, cell):
        (ground if model.body_weldid[shape.body] == 0 else bodies).append(shape)
    return ground, bodies


def motion_box(
    ground: list[Shape], bodies: list[Shape], positions: np.ndarray, R: np.ndarray
) -> np.ndarray:
    """Return the lowest and the highest coordinates [2 3] of what a picture of the run shows (m).

    The ground counts up to a quarter of the bodies' largest extent beyond the bodies: a long floor
    would make the bodies small.

    positions, R: result of `positions_and_rotations`.
    """
    low, high = bounds(bodies, positions, R)
    if ground:
        margin = (high - low).max() / 4
        lowest, highest = bounds(ground, positions[:1], R[:1]).clip(low - margin, high + margin)
        low, high = np.minimum(low, lowest), np.maximum(high, highest)
    # a body that is a point at rest has no extent
    return np.stack([low, high]) if np.any(high > low) else np.stack([low - 1, high + 1])
