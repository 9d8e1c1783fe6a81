"""Step 1.4: clean footprints are valid, canonical, unique; nothing goes unsaid; a second pass is idle."""

from pathlib import Path

import numpy as np
import pyogrio
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from pipeline.city_model.footprints import clean_footprints
from pipeline.data.citymodel import Footprints
from pipeline.data.notes import Note, count_notes
from pipeline.geometry.rings import compute_sharpest_corners, make_canonical
from tests.helpers.campaigns import examples

HOUSE = shapely.box(0, 0, 10, 8)


def footprints(*geometries: object, ids: list[str] | None = None) -> Footprints:
    polygons = np.empty(len(geometries), dtype=object)
    polygons[:] = geometries
    names = ids if ids is not None else [f"h{i}" for i in range(len(geometries))]
    return Footprints(polygons, np.array(names, dtype=np.str_), np.arange(len(geometries), dtype=np.float64))


def clean(*geometries: object, ids: list[str] | None = None) -> tuple[Footprints, tuple[Note, ...]]:
    return clean_footprints(footprints(*geometries, ids=ids), min_area=5.0, tolerance=0.01)


def ring(polygon: shapely.Polygon) -> list[tuple[float, float]]:
    return [(float(x), float(y)) for x, y in polygon.exterior.coords[:-1]]


def assert_same(a: Footprints, b: Footprints) -> None:
    assert a.ids.tolist() == b.ids.tolist()
    assert shapely.to_wkb(a.polygons).tolist() == shapely.to_wkb(b.polygons).tolist()
    np.testing.assert_array_equal(a.given_height, b.given_height)


def test_a_ring_is_oriented_canonical_and_without_needless_vertices() -> None:
    corners = [(10, 8), (10.003, 8.003), (10, 4), (10, 0), (5, 0.004), (0, 0), (0, 0), (0, 0.003), (0, 8)]
    result, notes = clean(shapely.Polygon([(x, y, 7.0) for x, y in corners]))
    (polygon,) = result.polygons
    assert not polygon.has_z
    assert ring(polygon) == [(0, 0), (10, 0), (10, 8), (0, 8)]
    assert notes == ()


def test_the_same_ring_from_any_start_in_any_direction_gives_the_same_bytes() -> None:
    blobs = set()
    for start in range(5):
        zero = -0.0 if start % 2 else 0.0
        corners = [(0.1, 0.2), (10, 0), (10.3, 8), (4, 6), (zero, 8)]
        turned = corners[start:] + corners[:start]
        for way in (turned, turned[::-1]):
            blobs.add(shapely.to_wkb(clean(shapely.Polygon(way))[0].polygons[0]))
    assert len(blobs) == 1


def test_a_courtyard_stays_and_a_tiny_one_or_a_slit_is_filled() -> None:
    holes = [
        [(1, 1), (1, 5), (5, 5), (5, 1)],
        [(7, 1), (7, 2), (8, 2), (8, 1)],
        [(1, 10), (1, 10.2), (39, 10.2), (39, 10)],
    ]
    result, notes = clean(shapely.Polygon([(0, 0), (40, 0), (40, 12), (0, 12)], holes))
    (polygon,) = result.polygons
    assert [hole.bounds for hole in polygon.interiors] == [(1, 1, 5, 5)]
    assert not polygon.interiors[0].is_ccw
    assert polygon.exterior.is_ccw
    assert [note.kind for note in notes] == ["courtyard-filled"] * 2
    assert sorted(note.detail.split(" m²")[0] for note in notes) == ["1.000", "7.600"]


def test_a_spike_and_a_slit_go() -> None:
    spike = [(0, 0), (10, 0), (10, 4), (30, 4.001), (10, 4.002), (10, 8), (0, 8)]
    slit = [(0, 0), (10, 0), (10, 4), (3, 4.001), (10, 4.002), (10, 8), (0, 8)]
    for corners in (spike, slit):
        result, notes = clean(shapely.Polygon(corners))
        assert ring(result.polygons[0]) == [(0, 0), (10, 0), (10, 8), (0, 8)]
        assert count_notes(notes) == {"footprint-spike": 1}


def test_a_bow_tie_becomes_its_two_wings_in_canonical_order() -> None:
    result, notes = clean(shapely.Polygon([(0, 0), (10, 8), (10, 0), (0, 8)]), ids=["B"])
    assert result.ids.tolist() == ["B-1", "B-2"]
    assert [polygon.bounds for polygon in result.polygons] == [(0, 0, 5, 8), (5, 0, 10, 8)]
    np.testing.assert_array_equal(result.given_height, [0.0, 0.0])
    assert count_notes(notes) == {"footprint-repaired": 1, "footprint-split": 1}
    assert "Self-intersection" in notes[0].detail
    assert (notes[0].subject, notes[0].x, notes[0].y) == ("B", 5.0, 4.0)


