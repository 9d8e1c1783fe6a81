"""Planes of roofs from points: hand-made roofs with known planes, houses with few or no points, and promises."""

from dataclasses import replace

import numpy as np
import pytest
import shapely
from numpy.typing import NDArray

from pipeline.data.roofs import ROOF_METHODS, roof_heights
from pipeline.geometry.inside import find_inside
from pipeline.geometry.rings import make_canonical
from pipeline.roofs.house_roofs import HouseRoofs, RoofOptions, fit_roofs
from pipeline.roofs.plane_search import search_levels
from pipeline.roofs.roof_points import make_roof_points, no_roof_points
from tests.helpers.sloped_roofs import SHAPES, SlopedHouse, scan_roof, town_of_slopes

Array = NDArray[np.float64]
OPTIONS = RoofOptions(clearance=1.0)
METHOD = {name: k for k, name in enumerate(ROOF_METHODS)}


def one(polygon: shapely.Polygon) -> NDArray[np.object_]:
    return np.array([polygon], dtype=object)


def fit(polygon: shapely.Polygon, xyz: Array, options: RoofOptions = OPTIONS) -> HouseRoofs:
    return fit_roofs(one(polygon), make_roof_points(np.array([0, len(xyz)]), xyz), options)[0]


def heights_at(found: HouseRoofs, xy: Array) -> Array:
    """Heights of the roofs at places inside parts; NaN elsewhere."""
    part, place = find_inside(xy, found.parts.polygons)
    z = np.full(len(xy), np.nan)
    z[place] = roof_heights(found.roofs, part, xy[place])
    return z


def ridge_of(found: HouseRoofs, polygon: shapely.Polygon) -> Array:
    """Vertices of the parts that the house does not have."""
    old = set(map(tuple, shapely.get_coordinates(polygon).tolist()))
    xy = np.unique(shapely.get_coordinates(found.parts.polygons), axis=0).tolist()
    return np.array([place for place in xy if tuple(place) not in old]).reshape(-1, 2)


def check_cover(found: HouseRoofs, polygons: NDArray[np.object_]) -> None:
    """Parts are valid, canonical, and cover each house without overlap, with shared vertices."""
    parts, house = found.parts.polygons, found.parts.house
    assert shapely.is_valid(parts).all()
    divided = parts[np.bincount(house)[house] > 1]
    assert shapely.to_wkb(make_canonical(divided)).tolist() == shapely.to_wkb(divided).tolist()
    areas = np.bincount(house, shapely.area(parts), len(polygons))
    np.testing.assert_allclose(areas, shapely.area(polygons), rtol=1e-9)
    assert all(shapely.coverage_is_valid(parts[house == k]) for k in range(len(polygons)))
    assert len(found.roofs) == len(parts)
    assert (found.roofs.limits[:, 0] <= found.roofs.limits[:, 1]).all()


@pytest.mark.parametrize("density", [14.0, 4.0])
@pytest.mark.parametrize("name", SHAPES)
def test_planes_of_known_roofs_are_found(name: str, density: float) -> None:
    house = SHAPES[name]
    found = fit(house.outline, scan_roof(house, density=density))
    check_cover(found, one(house.outline))
    assert found.n_planes.tolist() == [house.n_planes]
    assert len(found.parts.polygons) == house.n_planes
    inner = shapely.get_coordinates(shapely.buffer(house.outline, -1.5).segmentize(0.5))
    error = np.abs(heights_at(found, inner) - house.roof(*inner.T))
    assert np.nanmedian(error) < 0.06
    assert np.nanmean(error < 0.25) > 0.9


def test_a_gable_has_its_ridge_in_the_middle_and_its_slopes() -> None:
    house = SHAPES["gable"]
    found = fit(house.outline, scan_roof(house))
    assert found.method[0] in (METHOD["planes"], METHOD["family"])
    np.testing.assert_allclose(sorted(found.roofs.plane[:, 0]), [-0.9, 0.9], atol=0.02)
    np.testing.assert_allclose(found.roofs.plane[:, 1], 0, atol=1e-12)  # uphill across the walls
    ridge = ridge_of(found, house.outline)
    assert ridge[:, 1].tolist() == [0.0, 14.0]
    np.testing.assert_allclose(ridge[:, 0], 4.5, atol=0.05)
    top = roof_heights(found.roofs, np.array([0, 1]), np.array([[4.5, 7.0], [4.5, 7.0]]))
    np.testing.assert_allclose(top, 6 + 0.9 * 4.5, atol=0.05)


def test_a_flat_roof_with_a_chimney_has_two_heights() -> None:
    box = shapely.box(0, 0, 12, 16)
    house = SlopedHouse(box, lambda x, y: np.where((np.abs(x - 6) < 1.5) & (np.abs(y - 9) < 1.5), 12.0, 8.0), 2)
    found = fit(box, scan_roof(house))
    check_cover(found, one(box))
    assert found.method.tolist() == [METHOD["flat"]]
    assert not found.too_few.any()
    height = found.roofs.plane[:, 2]
    np.testing.assert_allclose(sorted(height), [8.0, 12.0], atol=0.03)
    assert (found.roofs.limits == height[:, None]).all()
    chimney = found.parts.polygons[height.argmax()]
    assert chimney.area == pytest.approx(9.0, abs=2.5)
    np.testing.assert_allclose(chimney.centroid.coords[0], (6, 9), atol=0.4)


