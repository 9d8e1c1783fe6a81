"""Families of roofs fitted to a house: flat, shed, gable, valley, hip or pyramid, mansard (for `house_roofs`)."""

import math

import numpy as np
from numpy.typing import NDArray

from pipeline.data.kernel import kernel
from pipeline.roofs.local_planes import solve_plane
from pipeline.roofs.plane_search import fit_weighted, misfit

# What a family must save against a flat roof: area (m²) whose points are off by `misfit` of 1.
SHED, GABLE, VALLEY, HIP, MANSARD = 1.5, 4.0, 6.0, 3.0, 8.0
SAMPLES = 100  # points that are looked at, at most
RIDGES = 14  # places of a ridge that are tried across a house, less one
BREAKS = 4  # widths of the upper part of a mansard roof that are tried, less one
ROUNDS = 4  # of robust fits
SOFT = 0.5  # m, a point this far from a roof counts half
LEAST_EDGE = 1.0  # m, an edge of a convex outline that has a face of a hip roof
STANDS_OUT = 0.3  # m, by which vertices may lie outside a convex outline
MAX_FACES = 8  # of a hip roof
SAME_WAY = 0.996  # cosine of 5 degrees

Array = NDArray[np.float64]


@kernel
def fit_family(xyz: Array, a: Array, b: Array, along: Array, density: float, max_slope: float) -> Array:
    """Fit each family to the points of a house; give the planes of the one that fits best.

    Parameters
    ----------
    xyz : float64, (n, 3)
        Points (m), n > 0, in an order of their own.
    a, b : float64, (m, 2)
        Ends of the walls of the outline (m), the shell counter-clockwise.
    along : float64, (d, 2)
        Directions of the walls, unit vectors, the longest first.
    density : float
        Points a m².
    max_slope : float
        Greatest slope of a plane.

    Returns
    -------
    float64, (k, 3)
        Slopes and height at the origin; none where a flat roof is best.
    """
    step = max(1, len(xyz) // SAMPLES)
    some = np.empty(((len(xyz) + step - 1) // step, 3))
    for k in range(len(some)):
        some[k, 0], some[k, 1], some[k, 2] = xyz[k * step, 0], xyz[k * step, 1], xyz[k * step, 2]
    best, unit = 0.0, density / step
    for k in range(len(some)):
        best += misfit(some[k, 2] - some[len(some) // 2, 2])
    planes, n_planes = np.empty((MAX_FACES, 3)), 0
    for way in range(2 * min(len(along), 2)):
        x, y = along[way // 2, 0], along[way // 2, 1]
        up = (-y, x) if way % 2 == 0 else (x, y)
        cost, n = _try_gables(some, _extent(a, up), up, (best, unit, max_slope), planes)
        best, n_planes = (cost, n) if n else (best, n_planes)
        cost, n = _try_mansards(some, _extent(a, up), up, (best, unit, max_slope), planes)
        best, n_planes = (cost, n) if n else (best, n_planes)
    n = _try_hip(some, a, b, (best, unit, max_slope), planes)
    return planes[: n if n else n_planes].copy()


@kernel
def _extent(xy: Array, up: tuple[float, float]) -> tuple[float, float]:
    """Least and greatest place of an outline along a direction (m)."""
    low, high = math.inf, -math.inf
    for e in range(len(xy)):
        t = xy[e, 0] * up[0] + xy[e, 1] * up[1]
        low, high = min(low, t), max(high, t)
    return low, high


@kernel
def _try_gables(
    xyz: Array,
    extent: tuple[float, float],
    up: tuple[float, float],
    bounds: tuple[float, float, float],
    planes: Array,
) -> tuple[float, int]:
    """Try shed, gable and valley roofs across a house; write the best one's planes, give cost and number.

    0 planes where none is better than the first of the bounds; the others are the price of an area, and a slope.
    """
    best, unit, max_slope = bounds
    rows, weight = np.empty((len(xyz), 3)), np.empty(len(xyz))
    n_planes = 0
    for ridge in range(RIDGES):  # a shed has its bend at the lower end
        t0 = extent[0] + (extent[1] - extent[0]) * ridge / RIDGES
        left, right, top = _fit_broken(xyz, up, t0, math.inf, rows, weight)
        if max(abs(left), abs(right)) > max_slope:
            continue
        area = SHED if ridge == 0 else GABLE if left > right else VALLEY
        cost = _sum_misfit(rows, (left, right, top)) + unit * area
        if cost < best:
            best, n_planes = cost, 1 if ridge == 0 else 2
            _put_slope(planes, 0, right, up, (t0, top))
            _put_slope(planes, 1, left, up, (t0, top))
    return best, n_planes


@kernel
def _try_mansards(
    xyz: Array,
    extent: tuple[float, float],
    up: tuple[float, float],
    bounds: tuple[float, float, float],
    planes: Array,
) -> tuple[float, int]:
    """Try symmetrical roofs with two slopes on each side, as `_try_gables` does."""
    best, unit, max_slope = bounds
    rows, weight = np.empty((len(xyz), 3)), np.empty(len(xyz))
    t0, n_planes = (extent[0] + extent[1]) / 2, 0
    for width in range(1, BREAKS):
        half = (extent[1] - extent[0]) / 2 * width / BREAKS
        upper, lower, top = _fit_broken(xyz, up, t0, half, rows, weight)
        if not 0 <= upper < lower <= max_slope:
            continue
        cost = _sum_misfit(rows, (upper, lower, top)) + unit * MANSARD
        if cost < best:
            best, n_planes = cost, 4
            for side in range(2):
                sign = 1 if side == 0 else -1
                _put_slope(planes, 2 * side, -sign * upper, up, (t0, top))
                _put_slope(planes, 2 * side + 1, -sign * lower, up, (t0 + sign * half, top - upper * half))
    return best, n_planes


@kernel
def _put_slope(planes: Array, row: int, slope: float, up: tuple[float, float], at: tuple[float, float]) -> None:
    """Write the plane with a slope along a direction, and a height at a place along it."""
    planes[row, 0], planes[row, 1], planes[row, 2] = slope * up[0], slope * up[1], at[1] - slope * at[0]


@kernel
def _try_hip(xyz: Array, a: Array, b: Array, bounds: tuple[float, float, float], planes: Array) -> int:
    """Try a roof of one slope from all edges of a convex outline; write its planes and give their number, or 0."""
    best, unit, max_slope = bounds
    normal = np.empty((MAX_FACES, 3))
    n_faces = _find_eaves(a, b, normal)
    if n_faces < 3:
        return 0
    rows, weight = np.empty((len(xyz), 3)), np.empty(len(xyz))
    for k in range(len(xyz)):
        inside = math.inf
        for f in range(n_faces):
            inside = min(inside, normal[f, 0] * xyz[k, 0] + normal[f, 1] * xyz[k, 1] - normal[f, 2])
        rows[k, 0], rows[k, 1], rows[k, 2] = inside, 0.0, xyz[k, 2]
    slope, _, eave = _fit_robustly(rows, weight)
    if not 0 < slope <= max_slope or _sum_misfit(rows, (slope, 0.0, eave)) + unit * HIP >= best:
        return 0
    for f in range(n_faces):
        _put_slope(planes, f, slope, (normal[f, 0], normal[f, 1]), (normal[f, 2], eave))
    return n_faces


@kernel
def _fit_broken(
    xyz: Array, up: tuple[float, float], t0: float, half: float, rows: Array, weight: Array
) -> tuple[float, float, float]:
    """Fit a roof that bends at a place across the house.

    With an infinite half width: slopes before and after `t0`, and the height there. Else of a symmetrical roof:
    slopes downwards within the half width of `t0` and beyond it, and the height at `t0`. `rows` gets the places.
    """
    for k in range(len(xyz)):
        t = xyz[k, 0] * up[0] + xyz[k, 1] * up[1] - t0
        if half == math.inf:
            rows[k, 0], rows[k, 1] = min(t, 0.0), max(t, 0.0)
        else:
            rows[k, 0], rows[k, 1] = -min(abs(t), half), -max(abs(t) - half, 0.0)
        rows[k, 2] = xyz[k, 2]
    return _fit_robustly(rows, weight)


@kernel
def _fit_robustly(rows: Array, weight: Array) -> tuple[float, float, float]:
    """Fit ``z = a x + b y + c`` with weights that fall off with the distance."""
    a = b = c = 0.0
    for turn in range(ROUNDS):
        for k in range(len(rows)):
            r = (rows[k, 2] - a * rows[k, 0] - b * rows[k, 1] - c) / SOFT if turn else 0.0
            weight[k] = 1 / (1 + r * r)
        a, b, c = fit_slopes(rows, weight)
    return a, b, c


@kernel
def fit_slopes(rows: Array, weight: Array) -> tuple[float, float, float]:
    """Fit ``z = a x + b y + c`` where x or y may be 0 throughout, (n, 3)."""
    a, b, c = fit_weighted(rows, weight)
    if a != 0 or b != 0:
        return a, b, c
    sums = np.zeros(9)
    for k in range(len(rows)):  # along the sum of both: a second column that is independent makes it solvable
        w, x, z = weight[k], rows[k, 0] + rows[k, 1], rows[k, 2]
        sums[0] += w
        sums[1] += w * x
        sums[3] += w * x * x
        sums[6] += w * z
        sums[7] += w * x * z
    sums[5] = sums[3]
    a, _, c = solve_plane(sums)
    return a, a, c


@kernel
def _sum_misfit(rows: Array, roof: tuple[float, float, float]) -> float:
    total = 0.0
    for k in range(len(rows)):
        total += misfit(rows[k, 2] - roof[0] * rows[k, 0] - roof[1] * rows[k, 1] - roof[2])
    return total


@kernel
def _find_eaves(a: Array, b: Array, normal: Array) -> int:
    """Write the normal of each edge of an almost convex outline, and its product with the edge; give their number.

    Normals point inwards. None where the outline is not convex.
    """
    n = 0
    for e in range(len(a)):
        x, y = b[e, 0] - a[e, 0], b[e, 1] - a[e, 1]
        length = math.hypot(x, y)
        if length < LEAST_EDGE:
            continue
        x, y = -y / length, x / length
        offset = x * a[e, 0] + y * a[e, 1]
        for f in range(len(a)):
            if x * a[f, 0] + y * a[f, 1] < offset - STANDS_OUT:
                return 0
        twin = -1
        for f in range(n):
            if normal[f, 0] * x + normal[f, 1] * y > SAME_WAY:
                twin = f
        if twin >= 0:
            normal[twin, 2] = min(normal[twin, 2], offset)
        elif n == len(normal):
            return 0
        else:
            normal[n, 0], normal[n, 1], normal[n, 2] = x, y, offset
            n += 1
    return n
