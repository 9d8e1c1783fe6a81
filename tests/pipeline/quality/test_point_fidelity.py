"""Distance of points to the model: residuals worked out by hand, coverage, and the real city."""

import functools
from pathlib import Path

import numpy as np
import pyogrio
import pytest
import shapely
from numpy.typing import NDArray

from pipeline.city_model.building_points import extract_building_points
from pipeline.city_model.footprints import clean_footprints
from pipeline.data.citymodel import Footprints
from pipeline.data.classes import BUILDING, GROUND, HIGH_VEGETATION, UNCLASSIFIED, WATER
from pipeline.data.pointcloud import PointCloud
from pipeline.data.roofs import flat_roofs
from pipeline.geometry.group_order import percentile_by_group
from pipeline.geometry.inside import find_inside
from pipeline.quality.point_fidelity import Residuals, measure_fidelity, measure_houses, summarise
from pipeline.roofs.house_levels import LevelOptions, split_levels
from pipeline.roofs.roof_points import locate_roof_points, make_roof_points
from tests.helpers.cities import tilted_dtm
from tests.helpers.whole_clouds import read_points
from tiler.pointclouds.clouds import find_clouds

HOUSE = shapely.box(10, 10, 20, 20)
DTM = tilted_dtm((0.0, 0.0, 40.0, 40.0), height=1.0)


def polygons(*shapes: shapely.Polygon) -> NDArray[np.object_]:
    array = np.empty(len(shapes), object)
    array[:] = shapes
    return array


def cloud_of(*points: tuple[float, float, float, int]) -> PointCloud:
    rows = np.array(points, dtype=np.float64).reshape(-1, 4)
    return PointCloud(rows[:, :3], rows[:, 3].astype(np.uint8))


# The model's building is narrower than the footprint on the right and wider on the left.
MODEL = shapely.box(8, 10, 18, 20)
CLOUD = cloud_of(
    (11, 15, 9.0, BUILDING),  # in both: 10 - 9 = 1
    (12, 15, 13.0, BUILDING),  # in both: -3
    (19, 15, 9.0, BUILDING),  # footprint only: 1 - 9 = -8
    (9, 15, 9.0, BUILDING),  # model only: 1
    (30, 15, 9.0, BUILDING),  # in neither: not counted
    (30, 30, 0.5, GROUND),  # open: 1 - 0.5 = 0.5
    (35, 30, 1.5, WATER),  # open: -0.5
    (19, 18, 1.5, GROUND),  # footprint only, so outside the model: -0.5
    (9, 18, 2.0, GROUND),  # swallowed: 10 - 2 = 8
    (12, 18, 3.0, GROUND),  # in both: not counted
    (12, 12, 30.0, HIGH_VEGETATION),
)


def test_residuals_by_hand() -> None:
    found = measure_fidelity(
        CLOUD, DTM, polygons(MODEL), flat_roofs(np.array([10.0])), footprints=polygons(HOUSE), building_class=True
    )
    assert found.roof == summarise(np.array([1.0, -3.0, 1.0]))
    assert found.roof.rmse == pytest.approx(np.sqrt(11 / 3))
    assert found.roof.bias == pytest.approx(-1 / 3)
    assert found.missed == Residuals(1, 8.0, 8.0, 8.0, -8.0)
    assert found.ground == summarise(np.array([0.5, -0.5, -0.5]))
    assert found.swallowed == Residuals(1, 8.0, 8.0, 8.0, 8.0)


def test_a_building_without_roof_is_none_of_the_model() -> None:
    found = measure_fidelity(
        CLOUD,
        DTM,
        polygons(MODEL),
        flat_roofs(np.array([np.nan])),
        footprints=polygons(HOUSE),
        building_class=True,
    )
    assert (found.roof.n, found.missed.n, found.ground.n, found.swallowed.n) == (0, 3, 5, 0)
    assert np.isnan(found.roof.rmse)


def test_without_building_class_unclassified_points_are_roofs() -> None:
    cloud = cloud_of((11, 15, 9.0, UNCLASSIFIED), (11, 16, 9.0, GROUND))
    found = measure_fidelity(
        cloud, DTM, polygons(HOUSE), flat_roofs(np.array([10.0])), footprints=polygons(HOUSE), building_class=False
    )
    assert found.roof == Residuals(1, 1.0, 1.0, 1.0, 1.0)


