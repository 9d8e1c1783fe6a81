"""Cells of a region from the pieces of its tiles, in files by tile: memory holds some columns of tiles.

A building, a piece or a cell is known by a number, and what is joined by the smallest number in it; the tile that
has this number owns it. Rounds: 0 are pieces, 1 these joined across the sides of tiles, 2 cells, which took in
fragments; names of these are objects of LoD0A. Kinds of files: `rows` (number, piece, its area), `borders` (two
numbers, length) and `names`, from numbers of a round to those of the next.
"""

from collections.abc import Callable, Iterable
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from pipeline.generalisation.cell_graph import SmallCells
from pipeline.generalisation.partition import sum_pairs
from pipeline.geometry.components import join_pairs
from tiler.generalisation.shards import Numbers, Shards, Tile, by_tile

Array = NDArray[np.float64]
Index = NDArray[np.int64]
NO_PAIRS = np.empty((0, 2), np.int64)
TILES_AT_ONCE = 64  # whose names are kept in memory


def join_across(numbers: Numbers, found: Iterable[Index], shards: Shards, kind: str) -> None:
    """Name what belongs together by chains of pairs by the smallest number in it.

    Parameters
    ----------
    found : iterable of int64, (p, 2)
        Pairs of things of each tile with those of its own column of tiles and of the next one.
    kind : str
        Names of the things of each tile are written as this.
    """
    pairs_of = iter(found)
    name: dict[int, int] = {}  # of things in the column ahead
    for column in numbers.columns():
        pairs = np.concatenate([NO_PAIRS, *(next(pairs_of) for _ in column)]).ravel()
        old, row = np.unique(np.array([name.get(k, k) for k in pairs.tolist()], np.int64), return_inverse=True)
        row = row.ravel()
        new = old[join_pairs(len(old), row.reshape(-1, 2))]
        _log(shards, kind, column[0][0], [*name.items(), *zip(old.tolist(), new.tolist(), strict=True)])
        ahead = pairs >= column[-1][2]
        name = dict(zip(pairs[ahead].tolist(), new[row][ahead].tolist(), strict=True))
    _write_names(numbers, shards, kind, lambda _, first, end: np.arange(first, end))


def join_small(numbers: Numbers, shards: Shards, number: int, limit: float, *, alike: bool = False) -> int:
    """Join the small cells of a round; gives how many others took in. With `alike` as LoD0A, else fragments."""
    graph = SmallCells(limit, alike=alike)
    for column in numbers.columns():
        for tile, _, _ in column:
            cells, area = read_areas(shards, number, tile)
            pairs, length = _read_borders(shards, number, tile)
            if alike and len(cells):
                may = shards.read("use", tile)[0][1] & (area <= limit)
                cells, area = cells[may], area[may]
            graph.add(cells, area, pairs, length)
        _log(shards, f"names-{number}", column[0][0], graph.join(column[-1][2]))
    _write_names(numbers, shards, f"names-{number}", lambda tile, *_: read_areas(shards, number, tile)[0])
    return graph.taken


def deal_round(numbers: Numbers, shards: Shards, number: int) -> None:
    """Deal the rows and borders of a round to the owners of its names, in their order."""

    @lru_cache(TILES_AT_ONCE)
    def names_of(tile: Tile) -> tuple[Index, Index]:
        ((own, names),) = shards.read(f"names-{number}", tile)
        return own, names

    def rename(old: Index) -> Index:
        new = np.empty_like(old)
        for tile, rows in by_tile(numbers.places(old)[0]):
            own, names = names_of(tile)
            new[rows] = names[np.searchsorted(own, old[rows])]
        return new

    def deal(kind: str, owner: Index, *columns: NDArray[np.generic]) -> None:
        for tile, rows in by_tile(numbers.places(owner)[0]):
            shards.append(f"{kind}-{number + 1}", tile, tuple(column[rows] for column in columns))

    for column in numbers.columns():
        for tile, _, _ in column:
            for old, piece, area in shards.read(f"rows-{number}", tile):
                deal("rows", new := rename(old), new, piece, area)
            pairs, length = _read_borders(shards, number, tile)
            pairs = np.sort(rename(pairs.ravel()).reshape(-1, 2), axis=1)
            apart = pairs[:, 0] != pairs[:, 1]
            deal("borders", pairs[apart, 0], pairs[apart], length[apart])
            shards.drop(f"rows-{number}", tile)
            shards.drop(f"borders-{number}", tile)


def read_rows(shards: Shards, number: int, tile: Tile) -> tuple[Index, Index, Array]:
    """Read the numbers of a round that a tile owns, piece by piece: number, piece, and its area (m2)."""
    rows = shards.read(f"rows-{number}", tile)
    if not rows:
        return np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0)
    cell, piece, area = (np.concatenate(part) for part in zip(*rows, strict=True))
    order = np.argsort(piece)
    return cell[order], piece[order], area[order]


def read_areas(shards: Shards, number: int, tile: Tile) -> tuple[Index, Array]:
    """Read the numbers of a round that a tile owns, and the area of each (m2)."""
    cell, _, area = read_rows(shards, number, tile)
    cells, row = np.unique(cell, return_inverse=True)
    return cells, np.bincount(row.ravel(), area, minlength=len(cells)).astype(np.float64)


def _read_borders(shards: Shards, number: int, tile: Tile) -> tuple[Index, Array]:
    """Read which numbers share borders, the lesser one the tile's; lengths are summed in their order (m)."""
    rows = shards.read(f"borders-{number}", tile)
    pairs, length = zip((NO_PAIRS, np.empty(0)), *rows, strict=True)
    if number == 0:  # each part of a border once, as it is
        return np.concatenate(pairs), np.concatenate(length)
    return sum_pairs(np.concatenate(pairs), np.concatenate(length))


def _log(shards: Shards, kind: str, tile: Tile, names: list[tuple[int, int]]) -> None:
    new = [(one, other) for one, other in names if one != other]
    shards.append(f"{kind}-log", (tile[0], 0), np.array(new, np.int64).reshape(-1, 2))


def _write_names(numbers: Numbers, shards: Shards, kind: str, of: Callable[[Tile, int, int], Index]) -> None:
    """Write the last name of each number, from the last column of tiles to the first."""
    last: dict[int, int] = {}
    for column in reversed(list(numbers.columns())):
        (log,) = shards.read(f"{kind}-log", (column[0][0][0], 0))
        for one, other in reversed(log.tolist()):
            last[one] = last.get(other, other)
        for tile, first, end in column:
            own = of(tile, first, end)
            shards.append(kind, tile, (own, np.array([last.get(k, k) for k in own.tolist()], np.int64)))
        last = {one: name for one, name in last.items() if one < column[0][1]}
