"""Houses as arrays for the store, and back, all of them or those that a stage reads."""

import numpy as np
import pytest
import shapely

from pipeline.building_points import BuildingPoints
from pipeline.house_levels import HouseParts
from pipeline.houses import Houses, join_houses, take_houses
from tiler.tables import ARRAYS_TO_RAISE, ARRAYS_TO_SHAPE, pack_houses, unpack_houses


def make_houses() -> Houses:
    """Two houses, the second one of two parts."""
    outlines = shapely.box([0, 10], 0, [5, 20], 8)
    parts = np.append(outlines[:1], shapely.box([10, 14], 0, [14, 20], 8))
    roof, ground = (np.array([0, 2, 3, 5]), np.arange(5.0)), (np.array([0, 0, 1, 1]), np.ones(1))
    return Houses(
        np.array(["a", "b"]),
        outlines,
        np.array([np.nan, 7.0]),
        HouseParts(parts, np.array([0, 1, 1])),
        BuildingPoints(*roof, *ground),
    )


def test_houses_come_back_whole() -> None:
    houses = make_houses()
    found = unpack_houses(pack_houses(houses))
    assert found.ids.tolist() == ["a", "b"]
    assert (found.polygons == houses.polygons).all()
    assert (found.parts.polygons == houses.parts.polygons).all()
    assert found.points.roof_z.tolist() == houses.points.roof_z.tolist()
    assert found.points.ground_start.tolist() == houses.points.ground_start.tolist()


@pytest.mark.parametrize("names", [ARRAYS_TO_SHAPE, ARRAYS_TO_RAISE])
def test_houses_are_taken_and_joined_without_what_was_not_read(names: tuple[str, ...]) -> None:
    houses = make_houses()
    packed = {name: values for name, values in pack_houses(houses).items() if name in names}
    found = take_houses(join_houses([unpack_houses(packed)] * 2), np.array([3, 0]))
    assert found.ids.tolist() == ["b", "a"]
    assert found.parts.house.tolist() == [0, 0, 1]
    if names == ARRAYS_TO_SHAPE:
        assert (found.parts.polygons == houses.parts.polygons[[1, 2, 0]]).all()
        assert unpack_houses(packed).points.roof_start.tolist() == [0, 0, 0, 0]
        assert len(found.points.roof_z) == 0
        assert set(found.polygons.tolist()) == {None}
    else:
        assert (found.polygons == houses.polygons[[1, 0]]).all()
        assert found.points.roof_z.tolist() == [2.0, 3.0, 4.0, 0.0, 1.0]
        assert set(found.parts.polygons.tolist()) == {None}
