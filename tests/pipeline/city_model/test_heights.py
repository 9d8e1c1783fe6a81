"""Steps 1.5, 1.6 and 2.3: building points, heights, roofs that terrain forces up."""

import numpy as np
import pytest
import shapely

from pipeline.city_model.building_points import (
    BuildingPoints,
    extract_building_points,
    has_building_class,
    merge_building_points,
    reach_of_points,
    remove_outliers,
)
from pipeline.city_model.heights import (
    ROOF_SOURCES,
    Heights,
    compute_building_heights,
    highest_wall_ground,
    raise_low_roofs,
)
from pipeline.data.classes import BUILDING, GROUND, HIGH_VEGETATION, UNCLASSIFIED, WATER
from pipeline.data.pointcloud import PointCloud
from pipeline.geometry.group_order import percentile_by_group
from tests.helpers.cities import cloud_over, tilted_dtm

HOUSE = shapely.box(10, 10, 20, 20)


def polygons(*shapes: shapely.Polygon) -> np.ndarray[tuple[int], np.dtype[np.object_]]:
    array = np.empty(len(shapes), object)
    array[:] = shapes
    return array


def brute_force(cloud: PointCloud, shape: shapely.Polygon, classes: tuple[int, ...]) -> list[float]:
    wanted = np.isin(cloud.classification, classes)
    return sorted(z for x, y, z in cloud.xyz[wanted] if shape.contains(shapely.Point(x, y)))


def test_roof_points_are_those_inside_by_brute_force() -> None:
    rng = np.random.default_rng(3)
    xyz = rng.uniform(0, 60, (4000, 3))
    cloud = PointCloud(xyz, rng.choice([GROUND, BUILDING, WATER], 4000).astype(np.uint8))
    ring = shapely.Polygon(shapely.box(5, 5, 50, 50).exterior, [shapely.box(20, 20, 30, 30).exterior])
    shapes = polygons(HOUSE, shapely.Point(40, 30).buffer(8), ring, shapely.box(100, 100, 110, 110))
    points = extract_building_points(cloud, shapes, margin=1.0, building_class=True)
    for row, shape in enumerate(shapes):
        inside = np.array(brute_force(cloud, shape, (BUILDING,)))
        _, kept = remove_outliers(np.array([0, len(inside)]), inside)
        assert points.roof_z[points.roof_start[row] : points.roof_start[row + 1]].tolist() == kept.tolist()
    assert points.roof_start[-1] == len(points.roof_z) > 0


def test_ground_points_lie_outside_within_the_margin() -> None:
    xyz = np.array([[9.5, 15, 1.0], [8.5, 15, 2.0], [15, 15, 3.0], [15, 20.9, 4.0], [15, 21.1, 5.0]])
    cloud = PointCloud(xyz, np.array([GROUND, GROUND, GROUND, WATER, WATER], np.uint8))
    points = extract_building_points(cloud, polygons(HOUSE), margin=1.0, building_class=True)
    assert points.ground_z.tolist() == [1.0, 4.0]


@pytest.mark.parametrize("margin", [0.01, 1.0, 5.0])
def test_all_ground_points_of_parts_lie_in_reach(margin: float) -> None:
    """The outline has so many vertices that it is coarsened, its parts have not."""
    angle = np.linspace(0, 2 * np.pi, 3001)[:-1]
    radius = 20 + 0.24 * margin * (np.arange(3000) % 2)
    round_house = shapely.Polygon(np.column_stack((radius * np.cos(angle), radius * np.sin(angle))))
    half = shapely.clip_by_rect(round_house, -30, -30, 0, 30)
    xy = np.random.default_rng(5).uniform(-32, 32, (20_000, 2))
    cloud = PointCloud(np.column_stack((xy, xy[:, 0])), np.full(len(xy), GROUND, np.uint8))
    (area,) = reach_of_points(polygons(round_house), margin)
    near = shapely.contains_xy(area, xy[:, 0], xy[:, 1])
    part = PointCloud(cloud.xyz[near], cloud.classification[near])
    assert near.sum() < len(xy)
    for shape in (round_house, half):
        found, expected = (
            extract_building_points(one, polygons(shape), margin=margin, building_class=True)
            for one in (part, cloud)
        )
        assert found.ground_z.tolist() == expected.ground_z.tolist()


def test_without_building_class_roofs_are_what_is_neither_ground_nor_plants() -> None:
    xyz = np.array([[12.0, 12, 8], [13, 13, 9], [14, 14, 0], [15, 15, 20]])
    cloud = PointCloud(xyz, np.array([UNCLASSIFIED, 26, GROUND, HIGH_VEGETATION], np.uint8))
    assert not has_building_class(cloud)
    points = extract_building_points(cloud, polygons(HOUSE), margin=1.0, building_class=False)
    assert points.roof_z.tolist() == [8.0, 9.0]


