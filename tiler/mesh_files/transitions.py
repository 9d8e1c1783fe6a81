"""Where prisms end in a hybrid mesh: sides beside two triangles, and the cells that such prisms are cut into.

The side of a prism stays a quadrilateral where another prism has the same one, and on the boundary where its two
halves have one marker. The others are cut along the diagonal that the tetrahedra have there, so that they meet
the triangles beyond. A prism with such sides becomes pyramids on the sides that it keeps, and tetrahedra: of two
cells where two diagonals meet in a corner, else around its middle.
"""

from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from stitch.pieces.conformity import group_rows

Ints = NDArray[np.int64]
Rows = NDArray[np.integer[Any]]
Number = TypeVar("Number", bound=np.generic)
NO_CORNER = -1  # in the places of cells and faces with fewer corners
# Sides of a prism by its corners, counter-clockwise seen from outside, and their halves: of the three columns the
# first rises first, then the second or, turned, the third.
SIDES = np.array([[0, 1, 4, 3], [1, 2, 5, 4], [2, 0, 3, 5]])
HALVES = np.array(
    [
        [[[0, 1, 3], [1, 4, 3]], middle, [[2, 0, 3], [2, 3, 5]]]
        for middle in ([[1, 2, 4], [2, 5, 4]], [[1, 2, 5], [1, 5, 4]])
    ]
)
ENDS = ((0, 2, 1), (3, 4, 5))
MIDDLE, NONE = 6, 7  # places behind the six corners: the prism's middle, and none


