"""Triangle meshes of a model's mesh and height-field geoms, and their decimation."""

from typing import NamedTuple

import numpy as np

from svkc.model.annotations import MuJoCo

# two cells per axis leave eight vertices, hence at most 56 faces
MIN_FACES = 100


class Mesh(NamedTuple):
    """A triangle mesh.

    vertices: [vertices 3], in the geom's frame (m).
    faces: [faces 3], numbers of vertices.
    """

    vertices: np.ndarray
    faces: np.ndarray


def mesh_key(model: MuJoCo, geom: int) -> tuple[bool, int] | None:
    """Return whether the geom is a height field, and the number of its mesh or field.

    None for a primitive.
    """
    import mujoco

    i = int(model.geom_dataid[geom])
    return None if i < 0 else (model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_HFIELD, i)


def load_mesh(model: MuJoCo, key: tuple[bool, int]) -> Mesh:
    """Return the mesh or the height field of a result of `mesh_key`."""
    is_field, i = key
    return _heightfield(model, i) if is_field else _mesh(model, i)


def _mesh(model, i: int) -> Mesh:
    """Return mesh i of the model."""
    vertices, faces = (
        rows[int(first[i]) : int(first[i]) + int(number[i])]
        for rows, first, number in (
            (model.mesh_vert, model.mesh_vertadr, model.mesh_vertnum),
            (model.mesh_face, model.mesh_faceadr, model.mesh_facenum),
        )
    )
    return Mesh(np.asarray(vertices, float), np.asarray(faces, int))


def _heightfield(model, i: int) -> Mesh:
    """Return height field i of the model, closed by its walls and its base."""
    rows, columns, first = (
        int(x[i]) for x in (model.hfield_nrow, model.hfield_ncol, model.hfield_adr)
    )
    half_width, half_depth, height, base = model.hfield_size[i]
    x, y = np.meshgrid(
        np.linspace(-half_width, half_width, columns), np.linspace(-half_depth, half_depth, rows)
    )
    vertex = np.arange(rows * columns).reshape(rows, columns)
    top = _rectangles(vertex[:-1, :-1], vertex[:-1, 1:], vertex[1:, 1:], vertex[1:, :-1])
    # the border, counter-clockwise from above, and below each of its vertices one of the base
    border = np.concatenate([vertex[0, :-1], vertex[:-1, -1], vertex[-1, :0:-1], vertex[:0:-1, 0]])
    below = rows * columns + np.arange(len(border))
    walls = _rectangles(below, np.roll(below, -1), np.roll(border, -1), border)
    bottom = np.stack([np.full(len(border) - 2, below[0]), below[2:], below[1:-1]], -1)
    z = height * model.hfield_data[first : first + rows * columns]
    surface = np.stack([x.ravel(), y.ravel(), z], -1)
    foot = np.concatenate([surface[border, :2], np.full((len(border), 1), -base)], -1)
    return Mesh(np.concatenate([surface, foot]), np.concatenate([top, walls, bottom]))


def _rectangles(a, b, c, d) -> np.ndarray:
    """Return two faces for each rectangle with corners a, b, c, d."""
    a, b, c, d = (corner.ravel() for corner in (a, b, c, d))
    return np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)])


def cluster(mesh: Mesh, cell: float) -> Mesh:
    """Return a mesh in which the vertices of each cell of a grid are one.

    This is vertex clustering (Rossignac and Borrel, 1993). Faces with two corners in a cell vanish.
    The new vertex is the mean of the cell's vertices, but cells at the sides of the bounding box
    keep their outermost coordinate, so that the bounding box stays. There are two to 2^20 cells
    along each axis.

    cell: largest edge of a cell (m).
    """
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    layers = np.ceil((high - low) / cell).clip(2, 2**20)
    width = np.where(high > low, (high - low) / layers, 1)
    place = np.floor((mesh.vertices - low) / width).clip(0, layers - 1).astype(int)
    _, first, number, count = np.unique(
        np.ravel_multi_index(tuple(place.T), tuple(layers.astype(int))),
        return_index=True,
        return_inverse=True,
        return_counts=True,
    )
    vertices = np.stack([np.bincount(number, axis) for axis in mesh.vertices.T], -1)
    vertices /= count[:, None]
    for layer, outermost in ((np.zeros(3), np.minimum), (layers - 1, np.maximum)):
        extremes = mesh.vertices[first]
        outermost.at(extremes, number, mesh.vertices)
        vertex, axis = np.nonzero(place == layer)
        vertices[number[vertex], axis] = extremes[number[vertex], axis]
    faces = number[mesh.faces]
    faces = faces[np.all(faces != np.roll(faces, 1, -1), -1)]
    _, kept = np.unique(np.sort(faces, -1), axis=0, return_index=True)
    return Mesh(vertices, faces[np.sort(kept)])


def decimate(mesh: Mesh, max_faces: int) -> Mesh:
    """Return the mesh, or if it has more than `max_faces` faces, a clustering that does not.

    The clustering has as many cells along the longest side as bisection finds.

    max_faces: at least `MIN_FACES`.
    """
    if len(mesh.faces) <= max_faces:
        return mesh
    longest = float(np.ptp(mesh.vertices, axis=0).max())
    # the number of cells along the longest side, by bisection
    low, high, best = 2, 2048, cluster(mesh, longest / 2)
    while high - low > 1:
        middle = (low + high) // 2
        candidate = cluster(mesh, longest / middle)
        if len(candidate.faces) <= max_faces:
            low, best = middle, candidate
        else:
            high = middle
    return best
