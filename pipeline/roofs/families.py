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
def fit_family(  # noqa: PLR0912
    xyz: Array, a: Array, b: Array, along: Array, density: float, max_slope: float
) -> Array:
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
    n = (len(xyz) + step - 1) // step
    some = np.empty((n, 3))
    for k in range(n):
        some[k, 0], some[k, 1], some[k, 2] = xyz[k * step, 0], xyz[k * step, 1], xyz[k * step, 2]
    unit = density / step
    best, planes, n_planes = 0.0, np.empty((MAX_FACES, 3)), 0
    for k in range(n):
        best += misfit(some[k, 2] - some[n // 2, 2])
    rows, weight = np.empty((n, 3)), np.empty(n)
    for way in range(2 * min(len(along), 2)):
        up_x, up_y = along[way // 2, 0], along[way // 2, 1]
        if way % 2 == 0:
            up_x, up_y = -up_y, up_x
        low = high = a[0, 0] * up_x + a[0, 1] * up_y
        for e in range(len(a)):
            t = a[e, 0] * up_x + a[e, 1] * up_y
            low, high = min(low, t), max(high, t)
        # One slope: the break lies at the lower end.
        for ridge in range(RIDGES):
            t0 = low + (high - low) * ridge / RIDGES
            left, right, top = _fit_broken(some, (up_x, up_y), t0, math.inf, rows, weight)
            if max(abs(left), abs(right)) > max_slope:
                continue
            cost = _sum_misfit(rows, (left, right, top)) + unit * (
                SHED if ridge == 0 else GABLE if left > right else VALLEY
            )
            if cost < best:
                best, n_planes = cost, 1 if ridge == 0 else 2
                planes[0, 0], planes[0, 1], planes[0, 2] = right * up_x, right * up_y, top - right * t0
                planes[1, 0], planes[1, 1], planes[1, 2] = left * up_x, left * up_y, top - left * t0
        for width in range(1, BREAKS):
            t0, half = (low + high) / 2, (high - low) / 2 * width / BREAKS
            upper, lower, top = _fit_broken(some, (up_x, up_y), t0, half, rows, weight)
            if not 0 <= upper < lower <= max_slope:
                continue
            cost = _sum_misfit(rows, (upper, lower, top)) + unit * MANSARD
            if cost < best:
                best, n_planes = cost, 4
                for side in range(2):
                    sign = 1 if side == 0 else -1
                    u, v = -sign * upper, -sign * lower
                    row = 2 * side
                    planes[row, 0], planes[row, 1], planes[row, 2] = u * up_x, u * up_y, top - u * t0
                    corner = top - upper * half
                    planes[row + 1, 0], planes[row + 1, 1] = v * up_x, v * up_y
                    planes[row + 1, 2] = corner - v * (t0 + sign * half)
    normal, n_faces = np.empty((MAX_FACES, 3)), 0
    n_faces = _find_eaves(a, b, normal)
    if n_faces >= 3:
        for k in range(n):
            inside = math.inf
            for f in range(n_faces):
                inside = min(inside, normal[f, 0] * some[k, 0] + normal[f, 1] * some[k, 1] - normal[f, 2])
            rows[k, 0], rows[k, 1], rows[k, 2] = inside, 0.0, some[k, 2]
        slope, _, eave = _fit_robustly(rows, weight)
        if 0 < slope <= max_slope and _sum_misfit(rows, (slope, 0.0, eave)) + unit * HIP < best:
            n_planes = n_faces
            for f in range(n_faces):
                planes[f, 0], planes[f, 1] = slope * normal[f, 0], slope * normal[f, 1]
                planes[f, 2] = eave - slope * normal[f, 2]
    return planes[:n_planes].copy()


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
