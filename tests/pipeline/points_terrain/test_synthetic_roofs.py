"""Roofs of synthetic houses: by hand, by their slopes, and that other houses change nothing."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pyogrio
import pytest
import shapely
from numpy.typing import NDArray
from shapely import affinity

from pipeline.points_terrain.synthetic import ORIGIN, SyntheticCity, city_points, make_city, terrain_height
from pipeline.points_terrain.synthetic_roofs import (
    ROOF_TYPES,
    RoofShapes,
    draw_roofs,
    flat_shapes,
    highest_places,
    shape_heights,
    wing_rings,
)
from tiler.interface.synth import write_city

X, Y = ORIGIN
FLAT, SHED, GABLE, HIP, PYRAMID, MANSARD = range(6)
FLAT_ROOFS = (39.979379754942244, 26.0359416308355, 18.86372619130747)
FLAT_POINTS = (49.97605771198869, 49.83025241922587, 25.224402803139405)
ELL = [(0, 0), (20, 0), (20, 8), (6, 8), (6, 15), (0, 15)]


def city(**changes: Any) -> SyntheticCity:
    given: dict[str, Any] = {
        "size": 400.0,
        "buildings": 200,
        "density": 1.5,
        "relief": 20.0,
        "seed": 1,
        "roofs": "mixed",
    }
    return make_city(**given | changes)


def roofs_of(*polygons: shapely.Polygon, seed: int = 1) -> RoofShapes:
    shapes = np.array(polygons, object)
    return draw_roofs(shapes, np.zeros(len(shapes)), np.full(len(shapes), 9.0), seed=seed)


def first_of(kind: int, polygon: shapely.Polygon, *, across: bool = False) -> RoofShapes:
    """Roofs over an outline of which the first is of some type, its ridge along the outline's long side or not."""
    for seed in range(1000):
        shapes = roofs_of(polygon, seed=seed)
        if shapes.kind[0] == kind and (abs(shapes.axis[0, 1]) > 0.5) == across:
            return shapes
    raise AssertionError("none found")


def height(shapes: RoofShapes, *places: tuple[float, float]) -> NDArray[np.float64]:
    z = shape_heights(shapes, np.zeros(len(places), np.int64), np.array(places))
    above: NDArray[np.float64] = z - shapes.eaves[0]
    return above


def test_roofs_over_a_rectangle() -> None:
    """Heights above the eaves of a house of 12 x 8 m, from its slope."""
    house = shapely.box(-6, -4, 6, 4)
    corner, end, side, off, middle = (6, 4), (6, 0), (0, 4), (3, 2), (0, 0)
    places = (corner, end, side, off, middle)
    assert height(first_of(FLAT, house), *places).tolist() == [0] * 5
    gable = height(first_of(GABLE, house), *places)
    np.testing.assert_allclose(gable, gable[4] * np.array([0, 1, 0, 0.5, 1]), atol=1e-12)
    across = height(first_of(GABLE, house, across=True), *places)
    np.testing.assert_allclose(across, across[4] * np.array([0, 0, 1, 0.5, 1]), atol=1e-12)
    hip = height(first_of(HIP, house), *places)
    np.testing.assert_allclose(hip, hip[4] * np.array([0, 0, 0, 0.5, 1]), atol=1e-12)
    pyramid = height(first_of(PYRAMID, house), *places)
    np.testing.assert_allclose(pyramid, pyramid[4] * np.array([0, 0, 0, 0.5, 1]), atol=1e-12)
    assert height(first_of(PYRAMID, house), (3, 0))[0] == pytest.approx(pyramid[4] / 2)
    assert height(first_of(HIP, house), (2, 0))[0] == pytest.approx(hip[4])  # the ridge ends there
    shed = height(first_of(SHED, house), (5, -4), (5, 4), (0, 0), (-5, 4))
    assert sorted(shed[:2] / shed[:2].max()) == [0, 1]
    assert shed[2] == pytest.approx(shed[:2].max() / 2)
    assert shed[3] == pytest.approx(shed[1])
    mansard = first_of(MANSARD, house)
    rise = height(mansard, *((0, 4 - d) for d in (0, 0.5, 1, 3, 3.5, 4)))
    assert rise[0] == pytest.approx(0)
    assert 1 <= (rise[2] - rise[1]) / 0.5 <= np.tan(np.radians(55.0)) + 1e-9
    assert np.tan(np.radians(15.0)) - 1e-9 <= (rise[5] - rise[4]) / 0.5 <= np.tan(np.radians(25.0)) + 1e-9


@pytest.mark.parametrize("angle", [0.0, 30.0, 200.0])
def test_wings_of_an_l_shape_meet_in_a_valley(angle: float) -> None:
    """A gable over 20 x 8 m and one over 6 x 15 m of one slope: ridges of 4 and 3 slopes, and a valley."""
    ell = affinity.rotate(shapely.Polygon(ELL), angle, origin=(0, 0))
    gable = next(found for found in (roofs_of(ell, seed=k) for k in range(99)) if found.kind[0] == GABLE)
    assert gable.start.tolist() == [0, 2]
    turned = [
        affinity.rotate(shapely.Point(place), angle, origin=(0, 0)).coords[0]
        for place in ((19, 4), (1, 4), (3, 14), (5, 8), (7, 7), (6, 8), (3, 8))
    ]
    rise = height(gable, *turned) / height(gable, turned[0]) * 4
    np.testing.assert_allclose(rise, [4, 4, 3, 1, 1, 0, 3], atol=1e-9)
    assert shapely.union_all(shapely.polygons(wing_rings(gable))).symmetric_difference(ell).area < 1e-9


