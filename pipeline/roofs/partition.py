"""A house cut into cells, each under one of its planes, and cells joined to parts (for `house_roofs`)."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.data.kernel import kernel
from pipeline.geometry.group_order import order_values
from pipeline.geometry.outlines import Outline, deal_out
from pipeline.geometry.segments import add_places
from pipeline.roofs.cuts import cut_along
from pipeline.roofs.lines import Line

MAX_TRIES = 5  # lines that are tried for a cut, the best first
RIDGE_BONUS = 0.25  # share of the price of a cut by which intersections of planes go before other lines
SAME_PLANE = 0.15  # difference of slopes below which planes have no ridge

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Fit:
    """Points of a house and the planes that its parts may have.

    Attributes
    ----------
    xyz : float64, (n, 3)
        Points (m) about an origin near the house, in an order of their own.
    planes : float64, (k, 3)
        Slopes and height at that origin.
    cost : float64, (n, k)
        Misfit of each point under each plane.
    along : float64, (d, 2)
        Directions of walls, unit vectors.
    price : float
        What a cut must save.
    """

    xyz: Array
    planes: Array
    cost: Array
    along: Array
    price: float


def cut_to_cells(
    outline: Outline, fit: Fit, *, clearance: float, min_area: float, min_points: int, max_depth: int
) -> tuple[list[Outline], list[Index]]:
    """Cut a house into cells that share all vertices.

    Returns
    -------
    cells : list of Outline
    points : list of int64 arrays
        Rows of the points in each.
    """
    everything = np.arange(len(fit.xyz))
    todo = [(outline, everything, max_depth)]
    cells: list[Outline] = []
    points: list[Index] = []
    corners = np.empty((0, 2))
    lines = find_ridges(fit.planes)
    while todo:
        piece, rows, depth = todo.pop()
        cut = None
        if depth > 0 and len(rows) >= 2 * min_points and piece.area >= 2 * min_area:
            least = max(min_points // 2, int(0.5 * len(rows) * min_area / piece.area))
            ranked = rank_cuts(fit.xyz, fit.cost, rows, fit.along, lines, least, fit.price)
            for x, y, offset in ranked.tolist():
                pieces, ends = cut_along(
                    piece.with_corners(corners), Line(np.array([x, y]), offset), clearance=clearance
                )
                if len(pieces):
                    cut = pieces, ends
                    break
        if cut is None:
            cells.append(piece)
            points.append(rows)
            continue
        corners = add_places(corners, cut[1])
        tagged = np.column_stack((fit.xyz[rows, :2], rows.astype(np.float64)))
        for part, inside in deal_out(cut[0], tagged):
            todo.append((part, inside[:, 2].astype(np.int64), depth - 1))
    return [cell.with_corners(corners) for cell in cells], points


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
    xyz, cost
        As in `Fit`.
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
    float64, (k, 3)
        Direction and offset of the lines that save as much, the best first, at most `MAX_TRIES`.
    """
    n, n_planes = len(rows), cost.shape[1]
    total, left = np.zeros(n_planes), np.empty(n_planes)
    for p in rows:
        for k in range(n_planes):
            total[k] += cost[p, k]
    whole = total.min()
    n_lines = len(along) + len(lines)
    found, loss, saved = np.empty((n_lines, 3)), np.zeros(n_lines), np.zeros(n_lines)
    across = np.empty(n)
    for d in range(n_lines if whole > price else 0):
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
        found[d, 0], found[d, 1], found[d, 2], saved[d] = x, y, offset, best
        loss[d] = -best if free or best <= 0 else -best - RIDGE_BONUS * price
    ranked, n_ranked = np.empty((MAX_TRIES, 3)), 0
    for d in order_values(loss):
        if saved[d] < price or n_ranked == MAX_TRIES or saved[d] <= 0:
            break
        ranked[n_ranked, 0], ranked[n_ranked, 1], ranked[n_ranked, 2] = found[d, 0], found[d, 1], found[d, 2]
        n_ranked += 1
    return ranked[:n_ranked].copy()


def join_parts(
    cells: list[Outline],
    points: list[Index],
    fit: Fit,
    *,
    min_area: float,
    min_points: int,
    min_step: float,
    min_kink: float,
) -> tuple[Index, Index]:
    """Join cells under the same plane, too small ones, and those that a wall does not pay for.

    Returns
    -------
    region : int64, (c,)
        Region of each cell, named by its first cell.
    plane : int64, (c,)
        Row of the plane of each region, by its name.
    """
    n = len(cells)
    energy = np.array([fit.cost[rows].sum(axis=0) for rows in points]).reshape(n, -1)
    area = np.array([cell.area for cell in cells])
    count = np.array([len(rows) for rows in points])
    borders = find_borders(
        np.cumsum([0, *(len(cell.xy) for cell in cells)]),
        np.concatenate([cell.xy for cell in cells]),
        np.concatenate([cell.ring for cell in cells]),
    )
    region = join_regions(
        borders, energy, area, count, fit.planes, (min_area, float(min_points), fit.price, min_step, min_kink)
    )
    return region, energy.argmin(axis=1)