def test_a_self_touching_ring_becomes_a_courtyard() -> None:
    corners = [(0, 0), (10, 0), (10, 8), (5, 8), (7, 5), (3, 5), (5, 8), (0, 8)]
    result, _ = clean(shapely.Polygon(corners))
    (polygon,) = result.polygons
    assert polygon.is_valid
    assert polygon.area == pytest.approx(80 - 6)


def test_parts_that_overlap_are_united() -> None:
    result, notes = clean(shapely.MultiPolygon([shapely.box(0, 0, 4, 4), shapely.box(2, 2, 6, 6)]))
    assert result.polygons[0].area == pytest.approx(28)
    assert count_notes(notes) == {"footprint-repaired": 1}


def test_a_hole_that_a_dropped_vertex_leaves_outside_is_repaired() -> None:
    shell = [(0, 0), (5, -0.009), (10, 0), (10, 8), (0, 8)]
    result, _ = clean(shapely.Polygon(shell, [[(5, -0.004), (2, 4), (8, 4)]]))
    assert shapely.is_valid(result.polygons).all()
    assert shapely.area(result.polygons).sum() == pytest.approx(80 - 12, abs=0.1)


def test_parts_of_collections_are_taken_and_lines_left() -> None:
    far = shapely.box(50, 0, 60, 8)
    nested = shapely.GeometryCollection(
        [shapely.Point(0, 0), shapely.MultiPolygon([far, HOUSE]), shapely.LineString([(0, 0), (90, 90)])]
    )
    result, notes = clean(nested, ids=["C"])
    assert result.ids.tolist() == ["C-1", "C-2"]
    assert [polygon.bounds[0] for polygon in result.polygons] == [0, 50]
    assert count_notes(notes) == {"footprint-split": 1}


def test_a_part_that_is_dropped_does_not_number_the_one_that_stays() -> None:
    result, notes = clean(shapely.MultiPolygon([HOUSE, shapely.box(20, 0, 21, 1)]), ids=["M"])
    assert result.ids.tolist() == ["M"]
    assert count_notes(notes) == {"footprint-too-small": 1}


def test_what_is_no_building_goes_and_is_noted() -> None:
    # GEOS raises the floating-point flag where a NaN comes in; numpy would report it.
    with np.errstate(invalid="ignore"):
        broken = shapely.Polygon([(0, 0), (np.nan, 0), (5, 5)])
    result, notes = clean(
        None,
        shapely.Polygon(),
        broken,
        shapely.Polygon([(0, 0), (1e300, 0), (5, 5)]),
        shapely.LineString([(0, 0), (9, 9)]),
        shapely.Polygon([(0, 0), (10, 0), (20, 0)]),
        shapely.box(0, 0, 2, 2.4),
        shapely.box(0, 0, 90, 0.2),
        HOUSE,
    )
    assert result.ids.tolist() == ["h8"]
    assert [(note.kind, note.subject) for note in notes] == [
        ("footprint-empty", "h0"),
        ("footprint-empty", "h1"),
        ("footprint-empty", "h4"),
        ("footprint-empty", "h5"),
        ("footprint-not-finite", "h2"),
        ("footprint-not-finite", "h3"),
        ("footprint-repaired", "h5"),
        ("footprint-sliver", "h7"),
        ("footprint-too-small", "h6"),
    ]
    assert (notes[-1].x, notes[-1].y) == (1.0, 1.2)
    assert notes[-1].detail == "4.800 m² < 5 m²"


def test_duplicates_keep_the_smallest_id() -> None:
    turned = shapely.Polygon([(10, 8), (10, 0), (0, 0), (0, 8)])
    result, notes = clean(HOUSE, turned, shapely.box(0, 0, 10, 9), ids=["b", "a", "c"])
    assert result.ids.tolist() == ["a", "c"]
    np.testing.assert_array_equal(result.given_height, [1.0, 2.0])
    assert [(note.kind, note.subject, note.detail) for note in notes] == [
        ("footprint-duplicate", "b", "same polygon as a")
    ]


