"""The quality of the cells behind the facets of a boundary."""

import numpy as np
from numpy.typing import NDArray

from pipeline.data.mesh import TetMesh
from tiler.mesh_files.vtk_files import BoundaryPiece


def measure_facets(mesh: TetMesh, piece: BoundaryPiece) -> NDArray[np.float32]:
    """Give the radius ratio of the cell behind each facet of a piece.

    Parameters
    ----------
    mesh : TetMesh
        Cells of the piece.
    piece : BoundaryPiece
        Its boundary.

    Returns
    -------
    float32, (k,)
        Radius ratio, 0 to 1; of facets with cells on both sides, as the ground over soil, the worse one. NaN where
        no cell has the facet.

    Notes
    -----
    Only cells with three corners on the boundary are measured.
    """
    from pipeline.quality.quality import measure_cells  # with numba

    n = len(piece.points)
    row = np.full(len(mesh.points), -1, np.int64)
    row[piece.vertex] = np.arange(n)
    marked = row >= 0
    cells = mesh.cells[sum(marked[mesh.cells[:, k]].astype(np.int8) for k in range(4)) >= 3]
    ratio = measure_cells(TetMesh(mesh.points, cells)).radius_ratio
    sides = np.concatenate([row[np.delete(cells, corner, axis=1)] for corner in range(4)])
    behind = np.flatnonzero((sides >= 0).all(axis=1))
    facets = piece.boundary.facets.astype(np.int64)
    name = name_facets(np.concatenate([facets, sides[behind]]), n)
    worst = np.full(int(name.max(initial=-1)) + 1, np.inf, np.float32)
    np.minimum.at(worst, name[len(facets) :], np.tile(ratio, 4)[behind])
    found: NDArray[np.float32] = worst[name[: len(facets)]]
    found[np.isinf(found)] = np.nan
    return found


def name_facets(facets: NDArray[np.int64], n: int) -> NDArray[np.int64]:
    """Number triangles by their corners, whatever their order: equal ones have equal numbers.

    Parameters
    ----------
    facets : int64, (k, 3)
        Corners, 0 to n - 1.
    n : int
        Number of points, less than 2**31.

    Examples
    --------
    >>> name_facets(np.array([[0, 1, 2], [3, 1, 2], [2, 0, 1]]), 4).tolist()
    [0, 1, 0]
    """
    corners = np.sort(facets, axis=1)
    _, edge = np.unique(corners[:, 0] * n + corners[:, 1], return_inverse=True)
    _, name = np.unique(edge.reshape(-1) * n + corners[:, 2], return_inverse=True)
    found: NDArray[np.int64] = name.reshape(-1).astype(np.int64)
    return found
