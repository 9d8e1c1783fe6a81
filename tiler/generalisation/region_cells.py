"""Cells of a region from the pieces of its tiles: joined across tiles, fragments joined to neighbours."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.generalisation.cell_graph import join_small
from pipeline.generalisation.partition import APART, EAST, NORTH, SOUTH, WEST, match_sides, sum_pairs
from pipeline.geometry.components import join_pairs
from tiler.generalisation.shards import Tile
from tiler.generalisation.tile_cells import Pieces

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Cells:
    """Cells of a region as numbers, without geometry."""

    tile: Index  # (p, 2): tile of each piece, in order
    piece: Index  # (p,): its row within the tile
    cell: Index  # (p,): the cell that it belongs to, 0 to n - 1
    area: Array  # (n,): of each cell (m2)
    pairs: Index  # (k, 2): cells that share a border
    length: Array  # (k,): of that border (m)
    fragments: int  # cells that were joined to a neighbour


def join_cells(pieces: Mapping[Tile, Pieces], fragment: float) -> Cells:
    """Join the pieces of tiles across their sides where no barrier is, then fragments to neighbours.

    Cells below `fragment` (m2) are joined to the neighbour with the longest border. Memory holds some 200 bytes a
    piece, and the borders of cells.
    """
    tiles = sorted(pieces)
    count = [len(pieces[tile].block) for tile in tiles]
    start = dict(zip(tiles, np.cumsum([0, *count]).tolist(), strict=False))
    n = sum(count)
    block = np.concatenate([np.empty(0, np.int64), *(pieces[tile].block for tile in tiles)])
    same, pairs, length = [np.empty((0, 2), np.int64)], [np.empty((0, 2), np.int64)], [np.empty(0)]
    for tile in tiles:
        own = pieces[tile].borders
        pairs.append(own.pairs + start[tile])
        length.append(own.length)
        for side, opposite, other in (
            (EAST, WEST, (tile[0] + 1, tile[1])),
            (NORTH, SOUTH, (tile[0], tile[1] + 1)),
        ):
            if other not in pieces:
                continue
            for barrier in (False, True):
                one = _side(pieces[tile], side, start[tile], barrier)
                met, shared = match_sides(one, _side(pieces[other], opposite, start[other], barrier))
                open_to = (not barrier) & (shared > APART) & (block[met[:, 0]] == block[met[:, 1]])
                same.append(met[open_to])
                pairs.append(met[~open_to])
                length.append(shared[~open_to])
    area = np.concatenate([np.empty(0), *(pieces[tile].borders.area for tile in tiles)])
    whole = _number(join_pairs(n, np.concatenate(same)))
    raw = np.bincount(whole, area).astype(np.float64)
    borders = sum_pairs(whole[np.concatenate(pairs)], np.concatenate(length))
    joined = join_small(raw, *borders, fragment)
    cell = _number(joined[whole])
    onto = np.zeros(len(raw), np.int64)
    onto[whole] = cell
    pairs_of_cells, total = sum_pairs(onto[borders[0]], borders[1])
    return Cells(
        np.repeat(np.array(tiles, np.int64).reshape(-1, 2), count, axis=0),
        np.concatenate([np.empty(0, np.int64), *map(np.arange, count)]),
        cell,
        np.bincount(cell, area).astype(np.float64),
        pairs_of_cells,
        total,
        int((joined != np.arange(len(joined))).sum()),
    )


def _side(pieces: Pieces, side: int, start: int, barrier: bool) -> tuple[Index, Array, Array]:
    own = pieces.borders
    rows = (own.side == side) & (own.barrier == barrier)
    return own.piece[rows] + start, own.low[rows], own.high[rows]


def _number(names: Index) -> Index:
    """Number groups that are named by the first row of each, in the order of these."""
    return np.unique(names, return_inverse=True)[1].ravel()
