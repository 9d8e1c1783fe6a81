"""Neighbouring cells of a house joined until the roof steps at every wall that is left (for `house_levels`)."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pipeline.data.kernel import kernel
from pipeline.geometry.group_order import order_values, sort_group
from pipeline.geometry.outlines import Outline
from pipeline.geometry.segments import heights_beside

STEP_REACH = 2.0  # m on both sides of a wall, where the roof has to step
MIN_NEAR = 3  # points on each side of a wall, to see a step there
TOO_SMALL, NO_STEP, APART = range(3)  # why two regions are joined, the first reason first; or not

Array = NDArray[np.float64]
Index = NDArray[np.int64]


def join_cells(
    cells: Sequence[Outline],
    points: Sequence[Array],
    *,
    min_step: float,
    min_area: float,
    min_points: int,
) -> tuple[Index, float]:
    """Join neighbouring cells until every region is large enough and the roof steps at each border.

    Parameters
    ----------
    cells : sequence of c Outline
        Cells that share their vertices, to the bit, where they touch.
    points : sequence of c float64 arrays (n, 3)
        Points of each cell (m).
    min_step : float
        Least step (m): of the medians of both regions, and of the medians of the points within `STEP_REACH`
        of their border, where both sides have `MIN_NEAR` of them.
    min_area, min_points
        What a region has at least (m², and points).

    Returns
    -------
    region : int64, (c,)
        Region of each cell, named by its first cell. A single region may be smaller.
    within : float
        Squares of the heights of all points around the mean of their region (m²).

    Notes
    -----
    Too small regions go first, then those without a step, closest medians first; ties by rows. Medians are
    taken anew after each joining: all points of the house are looked at, which are in order of their heights.
    """
    start = np.cumsum([0, *(len(cell.xy) for cell in cells)])
    xy, ring = np.concatenate([cell.xy for cell in cells]), np.concatenate([cell.ring for cell in cells])
    count = [len(some) for some in points]
    xyz, first = np.concatenate(points), np.cumsum([0, *count])
    order = np.argsort(xyz[:, 2], kind="stable")
    z, cell = xyz[order, 2], np.repeat(np.arange(len(cells)), count)[order]
    area = np.array([outline.area for outline in cells])
    borders = _find_borders(start, xy, ring, xyz, first)
    region, within = _join(*borders, area, z, cell, float(min_step), float(min_area), min_points, MIN_NEAR)
    return region, within


@kernel
def _find_borders(start: Index, xy: Array, ring: Index, xyz: Array, first: Index) -> tuple[Index, Array, Index]:
    """Find the edges that two cells share (b, 2), and the heights of the points beside them.

    Heights on side ``s`` of border ``k`` begin at ``near_start[2 * k + s]``.
    """
    edges = _number_edges(start, xy, ring)
    border, at = np.empty((len(edges) // 2, 2), np.int64), np.empty(len(edges) // 2, np.int64)
    n = 0
    for k in range(1, len(edges)):
        if edges[k, 0] == edges[k - 1, 0] and edges[k, 1] == edges[k - 1, 1]:
            border[n, 0], border[n, 1], at[n] = edges[k - 1, 2], edges[k, 2], edges[k - 1, 3]
            n += 1
    near_start = np.zeros(2 * n + 1, np.int64)
    for k in range(n):
        for side in range(2):
            c = border[k, side]
            near_start[2 * k + side + 1] = near_start[2 * k + side] + first[c + 1] - first[c]
    near = np.empty(near_start[2 * n])  # room for all points of the cells
    for k in range(n):
        for side in range(2):
            c, to = border[k, side], near_start[2 * k + side]
            beside = heights_beside(xyz[first[c] : first[c + 1]], xy[at[k]], xy[at[k] + 1], STEP_REACH)
            for i in range(len(beside)):
                near[to + i] = beside[i]
            near_start[2 * k + side + 1] = to + len(beside)
    return border[:n].copy(), near[: near_start[2 * n]].copy(), near_start


@kernel
def _number_edges(start: Index, xy: Array, ring: Index) -> Index:
    """List the edges of all cells in order: both vertices, the lesser first, cell, and row where it begins."""
    n = len(xy)
    rows, vertex = np.empty((n, 3)), np.empty(n, np.int64)
    for v in range(n):
        rows[v, 0], rows[v, 1], rows[v, 2] = v, xy[v, 1], xy[v, 0]
    sort_group(rows)
    for k in range(n):
        same = k > 0 and rows[k, 1] == rows[k - 1, 1] and rows[k, 2] == rows[k - 1, 2]
        vertex[int(rows[k, 0])] = vertex[int(rows[k - 1, 0])] if same else k
    edges = np.empty((n, 4), np.int64)
    n_edges = 0
    for c in range(len(start) - 1):
        for v in range(start[c] + 1, start[c + 1]):
            if ring[v] == ring[v - 1]:
                edges[n_edges, 0] = min(vertex[v - 1], vertex[v])
                edges[n_edges, 1] = max(vertex[v - 1], vertex[v])
                edges[n_edges, 2], edges[n_edges, 3] = c, v - 1
                n_edges += 1
    rows = np.empty((n_edges, 3))
    for e in range(n_edges):
        rows[e, 0], rows[e, 1], rows[e, 2] = e, edges[e, 1], edges[e, 0]
    sort_group(rows)
    ordered = np.empty((n_edges, 4), np.int64)
    for k in range(n_edges):
        for i in range(4):
            ordered[k, i] = edges[int(rows[k, 0]), i]
    return ordered


@kernel
def _join(
    border: Index,
    near: Array,
    near_start: Index,
    area: Array,
    z: Array,
    cell: Index,
    min_step: float,
    min_area: float,
    min_points: int,
    min_near: int,
) -> tuple[Index, float]:
    """Join cells as `join_cells` does; heights of all points, with the cell of each, ascend."""
    region, area = np.arange(len(area)), area.copy()
    count, height = np.empty(len(area), np.int64), np.empty(len(area))
    for c in range(len(area)):
        count[c], height[c] = _median_of(c, region, z, cell)
    why, difference = np.full(len(border), np.int64(APART)), np.zeros(len(border))
    touched = -1  # region whose borders are ranked anew; at first, all are
    while True:
        for k in range(len(border)):
            one, two = _sides(border, k, region)
            if one == two or (touched >= 0 and touched not in (one, two)):
                continue
            twin = 0  # the first edge between the same regions
            while not _is_between(border, twin, region, one, two):
                twin += 1
            if twin < k:
                why[k], difference[k] = why[twin], difference[twin]
                continue
            apart = height[one] - height[two]
            difference[k] = 0.0 if math.isnan(apart) else abs(apart)
            if min(count[one], count[two]) < min_points or min(area[one], area[two]) < min_area:
                why[k] = TOO_SMALL
            else:
                step = _step_at(one, two, apart, border, near, near_start, region, min_near)
                why[k] = APART if step >= min_step else NO_STEP
        best = _find_best(why, difference, border, region)
        if best < 0:
            break
        touched, gone = _sides(border, best, region)
        for c in range(len(region)):
            if region[c] == gone:
                region[c] = touched
        area[touched] += area[gone]
        count[touched], height[touched] = _median_of(touched, region, z, cell)
    return region, _squares_within(region, z, cell)


@kernel
def _find_best(why: Index, difference: Array, border: Index, region: Index) -> int:
    """Find the border that is opened first; -1 if none is."""
    best = -1
    for k in range(len(border)):
        one, two = _sides(border, k, region)
        if one != two and why[k] != APART and (best < 0 or _goes_before(k, best, why, difference, border, region)):
            best = k
    return best


@kernel
def _sides(border: Index, k: int, region: Index) -> tuple[int, int]:
    """Regions on both sides of a border, the lesser first."""
    one, two = region[border[k, 0]], region[border[k, 1]]
    return min(one, two), max(one, two)


@kernel
def _is_between(border: Index, k: int, region: Index, one: int, two: int) -> bool:
    """Whether a border lies between two regions."""
    first, second = region[border[k, 0]], region[border[k, 1]]
    return bool((first == one and second == two) or (first == two and second == one))


@kernel
def _goes_before(k: int, other: int, why: Index, difference: Array, border: Index, region: Index) -> bool:
    """Whether a border is opened before another one."""
    if why[k] != why[other]:
        return bool(why[k] < why[other])
    if difference[k] != difference[other]:
        return bool(difference[k] < difference[other])
    one, two = _sides(border, k, region)
    other_one, other_two = _sides(border, other, region)
    return bool(one < other_one or (one == other_one and two < other_two))


@kernel
def _median_of(wanted: int, region: Index, z: Array, cell: Index) -> tuple[int, float]:
    """Number and median height of the points of a region; NaN without points."""
    n = 0
    for k in range(len(z)):
        n += region[cell[k]] == wanted
    low = high = math.nan
    seen = 0
    for k in range(len(z)):
        if region[cell[k]] == wanted:
            if seen == (n - 1) // 2:
                low = z[k]
            if seen == n // 2:
                high = z[k]
                break
            seen += 1
    return n, (low + high) / 2


@kernel
def _step_at(
    one: int,
    two: int,
    apart: float,
    border: Index,
    near: Array,
    near_start: Index,
    region: Index,
    min_near: int,
) -> float:
    """Step of the roof between two regions (m): the lesser of that of their medians and that at their border."""
    n_one, at_one = _median_beside(one, two, border, near, near_start, region)
    n_two, at_two = _median_beside(two, one, border, near, near_start, region)
    step = abs(apart)
    if min(n_one, n_two) >= min_near:
        there = at_one - at_two
        step = min(step, there if apart > 0 else -there if apart < 0 else 0.0)
    return step


@kernel
def _median_beside(
    wanted: int, other: int, border: Index, near: Array, near_start: Index, region: Index
) -> tuple[int, float]:
    """Number and median height of the points of a region beside another one; NaN without points."""
    found = np.empty(len(near))
    n = 0
    for k in range(len(border)):
        if _is_between(border, k, region, wanted, other):
            side = 2 * k + (0 if region[border[k, 0]] == wanted else 1)
            for i in range(near_start[side], near_start[side + 1]):
                found[n] = near[i]
                n += 1
    if n == 0:
        return 0, math.nan
    order = order_values(found[:n])
    return n, (found[order[(n - 1) // 2]] + found[order[n // 2]]) / 2


@kernel
def _squares_within(region: Index, z: Array, cell: Index) -> float:
    """Squares of the heights around the means of their regions (m²)."""
    total, count, squares = np.zeros(len(region)), np.zeros(len(region)), 0.0
    for k in range(len(z)):
        total[region[cell[k]]] += z[k]
        count[region[cell[k]]] += 1
    for k in range(len(z)):
        r = region[cell[k]]
        squares += (z[k] - total[r] / count[r]) ** 2
    return squares
