"""Conformity: what makes tetrahedra and triangles one watertight mesh, as checks on arrays (step 3.6).

A facet is written with its vertices counter-clockwise seen from outside the cell. Two cells meet properly
in a face when they list its vertices in opposite orders.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.data.kernel import kernel
from stitch.pieces.face_mates import CROWDED, FACES, NO_MATE, iterate_mates, take_faces

# A cell counts as flat when its volume is below this part of the cube of its longest edge.
FLAT = 1e-12


@dataclass(frozen=True, eq=False)
class FacePairs:
    """How faces meet."""

    exterior: NDArray[np.int32]  #: (k, 3): faces that occur once, oriented outwards, in the order of the input
    #: (s, 3): faces that occur twice in the same orientation: two cells overlap, or one is inverted
    same_side: NDArray[np.int32]
    shared: NDArray[np.int32]  #: (t, 3): faces that occur three times or more, one row for each occurrence
    row: NDArray[np.int64]  #: (k,): the face of the input, or the cell, that each exterior face is of
    #: (m,): of cells: the part of each, from 0. Cells of one part hang together by faces of two cells. Of loose
    #: faces none
    part: NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class EdgePairs:
    """How the edges of a triangle surface meet."""

    #: (k, 2): edges that facets do not use equally often in both directions: the surface has a hole or a facet is
    #: turned over
    open: NDArray[np.int32]
    #: (m, 2): matched edges of more than two facets, as where two buildings touch in a corner: allowed
    non_manifold: NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class Matched:
    """Faces of one surface against those of another, as row numbers."""

    missing: NDArray[np.int64]  #: (k,): rows of the first that the second lacks
    extra: NDArray[np.int64]  #: (k,): rows of the second that the first lacks
    flipped: NDArray[np.int64]  #: (k,): rows of the second that are in the first in the other orientation
    duplicate: NDArray[np.int64]  #: (k,): rows of the second that repeat an earlier row, in either orientation


def pair_cell_faces(cells: NDArray[np.int32], n_points: int) -> FacePairs:
    """Find for every face of the cells whether one, two or more cells have it.

    Parameters
    ----------
    cells : int32, (m, 4)
        Tetrahedra, indices below `n_points`.
    n_points : int
        Number of points.

    Returns
    -------
    FacePairs
        Exterior and faulty faces.

    Notes
    -----
    Linear in the cells, some 5 bytes each and a few tens of MB (`iterate_mates`).

    Examples
    --------
    Two cells on the face 1, 2, 3 have six exterior faces:

    >>> pairs = pair_cell_faces(np.array([[0, 1, 2, 3], [1, 2, 3, 4]], np.int32), 5)
    >>> len(pairs.exterior), len(pairs.same_side), len(pairs.shared)
    (6, 0, 0)
    """
    cells = np.ascontiguousarray(cells)
    above = np.arange(len(cells), dtype=np.int32)  # a cell of the same part, itself if it is the first one
    kinds: tuple[list[NDArray[np.int32]], ...] = ([], [], [])
    for face, mate in iterate_mates(cells, n_points):
        one_sided = _join_cells(cells, face, mate, above)
        for kind, rows in zip(kinds, (mate == NO_MATE, one_sided, mate == CROWDED), strict=True):
            kind.append(face[rows])
    _number_parts(above)
    none = np.empty(0, np.int32)
    outer, one_sided, crowded = (np.sort(np.concatenate((none, *kind))) for kind in kinds)
    exterior, same_side, shared = (take_faces(cells, rows) for rows in (outer, one_sided, crowded))
    return FacePairs(exterior, same_side, shared, (outer // 4).astype(np.int64), above)


def pair_faces(facets: NDArray[np.int32]) -> FacePairs:
    """Do as `pair_cell_faces` for loose faces: the exterior faces of all pieces of a mesh.

    Parameters
    ----------
    facets : int32, (k, 3)
        Oriented faces.

    Returns
    -------
    FacePairs
        Faces of two pieces that meet properly are gone.
    """
    even = _is_even(facets)
    group, n_groups = group_rows(np.sort(facets, axis=1))
    count = np.bincount(group, minlength=n_groups)[group]
    n_even = np.bincount(group, even, n_groups)[group]
    same_side, shared = facets[(count == 2) & (n_even != 1)], facets[count > 2]
    return FacePairs(facets[count == 1], same_side, shared, np.flatnonzero(count == 1), np.empty(0, np.int32))


def pair_edges(facets: NDArray[np.int32]) -> EdgePairs:
    """Find whether a triangle surface is closed and oriented.

    Parameters
    ----------
    facets : int32, (k, 3)
        Oriented triangles.

    Returns
    -------
    EdgePairs
        Edges that are not matched, and those of more than two facets, each once.

    Examples
    --------
    >>> tetrahedron = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int32)
    >>> len(pair_edges(tetrahedron).open), pair_edges(tetrahedron[1:]).open.tolist()
    (0, [[0, 1], [0, 2], [1, 2]])
    """
    start, end = facets.ravel(), np.roll(facets, -1, axis=1).ravel()
    edges = np.column_stack([np.minimum(start, end), np.maximum(start, end)])
    group, n_groups = group_rows(edges)
    count = np.bincount(group, minlength=n_groups)
    forward = np.bincount(group, start < end, n_groups)
    first = _first_of_group(group, n_groups)
    is_open = 2 * forward != count
    return EdgePairs(edges[first[is_open]], edges[first[~is_open & (count > 2)]])


def match_facets(first: NDArray[np.int32], second: NDArray[np.int32]) -> Matched:
    """Compare two sets of oriented faces on the same vertices.

    Parameters
    ----------
    first : int32, (k, 3)
        What must be there, each face once.
    second : int32, (n, 3)
        What is there.

    Returns
    -------
    Matched
        All rows of `second` that have a fault and all rows of `first` without a partner.
    """
    both = np.concatenate([first, second])
    group, n_groups = group_rows(np.sort(both, axis=1))
    in_first, in_second = group[: len(first)], group[len(first) :]
    row_in_first = np.full(n_groups, -1)
    row_in_first[in_first] = np.arange(len(first))
    row_in_second = _first_of_group(in_second, n_groups)
    partner = row_in_first[in_second]
    turned = _is_even(first)[partner] != _is_even(second) if len(first) else np.zeros(len(second), np.bool_)
    return Matched(
        missing=np.flatnonzero(row_in_second[in_first] < 0),
        extra=np.flatnonzero(partner < 0),
        flipped=np.flatnonzero((partner >= 0) & turned),
        duplicate=np.flatnonzero(row_in_second[in_second] != np.arange(len(second))),
    )


def group_rows(rows: NDArray[np.generic]) -> tuple[NDArray[np.int64], int]:
    """Number the distinct rows of an array, in ascending order of the rows.

    Parameters
    ----------
    rows : any dtype with an order, (n, k)
        Rows; two rows are the same when all their numbers are equal, so -0.0 is 0.0 and NaN nothing.

    Returns
    -------
    group : int64, (n,)
        Number of each row's group.
    n_groups : int
        Number of groups.

    Examples
    --------
    >>> group_rows(np.array([[2, 1], [0, 5], [2, 1]]))
    (array([1, 0, 1]), 2)
    """
    order = np.lexsort(rows.T[::-1])
    changes = np.ones(len(rows), np.bool_)
    ordered = rows[order]
    changes[1:] = np.any(ordered[1:] != ordered[:-1], axis=1)
    group = np.empty(len(rows), np.int64)
    group[order] = np.cumsum(changes) - 1
    return group, int(changes.sum())


def find_duplicate_points(points: NDArray[np.float64]) -> NDArray[np.int64]:
    """Find the points whose three coordinates equal those of an earlier point.

    Parameters
    ----------
    points : float64, (n, 3)
        Points (m).

    Returns
    -------
    int64, (k,)
        Their indices, ascending.
    """
    if _ascend(points):
        return np.empty(0, np.int64)
    group, n_groups = group_rows(points)
    return np.flatnonzero(_first_of_group(group, n_groups)[group] != np.arange(len(points)))


def find_used_points(rows: NDArray[np.int32], n_points: int) -> NDArray[np.bool_]:
    """Tell which points, (n_points,), rows (m, k) of cells or facets use."""
    return _mark(np.ascontiguousarray(rows), n_points)  # type: ignore[no-any-return]


def find_unused_points(rows: NDArray[np.int32], n_points: int) -> NDArray[np.int64]:
    """Find the points that no cell or facet uses.

    Parameters
    ----------
    rows : int32, (m, k)
        Vertex indices of cells or facets.
    n_points : int
        Number of points.

    Returns
    -------
    int64, (n,)
        Their indices, ascending.
    """
    return np.flatnonzero(~find_used_points(rows, n_points))


def compute_cell_volumes(
    points: NDArray[np.float64], cells: NDArray[np.int32]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Compute the signed volume of every cell, and whether it is flat.

    Parameters
    ----------
    points : float64, (n, 3)
        Points (m).
    cells : int32, (m, 4)
        Tetrahedra.

    Returns
    -------
    volume : float64, (m,)
        Signed volume (m³), negative for an inverted cell, NaN if a coordinate is.
    flat : bool, (m,)
        True where the absolute volume is at most `FLAT` times the cube of the longest edge.
    """
    return _cell_volumes(np.ascontiguousarray(points), np.ascontiguousarray(cells), FLAT)  # type: ignore[no-any-return]