def test_the_order_of_the_points_does_not_matter() -> None:
    rng = np.random.default_rng(6)
    xyz = rng.uniform(0, 40, (5000, 3))
    classes = rng.choice([BUILDING, GROUND], 5000).astype(np.uint8)
    order = rng.permutation(5000)
    measure = functools.partial(
        measure_fidelity,
        dtm=tilted_dtm((0.0, 0.0, 40.0, 40.0), slope_x=0.1),
        polygons=polygons(MODEL),
        roofs=flat_roofs(np.array([10.0])),
        footprints=polygons(HOUSE),
        building_class=True,
    )
    assert measure(PointCloud(xyz, classes)) == measure(PointCloud(xyz[order], classes[order]))


def test_nothing_to_measure_is_nan() -> None:
    empty = PointCloud(np.empty((0, 3)), np.empty(0, np.uint8))
    found = measure_fidelity(
        empty, DTM, polygons(), flat_roofs(np.empty(0)), footprints=polygons(), building_class=True
    )
    assert found.ground.n == 0
    assert np.isnan(found.ground.p95)


def test_points_in_two_polygons_are_located_in_each() -> None:
    xy = np.array([[15.0, 15], [19, 15], [9, 15], [10, 15]])
    polygon, point = find_inside(xy, polygons(HOUSE, MODEL))
    assert sorted(zip(polygon.tolist(), point.tolist(), strict=True)) == [(0, 0), (0, 1), (1, 0), (1, 2), (1, 3)]


def measure_one(house: shapely.Polygon, *points: tuple[float, float, float]) -> tuple[int, float, float, float]:
    xyz = np.array(points).reshape(-1, 3)
    found = measure_houses(
        make_roof_points(np.array([0, len(xyz)]), xyz), polygons(house), flat_roofs(np.array([10.0]))
    )
    return int(found.n_points[0]), float(found.rmse[0]), float(found.bias[0]), float(found.coverage[0])


def test_a_house_by_hand() -> None:
    # Two of four cells have a point, one of them two.
    n, rmse, bias, coverage = measure_one(
        shapely.box(10, 10, 12, 12), (10.5, 10.5, 9), (10.6, 10.6, 13), (11.5, 11.5, 9)
    )
    assert (n, coverage) == (3, 0.5)
    assert rmse == pytest.approx(np.sqrt(11 / 3))
    assert bias == pytest.approx(-1 / 3)


def test_cells_on_the_rim_count_where_they_have_a_point() -> None:
    house = shapely.box(10, 10, 12.4, 11)  # the third cell has its centre at 12.5, outside
    assert measure_one(house, (10.5, 10.5, 9))[3] == 0.5
    assert measure_one(house, (10.5, 10.5, 9), (12.2, 10.5, 9))[3] == pytest.approx(2 / 3)
    assert measure_one(shapely.box(10, 10, 10.3, 10.3), (10.2, 10.2, 9))[3] == 1.0


def test_a_cell_whose_centre_is_on_the_outline_is_none_of_the_house() -> None:
    assert measure_one(shapely.box(10, 10, 12.5, 11), (10.5, 10.5, 9))[3] == 0.5
    assert measure_one(shapely.Polygon([(10, 10), (13, 10), (10, 13)]), (10.5, 10.5, 9))[3] == 1 / 3


def test_the_order_of_the_points_of_a_house_does_not_matter() -> None:
    rng = np.random.default_rng(8)
    xyz = rng.uniform(10, 20, (500, 3))
    assert measure_one(HOUSE, *xyz) == measure_one(HOUSE, *rng.permutation(xyz))


def test_a_courtyard_is_no_cell_of_the_house() -> None:
    ring = shapely.Polygon(shapely.box(0, 0, 3, 3).exterior, [shapely.box(1, 1, 2, 2).exterior])
    assert measure_one(ring, (0.5, 0.5, 9))[3] == 1 / 8


def test_a_house_without_points_is_told() -> None:
    n, rmse, bias, coverage = measure_one(HOUSE)
    assert (n, coverage) == (0, 0.0)
    assert np.isnan([rmse, bias]).all()
    found = measure_houses(make_roof_points(np.array([0]), np.empty((0, 3))), polygons(), flat_roofs(np.empty(0)))
    assert len(found.rmse) == len(found.coverage) == 0


