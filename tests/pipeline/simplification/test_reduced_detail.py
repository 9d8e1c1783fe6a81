"""Houses at lower levels of detail: parts that become one, and walls that keep what others meet."""

import numpy as np
import pytest
import shapely

from pipeline.city_model.building_points import BuildingPoints
from pipeline.city_model.city import assemble_city
from pipeline.city_model.heights import Heights
from pipeline.data.citymodel import Footprints
from pipeline.data.roofs import Roofs, is_flat
from pipeline.simplification.reduced_detail import BLOCK, FULL, PARTS, reduce_detail

# Two houses side by side: a gable in two parts with an annex, and a house that meets the gable's ridge.
GABLE_SOUTH = shapely.Polygon([(0, 0), (10, 0), (10, 5), (0, 5)])
GABLE_NORTH = shapely.Polygon([(0, 5), (10, 5), (10, 9), (10, 10), (0, 10)])
ANNEX = shapely.Polygon([(-6, 0), (0, 0), (0, 5), (0, 10), (-6, 10)])
OTHER = shapely.Polygon([(10, 0), (20, 0), (20, 9), (10, 9), (10, 5)])


@pytest.mark.parametrize("detail", [FULL, PARTS, BLOCK])
def test_parts_become_one_where_the_level_asks_for_it(detail: int) -> None:
    polygons = np.array([GABLE_SOUTH, GABLE_NORTH, ANNEX, OTHER])
    ids, house = np.array(["a-part1", "a-part2", "a-part3", "b"]), np.array(["a", "a", "a", "b"])
    nothing = np.zeros(5, np.int64), np.empty(0)
    roofs = Roofs(
        np.array([(0, 0.5, 10), (0, -0.5, 15), (0, 0, 4.0), (0, 0, 8.0)]),
        np.zeros((4, 2)),
        np.array([(10, 12.5), (10, 12.5), (4, 4), (8, 8.0)]),
    )
    heights = Heights(np.zeros(4), np.array([12.5, 12.5, 4, 8]), np.zeros(4, np.int8), np.zeros(4, np.bool_))
    city = assemble_city(
        Footprints(polygons, ids, np.full(4, np.nan)),
        BuildingPoints(*nothing, *nothing),
        heights,
        tuple((name,) for name in house.tolist()),
        np.zeros(4),
        roofs=roofs,
        house=house,
    )
    level = np.array([detail] * 3 + [FULL])
    found, row = reduce_detail(city, level, step=2.5, clearance=2.0, tolerance=0.01)
    model = found.model
    assert model.polygons[-1] is OTHER
    assert row.tolist() == {FULL: [0, 1, 2, 3], PARTS: [0, 0, 1, 2], BLOCK: [0, 0, 0, 1]}[detail]
    assert (
        model.ids.tolist() == {FULL: ids.tolist(), PARTS: ["a-part1", "a-part3", "b"], BLOCK: ["a", "b"]}[detail]
    )
    if detail == FULL:
        assert model.roofs.plane.tobytes() == roofs.plane.tobytes()
        return
    assert is_flat(model.roofs).all()
    if detail == PARTS:
        np.testing.assert_allclose(model.roof[:2], [11.25, 4], atol=0.01)
    else:
        np.testing.assert_allclose(model.roof[0], (100 * 11.25 + 60 * 4) / 160)
    # The wall to the other house keeps its vertices, those within the house are gone.
    mine = {tuple(place) for place in shapely.get_coordinates(model.polygons[0]).tolist()}
    assert {(10, 5), (10, 9)} <= mine
    assert (0, 5) not in mine
    assert shapely.coverage_is_valid(model.polygons)
    np.testing.assert_allclose(shapely.area(model.polygons).sum(), shapely.area(polygons).sum())