def test_of_an_l_shape_hips_are_its_straight_skeleton() -> None:
    """Heights are the slope times the distance to the closest wall; where both wings are, lower at most."""
    ell = shapely.Polygon(ELL)
    hip = next(found for found in (roofs_of(ell, seed=k) for k in range(99)) if found.kind[0] == HIP)
    x, y = (side.ravel() for side in np.meshgrid(np.arange(0.25, 20, 0.5), np.arange(0.25, 15, 0.5)))
    xy = np.column_stack((x, y))[shapely.contains_xy(ell, x, y)]
    distance = shapely.distance(shapely.points(xy), ell.exterior)
    both = (xy < (6, 8)).all(axis=1)
    slope = height(hip, (19, 4))[0] / 1.0
    rise = height(hip, *map(tuple, xy.tolist()))
    np.testing.assert_allclose(rise[~both], slope * distance[~both], atol=1e-9)
    assert (rise[both] <= slope * distance[both] + 1e-9).all()


def test_all_types_with_slopes_and_eaves_in_their_limits() -> None:
    made = city()
    shapes = made.shapes
    share = np.bincount(shapes.kind, minlength=6) / 200
    assert len(share) == len(ROOF_TYPES)
    assert (share >= (0.1, 0.08, 0.25, 0.1, 0.02, 0.08)).all()
    used = np.isfinite(shapes.plane[:, :, 2])
    slope = np.degrees(np.arctan(np.hypot(*shapes.plane[used][:, :2].T)))
    house = np.repeat(np.arange(200), np.diff(shapes.start))
    of_flat = np.repeat(shapes.kind[house] == FLAT, used.sum(axis=1))
    assert (slope[of_flat] == 0).all()
    assert slope[~of_flat].min() >= 15 - 1e-9
    assert slope[~of_flat].max() <= 55 + 1e-9
    sloped = shapes.kind != FLAT
    eaves = (shapes.eaves - made.ground)[sloped]
    assert 4 <= eaves.min() < 5.5
    assert 10 < eaves.max() <= 12.5
    assert (made.roof[sloped] - shapes.eaves[sloped]).min() > 0.3
    np.testing.assert_array_equal(made.roof, highest_places(shapes))
    assert (np.diff(shapes.start)[shapes.kind == FLAT] == 1).all()
    assert np.count_nonzero(np.diff(shapes.start) == 2) > 20


def test_heights_of_neighbours_in_a_row_cross() -> None:
    """Along the walls that houses share, one roof is higher here and lower there, often."""
    made = city(buildings=400)
    i, j = shapely.STRtree(made.polygons).query(made.polygons, predicate="touches")
    i, j = i[i < j], j[i < j]
    common = shapely.intersection(made.polygons[i], made.polygons[j])
    walls = shapely.length(common) > 1
    assert walls.sum() >= 16 * 3 + 20
    crosses = 0
    for one, two, wall in zip(i[walls], j[walls], common[walls], strict=True):
        xy = shapely.get_coordinates(shapely.line_interpolate_point(wall, np.linspace(0, wall.length, 50)))
        gap = shape_heights(made.shapes, np.full(50, one), xy) - shape_heights(made.shapes, np.full(50, two), xy)
        crosses += gap.min() < -0.5 and gap.max() > 0.5
    assert crosses >= 10


def test_a_roof_depends_on_number_and_place_alone() -> None:
    made = city()
    one = draw_roofs(made.polygons[:30], made.ground[:30], made.roof[:30], seed=1)
    last = one.start[-1]
    np.testing.assert_array_equal(one.kind, made.shapes.kind[:30])
    np.testing.assert_array_equal(one.plane, made.shapes.plane[:last])
    other = draw_roofs(made.polygons[:30], made.ground[:30], made.roof[:30], seed=2)
    assert (one.kind != other.kind).any()


def test_points_lie_on_the_roofs_in_any_part() -> None:
    made = city(size=200.0, density=8.0, buildings=50)
    clear = np.bincount(shapely.STRtree(made.polygons).query(made.polygons, "overlaps")[0], minlength=50) == 0
    whole = city_points(made, (X, Y, X + 200, Y + 200), (0, 0))
    x, y, z = whole.xyz[whole.classification == 6].T
    house, point = shapely.STRtree(shapely.points(x, y)).query(made.polygons[clear], "contains")
    house = np.flatnonzero(clear)[house]
    away = z[point] - shape_heights(made.shapes, house, np.column_stack((x, y))[point])
    assert len(away) > 5000
    assert away.std() == pytest.approx(0.05, rel=0.05)
    assert np.abs(away).max() < 0.3
    part = city_points(made, (X, Y, X + 100, Y + 100), (3, 4))
    again = city_points(city(size=200.0, density=8.0, buildings=50), (X, Y, X + 100, Y + 100), (3, 4))
    np.testing.assert_array_equal(part.xyz, again.xyz)


