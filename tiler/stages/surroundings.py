"""What counts for a seam or a tile that is meshed: how far around, and the buildings and terrain there."""

from dataclasses import replace
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.columns.adaptive import AdaptiveOptions
from pipeline.columns.layered import terrain_reach
from pipeline.columns.spacing import top_reach
from pipeline.plane_mesh.sizes import SizeField, finer_walls, size_field, size_field_around
from pipeline.points_terrain.raster import Dtm
from pipeline.points_terrain.terrain import cut_terrain
from stitch.seams.tiles import sizes_halo, tile_halo
from stitch.tiling.grid import Key, nominal_corner
from stitch.tiling.land_cover import LandCover, cover_edges
from stitch.tiling.strips import NO_EDGES
from stitch.tiling.walls import LONGEST_PIECE, cut_walls
from tiler.citymodels.tables import NearBuildings, unpack_polygons
from tiler.config.config import Config
from tiler.config.domain_height import Domain
from tiler.config.step_options import is_covered, is_refined, mesh_options, refined_areas, size_rule
from tiler.engine.run_context import region_around
from tiler.engine.task import Task
from tiler.stages.readers import grow, read_buildings, read_known_terrain, region_window

# Stages that have the land cover around each tile, and the terrain with level water.
COVERED, LEVELLED = "covered", "levelled"


def terrain_halo(given: Any, domain: Domain | None = None) -> float:
    """How far beyond the buildings that count terrain does (m)."""
    options = mesh_options(given, domain)
    if isinstance(options, AdaptiveOptions):
        return top_reach(options.domain_height) + 2 * float(given.dtm_spacing)
    return terrain_reach(options) + 2 * float(given.dtm_spacing)


def halos(given: Any, largest: float, *, around_walls: bool) -> tuple[float, float]:
    """How far beyond a box terrain is sampled, and buildings count (m); the largest size is 0 without grading."""
    more = cut_reach(given) if is_covered(given) else 0.0
    if not largest and not is_refined(given):
        halo = tile_halo(given.tile_size_or_default, given.mesh_size)
        return halo, halo + more
    rule = size_rule(given, largest)
    halo = tile_halo(given.tile_size_or_default, given.mesh_size, rule)
    return halo, sizes_halo(given.tile_size_or_default, rule, around_walls=around_walls) + more


def cut_reach(given: Any) -> float:
    """How far from an edge of land cover walls and other edges decide what stays of it (m)."""
    return float(LONGEST_PIECE * given.mesh_size + 2 * given.clearance)


def cover_reach(config: Config) -> float:
    """How far around a tile polygons of land cover count for it and its seams (m)."""
    _, see = halos(config, config.graded_size, around_walls=config.open_size > 0)
    return see + cut_reach(config)


def _halos_of(task: Task) -> tuple[float, float]:
    """How far beyond the box of a task terrain is sampled, and buildings count (m)."""
    largest = task.context.open_size
    return halos(task.parameters, largest, around_walls=largest > 0 and task.parameters.open_size > 0)


def find_walls(polygons: NDArray[np.object_], task: Task) -> tuple[NDArray[np.float64], SizeField | None]:
    """Walls in pieces, and the sizes around them, or with a pad alone around the region.

    The sizes are None where they are the same everywhere.
    """
    given, largest = task.parameters, task.context.open_size
    if not largest and not is_refined(given):
        return cut_walls(polygons, mesh_size=given.mesh_size), None
    rule, finer = size_rule(given, largest), refined_areas(given)
    walls = cut_walls(polygons, mesh_size=rule.at_walls, finer=finer)
    if given.open_size or not largest:
        return walls, size_field(walls, rule, finer)
    around = shapely.STRtree(shapely.linestrings(walls))
    field = size_field_around(given.core_bounds, rule)
    return walls, replace(field, finer=(*finer, *finer_walls(around, rule)))


def read_cover(task: Task, walls: NDArray[np.float64]) -> tuple[LandCover | None, NDArray[np.float64]]:
    """Read the land cover around a tile or a seam, if there is any, and find the edges between patches."""
    given = task.parameters
    if not is_covered(given):
        return None, NO_EDGES
    _, see = _halos_of(task)
    box = shapely.box(*grow(task.box, see + cut_reach(given)))
    results = [result.arrays for result in task.read(COVERED)]
    ids, kept = rows_of_cover(np.concatenate([arrays["ids"] for arrays in results]))
    polygons = np.concatenate([unpack_polygons(arrays, "outline") for arrays in results])[kept]
    near = shapely.intersects(polygons, box)
    core = given.get("core_bounds", None)
    cover = LandCover(polygons[near], patch_of_ids(ids[near]), core, len(given.cover_table) + 1)
    within = region_around(task.context.grid, task.box)
    return cover, cover_edges(cover, walls, within, mesh_size=given.mesh_size, clearance=given.clearance)


def rows_of_cover(ids: NDArray[np.str_]) -> tuple[NDArray[np.str_], NDArray[np.int64]]:
    """Ids of land cover, each once and sorted, and the first row of each."""
    return np.unique(ids, return_index=True)


def patch_of_ids(ids: NDArray[np.str_]) -> NDArray[np.int64]:
    """Patches of the ground by the ids of polygons, which begin with three digits.

    Examples
    --------
    >>> patch_of_ids(np.array(["002-a", "010-b"])).tolist()
    [2, 10]
    """
    return np.array([int(name[:3]) for name in ids.tolist()], np.int64)


def read_surroundings(task: Task) -> tuple[NearBuildings, Dtm]:
    """Read what counts for a tile or a seam; the terrain is NaN at nodes of tiles that are absent."""
    given = task.parameters
    halo, see = _halos_of(task)
    buildings = read_buildings(task, grow(task.box, see))
    reach = grow(task.box, halo + terrain_halo(given))
    return buildings, read_known_terrain(task, reach, spacing=given.dtm_spacing, bounds=task.context.bounds)


def terrain_around(key: Key, dtm: Dtm, task: Task) -> Dtm:
    """Terrain that counts for a corner: the same nodes in all tasks that compute its column.

    All of them read `terrain_halo` and more around it. The window ends two nodes short of that: the closest nodes
    beyond a tile towards an absent one are the tile's, and a task may see them without reading that tile.
    """
    given = task.parameters
    x, y = nominal_corner(task.context.grid, key)
    halo, _ = _halos_of(task)
    reach = halo + terrain_halo(given) - 2 * given.dtm_spacing
    return cut_terrain(dtm, region_window(grow((x, y, x, y), reach), given.dtm_spacing, task.context.bounds))
