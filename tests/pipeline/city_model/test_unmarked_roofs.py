"""Step 1.5: roofs that a cloud leaves in other classes, house by house."""

from collections.abc import Callable
from pathlib import Path

import laspy
import numpy as np
import pyogrio
import pytest
import shapely
from numpy.typing import NDArray

from pipeline.city_model.unmarked_roofs import MAY_BE_ROOF, are_roofs, find_bare, locate_unmarked
from pipeline.data.classes import BUILDING, GROUND, UNCLASSIFIED
from pipeline.data.pointcloud import PointCloud, rename_classes
from pipeline.points_terrain.terrain import compute_dtm
from pipeline.roofs.roof_points import RoofPoints, locate_roof_points
from tests.helpers.cities import tilted_dtm

Array = NDArray[np.float64]
BOX = (0.0, 0.0, 40.0, 40.0)
DTM = tilted_dtm(BOX, height=2.0)
HOUSE = shapely.box(10, 10, 22, 20)
ONE = np.array([HOUSE], object)
SPACINGS = (0.25, 0.6, 1.2)


def scan(
    area: shapely.Geometry, height: Callable[[Array, Array], Array], *, spacing: float = 0.6, seed: int = 0
) -> Array:
    """Points of a height above the ground, over coordinates, on a shaken grid in an area."""
    rng = np.random.default_rng(seed)
    low_x, low_y, high_x, high_y = area.bounds
    x, y = (a.ravel() for a in np.meshgrid(np.arange(low_x, high_x, spacing), np.arange(low_y, high_y, spacing)))
    x, y = (a + rng.uniform(0, spacing, len(x)) for a in (x, y))
    inside = shapely.contains_xy(area, x, y)
    x, y = x[inside], y[inside]
    return np.column_stack((x, y, 2.0 + height(x, y) + rng.normal(0, 0.02, len(x))))


def crown(x: float, y: float, *, n: int, radius: float = 4.0, low: float = 4.0, high: float = 11.0) -> Array:
    """Points anywhere in a tree's crown, between two heights above the ground."""
    rng = np.random.default_rng(5)
    angle, far = rng.uniform(0, 2 * np.pi, n), radius * np.sqrt(rng.random(n))
    return np.column_stack((x + far * np.cos(angle), y + far * np.sin(angle), 2 + rng.uniform(low, high, n)))


def flat(height: float) -> Callable[[Array, Array], Array]:
    return lambda x, _: np.full(len(x), height)


def gable(x: Array, y: Array) -> Array:
    """Ridge of 45 degrees at y = 15, 9 m high; eaves of 4 m."""
    return np.asarray(9 - np.abs(y - 15), np.float64) + 0 * x


def unclassified(*several: Array) -> PointCloud:
    xyz = np.concatenate(several)
    return PointCloud(xyz, np.full(len(xyz), UNCLASSIFIED, np.uint8))


def ground(*several: Array) -> PointCloud:
    xyz = np.concatenate([np.empty((0, 3)), *several])
    return PointCloud(xyz, np.full(len(xyz), GROUND, np.uint8))


def found_roof(others: PointCloud, soil: PointCloud | None = None) -> tuple[bool, RoofPoints]:
    found = locate_unmarked(others, ONE, DTM)
    (there,) = are_roofs(found, ONE, ground() if soil is None else soil)
    return bool(there), found.points


@pytest.mark.parametrize("spacing", SPACINGS)
def test_a_flat_roof_in_class_1_is_a_roof(spacing: float) -> None:
    there, found = found_roof(unclassified(scan(HOUSE, flat(20.0), spacing=spacing)))
    assert there
    assert np.median(found.z) == pytest.approx(22.0, abs=0.05)


@pytest.mark.parametrize("spacing", SPACINGS)
def test_a_gable_is_a_roof(spacing: float) -> None:
    there, found = found_roof(unclassified(scan(HOUSE, gable, spacing=spacing)))
    assert there
    assert np.median(found.z) == pytest.approx(2 + 6.5, abs=0.3)


@pytest.mark.parametrize("spacing", SPACINGS[:2])
def test_a_steep_roof_of_a_narrow_house_is_a_roof(spacing: float) -> None:
    house = np.array([shapely.box(10, 10, 15.5, 22)], object)
    points = scan(house[0], lambda x, _: 14 - 1.7 * np.abs(x - 12.75), spacing=spacing)  # 60 degrees
    found = locate_unmarked(unclassified(points), house, DTM)
    assert are_roofs(found, house, ground()).all()
    assert np.median(found.points.z) == pytest.approx(2 + 14 - 1.7 * 1.375, abs=0.3)


def test_two_levels_are_one_roof_with_all_its_points() -> None:
    points = scan(HOUSE, lambda x, _: np.where(x < 15.3, 6.0, 14.0))
    there, found = found_roof(unclassified(points))
    assert there
    assert len(found.z) >= 0.97 * len(points)


@pytest.mark.parametrize("spacing", SPACINGS)
def test_a_tree_over_a_roof_does_not_lift_it(spacing: float) -> None:
    roof = scan(HOUSE, flat(6.0), spacing=spacing)
    tree = crown(14, 15, n=int(50 / spacing**2), low=8.0, high=16.0)
    there, found = found_roof(unclassified(roof, tree))
    assert there
    assert np.median(found.z) == pytest.approx(8.0, abs=0.1)
    assert np.percentile(found.z, 90) == pytest.approx(8.0, abs=0.2)


