"""Planes of a roof: the best supported of the local planes, one after the other (for `house_roofs`)."""

import math

import numpy as np
from numpy.typing import NDArray

from pipeline.data.kernel import kernel
from pipeline.roofs.local_planes import add_point, solve_plane

BAND = 0.25  # m, points within this distance (in height) support a plane
MAX_PLANES = 12  # of a house
MAX_LEVELS = 2  # flat planes of a house through points that are too rough for planes of their own
HYPOTHESES, SAMPLES = 200, 700  # local planes that are tried, and points that each is held against, at most
SAME_SLOPE = 0.25  # squared difference of slopes, over 1 + slope², up to which a local plane agrees
ROUGH = 0.3  # weight of a point without a local plane of its own
ENOUGH = 0.8  # score, as a share of the points without a plane, at which no better one is looked for
FLAT = 0.09  # slope below which a plane is flat
SNAP = 0.978  # cosine of 12 degrees: a plane this close to uphill across a wall is turned there
REFITS = 4
TOLERANCE = 0.5  # m, misfit is the square of the distance over this
FAR = 0.5  # misfit a metre of what is beyond
FARTHEST = 20.0  # m, beyond which misfit grows no more

Array = NDArray[np.float64]


@kernel(inline="always")
def misfit(r: float) -> float:
    """Misfit of a point at a distance (m) from a roof: squared where it is near, linear beyond, bounded."""
    r = abs(r) / TOLERANCE
    return r * r if r < 1 else 1 + FAR * (min(r, FARTHEST) - 1)


