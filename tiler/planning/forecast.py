"""What a run will take, estimated before it: cells, tasks, memory, disk and hours."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from types import SimpleNamespace

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.columns.spacing import TALLEST
from pipeline.plane_mesh.sizes import SizeField, finer_walls, local_sizes, size_field_around
from stitch.tiling.grid import Bounds, TileGrid, seams_present, tiles_present
from stitch.tiling.smallest_tile import LEAST_TILE
from tiler.config.config import Config
from tiler.config.step_options import expected_levels, refined_areas, size_rule
from tiler.config.zone_levels import find_levels
from tiler.config.zones import LEVELS
from tiler.engine.stage import Scope
from tiler.planning.footprint_sample import FootprintSample
from tiler.planning.own_stages import list_stages, stages_of_pad
from tiler.planning.plan import Survey
from tiler.planning.refinements import read_refinements
from tiler.pointclouds.clouds import CloudHeader, count_shares

# Measured on synthetic cities and Amsterdam with mesh sizes of 4 to 20 m: see docs/plan.md.
TRIANGLES = 3.07  # on open ground, in one squared mesh size
TRIANGLES_AN_OCTAVE = 2.4  # layered: at a wall, for each halving of the mesh size down to the wall's length
FULL_SPACING = 0.785  # mesh sizes; levels above open ground are this far apart where 0.8 is allowed
CELLS_AT_WALLS = 22.0  # adaptive: in each metre of height, for each 1/m that walls are finer than the mesh
CELLS_OF_SLOPES = 1.16  # of those with flat roofs: in Amsterdam
BUILT_HEIGHT = 10.0  # m; height of houses, which no cells fill without solids
CELLS_A_POINT = 5.5
BYTES_A_LIDAR_POINT = 7.2  # of disk
BYTES_A_CELL = 9.5
BYTES_A_NODE = 8.0  # of the terrain grid, three stages together
BYTES_A_HOUSE = 8000.0
BYTES_OF_RECORDS = 40_000.0  # parameters, record and events of a small run
BASE_MEMORY = 300e6  # bytes; of a worker with its libraries
MEMORY_A_CELL = 16.0
MEMORY_A_LIDAR_POINT = 18.0
SECONDS_A_CELL = 0.28e-6
SECONDS_A_LIDAR_POINT = 0.35e-6
SECONDS_A_HOUSE = 1.0e-3
SECONDS_A_TASK = 0.0043
SECONDS_OF_DRIVER = 0.002  # for each task, whatever the number of workers
SECONDS_TO_START = 1.0
MEASURED_ON = "a shared core of a cloud server (x86-64, 2026)"
MEMORY_SHARE = 0.8  # of a worker's share of the machine, beyond which a tile is said not to fit
LARGEST_TILE = 1.5  # tile sizes; side of a tile on the border
LOOKS_A_SIDE = 16  # places along each side of a tile in which graded sizes are looked up
LOOKS_OF_FINER = 500  # the same where walls or areas are finer
MOST_LOOKS = 250_000  # in all tiles; fewer a tile where there are many, but four
TILE_STEP = 50.0  # m; tile sizes that are proposed are multiples of it


@dataclass(frozen=True)
class Tasks:
    """Tasks of one stage: its name, its scope, and how many."""

    stage: str
    scope: Scope
    number: int


@dataclass(frozen=True, eq=False)
class TileLoads:
    """What each tile that is present has, column by column."""

    index: NDArray[np.int64]  # (n, 2): column and row in the CRS
    area: NDArray[np.float64]  # (n,): area (m2)
    # (n,): their numbers
    lidar_points: NDArray[np.float64]
    footprints: NDArray[np.float64]
    cells: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.index)


@dataclass(frozen=True, eq=False)
class Forecast:
    """What a run will take."""

    loads: TileLoads
    # In the order of the stages; one later round of simplification is counted, and there may be more.
    tasks: list[Tasks]
    disk: float  # of the output folder (bytes)
    tile_memory: NDArray[np.float64]  # (n,): peak of a worker that does a tile (bytes)
    work: float  # seconds of one core for all tasks
    driver: float  # seconds that no number of workers shortens
    warnings: list[str]  # what may go wrong, and the next move
    # Cells by level of detail of the zone that they lie in; empty without zones.
    cells_by_level: dict[str, float] = field(default_factory=dict)

    def seconds(self, workers: int) -> float:
        """Estimate the wall time with some workers, a core each (s)."""
        return SECONDS_TO_START + self.driver + self.work / max(1, min(workers, len(self.loads)))


def forecast_run(
    survey: Survey, sample: FootprintSample | None, config: Config, *, memory: float | None = None
) -> Forecast:
    """Estimate what a run will take, from a survey of its headers and a sample of its footprints, if any.

    `memory` is that of the machine (bytes), shared by the workers; without it nothing is said of it.

    Notes
    -----
    Cells are those of open ground, in proportion to volume over the cubed mesh size, and those at walls that are
    shorter than the mesh size, in proportion to height over wall length. LiDAR points lie evenly in the box of
    their file, footprints of an incomplete sample evenly over the tiles. Constants are means over a few measured
    runs; cells were within a factor of 1.5 on all of them, seconds within 2 (medians).
    """
    loads = _loads(survey, sample, config)
    tasks = count_tasks(survey, config)
    n_tasks = sum(entry.number for entry in tasks)
    tile_memory = _tile_memory(loads)
    nodes, points, houses = (
        loads.area.sum() / config.dtm_spacing**2,
        loads.lidar_points.sum(),
        loads.footprints.sum(),
    )
    cells = loads.cells.sum()
    disk = BYTES_A_LIDAR_POINT * points + BYTES_A_CELL * cells + BYTES_A_NODE * nodes + BYTES_A_HOUSE * houses
    disk += BYTES_OF_RECORDS
    work = SECONDS_A_CELL * cells + SECONDS_A_LIDAR_POINT * points + SECONDS_A_HOUSE * houses
    work += SECONDS_A_TASK * n_tasks
    warnings = [] if memory is None else _memory_warnings(tile_memory, loads.area, config, memory)
    driver, by_level = SECONDS_OF_DRIVER * n_tasks, _by_level(survey, sample, config, loads)
    return Forecast(loads, tasks, float(disk), tile_memory, float(work), driver, warnings, by_level)


def count_tasks(survey: Survey, config: Config) -> list[Tasks]:
    """Count the tasks of each stage of a run whose clusters are joined in one later round at most."""
    wide = stages_of_pad(config)
    core, both = (
        _count_items(grid, sum(map(count_shares, survey.clouds))) for grid in (survey.grid, survey.meshed)
    )
    return [
        Tasks(stage.name, stage.scope, (both if stage.name in wide else core)[stage.scope])
        for stage in list_stages(config)
    ]


def _count_items(grid: TileGrid, n_files: int) -> dict[Scope, int]:
    seams = seams_present(grid)
    return {
        Scope.FILE: n_files,
        Scope.TILE: int(tiles_present(grid).sum()),
        Scope.SEAM: int(seams[0].sum() + seams[1].sum()),
        Scope.REGION: 1,
    }


def spread_points(grid: TileGrid, clouds: Sequence[CloudHeader], core: Bounds) -> NDArray[np.float64]:
    """Deal the LiDAR points of files out to tiles, (nx, ny), as if they lay evenly in the box of their header.

    Points beyond the region without its pad, `core`, are not counted.
    """
    x, y = grid.lines
    points = np.zeros((len(x) - 1, len(y) - 1))
    for cloud in clouds:
        columns, across = _shares(x, (core[0], core[2]), cloud.bounds[0], cloud.bounds[2])
        rows, along = _shares(y, (core[1], core[3]), cloud.bounds[1], cloud.bounds[3])
        points[columns, rows] += cloud.n_points * np.multiply.outer(across, along)
    return points


def _shares(
    lines: NDArray[np.float64], core: tuple[float, float], low: float, high: float
) -> tuple[slice, NDArray[np.float64]]:
    """Which intervals between lines an interval meets, and the share of it within another one in each."""
    first = max(int(np.searchsorted(lines, low, side="right")) - 1, 0)
    last = max(min(int(np.searchsorted(lines, high, side="left")), len(lines) - 1), first + 1)
    ends = np.clip(np.clip(lines[first : last + 1], *core), low, high)
    shares = np.diff(ends) / (high - low) if high > low else np.full(last - first, 1 / (last - first))
    return slice(first, last), shares


def _loads(survey: Survey, sample: FootprintSample | None, config: Config) -> TileLoads:
    grid, there = survey.meshed, tiles_present(survey.meshed)
    area = np.multiply.outer(*(np.diff(axis) for axis in grid.lines))
    h, height = config.mesh_size, config.expected_height
    houses, built, detail, octaves = (np.zeros_like(area) for _ in range(4))
    if sample is not None and len(sample):
        inner = _core_area(grid, survey.region.bounds)
        houses, built, detail, octaves = _house_sums(grid, sample, np.where(there, inner, 0.0))
    thin = _thinning(survey, sample, config)
    in_air = 0.0 if config.solids and config.mesher == "layered" else min(BUILT_HEIGHT, height)
    volume = np.maximum(area * height - built * in_air, 0.0)
    if config.mesher == "adaptive":
        spacing = h * FULL_SPACING / 0.8 * min(config.most_spacing, 1.0)
        closer = expected_levels(config, spacing) * spacing / height
        cells = 3 * TRIANGLES * volume * thin / (h**2 * spacing) * closer + CELLS_AT_WALLS * height * detail
        if config.has_sloped_roofs:
            cells = CELLS_OF_SLOPES * cells
    else:
        layers = max(round(expected_levels(config, config.layer_height_or_default)), 1)
        triangles = TRIANGLES * area * thin / h**2 + TRIANGLES_AN_OCTAVE * octaves
        cells = 3 * layers * triangles * volume / (area * height)
    if config.solids and config.mesher == "adaptive":
        solid = built * thin * min(BUILT_HEIGHT, height)
        inside = 3 * TRIANGLES * solid / (h**2 * spacing) * closer + CELLS_AT_WALLS / 2 * BUILT_HEIGHT * detail
        cells = cells + (CELLS_OF_SLOPES * inside if config.has_sloped_roofs else inside)
    if config.underground:
        spacing = h * FULL_SPACING / 0.8 * min(config.most_spacing, 1.0)
        open_ground = 3 * TRIANGLES * area / (h**2 * spacing)
        cells = cells + config.underground * (open_ground + CELLS_AT_WALLS * detail)
    index = np.argwhere(there) + grid.first
    points = spread_points(grid, survey.clouds, survey.region.bounds)
    return TileLoads(index, *(values[there] for values in (area, points, houses, cells)))


def _thinning(survey: Survey, sample: FootprintSample | None, config: Config) -> NDArray[np.float64]:
    """How many cells open ground has with graded or finer sizes, of those without: float64 (nx, ny), by tile."""
    x, y = survey.meshed.lines
    found = _look_up(survey, sample, config)
    if found is None:
        return np.ones((len(x) - 1, len(y) - 1))
    mean: NDArray[np.float64] = found[1].mean(axis=(1, 3))
    return mean


def _look_up(
    survey: Survey, sample: FootprintSample | None, config: Config
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Look sizes up in some places of each tile; None where they are the same everywhere.

    Gives the places (m), (nx, side, ny, side, 2), and how many cells open ground has there, (nx, side, ny, side),
    of those without graded or finer sizes. Footprints that are not known are taken to be everywhere.
    """
    x, y = survey.meshed.lines
    shape = len(x) - 1, len(y) - 1
    known = sample.complete if sample is not None else not config.has_buildings
    largest = 0.0 if config.open_size and not known else config.graded_size
    if not largest and not config.refined:
        return None
    most = LOOKS_OF_FINER if config.refined else LOOKS_A_SIDE
    side = int(np.clip(np.sqrt(MOST_LOOKS / (shape[0] * shape[1])), 2, most))
    places = (np.arange(side) + 0.5) / side
    columns, rows = ((axis[:-1, None] + np.diff(axis)[:, None] * places).ravel() for axis in (x, y))
    xy = np.stack(np.meshgrid(columns, rows, indexing="ij"), axis=-1).reshape(-1, 2)
    rule = size_rule(config, largest)
    houses = sample.polygons if sample is not None else np.empty(0, np.object_)
    if config.open_size or not largest:
        sizes = SizeField(rule, shapely.STRtree(houses))
    else:
        sizes = size_field_around(survey.region.bounds, rule)
    refinements = read_refinements(config, survey.region, survey.zones)
    areas = refined_areas(SimpleNamespace(**vars(config), refinements=refinements))
    sizes = replace(sizes, finer=(*areas, *finer_walls(shapely.STRtree(shapely.boundary(houses)), rule)))
    size = local_sizes(sizes, xy, mesh_size=config.mesh_size)
    share = (config.mesh_size / size) ** 2
    if config.mesher == "adaptive":
        upright = local_sizes(sizes, xy, mesh_size=config.mesh_size, upright=True)
        share *= config.mesh_size / np.minimum(upright, TALLEST * size)
    grid = shape[0], side, shape[1], side
    return xy.reshape(*grid, 2), share.reshape(grid)


