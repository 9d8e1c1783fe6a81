"""What stages read of each other's results: points, terrain, houses and buildings in a box."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.building_points import NEVER_ROOF
from pipeline.citymodel import Footprints
from pipeline.ground_filter import FILTER_REACH, classify_ground
from pipeline.las_points import LEFT_OUT, Triple, cut_units
from pipeline.pointcloud import BUILDING, PointCloud
from pipeline.raster import (
    Dtm,
    NodeWindow,
    grow_window,
    join_dtm,
    node_window,
)
from pipeline.terrain import cut_terrain, join_terrain
from stitch.grid import Bounds
from tiler.cells import select_cells
from tiler.footprint_index import FootprintRows, join_footprints, select_footprints
from tiler.ingest import CELL, crop_cloud
from tiler.stage import Box
from tiler.tables import Buildings, join_buildings, take_buildings, unpack_buildings
from tiler.task import Task

CLASSES = 256  # that a point may have


def grow(box: Box, by: float) -> Box:
    """Grow a box on all sides (m)."""
    return box[0] - by, box[1] - by, box[2] + by, box[3] + by


def clip(box: Box, bounds: Box) -> Box:
    """Cut a box to another one."""
    return max(box[0], bounds[0]), max(box[1], bounds[1]), min(box[2], bounds[2]), min(box[3], bounds[3])


def read_cloud(
    task: Task, box: Box, *, classes: Sequence[int] | None = None, ground_filter: bool = False
) -> PointCloud:
    """Read the points of some classes within a box, from the stage ``points``.

    Parameters
    ----------
    task : Task
        A task that reads that stage.
    box : (xmin, ymin, xmax, ymax)
        Box (m); its borders belong to it.
    classes : sequence of int, optional
        ASPRS classes that are wanted; all by default.
    ground_filter : bool
        Find ground by our own filter.

    Returns
    -------
    PointCloud
        Points that may lie on a roof have class 6: in a file that marks no building at all, these are all that
        are not ground, water, vegetation or noise.
    """
    wide = clip(grow(box, FILTER_REACH), task.context.bounds) if ground_filter else box
    files = [file for name in task.refs["points"] if (file := _find_rows(task, name, wide)) is not None]
    wanted = [_reclassify(classes, marked=file.marks_buildings) for file in files]
    if not ground_filter:
        return _read_files(task, files, box, wanted)[0]
    cloud, count = _read_files(task, files, wide, [np.arange(CLASSES, dtype=np.int16)] * len(files))
    found = classify_ground(cloud, bounds=wide).classification
    ends = np.cumsum([0, *count])
    parts = [table[found[first:end]] for table, (first, end) in zip(wanted, pairwise(ends), strict=True)]
    become = np.concatenate([np.empty(0, np.int16), *parts])
    kept = become != LEFT_OUT
    return crop_cloud(PointCloud(cloud.xyz[kept], become[kept].astype(np.uint8)), box)


def read_terrain(task: Task, box: Box, *, spacing: float, bounds: Bounds) -> Dtm:
    """Read the terrain of a box within the region, from the stage ``terrain``.

    Nodes of tiles that are absent are filled from those in the box: tasks with other boxes see others there.
    """
    window = region_window(box, spacing, bounds)
    return cut_terrain(read_known_terrain(task, box, spacing=spacing, bounds=bounds), window)


def read_known_terrain(task: Task, box: Box, *, spacing: float, bounds: Bounds) -> Dtm:
    """Read the terrain of a box within the region, NaN at nodes of tiles that are absent (see `cut_terrain`).

    Where the task reads the stage ``approach``, it is that of region and pad.
    """
    stage = "approach" if "approach" in task.refs else "terrain"
    window = region_window(box, spacing, bounds)
    return join_terrain(_read_rasters(task, stage, window), window)


def join_rasters(task: Task, stage: str, window: NodeWindow, spacing: float) -> Dtm:
    """Read the nodes of a window from the rasters of a stage; NaN where none has them, there may be no raster."""
    parts = _read_rasters(task, stage, window)
    if not parts:
        return Dtm(np.full((window.ny, window.nx), np.nan), window.i0, window.j0, spacing)
    return join_dtm(parts, window)


def _read_rasters(task: Task, stage: str, window: NodeWindow) -> list[Dtm]:
    """Read what the rasters of a stage have of a window, each that has any."""
    parts = []
    for result in task.read(stage, ()):
        i0, j0, nx, ny, spacing = (result.facts[name] for name in ("i0", "j0", "nx", "ny", "spacing"))
        common = grow_window(NodeWindow(i0, j0, nx, ny), 0, within=window)
        if common.nx and common.ny:
            rows, columns = common.j0 - j0, common.i0 - i0
            z = task.read_window(stage, result.name, "z", (rows, rows + common.ny), (columns, columns + common.nx))
            parts.append(Dtm(z, common.i0, common.j0, spacing))
    return parts


def region_window(box: Box, spacing: float, bounds: Bounds) -> NodeWindow:
    """Nodes of a box, and the next ones around it, within the region."""
    return grow_window(node_window(box, spacing), 0, within=node_window(bounds, spacing))


def read_outlines(task: Task) -> Footprints:
    """Read the footprints that meet the task's box, from the stage ``footprints``."""
    parts = []
    (found,) = task.read("footprints", ())
    if found.facts["n"] > 0:
        names = ("cell_box", "cell_start", "end")
        arrays, _ = task.store.read("footprints", found.name, names=names)

        def rows(array: str, first: int, last: int) -> NDArray[Any]:
            return task.read_rows("footprints", found.name, array, first, last)

        byte, letter = (np.cumsum([0, *rows(size, 0, found.facts["n"])]) for size in ("wkb_size", "id_size"))
        start = np.append(arrays["cell_start"], arrays["end"])
        for first, last in select_footprints(arrays["cell_box"], start, task.box):
            text = rows("id", letter[first], letter[last]).tobytes()
            cuts = (letter[first : last + 1] - letter[first]).tolist()
            ids = np.array([text[a:b].decode() for a, b in pairwise(cuts)], np.str_)
            wkb, height = rows("wkb", byte[first], byte[last]), rows("given_height", first, last)
            parts.append(FootprintRows(wkb, byte[first : last + 1], ids, height, rows("box", first, last)))
    return join_footprints(parts, task.box)


