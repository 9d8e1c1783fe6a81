"""Stages of trees: those of a file once, and the canopy of each tile in columns."""

import numpy as np
import pyproj
from numpy.typing import NDArray

from pipeline.data.classes import GROUND, WATER
from pipeline.data.notes import Note
from pipeline.geometry.inside import find_inside
from pipeline.points_terrain.canopy import Canopy, find_canopy
from pipeline.points_terrain.raster import sample_dtm
from tiler.config.config import Config
from tiler.engine.stage import Facts, Read, Scope, Stage
from tiler.engine.task import Task
from tiler.landcover.tree_files import BASE_COLUMN, scan_trees
from tiler.objects.places import place
from tiler.stages.inputs import own_window
from tiler.stages.pieces import CANOPY
from tiler.stages.readers import grow, put_rows, read_bands, read_known_terrain, read_rows

TREES = "trees"
UNNAMED = (0, 1, 3, 4, 5)  # classes of points that are leaves within a crown of the file
ABOVE = 2.0  # m; above the ground, from which on they are
FOOT = 0.3  # of a tree's height, where a file states no foot of its crown
DENSITY = 1.0  # m2/m3; of trees whose height a file states


def tree_file_stages(config: Config) -> list[Stage]:
    """Stage of the trees of a file; none without one."""
    return [Stage(TREES, Scope.REGION, read_trees, parameters=("trees", "trees_identity"))] if config.trees else []


def canopy_stages(config: Config) -> list[Stage]:
    """Stage of the canopy; none without trees. It is made over the region, not its pad."""
    if not config.has_trees:
        return []
    reads = [Read("points", config.leaf_column), Read("terrain", 2 * (config.dtm_spacing + config.leaf_column))]
    reads += [Read(TREES)] if config.trees else []
    parameters = ("vegetation_classes", "leaf_area_density", "leaf_column", "dtm_spacing", "trees_given")
    return [Stage(CANOPY, Scope.TILE, lay_canopy, tuple(reads), parameters)]


def read_trees(task: Task) -> Facts:
    """Read the trees of the region from their file."""
    crs = pyproj.CRS.from_user_input(task.context.crs)
    facts = put_rows(task, scan_trees(place(task.parameters.trees), crs=crs, bounds=task.context.bounds), "")
    if not facts["n"]:
        task.note(Note("no-trees-in-region", task.parameters.trees))
    return {"n": facts["n"], "counts": {"trees": facts["n"]}}


def lay_canopy(task: Task) -> Facts:
    """Find foot, top and leaf area density of the canopy in the columns of a tile."""
    given, size = task.parameters, task.parameters.leaf_column
    window = own_window(task, spacing=size)
    low = window.i0 * size, window.j0 * size
    box = (*low, low[0] + window.nx * size, low[1] + window.ny * size)
    terrain = read_known_terrain(
        task, grow(box, 2 * given.dtm_spacing), spacing=given.dtm_spacing, bounds=task.context.bounds
    )
    crowns = read_rows(task, box, stage=TREES) if given.trees_given else None
    tall = np.zeros(0, np.bool_) if crowns is None else np.isfinite(crowns.given_height)
    leaves, ground = [np.empty((0, 3))], [np.empty((0, 3))]
    for cloud in read_bands(task, box):
        kept = np.isin(cloud.classification, given.vegetation_classes)
        if crowns is not None and not tall.all():
            other = np.isin(cloud.classification, UNNAMED)
            other &= cloud.xyz[:, 2] > sample_dtm(terrain, cloud.xyz[:, :2]) + ABOVE
            under = np.zeros(len(other), np.bool_)
            under[find_inside(cloud.xyz, crowns.polygons[~tall], among=other)[1]] = True
            kept |= under
        leaves.append(cloud.xyz[kept])
        ground.append(cloud.xyz[np.isin(cloud.classification, (GROUND, WATER))])
    canopy = find_canopy(
        np.concatenate(leaves), np.concatenate(ground), (window.i0, window.j0), (window.ny, window.nx), size=size,
        density=given.leaf_area_density,
    )  # fmt: skip
    if crowns is not None and tall.any():
        x, y = (np.arange(n) + first + 0.5 for n, first in ((window.nx, window.i0), (window.ny, window.j0)))
        centre = np.stack(np.meshgrid(x * size, y * size), axis=-1).reshape(-1, 2)
        foot = crowns.forms[:, BASE_COLUMN]
        foot = np.where(np.isnan(foot), FOOT * crowns.given_height, foot)
        ground_at, density = sample_dtm(terrain, centre), given.leaf_area_density or DENSITY
        _plant(canopy, centre, ground_at, crowns.polygons[tall], crowns.given_height[tall], foot[tall], density)
    task.put_rasters(base=canopy.base, top=canopy.top, density=canopy.density)
    n = int((canopy.density > 0).sum())
    return {"i0": window.i0, "j0": window.j0, "nx": window.nx, "ny": window.ny, "counts": {"columns of leaves": n}}


def _plant(
    canopy: Canopy,
    centre: NDArray[np.float64],
    ground: NDArray[np.float64],
    crowns: NDArray[np.object_],
    height: NDArray[np.float64],
    foot: NDArray[np.float64],
    density: float,
) -> None:
    """Add trees of known height to the columns in whose centre they stand, in place: lowest foot, highest top."""
    tree, column = find_inside(centre, crowns)
    column, tree = column[~np.isnan(ground[column])], tree[~np.isnan(ground[column])]
    for raster, values, merge in (
        (canopy.top, ground[column] + height[tree], np.fmax),
        (canopy.base, ground[column] + np.minimum(foot, height)[tree], np.fmin),
    ):
        merge.at(raster.reshape(-1), column, values)
    flat = canopy.density.reshape(-1)
    flat[column] = np.where(flat[column] > 0, flat[column], np.float32(density))
