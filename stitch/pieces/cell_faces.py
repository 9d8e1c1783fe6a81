"""The faces between the cells of one piece: which two cells have each, and which faces look outwards.

What a finite-volume format wants: faces inside in the order of the cells that have them, faces of the region's
boundary, and faces that another piece must have.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.data.kernel import kernel
from stitch.pieces.conformity import FACES, group_rows

NO_MATE, CROWDED = -1, -2
MOST_CELLS = 2**29 - 1  # four faces each have numbers of 32 bits


@dataclass(frozen=True, eq=False)
class CellFaces:
    """The faces of a piece of ``m`` cells: ``i`` inside, ``f`` on the boundary, ``s`` shared with other pieces.

    Attributes
    ----------
    owner, neighbour : int32, (i,)
        The two cells of each face inside, ``owner < neighbour``, sorted by owner, then by neighbour.
    inner : int32, (i, 3)
        Their vertices, counter-clockwise seen from the neighbour: the normal points out of the owner.
    facet_cell : int32, (f,)
        Cell of each boundary facet, in the order in which facets were given.
    shared_cell : int32, (s,)
        Cell of each face that is neither, ascending.
    shared : int32, (s, 3)
        Their vertices, counter-clockwise seen from outside the piece.
    """

    owner: NDArray[np.int32]
    neighbour: NDArray[np.int32]
    inner: NDArray[np.int32]
    facet_cell: NDArray[np.int32]
    shared_cell: NDArray[np.int32]
    shared: NDArray[np.int32]


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
        If more than two cells have a face, a facet is no exterior face or is there twice, or there are more than
        `MOST_CELLS` cells.

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
    if len(cells) > MOST_CELLS:
        raise ValueError(f"{len(cells)} cells in one piece, at most {MOST_CELLS} can be paired")
    cells = np.ascontiguousarray(cells)
    mate = _pair(cells, n_points)
    crowded = np.flatnonzero(mate == CROWDED)
    if len(crowded):
        raise ValueError(f"more than two cells have the face {_corners(cells, crowded[:1])[0].tolist()}")
    outer = np.flatnonzero(mate == NO_MATE)
    facet = _find_facets(_corners(cells, outer), facets)
    is_shared = np.ones(len(outer), np.bool_)
    is_shared[facet] = False
    owner, neighbour, inner = _take_inner(cells, mate, (len(mate) - len(outer)) // 2)
    return CellFaces(
        owner,
        neighbour,
        inner,
        (outer[facet] // 4).astype(np.int32),
        (outer[is_shared] // 4).astype(np.int32),
        _corners(cells, outer[is_shared]),
    )


def _corners(cells: NDArray[np.int32], face: NDArray[np.int64]) -> NDArray[np.int32]:
    corners: NDArray[np.int32] = cells[(face // 4)[:, None], FACES[face % 4]]
    return corners


def _find_facets(outer: NDArray[np.int32], facets: NDArray[np.int32]) -> NDArray[np.int64]:
    """Find each facet among the exterior faces."""
    group, n_groups = group_rows(np.sort(np.concatenate([outer, facets]), axis=1))
    row = np.full(n_groups, -1)
    row[group[: len(outer)]] = np.arange(len(outer))
    found: NDArray[np.int64] = row[group[len(outer) :]]
    if (found < 0).any():
        raise ValueError(f"the facet {facets[found < 0][0].tolist()} is no exterior face of a cell")
    if len(np.unique(found)) < len(found):
        raise ValueError("a facet is there twice")
    return found


@kernel
def _sorted_face(cells, face):  # type: ignore[no-untyped-def]  # pragma: no cover
    i, k = face // 4, face % 4
    a, b, c = cells[i, FACES[k, 0]], cells[i, FACES[k, 1]], cells[i, FACES[k, 2]]
    low, high = min(a, b, c), max(a, b, c)
    return low, np.int64(a) + np.int64(b) + np.int64(c) - low - high, high


@kernel
def _pair(cells, n_points):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Find for each of the 4 m faces the other that has the same vertices, `NO_MATE` or `CROWDED`."""
    n_faces = 4 * len(cells)
    mate = np.full(n_faces, NO_MATE, np.int32)
    # Faces by their smallest vertex, as linked lists: few faces have the same one.
    last = np.full(n_points, -1, np.int32)
    before = np.empty(n_faces, np.int32)
    for face in range(n_faces):
        low, middle, high = _sorted_face(cells, face)
        other = last[low]
        while other >= 0:
            _, m, h = _sorted_face(cells, other)
            if m == middle and h == high:
                break
            other = before[other]
        if other < 0:
            before[face] = last[low]
            last[low] = face
        elif mate[other] == NO_MATE:
            mate[face], mate[other] = other, face
        else:
            mate[face] = CROWDED
    return mate


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
