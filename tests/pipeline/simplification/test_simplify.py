"""Step 2 composed as a planar city model: houses keep walls, parts, points and heights; roofs settle."""

import dataclasses

import numpy as np
import pytest
import shapely

from pipeline.city_model.building_points import BuildingPoints, take_building_points
from pipeline.city_model.city import City
from pipeline.city_model.city_steps import build_city
from pipeline.city_model.heights import Heights
from pipeline.columns.adaptive import AdaptiveOptions
from pipeline.columns.columns import expand_cells
from pipeline.columns.layered import LayeredOptions
from pipeline.columns.spacing import SpacingLimits
from pipeline.data.citymodel import Footprints
from pipeline.data.classes import BUILDING
from pipeline.data.mesh import Marker
from pipeline.data.notes import count_notes
from pipeline.data.pointcloud import PointCloud
from pipeline.data.roof_forms import HEIGHT, POINTS_TELL, ROOF_SHAPES, SHAPE, no_forms
from pipeline.data.roofs import ROOF_FALLBACKS, ROOF_METHODS
from pipeline.quality.building_facts import describe_buildings, measure_model
from pipeline.simplification.house_clusters import Shapes
from pipeline.simplification.simplify import _settle_clusters, settle_roofs
from tests.helpers.cities import CITY_OPTIONS as OPTIONS
from tests.helpers.cities import cloud_over, tilted_dtm
from tests.helpers.whole_city import extract_boundary, mesh_city, simplify_city
from tests.pipeline.columns.test_tile import BOUNDS, LAYERS, footprints_of

PLANAR = dataclasses.replace(OPTIONS, simplify="clearance", roof_percentile=50.0, min_courtyard_area=5.0)
SPLIT = dataclasses.replace(PLANAR, split_levels=True)
ADAPTIVE = AdaptiveOptions(10.0, 100.0, SpacingLimits(0.1, 0.8), 0.8, 1)
FRONT, BACK = shapely.box(1020, 2020, 1032, 2040), shapely.box(1032.3, 2020.2, 1045, 2040)


def planar_city(footprints: Footprints, cloud: PointCloud, slope: float = 0.0, options: object = PLANAR) -> City:
    assert isinstance(options, type(PLANAR))
    dtm = tilted_dtm(BOUNDS, slope_x=slope, height=-1000 * slope)
    return simplify_city(build_city(cloud, footprints, dtm, BOUNDS, options), cloud, dtm, options)


def test_terraced_houses_keep_a_wall_their_ids_and_heights() -> None:
    cloud = cloud_over(BOUNDS, [(FRONT, 12.0), (BACK, 6.0)])
    city = planar_city(footprints_of(FRONT, BACK), cloud)
    model = city.model
    assert sorted(zip(model.ids.tolist(), model.roof.tolist(), strict=True)) == [
        ("house-0", 12.0),
        ("house-1", 6.0),
    ]
    assert model.house.tolist() == model.ids.tolist()
    assert len(set(city.group.tolist())) == 2
    shared = shapely.intersection(model.polygons[0], model.polygons[1])
    assert shared.length == pytest.approx(20, abs=0.5)
    assert city.outline["min_clearance"] >= 1.0
    assert 0 < city.outline["area_error"] < 0.05


def test_houses_of_nearly_equal_height_get_one_roof() -> None:
    cloud = cloud_over(BOUNDS, [(FRONT, 10.0), (BACK, 11.0)])
    city = planar_city(footprints_of(FRONT, BACK), cloud)
    assert len(set(city.model.roof.tolist())) == 1
    assert 10.0 < city.model.roof[0] < 11.0
    assert len(set(city.group.tolist())) == 1
    facts = describe_buildings(cloud, city)
    assert all("moved" in words for words in facts["changes"])  # type: ignore[operator]
    mesh = mesh_city(city, tilted_dtm(BOUNDS), BOUNDS, ADAPTIVE)
    boundary = extract_boundary(mesh, city.model.numbers)
    walls = expand_cells(mesh).points[boundary.facets[boundary.marker == Marker.WALL]]
    # No wall inside: the party wall at x = 1032 has none of its own.
    inside = (walls[:, :, 1].min(axis=1) > 2021) & (walls[:, :, 1].max(axis=1) < 2039)
    assert not (inside & (abs(walls[:, :, 0] - 1032).max(axis=1) < 1)).any()


