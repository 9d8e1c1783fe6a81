"""Pieces of cells of a tile: blocks of buildings where there are no roads, barriers, borders, registration."""

from dataclasses import dataclass, replace

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.generalisation.barriers import deal_segments, split_at_grid
from pipeline.generalisation.partition import (
    APART,
    EAST,
    NORTH,
    SOUTH,
    WEST,
    Borders,
    find_borders,
    match_sides,
    partition_tile,
)
from pipeline.generalisation.street_axis import find_close_pairs, find_street_axis, smooth_pieces
from pipeline.geometry.components import join_pairs
from tiler.generalisation.buildings import Buildings, join_buildings
from tiler.generalisation.options import Asked
from tiler.generalisation.shards import Numbers, Shards, Tile, around

REACH = 200.0  # m; without roads, buildings farther from a place do not part cells there

Index = NDArray[np.int64]


@dataclass(frozen=True)
class Work:
    """A tile and what is done to it: small, so that it may be sent to a worker."""

    shards: Shards
    tile: Tile
    asked: Asked
    axis: bool
    rim: bytes


@dataclass(frozen=True, eq=False)
class Pieces:
    """What a tile tells of its pieces: borders, and the block of buildings next to each (-1 with roads)."""

    borders: Borders
    block: Index


def sort_buildings(work: Work) -> tuple[int, int]:
    """Take each outline of a tile once; gives the number of buildings, and that of copies, which are left out.

    The building has the lowest id of its copies and the greatest height, and is a landmark where one of them is.
    Without roads those that are closer than a street are chained: the first row of its chain for each.
    """
    dealt = join_buildings(work.shards.read("dealt", work.tile))
    _, outline = np.unique(shapely.to_wkb(shapely.normalize(dealt.outlines)), return_inverse=True)
    order = np.lexsort((dealt.ids.astype(str), outline.ravel()))
    start = np.flatnonzero(np.diff(outline.ravel()[order], prepend=-1))
    once = replace(
        dealt.take(order[start]),
        height=np.maximum.reduceat(dealt.height[order], start),
        ground=np.fmax.reduceat(dealt.ground[order], start),
        landmark=np.logical_or.reduceat(dealt.landmark[order], start),
    )
    once = once.take(np.argsort(order[start]))
    work.shards.append("buildings", work.tile, once)
    if work.axis:
        close = find_close_pairs(once.outlines, once.outlines, work.asked.block_gap)
        work.shards.append("chains", work.tile, join_pairs(len(once), close))
    return len(start), len(order) - len(start)


def read_buildings(shards: Shards, tile: Tile) -> Buildings:
    """Read the buildings whose middle lies in a tile."""
    return join_buildings(shards.read("buildings", tile))


def read_numbers(shards: Shards, kind: str) -> Numbers:
    """Read the numbers of the pieces or buildings of the region."""
    found: Numbers = shards.read(f"{kind}-numbers", (0, 0))[0]
    return found


def pair_buildings(work: Work) -> Index:
    """List the chains of buildings that are closer to those of this tile than a street, in the tiles behind it.

    Gives pairs (p, 2), each once: numbers of the first building of each chain.
    """
    numbers = read_numbers(work.shards, "buildings")
    own, chain = read_buildings(work.shards, work.tile).outlines, work.shards.read("chains", work.tile)[0]
    pairs = [np.empty((0, 2), np.int64)]
    for tile in around(work.tile)[5:]:
        if (first := numbers.first(tile)) >= 0:
            other = read_buildings(work.shards, tile).outlines
            one, two = find_close_pairs(own, other, work.asked.block_gap).T
            two = first + work.shards.read("chains", tile)[0][two]
            pairs.append(np.column_stack((numbers.first(work.tile) + chain[one], two)))
    return np.unique(np.concatenate(pairs), axis=0)


