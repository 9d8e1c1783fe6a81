"""How far LiDAR points are from the model: roofs, ground, and each house (measures steps 1.6 and 2.3)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.data.classes import GROUND, WATER
from pipeline.data.kernel import kernel
from pipeline.data.pointcloud import PointCloud
from pipeline.data.roofs import Roofs, roof_heights, take_roofs
from pipeline.geometry.group_order import sort_values
from pipeline.geometry.inside import (
    EVERYWHERE,
    INSIDE,
    UNSURE,
    Box,
    PolygonIndex,
    find_inside,
    index_polygons,
    list_edges,
    side_of,
)
from pipeline.points_terrain.raster import Dtm, measure_over
from pipeline.quality.residuals import Residuals, ResidualSums, conclude, merge_residuals, sum_residuals, summarise
from pipeline.roofs.roof_points import RoofPoints, select_roof

__all__ = [
    "KINDS",
    "FidelitySums",
    "HouseFidelity",
    "IndexedModel",
    "PointFidelity",
    "Residuals",
    "conclude_fidelity",
    "index_model",
    "measure_fidelity",
    "measure_houses",
    "merge_fidelity",
    "sum_fidelity",
    "summarise",
]

KINDS = ("roof", "missed", "ground", "swallowed")  # of points
NEAR = 0.25  # m; a point this close to a roof is on it
COVERAGE_CELL = 1.0  # m, side of the cells in which points are looked for


@dataclass(frozen=True)
class PointFidelity:
    """Distance of a point cloud to a city model. The points of the four fields are disjoint."""

    roof: Residuals  #: roof points inside a building of the model, against its roof
    #: roof points inside an original footprint, but outside all buildings of the model, against the terrain that
    #: the model has there: houses that were dropped, rims that were cut off
    missed: Residuals
    ground: Residuals  #: ground points outside all buildings of the model, against the terrain
    #: ground points inside a building of the model, but outside all original footprints, against its roof: streets
    #: and courtyards that were built over. (Ground points inside both are floors and passages, which the model
    #: does not have; they are not counted.)
    swallowed: Residuals


@dataclass(frozen=True, eq=False)
class FidelitySums:
    """Sums of a tile's points from which the fidelity of a region is made."""

    #: of the points that `PointFidelity` describes
    roof: ResidualSums
    missed: ResidualSums
    ground: ResidualSums
    swallowed: ResidualSums


@dataclass(frozen=True, eq=False)
class HouseFidelity:
    """Fidelity of each of ``n`` houses."""

    n_points: NDArray[np.int64]  #: (n,): number of roof points
    #: (n,): root of the mean squared height of the roof over its points (m); NaN without points or roof
    rmse: NDArray[np.float64]
    bias: NDArray[np.float64]  #: (n,): mean of the roof's height over its points (m); NaN likewise
    #: (n,): share of the 1 m cells of the footprint that have a roof point, 0 to 1. A cell belongs to it if its
    #: centre is inside or a roof point of the house lies in it. 0 without points
    coverage: NDArray[np.float64]
    #: (n,): median distance of the points from the roof, up or down (m); NaN without points or roof
    median: NDArray[np.float64]
    within: NDArray[np.float64]  #: (n,): share of the points within `NEAR` of the roof, 0 to 1; NaN likewise


def measure_fidelity(
    cloud: PointCloud,
    dtm: Dtm,
    polygons: NDArray[np.object_],
    roofs: Roofs,
    *,
    footprints: NDArray[np.object_],
    building_class: bool,
) -> PointFidelity:
    """Measure how far the points of a cloud are from a city model.

    Parameters
    ----------
    cloud : PointCloud
        Points of the region.
    dtm : Dtm
        Terrain of the model, without empty nodes.
    polygons : object, (b,)
        Buildings of the model.
    roofs : Roofs
        Their roofs, absolute heights (m); a building with NaN counts as none of the model.
    footprints : object, (f,)
        Clean footprints before simplification, which say what a building is.
    building_class : bool
        Whether the cloud marks buildings; see `select_roof`.

    Returns
    -------
    PointFidelity
        Roof points outside all footprints are not counted. A point in several buildings counts once for
        each; after simplification there are none.

    Notes
    -----
    All points count, outliers too. The result does not depend on the order of the points.
    """
    model = index_model(polygons, roofs, footprints=footprints)
    found = _find_residuals(cloud, dtm, model, building_class, np.ones(len(cloud.xyz), np.bool_))
    return PointFidelity(**{kind: summarise(residual) for kind, residual in found.items()})