def test_a_house_of_two_levels_becomes_two_parts() -> None:
    house = shapely.box(1020, 2020, 1050, 2040)
    tall, low = shapely.box(1020, 2020, 1038, 2040), shapely.box(1038, 2020, 1050, 2040)
    cloud = cloud_over(BOUNDS, [(tall, 20.0), (low, 8.0)])
    city = planar_city(footprints_of(house), cloud, options=SPLIT)
    assert sorted(city.model.ids.tolist()) == ["house-0-part1", "house-0-part2"]
    assert set(city.model.house.tolist()) == {"house-0"}
    assert sorted(city.model.roof.tolist()) == [8.0, 20.0]
    assert city.counts["houses split"] == 1
    found = measure_model(cloud, tilted_dtm(BOUNDS), city, np.array([house], dtype=object))
    whole = planar_city(footprints_of(house), cloud)
    flat = measure_model(cloud, tilted_dtm(BOUNDS), whole, np.array([house], dtype=object))
    assert found["roof"]["rmse"] < 2.0
    assert flat["roof"]["rmse"] > 5.0
    assert all("split" in words for words in describe_buildings(cloud, city)["changes"])  # type: ignore[operator]


def test_a_house_of_one_height_tells_why() -> None:
    """Houses of 16 m²: 12 points are enough to find it flat, 5 are too few, and a hipped roof has no room."""
    houses = [shapely.box(x, 2020, x + 4, 2024) for x in (1020, 1040, 1060)]
    cloud = cloud_over(BOUNDS, [(house, 2.2) for house in houses], spacing=1.0)
    on_roof = np.flatnonzero(cloud.classification == BUILDING)
    first = cloud.xyz[on_roof, 0] < 1030
    second = (cloud.xyz[on_roof, 0] > 1030) & (cloud.xyz[on_roof, 0] < 1050)
    dropped = [*on_roof[first][12:], *on_roof[second][5:], *on_roof[~first & ~second]]
    kept = np.delete(np.arange(len(cloud.xyz)), dropped)
    cloud = PointCloud(cloud.xyz[kept], cloud.classification[kept])
    city = planar_city(footprints_of(*houses), cloud, options=dataclasses.replace(PLANAR, roofs="planes"))
    told = dict(zip(city.model.ids.tolist(), (ROOF_FALLBACKS[k] for k in city.roof_fallback), strict=True))
    assert told == {"house-0": "", "house-1": "few roof points", "house-2": "no roof points"}
    assert {ROOF_METHODS[k] for k in city.roof_method.tolist()} == {"flat"}


def formed(shape: str, height: float) -> Footprints:
    """The front house with the form of a roof by its attributes."""
    forms = no_forms(1)
    forms[0, [SHAPE, HEIGHT]] = ROOF_SHAPES.index(shape), height
    return dataclasses.replace(footprints_of(FRONT), forms=forms)


def test_with_skeletons_a_given_form_stays_whole_whatever_points_say() -> None:
    cloud = cloud_over(BOUNDS, [(FRONT, 12.0)], spacing=1.0)
    city = planar_city(formed("gabled", 4.0), cloud, options=dataclasses.replace(PLANAR, roofs="skeleton"))
    assert [ROOF_SHAPES[form] for form in city.roof_form.tolist()] == ["gabled", "gabled"]
    assert {ROOF_METHODS[k] for k in city.roof_method.tolist()} == {"skeleton"}
    low, high = city.model.roofs.limits.T
    assert low.tolist() == pytest.approx([low[0]] * 2)
    assert (high - low).tolist() == pytest.approx([4.0, 4.0])
    assert low[0] < 12.0 < high[0]
    assert {note.kind for note in city.notes} & {"footprint-roof-form-off"} == set()  # 1 m in the median, no more