@kernel
def find_borders(start: Index, xy: Array, ring: Index) -> Array:
    """Edges that two cells share: both cells and both ends, float64 (b, 6)."""
    n = len(xy)
    m = 0
    owner = np.empty(n, np.int64)
    for c in range(len(start) - 1):
        for v in range(start[c], start[c + 1]):
            owner[v] = c
    for v in range(1, n):
        if ring[v] == ring[v - 1] and owner[v] == owner[v - 1]:
            m += 1
    key = np.empty(m)
    row = np.empty(m, np.int64)
    m = 0
    for v in range(1, n):
        if ring[v] == ring[v - 1] and owner[v] == owner[v - 1]:
            key[m] = xy[v, 0] + xy[v - 1, 0] + math.pi * (xy[v, 1] + xy[v - 1, 1])
            row[m] = v
            m += 1
    order = order_values(key)
    borders = np.empty((m, 6))
    b = 0
    for i in range(m):
        v = row[order[i]]
        for j in range(i + 1, m):
            if key[order[j]] > key[order[i]] + 1e-6:
                break
            w = row[order[j]]
            if (
                owner[v] != owner[w]
                and xy[v, 0] == xy[w - 1, 0]
                and xy[v, 1] == xy[w - 1, 1]
                and xy[w, 0] == xy[v - 1, 0]
                and xy[w, 1] == xy[v - 1, 1]
            ):
                borders[b, 0], borders[b, 1] = min(owner[v], owner[w]), max(owner[v], owner[w])
                borders[b, 2], borders[b, 3] = xy[v, 0], xy[v, 1]
                borders[b, 4], borders[b, 5] = xy[v - 1, 0], xy[v - 1, 1]
                b += 1
    return borders[:b].copy()


@kernel
def join_regions(  # noqa: PLR0912
    borders: Array,
    energy: Array,
    area: Array,
    count: Index,
    planes: Array,
    rules: tuple[float, float, float, float, float],
) -> Index:
    """Join cells as `join_parts` does; energy, area and count of cells become those of regions."""
    min_area, min_points, price, min_step, min_kink = rules
    region = np.arange(len(area))
    best_plane = np.empty(len(area), np.int64)
    for c in range(len(area)):
        best_plane[c] = energy[c].argmin()
    while True:
        best_why, best_cost, best_one, best_two = 9, math.inf, -1, -1
        for k in range(len(borders)):
            r, s = region[int(borders[k, 0])], region[int(borders[k, 1])]
            one, two = min(r, s), max(r, s)
            if one == two:
                continue
            low = math.inf
            for p in range(len(planes)):
                low = min(low, energy[one, p] + energy[two, p])
            i, j = best_plane[one], best_plane[two]
            cost = low - energy[one, i] - energy[two, j]
            why = 9
            if i == j:
                why = 0
            elif min(area[one], area[two]) < min_area or min(count[one], count[two]) < min_points:
                why = 1
            elif cost < price:
                why = 2
            elif math.hypot(planes[i, 0] - planes[j, 0], planes[i, 1] - planes[j, 1]) < min_kink:
                gap = 0.0
                for m in range(len(borders)):
                    q, t = region[int(borders[m, 0])], region[int(borders[m, 1])]
                    if min(q, t) == one and max(q, t) == two:
                        for at in (2, 4):
                            gap = max(
                                gap,
                                abs(
                                    (planes[i, 0] - planes[j, 0]) * borders[m, at]
                                    + (planes[i, 1] - planes[j, 1]) * borders[m, at + 1]
                                    + planes[i, 2]
                                    - planes[j, 2]
                                ),
                            )
                if gap < min_step:
                    why = 3
            better = why < best_why or (
                why == best_why
                and (
                    cost < best_cost
                    or (cost == best_cost and (one < best_one or (one == best_one and two < best_two)))
                )
            )
            if why < 9 and better:
                best_why, best_cost, best_one, best_two = why, cost, one, two
        if best_one < 0:
            return region
        for c in range(len(region)):
            if region[c] == best_two:
                region[c] = best_one
        for p in range(len(planes)):
            energy[best_one, p] += energy[best_two, p]
        area[best_one] += area[best_two]
        count[best_one] += count[best_two]
        best_plane[best_one] = energy[best_one].argmin()