def test_a_repeated_id_is_numbered_by_geometry_around_names_that_are_taken() -> None:
    shapes = [shapely.box(x, 0, x + 9, 9) for x in (40, 20, 0)]
    result, notes = clean(*shapes, ids=["A", "A", "A-1"])
    assert result.ids.tolist() == ["A-1", "A-2", "A-3"]
    assert [polygon.bounds[0] for polygon in result.polygons] == [0, 20, 40]
    assert count_notes(notes) == {"footprint-id-repeated": 1}


def test_no_footprints_are_fine() -> None:
    result, notes = clean()
    assert (len(result.polygons), len(result.ids), len(result.given_height), notes) == (0, 0, 0, ())
    assert len(clean(None)[0].ids) == 0


@pytest.mark.parametrize(("min_area", "tolerance"), [(-1.0, 0.01), (1.0, -0.01), (float("nan"), 0.01)])
def test_wrong_arguments_are_refused(min_area: float, tolerance: float) -> None:
    with pytest.raises(ValueError, match="must not be negative"):
        clean_footprints(footprints(HOUSE), min_area=min_area, tolerance=tolerance)


def test_the_sharpest_corner_is_the_angle_between_edges() -> None:
    wedge = shapely.Polygon([(0, 0), (10, 0), (10, 1)])
    notch = shapely.Polygon([(0, 0), (10, 0), (10, 10), (5.1, 10), (5, 5), (4.9, 10), (0, 10)])
    angles = compute_sharpest_corners(np.array([HOUSE, wedge, notch]))
    np.testing.assert_allclose(angles, [90, np.degrees(np.arctan(0.1)), 2 * np.degrees(np.arctan(0.1 / 5))])


coordinates = st.tuples(st.integers(0, 40), st.integers(0, 40)).map(lambda c: (c[0] / 4, c[1] / 4))
noisy = st.tuples(st.floats(0, 0.02), st.floats(0, 0.02))
vertices = st.tuples(coordinates, noisy).map(lambda v: (v[0][0] + v[1][0], v[0][1] + v[1][1]))
# Random rings: nearly all cross themselves, with repeated and nearly collinear vertices.
rings = st.lists(vertices, min_size=3, max_size=12)
shapes = st.tuples(rings, st.lists(rings, max_size=2)).map(lambda r: shapely.Polygon(*r))
names = st.lists(st.sampled_from(["a", "b", "a-1", "c"]), min_size=6, max_size=6)


@settings(max_examples=examples(200), deadline=None)
@given(st.lists(shapes, max_size=6), names, st.integers(0, 99))
def test_cleaning_is_idempotent_valid_and_blind_to_order(
    polygons: list[shapely.Polygon], ids: list[str], seed: int
) -> None:
    given_set = footprints(*polygons, ids=ids[: len(polygons)])
    result, notes = clean_footprints(given_set, min_area=1.0, tolerance=0.02)
    again, more = clean_footprints(result, min_area=1.0, tolerance=0.02)
    assert_same(again, result)
    assert more == ()
    assert_sound(result)
    order = np.random.default_rng(seed).permutation(len(polygons))
    shuffled = Footprints(given_set.polygons[order], given_set.ids[order], given_set.given_height[order])
    other, other_notes = clean_footprints(shuffled, min_area=1.0, tolerance=0.02)
    assert_same(other, result)
    assert other_notes == notes


def assert_sound(result: Footprints) -> None:
    assert shapely.is_valid(result.polygons).all()
    assert (shapely.get_type_id(result.polygons) == shapely.GeometryType.POLYGON).all()
    assert not shapely.has_z(result.polygons).any()
    assert len(np.unique(result.ids)) == len(result.ids)
    assert result.ids.tolist() == sorted(result.ids.tolist())
    same = make_canonical(result.polygons)
    assert shapely.to_wkb(same).tolist() == shapely.to_wkb(result.polygons).tolist()


@pytest.mark.shared
def test_amsterdam_keeps_its_area(shared_data: Path) -> None:
    _, _, blobs, _ = pyogrio.raw.read(shared_data / "amsterdam" / "footprints.shp")
    polygons: NDArray[np.object_] = shapely.from_wkb(blobs)
    result, notes = clean(*polygons, ids=[f"{i:04d}" for i in range(len(polygons))])
    assert_sound(result)
    assert len(polygons) == len(result.ids) + count_notes(notes)["footprint-too-small"]
    assert shapely.area(result.polygons).sum() == pytest.approx(shapely.area(polygons).sum(), rel=2e-4)
    again, _ = clean(*result.polygons, ids=result.ids.tolist())
    assert shapely.to_wkb(again.polygons).tolist() == shapely.to_wkb(result.polygons).tolist()
