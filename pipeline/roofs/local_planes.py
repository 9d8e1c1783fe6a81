"""Planes through the nearest neighbours of each roof point (for `house_roofs`)."""

import math

import numpy as np
from numpy.typing import NDArray

from pipeline.data.kernel import kernel

FEW, MANY = 9, 14  # neighbours of a point, itself among them, below and above `DENSE`
DENSE = 7.0  # points a m²
LEFT_OUT = 5  # one in so many neighbours, the farthest from a first plane, is left out of the second
LEAST_CELL, MOST_CELLS = 0.1, 1000  # m; and cells along a house
CELL_POINTS = 3.0  # mean number of points of a cell in which neighbours are looked for
THIN = 1e-6  # points whose spread across is less than this share of that along have no slope

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@kernel
def fit_locally(start: Index, xyz: Array, area: Array) -> Array:
    """Fit a plane to the neighbours of each point within its house.

    Parameters
    ----------
    start : int64, (h + 1,)
        House ``i`` has the points ``xyz[start[i]:start[i + 1]]``.
    xyz : float64, (n, 3)
        Points (m) near the origin, in an order of their own: of neighbours at equal distances the first counts.
    area : float64, (h,)
        Areas of the houses (m²).

    Returns
    -------
    float64, (n, 4)
        Slopes eastwards and northwards, height of the plane over the point, and root of the mean squared
        distance of the neighbours that it was fitted to (m).

    Notes
    -----
    The plane is fitted by least squares, and once more without the fifth of the neighbours that is farthest
    from it. O(n k).
    """
    planes = np.empty((len(xyz), 4))
    near, sums, far = np.empty((len(xyz), MANY), np.int64), np.empty(9), np.empty(MANY)
    for i in range(len(start) - 1):
        first, last = start[i], start[i + 1]
        n = last - first
        k = min(n, FEW if n < DENSE * area[i] else MANY)
        if k >= 3:
            _find_nearest(xyz, first, last, k, near)
        for p in range(first, last):
            if k >= 3:
                _fit_one(xyz, p, near, k, planes, sums, far)
            else:
                planes[p, 0], planes[p, 1], planes[p, 2], planes[p, 3] = 0.0, 0.0, xyz[p, 2], math.inf
    return planes


@kernel
def _find_nearest(xyz: Array, first: int, last: int, k: int, near: Index) -> None:
    """Write the rows of the k nearest points, in the plan, of each of some points."""
    left, right, under, over = math.inf, -math.inf, math.inf, -math.inf
    for p in range(first, last):
        left, right = min(left, xyz[p, 0]), max(right, xyz[p, 0])
        under, over = min(under, xyz[p, 1]), max(over, xyz[p, 1])
    mean = math.sqrt((right - left) * (over - under) * CELL_POINTS / (last - first))
    size = max(mean, LEAST_CELL, max(right - left, over - under) / MOST_CELLS)
    columns, rows = int((right - left) / size) + 1, int((over - under) / size) + 1
    start, order = _put_in_cells(xyz, first, last, (left, under, size), (columns, rows))
    away = np.empty(k)
    for p in range(first, last):
        x, y = xyz[p, 0], xyz[p, 1]
        i, j = int((x - left) / size), int((y - under) / size)
        # What is within this distance of the point, and `size` more with each ring, lies in the cells looked at.
        beside = min(x - left - i * size, left + (i + 1) * size - x)
        margin = min(beside, y - under - j * size, under + (j + 1) * size - y)
        found = ring = 0
        while ring <= max(columns, rows):
            for row in range(max(j - ring, 0), min(j + ring, rows - 1) + 1):
                step = 1 if row in (j - ring, j + ring) else max(2 * ring, 1)
                for column in range(i - ring, i + ring + 1, step):
                    if 0 <= column < columns:
                        cell = row * columns + column
                        for m in range(start[cell], start[cell + 1]):
                            found = _put_near(xyz, p, order[m], away, near, found)
            reach = margin + ring * size
            if found == k and reach > 0 and away[k - 1] < reach * reach:
                break
            ring += 1


