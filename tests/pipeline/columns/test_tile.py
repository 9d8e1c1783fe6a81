"""The steps composed: city model, its simplification, the tile's mesh; the rules for odd buildings."""

import dataclasses
from typing import Literal

import numpy as np
import pytest
import shapely

from pipeline.city_model.city import City, CityOptions
from pipeline.city_model.city_steps import build_city
from pipeline.columns.columns import lowest_gap
from pipeline.columns.layered import LayeredOptions
from pipeline.data.citymodel import Footprints, make_ids, number_ids
from pipeline.data.errors import InputError
from pipeline.data.notes import count_notes
from tests.helpers.cities import CITY_OPTIONS as OPTIONS
from tests.helpers.cities import Bounds, cloud_over, tilted_dtm
from tests.helpers.whole_city import mesh_city, simplify_city

BOUNDS: Bounds = (1000.0, 2000.0, 1100.0, 2100.0)
LAYERS = LayeredOptions(
    mesh_size=10.0, layer_height=10.0, domain_height=100.0, smoother="columns", tolerance=0.003, fem_tolerance=1e-8
)


def footprints_of(*polygons: shapely.Geometry, heights: tuple[float, ...] = ()) -> Footprints:
    shapes = np.empty(len(polygons), object)
    shapes[:] = polygons
    ids = np.array([f"house-{k}" for k in range(len(polygons))], np.str_)
    given = np.array(heights or [np.nan] * len(polygons))
    return Footprints(shapes, ids, given)


def city_over(
    footprints: Footprints,
    roofs: list[tuple[shapely.Polygon, float]],
    options: CityOptions = OPTIONS,
    slope: float = 0.0,
) -> City:
    dtm = tilted_dtm(BOUNDS, slope_x=slope, height=-1000 * slope)
    cloud = cloud_over(BOUNDS, roofs)
    return simplify_city(build_city(cloud, footprints, dtm, BOUNDS, options), cloud, dtm, options)


A, B = shapely.box(1020, 2020, 1035, 2040), shapely.box(1035.5, 2020, 1050, 2040)


def test_close_buildings_become_one_with_pooled_points_and_the_larger_ones_id() -> None:
    city = city_over(footprints_of(A, B), [(A, 10.0), (B, 20.0)])
    assert city.model.ids.tolist() == ["house-0"]
    assert city.model.members == (("house-0", "house-1"),)
    # 1200 points at 10 m and 1140 at 20 m: the 90th percentile is 20 m.
    assert city.model.roof.tolist() == [20.0]
    assert city.model.polygons[0].area == pytest.approx(30 * 20)
    assert city.counts["merge patch"] + city.counts["merge union"] == 1


def test_a_building_without_points_gets_its_attribute_then_the_default_then_goes() -> None:
    houses = [shapely.box(1010 + 20 * k, 2010, 1020 + 20 * k, 2020) for k in range(3)]
    heights = (8.0, np.nan, np.nan)
    seen = [(houses[2], 12.0)]
    city = city_over(footprints_of(*houses, heights=heights), seen)
    assert city.model.roof.tolist() == [8.0, 6.0, 12.0]
    assert count_notes(city.notes)["building-roof-from-attribute"] == 1
    assert count_notes(city.notes)["footprint-roof-from-default"] == 1
    none = city_over(
        footprints_of(*houses, heights=heights), seen, dataclasses.replace(OPTIONS, default_height=0.0)
    )
    assert none.model.ids.tolist() == ["house-0", "house-2"]
    (note,) = [note for note in none.notes if note.kind == "footprint-without-height-dropped"]
    assert (note.subject, note.x, note.y) == ("house-1", 1035.0, 2015.0)


@pytest.mark.parametrize(("border", "area"), [("drop", None), ("clip", 9 * 10)])
def test_a_building_on_the_border_follows_the_stated_rule(
    border: Literal["drop", "clip"], area: float | None
) -> None:
    on_border = shapely.box(995, 2050, 1010, 2060)
    options = dataclasses.replace(OPTIONS, border=border)
    city = city_over(footprints_of(A, on_border), [(A, 10.0), (on_border, 9.0)], options)
    rule = "dropped" if border == "drop" else "clipped"
    assert count_notes(city.notes)[f"footprint-on-border-{rule}"] == 1
    if area is None:
        assert city.model.ids.tolist() == ["house-0"]
    else:
        clipped = city.model.polygons[city.model.ids.tolist().index("house-1")]
        assert clipped.area == pytest.approx(area)
        assert clipped.bounds[0] == 1001.0


@pytest.mark.parametrize("border", ["drop", "clip"])
def test_a_footprint_as_large_as_the_region_is_no_harm(border: Literal["drop", "clip"]) -> None:
    whole = shapely.box(*BOUNDS)
    city = city_over(footprints_of(whole), [(whole, 15.0)], dataclasses.replace(OPTIONS, border=border))
    assert len(city.model) == (0 if border == "drop" else 1)
    mesh = mesh_city(city, tilted_dtm(BOUNDS), BOUNDS, LAYERS, min_angle=25.0)
    assert lowest_gap(mesh)[1] == 0


def test_a_roof_below_the_terrain_uphill_is_raised_and_told() -> None:
    city = city_over(footprints_of(A), [(A, 6.0)], slope=0.5)
    # The terrain reaches 17.5 m at the uphill wall (x = 1035).
    assert city.model.roof.tolist() == [19.5]
    (note,) = [note for note in city.notes if note.kind == "building-roof-raised"]
    assert "6.00 m raised to 19.50 m" in note.detail


def test_the_city_does_not_depend_on_the_order_of_footprints_and_points() -> None:
    rng = np.random.default_rng(8)
    houses = [
        shapely.box(1005 + 18 * i, 2005 + 18 * j, 1016 + 18 * i, 2017 + 18 * j) for i in range(5) for j in range(5)
    ]
    cloud = cloud_over(BOUNDS, [(house, 5.0 + k) for k, house in enumerate(houses)])
    dtm = tilted_dtm(BOUNDS)
    results = []
    for order, rows in (
        (np.arange(25), np.arange(len(cloud.xyz))),
        (rng.permutation(25), rng.permutation(len(cloud.xyz))),
    ):
        footprints = footprints_of(*houses)
        shuffled = Footprints(footprints.polygons[order], footprints.ids[order], footprints.given_height[order])
        points = dataclasses.replace(cloud, xyz=cloud.xyz[rows], classification=cloud.classification[rows])
        city = simplify_city(build_city(points, shuffled, dtm, BOUNDS, OPTIONS), points, dtm, OPTIONS)
        results.append(
            (city.model.ids.tolist(), city.model.roof.tobytes(), shapely.to_wkb(city.model.polygons).tolist())
        )
    assert results[0] == results[1]


def test_ids_from_geometry_do_not_depend_on_start_or_direction() -> None:
    ring = [(0, 0), (4, 0), (4, 3), (0, 3)]
    variants = [shapely.Polygon(ring), shapely.Polygon(ring[2:] + ring[:2]), shapely.Polygon(ring[::-1])]
    shapes = np.empty(3, object)
    shapes[:] = variants
    assert len(set(make_ids(shapes))) == 1


def test_number_ids_are_stable_and_distinct() -> None:
    numbers = number_ids(np.array(["7", "house-7", "gabc"]))
    assert numbers[0] == 7
    assert len(set(numbers.tolist())) == 3
    assert (numbers < 2**53).all()
    with pytest.raises(InputError, match="'007' and '7' both have the number 7"):
        number_ids(np.array(["7", "007"]))
