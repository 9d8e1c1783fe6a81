"""Cells of a house joined to regions, against a plain way to do it."""

from collections import defaultdict
from collections.abc import Sequence

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from pipeline.geometry.outlines import points_by_piece
from pipeline.roofs.regions import MIN_NEAR, STEP_REACH, join_cells

Array = NDArray[np.float64]
STEP, AREA, POINTS = 2.5, 15.0, 6


def plain(cells: NDArray[np.object_], points: Sequence[Array]) -> list[int]:
    """Region of each cell, by shapely and numpy alone."""
    region = list(range(len(cells)))
    walls = {
        (k, m): shapely.intersection(cells[k], cells[m])
        for k in range(len(cells))
        for m in range(k + 1, len(cells))
        if shapely.length(shapely.intersection(cells[k], cells[m])) > 0
    }
    while True:
        z = [
            np.concatenate([np.empty(0), *(xyz[:, 2] for xyz, r in zip(points, region, strict=True) if r == k)])
            for k in range(len(cells))
        ]
        area = [sum(c.area for c, r in zip(cells, region, strict=True) if r == k) for k in range(len(cells))]
        beside: defaultdict[tuple[int, int], list[list[Array]]] = defaultdict(lambda: [[], []])
        for pair, wall in walls.items():
            if region[pair[0]] == region[pair[1]]:
                continue
            for cell in pair:
                other = pair[0] + pair[1] - cell
                key = min(region[cell], region[other]), max(region[cell], region[other])
                for line in shapely.get_parts(wall):
                    near = shapely.distance(shapely.points(points[cell][:, :2]), line) <= STEP_REACH
                    beside[key][key.index(region[cell])].append(points[cell][near, 2])
        ranked = []
        for (one, two), sides in beside.items():
            near = [np.concatenate(side) for side in sides]
            apart = np.median(z[one]) - np.median(z[two]) if len(z[one]) and len(z[two]) else 0.0
            step = abs(apart)
            if min(map(len, near)) >= MIN_NEAR:
                step = min(step, (np.median(near[0]) - np.median(near[1])) * np.sign(apart))
            small = min(len(z[one]), len(z[two])) < POINTS or min(area[one], area[two]) < AREA
            if small or step < STEP:
                ranked.append((0 if small else 1, abs(apart), one, two))
        if not ranked:
            return region
        _, _, one, two = min(ranked)
        region = [one if r == two else r for r in region]


def grid(rng: np.random.Generator) -> NDArray[np.object_]:
    """Cells between the lines of an uneven grid, with one another's vertices."""
    x, y = (np.cumsum([0, *rng.integers(2, 7, n)]).astype(float) for n in (4, 3))
    lines = [[(x[0], v), (x[-1], v)] for v in y] + [[(v, y[0]), (v, y[-1])] for v in x]
    return np.asarray(shapely.get_parts(shapely.polygonize([shapely.union_all(shapely.linestrings(lines))])))


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 10**6), density=st.sampled_from([0.3, 2.0]))
def test_regions_are_those_of_a_plain_way(seed: int, density: float) -> None:
    rng = np.random.default_rng(seed)
    cells = grid(rng)
    heights = rng.choice([3.0, 6.0, 6.5, 9.0, 12.0], len(cells))
    xyz = rng.uniform(0, 30, (int(900 * density), 3))
    xyz = xyz[np.argsort(xyz[:, 2], kind="stable")]
    outlines, dealt = zip(*points_by_piece(cells, xyz), strict=True)
    points = [np.column_stack((p[:, :2], h + p[:, 2] / 25)) for p, h in zip(dealt, heights, strict=True)]
    region, within = join_cells(outlines, points, min_step=STEP, min_area=AREA, min_points=POINTS)
    assert region.tolist() == plain(cells, points)
    z = [np.concatenate([points[c][:, 2] for c in np.flatnonzero(region == k)]) for k in np.unique(region)]
    assert within == pytest.approx(sum(((part - part.mean()) ** 2).sum() for part in z if len(part)), rel=1e-9)


def test_a_cell_without_points_goes_to_a_neighbour() -> None:
    cells = shapely.box([0, 8, 16], 0, [8, 16, 24], 8)
    xyz = np.column_stack((np.linspace(0.5, 7.5, 40), np.full(40, 4.0), np.full(40, 3.0)))
    there = np.concatenate((xyz, xyz + np.array([16, 0, 9])))
    outlines, points = zip(*points_by_piece(cells, there), strict=True)
    assert len(points[1]) == 0
    region, within = join_cells(outlines, points, min_step=STEP, min_area=AREA, min_points=POINTS)
    assert region.tolist() == [0, 0, 2]
    assert within == 0
