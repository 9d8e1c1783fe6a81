"""Splitting of houses by level: hand-made roofs with a known answer, degenerate houses, and promises."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from shapely import affinity

from pipeline.city_model.building_points import extract_building_points
from pipeline.city_model.city_steps import build_city
from pipeline.city_model.houses import divide_houses
from pipeline.data.citymodel import Footprints
from pipeline.data.classes import BUILDING, GROUND
from pipeline.data.pointcloud import PointCloud
from pipeline.geometry.rings import make_canonical
from pipeline.points_terrain.raster import Dtm
from pipeline.roofs.house_levels import HouseParts, LevelOptions, split_levels
from pipeline.roofs.roof_points import locate_roof_points, make_roof_points
from tests.helpers.cities import CITY_OPTIONS

Array = NDArray[np.float64]
Roof = Callable[[Array, Array], Array]
OPTIONS = LevelOptions(clearance=0.5)
HOUSE = shapely.box(0, 0, 10, 20)


def one(polygon: shapely.Polygon) -> NDArray[np.object_]:
    return np.array([polygon], dtype=object)


def scan(
    polygon: shapely.Polygon, roof: Roof, *, spacing: float = 0.5, noise: float = 0.02, seed: int = 0
) -> PointCloud:
    """Class 6 points on a shaken grid inside a polygon, `roof` over local coordinates."""
    rng = np.random.default_rng(seed)
    low_x, low_y, high_x, high_y = polygon.bounds
    x, y = np.meshgrid(np.arange(low_x, high_x, spacing), np.arange(low_y, high_y, spacing))
    xy = np.column_stack((x.ravel(), y.ravel())) + rng.uniform(0, spacing, (x.size, 2))
    xy = xy[shapely.contains_xy(polygon, xy[:, 0], xy[:, 1])]
    z = roof(xy[:, 0], xy[:, 1]) + rng.normal(0, noise, len(xy))
    return PointCloud(np.column_stack((xy, z)), np.full(len(xy), BUILDING, np.uint8))


def split(
    polygon: shapely.Polygon, roof: Roof, *, options: LevelOptions = OPTIONS, noise: float = 0.02
) -> NDArray[np.object_]:
    points = locate_roof_points(scan(polygon, roof, noise=noise), one(polygon), building_class=True)
    return split_levels(one(polygon), points, options).polygons


def new_vertices(parts: NDArray[np.object_], polygon: shapely.Polygon) -> Array:
    """Vertices of the parts that the house does not have."""
    old = set(map(tuple, shapely.get_coordinates(polygon).tolist()))
    xy = np.unique(shapely.get_coordinates(parts), axis=0).tolist()
    return np.array([place for place in xy if tuple(place) not in old]).reshape(-1, 2)


def annex(x: Array, y: Array) -> Array:
    """Front house up to y = 12, 15 m high; annex of 6 m behind it."""
    return np.where(y < 12, 15.0, 6.0)


def test_a_low_annex_is_cut_off_where_it_begins() -> None:
    parts = split(HOUSE, annex)
    assert len(parts) == 2
    cut = new_vertices(parts, HOUSE)
    assert cut[:, 0].tolist() == [0.0, 10.0]
    np.testing.assert_allclose(cut[:, 1], 12.0, atol=0.5)
    assert cut[0, 1] == pytest.approx(cut[1, 1], abs=1e-9)  # along the back wall
    assert sorted(shapely.area(parts).tolist()) == pytest.approx([80, 120], abs=5)


def test_parts_have_the_points_that_are_found_in_and_around_each() -> None:
    houses = np.array([shapely.box(30, 0, 40, 20), HOUSE, shapely.box(10, 0, 20, 20)], object)
    roofs = [scan(houses[0], lambda x, y: 9 + 0 * x), scan(HOUSE, annex), scan(houses[2], lambda x, y: 4 + x / 10)]
    soil = scan(shapely.box(-5, -5, 45, 25).difference(shapely.union_all(houses)), lambda x, y: y / 9)
    xyz = np.concatenate([cloud.xyz for cloud in (*roofs, soil)])
    count = len(xyz) - len(soil.xyz), len(soil.xyz)
    cloud = PointCloud(xyz, np.repeat(np.array([BUILDING, GROUND], np.uint8), count))
    footprints = Footprints(houses, np.array(["a", "b", "c"]), np.full(3, np.nan))
    options = replace(CITY_OPTIONS, simplify="clearance", clearance=0.5, split_levels=True)
    dtm = Dtm(np.zeros((80, 80)), -10, -10, 1.0)
    city = build_city(cloud, footprints, dtm, (-20.0, -20.0, 60.0, 60.0), options)
    divided = divide_houses(city, cloud, options)
    assert sorted(divided.parts.house.tolist()) == [0, 1, 1, 2]
    expected = extract_building_points(
        cloud, divided.parts.polygons, margin=options.ground_margin, building_class=True
    )
    for name, values in vars(expected).items():
        np.testing.assert_array_equal(getattr(divided.points, name), values, err_msg=name)
    assert (np.diff(expected.roof_start) > 0).all()
    assert (np.diff(expected.ground_start) > 0).all()


@pytest.mark.parametrize("angle", [17.0, 45.0, 120.0])
def test_the_cut_follows_the_walls_of_a_turned_house(angle: float) -> None:
    turn = affinity.rotate(HOUSE, angle, origin=(0, 0))
    cos, sin = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    parts = split(turn, lambda x, y: annex(cos * x + sin * y, cos * y - sin * x))
    assert len(parts) == 2
    cut = new_vertices(parts, turn)
    np.testing.assert_allclose(cut @ [-sin, cos], 12.0, atol=0.5)
    assert np.ptp(cut @ [-sin, cos]) < 1e-6


def test_three_levels_make_three_parts_and_one_cut_makes_two() -> None:
    def stairs(x: Array, y: Array) -> Array:
        return np.where(y < 7, 15.0, np.where(y < 14, 10.0, 5.0))

    parts = split(HOUSE, stairs)
    assert sorted(shapely.area(parts).tolist()) == pytest.approx([60, 70, 70], abs=5)
    assert len(split(HOUSE, stairs, options=replace(OPTIONS, max_depth=1))) == 2
    assert len(split(HOUSE, stairs, options=replace(OPTIONS, max_depth=0))) == 1


def test_levels_closer_than_the_step_stay_together() -> None:
    # Behind the front of 15 m: 8, 6.5 and 5 m. The cuts between them are made, and taken back.
    parts = split(HOUSE, lambda x, y: np.select([y < 7, y < 11, y < 15], [15.0, 8.0, 6.5], 5.0))
    assert sorted(shapely.area(parts).tolist()) == pytest.approx([70, 130], abs=5)
    assert len(new_vertices(parts, HOUSE)) == 2  # nothing is left of the wall that is gone


def gable(x: Array, y: Array) -> Array:
    return 10 + 5 * (1 - np.abs(x - 5) / 5)


def shed(x: Array, y: Array) -> Array:
    return 5 + 0.6 * y


def trees(x: Array, y: Array) -> Array:
    return np.where(np.random.default_rng(1).random(len(x)) < 0.08, 16.0, 9.0)


@pytest.mark.parametrize("roof", [lambda x, y: np.full(len(x), 9.0), gable, shed, trees, lambda x, y: 9 + 0.2 * x])
def test_flat_sloping_and_noisy_roofs_stay_whole(roof: Roof) -> None:
    parts = split(HOUSE, roof, noise=0.3)
    assert shapely.to_wkb(parts).tolist() == [shapely.to_wkb(HOUSE)]


def test_a_shed_roof_would_be_cut_by_medians_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pipeline.roofs.regions.MIN_NEAR", 10**9)
    assert len(split(HOUSE, shed)) > 1


def test_an_annex_under_a_gable_is_cut_off() -> None:
    parts = split(HOUSE, lambda x, y: np.where(y < 12, gable(x, y), 4.0))
    assert sorted(shapely.area(parts).tolist()) == pytest.approx([80, 120], abs=5)


def test_the_wing_of_an_l_shape_is_cut_at_its_corner() -> None:
    house = shapely.Polygon([(0, 0), (20, 0), (20, 8), (8, 8), (8, 20), (0, 20)])
    parts = split(house, lambda x, y: np.where(y < 8, 14.0, 5.0))
    cut = new_vertices(parts, house)
    assert len(cut) == 1  # from the corner (8, 8), to the bit, to the opposite wall
    np.testing.assert_allclose(cut, [[0, 8]], atol=0.02)
    assert sorted(shapely.area(parts).tolist()) == pytest.approx([96, 160], abs=0.1)


def test_a_cut_passes_through_a_corner_within_the_clearance() -> None:
    # The left wall has a jog at y = 12.3; the step of the roof is at 12.2.
    house = shapely.Polygon([(0, 0), (10, 0), (10, 20), (-1, 20), (-1, 12.3), (0, 12.3)])
    parts = split(house, lambda x, y: annex(x, y - 0.2))
    cut = new_vertices(parts, house)
    assert len(parts) == 2
    assert len(cut) == 1
    assert cut[0, 1] == pytest.approx(12.3, abs=1e-9)


@pytest.mark.parametrize("clearance", [0.5, 1.0])
def test_a_cut_keeps_its_distance_from_other_corners(clearance: float) -> None:
    # A chimney breast of 1.6 m on the right wall: the step at 12 lies within 1 m of both its corners.
    house = shapely.Polygon(
        [(0, 0), (10, 0), (10, 11.2), (10.9, 11.2), (10.9, 12.8), (10, 12.8), (10, 20), (0, 20)]
    )
    parts = split(house, annex, options=replace(OPTIONS, clearance=clearance))
    assert len(parts) == 2
    cut = new_vertices(parts, house)
    other = shapely.get_coordinates(house)
    near = np.hypot(*(cut[:, None] - other[None]).transpose(2, 0, 1)).min()
    assert near >= clearance
    assert shapely.minimum_clearance(parts).min() >= min(clearance, 0.9) - 1e-9


COURT = shapely.Polygon(shapely.box(0, 0, 40, 40).exterior, [shapely.box(10, 10, 30, 30).exterior])


def test_a_side_of_a_courtyard_is_cut_off_by_two_walls() -> None:
    parts = split(COURT, lambda x, y: np.where(x < 20, 15.0, 6.0))
    assert len(parts) == 2
    cut = new_vertices(parts, COURT)
    np.testing.assert_allclose(cut[:, 0], 20.0, atol=0.5)
    assert sorted(cut[:, 1].tolist()) == [0.0, 10.0, 30.0, 40.0]
    assert shapely.area(parts).sum() == pytest.approx(1200, abs=1e-6)


def test_a_cut_through_a_comb_joins_the_teeth_that_show_no_step() -> None:
    # One line would cut three teeth; only the middle one is low.
    comb = shapely.Polygon(
        [
            (0, 0),
            (25, 0),
            (25, 20),
            (20, 20),
            (20, 8),
            (15, 8),
            (15, 20),
            (10, 20),
            (10, 8),
            (5, 8),
            (5, 20),
            (0, 20),
        ]
    )
    parts = split(comb, lambda x, y: np.where((y > 8) & (x > 10) & (x < 15), 4.0, 12.0))
    assert sorted(shapely.area(parts).tolist()) == pytest.approx([60, 320], abs=1)


def test_a_tower_inside_a_roof_makes_a_part_in_a_hole() -> None:
    block = shapely.box(0, 0, 40, 40)
    parts = split(block, lambda x, y: np.where((abs(x - 20) < 7) & (abs(y - 20) < 7), 40.0, 10.0))
    assert sorted(shapely.get_num_interior_rings(parts).tolist()) == [0, 1]
    assert sorted(shapely.area(parts).tolist()) == pytest.approx([196, 1404], abs=15)


@pytest.mark.parametrize(
    "house",
    [
        shapely.Polygon([(0, 0), (12, 0), (0, 12)]),
        shapely.box(0, 0, 4, 5),  # less than twice the least area
        shapely.box(0, 0, 0.2, 80),
    ],
)
@pytest.mark.parametrize("n", [0, 1, 2, 25])
def test_small_houses_and_few_points_never_fail(house: shapely.Polygon, n: int) -> None:
    rng = np.random.default_rng(n)
    places = shapely.get_coordinates(shapely.point_on_surface(house)) + rng.normal(0, 0.01, (n, 2))
    xyz = np.column_stack((places, np.sort(rng.choice([3.0, 9.0], n))))
    parts = split_levels(one(house), make_roof_points(np.array([0, n]), xyz), OPTIONS)
    assert shapely.to_wkb(parts.polygons).tolist() == [shapely.to_wkb(house)]


def test_a_triangle_with_two_levels_is_cut_without_a_sharp_corner() -> None:
    house = shapely.Polygon([(0, 0), (20, 0), (0, 20)])
    parts = split(house, lambda x, y: np.where(x < 8, 12.0, 4.0))
    assert sorted(shapely.area(parts).tolist()) == pytest.approx([72, 128], abs=8)


def test_no_houses_have_no_parts() -> None:
    parts = split_levels(np.empty(0, object), make_roof_points(np.array([0]), np.empty((0, 3))), OPTIONS)
    assert len(parts.polygons) == len(parts.house) == 0
    assert parts.house.dtype == np.int64


def test_each_part_knows_its_house() -> None:
    houses = np.array([HOUSE, shapely.box(20, 0, 30, 20), shapely.box(40, 0, 50, 20)], dtype=object)
    cloud = PointCloud(
        np.concatenate([scan(house, annex if k != 1 else gable).xyz for k, house in enumerate(houses)]),
        np.full(1, BUILDING, np.uint8).repeat(sum(len(scan(house, annex).xyz) for house in houses)),
    )
    parts = split_levels(houses, locate_roof_points(cloud, houses, building_class=True), OPTIONS)
    assert parts.house.tolist() == [0, 0, 1, 2, 2]
    assert shapely.covers(shapely.buffer(houses[parts.house], 1e-6), parts.polygons).all()


@pytest.mark.parametrize(
    "change", [{"clearance": 0.0}, {"min_step": -1.0}, {"min_points": 0}, {"max_depth": -1}, {"min_area": np.nan}]
)
def test_wrong_options_are_told(change: dict[str, float]) -> None:
    points = make_roof_points(np.array([0, 0]), np.empty((0, 3)))
    with pytest.raises(ValueError, match=next(iter(change))):
        split_levels(one(HOUSE), points, replace(OPTIONS, **change))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="1 polygons do not match the points of 0"):
        split_levels(one(HOUSE), make_roof_points(np.array([0]), np.empty((0, 3))), OPTIONS)


def random_house(rng: np.random.Generator) -> shapely.Polygon:
    """Union of boxes on a grid of 1 m, turned: its own walls are 1 m apart or more."""
    low = rng.integers(0, 25, (5, 2)).astype(np.float64)
    size = rng.integers(6, 25, (5, 2)).astype(np.float64)
    boxes = shapely.box(low[:, 0], low[:, 1], low[:, 0] + size[:, 0], low[:, 1] + size[:, 1])
    parts = shapely.get_parts(shapely.union_all(boxes))
    house = parts[np.argmax(shapely.area(parts))]
    return affinity.rotate(house, rng.uniform(0, 90), origin=(0, 0))


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10**6))
def test_promises_on_random_houses(seed: int) -> None:
    rng = np.random.default_rng(seed)
    house = random_house(rng)
    levels = rng.uniform(4, 30, 12)
    centres = rng.uniform(house.bounds[:2], house.bounds[2:], (12, 2))

    def roof(x: Array, y: Array) -> Array:
        nearest = np.argmin(np.hypot(x[:, None] - centres[:, 0], y[:, None] - centres[:, 1]), axis=1)
        return np.asarray(levels[nearest])

    cloud = scan(house, roof, spacing=0.8, seed=seed)
    points = locate_roof_points(cloud, one(house), building_class=True)
    found = split_levels(one(house), points, OPTIONS)
    parts = found.polygons
    assert shapely.is_valid(parts).all()
    assert shapely.to_wkb(parts).tolist() == shapely.to_wkb(make_canonical(parts)).tolist() or len(parts) == 1
    assert shapely.coverage_is_valid(parts)
    assert shapely.area(parts).sum() == pytest.approx(house.area, rel=1e-9)
    assert shapely.union_all(parts).symmetric_difference(house).area < 1e-6
    if len(parts) > 1:
        every = np.unique(shapely.get_coordinates(parts), axis=0)
        apart = np.hypot(*(new_vertices(parts, house)[:, None] - every[None]).transpose(2, 0, 1))
        assert np.partition(apart, 1, axis=1)[:, 1].min() >= OPTIONS.clearance - 1e-6
        assert shapely.area(parts).min() >= OPTIONS.min_area
        within = locate_roof_points(cloud, parts, building_class=True)
        assert np.diff(within.start).min() >= OPTIONS.min_points
        medians = [np.median(z) for z in np.split(within.xyz[:, 2], within.start[1:-1])]
        rms = np.repeat([np.var(z) for z in np.split(within.xyz[:, 2], within.start[1:-1])], np.diff(within.start))
        assert rms.mean() <= (1 - OPTIONS.min_explained) * np.var(points.xyz[:, 2]) + 1e-9
        for i, j in zip(*np.triu_indices(len(parts), 1), strict=True):
            if shapely.intersection(parts[i], parts[j]).length > 0.01:
                assert abs(medians[i] - medians[j]) >= OPTIONS.min_step


@pytest.mark.parametrize("digits", [0, 9])
def test_the_order_of_the_points_does_not_matter(digits: int) -> None:
    house = random_house(np.random.default_rng(3))
    cloud = scan(house, lambda x, y: np.where(x + y < 25, 12.0, np.where(x < y, 6.0, 20.0)), noise=0.5)
    cloud.xyz[:, 2] = cloud.xyz[:, 2].round(digits)
    order = np.random.default_rng(0).permutation(len(cloud.xyz))
    shuffled = PointCloud(cloud.xyz[order], cloud.classification[order])
    results: list[HouseParts] = [
        split_levels(one(house), locate_roof_points(data, one(house), building_class=True), OPTIONS)
        for data in (cloud, shuffled)
    ]
    assert len(results[0].polygons) > 2
    assert shapely.to_wkb(results[0].polygons).tolist() == shapely.to_wkb(results[1].polygons).tolist()
