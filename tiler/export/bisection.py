"""Columns of cells dealt out to processes by recursive coordinate bisection, from a file of any length.

A column is what stands over one triangle of the plane mesh. All its cells have the same box in plan, whichever of
its vertices they have twice, so the middle of that box names the column; cuts between columns are vertical.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
BINS = 4096  # of a histogram along the cut axis; a second one divides the bin that the cut falls in
TILT = 2.0**-10  # across per along: so columns in a row, as those of a grid are, don't fall on one side together
CHUNK = 1 << 18  # columns that are looked at together


@dataclass(frozen=True, eq=False)
class Cuts:
    """A tree of cuts in plan; node 0 is the whole region."""

    axis: Ints  #: (n,): 0 for a cut across x, 1 across y
    place: Floats  #: (n,): a column goes low where ``along + TILT * across`` is less (m)
    #: (n,): the next node on each side; -1 less the part where there is no further cut
    low: Ints
    high: Ints
    n_parts: int  #: number of parts

    def part_of(self, centre: Floats) -> Ints:
        """Return the part of each column, (k, 2) to (k,), by the middle of its box in plan (m)."""
        if not len(self.axis):
            return np.zeros(len(centre), np.int64)
        return -1 - _descend(self, centre)


def column_centres(points: Floats, cells: NDArray[np.int32]) -> Floats:
    """Return the middle of the box in plan of each cell or facet, float64 (m, 2), from its vertices (m, k).

    Examples
    --------
    >>> points = np.array([[0.0, 0, 0], [4, 0, 0], [0, 2, 0], [0, 0, 3], [4, 0, 3]])
    >>> column_centres(points, np.array([[0, 1, 2, 3], [1, 2, 3, 4]], np.int32))
    array([[2., 1.],
           [2., 1.]])
    """
    low, high = points[cells[:, 0], :2].copy(), points[cells[:, 0], :2].copy()
    for k in range(1, cells.shape[1]):
        corner = points[cells[:, k], :2]
        np.minimum(low, corner, out=low)
        np.maximum(high, corner, out=high)
    return (low + high) / 2


def count_columns(points: Floats, cells: NDArray[np.int32]) -> Floats:
    """Find the columns of some cells: rows (c, 3) of the middle of each (m) and the number of its cells."""
    centre = column_centres(points, cells)
    order = np.lexsort((centre[:, 1], centre[:, 0]))
    centre = centre[order]
    first = np.flatnonzero(np.concatenate(([True], (centre[1:] != centre[:-1]).any(axis=1)))[: len(centre)])
    n = np.diff(np.append(first, len(centre)))
    return np.column_stack([centre[first], n.astype(np.float64)])


def bisect_columns(columns: Floats, n_parts: int) -> Cuts:
    """Cut a region into parts of about equal numbers of cells, each time across the longer side.

    Parameters
    ----------
    columns : float64, (c, 3)
        Rows of `count_columns`, in any order; a column may have several rows.
    n_parts : int
        Number of parts, 1 or more.

    Returns
    -------
    Cuts
        The tree. A part has no cells where there are too few columns.

    Notes
    -----
    Columns are read three times a level of the tree, `CHUNK` at a time: memory is 64 kB a part. All sums are of
    whole numbers, so the order of rows does not count. A cut is off by one column, or by 6e-8 of the length of
    what it cuts.

    References
    ----------
    M. J. Berger, S. H. Bokhari, "A partitioning strategy for nonuniform problems on multiprocessors", IEEE
    Transactions on Computers C-36, 570-580, 1987.

    Examples
    --------
    >>> columns = np.array([[0.0, 0, 1], [1, 0, 1], [2, 0, 1], [3, 0, 3]])
    >>> bisect_columns(columns, 2).part_of(columns[:, :2])
    array([0, 0, 0, 1])
    """
    none = np.empty(0, np.int64)
    tree = Cuts(none, np.empty(0), none, none, n_parts)
    waiting = [(0, n_parts)] if n_parts > 1 else []  # of each node without a cut: its first part and their number
    while waiting:
        start = len(tree.axis)
        share = np.array([n // 2 / n for _, n in waiting])
        axis, place = _find_cuts(tree, columns, start, share)
        low, high = np.empty(len(waiting), np.int64), np.empty(len(waiting), np.int64)
        following: list[tuple[int, int]] = []
        for row, (first, n) in enumerate(waiting):
            for side, begin, count in ((low, first, n // 2), (high, first + n // 2, n - n // 2)):
                side[row] = -1 - begin if count == 1 else start + len(waiting) + len(following)
                following += [(begin, count)] if count > 1 else []
        tree = Cuts(
            np.concatenate([tree.axis, axis]),
            np.concatenate([tree.place, place]),
            np.concatenate([tree.low, low]),
            np.concatenate([tree.high, high]),
            n_parts,
        )
        waiting = following
    return tree


def _descend(tree: Cuts, centre: Floats) -> Ints:
    """Follow the cuts from the root on; gives what is behind the last one."""
    node = np.zeros(len(centre), np.int64)
    rows = np.flatnonzero(node < len(tree.axis))
    while len(rows):
        at = node[rows]
        is_low = _key(centre[rows], tree.axis[at]) < tree.place[at]
        node[rows] = np.where(is_low, tree.low[at], tree.high[at])
        rows = rows[(node[rows] >= 0) & (node[rows] < len(tree.axis))]
    return node


def _key(centre: Floats, axis: Ints) -> Floats:
    x, y = centre[:, 0], centre[:, 1]
    key: Floats = np.where(axis == 0, x + TILT * y, y + TILT * x)
    return key


def _find_cuts(tree: Cuts, columns: Floats, start: int, share: Floats) -> tuple[Ints, Floats]:
    """Find the next cut of each node from number `start` on, whose low side has a `share` of the cells."""
    n = len(share)
    low, high = np.full((n, 2), np.inf), np.full((n, 2), -np.inf)
    for row, centre, _ in _walk(tree, columns, start):
        for k in range(2):
            np.minimum.at(low[:, k], row, centre[:, k])
            np.maximum.at(high[:, k], row, centre[:, k])
    low, high = np.where(np.isfinite(low), low, 0.0), np.where(np.isfinite(high), high, 0.0)
    axis = (high - low).argmax(axis=1)
    begin, end = _key(low, axis), _key(high, axis)
    before = np.zeros(n)
    target = np.full(n, np.nan)
    for _ in range(2):
        width = np.maximum(end - begin, np.spacing(np.abs(end)) * BINS) / BINS
        weight = np.zeros(n * BINS)
        for row, centre, cells in _walk(tree, columns, start):
            key = _key(centre, axis[row])
            bin_of = np.floor((key - begin[row]) / width[row])
            chosen = (bin_of >= 0) & (key <= end[row])
            place = row[chosen] * BINS + np.minimum(bin_of[chosen], BINS - 1).astype(np.int64)
            weight += np.bincount(place, cells[chosen], n * BINS)
        total = before[:, None] + np.cumsum(weight.reshape(n, BINS), axis=1)
        target = np.where(np.isnan(target), total[:, -1] * share, target)
        found = np.minimum((total < target[:, None]).sum(axis=1), BINS - 1)
        under = np.where(found > 0, total[np.arange(n), found - 1], before)
        over = total[np.arange(n), found]
        begin, before = begin + found * width, under
        end = begin + width
    return axis, np.where(target - under <= over - target, begin, end)


def _walk(tree: Cuts, columns: Floats, start: int) -> Iterator[tuple[Ints, Floats, Floats]]:
    """Give the columns of nodes from number `start` on: which of them, middle and cells, a chunk at a time."""
    for first in range(0, len(columns), CHUNK):
        some = np.array(columns[first : first + CHUNK])
        row = _descend(tree, some[:, :2]) - start
        chosen = row >= 0
        yield row[chosen], some[chosen, :2], some[chosen, 2]
