"""What the report measures itself, on all tiles or an even choice: cells near seams, points over the mesh."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.columns.columns import expand_cells
from pipeline.data.classes import BUILDING, GROUND, WATER
from pipeline.data.mesh import ColumnMesh, PlaneMesh
from pipeline.plane_mesh.surface_points import NOWHERE, measure_surface
from pipeline.quality.histograms import Histogram, merge_histograms, quality_histograms
from pipeline.quality.quality import measure_cells
from pipeline.quality.residuals import ResidualSums, merge_residuals, sum_residuals
from tiler.engine.stage import Box, Scope, whole_file
from tiler.engine.task import Task
from tiler.pointclouds.ingest import CELL
from tiler.stages.readers import hull, read_cloud
from tiler.store.out_folder import STORE
from tiler.store.results import COLUMN_ARRAYS, unpack_columns
from tiler.store.store import Store

MOST_TILES = 32  # that are looked at
NEAR = 20.0  # m from a seam
MOST_POINTS = 400_000  # of a tile; of more, evenly chosen ones
CLASSES = {BUILDING: "roof", GROUND: "ground", WATER: "water"}
KINDS = (
    "roof on roof",
    "ground on ground",
    "water on ground",
    "roof on ground",
    "ground on roof",
    "water on roof",
)


@dataclass(frozen=True, eq=False)
class Samples:
    """What was measured."""

    #: tiles that were looked at, and all
    tiles: int
    all_tiles: int
    #: points that were looked at, and all that lie on these tiles
    n_points: int
    all_points: int
    #: quality of the cells of air whose triangle's centre is within `NEAR` of a seam; empty where there is none
    near: dict[str, Histogram]
    #: heights of the mesh's lower surface over points, by class and by what the surface is: ``"roof on ground"``
    points: dict[str, ResidualSums]


def measure_samples(directory: Path, bounds: Box, *, ground_filter: bool) -> Samples:
    """Measure cells near seams, and the distance of points to the mesh.

    Parameters
    ----------
    directory : Path
        Folder of a run; its store is read.
    bounds : (xmin, ymin, xmax, ymax)
        Its region (m).
    ground_filter : bool
        Whether ground points were found by our own filter.

    Raises
    ------
    InputError
        If a result is missing or damaged.

    Notes
    -----
    At most `MOST_TILES` tiles are looked at, evenly chosen by name, so the time is bounded; memory is that of one.
    """
    store = Store(directory / STORE)
    names = store.names("columns")
    chosen = [names[k] for k in np.unique(np.linspace(0, len(names) - 1, min(len(names), MOST_TILES)).astype(int))]
    files = _find_files(store)
    near: dict[str, Histogram] = {}
    points: dict[str, ResidualSums] = {}
    n_points = all_points = 0
    for name in chosen:
        arrays, attributes = store.read("columns", name, names=(*COLUMN_ARRAYS, "edge", "edge_missing"))
        mesh, _ = unpack_columns(arrays, attributes["facts"]["order"])
        for key, part in _measure_near(mesh, arrays["edge"][~arrays["edge_missing"]]).items():
            near[key] = merge_histograms([near[key], part]) if key in near else part
        refs: dict[str, tuple[str, ...]] = {"points": ()}
        context = SimpleNamespace(bounds=bounds)
        task = Task("report", name, Scope.TILE, bounds, None, context, "", store, refs, "", directory)
        found, taken, there = _measure_points(mesh, task, files, ground_filter)
        n_points, all_points = n_points + taken, all_points + there
        for key, sums in found.items():
            points[key] = merge_residuals([points[key], sums]) if key in points else sums
    return Samples(len(chosen), len(names), n_points, all_points, near, points)


def _measure_near(mesh: ColumnMesh, edges: NDArray[np.int32]) -> dict[str, Histogram]:
    """Quality of the cells near a tile's seams."""
    if not len(edges):
        return {}
    plane = mesh.plane
    seams = shapely.linestrings(plane.xy[edges])
    centres = shapely.STRtree(shapely.points(plane.xy[plane.triangles].mean(axis=1)))
    rows = np.unique(centres.query(seams, predicate="dwithin", distance=NEAR)[1])
    part = PlaneMesh(plane.xy, plane.triangles[rows], plane.building[rows])
    cells = expand_cells(ColumnMesh(part, mesh.z_start, mesh.z, mesh.bottom[rows], mesh.order, mesh.key))
    return quality_histograms(measure_cells(cells))


def _find_files(store: Store) -> Mapping[str, Box]:
    """Boxes of the cells that each file has points in; those of a share are the file's."""
    boxes: dict[str, Box] = {}
    for name in store.names("points"):
        if store.attributes("points", name)["facts"]["unreadable"]:
            continue
        cell = store.read("points", name, names=("cell",))[0]["cell"]
        if len(cell):
            low, high = cell.min(axis=0) * CELL, (cell.max(axis=0) + 1) * CELL
            box = (float(low[0]), float(low[1]), float(high[0]), float(high[1]))
            boxes[whole_file(name)] = hull(box, boxes.get(whole_file(name)))
    return {name: boxes[whole_file(name)] for name in store.names("points") if whole_file(name) in boxes}


def _measure_points(
    mesh: ColumnMesh, task: Task, files: Mapping[str, Box], ground_filter: bool
) -> tuple[dict[str, ResidualSums], int, int]:
    """Heights of a tile's lower surface over points, the number of these, and of all of which they are chosen.

    Each point is on the mesh of one tile.
    """
    low, high = mesh.plane.xy.min(axis=0).tolist(), mesh.plane.xy.max(axis=0).tolist()
    box = (low[0], low[1], high[0], high[1])
    task.refs["points"] = tuple(
        name
        for name, (west, south, east, north) in sorted(files.items())
        if west <= box[2] and east >= box[0] and south <= box[3] and north >= box[1]
    )
    cloud = read_cloud(task, box, classes=list(CLASSES), ground_filter=ground_filter)
    step = max(1, -(-len(cloud.xyz) // MOST_POINTS))
    xyz, kind = cloud.xyz[::step], cloud.classification[::step]
    triangle, residual = measure_surface(mesh, xyz)
    there = triangle != NOWHERE
    built = mesh.plane.building[triangle] >= 0
    found: dict[str, Any] = {}
    for number, word in CLASSES.items():
        for on_roof, surface in ((False, "ground"), (True, "roof")):
            found[f"{word} on {surface}"] = sum_residuals(residual[there & (kind == number) & (built == on_roof)])
    return found, len(xyz), len(cloud.xyz)
