"""Where a piece of a house is cut: lines and rectangles whose sides fall best under different planes."""

import math

import numpy as np
from numpy.typing import NDArray

from pipeline.data.kernel import kernel
from pipeline.geometry.group_order import order_values

SHIFTS = 4  # to either side, within a clearance, by which a line is moved that has no room where it is best
MAX_TRIES = 5  # lines that are tried for a cut, the best first
RIDGE_BONUS = 0.25  # share of the price of a cut by which intersections of planes go before other lines
SAME_PLANE = 0.15  # difference of slopes below which planes have no ridge
MAX_BINS = 20  # across a piece, along each side of a rectangle
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
def order_across(xyz: Array, along: Array) -> tuple[Array, Index]:
    """Place of each point across each direction (m), (d, n), and the rows of points in that order, (d, n)."""
    across, order = np.empty((len(along), len(xyz))), np.empty((len(along), len(xyz)), np.int64)
    for d in range(len(along)):
        for p in range(len(xyz)):
            across[d, p] = xyz[p, 1] * along[d, 0] - xyz[p, 0] * along[d, 1]
        rows = order_values(across[d])
        for m in range(len(xyz)):
            order[d, m] = rows[m]
    return across, order


@kernel
def rank_cuts(
    xyz: Array,
    cost: Array,
    face: Index,
    rows: Index,
    lines: tuple[Array, Array, Array, Index],
    min_points: int,
    price: float,
) -> Array:
    """Rank the lines by the misfit that they save when each side takes its own best plane.

    Parameters
    ----------
    xyz : float64, (n, 3)
        Points of the house (m).
    cost : float64, (n, k)
        Misfit of each under each plane.
    face : int64, (n,)
        Face of each.
    rows : int64, (m,)
        The points of the face that is to be cut, at least one.
    lines : tuple
        Directions, (d, 2), along each of which the best line is looked for; direction and offset of further
        lines, (l, 3); and what `order_across` gives for the directions.
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
    along, fixed, across, order = lines
    total = sum_costs(cost, rows)
    sums = (total, len(rows), min_points)
    n_lines = len(along) + len(fixed) if total.min() >= price else 0
    found, loss = np.empty((n_lines, 4)), np.zeros(n_lines)
    for d in range(n_lines):
        if d < len(along):
            found[d, 0], found[d, 1] = along[d, 0], along[d, 1]
            saved, found[d, 2] = _best_offset(cost, face, face[rows[0]], order[d], across[d], sums)
            loss[d] = -saved
        else:
            found[d, 0], found[d, 1], found[d, 2] = fixed[d - len(along)]
            saved = _saved_by(xyz, cost, rows, fixed[d - len(along)], sums)
            loss[d] = -saved - RIDGE_BONUS * price
        found[d, 3] = saved
    ranked, n_ranked = np.empty((MAX_TRIES, 4)), 0
    for d in order_values(loss):
        if n_ranked < MAX_TRIES and found[d, 3] >= price:
            for q in range(4):
                ranked[n_ranked, q] = found[d, q]
            n_ranked += 1
    return ranked[:n_ranked].copy()


@kernel
def shift_cuts(
    xyz: Array,
    cost: Array,
    rows: Index,
    ranked: Array,
    min_points: int,
    rules: tuple[float, float],
) -> Array:
    """Move lines that have no room by up to a clearance, for they may save enough beside the best place too.

    Parameters
    ----------
    xyz, cost, rows, min_points
        As for `rank_cuts`.
    ranked : float64, (k, 4)
        As from there.
    rules : tuple of 2 floats
        What a line must save, and the clearance (m).

    Returns
    -------
    float64, (m, 4)
        As `ranked`.
    """
    price, clearance = rules
    sums = (sum_costs(cost, rows), len(rows), min_points)
    lines, m = np.empty((len(ranked) * 2 * SHIFTS, 4)), 0
    for k in range(len(ranked)):
        for step in range(-SHIFTS, SHIFTS + 1):
            lines[m, :2] = ranked[k, :2]
            lines[m, 2] = ranked[k, 2] + step * clearance / SHIFTS
            lines[m, 3] = _saved_by(xyz, cost, rows, lines[m, :3], sums) if step else 0.0
            if lines[m, 3] >= price:
                m += 1
    kept: Array = lines[:m][order_values(-lines[:m, 3])]
    return kept


@kernel
def _best_offset(
    cost: Array, face: Index, piece: int, order: Index, across: Array, sums: tuple[Array, int, int]
) -> tuple[float, float]:
    """What the best line across a direction saves, 0 if none does, and its offset (m)."""
    total, n, min_points = sums
    left, whole = np.zeros(len(total)), total.min()
    best, offset, before, last = 0.0, 0.0, 0, 0.0
    saved = 0.0
    for p in order:
        if face[p] != piece:
            continue
        if saved > best:
            best, offset = saved, (last + across[p]) / 2
        saved, low, high = 0.0, math.inf, math.inf
        for k in range(len(total)):
            left[k] += cost[p, k]
            low, high = min(low, left[k]), min(high, total[k] - left[k])
        before, last = before + 1, across[p]
        if min_points <= before <= n - min_points:
            saved = whole - low - high
    return best, offset


@kernel
def _saved_by(xyz: Array, cost: Array, rows: Index, line: Array, sums: tuple[Array, int, int]) -> float:
    """What a line saves; 0 with too few points on a side."""
    total, n, min_points = sums
    left, before = np.zeros(len(total)), 0
    for p in rows:
        if xyz[p, 1] * line[0] - xyz[p, 0] * line[1] < line[2]:
            before += 1
            for k in range(len(total)):
                left[k] += cost[p, k]
    if not min_points <= before <= n - min_points:
        return 0.0
    low = high = math.inf
    for k in range(len(total)):
        low, high = min(low, left[k]), min(high, total[k] - left[k])
    saved: float = total.min() - low - high
    return saved


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
    most = np.zeros(len(total))  # that each plane may save
    for p in rows:
        for k in range(len(total)):
            most[k] += max(cost[p, base] - cost[p, k], 0.0)
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
            if k == base or most[k] <= max(price, best[0]):
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
    column, hope = np.empty((2, n_columns)), np.zeros(n_rows + 1)
    for i in range(n_rows - 1, -1, -1):  # what rectangles that begin in this row or later can save
        hope[i] = hope[i + 1]
        for j in range(n_columns):
            hope[i] += max(grid[0, i, j], 0.0)
    for i in range(n_rows):
        if hope[i] <= best:
            break
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
