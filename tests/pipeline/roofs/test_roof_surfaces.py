"""Roofs from the surfaces of a city model: parts, gaps, overhangs, surfaces over each other and across."""

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from pipeline.data.roofs import Roofs, roof_heights, take_roofs
from pipeline.roofs.roof_surfaces import SurfacedRoof, make_surfaced_roof

HOUSE = shapely.box(0, 0, 10, 8)
GABLE = (shapely.box(0, 0, 10, 4), shapely.box(0, 4, 10, 8))
SLOPES = ([0.0, 0.75, 6.0], [0.0, -0.75, 12.0])  # eaves at 6 m, a ridge at 9 m over y = 4


def roofs_of(planes: object, low: float = -np.inf, high: float = np.inf) -> Roofs:
    plane = np.array(planes, np.float64).reshape(-1, 3)
    flat = (plane[:, :2] == 0).all(axis=1)
    limits = np.where(flat[:, None], plane[:, [2, 2]], [low, high])
    return Roofs(plane, np.zeros((len(plane), 2)), limits)


def make(
    surfaces: object, planes: object, house: shapely.Polygon = HOUSE, clearance: float = 1.0, finer: float = 0.0
) -> SurfacedRoof:
    found = make_surfaced_roof(
        house, np.array(surfaces, object), roofs_of(planes), clearance=clearance, finer=finer
    )
    assert found is not None
    return found


def height_at(roof: SurfacedRoof, x: float, y: float) -> float:
    (row,) = np.flatnonzero(shapely.contains(roof.parts, shapely.Point(x, y)))
    return float(roof_heights(roof.roofs, np.array([row]), np.array([[x, y]]))[0])


def assert_covers(roof: SurfacedRoof, house: shapely.Polygon = HOUSE) -> None:
    assert shapely.area(roof.parts).sum() == pytest.approx(house.area, abs=0.02)
    assert shapely.coverage_is_valid(roof.parts)


def test_a_gabled_roof_keeps_its_two_planes() -> None:
    roof = make(GABLE, SLOPES)
    assert shapely.area(roof.parts).tolist() == [40.0, 40.0]
    assert (roof.gap, roof.overhang) == (0.0, 0.0)
    assert [height_at(roof, 5, y) for y in (1, 3.5, 4.5, 7)] == [6.75, 8.625, 8.625, 6.75]
    assert_covers(roof)


def test_one_plane_keeps_the_polygon_to_the_bit() -> None:
    house = shapely.Polygon([(0, 0), (10.0001, 0), (10, 8.0003), (0, 8)])
    roof = make([shapely.box(-1, -1, 11, 4), shapely.box(-1, 4, 11, 9)], [[0, 0, 7], [0, 0, 7.02]], house)
    assert roof.parts.tolist() == [house]
    assert roof.roofs.plane.tolist() == [[0, 0, 7.02]] or roof.roofs.plane.tolist() == [[0, 0, 7.0]]
    assert roof.overhang == pytest.approx(12 * 10 - house.area, abs=1e-9)


def test_what_lies_beyond_the_walls_is_cut_off_and_told() -> None:
    roof = make([shapely.box(-0.5, -0.5, 10.5, 4), shapely.box(-0.5, 4, 10.5, 8.5)], SLOPES)
    assert roof.overhang == pytest.approx(11 * 9 - 80)
    assert_covers(roof)


def test_a_gap_takes_the_nearest_surface_and_is_told() -> None:
    roof = make([shapely.box(0, 0, 10, 4), shapely.box(0, 4, 10, 7)], SLOPES)
    assert roof.gap == pytest.approx(10.0)
    assert height_at(roof, 5, 7.5) == 12 - 0.75 * 7.5
    assert_covers(roof)