@dataclass(frozen=True, eq=False)
class IndexedModel:
    """A city model and the footprints that it was made of, in which points are looked for."""

    polygons: NDArray[np.object_]  #: (n,): buildings that have a roof, then footprints
    roofs: Roofs  #: roofs of the first ``b``, the buildings
    index: PolygonIndex  #: all of them in cells


def index_model(
    polygons: NDArray[np.object_],
    roofs: Roofs,
    *,
    footprints: NDArray[np.object_],
    box: Box = EVERYWHERE,
) -> IndexedModel:
    """Prepare a city model for `sum_fidelity` of several clouds within a box.

    Parameters
    ----------
    polygons, roofs, footprints
        As in `measure_fidelity`: all that touch the box, also those that the tiles around it own.
    box : (xmin, ymin, xmax, ymax)
        Box of all points (m), its borders included.
    """
    built = np.flatnonzero(np.isfinite(roofs.plane[:, 2]))
    both = np.concatenate((polygons[built], footprints))
    return IndexedModel(both, take_roofs(roofs, built), index_polygons(both, box))


def sum_fidelity(
    cloud: PointCloud, dtm: Dtm, model: IndexedModel, *, building_class: bool, among: NDArray[np.bool_]
) -> FidelitySums:
    """Measure a tile's points as `measure_fidelity` does, for adding up.

    Parameters
    ----------
    cloud : PointCloud
        Points within the box of the model.
    dtm : Dtm
        As in `measure_fidelity`.
    model : IndexedModel
        The city model, from `index_model`.
    building_class : bool
        As in `measure_fidelity`; a question to the whole region.
    among : bool, (n,)
        The tile's own points: each point of the region in one tile.
    """
    found = _find_residuals(cloud, dtm, model, building_class, among)
    return FidelitySums(**{kind: sum_residuals(residual) for kind, residual in found.items()})


def merge_fidelity(parts: Sequence[FidelitySums]) -> FidelitySums:
    """Add up the sums of tiles, at least one, in any order."""
    return FidelitySums(**{kind: merge_residuals([getattr(part, kind) for part in parts]) for kind in KINDS})


def conclude_fidelity(sums: FidelitySums) -> PointFidelity:
    """Say what the sums tell; percentiles are known to 1 cm (see `residuals.conclude`)."""
    return PointFidelity(**{kind: conclude(getattr(sums, kind)) for kind in KINDS})