def test_an_annex_narrower_than_the_room_of_walls_keeps_its_height() -> None:
    """1.4 m deep: its wall is moved to where it has room, 1.5 clearances from the outline."""
    house = SlopedHouse(shapely.box(0, 0, 12, 8), lambda x, y: np.where(x < 1.4, 3.0, 9.0 + 0.5 * y), 2)
    found = fit(house.outline, scan_roof(house))
    check_cover(found, one(house.outline))
    low = found.parts.polygons[found.roofs.plane[:, 2].argmin()]
    np.testing.assert_allclose(low.bounds, (0, 0, 1.7, 8), atol=0.2)
    assert heights_at(found, np.array([[0.7, 4.0]])) == pytest.approx(3.0, abs=0.05)


def test_heights_at_which_many_points_lie_are_planes() -> None:
    """Two rough roofs beside a plane: the one with most points first, and none with too few."""
    rng = np.random.default_rng(1)
    z = np.concatenate([rng.uniform(2.8, 3.2, 30), rng.uniform(5.9, 6.1, 20), np.full(50, 9.0)])
    xyz = np.column_stack([rng.uniform(0, 8, (100, 2)), np.sort(z)])
    planes = np.zeros((3, 3))
    planes[0, 2] = 9.0
    assert search_levels(xyz, 15.0, planes, 1) == 3
    np.testing.assert_allclose(planes, [[0, 0, 9], [0, 0, 3], [0, 0, 6]], atol=0.1)
    assert search_levels(xyz, 25.0, planes, 1) == 2


def test_a_house_around_a_courtyard_keeps_it() -> None:
    house = shapely.Polygon(shapely.box(0, 0, 30, 30).exterior, [shapely.box(10, 10, 20, 20).exterior])
    slopes = SlopedHouse(house, lambda x, y: 5 + 0.5 * np.minimum(np.minimum(x, 30 - x), np.minimum(y, 30 - y)), 4)
    found = fit(house, scan_roof(slopes, density=4))
    check_cover(found, one(house))
    assert not shapely.contains_xy(found.parts.polygons, 15, 15).any()
    assert found.n_planes[0] == 4
    inner = np.array([[5.0, 15], [25, 15], [15, 5], [15, 25]])
    np.testing.assert_allclose(heights_at(found, inner), 7.5, atol=0.1)


def test_a_part_may_lie_around_another_one() -> None:
    """A well in the middle of a flat roof, at a distance from all walls, leaves a part with a hole."""
    box = shapely.box(0, 0, 20, 20)
    well = SlopedHouse(box, lambda x, y: np.where((np.abs(x - 9) < 2) & (np.abs(y - 11) < 2), 2.0, 9.0), 2)
    found = fit(box, scan_roof(well, density=6))
    check_cover(found, one(box))
    assert sorted(shapely.get_num_interior_rings(found.parts.polygons).tolist()) == [0, 1]


def test_the_order_of_points_does_not_matter_and_a_second_division_is_closer() -> None:
    polygons, points = town_of_slopes(8, density=5)
    found, finer = fit_roofs(polygons, points, OPTIONS, (0.2, 1.0))
    rng = np.random.default_rng(3)
    owner = np.repeat(np.arange(8), np.diff(points.start))
    order = np.lexsort((rng.random(len(owner)), owner))
    mixed = make_roof_points(points.start, points.xyz[order])
    again, finer_again = fit_roofs(polygons, mixed, OPTIONS, (0.2, 1.0))
    assert finer is not None
    assert finer_again is not None
    assert_same(again, found)
    assert_same(finer_again, finer)
    assert_same(fit_roofs(polygons, points, OPTIONS)[0], found)
    for one in (found, finer):
        check_cover(one, polygons)
    worst = [
        np.nanpercentile(np.abs(heights_at(one, points.xyz[:, :2]) - points.xyz[:, 2]), 99)
        for one in (found, finer)
    ]
    assert worst[1] < worst[0]


