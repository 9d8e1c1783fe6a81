"""Region-wide numbers of points: a point has one number, whichever tile writes it (step 3.6).

Points are numbered by parts: the column of each corner, the columns of each seam between its corners, what is left
of each tile. A point's id is the code of its part, and behind that its number within the part, column by column
from below. The code is made of the part's kind and its column and row in the CRS: a tile gives its ids without
knowing any other, and they stay when another tile changes, or when the region does.

    ======  ====================================================================================
    bits    meaning
    ======  ====================================================================================
    61, 62  kind of the part: 0 corner, 1 seam to the east, 2 seam to the north, 3 tile
    46-60   column of the part in the CRS, modulo 2**15
    31-45   row of the part in the CRS, modulo 2**15
    0-30    number within the part
    ======  ====================================================================================

Ids are unique where a region has fewer than 2**15 tiles to a side. They have gaps. Where numbers without gaps are
wanted, the ids are counted by their order (`Numbering`).
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.columns.nodes import Levels
from pipeline.data.mesh import ColumnMesh
from stitch.tiling.grid import Key, SeamKey, ends_of_seam

INDEX_BITS = 15  # of a column or row
LOCAL_BITS = 31  # of a number within a part: indices within a piece are int32
MOST_TILES = 2**INDEX_BITS - 1  # to a side of a region, which has one more line
Ints = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Numbering:
    """From ids to numbers without gaps, 0 to ``n_points - 1``, in the order of the ids."""

    #: (r,): runs of ids that follow each other: from ``start`` to before ``stop``, ascending and apart
    start: Ints
    stop: Ints
    offset: Ints  #: (r + 1,): number of the first id of each run, and of all points

    @property
    def n_points(self) -> int:
        """Number of all points."""
        return int(self.offset[-1])


@dataclass(frozen=True, eq=False)
class PartCounts:
    """Points of a tile."""

    own: int  #: points of no seam
    #: (p,): codes of the tile's seams and corners, and how many levels each has
    part: Ints
    levels: Ints
    unused: Ints  #: (u,): ids of those levels that the tile has no cell at: the tiles around it may have one


def corner_part(key: Key) -> int:
    """Code of a corner."""
    return _part(0, key.i, key.j)


def seam_part(key: SeamKey) -> int:
    """Code of a seam between its corners."""
    return _part(1 + key.axis, key.i, key.j)


def tile_part(key: Key) -> int:
    """Code of a tile between its seams."""
    return _part(3, key.i, key.j)


def first_id(part: int) -> int:
    """Id of the first point of a part.

    Examples
    --------
    >>> first_id(corner_part(Key(0, 1))) == 2**31
    True
    """
    return part << LOCAL_BITS


def count_by_part(
    mesh: ColumnMesh, used: NDArray[np.bool_], shared: NDArray[np.int32], lowest: Ints
) -> PartCounts:
    """Count the points of a tile by parts.

    Parameters
    ----------
    mesh : ColumnMesh
        The tile's mesh.
    used : bool, (n_levels,)
        Levels that its cells use.
    shared, lowest : int32 and int64, (k,)
        As in `number_columns`.
    """
    first, row = np.unique(lowest, return_index=True)
    begin = mesh.z_start[shared[row]]
    count = mesh.z_start[shared[row] + 1] - begin
    within = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    there = used[np.repeat(begin, count) + within]
    unused = (np.repeat(first, count) + within)[~there]
    part, of = np.unique(first >> LOCAL_BITS, return_inverse=True)
    levels = np.bincount(of, count, len(part)).astype(np.int64)
    return PartCounts(int(used.sum() - there.sum()), part, levels, unused)


def count_all_points(tiles: Sequence[PartCounts]) -> int:
    """Count the points of some tiles, each once: those that some tile uses.

    Examples
    --------
    >>> one = PartCounts(5, np.array([7]), np.array([4]), np.array([7, 9]) + first_id(7))
    >>> two = PartCounts(2, np.array([7]), np.array([4]), np.array([9]) + first_id(7))
    >>> count_all_points([one]), count_all_points([one, two])
    (7, 10)
    """
    if not tiles:
        return 0
    part, first, n_tiles = np.unique(
        np.concatenate([tile.part for tile in tiles]), return_index=True, return_counts=True
    )
    levels = np.concatenate([tile.levels for tile in tiles])[first]
    unused, n_unused = np.unique(np.concatenate([tile.unused for tile in tiles]), return_counts=True)
    by_all = n_unused == n_tiles[np.searchsorted(part, unused >> LOCAL_BITS)]
    return int(sum(tile.own for tile in tiles) + levels.sum() - by_all.sum())


def seam_ids(key: SeamKey, levels: Levels) -> Ints:
    """Give the ids of the lowest points of a seam's columns.

    Parameters
    ----------
    key : SeamKey
        The seam.
    levels : Levels
        Its columns, from its first corner to its last.

    Returns
    -------
    int64, (n,)
        Id of the lowest point of each column; the others of a column follow.
    """
    ids: Ints = first_id(seam_part(key)) + levels.start[:-1] - levels.start[1]
    ids[[0, -1]] = [first_id(corner_part(corner)) for corner in ends_of_seam(key)]
    return ids


def number_columns(mesh: ColumnMesh, shared: NDArray[np.int32], lowest: Ints, first: int) -> Ints:
    """Give the points of a tile their region-wide ids: those of the lowest, as the others of a column follow.

    Parameters
    ----------
    mesh : ColumnMesh
        The tile's mesh.
    shared : int32, (k,)
        Vertices of its plane mesh on seams within the region; a corner may come several times.
    lowest : int64, (k,)
        Ids of their lowest points, see `seam_ids`.
    first : int
        Id of the first of the tile's own points.

    Returns
    -------
    int64, (n,)
        Id of the lowest level of each column of the tile.

    Raises
    ------
    ValueError
        If a corner is given with two ids.
    """
    count = np.diff(mesh.z_start)
    ids = np.full(len(count), -1, np.int64)
    ids[shared] = lowest
    if (ids[shared] != lowest).any():
        raise ValueError("two seams of a tile number a corner differently")
    own = ids < 0
    ids[own] = first + np.cumsum(count[own]) - count[own]
    return ids


def collect_ids(pieces: Iterable[Ints]) -> Numbering:
    """Number the points of all pieces without gaps.

    Parameters
    ----------
    pieces : iterable of int64, (n,)
        Ids of the points of each piece; a point may be in several pieces.

    Notes
    -----
    Ids are kept as runs. Where every level of a seam has a cell, a part is one run when all its tiles are seen; so
    memory is some 100 bytes a part, and one piece.

    Examples
    --------
    >>> table = collect_ids([np.array([0, 1, 3]), np.array([2**31, 1, 2])])
    >>> table.start.tolist(), table.stop.tolist()
    ([0, 2147483648], [4, 2147483649])
    >>> number_without_gaps(table, np.array([3, 2**31, 0])).tolist()
    [3, 4, 0]
    """
    runs = np.empty((0, 2), np.int64)
    waiting: list[Ints] = []
    n_waiting = 0
    for ids in pieces:
        waiting.append(_join_runs([_runs(ids)]))
        n_waiting += len(waiting[-1])
        if n_waiting > len(runs):  # each run is moved a few times at most, however many pieces there are
            runs, waiting, n_waiting = _join_runs([runs, *waiting]), [], 0
    start, stop = _join_runs([runs, *waiting]).T
    return Numbering(start, stop, np.concatenate(([0], np.cumsum(stop - start))))


def number_without_gaps(numbering: Numbering, ids: Ints) -> Ints:
    """Turn ids (n,) into numbers from 0 on; ValueError for one that was not collected."""
    run = np.searchsorted(numbering.start, ids, side="right") - 1
    if len(ids) and (run.min() < 0 or (ids >= numbering.stop[run]).any()):
        raise ValueError("an id is not among those that were collected")
    numbers: Ints = numbering.offset[run] + ids - numbering.start[run]
    return numbers


def _part(kind: int, i: int, j: int) -> int:
    # Columns and rows go round, so that no place in the CRS is too far out and none is below 0.
    wrap = 1 << INDEX_BITS
    return (kind * wrap + i % wrap) * wrap + j % wrap


def _runs(ids: Ints) -> Ints:
    """Runs (r, 2) of ids that follow each other, as they stand."""
    if len(ids) == 0:
        return np.empty((0, 2), np.int64)
    last = np.append(np.flatnonzero(np.diff(ids) != 1), len(ids) - 1)
    return np.stack((ids[np.append(0, last[:-1] + 1)], ids[last] + 1), axis=1)


def _join_runs(several: Sequence[Ints]) -> Ints:
    """Join runs that overlap or touch."""
    runs = np.concatenate(several)
    start, stop = runs[np.argsort(runs[:, 0], kind="stable")].T
    reach = np.maximum.accumulate(stop)
    first = np.ones(len(start), np.bool_)
    first[1:] = start[1:] > reach[:-1]
    last = np.append(first[1:], True)[: len(first)]
    return np.stack((start[first], reach[last]), axis=1)