def find_cut_sides(cells: Rows, turned: NDArray[np.bool_], facets: Rows, label: Ints) -> NDArray[np.bool_]:
    """Find the sides of prisms that must be cut.

    Parameters
    ----------
    cells : int64, (m, 6)
        Prisms and tetrahedra, as `tiler.mesh_files.prisms.PrismMesh` has them.
    turned : bool, (m,)
        Of prisms, whether the third column rises second.
    facets : int64, (f, 3)
        Triangles of the boundary.
    label : int64, (f, l)
        What must be equal in both halves of a quadrilateral of it.

    Returns
    -------
    bool, (m, 3)
        By the order of `SIDES`; no side of a tetrahedron is.
    """
    prism = np.flatnonzero(cells[:, 5] != NO_CORNER)
    group, n = group_rows(np.sort(cells[prism][:, SIDES].reshape(-1, 4), axis=1))
    alone = np.flatnonzero(np.bincount(group, minlength=n)[group] == 1)
    of, side = prism[alone // 3], alone % 3
    halves = _halves(cells, turned, of, side).reshape(-1, 3)
    known, n = group_rows(np.sort(np.concatenate((facets, halves)), axis=1))
    facet = np.full(n, -1)
    facet[known[: len(facets)]] = np.arange(len(facets))
    one, two = facet[known[len(facets) :]].reshape(-1, 2).T
    outer = (one >= 0) & (two >= 0) & (label[one] == label[two]).all(axis=1)
    cut = np.zeros((len(cells), 3), np.bool_)
    cut[of[~outer], side[~outer]] = True
    return cut


def halve_sides(
    faces: NDArray[Number], cell: Ints, cells: NDArray[Number], turned: NDArray[np.bool_], cut: NDArray[np.bool_]
) -> tuple[NDArray[Number], Ints]:
    """Put two triangles in the place of each side that must be cut.

    Parameters
    ----------
    faces : int64, (k, 4)
        Faces of the cells, cell by cell, those of a prism in the order of `ENDS` and `SIDES`.
    cell : int64, (k,)
        Cell of each, ascending.
    cells, turned, cut
        As of `find_cut_sides`.
    """
    of, side = np.nonzero(cut)
    quad = np.searchsorted(cell, of) + len(ENDS) + side
    halves = np.full((len(of), 2, 4), NO_CORNER, cells.dtype)
    halves[:, :, :3] = _halves(cells, turned, of, side)
    kept = np.delete(np.arange(len(faces)), quad)
    place = np.concatenate((kept, np.repeat(quad, 2)))
    order = np.argsort(place, kind="stable")
    return np.concatenate((faces[kept], halves.reshape(-1, 4)))[order], cell[place[order]]


def turn_over(faces: NDArray[Number]) -> NDArray[Number]:
    """Turn faces, (k, 3) or (k, 4), to look the other way; the first corner stays.

    Examples
    --------
    >>> turn_over(np.array([[5, 6, 7, 8], [5, 6, 7, NO_CORNER]])).tolist()
    [[5, 8, 7, 6], [5, 7, 6, -1]]
    """
    triangles = faces[:, [0, 2, 1, *range(3, faces.shape[1])]]
    return (
        triangles
        if faces.shape[1] == 3
        else np.where(faces[:, 3:] == NO_CORNER, triangles, faces[:, [0, 3, 2, 1]])
    )


def fill_corners(rows: NDArray[Number]) -> NDArray[Number]:
    """Repeat the first corner of cells or faces (k, w) in the places that have none, which are the last ones."""
    return rows if (rows[:, -1] != NO_CORNER).all() else np.where(rows == NO_CORNER, rows[:, :1], rows)


def find_seam_sides(
    cells: NDArray[Number], turned: NDArray[np.bool_], cut: NDArray[np.bool_], shared: Rows
) -> tuple[Ints, NDArray[Number]]:
    """Find which of the sides to be cut may be whole in another piece: both halves are among its faces, (s, 3).

    Returns
    -------
    int64, (k,)
        The sides, as places in `cut` laid flat.
    int64, (k, 4)
        Their corners.
    """
    of, side = np.nonzero(cut)
    halves = _halves(cells, turned, of, side).reshape(-1, 3)
    group, n = group_rows(np.sort(np.concatenate((shared, halves)), axis=1))
    known = np.zeros(n, np.bool_)
    known[group[: len(shared)]] = True
    both = known[group[len(shared) :]].reshape(-1, 2).all(axis=1)
    of, side = of[both], side[both]
    return 3 * of + side, np.take_along_axis(cells[of], SIDES[side], axis=1)


def _halves(cells: NDArray[Number], turned: NDArray[np.bool_], of: Ints, side: Ints) -> NDArray[Number]:
    """Give the two triangles, (k, 2, 3), of sides of cells."""
    corners = HALVES[turned[of].astype(np.int64), side].reshape(-1, 6)
    return np.take_along_axis(cells[of], corners, axis=1).reshape(-1, 2, 3)


def split_prisms(
    cells: Ints, turned: NDArray[np.bool_], cut: NDArray[np.bool_], n_points: int
) -> tuple[Ints, Ints, Ints]:
    """Cut the prisms that have sides to be cut.

    Parameters
    ----------
    cells, turned, cut
        As of `find_cut_sides`.
    n_points : int
        Number of points, from which on middles are numbered.

    Returns
    -------
    int64, (k, 6)
        Cells; those of a prism stand in its place.
    int64, (k,)
        Which cell each comes from.
    int64, (p, 6)
        Corners of the prisms whose middle is a point, in the order of their numbers.
    """
    pattern = cut @ np.array([1, 2, 4]) + 8 * turned
    tables = {number: _divide(number >= 8, number % 8) for number in range(16) if number % 8}
    central = np.isin(pattern, [number for number, table in tables.items() if (table == MIDDLE).any()])
    number = n_points + np.cumsum(central) - 1
    whole = ~cut.any(axis=1)
    found, parent = [cells[whole]], [np.flatnonzero(whole)]
    for kind, table in tables.items():
        rows = np.flatnonzero(pattern == kind)
        places = np.column_stack((cells[rows], number[rows], np.full(len(rows), NO_CORNER)))
        found.append(places[:, table].reshape(-1, 6))
        parent.append(np.repeat(rows, len(table)))
    of = np.concatenate(parent)
    order = np.argsort(of, kind="stable")
    return np.concatenate(found)[order], of[order], cells[central]


def _divide(turned: bool, cut: int) -> Ints:
    """Give the cells of a prism with some sides cut (bits), by places among its corners, the middle and none.

    Examples
    --------
    Both cut sides have a diagonal to corner 3: a pyramid on the third side, and a tetrahedron.

    >>> _divide(False, 0b101).tolist()
    [[4, 5, 2, 1, 3, 7], [0, 1, 2, 3, 7, 7]]
    """
    if cut == 0b111:
        return _rows(
            [[0, 1, 2, 3], [3, 1, 2, 5], [3, 1, 5, 4]] if turned else [[0, 1, 2, 3], [3, 1, 2, 4], [3, 4, 2, 5]]
        )
    meeting = {
        (False, 0b101): [[4, 5, 2, 1, 3], [0, 1, 2, 3]],
        (True, 0b101): [[4, 5, 2, 1, 3], [0, 1, 2, 3]],
        (True, 0b011): [[5, 3, 0, 2, 1], [3, 5, 4, 1]],
        (False, 0b110): [[3, 4, 1, 0, 2], [3, 5, 4, 2]],
    }
    if (turned, cut) in meeting:
        return _rows(meeting[turned, cut])
    triangles = list(ENDS)
    pyramids = []
    for side in range(3):
        if cut >> side & 1:
            triangles += HALVES[int(turned), side].tolist()
        else:
            pyramids.append([*SIDES[side][::-1].tolist(), MIDDLE])
    return _rows([*pyramids, *([a, c, b, MIDDLE] for a, b, c in triangles)])


def _rows(cells: list[list[int]]) -> Ints:
    return np.array([cell + [NONE] * (6 - len(cell)) for cell in cells])
