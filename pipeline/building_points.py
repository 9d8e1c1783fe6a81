"""Step 1.5: roof and ground points of each building."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.pointcloud import (
    BUILDING,
    GROUND,
    HIGH_NOISE,
    HIGH_VEGETATION,
    LOW_NOISE,
    LOW_VEGETATION,
    MEDIUM_VEGETATION,
    WATER,
    PointCloud,
)

# Where a cloud has no building class, a point of any class but these may lie on a roof.
NEVER_ROOF = (GROUND, LOW_VEGETATION, MEDIUM_VEGETATION, HIGH_VEGETATION, LOW_NOISE, WATER, HIGH_NOISE)
OUTLIER_DEVIATIONS = 2.0  # paper, step 1.5
CHUNK_POINTS = 2**18
INDEX_CELL = 4.0  # m, side of a cell of the point index; measured best of 2, 4 and 8 on 3.5 points/m2


@dataclass(frozen=True, eq=False)
class BuildingPoints:
    """Heights of the roof and ground points of ``n`` buildings.

    Attributes
    ----------
    roof_start, ground_start : int64, (n + 1,)
        Building ``i`` has ``roof_z[roof_start[i]:roof_start[i + 1]]``, and its ground points likewise.
    roof_z, ground_z : float64
        Absolute heights (m), ascending within each building.
    """

    roof_start: NDArray[np.int64]
    roof_z: NDArray[np.float64]
    ground_start: NDArray[np.int64]
    ground_z: NDArray[np.float64]


def has_building_class(cloud: PointCloud) -> bool:
    """Tell whether any point is classified as building (class 6)."""
    return bool((cloud.classification == BUILDING).any())


def extract_building_points(
    cloud: PointCloud, polygons: NDArray[np.object_], *, margin: float, building_class: bool
) -> BuildingPoints:
    """Extract each building's roof and ground points, outliers removed (paper, step 1.5).

    Parameters
    ----------
    cloud : PointCloud
        Points of the tile and its halo.
    polygons : object, (n,)
        Valid shapely Polygons.
    margin : float
        Ground points (classes 2 and 9) lie outside the footprint within this distance (m).
    building_class : bool
        True: roof points are those of class 6 inside. False, for a cloud without that class: those inside
        that are neither ground, water, vegetation nor noise.

    Returns
    -------
    BuildingPoints
        Points within two standard deviations of the mean of their building.

    Notes
    -----
    Points are sorted into square cells; each polygon takes the cells that its box touches, then exact
    containment decides. The result does not depend on the order of the points.
    """
    roof = cloud.classification == BUILDING if building_class else ~np.isin(cloud.classification, NEVER_ROOF)
    ground = (cloud.classification == GROUND) | (cloud.classification == WATER)
    roof_start, roof_z = _points_inside(cloud.xyz[roof], polygons, None)
    rings = shapely.buffer(polygons, margin)
    ground_start, ground_z = _points_inside(cloud.xyz[ground], rings, polygons)
    return BuildingPoints(*remove_outliers(roof_start, roof_z), *remove_outliers(ground_start, ground_z))


def remove_outliers(
    start: NDArray[np.int64], z: NDArray[np.float64], *, deviations: float = OUTLIER_DEVIATIONS
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Remove the values farther than `deviations` standard deviations from the mean of their group.

    Parameters
    ----------
    start : int64, (n + 1,)
        Group ``i`` is ``z[start[i]:start[i + 1]]``; groups may be empty.
    z : float64
        Values, ascending within each group.

    Returns
    -------
    start, z
        The same for the values that stay.

    Examples
    --------
    >>> remove_outliers(np.array([0, 0, 7]), np.array([1.0, 1, 1, 1, 1, 1, 9]))
    (array([0, 0, 6]), array([1., 1., 1., 1., 1., 1.]))
    """
    count = np.diff(start)
    group = np.repeat(np.arange(len(count)), count)
    some = np.maximum(count, 1)
    mean = np.bincount(group, z, len(count)) / some
    offset = z - mean[group]
    deviation = np.sqrt(np.bincount(group, offset**2, len(count)) / some)
    # A group of equal values has a deviation of rounding errors only: keep it whole.
    keep = np.abs(offset) <= deviations * deviation[group] + 1e-9
    kept = np.bincount(group[keep], minlength=len(count))
    return np.concatenate(([0], np.cumsum(kept))), z[keep]


def merge_building_points(points: BuildingPoints, members: tuple[NDArray[np.int64], ...]) -> BuildingPoints:
    """Pool the points of the buildings that were merged (paper, step 2.3).

    Parameters
    ----------
    points : BuildingPoints
        Points of the original buildings.
    members : tuple of int64 arrays
        The originals that each merged building is made of.
    """
    owner = np.full(len(points.roof_start) - 1, -1)
    for building, originals in enumerate(members):
        owner[originals] = building
    roof = _regroup(points.roof_start, points.roof_z, owner, len(members))
    ground = _regroup(points.ground_start, points.ground_z, owner, len(members))
    return BuildingPoints(*roof, *ground)


def take_building_points(points: BuildingPoints, rows: NDArray[np.int64]) -> BuildingPoints:
    """Take the points of some buildings, in the order of `rows`, int64 (k,), which may repeat."""
    roof = _take(points.roof_start, points.roof_z, rows)
    return BuildingPoints(*roof, *_take(points.ground_start, points.ground_z, rows))


