"""Integrals of roofs over outlines, against the cuts worked out by hand and against sums over a fine raster."""

import numpy as np
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.city_model.roof_areas import block_heights, measure_roof_areas
from pipeline.data.citymodel import CityModel
from pipeline.data.roofs import Roofs, flat_roofs, join_roofs, roof_heights
from tests.helpers.campaigns import examples


def one_roof(plane: list[float], low: float, high: float, origin: tuple[float, float] = (0.0, 0.0)) -> Roofs:
    return Roofs(np.array([plane], float), np.array([origin], float), np.array([[low, high]], float))


def test_a_shed_that_is_cut_at_both_limits() -> None:
    """A plane of z = x over 10 m, kept within 2 and 6: 2 m at 2, 4 m rising with mean 4, 4 m at 6; 3 m wide."""
    box = np.array([shapely.box(121000, 487000, 121010, 487003)])
    found = measure_roof_areas(box, one_roof([1, 0, 0], 2, 6, (121000, 487000)))
    assert abs(found.mean[0] - (2 * 2 + 4 * 4 + 4 * 6) / 10) < 1e-9
    assert abs(found.at_low[0] - 6) < 1e-9
    assert abs(found.at_high[0] - 12) < 1e-9


def test_a_roof_that_is_all_beyond_a_limit_or_within_both() -> None:
    box = np.array([shapely.box(0, 0, 4, 4)])
    for low, high, expected in ((-9, -5, (-5.0, 0.0, 16.0)), (8, 9, (8.0, 16.0, 0.0)), (-1, 50, (2.0, 0.0, 0.0))):
        found = measure_roof_areas(box, one_roof([0.5, -0.5, 2.0], low, high))
        assert (found.mean[0], found.at_low[0], found.at_high[0]) == expected


def test_flat_roofs_keep_their_height_to_the_last_bit() -> None:
    height = np.array([1 / 3, 12.3456789, -0.1])
    found = measure_roof_areas(shapely.box([0] * 3, [0] * 3, [3] * 3, [7] * 3), flat_roofs(height))
    assert found.mean.tolist() == height.tolist()
    assert found.at_low.tolist() == found.at_high.tolist() == [0, 0, 0]


@settings(max_examples=examples(40), deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_a_fine_raster_gives_the_same(seed: int) -> None:
    rng = np.random.default_rng(seed)
    turn = np.sort(rng.uniform(0, 2 * np.pi, 7)) + np.arange(7) * 0.1
    ring = 5 * rng.uniform(0.3, 1, (7, 1)) * np.column_stack((np.cos(turn), np.sin(turn))) + [121000, 487000]
    polygon = shapely.convex_hull(shapely.Polygon(ring))
    a, b = rng.uniform(-1.7, 1.7, 2)
    roofs = one_roof([a, b, 10.0], 10 - rng.uniform(-1, 4), 11 + rng.uniform(0, 4), (121000, 487000))
    west, south, east, north = polygon.bounds
    x, y = np.meshgrid(np.linspace(west, east, 401), np.linspace(south, north, 401))
    xy = np.column_stack((x.ravel(), y.ravel()))
    xy = xy[shapely.contains_xy(polygon, *xy.T)]
    z = roof_heights(roofs, np.zeros(len(xy), np.int64), xy)
    found = measure_roof_areas(np.array([polygon]), roofs)
    assert abs(found.mean[0] - z.mean()) < 0.03
    for area, limit in ((found.at_low[0], roofs.limits[0, 0]), (found.at_high[0], roofs.limits[0, 1])):
        assert abs(area / polygon.area - (z == limit).mean()) < 0.02


def test_blocks_are_one_height_a_house_and_one_a_part() -> None:
    """A shed of mean 2 m on 4 m2 and a flat part of 5 m on 8 m2: 4 m in the mean; a house of its own keeps 1/3."""
    boxes = shapely.box([0, 2, 20], [0, 0, 0], [2, 6, 21], [2, 2, 1])
    roofs = join_roofs([one_roof([1, 0, 1], 0, 9), flat_roofs(np.array([5.0, 1 / 3]))])
    ids = np.array(["a-1", "a-2", "b"])
    model = CityModel(boxes, ids, np.arange(3), np.zeros(3), roofs, ((),) * 3, np.array(["a", "a", "b"]))
    assert block_heights(model).tolist() == [[4.0, 2.0], [4.0, 5.0], [1 / 3, 1 / 3]]