def compute_facet_areas(
    points: NDArray[np.float64], facets: NDArray[np.int32]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Compute the signed plan area of every facet, and the volume between it and height zero.

    Parameters
    ----------
    points : float64, (n, 3)
        Points (m).
    facets : int32, (k, 3)
        Oriented triangles.

    Returns
    -------
    area : float64, (k,)
        Area of its projection on the plane (m²): positive facing up, negative facing down.
    volume : float64, (k,)
        That area times the mean height of the vertices (m³); over a closed surface they add up to the
        volume inside.
    """
    a, b, c = (points[facets[:, k]] for k in range(3))
    u, v = b[:, :2] - a[:, :2], c[:, :2] - a[:, :2]
    area = (u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]) / 2
    return area, area * (a[:, 2] + b[:, 2] + c[:, 2]) / 3


def _ascend(points: NDArray[np.float64]) -> bool:
    """Tell whether points ascend by x, then y, then z: those of a mesh of ours do."""
    above, equal = (compare(points[1:], points[:-1]) for compare in (np.greater, np.equal))
    higher = above[:, 0] | (equal[:, 0] & (above[:, 1] | (equal[:, 1] & above[:, 2])))
    return bool(higher.all())


def _first_of_group(group: NDArray[np.int64], n_groups: int) -> NDArray[np.int64]:
    """Return the first row of each group, -1 for an empty one."""
    first = np.full(n_groups, -1)
    first[group[::-1]] = np.arange(len(group))[::-1]
    return first


def _is_even(facets: NDArray[np.int32]) -> NDArray[np.bool_]:
    """Tell whether a rotation brings a row into ascending order (True), or only a swap (False)."""
    a, b, c = facets.T
    ascents = (a < b).astype(np.int8) + (b < c) + (c < a)
    even: NDArray[np.bool_] = ascents == 2
    return even


@kernel
def _turns(cells, face):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Tell whether a rotation brings the vertices of a face into ascending order."""
    i, k = face // 4, face % 4
    a, b, c = cells[i, FACES[k, 0]], cells[i, FACES[k, 1]], cells[i, FACES[k, 2]]
    return (a < b) + (b < c) + (c < a) == 2


@kernel
def _find_first(above, i):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Find the first thing of a part, where each thing names another one before it, and the first itself."""
    while above[i] != i:
        above[i] = above[above[i]]
        i = above[i]
    return i


@kernel
def _join_cells(cells, faces, mates, above):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Put cells on both sides of faces into one part, and tell which faces have both on one side."""
    one_sided = np.zeros(len(faces), np.bool_)
    for at in range(len(faces)):
        face, other = faces[at], mates[at]
        if other < 0:
            continue
        one_sided[at] = _turns(cells, face) == _turns(cells, other)
        if other < face:
            continue
        one, two = _find_first(above, face // 4), _find_first(above, other // 4)
        above[max(one, two)] = min(one, two)
    return one_sided


@kernel
def _number_parts(above):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Number the parts from 0, in the order of their first cells."""
    n = 0
    for cell in range(len(above)):
        if above[cell] == cell:
            above[cell] = n
            n += 1
        else:  # of a smaller cell, which has its number
            above[cell] = above[above[cell]]


@kernel
def _mark(rows, n_points):  # type: ignore[no-untyped-def]  # pragma: no cover
    used = np.zeros(n_points, np.bool_)
    for i in range(rows.shape[0]):
        for k in range(rows.shape[1]):
            used[rows[i, k]] = True
    return used


@kernel
def _cell_volumes(points, cells, flat_below):  # type: ignore[no-untyped-def]  # pragma: no cover
    volume = np.empty(len(cells))
    flat = np.empty(len(cells), np.bool_)
    edge = np.empty((3, 3))
    for i in range(len(cells)):
        longest = 0.0
        for k in range(3):
            for axis in range(3):
                edge[k, axis] = points[cells[i, k + 1], axis] - points[cells[i, 0], axis]
        a, b, c = edge
        for k in range(3):
            one, two = edge[k], edge[(k + 1) % 3]
            own = one[0] ** 2 + one[1] ** 2 + one[2] ** 2
            other = (one[0] - two[0]) ** 2 + (one[1] - two[1]) ** 2 + (one[2] - two[2]) ** 2
            longest = max(longest, own, other)
        volume[i] = (
            a[0] * (b[1] * c[2] - b[2] * c[1])
            - a[1] * (b[0] * c[2] - b[2] * c[0])
            + a[2] * (b[0] * c[1] - b[1] * c[0])
        ) / 6
        flat[i] = not abs(volume[i]) > flat_below * longest**1.5
    return volume, flat
