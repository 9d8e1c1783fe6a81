"""Roof points of each building with their places, for splitting houses and measuring (step 1.5)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.data.classes import BUILDING, NEVER_ROOF
from pipeline.data.pointcloud import PointCloud
from pipeline.geometry.group_order import sort_values
from pipeline.geometry.inside import find_inside


@dataclass(frozen=True, eq=False)
class RoofPoints:
    """Roof points of ``n`` buildings."""

    start: NDArray[np.int64]  #: (n + 1,): building ``i`` has the points ``xyz[start[i]:start[i + 1]]``
    xyz: NDArray[np.float64]  #: (k, 3): coordinates (m), in any order within each building
    z: NDArray[np.float64]  #: (k,): heights (m), ascending within each building: not in the order of `xyz`


def make_roof_points(start: NDArray[np.int64], xyz: NDArray[np.float64]) -> RoofPoints:
    """Put the heights of each building's points in order.

    Examples
    --------
    >>> make_roof_points(np.array([0, 1, 3]), np.array([[0.0, 0, 9], [1, 0, 7], [2, 0, 5]])).z
    array([9., 5., 7.])
    """
    return RoofPoints(start, xyz, sort_values(start, xyz[:, 2]))


def no_roof_points(n: int) -> RoofPoints:
    """Give n buildings no point."""
    return RoofPoints(np.zeros(n + 1, np.int64), np.empty((0, 3)), np.empty(0))


def select_roof(cloud: PointCloud, *, building_class: bool) -> NDArray[np.bool_]:
    """Tell which points may lie on a roof, by the rule of `extract_building_points`.

    Returns
    -------
    bool, (n,)
        True for class 6; without that class, for all but `NEVER_ROOF`.
    """
    if building_class:
        return np.asarray(cloud.classification == BUILDING)
    return ~np.isin(cloud.classification, NEVER_ROOF)


def locate_roof_points(cloud: PointCloud, polygons: NDArray[np.object_], *, building_class: bool) -> RoofPoints:
    """Take the roof points inside each polygon, outliers included.

    Parameters
    ----------
    cloud : PointCloud
        Points of the tile and its halo.
    polygons : object, (n,)
        Valid shapely Polygons.
    building_class : bool
        Whether the cloud marks buildings; see `select_roof`.

    Notes
    -----
    Two standard deviations (the outliers of step 1.5) would cut off a low annex with less than a fifth of
    the points: its distance from the mean, ``(1 - p) D``, exceeds ``2 sqrt(p (1 - p)) D`` when ``p < 0.2``.
    """
    polygon, point = find_inside(cloud.xyz, polygons, among=select_roof(cloud, building_class=building_class))
    start = np.concatenate(([0], np.cumsum(np.bincount(polygon, minlength=len(polygons)))))
    xyz = np.take(cloud.xyz, point, axis=0)  # in half of the time of an index
    del polygon, point  # they are as large as what is sorted
    return make_roof_points(start, xyz)


def divide_roof_points(points: RoofPoints, parts: NDArray[np.object_], owner: NDArray[np.int64]) -> RoofPoints:
    """Deal the points of buildings out to parts of them.

    Parameters
    ----------
    points : RoofPoints
        Points of n buildings.
    parts : object, (p,)
        Polygons.
    owner : int64, (p,)
        The building that each is a part of: it gets none of the points of others.
    """
    n = len(points.start) - 1
    of_point = np.repeat(np.arange(n), np.diff(points.start))
    part, point = find_inside(points.xyz, parts, among=np.isin(np.arange(n), owner)[of_point])
    own = owner[part] == of_point[point]
    start = np.concatenate(([0], np.cumsum(np.bincount(part[own], minlength=len(parts)))))
    return make_roof_points(start, points.xyz[point[own]])


def keep_roof_points(points: RoofPoints, kept: NDArray[np.bool_]) -> RoofPoints:
    """Keep the points of some buildings, bool (n,).

    Examples
    --------
    >>> points = make_roof_points(np.array([0, 1, 3, 3]), np.array([[0.0, 0, 9], [1, 0, 5], [2, 0, 5]]))
    >>> found = keep_roof_points(points, np.array([False, True, True]))
    >>> found.start.tolist(), found.xyz[:, 0].tolist()
    ([0, 2, 2], [1.0, 2.0])
    """
    if kept.all():
        return points
    count = np.diff(points.start)
    rows = np.repeat(kept, count)
    return RoofPoints(np.concatenate(([0], np.cumsum(count[kept]))), points.xyz[rows], points.z[rows])


def merge_roof_points(points: RoofPoints, row: NDArray[np.int64]) -> RoofPoints:
    """Pool the points of buildings that became one.

    Parameters
    ----------
    points : RoofPoints
        Points of n buildings.
    row : int64, (n,)
        Which building each became: 0, 1, ..., none left out.

    Examples
    --------
    >>> points = make_roof_points(np.array([0, 1, 2]), np.array([[0.0, 0, 9], [1, 0, 5]]))
    >>> merge_roof_points(points, np.array([0, 0])).z.tolist()
    [5.0, 9.0]
    """
    owner = np.repeat(row, np.diff(points.start))
    start = np.concatenate(([0], np.cumsum(np.bincount(owner, minlength=int(row.max(initial=-1)) + 1))))
    return make_roof_points(start, points.xyz[np.argsort(owner, kind="stable")])


def add_roof_points(points: RoofPoints, rows: NDArray[np.int64], more: RoofPoints) -> RoofPoints:
    """Give some buildings further points.

    Parameters
    ----------
    points : RoofPoints
        Points of n buildings.
    rows : int64, (m,)
        Which of them get some.
    more : RoofPoints
        The points of these m.

    Examples
    --------
    >>> points = make_roof_points(np.array([0, 1, 2]), np.array([[0.0, 0, 9], [1, 0, 5]]))
    >>> more = make_roof_points(np.array([0, 1]), np.array([[2.0, 0, 4]]))
    >>> found = add_roof_points(points, np.array([1]), more)
    >>> found.start.tolist(), found.z.tolist()
    ([0, 1, 3], [9.0, 4.0, 5.0])
    """
    if len(rows) == 0:
        return points
    old, new = np.diff(points.start), np.diff(more.start)
    owner = np.concatenate((np.repeat(np.arange(len(old)), old), np.repeat(rows, new)))
    order = np.argsort(owner, kind="stable")
    start = np.concatenate(([0], np.cumsum(np.bincount(owner, minlength=len(old)))))
    return make_roof_points(start, np.concatenate((points.xyz, more.xyz))[order])