def test_with_planes_points_tell_the_roof_where_they_are_enough() -> None:
    options = dataclasses.replace(PLANAR, roofs="planes")
    enough = planar_city(formed("gabled", 4.0), cloud_over(BOUNDS, [(FRONT, 12.0)], spacing=1.0), options=options)
    assert enough.roof_form.tolist() == [POINTS_TELL]
    assert enough.model.roof.tolist() == pytest.approx([12.0])
    few = planar_city(formed("gabled", 4.0), cloud_over(BOUNDS, [(FRONT, 12.0)], spacing=5.0), options=options)
    assert [ROOF_SHAPES[form] for form in few.roof_form.tolist()] == ["gabled", "gabled"]
    flat = planar_city(formed("flat", 4.0), cloud_over(BOUNDS, [(FRONT, 12.0)], spacing=5.0), options=options)
    assert [ROOF_FALLBACKS[k] for k in flat.roof_fallback.tolist()] == [""]
    assert [ROOF_SHAPES[form] for form in flat.roof_form.tolist()] == ["flat"]


def test_a_wall_between_planes_must_save_its_price() -> None:
    """A strip of 4 m, 0.4 m higher, of a house of 12 by 20 m: 31 m² of roof half a metre off."""
    low, high = shapely.box(1020, 2020, 1032, 2036), shapely.box(1020, 2036, 1032, 2040)
    cloud = cloud_over(BOUNDS, [(low, 12.0), (high, 12.4)], spacing=0.5)
    parts = {}
    for price in (4.0, 40.0):
        options = dataclasses.replace(PLANAR, roofs="planes", roof_price=price)
        parts[price] = len(planar_city(footprints_of(FRONT), cloud, options=options).model)
    assert parts == {4.0: 2, 40.0: 1}


def test_a_house_without_room_is_lost_and_told() -> None:
    sliver = shapely.box(1060, 2020, 1060.6, 2040)
    cloud = cloud_over(BOUNDS, [(FRONT, 12.0), (sliver, 9.0)])
    city = planar_city(footprints_of(FRONT, sliver), cloud)
    assert city.model.ids.tolist() == ["house-0"]
    (note,) = [note for note in city.notes if note.kind == "building-lost"]
    assert (note.subject, note.detail.split(",")[0]) == ("house-1", "12.0 m²")


def test_a_house_within_another_is_covered_not_lost() -> None:
    inner = shapely.box(1020.02, 2020.02, 1031.98, 2039.98)
    cloud = cloud_over(BOUNDS, [(FRONT, 12.0)])
    city = planar_city(footprints_of(FRONT, inner), cloud)
    assert len(city.model) == 1
    assert count_notes(city.notes)["building-covered-by-others"] == 1
    assert "building-lost" not in count_notes(city.notes)


def test_a_comb_of_thin_walls_keeps_its_outline() -> None:
    back = shapely.box(1020, 2020, 1060, 2021)
    teeth = [shapely.box(1020 + 1.6 * k, 2020, 1020.8 + 1.6 * k, 2050) for k in range(25)]
    comb = shapely.union_all([back, *teeth])
    cloud = cloud_over(BOUNDS, [(comb, 12.0)])
    city = planar_city(footprints_of(comb), cloud)
    hull = comb.convex_hull
    assert shapely.area(city.model.polygons).sum() == pytest.approx(hull.area, rel=0.1)
    assert count_notes(city.notes)["building-outline-closed"] == 1
    assert city.outline["min_clearance"] >= 1.0


def test_names_of_parts_are_free_names() -> None:
    house, other = shapely.box(1020, 2020, 1050, 2040), shapely.box(1060, 2060, 1080, 2080)
    tall, low = shapely.box(1020, 2020, 1038, 2040), shapely.box(1038, 2020, 1050, 2040)
    cloud = cloud_over(BOUNDS, [(tall, 20.0), (low, 8.0), (other, 9.0)])
    footprints = footprints_of(house, other)
    renamed = dataclasses.replace(footprints, ids=np.array(["7", "7-part1"]))
    city = planar_city(renamed, cloud, options=SPLIT)
    assert sorted(city.model.ids.tolist()) == ["7-part1", "7-part1-", "7-part2"]


def test_roofs_clear_the_terrain_of_their_whole_group() -> None:
    cloud = cloud_over(BOUNDS, [(FRONT, 6.0), (BACK, 6.5)])
    city = planar_city(footprints_of(FRONT, BACK), cloud, slope=0.12)
    # Both are one group, and the terrain reaches 5.4 m at the uphill wall (x = 1045): the group's mean is too low.
    assert city.model.roof.tolist() == pytest.approx([7.4, 7.4], abs=1e-9)
    assert len(set(city.model.roof.tolist())) == 1
    assert count_notes(city.notes)["building-roof-raised"] == 1


