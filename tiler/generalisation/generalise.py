"""`citystitch generalise`: buildings and barriers in, cells and levels out, tile by tile."""

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory, TemporaryFile
from typing import Protocol, TypeVar

import numpy as np
import pyproj
import shapely
from numpy.typing import NDArray

from pipeline.data.errors import ConfigError, GeometryError, InputError
from pipeline.generalisation.barriers import GRID, deal_segments, explode_lines, split_at_grid
from tiler.convert.convert import refuse_output
from tiler.executors.in_order import map_in_order
from tiler.footprints.building_parts import mend_polygons
from tiler.formats.gpkg import fixed_time
from tiler.generalisation.barrier_files import scan_geometries
from tiler.generalisation.buildings import open_buildings
from tiler.generalisation.city_json import HierarchyWriter
from tiler.generalisation.gpkg_layers import LayerWriter
from tiler.generalisation.options import Asked, Inputs
from tiler.generalisation.region_cells import deal_round, join_across, join_small
from tiler.generalisation.rows import LEVELS
from tiler.generalisation.shards import Numbers, Shards, Tile, by_tile
from tiler.generalisation.summary import LevelSum, Told, describe_levels, table_lines
from tiler.generalisation.tile_cells import Work, meet_tiles, pair_buildings, part_tile, sort_buildings
from tiler.generalisation.tile_levels import make_cells, make_levels
from tiler.georeference.crs import box_words, crs_text
from tiler.mesh_files.threads import check_workers
from tiler.store.atomic import replacing
from tiler.vectors.features import to_objects
from tiler.vectors.gdal_layer import list_some
from tiler.vectors.layers import split_layer

MOST_TILES = 1_000_000
ADJACENT = 1.0  # m; a wider gap of adjacent buildings is told with the numbers
Result = TypeVar("Result")


class Each(Protocol):
    """Does a step for each of some tiles, results in their order."""

    def __call__(self, step: Callable[[Work], Result], tiles: Sequence[Tile], /) -> Iterator[Result]:
        """Do it."""


@dataclass(frozen=True)
class Outputs:
    """Files that a generalisation writes: all levels as GeoPackage, and beside it CityJSON and the numbers."""

    gpkg: Path

    @property
    def city_json(self) -> Path:
        """The hierarchy as CityJSON."""
        return self.gpkg.with_suffix(".city.json")

    @property
    def numbers(self) -> Path:
        """The table of levels and what was told, as JSON."""
        return self.gpkg.with_suffix(".levels.json")

    @property
    def all(self) -> tuple[Path, ...]:
        """List them."""
        return self.gpkg, self.city_json, self.numbers


