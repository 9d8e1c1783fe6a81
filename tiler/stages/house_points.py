"""Points on and around the houses of a tile, and roofs that the cloud does not mark (step 1.5)."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pipeline.city_model.city import find_places
from pipeline.city_model.unmarked_roofs import (
    MAY_BE_ROOF,
    PLANTS,
    UnmarkedRoofs,
    are_roofs,
    find_bare,
    locate_unmarked,
)
from pipeline.data.citymodel import Footprints
from pipeline.data.classes import BUILDING
from pipeline.data.notes import Note
from pipeline.data.pointcloud import PointCloud
from pipeline.geometry.inside import cover_polygons
from pipeline.points_terrain.raster import Dtm
from pipeline.roofs.roof_points import RoofPoints, add_roof_points, keep_roof_points
from tiler.engine.stage import Box
from tiler.engine.task import Task
from tiler.stages.readers import extent_of, grow, read_cloud

Rows = NDArray[np.int64]


def points_near(
    task: Task, extent: Box | None, margin: float, areas: NDArray[np.object_], classes: Sequence[int]
) -> PointCloud:
    """Points of some classes in areas, and some near them, as far as a margin around an extent, if any."""
    if extent is None:
        return PointCloud(np.empty((0, 3)), np.empty(0, np.uint8))
    with task.step("1.1 points of houses"):
        return read_cloud(
            task,
            grow(extent, margin),
            classes=classes,
            ground_filter=task.parameters.ground_filter,
            cover=cover_polygons(areas),
        )


def add_unmarked(
    task: Task,
    footprints: Footprints,
    roofs: RoofPoints,
    cloud: PointCloud,
    terrain: Dtm,
    *,
    told: NDArray[np.bool_],
) -> tuple[RoofPoints, Rows]:
    """Give the houses that the cloud does not mark the points of their roofs from other classes, and note them.

    Parameters
    ----------
    task : Task
        A task that reads the stage ``points``.
    footprints : Footprints
        The tile's houses.
    roofs : RoofPoints
        Their points of class 6.
    cloud : PointCloud
        Points that include those of ground and water inside them.
    terrain : Dtm
        Terrain without empty nodes.
    told : bool, (h,)
        Houses that get none: uploads tell their roofs.

    Returns
    -------
    roofs : RoofPoints
        The points of all houses.
    rows : int64
        Houses that got some.

    Notes
    -----
    Where a house has neither, but smooth surfaces of plants as a roof has, a note says so: some surveys know
    heights above ground alone, and call roofs high vegetation. These are not taken unasked.
    """
    polygons, n_marked = footprints.polygons, np.diff(roofs.start)
    bare = np.flatnonzero(find_bare(roofs, polygons) & ~told)
    rows, found = _find_roofs(task, polygons, bare, cloud, terrain, MAY_BE_ROOF)
    n_other = np.diff(found.start).tolist()
    details = [
        f"{n} points of class {BUILDING}, {other} of others"
        for n, other in zip(n_marked[rows].tolist(), n_other, strict=True)
    ]
    task.notes(_note_each("footprint-roof-from-other-classes", footprints, rows, details))
    without = np.setdiff1d(bare[n_marked[bare] == 0], rows)
    plants, leaves = _find_roofs(task, polygons, without, cloud, terrain, PLANTS)
    details = [
        f"{n} points of classes 3 to 5 are as smooth as a roof, and not used; where the cloud has roofs in the "
        f"classes of plants, --building-classes 5,{BUILDING} takes them"
        for n in np.diff(leaves.start).tolist()
    ]
    task.notes(_note_each("footprint-roof-like-plants", footprints, plants, details))
    return add_roof_points(roofs, rows, found), rows


def find_surfaces(
    task: Task, polygons: NDArray[np.object_], terrain: Dtm, classes: Sequence[int]
) -> UnmarkedRoofs:
    """Read the points of some classes in some houses that may be of their roofs, as `locate_unmarked`."""
    others = points_near(task, extent_of(polygons), 0.0, polygons, classes)
    return locate_unmarked(others, polygons, terrain)


def _find_roofs(
    task: Task, polygons: NDArray[np.object_], rows: Rows, cloud: PointCloud, terrain: Dtm, classes: Sequence[int]
) -> tuple[Rows, RoofPoints]:
    """Find which of some houses have a roof in some classes, and its points."""
    found = find_surfaces(task, polygons[rows], terrain, classes)
    there = are_roofs(found, polygons[rows], cloud)
    return rows[there], keep_roof_points(found.points, there)


def _note_each(kind: str, footprints: Footprints, rows: Rows, details: Sequence[str]) -> list[Note]:
    """Make a note on each of some houses, ascending."""
    chosen = np.zeros(len(footprints.ids), np.bool_)
    chosen[rows] = True
    places = (place for _, place in find_places(footprints, chosen))
    return [Note(kind, *place, detail) for place, detail in zip(places, details, strict=True)]