def test_of_surfaces_over_each_other_the_highest_counts() -> None:
    tower = shapely.box(2, 2, 6, 6)
    roof = make([HOUSE, tower, tower], [[0, 0, 6], [0, 0, 12], [0, 0, 3]])
    assert (height_at(roof, 4, 4), height_at(roof, 1, 1)) == (12.0, 6.0)
    assert sorted(shapely.area(roof.parts).tolist()) == [16.0, 64.0]
    assert_covers(roof)


def test_surfaces_that_cross_get_a_wall_where_they_do() -> None:
    roof = make([HOUSE, HOUSE], [[0, 0, 8], [0.5, 0, 6]])  # equal where x = 4
    assert sorted(shapely.area(roof.parts).tolist()) == pytest.approx([32.0, 48.0], abs=0.02)
    assert (height_at(roof, 2, 4), height_at(roof, 9, 4)) == (8.0, 10.5)
    assert_covers(roof)


def test_small_and_narrow_parts_take_the_closest_plane_beside_them() -> None:
    dormer, edge = shapely.box(4, 1, 5, 1.9), shapely.box(0, 7.8, 10, 8)
    surfaces = [shapely.difference(GABLE[0], dormer), shapely.difference(GABLE[1], edge), dormer, edge]
    roof = make(surfaces, [*SLOPES, [0, 0, 8.0], [0, 0, 5.9]])
    assert sorted(shapely.area(roof.parts).tolist()) == pytest.approx([40.0, 40.0])
    assert_covers(roof)
    kept = make(surfaces, [*SLOPES, [0, 0, 8.0], [0, 0, 5.9]], clearance=0.4)
    assert sorted(shapely.area(kept.parts).tolist()) == pytest.approx([0.9, 39.1, 40.0])


def test_a_narrow_part_stays_at_the_finer_clearance_where_the_roof_would_be_off() -> None:
    strip, wedge = shapely.box(0, 7.6, 10, 8), shapely.Polygon([(0, 7.2), (10, 8), (0, 8)])
    for shape, height, finer, n in (
        (strip, 30, 0.3, 3),
        (strip, 30, 0.0, 2),
        (strip, 6.5, 0.3, 2),
        (wedge, 30, 0.3, 2),
    ):
        surfaces = [GABLE[0], shapely.difference(GABLE[1], shape), shape]
        roof = make(surfaces, [*SLOPES, [0, 0, height]], finer=finer)
        assert len(roof.parts) == n, (shape, height, finer)
        assert_covers(roof)


def test_a_courtyard_stays_open() -> None:
    ring = shapely.difference(HOUSE, shapely.box(4, 3, 6, 5))
    roof = make(GABLE, SLOPES, ring)
    assert_covers(roof, ring)
    assert roof.overhang == pytest.approx(4.0)


def test_surfaces_elsewhere_give_no_roof() -> None:
    far = np.array([shapely.box(20, 0, 30, 8)], object)
    assert make_surfaced_roof(HOUSE, far, roofs_of([0, 0, 5]), clearance=1.0) is None


@settings(max_examples=25, deadline=None)
@given(st.permutations(range(5)), st.integers(-3, 3))
def test_the_order_of_surfaces_does_not_matter(order: list[int], shift: int) -> None:
    surfaces = np.array(
        [*GABLE, shapely.box(2, 2, 6, 6), shapely.box(5, 1, 9, 7), shapely.box(5, 5, 7, 7)], object
    )
    planes = [*SLOPES, [0.1, 0, 7.5], [0, 0.3 * shift, 7], [0, 0, 8.5]]
    first = make(surfaces, planes)
    rows: NDArray[np.int64] = np.array(order)
    moved = take_roofs(roofs_of(planes), rows)
    second = make_surfaced_roof(HOUSE, surfaces[rows], moved, clearance=1.0)
    assert second is not None
    assert shapely.to_wkb(second.parts).tolist() == shapely.to_wkb(first.parts).tolist()
    assert second.roofs.plane.tolist() == first.roofs.plane.tolist()
    assert_covers(first)
