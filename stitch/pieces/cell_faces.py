"""The faces between the cells of one piece: which two cells have each, and which faces look outwards.

What a finite-volume format wants: faces inside in the order of the cells that have them, faces of the region's
boundary, and faces that another piece must have.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.data.kernel import kernel
from stitch.pieces.conformity import group_rows
from stitch.pieces.face_mates import CROWDED, FACES, NO_MATE, find_mates, take_faces


@dataclass(frozen=True, eq=False)
class CellFaces:
    """The faces of a piece of ``m`` cells: ``i`` inside, ``f`` on the boundary, ``s`` shared with other pieces."""

    #: (i,): the two cells of each face inside, ``owner < neighbour``, sorted by owner, then by neighbour
    owner: NDArray[np.int32]
    neighbour: NDArray[np.int32]
    #: (i, 3): their vertices, counter-clockwise seen from the neighbour: the normal points out of the owner
    inner: NDArray[np.int32]
    facet_cell: NDArray[np.int32]  #: (f,): cell of each boundary facet, in the order in which facets were given
    shared_cell: NDArray[np.int32]  #: (s,): cell of each face that is neither, ascending
    shared: NDArray[np.int32]  #: (s, 3): their vertices, counter-clockwise seen from outside the piece


def find_cell_faces(cells: NDArray[np.int32], facets: NDArray[np.int32], n_points: int) -> CellFaces:
    """Find which cells have which faces.

    Parameters
    ----------
    cells : int32, (m, 4)
        Tetrahedra of positive volume, indices below `n_points`.
    facets : int32, (f, 3)
        Facets of the boundary, each an exterior face of one cell.
    n_points : int
        Number of points.

    Raises
    ------
    ValueError
        If more than two cells have a face, a facet is no exterior face or is there twice, or there are too many
        cells, see `find_mates`.

    Notes
    -----
    Linear in the cells; some 60 bytes a cell, of which 40 are the result.

    Examples
    --------
    Two cells on the face 1, 2, 3, five faces of theirs on the boundary:

    >>> cells = np.array([[0, 1, 2, 3], [1, 2, 3, 4]], np.int32)
    >>> facets = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 4], [1, 4, 3]], np.int32)
    >>> faces = find_cell_faces(cells, facets, 5)
    >>> faces.inner.tolist(), faces.facet_cell.tolist(), faces.shared.tolist()
    ([[1, 2, 3]], [0, 0, 0, 1, 1], [[2, 3, 4]])
    """
    cells = np.ascontiguousarray(cells)
    mate = find_mates(cells, n_points)
    crowded = np.flatnonzero(mate == CROWDED)
    if len(crowded):
        raise ValueError(f"more than two cells have the face {take_faces(cells, crowded[:1])[0].tolist()}")
    outer = np.flatnonzero(mate == NO_MATE)
    facet = _find_facets(take_faces(cells, outer), facets)
    is_shared = np.ones(len(outer), np.bool_)
    is_shared[facet] = False
    owner, neighbour, inner = _take_inner(cells, mate, (len(mate) - len(outer)) // 2)
    return CellFaces(
        owner,
        neighbour,
        inner,
        (outer[facet] // 4).astype(np.int32),
        (outer[is_shared] // 4).astype(np.int32),
        take_faces(cells, outer[is_shared]),
    )


def _find_facets(outer: NDArray[np.int32], facets: NDArray[np.int32]) -> NDArray[np.int64]:
    """Find each facet among the exterior faces."""
    group, n_groups = group_rows(np.sort(np.concatenate([outer, facets]), axis=1))
    row = np.full(n_groups, -1)
    row[group[: len(outer)]] = np.arange(len(outer))
    found: NDArray[np.int64] = row[group[len(outer) :]]
    if (found < 0).any():
        raise ValueError(f"the facet {facets[found < 0][0].tolist()} is no exterior face of a cell")
    if np.bincount(found).max(initial=0) > 1:
        raise ValueError("a facet is there twice")
    return found


@kernel
def _take_inner(cells, mate, n):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Give both cells and the vertices of the `n` faces with two cells, sorted by the lower, then the other."""
    owner, neighbour, inner = np.empty(n, np.int32), np.empty(n, np.int32), np.empty((n, 3), np.int32)
    end = 0
    for cell in range(len(cells)):
        first = end
        for k in range(4):
            other = mate[4 * cell + k]
            if other <= 4 * cell + k:
                continue
            row, beyond = end, other // 4
            while row > first and neighbour[row - 1] > beyond:
                neighbour[row] = neighbour[row - 1]
                for j in range(3):
                    inner[row, j] = inner[row - 1, j]
                row -= 1
            neighbour[row] = beyond
            for j in range(3):
                inner[row, j] = cells[cell, FACES[k, j]]
            owner[end] = cell
            end += 1
    return owner, neighbour, inner