def test_a_roof_is_raised_before_it_is_compared_with_its_neighbours() -> None:
    cloud = cloud_over(BOUNDS, [(FRONT, 6.0), (BACK, 6.5)])
    city = planar_city(footprints_of(FRONT, BACK), cloud, slope=0.5)
    # The terrain reaches 16 m at the front house's walls (x = 1032) and 22.5 m at the other's (x = 1045).
    assert sorted(city.model.roof.tolist()) == pytest.approx([18.0, 24.5])


def test_roofs_are_settled_cluster_by_cluster() -> None:
    """One alone and too low, a pair that is grouped, one alone and high, and a pair that is not."""
    x = np.array([0.0, 40.0, 50.0, 20.0, 70.0, 80.0])
    polygons = shapely.box(x, 0, x + 10, 10)
    nothing = np.empty((0, 2), np.int64)
    shapes = Shapes(polygons, np.arange(7), np.arange(6), np.array([3, 5, 5, 0, 9, 9]), nothing, np.ones(6), {})
    heights = Heights(np.zeros(6), np.array([1.0, 9, 10, 30, 8, 20]), np.zeros(6, np.int8), np.zeros(6, np.bool_))
    roof, group = _settle_clusters(shapes, heights, np.ones(6), np.array(list("fedcba")), OPTIONS)
    assert roof.tolist() == [3.0, 9.5, 9.5, 30.0, 8.0, 20.0]
    assert group.tolist() == [1, 2, 2, 0, 4, 3]
    assert group.dtype == np.int32


def test_settled_roofs_meet_both_rules() -> None:
    rng = np.random.default_rng(0)
    n = 60
    pairs = np.column_stack((np.arange(n - 1), np.arange(1, n)))
    roof, ground = rng.uniform(3, 30, n), rng.uniform(0, 12, n)
    key = np.array([f"{k:03d}" for k in range(n)])
    settled, group = settle_roofs(
        roof, rng.uniform(20, 200, n), ground, pairs, key=key, threshold=2.0, clearance=2.0
    )
    assert (settled >= ground + 2.0).all()
    for one, two in pairs:
        if group[one] == group[two]:
            assert settled[one] == settled[two]
        else:
            assert abs(settled[one] - settled[two]) >= 2.0


def test_taken_points_may_repeat() -> None:
    points = BuildingPoints(np.array([0, 2, 3]), np.array([1.0, 2, 3]), np.array([0, 0, 1]), np.array([9.0]))
    taken = take_building_points(points, np.array([1, 0, 1]))
    assert taken.roof_start.tolist() == [0, 1, 3, 4]
    assert taken.roof_z.tolist() == [3.0, 1.0, 2.0, 3.0]
    assert taken.ground_z.tolist() == [9.0, 9.0]


def test_no_houses_are_no_harm() -> None:
    city = planar_city(footprints_of(), cloud_over(BOUNDS, []), options=SPLIT)
    assert len(city.model) == 0
    mesh_city(city, tilted_dtm(BOUNDS), BOUNDS, ADAPTIVE)


@pytest.mark.parametrize("options", [ADAPTIVE, LAYERS, dataclasses.replace(LAYERS, smoother="fem")])
def test_every_mesher_takes_houses_with_party_walls(options: AdaptiveOptions | LayeredOptions) -> None:
    houses = [shapely.box(1010 + 9 * k, 2030, 1019 + 9 * k, 2045) for k in range(8)]
    heights = [9.0, 12.5, 12.9, 20.0, 5.0, 9.0, 14.0, 30.0]
    cloud = cloud_over(BOUNDS, list(zip(houses, heights, strict=True)))
    city = planar_city(footprints_of(*houses), cloud)
    mesh = mesh_city(city, tilted_dtm(BOUNDS), BOUNDS, options)
    cells = expand_cells(mesh)
    corners = cells.points[cells.cells]
    assert np.linalg.det(corners[:, 1:] - corners[:, :1]).min() > 0
    boundary = extract_boundary(mesh, city.model.numbers)
    for number, roof in zip(city.model.numbers, city.model.roof, strict=True):
        facets = boundary.facets[(boundary.marker == Marker.ROOF) & (boundary.building == number)]
        assert (cells.points[facets, 2] == roof).all()
        assert len(facets)