@pytest.mark.parametrize("spacing", SPACINGS)
def test_trees_where_no_house_stands_are_no_roof(spacing: float) -> None:
    trees = [crown(x, y, n=int(50 / spacing**2)) for x in (12, 16, 20) for y in (12, 18)]
    assert not found_roof(unclassified(*trees))[0]


def test_cars_and_grass_are_no_roof() -> None:
    grass, van = scan(HOUSE, flat(0.3)), scan(shapely.box(12, 12, 14, 17), flat(2.4))
    assert not found_roof(unclassified(grass))[0]
    assert not found_roof(unclassified(grass, van))[0]


def test_chimneys_and_few_points_are_no_roof() -> None:
    chimneys = [scan(shapely.box(x, 12, x + 1, 13), flat(9.0), spacing=0.2) for x in (11, 15, 19)]
    assert not found_roof(unclassified(*chimneys))[0]
    assert not found_roof(unclassified(scan(HOUSE, flat(9.0), spacing=4.0)))[0]
    assert not found_roof(unclassified(np.empty((0, 3))))[0]


def test_more_ground_than_roof_is_no_roof() -> None:
    others = unclassified(scan(HOUSE, flat(9.0), spacing=0.6))
    assert not found_roof(others, ground(scan(HOUSE, flat(0.0), spacing=0.5)))[0]
    assert found_roof(others, ground(scan(shapely.box(10, 10, 22, 13), flat(0.0), spacing=0.5)))[0]


def test_the_order_of_points_and_other_houses_change_nothing() -> None:
    houses = np.array([HOUSE, shapely.box(22, 10, 35, 20)], object)
    others = unclassified(scan(shapely.union_all(houses), gable), crown(20, 15, n=200))
    order = np.random.default_rng(2).permutation(len(others.xyz))
    both = locate_unmarked(PointCloud(others.xyz[order], others.classification), houses, DTM).points
    _, alone = found_roof(others)
    np.testing.assert_array_equal(both.z[: both.start[1]], alone.z)


def test_a_house_is_bare_without_points_of_class_6_or_with_strays_alone() -> None:
    houses = np.array(
        [HOUSE, shapely.box(22, 10, 35, 20), shapely.box(0, 30, 10, 40), shapely.box(30, 30, 36, 38)]
    )
    strays = shapely.box(10, 10, 22, 10.8)  # of the next house
    xyz = np.concatenate(
        [scan(strays, flat(9.0), spacing=0.3), scan(houses[1], flat(9.0)), scan(houses[3], flat(5.0), spacing=1.4)]
    )
    cloud = PointCloud(xyz, np.full(len(xyz), BUILDING, np.uint8))
    points = locate_roof_points(cloud, houses, building_class=True)
    assert find_bare(points, houses).tolist() == [True, False, True, False]


def test_ground_plants_water_wires_and_bridges_are_never_roofs() -> None:
    assert not set(MAY_BE_ROOF) & {2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 13, 14, 15, 16, 17, 18, 19, 40, 45}
    assert set(MAY_BE_ROOF) >= {0, 1, 12, 20, 26, 64, 67, 255}


def test_classes_that_mark_buildings_take_the_place_of_6() -> None:
    assert rename_classes([6]).tolist() == list(range(256))
    assert rename_classes([6, 67])[[6, 67, 1]].tolist() == [6, 6, 1]
    assert rename_classes([67])[[6, 67, 1]].tolist() == [1, 6, 1]


@pytest.mark.long
def test_houses_of_amsterdam_have_their_roofs_without_class_6(shared_data: Path) -> None:
    parts = [laspy.read(path) for path in sorted((shared_data / "amsterdam" / "tiles").glob("*.laz"))]
    xyz = np.concatenate([np.asarray(part.xyz) for part in parts])
    cloud = PointCloud(xyz, np.concatenate([np.asarray(part.classification, np.uint8) for part in parts]))
    bounds = (*np.floor(xyz[:, :2].min(axis=0)).tolist(), *np.ceil(xyz[:, :2].max(axis=0)).tolist())
    houses = shapely.from_wkb(pyogrio.raw.read(shared_data / "amsterdam" / "footprints.shp")[2])
    houses = houses[shapely.is_valid(houses) & (shapely.get_type_id(houses) == 3) & (shapely.area(houses) > 5)]
    houses = houses[shapely.contains(shapely.box(*bounds), houses)]
    marked = locate_roof_points(cloud, houses, building_class=True)
    assert find_bare(marked, houses).sum() <= 5
    others = np.isin(cloud.classification, (*MAY_BE_ROOF, BUILDING))
    unmarked = PointCloud(xyz[others], cloud.classification[others])
    found = locate_unmarked(unmarked, houses, compute_dtm(cloud, bounds))
    there = np.flatnonzero(are_roofs(found, houses, cloud) & (np.diff(marked.start) > 0))
    assert len(there) > 0.95 * len(houses)
    medians = [
        [np.median(points.z[points.start[k] : points.start[k + 1]]) for k in there.tolist()]
        for points in (marked, found.points)
    ]
    error = np.percentile(np.abs(np.array(medians[0]) - np.array(medians[1])), [50, 90, 95])
    assert (error < (0.1, 0.5, 0.8)).all()
