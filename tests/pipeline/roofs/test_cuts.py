"""Cuts along a line: through corners, clear of corners, blunt, and through several rings at once."""

import numpy as np
import pytest
import shapely
from numpy.typing import NDArray
from shapely import Polygon, box

from pipeline.geometry.outlines import open_outline
from pipeline.geometry.segments import distances_to_segments
from pipeline.roofs.cuts import cut_along, cut_best
from pipeline.roofs.lines import Line, rank_lines

Array = NDArray[np.float64]


def level(y: float) -> Line:
    """Line of all places at height `y` of the plan."""
    return Line(np.array([1.0, 0.0]), y)


def cut(
    polygon: shapely.Polygon, y: float, *, clearance: float = 0.5
) -> tuple[list[float], set[tuple[float, ...]]]:
    """Areas of the pieces, ascending, and the ends of the walls."""
    pieces, corners = cut_along(open_outline(polygon), level(y), clearance=clearance)
    if not len(pieces):
        assert not len(corners)
        return [round(polygon.area, 9)], set()
    assert shapely.coverage_is_valid(pieces)
    assert shapely.area(pieces).sum() == pytest.approx(polygon.area, rel=1e-12)
    return np.sort(shapely.area(pieces)).round(9).tolist(), set(map(tuple, corners.round(9).tolist()))


BENT = Polygon([(0, 0), (10, 0), (10, 20), (-4, 20), (-4, 12.3), (0, 12.3)])
# Bent up to (0, 10.4), the wall would pass (2, 10.6), at the tip of a courtyard, at 0.28 m.
CLOSE = Polygon([(0, 0), (10, 0), (10, 20), (-3, 20), (-3, 10.4), (0, 10.4)], [[(2, 10.6), (3, 14), (1, 14)]])
COURT = Polygon(box(0, 0, 40, 40).exterior, [box(10, 10, 30, 30).exterior])
COMB = Polygon([(0, 0), (15, 0), (15, 20), (10, 20), (10, 8), (5, 8), (5, 20), (0, 20)])
NOTCH = Polygon([(0, 0), (15, 0), (15, 10), (11, 10), (10, 6), (9, 10), (5, 10), (5, 20), (0, 20)])
# A body that hangs from a strip of 0.3 m: the wall between them would run 0.3 m below the strip's edge.
STRIP = Polygon([(0, 0), (10, 0), (10, -10), (20, -10), (20, 0), (30, 0), (30, 0.3), (0, 0.3)])
WAIST = Polygon(
    [
        (0, 0),
        (10, 0),
        (10, 10),
        (5.2, 10),
        (5.2, 14),
        (10, 14),
        (10, 24),
        (0, 24),
        (0, 14),
        (4.8, 14),
        (4.8, 10),
        (0, 10),
    ]
)
# House, height of the line in the plan, clearance; areas of the pieces or their number, and ends of the walls.
CUTS: dict[str, tuple[Polygon, float, float, list[float] | int, set[tuple[float, ...]] | None]] = {
    "straight far from all corners": (box(0, 0, 10, 20), 12, 0.5, [80, 120], {(0, 12), (10, 12)}),
    "bent through a corner within the clearance": (BENT, 12, 0.5, 2, {(0, 12.3), (10, 12)}),
    "straight at the clearance": (BENT, 11.5, 0.5, 2, {(0, 11.5), (10, 11.5)}),
    "to the end of a slanting wall that is close": (
        Polygon([(0, 0), (10, 0), (12, 10), (10, 20), (0, 20)]), 9.8, 0.5, 2, {(0, 9.8), (12, 10)},
    ),
    "from a corner, and along no wall": (
        Polygon([(0, 0), (20, 0), (20, 8), (8, 8), (8, 20), (0, 20)]), 8, 0.5, [96, 160], {(8, 8), (0, 8)},
    ),
    "not close to another corner": (CLOSE, 10, 0.5, [CLOSE.area], None),
    "where that corner is none": (Polygon(CLOSE.exterior), 10, 0.5, 2, None),
    "not at 18 degrees to a wall": (Polygon([(0, 0), (30, 0), (0, 10)]), 5, 0.5, [150], None),
    "at 45 degrees to a wall": (Polygon([(0, 0), (30, 0), (0, 30)]), 15, 0.5, [112.5, 337.5], None),
    "on both sides of a courtyard": (COURT, 20, 0.5, [600, 600], {(0, 20), (10, 20), (30, 20), (40, 20)}),
    "along the side of a courtyard": (COURT, 10, 0.5, [400, 800], None),
    "not beside the house": (box(0, 0, 10, 20), 20.3, 0.5, [200], None),
    "not far from the house": (box(0, 0, 10, 20), 50, 0.5, [200], set()),
    "each tooth of a comb": (COMB, 14, 0.5, [30, 30, COMB.area - 60], None),
    "not across a notch outside the house": (NOTCH, 10, 0.5, [50, NOTCH.area - 50], {(0, 10), (5, 10)}),
    "not along another wall within the clearance": (STRIP, 0.1, 0.5, [STRIP.area], None),
    "along another wall beyond the clearance": (STRIP, 0.1, 0.2, 2, None),
    "with no wall shorter than the clearance": (WAIST, 12, 0.5, [WAIST.area], None),
    "with a wall longer than the clearance": (WAIST, 12, 0.3, 2, None),
}  # fmt: skip