def assert_same(one: HouseRoofs, other: HouseRoofs) -> None:
    assert shapely.to_wkb(one.parts.polygons).tolist() == shapely.to_wkb(other.parts.polygons).tolist()
    for name in ("plane", "origin", "limits"):
        np.testing.assert_array_equal(getattr(one.roofs, name), getattr(other.roofs, name))
    for name in ("method", "n_planes", "too_few"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


def test_a_house_is_roofed_alike_whatever_houses_are_with_it() -> None:
    polygons, points = town_of_slopes(8, density=5)
    found, _ = fit_roofs(polygons, points, OPTIONS)
    for k in (2, 6):
        first, last = points.start[k], points.start[k + 1]
        alone = fit(polygons[k], points.xyz[first:last])
        mine = found.parts.house == k
        assert shapely.to_wkb(alone.parts.polygons).tolist() == shapely.to_wkb(found.parts.polygons[mine]).tolist()
        np.testing.assert_array_equal(alone.roofs.plane, found.roofs.plane[mine])


def test_a_house_moved_by_whole_metres_has_the_same_roof() -> None:
    house = SHAPES["L"]
    xyz = np.round(scan_roof(house, density=5) * 1024) / 1024  # so that nothing is rounded by the move
    found, by = fit(house.outline, xyz), np.array([4096.0, -512.0])
    moved = fit(shapely.transform(house.outline, lambda xy: xy + by), xyz + np.append(by, 0))
    np.testing.assert_array_equal(moved.roofs.plane, found.roofs.plane)
    np.testing.assert_array_equal(moved.roofs.limits, found.roofs.limits)
    np.testing.assert_array_equal(moved.roofs.origin, found.roofs.origin + by)
    assert (found.roofs.origin == np.floor(found.roofs.origin)).all()
    back = shapely.transform(moved.parts.polygons, lambda xy: xy - by)
    assert shapely.equals_exact(back, found.parts.polygons, 1e-9).all()


def test_few_points_make_one_flat_roof_and_are_told() -> None:
    house, xyz = SHAPES["gable"], scan_roof(SHAPES["gable"])
    sparse = xyz[:: int(len(xyz) / (0.4 * house.outline.area))]
    assert len(sparse) > OPTIONS.min_points
    for some in (xyz[:7], sparse):
        found = fit(house.outline, some)
        assert (found.method.tolist(), found.too_few.tolist()) == ([METHOD["flat"]], [True])
        assert found.parts.polygons[0] is house.outline
        height = float(np.median(some[:, 2]))
        assert found.roofs.plane.tolist() == [[0.0, 0.0, height]]
        assert found.roofs.limits.tolist() == [[height, height]]
    assert not fit(house.outline, xyz).too_few.any()


def test_no_points_and_no_houses() -> None:
    polygons = np.array([shapely.box(0, 0, 10, 10), shapely.box(20, 0, 30, 10)], object)
    found, _ = fit_roofs(polygons, no_roof_points(2), OPTIONS)
    assert found.too_few.all()
    assert found.parts.polygons.tolist() == polygons.tolist()
    assert np.isnan(found.roofs.plane[:, 2]).all()
    nothing, _ = fit_roofs(polygons[:0], no_roof_points(0), OPTIONS)
    assert len(nothing.parts.polygons) == len(nothing.roofs) == len(nothing.method) == 0


def test_outliers_and_points_at_one_place_do_no_harm() -> None:
    house = SHAPES["gable"]
    xyz = scan_roof(house, density=6)
    rng = np.random.default_rng(5)
    xyz[rng.random(len(xyz)) < 0.05, 2] += rng.uniform(-8, 20)
    xyz = np.concatenate((xyz, xyz[:50], np.repeat(xyz[:1], 40, axis=0)))
    found = fit(house.outline, xyz)
    check_cover(found, one(house.outline))
    places = np.array([[2.0, 7], [7, 7]])
    np.testing.assert_allclose(heights_at(found, places), house.roof(*places.T), atol=0.1)
    fit(house.outline, np.repeat(xyz[:1], 200, axis=0))
    line = np.column_stack((np.full(200, 4.0), np.linspace(1, 13, 200), np.full(200, 9.0)))
    assert fit(house.outline, line).roofs.plane[0].tolist() == [0.0, 0.0, 9.0]


def test_random_points_leave_parts_that_cover_the_house() -> None:
    rng = np.random.default_rng(7)
    for seed in range(6):
        angles = np.sort(rng.uniform(0, 2 * np.pi, 9))
        star = shapely.Polygon(np.column_stack((np.cos(angles), np.sin(angles))) * rng.uniform(6, 20, (9, 1)))
        assert star.is_valid
        n = 400
        xyz = np.column_stack((rng.uniform(-20, 20, (n, 2)), rng.choice([3.0, 6.0, 9.0, 15.0], n)))
        xyz = xyz[shapely.contains_xy(star, xyz[:, 0], xyz[:, 1])]
        xyz[:, 2] += rng.normal(0, 0.1, len(xyz)) + 0.5 * xyz[:, 0] * (seed % 2)
        check_cover(fit(star, xyz, replace(OPTIONS, cut_price=0.3)), one(star))


@pytest.mark.parametrize(
    "change", [{"clearance": 0.0}, {"min_area": -1.0}, {"min_points": 0}, {"cut_price": 0.0}, {"max_depth": -1}]
)
def test_options_out_of_range_and_other_points_are_refused(change: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="options of roofs"):
        fit_roofs(one(shapely.box(0, 0, 1, 1)), no_roof_points(1), replace(OPTIONS, **change))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="do not match"):
        fit_roofs(one(shapely.box(0, 0, 1, 1)), no_roof_points(2), OPTIONS)
