"""Houses as arrays for the store, and back, all of them or those that a stage reads."""

import numpy as np
import pytest
import shapely

from pipeline.city_model.building_points import BuildingPoints
from pipeline.city_model.houses import Houses, join_houses, take_houses
from pipeline.data.roofs import flat_roofs
from pipeline.quality.point_fidelity import HouseFidelity
from pipeline.roofs.house_levels import HouseParts
from tests.helpers.cities import city_of, crowded_blocks
from tiler.citymodels.tables import (
    ARRAYS_TO_RAISE,
    ARRAYS_TO_SHAPE,
    NEAR_ARRAYS,
    Buildings,
    join_near,
    no_buildings,
    pack_houses,
    pack_model,
    take_buildings,
    take_near,
    unpack_houses,
)


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
        flat_roofs(np.array([np.nan, 4.0, 6.0])),
        np.array([3, 0], np.int8),
        np.array([True, False]),
        np.array([4, -2], np.int8),
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
    assert found.roofs.plane[1:].tolist() == [[0.0, 0.0, 4.0], [0.0, 0.0, 6.0]]
    assert found.method.tolist() == [3, 0]
    assert found.too_few.tolist() == [True, False]
    assert found.form.tolist() == [4, -2]


@pytest.mark.parametrize("names", [ARRAYS_TO_SHAPE, ARRAYS_TO_RAISE])
def test_houses_are_taken_and_joined_without_what_was_not_read(names: tuple[str, ...]) -> None:
    houses = make_houses()
    packed = {name: values for name, values in pack_houses(houses).items() if name in names}
    found = take_houses(join_houses([unpack_houses(packed)] * 2), np.array([3, 0]))
    assert found.ids.tolist() == ["b", "a"]
    assert found.parts.house.tolist() == [0, 0, 1]
    assert found.roofs.plane[:2, 2].tolist() == [4.0, 6.0]
    assert found.method.tolist() == [0, 3]
    assert found.form.tolist() == [-2, 4]
    if names == ARRAYS_TO_SHAPE:
        assert (found.parts.polygons == houses.parts.polygons[[1, 2, 0]]).all()
        assert unpack_houses(packed).points.roof_start.tolist() == [0, 0, 0, 0]
        assert len(found.points.roof_z) == 0
        assert set(found.polygons.tolist()) == {None}
    else:
        assert (found.polygons == houses.polygons[[1, 0]]).all()
        assert found.points.roof_z.tolist() == [2.0, 3.0, 4.0, 0.0, 1.0]
        assert set(found.parts.polygons.tolist()) == {None}


def make_town() -> Buildings:
    """Turned blocks, many of whose boxes reach farther than they do, in groups of two."""
    blocks = crowded_blocks((0.0, 0.0, 300.0, 300.0), 60, seed=8)
    rows = np.arange(len(blocks))
    heights = rows.astype(np.float64)
    return Buildings(
        city_of(blocks, (10.0 + rows).tolist()),
        np.zeros(len(rows), np.int8),
        0.5 + heights,
        0.25 * heights,
        rows // 2,
        rows.astype(np.int32),
        HouseFidelity(rows, *np.zeros((5, len(rows)))),
        (rows % 4).astype(np.int8),
        (rows % 3).astype(np.int8),
        (rows % 5 - 1).astype(np.int8),
    )


def test_buildings_near_a_box_are_those_that_meet_it() -> None:
    town = make_town()
    order = np.random.default_rng(2).permutation(len(town))
    tiles = [pack_model(take_buildings(town, rows)) for rows in (order[:25], order[25:], order[:0])]
    read = [{name: arrays[name] for name in NEAR_ARRAYS} for arrays in tiles]
    boxes_only = 0
    for x, y in np.random.default_rng(3).uniform(0, 290, (200, 2)):
        box = shapely.box(x, y, x + 5, y + 20)
        shapely.prepare(box)
        near = join_near([take_near(arrays, box) for arrays in read])
        meet = shapely.intersects(town.model.polygons, box)
        expected = take_buildings(town, np.flatnonzero(meet)[np.argsort(town.model.ids[meet], kind="stable")])
        assert near.model.ids.tolist() == expected.model.ids.tolist()
        assert (near.model.polygons == expected.model.polygons).all()
        for name in ("numbers", "ground", "roof"):
            assert getattr(near.model, name).tolist() == getattr(expected.model, name).tolist()
        assert near.wall_ground.tolist() == expected.wall_ground.tolist()
        assert near.layers.tolist() == expected.layers.tolist()
        boxes_only += int(shapely.intersects(shapely.envelope(town.model.polygons), box).sum() - meet.sum())
    assert boxes_only > 10, "a box that meets says nothing of the building"


def test_groups_of_tiles_stay_apart_and_layers_may_come_later() -> None:
    packed, everywhere = pack_model(make_town()), shapely.box(0, 0, 300, 300)
    near = join_near([take_near(packed, everywhere, np.full(len(make_town()), 7, np.int32))] * 2)
    assert set(near.layers.tolist()) == {7}
    _, size = np.unique(near.group, return_counts=True)
    assert size.tolist() == np.bincount(make_town().group).tolist() * 2


def test_no_buildings_are_near_where_there_are_none() -> None:
    assert len(join_near([take_near(pack_model(no_buildings()), shapely.box(0, 0, 9, 9))])) == 0
    assert len(join_near([])) == 0