def read_buildings(task: Task, box: Box) -> Buildings:
    """Read the buildings of the simplified city model that meet a box, by ascending id.

    Their layers are those of the stage ``layers``, where the task reads it.
    """
    near, here = [], shapely.box(*box)
    shapely.prepare(here)
    later = task.read("layers") if "layers" in task.refs else iter(())
    layers = {result.name: result.arrays["layers"] for result in later}
    for result in task.read("model"):
        buildings = unpack_buildings(result.arrays)
        buildings = replace(buildings, layers=layers.get(result.name, buildings.layers))
        rows = np.flatnonzero(shapely.intersects(here, buildings.model.polygons))
        near.append(take_buildings(buildings, rows))
    return join_buildings(near)


@dataclass(frozen=True, eq=False)
class _FileRows:
    """Rows of a file to read, as ranges, and what it says of their units and classes."""

    name: str
    ranges: list[tuple[int, int]]
    scale: Triple
    offset: Triple
    marks_buildings: bool


def _find_rows(task: Task, name: str, box: Box) -> _FileRows | None:
    """Find the rows of a file in cells that meet a box; None for a file that could not be read."""
    facts = task.store.attributes("points", name)["facts"]
    if facts["unreadable"]:
        return None
    arrays, _ = task.store.read("points", name, names=("cell", "cell_row", "block", "end"))
    ranges = _ranges_of_blocks(arrays["cell"], np.append(arrays["cell_row"], arrays["end"]), arrays["block"], box)
    return _FileRows(name, ranges, tuple(facts["scale"]), tuple(facts["offset"]), facts["marks_buildings"])


def _reclassify(classes: Sequence[int] | None, *, marked: bool) -> NDArray[np.int16]:
    """Class that each class becomes in a file that marks buildings, or not; `LEFT_OUT` for unwanted ones."""
    become = np.arange(CLASSES, dtype=np.int16)
    if not marked:
        become[~np.isin(become, NEVER_ROOF)] = BUILDING
    if classes is not None:
        become[~np.isin(become, classes)] = LEFT_OUT
    return become


def _read_files(
    task: Task, files: Sequence[_FileRows], box: Box, become: Sequence[NDArray[np.int16]]
) -> tuple[PointCloud, list[int]]:
    """Read points of files, cropped to a box, one file after the other; also their number in each."""
    room = sum(stop - first for file in files for first, stop in file.ranges)
    xyz, classes = np.empty((room, 3)), np.empty(room, np.uint8)
    count: list[int] = []
    for file, table in zip(files, become, strict=True):
        rows = task.read_ranges("points", file.name, ("units", "classification"), file.ranges)
        n = sum(count)
        found = rows["units"], rows["classification"], file.scale, file.offset
        count.append(cut_units(*found, box, table, xyz[n:], classes[n:]))
    return PointCloud(xyz[: sum(count)], classes[: sum(count)]), count


def _ranges_of_blocks(
    cell: NDArray[np.int64], row: NDArray[np.int64], block: NDArray[np.int64], box: Box
) -> list[tuple[int, int]]:
    """Ranges of rows to read, ascending."""
    blocks = pairwise(block.tolist())
    return [
        found
        for first, last in blocks
        for found in select_cells(cell[first:last], row[first : last + 1], box, size=CELL)
    ]