def generalise(
    inputs: Inputs, output: Path, asked: Asked, *, workers: int = 0, overwrite: bool = False
) -> list[str]:
    """Make cells, LoD0C, LoD0B and LoD0A of buildings; gives the table of levels and what must be known.

    Parameters
    ----------
    inputs, asked
        Buildings, barriers and other objects; options.
    output : Path
        GeoPackage to write; CityJSON and numbers go beside it. Each file appears whole or not at all.
    workers : int
        Processes; 0 for this one. The bytes are the same.
    overwrite : bool
        Whether files that exist are replaced.

    Raises
    ------
    ConfigError
        If options do not go together, or a file exists.
    InputError
        If a file cannot be read, or there is no building.
    OutputError
        If a file cannot be written.

    Notes
    -----
    The inputs are read once, and dealt out to tiles in a temporary folder; then each step works on a tile, or on
    the cells that a tile owns: those whose first piece lies in it. Memory holds a tile with its neighbours, the
    largest cell, the numbers of some columns of tiles, and some kB for each tile.
    """
    files = Outputs(output)
    if output.suffix != ".gpkg":
        raise ConfigError(f"{output}: a GeoPackage ends with .gpkg; rename --output")
    if not output.parent.is_dir():
        raise ConfigError(f"{output.parent}: no such folder; make it, or give another --output")
    check_workers(workers)
    lines = [*inputs.roads, *inputs.railways, *inputs.water, *inputs.others]
    given = [
        *inputs.models,
        *filter(None, [inputs.footprints]),
        *(Path(split_layer(str(one))[0]) for one in lines),
    ]
    for path in files.all:
        refuse_output(path, given, overwrite=overwrite)
    told = Told()
    with TemporaryDirectory(prefix="citystitch-") as folder:
        shards = Shards(Path(folder), asked.tile_size)
        crs, rim = _deal_inputs(inputs, asked, shards, told)
        work = Work(shards, (0, 0), asked, axis=not inputs.roads, rim=shapely.to_wkb(rim))
        if work.axis:
            told.say("no roads: streets are the medial axis of the open space between buildings")

        def each(step: Callable[[Work], Result], tiles: Sequence[Tile], /) -> Iterator[Result]:
            return map_in_order(step, (replace(work, tile=tile) for tile in tiles), workers)

        if (n := shards.count(rim.bounds)) > MOST_TILES:
            raise InputError(
                f"the layers reach over {n:,} tiles of {asked.tile_size:g} m, more than {MOST_TILES:,}: "
                f"{box_words(rim.bounds)}; is a coordinate wrong? --bounds takes a part, --tile-size larger tiles"
            )
        tiles = [t for t in shards.covered(rim.bounds) if rim.intersects(shapely.box(*shards.box(t)))]
        owners = _make_levels(_make_cells(tiles, work, each, told), work, each)
        levels = _write(files, owners, shards, crs, told)
    with replacing(files.numbers) as part:
        numbers: dict[str, object] = {"levels": levels, "counts": told.known(), "notes": told.said}
        if asked.adjacent > ADJACENT:
            numbers["adjacent"] = asked.adjacent  # by which `check` may find outlines moved
        part.write_text(json.dumps(numbers, indent=1, ensure_ascii=False) + "\n")
    return [*table_lines(levels), *told.lines()]


def _deal_inputs(inputs: Inputs, asked: Asked, shards: Shards, told: Told) -> tuple[pyproj.CRS, shapely.Polygon]:
    """Deal buildings, barriers and other objects out to tiles; gives the CRS and the rim of the region."""
    hull, missing = shapely.MultiPoint(), set(asked.landmarks.ids)
    with open_buildings(inputs, asked, told) as source:
        for batch in source.batches:
            if not len(batch):
                continue
            hull = _hull(hull, batch.outlines)
            middle = shapely.get_coordinates(shapely.point_on_surface(batch.outlines))
            for tile, rows in by_tile(np.floor(middle / shards.size).astype(np.int64)):
                shards.append("dealt", tile, batch.take(rows))
            told.counts["landmarks"] += int(batch.landmark.sum())
            missing.difference_update(batch.ids.tolist())
        crs = source.crs
    if hull.is_empty:
        raise InputError(f"{inputs.footprints or inputs.models[0]}: no building in the region; give other files")
    if missing:
        told.say(f"--landmarks: {len(missing)} of no building: {list_some(sorted(missing))}")
    around = hull.bounds
    read = partial(scan_geometries, crs=crs, around=around, bounds=inputs.bounds, told=told)
    for option, is_barrier, cuts in (
        ("roads", True, True),
        ("railways", True, False),
        ("water", True, True),
        ("others", False, True),
    ):
        for path in getattr(inputs, option):
            n = 0
            for geometry in read(str(path), f"--{option}"):
                n += len(geometry)
                hull = _hull(hull, geometry)
                if is_barrier:
                    _deal_barriers(geometry, shards)
                if cuts:
                    _deal_others(geometry, shards)
            if not n:
                told.say(f"{path.name}: has nothing in the region")
    rim = shapely.set_precision(hull, GRID)
    _deal_barriers(np.array([rim], object), shards)
    return crs, rim


def _hull(hull: shapely.Geometry, geometry: NDArray[np.object_]) -> shapely.Geometry:
    return shapely.convex_hull(shapely.geometrycollections([hull, *shapely.convex_hull(geometry)]))


