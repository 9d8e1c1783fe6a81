"""How far LiDAR points are from the model: roofs, ground, and each house (measures steps 1.6 and 2.3)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numba
import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.inside import are_inside, find_inside
from pipeline.pointcloud import GROUND, WATER, PointCloud
from pipeline.raster import Dtm, measure_over
from pipeline.residuals import Residuals, ResidualSums, conclude, merge_residuals, sum_residuals, summarise
from pipeline.roof_points import RoofPoints, select_roof

__all__ = [
    "KINDS",
    "FidelitySums",
    "HouseFidelity",
    "PointFidelity",
    "Residuals",
    "conclude_fidelity",
    "measure_fidelity",
    "measure_houses",
    "merge_fidelity",
    "sum_fidelity",
    "summarise",
]

KINDS = ("roof", "missed", "ground", "swallowed")  # of points
COVERAGE_CELL = 1.0  # m, side of the cells in which points are looked for


@dataclass(frozen=True)
class PointFidelity:
    """Distance of a point cloud to a city model. The points of the four fields are disjoint.

    Attributes
    ----------
    roof : Residuals
        Roof points inside a building of the model, against its roof.
    missed : Residuals
        Roof points inside an original footprint, but outside all buildings of the model, against the terrain
        that the model has there: houses that were dropped, rims that were cut off.
    ground : Residuals
        Ground points outside all buildings of the model, against the terrain.
    swallowed : Residuals
        Ground points inside a building of the model, but outside all original footprints, against its roof:
        streets and courtyards that were built over. (Ground points inside both are floors and passages, which
        the model does not have; they are not counted.)
    """

    roof: Residuals
    missed: Residuals
    ground: Residuals
    swallowed: Residuals


@dataclass(frozen=True, eq=False)
class FidelitySums:
    """Sums of a tile's points from which the fidelity of a region is made.

    Attributes
    ----------
    roof, missed, ground, swallowed : ResidualSums
        Of the points that `PointFidelity` describes.
    """

    roof: ResidualSums
    missed: ResidualSums
    ground: ResidualSums
    swallowed: ResidualSums


@dataclass(frozen=True, eq=False)
class HouseFidelity:
    """Fidelity of each of ``n`` houses.

    Attributes
    ----------
    n_points : int64, (n,)
        Number of roof points.
    rmse : float64, (n,)
        Root of the mean squared height of the roof over its points (m); NaN without points or roof.
    bias : float64, (n,)
        Mean of the roof's height over its points (m); NaN likewise.
    coverage : float64, (n,)
        Share of the 1 m cells of the footprint that have a roof point, 0 to 1. A cell belongs to it if its
        centre is inside or a roof point of the house lies in it. 0 without points.
    """

    n_points: NDArray[np.int64]
    rmse: NDArray[np.float64]
    bias: NDArray[np.float64]
    coverage: NDArray[np.float64]


def measure_fidelity(
    cloud: PointCloud,
    dtm: Dtm,
    polygons: NDArray[np.object_],
    roof: NDArray[np.float64],
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
    roof : float64, (b,)
        Their absolute roof heights (m); a building with NaN counts as none of the model.
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
    found = _find_residuals(cloud, dtm, polygons, roof, footprints, building_class)
    return PointFidelity(**{kind: summarise(residual) for kind, residual in found.items()})


def sum_fidelity(
    cloud: PointCloud,
    dtm: Dtm,
    polygons: NDArray[np.object_],
    roof: NDArray[np.float64],
    *,
    footprints: NDArray[np.object_],
    building_class: bool,
) -> FidelitySums:
    """Measure a tile's points as `measure_fidelity` does, for adding up.

    Parameters
    ----------
    cloud : PointCloud
        The tile's own points: each point of the region in one tile.
    dtm, polygons, roof, footprints, building_class
        As in `measure_fidelity`: all that touch the tile, also those that its neighbours own. Whether there is a
        building class is a question to the whole region.
    """
    found = _find_residuals(cloud, dtm, polygons, roof, footprints, building_class)
    return FidelitySums(**{kind: sum_residuals(residual) for kind, residual in found.items()})


def merge_fidelity(parts: Sequence[FidelitySums]) -> FidelitySums:
    """Add up the sums of tiles, at least one, in any order."""
    return FidelitySums(**{kind: merge_residuals([getattr(part, kind) for part in parts]) for kind in KINDS})


def conclude_fidelity(sums: FidelitySums) -> PointFidelity:
    """Say what the sums tell; percentiles are known to 1 cm (see `residuals.conclude`)."""
    return PointFidelity(**{kind: conclude(getattr(sums, kind)) for kind in KINDS})


def measure_houses(points: RoofPoints, polygons: NDArray[np.object_], roof: NDArray[np.float64]) -> HouseFidelity:
    """Measure each house against its own roof points, outliers included.

    Parameters
    ----------
    points : RoofPoints
        Points of the houses, as from `locate_roof_points`.
    polygons : object, (n,)
        Houses.
    roof : float64, (n,)
        Absolute roof heights (m).
    """
    n_points = np.diff(points.start)
    house = np.repeat(np.arange(len(n_points)), n_points)
    residual = roof[house] - points.xyz[:, 2]
    some = np.where(n_points > 0, n_points, np.nan)
    return HouseFidelity(
        n_points,
        np.sqrt(np.bincount(house, residual**2, len(n_points)) / some),
        np.bincount(house, residual, len(n_points)) / some,
        _measure_coverage(points, polygons),
    )


def _find_residuals(
    cloud: PointCloud,
    dtm: Dtm,
    polygons: NDArray[np.object_],
    roof: NDArray[np.float64],
    footprints: NDArray[np.object_],
    building_class: bool,
) -> dict[str, NDArray[np.float64]]:
    """Find the residuals (m) of the points of each kind."""
    built = np.isfinite(roof)
    polygons, roof = polygons[built], roof[built]
    xyz = cloud.xyz
    is_roof = select_roof(cloud, building_class=building_class)
    building, point, original = _find_in_both(xyz, is_roof, polygons, footprints)
    missed = original & ~_mark(len(xyz), point)

    is_ground = (cloud.classification == GROUND) | (cloud.classification == WATER)
    over, below, original = _find_in_both(xyz, is_ground, polygons, footprints)
    open_ground = is_ground & ~_mark(len(xyz), below)
    return {
        "roof": roof[building] - xyz[point, 2],
        "missed": measure_over(dtm, xyz, missed),
        "ground": measure_over(dtm, xyz, open_ground),
        "swallowed": (roof[over] - xyz[below, 2])[~original[below]],
    }


def _find_in_both(
    xyz: NDArray[np.float64],
    among: NDArray[np.bool_],
    polygons: NDArray[np.object_],
    footprints: NDArray[np.object_],
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]:
    """Find the points in each polygon, as `find_inside`, and tell which points are in a footprint."""
    polygon, point = find_inside(xyz, np.concatenate((polygons, footprints)), among=among)
    n = int(np.searchsorted(polygon, len(polygons)))
    return polygon[:n], point[:n], _mark(len(xyz), point[n:])


def _mark(n: int, index: NDArray[np.int64]) -> NDArray[np.bool_]:
    marked = np.zeros(n, np.bool_)
    marked[index] = True
    return marked


def _measure_coverage(points: RoofPoints, polygons: NDArray[np.object_]) -> NDArray[np.float64]:
    """Share of the cells of each house that have a point; points lie within the box of their house."""
    low, size = _cells_under(shapely.bounds(polygons).reshape(-1, 4))
    count = size[:, 0] * size[:, 1]
    begin = np.cumsum(count) - count
    box = np.repeat(np.arange(len(polygons)), count)
    row, column = np.divmod(np.arange(len(box)) - begin[box], size[box, 0])
    belongs = are_inside(polygons, box, (low[box] + np.column_stack((column, row)) + 0.5) * COVERAGE_CELL)
    filled = _find_filled(points.start, points.xyz, low, size[:, 0], begin, np.zeros(len(box), np.bool_))
    n_filled = np.bincount(box[filled], minlength=len(polygons))
    return n_filled / np.maximum(np.bincount(box[belongs | filled], minlength=len(polygons)), 1)


@numba.njit(cache=True, nogil=True)
def _find_filled(
    start: NDArray[np.int64],
    xyz: NDArray[np.float64],
    low: NDArray[np.int64],
    width: NDArray[np.int64],
    begin: NDArray[np.int64],
    filled: NDArray[np.bool_],
) -> NDArray[np.bool_]:
    """Mark the cells that have a point of their house: those of house h begin at ``begin[h]``, row by row."""
    for h in range(len(begin)):
        for x, y, _ in xyz[start[h] : start[h + 1]]:
            i, j = int(np.floor(x / COVERAGE_CELL)) - low[h, 0], int(np.floor(y / COVERAGE_CELL)) - low[h, 1]
            filled[begin[h] + j * width[h] + i] = True
    return filled


def _cells_under(boxes: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """First cell under each box, column and row, and the number of columns and rows."""
    low = np.floor(boxes[:, :2] / COVERAGE_CELL).astype(np.int64)
    return low, np.floor(boxes[:, 2:] / COVERAGE_CELL).astype(np.int64) - low + 1