def _by_level(
    survey: Survey, sample: FootprintSample | None, config: Config, loads: TileLoads
) -> dict[str, float]:
    """Cells by level of detail of the zone that they lie in; nothing without zones."""
    found = _look_up(survey, sample, config) if config.zoned else None
    if found is None:
        return {}
    xy, share = found
    level = find_levels(survey.zones, xy.reshape(-1, 2)).reshape(share.shape)
    column, row = (loads.index - survey.meshed.first).T
    cells = loads.cells / share.sum(axis=(1, 3))[column, row]
    parts = ((name, (share * (level == k)).sum(axis=(1, 3))[column, row]) for k, name in enumerate(LEVELS))
    return {name: float((cells * part).sum()) for name, part in parts if part.any()}


def _core_area(grid: TileGrid, core: Bounds) -> NDArray[np.float64]:
    """Area of each tile within the region without its pad (m2): float64 (nx, ny)."""
    across, along = (np.diff(np.clip(axis, core[k], core[k + 2])) for k, axis in enumerate(grid.lines))
    area: NDArray[np.float64] = np.multiply.outer(across, along)
    return area


def _house_sums(
    grid: TileGrid, sample: FootprintSample, area: NDArray[np.float64]
) -> tuple[NDArray[np.float64], ...]:
    """Sum number, area, detail and octaves of footprints over each tile, (nx, ny) each."""
    kinds: tuple[NDArray[np.float64], ...] = (np.ones(len(sample)), sample.area, sample.detail, sample.octaves)
    if not sample.complete:
        return tuple(values.mean() * sample.total * area / area.sum() for values in kinds)
    centre = (sample.box[:, :2] + sample.box[:, 2:]) / 2
    column, row = (
        np.clip(np.searchsorted(axis, centre[:, k], side="right") - 1, 0, len(axis) - 2)
        for k, axis in enumerate(grid.lines)
    )
    flat = column * area.shape[1] + row
    sums = (np.bincount(flat, values, minlength=area.size).astype(np.float64) for values in kinds)
    return tuple(values.reshape(area.shape) for values in sums)


