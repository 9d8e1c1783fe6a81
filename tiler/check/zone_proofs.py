"""The proofs of `citystitch check` that buildings and triangles are as detailed as the zones of detail ask for.

Each building has the level of detail of the zone of its point. Facets of the top are the triangles of the plane
mesh: each has an area of about h**2 / 2 at most, with the target edge length h in its middle. Houses and seams
make smaller ones; on open ground none is much smaller.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.data.mesh import Marker
from pipeline.data.roof_forms import find_blocks
from pipeline.plane_mesh.sizes import Finer, finer_sizes
from tiler.check.proofs import Dtm, Fault, Finding, Proof, Surface, Vertices, find_faults, join_findings
from tiler.citymodels.building_index import BuildingRow, copy_vertices, has_parts, read_building, read_objects
from tiler.config.step_options import make_finer
from tiler.config.zone_levels import find_levels
from tiler.config.zones import LEVELS, LOD, LOD_POINT, Zones
from tiler.store.result_file import ResultFile
from tiler.store.run_folder import CELLS_REPLACED, RoofRules, RunRecord
from tiler.store.store import Store

WITHIN = 0.002  # m; a point lies in its building's outline, whose coordinates are rounded to 1 mm
WALL_SAMPLE = 0.5  # m; between the places on walls where the terrain is looked up
RAISED = 0.02  # m; of a raised roof against these, as outlines are rounded to 1 mm
ROUNDED = 0.003  # m; heights of the city model are rounded to 1 mm
# Stages with the blocks that a run was given, and with their cells; rows that are read at once.
BLOCK_ROWS, CELL_ROWS, BATCH = "blocks", "block-cells", 10_000
# Areas over h**2 / 2. Of the facets of real and synthetic cities the largest has 1.5, the smallest on open ground
# 0.25.
MOST, LEAST = 2.0, 0.15
# Vertical edges over h.
TALLEST, LOWEST = 1.6, 0.3
CLEAR = 2.0  # sizes; open ground is that far from vertices of houses and from the border of a piece
COMMON = 0.01  # m; parts of a house share no longer wall than this where they have one height
PLANES, BLOCK, TOP = LEVELS.index("2.2"), LEVELS.index("1.2"), LEVELS.index("0A")
DETAILS = {
    "level-not-stated": f"a building has no attribute {LOD!r}, or no point {LOD_POINT!r}; run again",
    "level-count": "run.json counts another number of building parts at a level of detail",
    "level-of-zone": "a building has another level of detail than the zone of its point asks for",
    "level-point": f"the point of a building is outside of its outline before simplification; bound: {WITHIN:g} m",
    "level-roof": "a roof slopes, where its building's level has flat ones alone",
    "building-in-block": "the point of a building lies in a block that stands for it",
    "block-unknown": "a building at a level of blocks is none of those that the run was given",
    "block-level": "a block has another level or point than the one that the run was given",
    "block-height": f"a block has not its height above its ground, nor is it raised; bound: {ROUNDED:g} m",
    "block-cell": "a block that the run was given is of no cell at its level with its point",
    "cell-level": "a cell of blocks has another level of detail than the zone of its point asks for",
    "cell-point": f"the point of a cell of blocks is outside of it; bound: {WITHIN:g} m",
    "cell-count": "run.json counts another number of cells that blocks stand for",
    "building-in-cell": "a building lies as a whole in a cell that blocks stand for",
    "level-parts": "parts of a house at level 1.2 share a wall; they are one outline there",
}


@dataclass(frozen=True, eq=False)
class GivenBlocks:
    """Blocks that a run was given, by id: level, height (m), point; cells, terrain, rules of raised roofs."""

    rows: Mapping[str, tuple[int, float, float, float]]
    dtm: Dtm
    roofs: RoofRules
    cells: NDArray[np.object_]  # outlines of the cells whose buildings blocks stand for
    cell_places: Sequence[tuple[int, float, float]]  # level and point of each
    inner: shapely.Geometry  # what of the region is away from its sides, where houses are clipped


def read_given_blocks(store: Path, dtm: Dtm, record: RunRecord) -> GivenBlocks:
    """Read the blocks of a run and their cells, some at a time; there may be none."""
    rows: dict[str, tuple[int, float, float, float]] = {}
    stored = Store(store)
    for names, found, some in _scan_rows(stored, BLOCK_ROWS):
        level, place = find_blocks(found.read("forms", some))
        height = found.read("given_height", some)
        for i, name in enumerate(names):
            rows[name.decode()] = (int(level[i]), float(height[i]), *place[i].tolist())
    cells, places = [np.empty(0, np.object_)], list[tuple[int, float, float]]()
    for names, found, some in _scan_rows(stored, CELL_ROWS):
        cells.append(shapely.from_wkb(_cut(found, "wkb", *some[0])))
        for name in names:
            word, x, y, _ = name.decode().split(" ", 3)
            places.append((LEVELS.index(word), float(x), float(y)))
    inner = shapely.box(*(record.core or record.bounds)).buffer(-record.sizes.clearance - WITHIN)
    return GivenBlocks(rows, dtm, record.roofs, np.concatenate(cells), places, inner)


def _scan_rows(stored: Store, stage: str) -> Iterator[tuple[list[bytes], ResultFile, list[tuple[int, int]]]]:
    """Go through the rows of a stage, some at a time: their ids, the file, and the range of rows."""
    for name in stored.names(stage):
        with stored.open(stage, name) as found:
            n = len(found.read("id_end")) if "id_end" in found.names else 0
            for k in range(0, n, BATCH):
                some = k, min(k + BATCH, n)
                yield _cut(found, "id", *some), found, [some]


def _cut(found: ResultFile, name: str, first: int, last: int) -> list[bytes]:
    """Cut the bytes of some rows out of those of all."""
    ends = found.read(f"{name}_end", [(max(first - 1, 0), last)])
    start = ends if first else np.insert(ends, 0, 0)
    data = found.read(name, [(int(start[0]), int(start[-1]))]).tobytes()
    return [data[a:b] for a, b in pairwise((start - start[0]).tolist())]


def check_zones(
    zones: Zones,
    model: Path,
    full_model: Path,
    stated: Mapping[str, int] | None = None,
    blocks: GivenBlocks | None = None,
) -> Proof:
    """Hold points against outlines of houses before they were simplified, and levels against zones.

    Parameters
    ----------
    zones : Zones
        The zones of the run.
    model : Path
        The city model that was meshed.
    full_model : Path
        The city model before it was simplified.
    stated : mapping of str to int, optional
        Building parts at each level by the record of the run, to hold theirs against.
    blocks : GivenBlocks, optional
        What blocks are held against.

    Raises
    ------
    InputError
        If a file is missing or damaged.
    """
    found = _Found(zones, blocks)
    for name, thing, building in _iterate(model):
        found.add(name, thing, building)
    return found.prove(full_model, stated)


def _iterate(path: Path) -> Iterator[tuple[str, Mapping[str, Any], BuildingRow]]:
    """Read the buildings and parts of a city model one at a time: name, object and what is read of it."""
    with TemporaryFile() as vertex_file:
        vertices = copy_vertices(path, vertex_file)
        for name, thing in read_objects(path):
            if not has_parts(path, thing):
                yield name, thing, read_building(path, name, thing, vertices)


class _Found:
    """Level and point of each house, and what is wrong with buildings alone."""

    def __init__(self, zones: Zones, blocks: GivenBlocks | None) -> None:
        self._zones, self._blocks = zones, blocks
        self._names: list[str] = []
        self._rows: list[tuple[float, float, float, int]] = []
        self._parts: dict[str, list[Any]] = {}
        self._faults: list[tuple[str, float, float, float]] = []

    def add(self, name: str, thing: Mapping[str, Any], building: BuildingRow) -> None:
        """Look at a building or part."""
        values = thing["attributes"]
        level, point = values.get(LOD), values.get(LOD_POINT)
        house = thing.get("parents", [name])[0]
        inside = building.footprint.representative_point()
        place = (inside.x, inside.y, building.roof)
        numbers = isinstance(point, list) and all(isinstance(v, (int, float)) for v in point)
        if level not in LEVELS or not numbers or len(point) != 2:
            self._faults.append(("level-not-stated", *place))
            return
        number = LEVELS.index(level)
        self._names.append(house)
        self._rows.append((float(point[0]), float(point[1]), building.roof, number))
        if number != PLANES and any(building.plane[:2]):
            self._faults.append(("level-roof", *place))
        if number > BLOCK and self._blocks is not None:
            wrong = _look_at_block(self._blocks, values, building, number)
            self._faults += [(wrong, *place)] if wrong else []
        if level == "1.2" and "parents" in thing:
            self._parts.setdefault(house, []).append(building.footprint)

    def prove(self, full_model: Path, stated: Mapping[str, int] | None) -> Proof:
        """Hold what was found against zones and the city model before it was simplified."""
        rows = np.array(self._rows, np.float64).reshape(-1, 4)
        level = rows[:, 3].astype(np.int64)
        found = find_levels(self._zones, rows[:, :2])
        found = np.where(level <= BLOCK, np.minimum(found, BLOCK), found)  # a building that is in no cell
        found = np.where(level == TOP - 1, np.minimum(found, TOP - 1), found)  # not all cells of a block are at 0A
        within, blocks, kept = self._look_up(full_model, rows)
        covered = np.zeros(len(rows), np.bool_)
        single = np.flatnonzero(level <= BLOCK)
        tree = shapely.STRtree(blocks)
        covered[single[tree.query(shapely.points(rows[single, :2]), predicate="within")[0]]] = True
        count = np.bincount(level, minlength=len(LEVELS)).tolist()
        other = [k for k, name in enumerate(LEVELS) if stated is not None and count[k] != stated[name]]
        faults = [
            *self._told(),
            *_fault("level-count", np.array([rows[level == k][0, :3] for k in other if count[k]]).reshape(-1, 3)),
            *_fault("level-of-zone", rows[level != found]),
            *_fault("level-point", rows[~within & (level <= BLOCK)]),
            *_fault("building-in-block", rows[covered]),
            *_fault("building-in-cell", rows[kept & (level <= BLOCK)]),
            *([] if self._blocks is None else _look_at_cells(self._blocks, self._zones, stated)),
            *_fault("level-parts", np.array(self._common_walls()).reshape(-1, 3)),
        ]
        shown = ", ".join(f"{n} of {name}" for name, n in zip(LEVELS, count, strict=True) if n)
        claim = f"{len(rows)} building parts have the level of detail of the zone of their point"
        return Proof(f"{claim}: {shown or 'none'}", tuple(faults))

    def _told(self) -> list[Fault]:
        kinds = sorted({kind for kind, *_ in self._faults})
        return [
            fault
            for kind in kinds
            for fault in _fault(kind, np.array([place for other, *place in self._faults if other == kind]))
        ]

    def _look_up(
        self, full_model: Path, rows: NDArray[np.float64]
    ) -> tuple[NDArray[np.bool_], list[Any], NDArray[np.bool_]]:
        """Tell which points are in the outline of their house before simplification, and give those of blocks.

        Also tells of which rows this outline lies in a cell that blocks stand for.
        """
        within, blocks, of_house = np.zeros(len(rows), np.bool_), list[Any](), dict[str, list[int]]()
        cells = shapely.STRtree([] if self._blocks is None else self._blocks.cells)
        known, kept = within.copy(), ~within  # of which rows the house is there; all of its parts lie in cells
        for row, name in enumerate(self._names):
            of_house.setdefault(name, []).append(row)

        for name, thing, building in _iterate(full_model):
            house = thing.get("parents", [name])[0]
            if mine := of_house.get(house):
                within[mine] |= shapely.dwithin(building.footprint, shapely.points(rows[mine, :2]), WITHIN)
                known[mine] = True
                kept[mine] &= self._lies_in_cell(house, building.footprint, cells)
                if rows[mine[0], 3] > BLOCK:
                    blocks.append(building.footprint)
        return within, blocks, known & kept

    def _lies_in_cell(self, name: str, outline: shapely.Geometry, cells: shapely.STRtree) -> bool:
        """Whether a house lies in a cell, so that its point did: no part of a footprint, which has more places."""
        if self._blocks is None or name.rpartition("-")[2].isdecimal():
            return False
        return bool(len(cells.query(outline, "within")) and shapely.within(outline, self._blocks.inner))

    def _common_walls(self) -> list[tuple[float, float, float]]:
        places = []
        for parts in self._parts.values():
            for k, part in enumerate(parts):
                for other in parts[:k]:
                    common = shapely.intersection(shapely.boundary(part), shapely.boundary(other))
                    if shapely.length(common) > COMMON:
                        x, y = shapely.get_coordinates(common)[0].tolist()
                        places.append((x, y, 0.0))
        return places


def _look_at_cells(blocks: GivenBlocks, zones: Zones, stated: Mapping[str, int] | None) -> list[Fault]:
    """Hold the cells of blocks against zones, blocks against cells, and their number against the record."""
    places = np.array(blocks.cell_places, np.float64).reshape(-1, 3)
    level, shown = places[:, 0].astype(np.int64), np.insert(places[:, 1:], 2, 0.0, axis=1)
    found = find_levels(zones, places[:, 1:])
    found = np.where(level == TOP - 1, np.minimum(found, TOP - 1), found)  # not all cells of a block are at 0A
    away = ~shapely.dwithin(blocks.cells, shapely.points(places[:, 1:]), WITHIN)
    known = set(blocks.cell_places)
    lost = [(x, y, height) for of, height, x, y in blocks.rows.values() if (of, x, y) not in known]
    wrong = [(0.0, 0.0, 0.0)] if stated is not None and stated[CELLS_REPLACED] != len(places) else []
    return [
        *_fault("block-cell", np.array(lost)),
        *_fault("cell-level", shown[level != found]),
        *_fault("cell-point", shown[away]),
        *_fault("cell-count", np.array(wrong)),
    ]


def _look_at_block(blocks: GivenBlocks, values: Mapping[str, Any], building: BuildingRow, level: int) -> str:
    """Hold a block against what the run was given; the kind of fault, if any."""
    given = [_find_block(blocks, str(name)) for name in values.get("members") or [""]]
    known = [row for row in given if row is not None]
    if len(known) < len(given):
        return "block-unknown"
    if any(row[0] != level or max(np.abs(np.subtract(row[2:], values[LOD_POINT]))) > WITHIN for row in known):
        return "block-level"
    heights = [row[1] for row in known]
    height = building.roof - building.ground
    if min(heights) - ROUNDED <= height <= max(heights) + ROUNDED:
        return ""
    walls = shapely.get_coordinates(shapely.segmentize(building.footprint, WALL_SAMPLE))
    raised = building.roof - float(blocks.dtm.sample(walls).max())
    within = blocks.roofs.raised - RAISED <= raised <= blocks.roofs.clearance + RAISED
    return "" if height > max(heights) and within else "block-height"


def _find_block(blocks: GivenBlocks, name: str) -> tuple[int, float, float, float] | None:
    """Find a block by the name of its footprint, which has a number behind it where it is a part of several."""
    while name not in blocks.rows and name.rpartition("-")[2].isdecimal():
        name = name.rpartition("-")[0]
    return blocks.rows.get(name)


def _fault(kind: str, places: NDArray[np.float64]) -> list[Fault]:
    return list(find_faults(kind, places.reshape(len(places), -1)[:, :3], DETAILS[kind])) if len(places) else []


def zone_finer(record: RunRecord) -> list[Finer]:
    """Give the zones that are finer than the rest, those of one size together."""
    return make_finer([(size, place) for _, size, place in record.zones if place], record.sizes.growth)


def check_sizes_of_zones(
    surface: Surface,
    outline: Vertices,
    upright: NDArray[np.float64],
    finer: Sequence[Finer],
    record: RunRecord,
) -> Finding:
    """Measure the facets of a piece's top, and its columns, `upright` (c, 4): place, shortest and longest edge.

    `outline` (k, 2, 2) are the edges of its plan.
    """
    top, asked = surface.marked(Marker.TOP), record.sizes
    middle = surface.corners[top].mean(axis=1)
    size = _sizes_at(middle[:, :2], finer, record)
    share = np.abs(surface.area[top]) / (size**2 / 2)
    rows = np.flatnonzero(size <= asked.mesh_size) if asked.alone else np.empty(0, np.int64)
    open_rows = rows[_are_clear(surface, outline, middle[rows, :2], CLEAR * size[rows])]
    low, high = float(share[open_rows].min(initial=1.0)), float(share.max(initial=0.0))
    small = open_rows[share[open_rows] < LEAST]
    faults = [
        *find_faults("zone-too-coarse", middle[share > MOST], f"{high:.3g} of h^2 / 2; bound: {MOST:g}"),
        *find_faults("zone-too-fine", middle[small], f"{low:.3g} of h^2 / 2; bound: {LEAST:g}"),
    ]
    found = Finding(tuple(faults), {"facets": len(share), "open": len(open_rows)}, {"share": high, "-least": -low})
    return join_findings(found, _check_columns(surface, outline, upright, finer, record))


def _check_columns(
    surface: Surface,
    outline: Vertices,
    upright: NDArray[np.float64],
    finer: Sequence[Finer],
    record: RunRecord,
) -> Finding:
    """Hold vertical edges against the sizes at their places."""
    xy, places, asked = upright[:, :2], np.insert(upright[:, :2], 2, 0.0, axis=1), record.sizes
    size = _sizes_at(xy, finer, record)
    tall = upright[:, 3] / size
    rows = np.flatnonzero(size <= asked.mesh_size) if asked.alone and asked.even else np.empty(0, np.int64)
    open_rows = rows[_are_clear(surface, outline, xy[rows], CLEAR * size[rows])]
    short = upright[open_rows, 2] / size[open_rows]
    high, low = float(tall.max(initial=0.0)), float(short.min(initial=1.0))
    faults = [
        *find_faults("zone-too-tall", places[tall > TALLEST], f"{high:.3g} h; bound: {TALLEST:g}"),
        *find_faults("zone-too-low", places[open_rows[short < LOWEST]], f"{low:.3g} h; bound: {LOWEST:g}"),
    ]
    sums = {"columns": len(xy), "open columns": len(open_rows)}
    return Finding(tuple(faults), sums, {"tall": high, "-low": -low})


def _sizes_at(xy: NDArray[np.float64], finer: Sequence[Finer], record: RunRecord) -> NDArray[np.float64]:
    """Give the sizes that zones and their growth ask for at places (n, 2), infinite where a pad has larger."""
    size = finer_sizes(finer, xy, record.sizes.largest)
    if record.core is not None:
        beyond = ~shapely.intersects_xy(shapely.box(*record.core), xy[:, 0], xy[:, 1])
        size[beyond & (size >= record.sizes.largest)] = np.inf
    return size


def _are_clear(
    surface: Surface, outline: Vertices, xy: NDArray[np.float64], reach: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Tell which places (n, 2) are farther from vertices of houses and from the piece's border than that (m)."""
    houses = surface.corners[surface.marked(Marker.WALL, Marker.ROOF)].reshape(-1, 3)
    tree = shapely.STRtree([*shapely.linestrings(outline), *shapely.points(np.unique(houses[:, :2], axis=0))])
    (near, _), distance = tree.query_nearest(
        shapely.points(xy), max_distance=reach.max(initial=1.0), return_distance=True, all_matches=False
    )
    clear = np.ones(len(xy), np.bool_)
    clear[near] = distance > reach[near]
    return clear


def prove_sizes_of_zones(found: Finding) -> Proof:
    """Tell how large triangles are, over what their zone asks for."""
    claim = (
        f"{int(found.sums['facets'])} facets of the top have the sizes h of zones and of the growth between them: "
        f"{found.largest['share']:.2f} of h^2 / 2 at most, and {-found.largest['-least']:.2f} at least for "
        f"{int(found.sums['open'])} on open ground; vertical edges of {int(found.sums['columns'])} columns are "
        f"{found.largest['tall']:.2f} h at most, and {-found.largest['-low']:.2f} h at least for "
        f"{int(found.sums['open columns'])} on open ground"
    )
    return Proof(claim, found.faults)