@kernel
def search_planes(xyz: Array, local: Array, least: float, max_slope: float, planes: Array) -> int:
    """Find the planes that most points support; write them, and give their number.

    Parameters
    ----------
    xyz : float64, (n, 3)
        Points of a house (m), near the origin and in an order of their own.
    local : float64, (n, 4)
        As from `fit_locally`.
    least : float
        Points that must support a plane.
    max_slope : float
        Greatest slope of a plane.
    planes : float64, (m, 3)
        Room for slopes and the height at the origin.

    Notes
    -----
    Each local plane is scored by the points that no plane has yet, by their distance. Points leave, so scores
    fall: only those that might be the best are computed anew, and none beyond one that nearly all points support.
    """
    n = len(xyz)
    free, smooth = np.ones(n, np.bool_), np.empty(n, np.bool_)
    for p in range(n):
        smooth[p] = local[p, 3] < BAND and local[p, 0] ** 2 + local[p, 1] ** 2 < max_slope * max_slope
    step = max(1, n // HYPOTHESES)
    score = np.full((n + step - 1) // step, math.inf)
    fresh = np.full(len(score), -1)
    weight = np.empty(n)
    n_planes = tries = 0
    while n_planes < len(planes) and tries < 2 * len(planes):
        best = _find_best(xyz, local, free, smooth, score, fresh, tries)
        if score[best] < least / 2:
            break
        p = best * step
        a, b = local[p, 0], local[p, 1]
        c = local[p, 2] - a * xyz[p, 0] - b * xyz[p, 1]
        count = 0
        for _ in range(REFITS):
            count = _weigh(xyz, local, free, smooth, weight, (a, b, c))
            if count < 3:
                break
            a, b, c = fit_weighted(xyz, weight)
        for q in range(n):
            if free[q] and (weight[q] > 0 or not smooth[q]):
                free[q] = abs(xyz[q, 2] - a * xyz[q, 0] - b * xyz[q, 1] - c) >= BAND
        free[p] = False
        score[best] = -1.0
        tries += 1
        if count >= least and a * a + b * b <= max_slope * max_slope:
            planes[n_planes, 0], planes[n_planes, 1], planes[n_planes, 2] = a, b, c
            n_planes += 1
    return n_planes


@kernel
def search_levels(xyz: Array, least: float, planes: Array, n: int) -> int:
    """Find the heights at which most points lie that no plane is near; write flat planes, and give their number.

    Parameters
    ----------
    xyz : float64, (p, 3)
        Points of a house, ascending by height (m).
    least : float
        Points that must lie within a band.
    planes : float64, (m, 3)
        The planes that there are, and room for `MAX_LEVELS` more.
    n : int
        Number of planes.

    Notes
    -----
    Small flat roofs, and those with plants or fences, have no smooth points: walls are within the neighbours of
    each. They lie at one height nevertheless. O(p n).
    """
    for _ in range(MAX_LEVELS):
        z, m = np.empty(len(xyz)), 0
        for p in range(len(xyz)):
            free = True
            for k in range(n):
                free &= abs(xyz[p, 2] - planes[k, 0] * xyz[p, 0] - planes[k, 1] * xyz[p, 1] - planes[k, 2]) >= BAND
            if free:
                z[m] = xyz[p, 2]
                m += 1
        first = best = begin = 0
        for end in range(m):
            while z[end] - z[first] > 2 * BAND:
                first += 1
            if end + 1 - first > best:
                best, begin = end + 1 - first, first
        if best < least:
            break
        planes[n, 0], planes[n, 1], planes[n, 2] = 0.0, 0.0, z[begin : begin + best].mean()
        n += 1
    return n


@kernel
def _find_best(
    xyz: Array,
    local: Array,
    free: NDArray[np.bool_],
    smooth: NDArray[np.bool_],
    score: Array,
    fresh: NDArray[np.int64],
    turn: int,
) -> int:
    """Find the local plane with the best score, or the first with `ENOUGH`; scores are brought up to date."""
    n = len(xyz)
    step, stride = max(1, n // HYPOTHESES), max(1, n // SAMPLES)
    enough = ENOUGH * free.sum()
    while True:
        best = 0
        for k in range(1, len(score)):
            if score[k] > score[best]:
                best = k
        if fresh[best] == turn or score[best] <= 0:
            return best
        fresh[best] = turn
        p = best * step
        if not (free[p] and smooth[p]):
            score[best] = -1.0
            continue
        a, b = local[p, 0], local[p, 1]
        c = local[p, 2] - a * xyz[p, 0] - b * xyz[p, 1]
        unlike = SAME_SLOPE * (1 + a * a + b * b)
        total = 0.0
        for q in range(0, n, stride):
            if free[q]:
                r = (xyz[q, 2] - a * xyz[q, 0] - b * xyz[q, 1] - c) / BAND
                if r * r < 1:
                    if not smooth[q]:
                        total += ROUGH * (1 - r * r)
                    elif (local[q, 0] - a) ** 2 + (local[q, 1] - b) ** 2 <= unlike:
                        total += 1 - r * r
        score[best] = total * stride
        if score[best] >= enough:
            return best


@kernel
def _weigh(
    xyz: Array,
    local: Array,
    free: NDArray[np.bool_],
    smooth: NDArray[np.bool_],
    weight: Array,
    plane: tuple[float, float, float],
) -> int:
    """Write the weights of the points that support a plane, and give their number."""
    a, b, c = plane
    unlike = SAME_SLOPE * (1 + a * a + b * b)
    count = 0
    for q in range(len(xyz)):
        weight[q] = 0.0
        if free[q] and abs(xyz[q, 2] - a * xyz[q, 0] - b * xyz[q, 1] - c) < BAND:
            if not smooth[q]:
                weight[q] = ROUGH
            elif (local[q, 0] - a) ** 2 + (local[q, 1] - b) ** 2 <= unlike:
                weight[q] = 1.0
            count += weight[q] > 0
    return count


@kernel
def fit_weighted(xyz: Array, weight: Array) -> tuple[float, float, float]:
    """Fit a plane to points (n, 3) with weights (n,), not all of them 0."""
    sums = np.zeros(9)
    for p in range(len(xyz)):
        if weight[p] > 0:
            add_point(sums, weight[p], xyz[p, 0], xyz[p, 1], xyz[p, 2])
    return solve_plane(sums)


@kernel
def refit_plane(xyz: Array, start: tuple[float, float, float], band: float) -> tuple[float, float, float]:
    """Fit a plane again to the points near it, (n, 3), whose weights fall off beyond a band (m)."""
    a, b, c = start
    weight = np.empty(len(xyz))
    for _ in range(REFITS - 1):
        if weigh_near(xyz, (a, b, c), band, weight) < 3:
            break
        a, b, c = fit_weighted(xyz, weight)
    return a, b, c


@kernel
def weigh_near(xyz: Array, plane: tuple[float, float, float], band: float, weight: Array) -> float:
    """Write weights that fall off with the distance from a plane, and give their sum."""
    a, b, c = plane
    total = 0.0
    for p in range(len(xyz)):
        r = (xyz[p, 2] - a * xyz[p, 0] - b * xyz[p, 1] - c) / band
        weight[p] = 1 / (1 + r * r) ** 2
        total += weight[p]
    return total


@kernel
def regularise(xyz: Array, plane: tuple[float, float, float], along: Array) -> tuple[float, float, float]:
    """Make a plane flat, or uphill across a wall, where it nearly is; its height is that of the points near it.

    Parameters
    ----------
    xyz : float64, (n, 3)
        Points (m).
    plane : tuple of 3 floats
        Slopes, and height at the origin (m).
    along : float64, (d, 2)
        Directions of the walls, unit vectors.
    """
    a, b, _ = plane
    weight = np.empty(len(xyz))
    if weigh_near(xyz, plane, BAND, weight) < 2:
        return plane
    slope = math.hypot(a, b)
    if slope < FLAT:
        return 0.0, 0.0, slope_along(xyz, weight, 0.0, 0.0)[1]
    best, up_x, up_y = SNAP, 0.0, 0.0
    for d in range(len(along)):
        for x, y in ((-along[d, 1], along[d, 0]), (along[d, 0], along[d, 1])):
            q = abs(x * a + y * b) / slope
            if q > best:
                best, up_x, up_y = q, x, y
    if up_x == 0 and up_y == 0:
        return plane
    s, height, _ = slope_along(xyz, weight, up_x, up_y)
    return s * up_x, s * up_y, height


@kernel
def slope_along(xyz: Array, weight: Array, up_x: float, up_y: float) -> tuple[float, float, float]:
    """Slope along a direction and height at the origin of weighted points, by least squares; variance along it."""
    w = wt = wtt = wz = wtz = 0.0
    for p in range(len(xyz)):
        t, z, u = up_x * xyz[p, 0] + up_y * xyz[p, 1], xyz[p, 2], weight[p]
        w += u
        wt += u * t
        wtt += u * t * t
        wz += u * z
        wtz += u * t * z
    spread = wtt - wt * wt / w
    slope = (wtz - wt * wz / w) / spread if spread > 1e-9 else 0.0
    return slope, (wz - slope * wt) / w, spread / w