@pytest.mark.parametrize("way", CUTS)
def test_a_house_is_cut(way: str) -> None:
    house, y, clearance, wanted, ends = CUTS[way]
    areas, found = cut(house, y, clearance=clearance)
    assert len(areas) == wanted if isinstance(wanted, int) else areas == pytest.approx(wanted, rel=1e-9)
    assert ends is None or found == ends


def test_points_choose_the_line() -> None:
    x, y = (part.ravel() for part in np.meshgrid(np.arange(0.25, 10, 0.5), np.arange(0.25, 20, 0.5)))
    xyz = np.column_stack((x, y, np.where(y < 13, 9.0, 3.0)))
    house = open_outline(shapely.box(0, 0, 10, 20))
    pieces, corners = cut_best(house, xyz, clearance=0.5, min_area=15, min_points=10)
    assert np.sort(shapely.area(pieces)).tolist() == [70, 130]
    assert corners[:, 1].tolist() == [13, 13]
    pieces, corners = cut_best(house, xyz, clearance=0.5, min_area=210, min_points=10)
    assert len(pieces) == len(corners) == 0


def test_lines_leave_enough_points_on_both_sides() -> None:
    house = shapely.get_coordinates(shapely.box(0, 0, 10, 20))
    xyz = np.column_stack((np.full(20, 5.0), np.arange(20) + 0.5, np.where(np.arange(20) < 2, 0.0, 9.0)))
    for least, offset in ((2, 2.0), (3, 3.0)):
        best = rank_lines(house[:-1], house[1:], xyz, clearance=0.5, min_points=least)[0]
        assert abs(best.offset * best.normal[1]) == offset
    assert rank_lines(house[:-1], house[1:], xyz, clearance=0.5, min_points=11) == []
    flat = xyz * [1, 1, 0]
    assert rank_lines(house[:-1], house[1:], flat, clearance=0.5, min_points=2) == []


def test_a_line_does_not_part_points_of_one_row() -> None:
    house = shapely.get_coordinates(shapely.box(0, 0, 10, 20))
    rows = np.repeat([3.0, 5.0, 9.0], [5, 20, 5])
    xyz = np.column_stack((np.full(30, 5.0), rows, np.arange(30) > 14))
    offsets = [
        abs(float(line.offset * line.normal[1]))
        for line in rank_lines(house[:-1], house[1:], xyz, clearance=0.5, min_points=2)
    ]
    assert offsets
    assert set(offsets) <= {4.0, 7.0}


def test_noise_has_no_line() -> None:
    house = shapely.get_coordinates(shapely.box(0, 0, 10, 20))
    xyz = np.random.default_rng(0).uniform(0, 10, (2000, 3)) * [1, 2, 1]
    assert rank_lines(house[:-1], house[1:], xyz, clearance=0.5, min_points=2) == []


def test_the_gain_is_that_of_brute_force() -> None:
    rng = np.random.default_rng(8)
    xyz = rng.uniform(0, 10, (60, 3)) * [1, 2, 1]
    house = shapely.get_coordinates(shapely.box(0, 0, 10, 20))
    best = rank_lines(house[:-1], house[1:], xyz, clearance=0.5, min_points=5)[0]

    def left_over(before: NDArray[np.bool_]) -> float:
        return float(sum(((z - z.mean()) ** 2).sum() for z in (xyz[before, 2], xyz[~before, 2])))

    tries = []
    for axis, size in ((0, 10), (1, 20)):
        middle = np.sort(xyz[:, axis])
        middle = (middle[1:] + middle[:-1]) / 2
        places = [at for at in middle if 0.5 <= at <= size - 0.5]
        sides = [xyz[:, axis] < at for at in places]
        tries += [left_over(side) for side in sides if 5 <= side.sum() <= 55]
    assert left_over(xyz[:, :2] @ best.normal < best.offset) == pytest.approx(min(tries), rel=1e-12)


def test_distances_to_segments_are_shapelys() -> None:
    rng = np.random.default_rng(1)
    xy, a, b = rng.uniform(0, 10, (3, 7, 2))
    expected = shapely.distance(shapely.linestrings(np.stack((a, b), axis=1))[:, None], shapely.points(xy)[None])
    np.testing.assert_allclose(distances_to_segments(xy, a, b), expected, atol=1e-12)


def test_walls_stand_where_the_normal_of_a_line_has_its_offset() -> None:
    line = Line(np.array([0.6, 0.8]), -2.0)
    _, corners = cut_along(open_outline(shapely.box(0, 0, 10, 20)), line, clearance=0.5)
    assert len(corners) == 2
    np.testing.assert_allclose(corners @ line.normal, line.offset, atol=1e-12)
