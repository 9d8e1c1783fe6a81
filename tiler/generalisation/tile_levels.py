"""Levels of the cells that a tile owns: land use, LoD0C, LoD0B and LoD0A."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.data.citymodel import make_ids
from pipeline.generalisation.aggregation import areas_of, find_adjacent, merge_outlines
from pipeline.generalisation.barriers import GRID
from pipeline.generalisation.blocks import cut_block, is_building, keep_near, mean_heights, subtract
from tiler.generalisation.buildings import Buildings, join_buildings
from tiler.generalisation.region_cells import read_rows
from tiler.generalisation.rows import CellRows, Rows, join_rows
from tiler.generalisation.shards import Tile, by_tile
from tiler.generalisation.tile_cells import Work, read_buildings, read_numbers
from tiler.vectors.features import to_objects

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Texts = NDArray[np.object_]


@dataclass(frozen=True, eq=False)
class CellList:
    """Cells that a tile owns: their numbers, and the pieces of each by tile and row."""

    number: Index
    cell: Index
    tile: Index
    piece: Index


@dataclass(frozen=True, eq=False)
class OwnCells:
    """Cells with their outlines, what is cut from them, and their buildings.

    `others` are all other objects in a cell, `free` the area that equation (1) divides by, `built` that of the
    buildings; `owner` is the row of each building's cell, `of` that of its LoD0C object, `cell` the cell of each
    of these.
    """

    number: Index
    id: Texts
    outlines: NDArray[np.object_]
    others: NDArray[np.object_]
    free: Array
    built: Array
    use: NDArray[np.bool_]
    tiles: Sequence[Sequence[Tile]]
    buildings: Buildings
    owner: Index
    of: Index
    lod0c: Rows
    cell: Index


def make_cells(work: Work) -> None:
    """Make the cells that a tile owns: outlines, land use, LoD0C; they go into files."""
    cell, number, _ = read_rows(work.shards, 2, work.tile)
    found = _gather(work, CellList(np.unique(cell), cell, *read_numbers(work.shards, "pieces").places(number)))
    work.shards.append("made", work.tile, found)
    work.shards.append("use", work.tile, (found.id, found.use))
    _list_standing(work, found)


def _gather(work: Work, listed: CellList) -> OwnCells:
    asked, n = work.asked, len(listed.number)
    row = np.searchsorted(listed.number, listed.cell)
    pieces = np.empty(len(row), object)
    houses, owner = [], []
    others: list[list[shapely.Geometry]] = [[] for _ in range(n)]
    tiles: list[list[Tile]] = [[] for _ in range(n)]
    for tile, mine in by_tile(listed.tile):
        polygons, registered = work.shards.read("pieces", tile)[0]
        pieces[mine] = polygons[listed.piece[mine]]
        cell_of = np.full(len(polygons), -1)
        cell_of[listed.piece[mine]] = row[mine]
        here = cell_of[registered]
        houses.append(read_buildings(work.shards, tile).take(here >= 0))
        owner.append(here[here >= 0])
        cover = work.shards.read("others", tile)
        tree = shapely.STRtree(np.concatenate([np.empty(0, object), *cover]))
        for k in np.unique(row[mine]).tolist():
            tiles[k].append(tile)
            own = pieces[mine[row[mine] == k]]
            others[k].extend(tree.geometries[np.unique(tree.query(own, "intersects")[1])])
    outlines = to_objects([_union(pieces[row == k]) for k in range(n)])
    outlines = shapely.normalize(outlines)
    cut = to_objects([_union(to_objects(each)) for each in others])
    buildings, of_cell = join_buildings(houses), np.concatenate([np.empty(0, np.int64), *owner])
    order = np.lexsort((buildings.ids.astype(str), of_cell))
    buildings, of_cell = buildings.take(order), of_cell[order]
    names = to_objects(["C" + name[1:] for name in make_ids(outlines).tolist()])
    first = find_adjacent(buildings.outlines, of_cell, buildings.landmark, asked.adjacent)
    heads, of = np.unique(first, return_inverse=True)
    lod0c = _aggregate(buildings, of.ravel(), names[of_cell[heads]], asked.adjacent, asked.block_height)
    rim = shapely.from_wkb(work.rim)
    free = np.array([cut_block(a, b, asked.street_width, rim).area for a, b in zip(outlines, cut, strict=True)])
    built = np.bincount(of_cell[heads], lod0c.area, minlength=n).astype(np.float64)
    plain = np.bincount(of_cell[~buildings.landmark], minlength=n) > 0
    use = is_building(built, free, asked.least_share) & plain
    return OwnCells(
        listed.number, names, outlines, cut, free, built, use, tiles, buildings, of_cell, of.ravel(), lod0c,
        of_cell[heads],
    )  # fmt: skip


def _union(parts: NDArray[np.object_]) -> shapely.Geometry:
    if not len(parts):
        return shapely.Polygon()
    return parts[0] if len(parts) == 1 else shapely.union_all(parts, grid_size=GRID)


def _aggregate(buildings: Buildings, of: Index, cell: Texts, gap: float, keeps: str) -> Rows:
    """Make the objects of LoD0C; a landmark keeps its id."""
    order = np.argsort(of, kind="stable")
    groups = np.split(order, np.flatnonzero(np.diff(of[order])) + 1) if len(order) else []
    outlines = to_objects([merge_outlines(buildings.outlines[rows], gap) for rows in groups])
    head = np.array([rows[0] for rows in groups], np.int64)
    landmark = buildings.landmark[head]
    ids = [
        name if is_landmark else f"{of_cell}/{name}"
        for name, of_cell, is_landmark in zip(buildings.ids[head], cell, landmark, strict=True)
    ]
    height, ground = _means(buildings, of, shapely.area(outlines), keeps)
    members = np.bincount(of, minlength=len(groups))
    return Rows(
        outlines, to_objects(ids), to_objects(ids), cell, height, ground, members, landmark.astype(np.int64)
    )


def _means(buildings: Buildings, of: Index, area: Array, keeps: str) -> tuple[Array, Array]:
    """Height and ground of groups; the ground is the mean of those that are known, by area."""
    own = shapely.area(buildings.outlines)
    known = np.isfinite(buildings.ground)
    with np.errstate(invalid="ignore"):
        over = np.bincount(of[known], own[known], minlength=len(area))
        ground = np.bincount(of[known], (own * buildings.ground)[known], minlength=len(area)) / over
    return mean_heights(own, buildings.height, of, area, keeps), ground


def _list_standing(work: Work, found: OwnCells) -> None:
    """List what stands for itself in blocks: landmarks, and objects of cells of other use beyond their cell."""
    beyond = ~found.use[found.cell] & ~shapely.covers(found.outlines[found.cell], found.lod0c.outlines)
    standing = found.lod0c.outlines[(found.lod0c.landmark == 1) | beyond]
    work.shards.append("standing", work.tile, standing)


def make_levels(work: Work) -> None:
    """Make the rows of all levels of a tile, and of its cells; they go into a file."""
    (own,) = work.shards.read("made", work.tile)
    is_block = own.use[own.cell] & (own.lod0c.landmark == 0)
    lod0c = replace(own.lod0c, parent=np.where(is_block, own.lod0c.cell, own.lod0c.id))
    alone = replace(own.lod0c, parent=own.lod0c.id).take(~is_block)
    parent = _name_parents(work, own.use)
    used = np.flatnonzero(own.use)
    blocks = [_block(work, [(own, k)], own.id[k], parent[k]) for k in used.tolist()]
    groups_of = _read_groups(work)
    upper = [_block(work, mine, name, "") for name, mine in groups_of.items()]
    rows = {
        "lod1": _lod1(own),
        "lod0c": lod0c,
        "lod0b": join_rows([*blocks, alone]),
        "lod0a": join_rows([*upper, replace(alone, parent=to_objects([""] * len(alone)))]),
    }
    count = np.bincount(own.owner, minlength=len(own.id))
    cells_of = CellRows(own.outlines, own.id, own.use, own.free, own.built, count, parent)
    children = {name: [own.id[k] for own, k in mine] for name, mine in groups_of.items()}
    work.shards.append("rows", work.tile, (cells_of, rows, children))


def _name_parents(work: Work, use: NDArray[np.bool_]) -> Texts:
    """Give the object of LoD0A of each cell of a tile, by the first cell in it; ``""`` for cells of other use."""
    _, group = work.shards.read("names-2", work.tile)[0]
    parent = np.full(len(group), "", object)
    for tile, rows in by_tile(read_numbers(work.shards, "pieces").places(group)[0]):
        number, ids = work.shards.read("names-2", tile)[0][0], work.shards.read("use", tile)[0][0]
        parent[rows] = ["A" + name[1:] for name in ids[np.searchsorted(number, group[rows])].tolist()]
    return np.where(use, parent, "")


def _read_groups(work: Work) -> dict[str, list[tuple[OwnCells, int]]]:
    """Read the cells of each object of LoD0A that a tile owns, by its id: cells of a tile, and the row of one."""
    made = cache(lambda tile: work.shards.read("made", tile)[0])
    numbers, found = read_numbers(work.shards, "pieces"), {}
    group, cell = np.concatenate([np.empty((2, 0), np.int64), *work.shards.read("groups", work.tile)], axis=1)
    for name in np.unique(group).tolist():
        mine = np.sort(cell[group == name])
        cells = [made(tuple(tile)) for tile in numbers.places(mine)[0].tolist()]
        rows = [int(np.searchsorted(one.number, k)) for one, k in zip(cells, mine.tolist(), strict=True)]
        found["A" + cells[0].id[rows[0]][1:]] = list(zip(cells, rows, strict=True))
    return found


def _lod1(own: OwnCells) -> Rows:
    n = len(own.buildings)
    landmark = own.buildings.landmark
    return Rows(
        own.buildings.outlines,
        own.buildings.ids,
        own.lod0c.id[own.of],
        own.id[own.owner],
        own.buildings.height,
        own.buildings.ground,
        np.ones(n, np.int64),
        landmark.astype(np.int64),
    )


def _block(work: Work, cells: Sequence[tuple[OwnCells, int]], name: str, parent: str) -> Rows:
    """Make the block that stands for the buildings of one or several cells, but for landmarks."""
    asked = work.asked
    outline = _union(to_objects([own.outlines[k] for own, k in cells]))
    others = _union(to_objects([own.others[k] for own, k in cells]))
    block = cut_block(outline, others, asked.street_width, shapely.from_wkb(work.rim))
    tiles = sorted({tile for own, k in cells for tile in own.tiles[k]})
    cuts = [each for tile in tiles for each in work.shards.read("cuts", tile)]
    standing = np.concatenate([np.empty(0, object), *cuts])
    standing = standing[shapely.intersects(standing, block)]
    left = subtract(block, _union(standing))
    block = block if left.is_empty else left
    houses = join_buildings([own.buildings.take((own.owner == k) & ~own.buildings.landmark) for own, k in cells])
    if asked.yard_width > 0:
        near = keep_near(block, houses.outlines, asked.yard_width)
        block = block if near.is_empty else near
    block = areas_of(shapely.simplify(block, asked.adjacent / 2))
    of = np.zeros(len(houses), np.int64)
    height, ground = _means(houses, of, np.array([block.area]), asked.block_height)
    return Rows(
        to_objects([block]), to_objects([name]), to_objects([parent]), to_objects([cells[0][0].id[cells[0][1]]]),
        height, ground, np.array([len(houses)]), np.zeros(1, np.int64),
    )  # fmt: skip