def _memory_warnings(
    tile_memory: NDArray[np.float64], area: NDArray[np.float64], config: Config, memory: float
) -> list[str]:
    """Name which tiles do not fit into a worker's share of memory, and which tile size would."""
    workers = max(config.workers, 1)
    share = config.memory_limit * 2**30 if config.memory_limit and config.workers else memory / workers
    limit = MEMORY_SHARE * share
    heavy = int((tile_memory > limit).sum())
    if not heavy:
        return []
    words = (
        f"{heavy} of {len(tile_memory)} tiles may not fit into memory: up to {tile_memory.max() / 2**30:.1f} GiB"
    )
    words += f" a worker > {limit / 2**30:.1f} GiB, 80 % of the {share / 2**30:.1f} GiB that it has"
    per_area = ((tile_memory - BASE_MEMORY) / area).max()  # tiles on the border may be larger than others
    side = np.sqrt(max(limit - BASE_MEMORY, 0.0) / per_area) / LARGEST_TILE
    size = np.floor(side / TILE_STEP) * TILE_STEP
    if size >= max(LEAST_TILE * config.largest_size, TILE_STEP):
        return [f"{words}; give --tile-size {size:g}, or fewer --workers"]
    return [f"{words}; give fewer --workers with more memory each, or a larger --mesh-size"]


def warn_of_memory(survey: Survey, config: Config, *, memory: float) -> list[str]:
    """Warn before a run which tiles may not fit into memory, from headers alone; see `forecast_run`.

    Footprints are not looked at: what is refined at walls comes on top.
    """
    loads = _loads(survey, None, config)
    return _memory_warnings(_tile_memory(loads), loads.area, config, memory)


def _tile_memory(loads: TileLoads) -> NDArray[np.float64]:
    return BASE_MEMORY + MEMORY_A_CELL * loads.cells + MEMORY_A_LIDAR_POINT * loads.lidar_points