def test_flat_cities_are_what_they_were() -> None:
    """Figures of a city that was made before there were other roofs."""
    made = city(roofs="flat", buildings=80)
    above = (made.roof - made.ground).tolist()
    np.testing.assert_allclose(above[:3], FLAT_ROOFS, atol=1e-9)
    assert made.shapes.kind.max() == FLAT
    cloud = city_points(made, (X, Y, X + 100, Y + 100), (0, 0))
    np.testing.assert_allclose(cloud.xyz.mean(axis=0) - (X, Y, 0), FLAT_POINTS, atol=1e-6)
    np.testing.assert_array_equal(flat_shapes(made.polygons, made.roof).plane, made.shapes.plane)


def test_truth_has_types_and_planes(tmp_path: Path) -> None:
    """The roof of a house in the truth file is that of the city."""
    files = write_city(tmp_path, size=200, buildings=40, density=0.1, roofs="mixed")
    truth = json.loads(files.truth.read_text())
    made = city(size=200.0, buildings=40, density=0.1)
    assert truth["roofs"] == "mixed"
    assert [entry["type"] for entry in truth["buildings"]] == [ROOF_TYPES[kind] for kind in made.shapes.kind]
    for k, entry in enumerate(truth["buildings"]):
        xy = shapely.get_coordinates(shapely.point_on_surface(made.polygons[k]))
        over = [
            min(a * (xy[0, 0] - x) + b * (xy[0, 1] - y) + c for a, b, c in wing["planes"])
            for wing in entry["wings"]
            for x, y in [wing["origin"]]
            if shapely.Polygon(wing["ring"]).contains(shapely.Point(xy[0]))
        ]
        assert max(over) == pytest.approx(shape_heights(made.shapes, np.array([k]), xy)[0], abs=2e-3)
        assert entry["roof"] == pytest.approx(made.roof[k], abs=6e-4)
        assert entry["ground"] == pytest.approx(terrain_height(made, *_centroid(made, k))[0], abs=6e-4)
    flat = write_city(tmp_path / "flat", size=200, buildings=4, density=0.1)
    assert set(json.loads(flat.truth.read_text())["buildings"][0]) == {"id", "ground", "roof"}


def _centroid(made: SyntheticCity, k: int) -> NDArray[np.float64]:
    xy: NDArray[np.float64] = shapely.get_coordinates(shapely.centroid(made.polygons[k])).reshape(-1, 1, 2).T[:, 0]
    return xy


def test_no_and_few_houses() -> None:
    assert len(draw_roofs(np.empty(0, object), np.empty(0), np.empty(0), seed=1)) == 0
    for buildings in range(13):
        made = city(size=100.0, buildings=buildings)
        assert len(made.polygons) == len(made.shapes) == buildings
        assert len(city_points(made, (X, Y, X + 100, Y + 100), (0, 0)).xyz) > 10_000


def test_unknown_roofs_are_refused() -> None:
    with pytest.raises(ValueError, match="roofs 'thatched'; one of flat, mixed"):
        city(roofs="thatched")


def test_footprints_have_the_tags_of_their_roofs(tmp_path: Path) -> None:
    files = write_city(tmp_path, size=200, buildings=40, density=0.1, roofs="mixed")
    meta, _, _, columns = pyogrio.raw.read(files.footprints)
    tags = dict(zip(meta["fields"].tolist(), columns, strict=True))
    truth = json.loads(files.truth.read_text())["buildings"]
    assert len(truth) == len(tags["id"]) == 40
    seen = set()
    for k, house in enumerate(truth):
        shape, planes = tags["roof:shape"][k], np.array(house["wings"][0]["planes"])
        seen.add(shape)
        assert tags["height"][k] == pytest.approx(house["roof"] - house["ground"], abs=2e-3)
        assert tags["roof:height"][k] == pytest.approx(house["roof"] - house["eaves"], abs=2e-3)
        assert (tags["roof:orientation"][k] in ("along", "across")) == (shape in ("gabled", "gambrel"))
        assert (shape in ("mansard", "gambrel")) == (house["type"] == "mansard")
        if shape == "skillion":
            angle = math.radians(tags["roof:direction"][k])
            downhill = planes[0, 0] * math.sin(angle) + planes[0, 1] * math.cos(angle)
            assert downhill == pytest.approx(-math.hypot(*planes[0, :2]), rel=1e-4)
        else:
            assert np.isnan(tags["roof:direction"][k])
    assert {"flat", "skillion", "gabled", "hipped"} <= seen
    plain = write_city(tmp_path / "flat", size=200, buildings=4, density=0.1)
    assert pyogrio.read_info(plain.footprints)["fields"].tolist() == ["id"]
    assert pyogrio.read_info(files.shapefile)["fields"].tolist() == ["id"]