def _deal_barriers(geometry: NDArray[np.object_], shards: Shards) -> None:
    segments = split_at_grid(explode_lines(geometry), shards.size)
    for tile, own in deal_segments(segments, shards.size).items():
        shards.append("segments", tile, own)


def _deal_others(geometry: NDArray[np.object_], shards: Shards) -> None:
    """Deal areas out to the tiles that they touch, cut at their borders."""
    parts = shapely.get_parts(shapely.get_parts(geometry))
    parts = parts[shapely.get_type_id(parts) == shapely.GeometryType.POLYGON]
    parts = mend_polygons(parts)
    for part in parts[shapely.area(parts) > 0]:
        tiles = list(shards.covered(part.bounds))
        for tile in tiles:
            own = part if len(tiles) == 1 else shapely.intersection(part, shapely.box(*shards.box(tile)))
            own = shapely.set_precision(own, GRID)
            if own.area > 0:
                shards.append("others", tile, to_objects([own]))


def _make_cells(tiles: Sequence[Tile], work: Work, each: Each, told: Told) -> Numbers:
    """Make the pieces of all tiles, and cells of them; gives the numbers of the pieces."""
    shards = work.shards
    own = shards.tiles("dealt")
    counts, copies = np.array(list(each(sort_buildings, own))).T
    told.counts["buildings with the outline of another one, left out"] += int(copies.sum())
    if work.axis:
        numbers = Numbers.count(own, counts)
        shards.append("buildings-numbers", (0, 0), numbers)
        join_across(numbers, each(pair_buildings, own), shards, "blocks")
    numbers = Numbers.count(tiles, each(part_tile, tiles))
    shards.append("pieces-numbers", (0, 0), numbers)
    join_across(numbers, each(meet_tiles, tiles), shards, "names-0")
    deal_round(numbers, shards, 0)
    told.counts["fragments joined to a neighbour"] = join_small(numbers, shards, 1, work.asked.fragment)
    deal_round(numbers, shards, 1)
    return numbers


def _make_levels(numbers: Numbers, work: Work, each: Each) -> list[Tile]:
    """Make all levels tile by tile; gives the tiles that own cells."""
    shards = work.shards
    owners = shards.tiles("rows-2")
    for _ in each(make_cells, owners):
        pass
    join_small(numbers, shards, 2, work.asked.most_area, alike=True)
    for tile in owners:
        cells, groups = shards.read("names-2", tile)[0]
        use = shards.read("use", tile)[0][1]
        for owner, rows in by_tile(numbers.places(groups[use])[0]):
            shards.append("groups", owner, (groups[use][rows], cells[use][rows]))
        for outline in shards.read("standing", tile)[0]:
            for near in shards.covered(outline.bounds):
                shards.append("cuts", near, to_objects([outline]))
    for _ in each(make_levels, owners):
        pass
    return owners


def _write(
    files: Outputs, owners: Sequence[Tile], shards: Shards, crs: pyproj.CRS, told: Told
) -> dict[str, dict[str, object]]:
    sums = {level: LevelSum() for level in LEVELS}
    origin = [float(min(tile[axis] for tile in owners) * shards.size) for axis in (0, 1)]
    with replacing(files.gpkg) as gpkg, replacing(files.city_json) as city, fixed_time():
        layers = LayerWriter(gpkg, crs_text(crs))
        with city.open("wb") as file, TemporaryFile() as vertex_file:
            hierarchy = HierarchyWriter(file, vertex_file, crs, origin)
            for tile in owners:
                ((cells, rows, children),) = shards.read("rows", tile)
                layers.add(cells, rows)
                hierarchy.add(rows, children)
                for level, found in sums.items():
                    found.add(rows[level])
                told.counts["cells"] += len(cells.id)
                told.counts["cells of land use Building"] += int(cells.use.sum())
            hierarchy.finish()
        layers.finish()
        told.counts["objects without a solid in CityJSON"] += hierarchy.without_solid
        n = sums[LEVELS[0]].members
        for level, found in sums.items():
            if found.members != n:
                raise GeometryError(f"{level}: stands for {found.members} of {n} buildings; report this")
    return describe_levels(sums)
