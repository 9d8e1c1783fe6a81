"""Neighbouring cells of a house joined until the roof steps at every wall that is left (for `house_levels`)."""

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.segments import heights_beside, unite_places

STEP_REACH = 2.0  # m on both sides of a wall, where the roof has to step
MIN_NEAR = 3  # points on each side of a wall, to see a step there
TOO_SMALL, NO_STEP, APART = range(3)  # why two regions are joined, the first reason first; or not

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Region:
    """Cells that are one part of a house.

    Attributes
    ----------
    cells : list of int
        Their rows.
    area : float
        Sum of their areas (m²).
    z : float64, (n,)
        Heights of their points (m), in no order.
    height : float
        Median of `z` (m); NaN without points.
    """

    cells: list[int]
    area: float
    z: Array
    height: float


@dataclass(frozen=True)
class _Limits:
    min_step: float
    min_area: float
    min_points: int


# Heights of the points beside the wall between two regions, on the side of the first and of the second.
_Borders = dict[tuple[int, int], tuple[Array, Array]]


def join_cells(
    cells: NDArray[np.object_],
    points: list[Array],
    *,
    min_step: float,
    min_area: float,
    min_points: int,
) -> list[Region]:
    """Join neighbouring cells until every region is large enough and the roof steps at each border.

    Parameters
    ----------
    cells : object, (c,)
        Polygons that share their vertices, to the bit, where they touch.
    points : list of c float64 arrays (n, 3)
        Points of each cell (m).
    min_step : float
        Least step (m): of the medians of both regions, and of the medians of the points within `STEP_REACH`
        of their border, where both sides have `MIN_NEAR` of them.
    min_area, min_points
        What a region has at least (m², and points).

    Returns
    -------
    list of Region
        By their first cell. A single region may be smaller.

    Notes
    -----
    Too small regions go first, then those without a step, closest medians first; ties by rows. Medians are
    taken anew after each joining, at the cost of the points of the new region and its borders.
    """
    limits = _Limits(min_step, min_area, min_points)
    areas = shapely.area(cells).tolist()
    regions = {k: _region([k], areas[k], xyz[:, 2]) for k, xyz in enumerate(points)}
    borders = _find_borders(cells, points)
    ranks = {pair: _rank(pair, regions, borders, limits) for pair in borders}
    while ranks:
        pair = min(ranks, key=lambda pair: (ranks[pair], pair))
        if ranks[pair][0] == APART:
            break
        first, second = pair
        kept, gone = regions[first], regions.pop(second)
        regions[first] = _region(kept.cells + gone.cells, kept.area + gone.area, np.concatenate((kept.z, gone.z)))
        for other in [other for other in borders if first in other or second in other]:
            sides = borders.pop(other)
            ranks.pop(other)
            if other != pair:
                one, two = (first if end == second else end for end in other)
                _add_border(borders, one, two, *sides)
        for other in borders:
            if first in other:
                ranks[other] = _rank(other, regions, borders, limits)
    return list(regions.values())


def _region(cells: list[int], area: float, z: Array) -> Region:
    return Region(cells, area, z, _median(z) if len(z) else float("nan"))


def _rank(
    pair: tuple[int, int], regions: dict[int, Region], borders: _Borders, limits: _Limits
) -> tuple[int, float]:
    """Whether two regions are joined, and the difference of their heights."""
    one, two = regions[pair[0]], regions[pair[1]]
    difference = one.height - two.height
    if min(len(one.z), len(two.z)) < limits.min_points or min(one.area, two.area) < limits.min_area:
        return TOO_SMALL, 0.0 if np.isnan(difference) else abs(difference)
    step = abs(difference)
    near_one, near_two = borders[pair]
    if min(len(near_one), len(near_two)) >= MIN_NEAR:
        step = min(step, (_median(near_one) - _median(near_two)) * float(np.sign(difference)))
    return APART if step >= limits.min_step else NO_STEP, abs(difference)


def _find_borders(cells: NDArray[np.object_], points: list[Array]) -> _Borders:
    """Find the cells that share an edge, and the heights of the points beside it."""
    rings, owner = shapely.get_rings(cells, return_index=True)
    xy, ring = shapely.get_coordinates(rings, return_index=True)
    edge = np.flatnonzero(ring[1:] == ring[:-1])
    cell = owner[ring[edge]]
    _, vertex = unite_places(xy)
    ends = np.sort(np.column_stack((vertex[edge], vertex[edge + 1])), axis=1)
    order = np.lexsort((cell, ends[:, 1], ends[:, 0]))
    again = np.flatnonzero((ends[order[1:]] == ends[order[:-1]]).all(axis=1))
    borders: _Borders = {}
    for e, f in zip(order[again].tolist(), order[again + 1].tolist(), strict=True):
        a, b = xy[edge[e]], xy[edge[e] + 1]
        beside = [heights_beside(points[cell[side]], a, b, STEP_REACH) for side in (e, f)]
        _add_border(borders, int(cell[e]), int(cell[f]), beside[0], beside[1])
    return borders


def _add_border(borders: _Borders, one: int, two: int, near_one: Array, near_two: Array) -> None:
    if one > two:
        one, two, near_one, near_two = two, one, near_two, near_one
    known_one, known_two = borders.get((one, two), (np.empty(0), np.empty(0)))
    borders[one, two] = np.concatenate((known_one, near_one)), np.concatenate((known_two, near_two))


def _median(z: Array) -> float:
    """Median as numpy's, at a quarter of its cost for few values."""
    half = len(z) // 2
    z = np.partition(z, (half - 1, half)) if len(z) % 2 == 0 else np.partition(z, half)
    return float(z[half]) if len(z) % 2 else float((z[half - 1] + z[half]) / 2)
