"""Which two cells have each face: the one pairing of faces for all that needs it."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from pipeline.data.kernel import kernel

# The faces of a cell of positive volume, counter-clockwise seen from outside.
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int8)
NO_MATE, CROWDED = -1, -2
MOST_CELLS = 2**29 - 1  # four faces each have numbers of 32 bits
AT_ONCE = 1 << 20  # faces that are dealt out at once


def find_mates(cells: NDArray[np.int32], n_points: int) -> NDArray[np.int32]:
    """Find for each face of the cells the other that has the same vertices.

    Parameters and errors as of `iterate_mates`.

    Returns
    -------
    int32, (4 m,)
        Of face `k` of cell `i`, at ``4 * i + k``: the number of the other one, `NO_MATE` or `CROWDED`.

    Examples
    --------
    Two cells on the face 1, 2, 3:

    >>> find_mates(np.array([[0, 1, 2, 3], [1, 2, 3, 4]], np.int32), 5)
    array([-1, -1, -1,  4,  3, -1, -1, -1], dtype=int32)
    """
    found = np.empty(4 * len(cells), np.int32)
    for face, mate in iterate_mates(cells, n_points):
        found[face] = mate
    return found


def iterate_mates(
    cells: NDArray[np.int32], n_points: int
) -> Iterator[tuple[NDArray[np.int32], NDArray[np.int32]]]:
    """Find for each face of the cells the other that has the same vertices, some millions at a time.

    Parameters
    ----------
    cells : int32, (m, 4)
        Tetrahedra, indices below `n_points`.
    n_points : int
        Number of points.

    Yields
    ------
    face : int32, (k,)
        Numbers of faces, ``4 * i + k`` for face `k` of cell `i`: each once in all.
    mate : int32, (k,)
        The number of the other one, `NO_MATE`, or `CROWDED` where three or more cells have it.

    Raises
    ------
    ValueError
        If there are more than `MOST_CELLS` cells.

    Notes
    -----
    Faces are dealt out by their smallest vertex, and found among the few that have the same one: linear in the
    cells, and all of a face come together.
    """
    if len(cells) > MOST_CELLS:
        raise ValueError(f"{len(cells)} cells in one piece, at most {MOST_CELLS} can be paired")
    cells = np.ascontiguousarray(cells)
    start = _count(cells, n_points)
    begin = 0
    while begin < n_points:
        end = int(np.searchsorted(start, start[begin] + AT_ONCE, side="right")) - 1
        end = max(min(end, n_points), begin + 1)
        face = _deal(cells, start, begin, end)
        yield face, _pair(cells, start[begin : end + 1] - start[begin], face)
        begin = end


def take_faces(cells: NDArray[np.int32], face: NDArray[np.int64]) -> NDArray[np.int32]:
    """Give the vertices (k, 3) of faces by their numbers, counter-clockwise seen from outside the cell."""
    corners: NDArray[np.int32] = cells[(face // 4)[:, None], FACES[face % 4]]
    return corners


@kernel(inline="always")
def _name_face(cells, face):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return the smallest vertex of a face, and a number of the other two."""
    i, k = face // 4, face % 4
    a, b, c = np.int64(cells[i, FACES[k, 0]]), np.int64(cells[i, FACES[k, 1]]), np.int64(cells[i, FACES[k, 2]])
    low, high = min(a, b, c), max(a, b, c)
    return low, ((a + b + c - low - high) << 32) | high


@kernel
def _count(cells, n_points):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Count faces by their smallest vertex: how many have a smaller one than each."""
    start = np.zeros(n_points + 1, np.int64)
    for face in range(4 * len(cells)):
        start[_name_face(cells, face)[0] + 1] += 1
    for p in range(n_points):
        start[p + 1] += start[p]
    return start


@kernel
def _deal(cells, start, begin, end):  # type: ignore[no-untyped-def]  # pragma: no cover
    """List the faces whose smallest vertex is `begin` to before `end`, by that vertex."""
    place = start[begin:end] - start[begin]
    dealt = np.empty(start[end] - start[begin], np.int32)
    for i in range(len(cells)):
        one, two = min(cells[i, 0], cells[i, 1]), min(cells[i, 2], cells[i, 3])
        if min(one, two) >= end or max(one, two) < begin:  # most cells, as neighbours lie together
            continue
        for face in range(4 * i, 4 * i + 4):
            low = _name_face(cells, face)[0]
            if begin <= low < end:
                dealt[place[low - begin]] = face
                place[low - begin] += 1
    return dealt


@kernel
def _pair(cells, start, dealt):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Pair faces that lie side by side: group `p` from ``start[p]`` on."""
    mate = np.full(len(dealt), NO_MATE, np.int32)
    most = 0
    for p in range(len(start) - 1):
        most = max(most, start[p + 1] - start[p])
    names, first = np.empty(most, np.int64), np.empty(most, np.int64)
    second = np.empty(most, np.int64)
    for p in range(len(start) - 1):
        n = 0
        for at in range(start[p], start[p + 1]):
            name = _name_face(cells, dealt[at])[1]
            row = 0
            while row < n and names[row] != name:
                row += 1
            if row == n:
                names[n], first[n], second[n] = name, at, -1
                n += 1
            elif second[row] < 0:
                second[row] = at
                mate[at], mate[first[row]] = dealt[first[row]], dealt[at]
            else:
                mate[at] = mate[first[row]] = mate[second[row]] = CROWDED
    return mate
