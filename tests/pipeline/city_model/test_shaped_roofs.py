"""Tests of hipped roofs for houses whose points do not tell of planes (step 2.0, ours)."""

import numpy as np
import pytest
import shapely

from pipeline.city_model.shaped_roofs import LEAST_EAVES, SKELETON, SLOPE, shape_roofs
from pipeline.data.roofs import flat_roofs, is_flat, roof_heights
from pipeline.roofs.house_levels import HouseParts
from pipeline.roofs.house_roofs import FLAT, HouseRoofs

HOUSES = np.array([shapely.box(100, 0, 112, 8), shapely.box(120, 0, 130, 8), shapely.box(0, 40, 60, 80)])


def flat_houses(heights: list[float]) -> HouseRoofs:
    n = len(heights)
    parts = HouseParts(HOUSES[:n], np.arange(n))
    return HouseRoofs(
        parts, flat_roofs(np.array(heights)), np.full(n, FLAT, np.int8), np.ones(n, np.int32), np.ones(n, np.bool_)
    )


def shape(heights: list[float], chosen: list[bool], ground: float = 0.0) -> HouseRoofs:
    n = len(heights)
    return shape_roofs(
        flat_houses(heights), HOUSES[:n], np.array(chosen), np.full(n, ground), np.array(heights, np.float64)
    )


def test_a_hipped_roof_has_four_parts_and_the_mean_height_of_the_flat_one() -> None:
    found = shape([9.0, 7.0], [True, False])
    assert found.parts.house.tolist() == [0, 0, 0, 0, 1]
    assert found.method.tolist() == [SKELETON, FLAT]
    assert found.n_planes.tolist() == [4, 1]
    parts = found.parts.polygons[:4]
    assert shapely.area(parts).sum() == pytest.approx(96)
    assert sorted(shapely.area(parts).tolist()) == pytest.approx([16, 16, 32, 32])
    centre = shapely.get_coordinates(shapely.centroid(parts))
    height = roof_heights(found.roofs, np.arange(4), centre)
    assert (height * shapely.area(parts)).sum() / 96 == pytest.approx(9.0)
    assert np.hypot(*found.roofs.plane[:4, :2].T) == pytest.approx(SLOPE)
    # By hand: the mean distance from the closest edge is 14/9 m.
    eaves = roof_heights(found.roofs, np.arange(4), np.tile([100.0, 0.0], (4, 1)))
    assert eaves.min() == pytest.approx(9.0 - SLOPE * 14 / 9)
    assert is_flat(found.roofs).tolist() == [False] * 4 + [True]


def test_houses_stay_flat_where_a_hipped_roof_is_no_roof_of_theirs() -> None:
    wide = shape([9.0, 9.0, 9.0], [False, False, True])  # 40 m wide: it would rise by 14 m
    low = shape([3.0], [True], ground=2.5 - LEAST_EAVES)  # its eaves would be 1.5 m above the ground
    unknown = shape([np.nan], [True])
    for found in (wide, low, unknown):
        assert (found.method == FLAT).all()
        assert (found.parts.polygons == HOUSES[: len(found.method)]).all()