def test_points_do_not_depend_on_the_order_of_the_cloud() -> None:
    rng = np.random.default_rng(5)
    xyz = rng.normal(15, 4, (3000, 3))
    classes = rng.choice([GROUND, BUILDING], 3000).astype(np.uint8)
    order = rng.permutation(3000)
    one = extract_building_points(PointCloud(xyz, classes), polygons(HOUSE), margin=1.0, building_class=True)
    two = extract_building_points(
        PointCloud(xyz[order], classes[order]), polygons(HOUSE), margin=1.0, building_class=True
    )
    assert one.roof_z.tobytes() == two.roof_z.tobytes()
    assert one.ground_z.tobytes() == two.ground_z.tobytes()


@pytest.mark.parametrize("shapes", [polygons(), polygons(HOUSE)])
def test_no_points_and_no_buildings_give_empty_groups(
    shapes: np.ndarray[tuple[int], np.dtype[np.object_]],
) -> None:
    empty = PointCloud(np.empty((0, 3)), np.empty(0, np.uint8))
    points = extract_building_points(empty, shapes, margin=1.0, building_class=True)
    assert points.roof_start.tolist() == [0] * (len(shapes) + 1)


@pytest.mark.parametrize("percentile", [0.0, 10.0, 37.5, 90.0, 100.0])
def test_percentiles_are_numpys(percentile: float) -> None:
    rng = np.random.default_rng(2)
    groups = [np.sort(rng.normal(size=n)) for n in (1, 2, 7, 40)]
    start = np.concatenate(([0], np.cumsum([len(group) for group in groups])))
    found = percentile_by_group(start, np.concatenate(groups), percentile)
    np.testing.assert_allclose(found, [np.percentile(group, percentile) for group in groups], rtol=1e-12)


def heights_of(points: BuildingPoints, given: float, default: float) -> Heights:
    return compute_building_heights(
        points,
        polygons(HOUSE),
        tilted_dtm((0.0, 0.0, 30.0, 30.0), slope_x=0.1),
        ground_percentile=10,
        roof_percentile=90,
        given_height=np.array([given]),
        default_height=default,
    )


NOTHING = BuildingPoints(np.array([0, 0]), np.empty(0), np.array([0, 0]), np.empty(0))


@pytest.mark.parametrize(
    ("given", "default", "source", "roof"),
    [(7.0, 5.0, "attribute", 8.5), (np.nan, 5.0, "default", 6.5), (np.nan, 0.0, "none", np.nan)],
)
def test_without_points_heights_follow_the_stated_rule(
    given: float, default: float, source: str, roof: float
) -> None:
    heights = heights_of(NOTHING, given, default)
    # The terrain at the centroid (15, 15) is 1.5 m.
    assert heights.ground.tolist() == [1.5]
    assert heights.ground_from_dtm.tolist() == [True]
    assert ROOF_SOURCES[heights.roof_source[0]] == source
    np.testing.assert_allclose(heights.roof, [roof])


def test_with_points_heights_are_the_papers_percentiles() -> None:
    cloud = cloud_over((0.0, 0.0, 30.0, 30.0), [(HOUSE, 12.0)], ground=2.0)
    points = extract_building_points(cloud, polygons(HOUSE), margin=1.0, building_class=True)
    heights = heights_of(points, 99.0, 99.0)
    assert (heights.ground[0], heights.roof[0]) == (2.0, 12.0)
    assert ROOF_SOURCES[heights.roof_source[0]] == "points"


def test_merged_buildings_pool_their_points() -> None:
    points = BuildingPoints(
        np.array([0, 2, 3, 4]), np.array([5.0, 7, 6, 1]), np.array([0, 0, 1, 1]), np.array([2.0])
    )
    merged = merge_building_points(points, (np.array([0, 1]),))
    assert merged.roof_z.tolist() == [5.0, 6.0, 7.0]
    assert merged.ground_z.tolist() == [2.0]


def test_highest_wall_ground_looks_along_walls_and_courtyards() -> None:
    dtm = tilted_dtm((0.0, 0.0, 30.0, 30.0), slope_x=1.0)
    assert highest_wall_ground(polygons(HOUSE), dtm).tolist() == [20.0]


def test_low_roofs_are_raised_and_told() -> None:
    roof, raised = raise_low_roofs(np.array([3.0, 9.0]), np.array([4.0, 4.0]), clearance=2.0)
    assert roof.tolist() == [6.0, 9.0]
    assert raised.tolist() == [True, False]
