"""The full city model: corners of parts that lie too close together."""

import numpy as np
import shapely

from pipeline.city_model.full_model import join_close
from pipeline.data.roofs import ROOF_METHODS, flat_roofs
from pipeline.roofs.house_levels import HouseParts
from pipeline.roofs.house_roofs import HouseRoofs


def test_corners_of_a_skeleton_that_are_close_become_those_of_the_outline() -> None:
    """A wall that ends 1 mm beside a corner ends there, on both sides; other corners, and planes, stay."""
    outline = shapely.Polygon([(0, 0), (5, 0), (10, 0.1), (10, 8), (0, 8)])
    west = shapely.Polygon([(0, 0), (5, 0), (5.001, 0), (5, 8), (0, 8)])
    east = shapely.Polygon([(5.001, 0), (10, 0.1), (10, 8), (5, 8)])
    parts = HouseParts(np.array([west, east], object), np.zeros(2, np.int64))
    for method, joined in (("skeleton", True), ("planes", False)):
        code = np.array([ROOF_METHODS.index(method)], np.int8)
        one = HouseRoofs(parts, flat_roofs(np.zeros(2)), code, np.ones(1, np.int32), np.zeros(1, np.bool_))
        found = join_close(one, np.array([outline], object)).polygons
        assert (found.tolist() == parts.polygons.tolist()) == (not joined)
        if joined:
            assert shapely.get_num_coordinates(found).tolist() == [5, 5]
            assert shapely.equals(shapely.union_all(found), outline)
            assert shapely.coverage_is_valid(found)