@kernel
def _put_in_cells(
    xyz: Array, first: int, last: int, grid: tuple[float, float, float], shape: tuple[int, int]
) -> tuple[Index, Index]:
    """Put points into square cells: where those of each cell start, row by row, and rows of points."""
    left, under, size = grid
    cell, start = np.empty(last - first, np.int64), np.zeros(shape[0] * shape[1] + 1, np.int64)
    for p in range(first, last):
        cell[p - first] = int((xyz[p, 1] - under) / size) * shape[0] + int((xyz[p, 0] - left) / size)
        start[cell[p - first] + 1] += 1
    for c in range(len(start) - 1):
        start[c + 1] += start[c]
    order, free = np.empty(last - first, np.int64), start.copy()
    for p in range(first, last):
        c = cell[p - first]
        order[free[c]] = p
        free[c] += 1
    return start, order


@kernel(inline="always")
def _put_near(xyz: Array, p: int, q: int, away: Array, near: Index, found: int) -> int:
    """Take point q among the nearest of point p, by distance, then by row; give how many there are."""
    k = len(away)
    d = (xyz[q, 0] - xyz[p, 0]) ** 2 + (xyz[q, 1] - xyz[p, 1]) ** 2
    if found == k and (d > away[k - 1] or (d == away[k - 1] and q > near[p, k - 1])):
        return found
    at = found if found < k else k - 1
    while at > 0 and (d < away[at - 1] or (d == away[at - 1] and q < near[p, at - 1])):
        away[at], near[p, at] = away[at - 1], near[p, at - 1]
        at -= 1
    away[at], near[p, at] = d, q
    return min(found + 1, k)


@kernel
def _fit_one(xyz: Array, p: int, near: Index, k: int, planes: Array, sums: Array, far: Array) -> None:
    """Write the plane through the neighbours of a point."""
    x0, y0, z0 = xyz[p, 0], xyz[p, 1], xyz[p, 2]
    sums[:] = 0
    for m in range(k):
        q = near[p, m]
        add_point(sums, 1.0, xyz[q, 0] - x0, xyz[q, 1] - y0, xyz[q, 2] - z0)
    a, b, c = solve_plane(sums)
    for m in range(k):
        q = near[p, m]
        far[m] = abs(xyz[q, 2] - z0 - a * (xyz[q, 0] - x0) - b * (xyz[q, 1] - y0) - c)
    n_left = max(1, k // LEFT_OUT) if k > 3 else 0
    for _ in range(n_left):
        worst = 0
        for m in range(1, k):
            if far[m] > far[worst]:
                worst = m
        q = near[p, worst]
        add_point(sums, -1.0, xyz[q, 0] - x0, xyz[q, 1] - y0, xyz[q, 2] - z0)
        far[worst] = -1.0
    a, b, c = solve_plane(sums)
    squares = 0.0
    for m in range(k):
        if far[m] >= 0:
            q = near[p, m]
            squares += (xyz[q, 2] - z0 - a * (xyz[q, 0] - x0) - b * (xyz[q, 1] - y0) - c) ** 2
    planes[p, 0], planes[p, 1], planes[p, 2] = a, b, z0 + c
    planes[p, 3] = math.sqrt(squares / (k - n_left))


@kernel(inline="always")
def add_point(sums: Array, weight: float, x: float, y: float, z: float) -> None:
    """Add a point to the sums of `solve_plane`."""
    sums[0] += weight
    sums[1] += weight * x
    sums[2] += weight * y
    sums[3] += weight * x * x
    sums[4] += weight * x * y
    sums[5] += weight * y * y
    sums[6] += weight * z
    sums[7] += weight * x * z
    sums[8] += weight * y * z


@kernel
def solve_plane(sums: Array) -> tuple[float, float, float]:
    """Solve ``z = a x + b y + c`` by least squares.

    Parameters
    ----------
    sums : float64, (9,)
        Weights w, w x, w y, w x², w x y, w y², w z, w x z, w y z of all points, not all of weight 0.

    Returns
    -------
    a, b, c : float
        The mean height, and no slope, where the points lie on a line.
    """
    n = sums[0]
    x, y, z = sums[1] / n, sums[2] / n, sums[6] / n
    xx, xy, yy = sums[3] - n * x * x, sums[4] - n * x * y, sums[5] - n * y * y
    xz, yz = sums[7] - n * x * z, sums[8] - n * y * z
    determinant = xx * yy - xy * xy
    if determinant <= THIN * (xx + yy) ** 2 + 1e-9:
        return 0.0, 0.0, z
    a, b = (xz * yy - yz * xy) / determinant, (yz * xx - xz * xy) / determinant
    return a, b, z - a * x - b * y