def join_building_points(several: Sequence[BuildingPoints]) -> BuildingPoints:
    """Put the points of the buildings of several lists one after the other."""

    def joined(start: list[NDArray[np.int64]], z: list[NDArray[np.float64]]) -> tuple[Any, Any]:
        count = np.concatenate([np.empty(0, np.int64), *(np.diff(one) for one in start)])
        return np.concatenate(([0], np.cumsum(count))), np.concatenate([np.empty(0), *z])

    roof = joined([points.roof_start for points in several], [points.roof_z for points in several])
    ground = joined([points.ground_start for points in several], [points.ground_z for points in several])
    return BuildingPoints(*roof, *ground)


def _take(
    start: NDArray[np.int64], z: NDArray[np.float64], rows: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    count = np.diff(start)[rows]
    new_start = np.concatenate(([0], np.cumsum(count)))
    return new_start, z[np.arange(new_start[-1]) + np.repeat(start[rows] - new_start[:-1], count)]


def find_inside(
    xy: NDArray[np.float64], polygons: NDArray[np.object_]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Find the points inside each polygon, those on its outline left out.

    Parameters
    ----------
    xy : float64, (k, 2) or (k, 3)
        Points (m).
    polygons : object, (n,)
        Valid shapely Polygons; a point in several of them is found in each.

    Returns
    -------
    polygon, point : int64, (h,)
        Rows of `polygons` and `xy`, by polygon, then by point.

    Notes
    -----
    Points are looked at a quarter of a million at a time, so that memory is that of the result.
    """
    boxes = shapely.bounds(polygons).reshape(-1, 4)
    shapely.prepare(polygons)
    found = [(np.empty(0, np.int64), np.empty(0, np.int64))]
    for first in range(0, len(xy), CHUNK_POINTS):
        chunk = xy[first : first + CHUNK_POINTS]
        polygon, point = _find_candidates(chunk, boxes)
        inside = shapely.contains_xy(polygons[polygon], chunk[point, 0], chunk[point, 1])
        found.append((polygon[inside], point[inside] + first))
    polygon, point = (np.concatenate(part) for part in zip(*found, strict=True))
    order = np.lexsort((point, polygon))
    return polygon[order], point[order]


def _points_inside(
    xyz: NDArray[np.float64], polygons: NDArray[np.object_], outside: NDArray[np.object_] | None
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Heights of the points in each polygon, and not in its counterpart in `outside` where given."""
    polygon, point = find_inside(xyz, polygons)
    if outside is not None:
        shapely.prepare(outside)
        apart = ~shapely.intersects_xy(outside[polygon], xyz[point, 0], xyz[point, 1])
        polygon, point = polygon[apart], point[apart]
    z = xyz[point, 2]
    order = np.lexsort((z, polygon))
    start = np.concatenate(([0], np.cumsum(np.bincount(polygon, minlength=len(polygons)))))
    return start, z[order]


def _find_candidates(
    xyz: NDArray[np.float64], boxes: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Pairs (box, point) of the points in the index cells that each box touches, by box."""
    if len(xyz) == 0 or len(boxes) == 0:
        return np.empty(0, np.int64), np.empty(0, np.int64)
    cell = np.floor(xyz[:, :2] / INDEX_CELL).astype(np.int64)
    first = cell.min(axis=0)
    n_cols, n_rows = (cell.max(axis=0) - first + 1).tolist()
    key = (cell[:, 1] - first[1]) * n_cols + cell[:, 0] - first[0]
    order = np.argsort(key, kind="stable")
    cell_start = np.concatenate(([0], np.cumsum(np.bincount(key, minlength=n_cols * n_rows))))

    low = np.floor(boxes[:, :2] / INDEX_CELL).astype(np.int64) - first
    high = np.floor(boxes[:, 2:] / INDEX_CELL).astype(np.int64) - first
    last_col, last_row = n_cols - 1, n_rows - 1
    meets = (low <= [last_col, last_row]).all(axis=1) & (high >= 0).all(axis=1)
    low, high = np.clip(low, 0, [last_col, last_row]), np.clip(high, 0, [last_col, last_row])
    # One run of cells for each row of cells under a box; its points are neighbours in `order`.
    rows = np.where(meets, high[:, 1] - low[:, 1] + 1, 0)
    box = np.repeat(np.arange(len(boxes)), rows)
    row = low[box, 1] + np.arange(len(box)) - np.repeat(np.cumsum(rows) - rows, rows)
    begin = cell_start[row * n_cols + low[box, 0]]
    length = cell_start[row * n_cols + high[box, 0] + 1] - begin
    shift = begin - (np.cumsum(length) - length)
    return np.repeat(box, length), order[np.arange(length.sum()) + np.repeat(shift, length)]


def _regroup(
    start: NDArray[np.int64], z: NDArray[np.float64], owner: NDArray[np.int64], n: int
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    group = np.repeat(owner, np.diff(start))
    kept = group >= 0
    group, z = group[kept], z[kept]
    order = np.lexsort((z, group))
    return np.concatenate(([0], np.cumsum(np.bincount(group, minlength=n)))), z[order]
