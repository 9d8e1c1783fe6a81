"""Where a piece of a house is cut: lines and rectangles whose sides fall best under different planes."""

import math

import numpy as np
from numpy.typing import NDArray

from pipeline.data.kernel import kernel
from pipeline.geometry.group_order import order_values

MAX_TRIES = 5  # lines that are tried for a cut, the best first
RIDGE_BONUS = 0.25  # share of the price of a cut by which intersections of planes go before other lines
SAME_PLANE = 0.15  # difference of slopes below which planes have no ridge
MAX_BINS = 24  # across a piece, along each side of a rectangle
LEAST_BIN = 0.5  # m
RIGHT = 0.09  # cosine of 85 degrees: directions this close to a right angle have the same rectangles
OPEN = 1e9  # offset of a side of a rectangle that lies on the piece's own walls

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@kernel
def find_ridges(planes: Array) -> Array:
    """Lines in which planes meet: direction and offset of each, float64 (m, 3)."""
    lines = np.empty((len(planes) * (len(planes) - 1) // 2, 3))
    n = 0
    for i in range(len(planes)):
        for j in range(i):
            a, b, c = planes[i, 0] - planes[j, 0], planes[i, 1] - planes[j, 1], planes[i, 2] - planes[j, 2]
            slope = math.hypot(a, b)
            if slope >= SAME_PLANE:
                lines[n, 0], lines[n, 1], lines[n, 2] = -b / slope, a / slope, c / slope
                n += 1
    return lines[:n].copy()


@kernel
def rank_cuts(  # noqa: PLR0912
    xyz: Array, cost: Array, rows: Index, along: Array, lines: Array, min_points: int, price: float
) -> Array:
    """Rank the lines by the misfit that they save when each side takes its own best plane.

    Parameters
    ----------
    xyz : float64, (n, 3)
        Points of the house (m).
    cost : float64, (n, k)
        Misfit of each under each plane.
    rows : int64, (m,)
        Points of the piece that is to be cut.
    along : float64, (d, 2)
        Directions, along each of which the best line is looked for.
    lines : float64, (l, 3)
        Direction and offset of further lines.
    min_points : int
        Least number of points on either side.
    price : float
        What a line must save.

    Returns
    -------
    float64, (k, 4)
        Direction and offset of the lines that save as much, and what they save, the best first, at most
        `MAX_TRIES`.
    """
    n, n_planes = len(rows), cost.shape[1]
    total, left = sum_costs(cost, rows), np.empty(n_planes)
    whole = total.min()
    n_lines = len(along) + len(lines)
    found, loss = np.empty((n_lines, 4)), np.zeros(n_lines)
    across = np.empty(n)
    for d in range(n_lines):
        free = d < len(along)
        x, y = (along[d, 0], along[d, 1]) if free else (lines[d - len(along), 0], lines[d - len(along), 1])
        for m in range(n):
            across[m] = xyz[rows[m], 1] * x - xyz[rows[m], 0] * y
        left[:] = 0
        best, offset = 0.0, 0.0
        if free:
            order = order_values(across)
            for m in range(n - 1):
                low = high = math.inf
                p = rows[order[m]]
                for k in range(n_planes):
                    left[k] += cost[p, k]
                    low, high = min(low, left[k]), min(high, total[k] - left[k])
                if min_points <= m + 1 <= n - min_points and whole - low - high > best:
                    best = whole - low - high
                    offset = (across[order[m]] + across[order[m + 1]]) / 2
        else:
            offset = lines[d - len(along), 2]
            count = 0
            for m in range(n):
                if across[m] < offset:
                    count += 1
                    for k in range(n_planes):
                        left[k] += cost[rows[m], k]
            if min_points <= count <= n - min_points:
                low = high = math.inf
                for k in range(n_planes):
                    low, high = min(low, left[k]), min(high, total[k] - left[k])
                best = whole - low - high
        found[d, 0], found[d, 1], found[d, 2], found[d, 3] = x, y, offset, best
        loss[d] = -best if free or best <= 0 else -best - RIDGE_BONUS * price
    ranked, n_ranked = np.empty((MAX_TRIES, 4)), 0
    for d in order_values(loss):
        if n_ranked < MAX_TRIES and found[d, 3] >= price:
            for q in range(4):
                ranked[n_ranked, q] = found[d, q]
            n_ranked += 1
    return ranked[:n_ranked].copy()


@kernel
def sum_costs(cost: Array, rows: Index) -> Array:
    """Misfit of some points under each plane."""
    total = np.zeros(cost.shape[1])
    for p in rows:
        for k in range(len(total)):
            total[k] += cost[p, k]
    return total


@kernel
def find_rectangle(
    xyz: Array, cost: Array, rows: Index, along: Array, min_points: int, price: float, clearance: float
) -> Array:
    """Find the rectangle in which another plane than that of the piece saves most misfit.

    Parameters
    ----------
    xyz, cost, rows, along, min_points, price
        As for `rank_cuts`.
    clearance : float
        A side closer than this to the last point of the piece is left open (m).

    Returns
    -------
    float64, (9,)
        What is saved, 0 for no rectangle; direction of its first two sides; their offsets; the offsets of the
        others, a quarter turn to the left of these, all `OPEN` or its negative where no wall is needed; and the
        place of its middle.

    Notes
    -----
    Points are counted in squares; for each pair of rows the best run of columns is found in one pass.
    O(bins³) for each plane that might save enough.
    """
    n = len(rows)
    best = np.zeros(9)
    total = sum_costs(cost, rows)
    base = total.argmin()
    t, u = np.empty(n), np.empty(n)
    i, j = np.empty(n, np.int64), np.empty(n, np.int64)
    for d in range(min(len(along), 2)):
        x, y = along[d, 0], along[d, 1]
        if d > 0 and abs(x * along[0, 0] + y * along[0, 1]) < RIGHT:
            continue
        low_t = low_u = math.inf
        high_t = high_u = -math.inf
        for m in range(n):
            p = rows[m]
            t[m], u[m] = xyz[p, 1] * x - xyz[p, 0] * y, -(xyz[p, 0] * x + xyz[p, 1] * y)
            low_t, high_t = min(low_t, t[m]), max(high_t, t[m])
            low_u, high_u = min(low_u, u[m]), max(high_u, u[m])
        step_t = max(LEAST_BIN, (high_t - low_t) / MAX_BINS)
        step_u = max(LEAST_BIN, (high_u - low_u) / MAX_BINS)
        grid = np.zeros((2, int((high_t - low_t) / step_t) + 1, int((high_u - low_u) / step_u) + 1))
        for m in range(n):
            i[m], j[m] = int((t[m] - low_t) / step_t), int((u[m] - low_u) / step_u)
            grid[1, i[m], j[m]] += 1
        for k in range(len(total)):
            saved = 0.0
            for p in rows:
                saved += max(cost[p, base] - cost[p, k], 0.0)
            if k == base or saved <= max(price, best[0]):
                continue
            grid[0] = 0
            for m in range(n):
                grid[0, i[m], j[m]] += cost[rows[m], base] - cost[rows[m], k]
            least_t, least_u = math.ceil(2 * clearance / step_t), math.ceil(2 * clearance / step_u)
            gain, i0, i1, j0, j1 = _best_bins(grid, max(price, best[0]), (min_points, least_t, least_u))
            if gain > best[0]:
                best[0], best[1], best[2] = gain, x, y
                from_t, to_t, from_u, to_u = i0 * step_t, i1 * step_t, j0 * step_u, j1 * step_u
                best[3] = low_t + from_t if from_t >= clearance else -OPEN
                best[4] = low_t + to_t if high_t - low_t - to_t >= clearance else OPEN
                best[5] = low_u + from_u if from_u >= clearance else -OPEN
                best[6] = low_u + to_u if high_u - low_u - to_u >= clearance else OPEN
                middle_t, middle_u = low_t + (from_t + to_t) / 2, low_u + (from_u + to_u) / 2
                best[7], best[8] = -y * middle_t - x * middle_u, x * middle_t - y * middle_u
    return best


@kernel
def _best_bins(grid: Array, best: float, least: tuple[int, int, int]) -> tuple[float, int, int, int, int]:
    """Find the rectangle of bins that saves more than `best`: what it saves, first and last row and column.

    It has the least numbers of points, rows and columns, and leaves as many points outside; 0 for none.
    """
    n_rows, n_columns = grid.shape[1], grid.shape[2]
    n_points = grid[1].sum()
    found = (0.0, 0, 0, 0, 0)
    column = np.empty((2, n_columns))
    for i in range(n_rows):
        column[:] = 0
        for k in range(i, n_rows):
            run, count, first = 0.0, 0.0, 0
            for j in range(n_columns):
                column[0, j] += grid[0, k, j]
                column[1, j] += grid[1, k, j]
                if run <= 0:
                    run, count, first = 0.0, 0.0, j
                run += column[0, j]
                count += column[1, j]
                wide = k + 1 - i >= least[1] and j + 1 - first >= least[2]
                if run > best and wide and least[0] <= count <= n_points - least[0]:
                    best, found = run, (run, i, k + 1, first, j + 1)
    return found
