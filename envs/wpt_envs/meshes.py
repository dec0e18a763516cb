"""Thins triangle meshes for drawing: one vertex per cell of a grid, placed to keep edges sharp."""

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import mujoco

_FLAT = 0.05  # directions with less than this share of the largest eigenvalue count as flat


def thin_meshes(model: "mujoco.MjModel", cell: float, most: int) -> None:
    """Thin every mesh in place: shorten its list of faces, and move some of its vertices.

    :param cell: side of a cell in metres; the vertices in it are merged
    :param most: the most faces of a mesh; where more are left, its cells grow
    """
    for mesh in range(model.nmesh):
        first, vertices = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
        start, count = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
        vertex = model.mesh_vert[first : first + vertices]
        faces = model.mesh_face[start : start + count].copy()
        group, kept = _coarsen(vertex.astype(np.float64), faces, cell, most)
        places = _places(vertex.astype(np.float64), faces, group, cell)
        chosen = np.unique(group, return_index=True)[1]  # a vertex for each cell
        vertex[chosen] = places
        target = slice(start, start + len(kept))
        model.mesh_face[target] = chosen[group[faces[kept]]]
        for array in (model.mesh_facenormal, model.mesh_facetexcoord):
            array[target] = array[start : start + count][kept]
        model.mesh_facenum[mesh] = len(kept)


def _coarsen(
    vertex: np.ndarray, faces: np.ndarray, cell: float, most: int
) -> tuple[np.ndarray, np.ndarray]:
    """Find cells just large enough to leave at most `most` faces.

    :param vertex: (V, 3)
    :param faces: (F, 3)
    :return: (V,), the cell of each vertex, and (K,), the faces that stay
    """
    while True:
        keys = np.floor(vertex / cell).astype(np.int64)
        group = np.unique(keys @ [1, 1 << 20, 1 << 40], return_inverse=True)[1].reshape(-1)
        kept = _proper(group[faces])
        if len(kept) <= most:
            return group, kept
        cell *= 1.25


def _proper(corners: np.ndarray) -> np.ndarray:
    """Find the faces that still have three corners, each once; both sides of a thin sheet stay.

    :param corners: (F, 3), the cells of each face's corners
    :return: (K,), their indices
    """
    a, b, c = corners.T
    kept = np.flatnonzero((a != b) & (b != c) & (c != a))
    start = corners[kept].argmin(axis=1)[:, None]
    turned = np.take_along_axis(corners[kept], (start + np.arange(3)) % 3, axis=1)
    return kept[np.sort(np.unique(turned, axis=0, return_index=True)[1])]


def _places(vertex: np.ndarray, faces: np.ndarray, group: np.ndarray, cell: float) -> np.ndarray:
    """Find for each cell the point nearest to the planes of its faces.

    It minimises the sum of squared distances to the planes (a quadric error). It starts from the
    vertices' mean and moves only in directions that the planes determine.

    :param vertex: (V, 3)
    :param faces: (F, 3)
    :param group: (V,), the cell of each vertex
    :param cell: the farthest that a point moves along an axis
    :return: (C, 3)
    """
    members = np.bincount(group)[:, None]
    cells = len(members)
    mean = _sum_by(group, vertex, cells) / members
    a, b, c = (vertex[faces[:, corner]] for corner in range(3))
    normal = np.cross(b - a, c - a)
    normal /= np.sqrt(np.linalg.norm(normal, axis=1) + 1e-12)[:, None]  # weighs by area
    outer = (normal[:, :, None] * normal[:, None, :]).reshape(-1, 9)
    matrix, pull = np.zeros((cells, 9)), np.zeros((cells, 3))
    for corner in range(3):
        owner = group[faces[:, corner]]
        distance = np.einsum("fi,fi->f", normal, a - mean[owner])
        matrix += _sum_by(owner, outer, cells)
        pull += _sum_by(owner, normal * distance[:, None], cells)
    inverse = np.linalg.pinv(matrix.reshape(-1, 3, 3), rcond=_FLAT, hermitian=True)
    move = np.einsum("cij,cj->ci", inverse, pull)
    return mean + np.clip(move, -cell, cell)


def _sum_by(owner: np.ndarray, values: np.ndarray, owners: int) -> np.ndarray:
    """Add up values (N, D) by owner: (owners, D)."""
    columns = [np.bincount(owner, column, owners) for column in values.T]
    return np.stack(columns, axis=1)
