"""Pieces of cells of a tile: blocks of buildings where there are no roads, barriers, borders, registration."""

from dataclasses import dataclass, replace

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.generalisation.barriers import deal_segments, split_at_grid
from pipeline.generalisation.partition import Borders, find_borders, partition_tile
from pipeline.generalisation.street_axis import find_close_pairs, find_street_axis, smooth_pieces
from tiler.generalisation.buildings import Buildings, join_buildings
from tiler.generalisation.options import Asked
from tiler.generalisation.shards import Shards, Tile, around

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
    work.shards.append("buildings", work.tile, once.take(np.argsort(order[start])))
    return len(start), len(order) - len(start)


def read_buildings(shards: Shards, tile: Tile) -> Buildings:
    """Read the buildings whose middle lies in a tile."""
    return join_buildings(shards.read("buildings", tile))


def pair_buildings(work: Work) -> list[tuple[Tile, Index]]:
    """List the buildings that are closer to those of this tile than a street, by the tile of the other one."""
    own = read_buildings(work.shards, work.tile).outlines
    found = []
    for tile in around(work.tile):
        pairs = find_close_pairs(own, read_buildings(work.shards, tile).outlines, work.asked.block_gap)
        found.append((tile, pairs))
    return [(tile, pairs) for tile, pairs in found if len(pairs)]


def part_tile(work: Work) -> Pieces:
    """Part a tile into pieces of cells, and register its buildings; polygons go into a file."""
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
    return Pieces(find_borders(pieces, segments, box), names)


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
    parts, names = [], []
    for tile in around(work.tile):
        outlines = read_buildings(work.shards, tile).outlines
        kept = shapely.intersects(outlines, area)
        parts.append(outlines[kept])
        blocks = work.shards.read("blocks", tile)
        names.append(blocks[0][kept] if blocks else np.empty(0, np.int64))
    return np.concatenate(parts), np.concatenate(names)


def _grow(box: tuple[float, float, float, float], by: float) -> tuple[float, float, float, float]:
    return box[0] - by, box[1] - by, box[2] + by, box[3] + by
