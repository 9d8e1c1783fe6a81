"""Roofs fitted once more to the points of their faces, after simplification has moved walls (step 2.3)."""

import math

import numpy as np
from numpy.typing import NDArray

from pipeline.data.kernel import kernel
from pipeline.data.roofs import Roofs
from pipeline.geometry.group_order import order_values, percentile_by_group, sort_points
from pipeline.roofs.plane_search import BAND, slope_along
from pipeline.roofs.roof_points import RoofPoints

LIMIT_SHARE = 0.02  # of a part's points may lie beyond its limits, on either side
LIMIT_ROOM = 0.5  # m, between these points and the limits
MIN_REFIT = 6  # points that move a face
MIN_SLOPED = 12  # points of a face that change its slope
MAX_MOVE = 1.0  # m, from the median to the mean of the densest points
LEAST_SHARE = 0.3  # of a face's points, in the densest band and near a plane whose slope is fitted
NEAR = 0.5  # m, from the plane: points that a slope is fitted to
ROUNDS = 4
LEAST_SPREAD = 0.5  # m, standard deviation of these points along the slope

Array = NDArray[np.float64]


def refit_roofs(roofs: Roofs, polygons: NDArray[np.object_], points: RoofPoints, *, max_slope: float) -> Roofs:
    """Fit the roof of each face to its points, and set its limits by them.

    Parameters
    ----------
    roofs : Roofs
        Roofs of the faces, from the parts that they were made of.
    polygons : object, (n,)
        The faces.
    max_slope : float
        Greatest slope of a roof.

    Returns
    -------
    Roofs
        With limits of half a metre beyond the 2nd and the 98th percentile of the points; unchanged with fewer than
        `MIN_REFIT` points.

    Notes
    -----
    1. The plane moves by the median of the points over it.
    2. It moves on to the mean of the densest points, since a façade or another roof pulls the median: those in the
       band of ``2 * BAND`` that holds most, if it holds `LEAST_SHARE` of all and its mean is within `MAX_MOVE`.
    3. With `MIN_SLOPED` points, the slope is fitted to the points within `NEAR` of the plane. Its direction stays,
       so that ridges stay level. This is repeated as long as the sum of squared distances, each up to `NEAR`,
       falls.

    O(n log n) for the n points of a face.
    """
    if len(roofs) != len(polygons) or len(points.start) != len(polygons) + 1:
        raise ValueError(
            f"{len(roofs)} roofs, {len(polygons)} polygons and {len(points.start) - 1} sets of points"
        )
    start, count = points.start, np.diff(points.start)
    moved = (count >= MIN_REFIT) & np.isfinite(roofs.plane[:, 2])
    xyz = sort_points(start, points.xyz)
    xyz[:, :2] -= np.repeat(roofs.origin, count, axis=0)
    plane, limits = roofs.plane.copy(), roofs.limits.copy()
    for face in np.flatnonzero(moved).tolist():
        plane[face] = _refit_face(xyz[start[face] : start[face + 1]], plane[face], max_slope)
    low, high = (percentile_by_group(start, points.z, q) for q in (100 * LIMIT_SHARE, 100 - 100 * LIMIT_SHARE))
    limits[moved] = np.column_stack((low - LIMIT_ROOM, high + LIMIT_ROOM))[moved]
    flat = (plane[:, :2] == 0).all(axis=1) & moved
    limits[flat] = plane[flat][:, [2, 2]]
    return Roofs(plane, roofs.origin, limits)


@kernel
def _refit_face(xyz: Array, plane: Array, max_slope: float) -> tuple[float, float, float]:
    """Plane of a face by its points."""
    a, b, c = plane[0], plane[1], plane[2]
    above = np.empty(len(xyz))
    for p in range(len(xyz)):
        above[p] = xyz[p, 2] - a * xyz[p, 0] - b * xyz[p, 1] - c
    above = above[order_values(above)]
    c += _densest(above)
    slope = math.hypot(a, b)
    if slope > 0 and len(xyz) >= MIN_SLOPED:
        up_x, up_y = a / slope, b / slope
        slope, c = _refit_slope(xyz, (up_x, up_y), slope, c, max_slope)
        a, b = slope * up_x, slope * up_y
    return a, b, c


@kernel
def _densest(values: Array) -> float:
    """Where ascending values are densest, near their median; the median where they are nowhere dense."""
    n = len(values)
    median: float = (values[(n - 1) // 2] + values[n // 2]) / 2
    most, best, last = 0, math.inf, 0
    for first in range(n):
        while last < n and values[last] - values[first] <= 2 * BAND:
            last += 1
        middle = 0.0
        if last - first >= most:
            for k in range(first, last):
                middle += values[k] - median
            middle /= last - first
            if last - first > most or abs(middle) < abs(best):
                best = middle
            most = last - first
    return median + best if most >= LEAST_SHARE * n and abs(best) <= MAX_MOVE else median


@kernel
def _refit_slope(
    xyz: Array, up: tuple[float, float], slope: float, height: float, max_slope: float
) -> tuple[float, float]:
    """Slope along a direction and height at the origin, by the points near the plane."""
    found_slope, found_height, least = slope, height, math.inf
    weight = np.empty(len(xyz))
    for _ in range(ROUNDS + 1):
        n, far = 0.0, 0.0
        for p in range(len(xyz)):
            r = abs(xyz[p, 2] - slope * (up[0] * xyz[p, 0] + up[1] * xyz[p, 1]) - height)
            far += min(r, NEAR) ** 2
            weight[p] = 1.0 if r < NEAR else 0.0
            n += weight[p]
        if far >= least:
            break
        found_slope, found_height, least = slope, height, far
        if n < max(MIN_REFIT, LEAST_SHARE * len(xyz)):
            break
        slope, height, variance = slope_along(xyz, weight, up[0], up[1])
        if variance < LEAST_SPREAD**2 or not 0 < slope <= max_slope:
            break
    return found_slope, found_height