def test_houses_do_not_mix() -> None:
    rng = np.random.default_rng(2)
    houses = polygons(HOUSE, shapely.box(20, 10, 30, 20), shapely.box(50, 50, 60, 60))
    xyz = rng.uniform(5, 35, (3000, 3))
    points = locate_roof_points(PointCloud(xyz, np.full(3000, BUILDING, np.uint8)), houses, building_class=True)
    all_at_once = measure_houses(points, houses, flat_roofs(np.array([10.0, 20.0, 30.0])))
    for k, (house, roof) in enumerate(zip(houses, (10.0, 20.0, 30.0), strict=True)):
        inside = xyz[shapely.contains_xy(house, xyz[:, 0], xyz[:, 1])]
        assert all_at_once.n_points[k] == len(inside)
        if len(inside):
            assert all_at_once.rmse[k] == pytest.approx(np.sqrt(np.mean((roof - inside[:, 2]) ** 2)))
            assert all_at_once.coverage[k] == len({tuple(cell) for cell in np.floor(inside[:, :2]).tolist()}) / 100


@functools.cache
def read_city(folder: Path, footprints: Path) -> tuple[PointCloud, NDArray[np.object_]]:
    """Cloud and clean footprints that its box touches."""
    everywhere = (-1e9, -1e9, 1e9, 1e9)
    clouds = [read_points(path, everywhere)[0] for path in find_clouds([folder / "tiles"])]
    cloud = PointCloud(
        np.concatenate([part.xyz for part in clouds]), np.concatenate([part.classification for part in clouds])
    )
    _, _, blobs, _ = pyogrio.raw.read(footprints, columns=[])
    raw = shapely.from_wkb(blobs)
    ids = np.array([f"{i:04d}" for i in range(len(raw))])
    clean, _ = clean_footprints(Footprints(raw, ids, np.full(len(raw), np.nan)), min_area=15.0, tolerance=0.01)
    low, high = cloud.xyz.min(axis=0), cloud.xyz.max(axis=0)
    return cloud, clean.polygons[shapely.intersects(clean.polygons, shapely.box(low[0], low[1], high[0], high[1]))]


def roof_error(
    cloud: PointCloud, houses: NDArray[np.object_], percentile: float, *, building_class: bool
) -> Residuals:
    points = extract_building_points(cloud, houses, margin=1.0, building_class=building_class)
    roof = percentile_by_group(points.roof_start, points.roof_z, percentile)
    dtm = tilted_dtm((120000.0, 485900.0, 120001.0, 485901.0))
    found = measure_fidelity(
        cloud, dtm, houses, flat_roofs(roof), footprints=houses, building_class=building_class
    )
    return found.roof


@pytest.mark.long
@pytest.mark.shared
@pytest.mark.parametrize(
    ("folder", "most"),
    [
        # Most RMSE of one height a house, then of one cut, then of eight; percentile 50, then 90.
        ("amsterdam", {(0, 50): 4.6, (0, 90): 6.1, (1, 50): 4.05, (8, 50): 3.05, (8, 90): 4.0}),
        ("amsterdam_no_building_class", {(8, 50): 3.05, (8, 90): 4.05}),
    ],
)
def test_split_houses_come_closer_to_the_points(
    shared_data: Path, folder: str, most: dict[tuple[int, int], float]
) -> None:
    cloud, houses = read_city(shared_data / folder, shared_data / "amsterdam" / "footprints.gpkg")
    building_class = folder == "amsterdam"
    points = locate_roof_points(cloud, houses, building_class=building_class)
    found = {}
    for depth in sorted({depth for depth, _ in most}):
        parts = split_levels(houses, points, LevelOptions(clearance=0.5, max_depth=depth)).polygons
        assert shapely.area(parts).sum() == pytest.approx(shapely.area(houses).sum(), rel=1e-9)
        assert shapely.is_valid(parts).all()
        for percentile in [percentile for known, percentile in most if known == depth]:
            found[depth, percentile] = roof_error(cloud, parts, percentile, building_class=building_class).rmse
    assert all(found[case] <= bound for case, bound in most.items()), found