def part_tile(work: Work) -> int:
    """Part a tile into pieces of cells, and register its buildings; all goes into files, the number is given."""
    box = work.shards.box(work.tile)
    rim = shapely.from_wkb(work.rim)
    segments = np.concatenate([np.empty((0, 4)), *work.shards.read("segments", work.tile)])
    near, block = _read_near(work, box) if work.axis else (np.empty(0, object), np.empty(0, np.int64))
    if work.axis:
        axis = split_at_grid(find_street_axis(near, block, _grow(box, 1.0)), work.shards.size)
        segments = np.concatenate((segments, deal_segments(axis, work.shards.size).get(work.tile, segments[:0])))
    pieces = partition_tile(segments, box, rim)
    if work.axis:
        pieces = smooth_pieces(pieces)
    own = read_buildings(work.shards, work.tile)
    work.shards.append("pieces", work.tile, (pieces, register(own.outlines, pieces)))
    names = np.full(len(pieces), -1)
    if len(near) and len(pieces):
        middle = shapely.point_on_surface(pieces)
        rows, nearest = shapely.STRtree(near).query_nearest(middle, all_matches=False)
        names[rows] = block[nearest]
    work.shards.append("sides", work.tile, Pieces(find_borders(pieces, segments, box), names))
    return len(pieces)


def meet_tiles(work: Work) -> Index:
    """Find the pieces that are one with those of the tiles to the east and north; gives pairs of numbers (p, 2).

    All pieces and borders of the tile go into files.
    """
    numbers = read_numbers(work.shards, "pieces")
    own, first = work.shards.read("sides", work.tile)[0], numbers.first(work.tile)
    row = first + np.arange(len(own.block))
    work.shards.append("rows-0", work.tile, (row, row, own.borders.area))
    work.shards.append("borders-0", work.tile, (first + own.borders.pairs, own.borders.length))
    same = [np.empty((0, 2), np.int64)]
    i, j = work.tile
    for side, opposite, tile in ((EAST, WEST, (i + 1, j)), (NORTH, SOUTH, (i, j + 1))):
        if (second := numbers.first(tile)) < 0:
            continue
        (other,) = work.shards.read("sides", tile)
        for barrier in (False, True):
            met, shared = match_sides(_side(own, side, barrier), _side(other, opposite, barrier))
            open_to = (not barrier) & (shared > APART) & (own.block[met[:, 0]] == other.block[met[:, 1]])
            met += np.array([first, second])
            same.append(met[open_to])
            work.shards.append("borders-0", work.tile, (met[~open_to], shared[~open_to]))
    return np.concatenate(same)


def _side(pieces: Pieces, side: int, barrier: bool) -> tuple[Index, NDArray[np.float64], NDArray[np.float64]]:
    own = pieces.borders
    rows = (own.side == side) & (own.barrier == barrier)
    return own.piece[rows], own.low[rows], own.high[rows]


def register(outlines: NDArray[np.object_], pieces: NDArray[np.object_]) -> Index:
    """Find the piece that holds the middle of each outline, or the nearest one."""
    found = np.zeros(len(outlines), np.int64)
    if len(outlines):
        middle = shapely.point_on_surface(outlines)
        rows, piece = shapely.STRtree(pieces).query_nearest(middle)
        found[rows[::-1]] = piece[::-1]  # the first of several
    return found


def _read_near(work: Work, box: tuple[float, float, float, float]) -> tuple[NDArray[np.object_], Index]:
    """Read the buildings in and around a tile, and the block of each."""
    area = shapely.box(*_grow(box, REACH))
    parts, names = [], [np.empty(0, np.int64)]
    for tile in around(work.tile):
        outlines = read_buildings(work.shards, tile).outlines
        kept = shapely.intersects(outlines, area)
        parts.append(outlines[kept])
        blocks = work.shards.read("blocks", tile)
        if blocks:
            names.append(blocks[0][1][work.shards.read("chains", tile)[0]][kept])
    return np.concatenate(parts), np.concatenate(names)


def _grow(box: tuple[float, float, float, float], by: float) -> tuple[float, float, float, float]:
    return box[0] - by, box[1] - by, box[2] + by, box[3] + by