def measure_houses(points: RoofPoints, polygons: NDArray[np.object_], roofs: Roofs) -> HouseFidelity:
    """Measure each house against its own roof points, outliers included.

    Parameters
    ----------
    points : RoofPoints
        Points of the houses, as from `locate_roof_points`.
    polygons : object, (n,)
        Houses.
    roofs : Roofs
        Their roofs, absolute heights (m).
    """
    n_points = np.diff(points.start)
    house_of_point = np.repeat(np.arange(len(n_points)), n_points)
    height = roof_heights(roofs, house_of_point, points.xyz[:, :2])
    residual = -sort_values(points.start, points.xyz[:, 2] - height)
    edges = list_edges(polygons)
    low, size = _cells_under(shapely.bounds(polygons).reshape(-1, 4))
    total, squares, filled, cells, unsure = _measure_each(
        points.start, points.xyz, residual, low, size, edges.start, edges.a, edges.b
    )
    house = unsure[:, 0].astype(np.int64)
    cells += np.bincount(house[shapely.contains_xy(polygons[house], *unsure[:, 1:].T)], minlength=len(cells))
    some = np.where(n_points > 0, n_points, np.nan)
    distance = sort_values(points.start, np.abs(residual))
    first, several = points.start[:-1], n_points > 0
    median = np.full(len(n_points), np.nan)
    middle = (first + (n_points - 1) // 2)[several], (first + n_points // 2)[several]
    median[several] = (distance[middle[0]] + distance[middle[1]]) / 2
    within = np.bincount(house_of_point[distance <= NEAR], minlength=len(n_points)) / some
    within[np.isnan(median)] = np.nan
    return HouseFidelity(
        n_points, np.sqrt(squares / some), total / some, filled / np.maximum(cells, 1), median, within
    )


def _find_residuals(
    cloud: PointCloud, dtm: Dtm, model: IndexedModel, building_class: bool, among: NDArray[np.bool_]
) -> dict[str, NDArray[np.float64]]:
    """Find the residuals (m) of the points of each kind among some."""
    xyz, roofs = cloud.xyz, model.roofs
    is_roof = among & select_roof(cloud, building_class=building_class)
    is_ground = among & ((cloud.classification == GROUND) | (cloud.classification == WATER))
    polygon, point = find_inside(xyz, model.polygons, among=is_roof | is_ground, index=model.index)
    n = int(np.searchsorted(polygon, len(roofs)))
    building, point, original = polygon[:n], point[:n], _mark(len(xyz), point[n:])
    outside = ~_mark(len(xyz), point)
    residual = roof_heights(roofs, building, xyz[point, :2]) - xyz[point, 2]
    return {
        "roof": residual[is_roof[point]],
        "missed": measure_over(dtm, xyz, is_roof & original & outside),
        "ground": measure_over(dtm, xyz, is_ground & outside),
        "swallowed": residual[(is_ground & ~original)[point]],
    }


def _mark(n: int, index: NDArray[np.int64]) -> NDArray[np.bool_]:
    marked = np.zeros(n, np.bool_)
    marked[index] = True
    return marked


@kernel
def _measure_each(
    start: NDArray[np.int64],
    xyz: NDArray[np.float64],
    residual: NDArray[np.float64],
    low: NDArray[np.int64],
    size: NDArray[np.int64],
    edge_start: NDArray[np.int64],
    a: NDArray[np.float64],
    b: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Sum up the residuals of each house and their squares, in their order; count its cells.

    Gives the sums, the number of cells that have a point, and of those that belong to the house; and house and
    centre of cells without a point of which crossings do not tell.
    """
    n, n_unsure = len(start) - 1, 0
    total, squares = np.zeros(n), np.zeros(n)
    n_filled, n_cells = np.zeros(n, np.int64), np.zeros(n, np.int64)
    unsure = np.empty(((size[:, 0] * size[:, 1]).sum(), 3))
    for h in range(n):
        for k in range(start[h], start[h + 1]):
            total[h] += residual[k]
            squares[h] += residual[k] * residual[k]
        filled = np.zeros((size[h, 1], size[h, 0]), np.bool_)
        for k in range(start[h], start[h + 1]):
            i, j = int(np.floor(xyz[k, 0] / COVERAGE_CELL)), int(np.floor(xyz[k, 1] / COVERAGE_CELL))
            filled[j - low[h, 1], i - low[h, 0]] = True
        for j in range(size[h, 1]):
            y = (low[h, 1] + j + 0.5) * COVERAGE_CELL
            for i in range(size[h, 0]):
                x = (low[h, 0] + i + 0.5) * COVERAGE_CELL
                if filled[j, i]:
                    n_filled[h] += 1
                    n_cells[h] += 1
                    continue
                side = side_of(x, y, edge_start[h], edge_start[h + 1], a, b)
                n_cells[h] += side == INSIDE
                if side == UNSURE:
                    unsure[n_unsure, 0], unsure[n_unsure, 1], unsure[n_unsure, 2] = h, x, y
                    n_unsure += 1
    return total, squares, n_filled, n_cells, unsure[:n_unsure].copy()


def _cells_under(boxes: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """First cell under each box, column and row, and the number of columns and rows."""
    low = np.floor(boxes[:, :2] / COVERAGE_CELL).astype(np.int64)
    return low, np.floor(boxes[:, 2:] / COVERAGE_CELL).astype(np.int64) - low + 1
