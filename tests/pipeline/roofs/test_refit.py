"""Roofs of faces fitted once more to their points."""

import numpy as np
import pytest
import shapely
from numpy.typing import NDArray

from pipeline.data.roofs import Roofs, flat_roofs
from pipeline.roofs.refit import refit_roofs
from pipeline.roofs.roof_points import make_roof_points, no_roof_points

ONE = np.array([shapely.box(0, 0, 10, 10)], object)


def refit_one(plane: tuple[float, float, float], xyz: NDArray[np.float64]) -> NDArray[np.float64]:
    """The plane of one face after it."""
    roofs = Roofs(np.array([plane]), np.zeros((1, 2)), np.array([[-99.0, 99.0]]))
    found = refit_roofs(roofs, ONE, make_roof_points(np.array([0, len(xyz)]), xyz), max_slope=1.7)
    row: NDArray[np.float64] = found.plane[0]
    return row


def test_roofs_of_faces_move_to_their_points() -> None:
    roofs = Roofs(
        np.array([[0.5, 0.0, 10.0], [0.0, 0.0, 7.0], [0.5, 0.0, 10.0]]),
        np.array([[100.0, 50.0]] * 3),
        np.array([[9.0, 13.0], [7.0, 7.0], [9.0, 13.0]]),
    )
    faces = np.array([shapely.box(100 + 10 * k, 50, 110 + 10 * k, 60) for k in range(3)], object)
    x = np.linspace(100.5, 109.5, 101)
    slope = np.column_stack((x, np.full(101, 55.0), 10.4 + 0.5 * (x - 100)))
    level = np.column_stack((x + 10, np.full(101, 55.0), np.where(np.arange(101) < 60, 8.0, 3.0)))
    few = np.column_stack((x[:5] + 20, np.full(5, 55.0), np.full(5, 99.0)))
    points = make_roof_points(np.array([0, 101, 202, 207]), np.concatenate((slope, level, few)))
    found = refit_roofs(roofs, faces, points, max_slope=1.7)
    plane = np.array([[0.5, 0, 10.4], [0, 0, 8], [0.5, 0, 10]])
    np.testing.assert_allclose(found.plane, plane, atol=1e-12)
    z = np.sort(slope[:, 2])
    limits = np.array([[z[2] - 0.5, z[98] + 0.5], [8, 8], [9, 13]])
    np.testing.assert_allclose(found.limits, limits, atol=1e-12)


def test_a_roof_lies_where_points_are_densest_near_the_median() -> None:
    """13 of 40 points lie within 2 cm of 8 m, 11 below and 16 above are spread out: the median is over them."""
    z = np.concatenate((np.linspace(7.0, 7.7, 11), np.full(13, 8.0), 8.3 + 0.06 * np.arange(16)))
    xyz = np.column_stack((np.linspace(0, 10, 40), np.linspace(0, 10, 40), z))
    assert np.median(z) == 8.0
    assert refit_one((0.0, 0.0, 3.0), xyz)[2] == pytest.approx(8.0, abs=0.2)
    spread = np.column_stack((xyz[:, :2], np.linspace(0, 40, 40)))  # dense nowhere: the median
    assert refit_one((0.0, 0.0, 3.0), spread)[2] == pytest.approx(20.0)


def test_half_of_the_points_on_a_facade_do_not_move_a_roof() -> None:
    """16 of 40 points on a flat roof at 9 m, 24 on a wall below it: the median is 0.95 m too low."""
    wall = np.linspace(5.6, 8.49, 24)
    z = np.concatenate((wall, np.full(16, 9.0)))
    xyz = np.column_stack((np.zeros(40), np.zeros(40), z))
    assert np.median(z) < 8.5
    assert refit_one((0.0, 0.0, 0.0), xyz)[2] == pytest.approx(9.0)
    far = np.column_stack((np.zeros(40), np.zeros(40), np.where(z < 9, z - 4, 9.0)))  # more than a metre off
    assert refit_one((0.0, 0.0, 0.0), far)[2] == pytest.approx(np.median(far[:, 2]))


def test_a_slope_keeps_its_direction_and_follows_its_points() -> None:
    """Points of slope 0.8 to the north-east, from a plane of slope 0.5; a third of them are a chimney."""
    rng = np.random.default_rng(3)
    xy = rng.uniform(0, 10, (90, 2))
    up = np.array([0.6, 0.8])
    z = 5 + 0.6 * (xy @ up)
    z[:20] += 3.0
    plane = refit_one((0.5 * 0.6, 0.5 * 0.8, 5.3), np.column_stack((xy, z)))
    np.testing.assert_allclose(plane, [0.36, 0.48, 5.0], atol=1e-9)


def test_too_steep_points_and_few_of_them_leave_the_slope() -> None:
    x = np.linspace(0, 0.8, 30)
    steep = np.column_stack((x, np.zeros(30), 2.0 * x))
    assert refit_one((1.0, 0.0, 0.0), steep)[0] == 1.0
    few = np.column_stack((np.linspace(0, 9, 11), np.zeros(11), 1.1 * np.linspace(0, 9, 11)))
    assert refit_one((1.0, 0.0, 0.0), few)[0] == 1.0
    assert refit_one((1.0, 0.0, 0.0), np.repeat(few, 2, axis=0))[0] == pytest.approx(1.1)


def test_the_order_of_points_and_whole_metres_change_nothing() -> None:
    rng = np.random.default_rng(5)
    xyz = np.column_stack((rng.uniform(0, 10, (50, 2)), rng.uniform(3, 6, 50)))
    found = refit_one((0.3, 0.1, 4.0), xyz)
    assert refit_one((0.3, 0.1, 4.0), xyz[rng.permutation(50)]).tobytes() == found.tobytes()
    whole = np.round(xyz * 1024) / 1024  # their sums with 100 km are exact
    shift = np.array([100_000.0, 400_000.0])
    roofs = Roofs(np.array([[0.3, 0.1, 4.0]]), shift[None], np.array([[-99.0, 99.0]]))
    moved = make_roof_points(np.array([0, 50]), whole + np.append(shift, 0))
    there = refit_roofs(roofs, ONE, moved, max_slope=1.7).plane[0]
    assert there.tobytes() == refit_one((0.3, 0.1, 4.0), whole).tobytes()


def test_roofs_without_a_height_stay_and_wrong_numbers_are_refused() -> None:
    xyz = np.column_stack((np.zeros(9), np.zeros(9), np.arange(9.0)))
    points = make_roof_points(np.array([0, 9]), xyz)
    assert np.isnan(refit_roofs(flat_roofs(np.array([np.nan])), ONE, points, max_slope=1.7).plane[0, 2])
    with pytest.raises(ValueError, match="3 roofs"):
        refit_roofs(flat_roofs(np.zeros(3)), ONE, no_roof_points(1), max_slope=1.7)
