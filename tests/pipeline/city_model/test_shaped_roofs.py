"""Roofs by the outline: forms that attributes give, and hipped ones where points do not tell (step 2.0, ours)."""

import numpy as np
import pytest
import shapely

from pipeline.city_model.building_points import BuildingPoints
from pipeline.city_model.city import assemble_city
from pipeline.city_model.heights import ROOF_SOURCES, Heights
from pipeline.city_model.shaped_roofs import LEAST_EAVES, SKELETON, WIDEST_RISE, form_roofs, shape_roofs
from pipeline.data.citymodel import Footprints
from pipeline.data.notes import Note
from pipeline.data.roof_forms import (
    DIRECTION,
    HEIGHT,
    ROOF_SHAPES,
    SHAPE,
    SLOPE,
    TO_EAVES,
    TOO_LOW,
    no_forms,
)
from pipeline.data.roofs import flat_roofs, is_flat, roof_heights
from pipeline.roofs.house_levels import HouseParts
from pipeline.roofs.house_roofs import FLAT, HouseRoofs
from pipeline.roofs.roof_points import RoofPoints, make_roof_points, no_roof_points
from pipeline.skeletons.skeleton_roofs import DEFAULT_SLOPE

HOUSES = np.array([shapely.box(100, 0, 112, 8), shapely.box(120, 0, 130, 8), shapely.box(0, 40, 60, 80)])


def flat_houses(heights: list[float]) -> HouseRoofs:
    n = len(heights)
    parts = HouseParts(HOUSES[:n], np.arange(n))
    return HouseRoofs(
        parts, flat_roofs(np.array(heights)), np.full(n, FLAT, np.int8), np.ones(n, np.int32), np.ones(n, np.bool_)
    )


def shape(heights: list[float], chosen: list[bool], ground: float = 0.0) -> HouseRoofs:
    n = len(heights)
    return shape_roofs(
        flat_houses(heights), HOUSES[:n], np.array(chosen), np.full(n, ground), np.array(heights, np.float64)
    )


def test_a_hipped_roof_has_four_parts_and_the_mean_height_of_the_flat_one() -> None:
    found = shape([9.0, 7.0], [True, False])
    assert found.parts.house.tolist() == [0, 0, 0, 0, 1]
    assert found.method.tolist() == [SKELETON, FLAT]
    assert found.n_planes.tolist() == [4, 1]
    parts = found.parts.polygons[:4]
    assert shapely.area(parts).sum() == pytest.approx(96)
    assert sorted(shapely.area(parts).tolist()) == pytest.approx([16, 16, 32, 32])
    centre = shapely.get_coordinates(shapely.centroid(parts))
    height = roof_heights(found.roofs, np.arange(4), centre)
    assert (height * shapely.area(parts)).sum() / 96 == pytest.approx(9.0)
    assert np.hypot(*found.roofs.plane[:4, :2].T) == pytest.approx(DEFAULT_SLOPE)
    # By hand: the mean distance from the closest edge is 14/9 m.
    eaves = roof_heights(found.roofs, np.arange(4), np.tile([100.0, 0.0], (4, 1)))
    assert eaves.min() == pytest.approx(9.0 - DEFAULT_SLOPE * 14 / 9)
    assert is_flat(found.roofs).tolist() == [False] * 4 + [True]


def test_houses_stay_flat_where_a_hipped_roof_is_no_roof_of_theirs() -> None:
    wide = shape([9.0, 9.0, 9.0], [False, False, True])  # 40 m wide: it would rise by 14 m
    low = shape([3.0], [True], ground=2.5 - LEAST_EAVES)  # its eaves would be 1.5 m above the ground
    unknown = shape([np.nan], [True])
    for found in (wide, low, unknown):
        assert (found.method == FLAT).all()
        assert (found.parts.polygons == HOUSES[: len(found.method)]).all()


def form_of(shape: str, **values: float) -> np.ndarray:
    """One row of forms: `height`, `slope`, `direction`, `to_eaves` as they are given."""
    columns = {"height": HEIGHT, "slope": SLOPE, "direction": DIRECTION, "to_eaves": TO_EAVES}
    form = no_forms(1)
    form[0, SHAPE] = ROOF_SHAPES.index(shape)
    for name, value in values.items():
        form[0, columns[name]] = value
    return form


def give_form(
    form: np.ndarray,
    roof: float,
    *,
    source: str = "attribute",
    points: np.ndarray | None = None,
    house: shapely.Polygon = HOUSES[0],
) -> tuple[HouseRoofs, int, list[Note]]:
    """Give one house on the ground at 0 a form; its roof height is known by a source."""
    located: RoofPoints = no_roof_points(1)
    if points is not None:
        located = make_roof_points(np.array([0, len(points)]), points)
    footprints = Footprints(np.array([house], object), np.array(["a"]), np.array([np.nan]), form)
    code = np.array([ROOF_SOURCES.index(source)], np.int8)
    heights = Heights(np.zeros(1), np.array([roof]), code, np.zeros(1, np.bool_))
    none = BuildingPoints(np.zeros(2, np.int64), np.empty(0), np.zeros(2, np.int64), np.empty(0))
    city = assemble_city(footprints, none, heights, (("a",),), np.zeros(1))
    flat = HouseRoofs(
        HouseParts(city.model.polygons, np.arange(1)),
        flat_roofs(np.array([roof])),
        np.full(1, FLAT, np.int8),
        np.ones(1, np.int32),
        np.ones(1, np.bool_),
    )
    found, codes, notes = form_roofs(flat, city, located, np.ones(1, np.bool_))
    return found, int(codes[0]), notes


def heights_of(found: HouseRoofs) -> tuple[float, float]:
    """Eaves and ridge (m)."""
    return float(found.roofs.limits[:, 0].min()), float(found.roofs.limits[:, 1].max())


def points_on(height: float, slope: float, n: int = 40) -> np.ndarray:
    """Points on a gable of the house of 12 x 8 m, whose ridge runs along y = 4."""
    rng = np.random.default_rng(5)
    xy = rng.uniform((100.5, 0.5), (111.5, 7.5), (n, 2))
    return np.column_stack((xy, height + slope * np.minimum(xy[:, 1], 8 - xy[:, 1])))


@pytest.mark.parametrize(
    ("form", "expected"),
    [
        (form_of("gabled", height=3), (6.0, 9.0)),  # a height includes the roof
        (form_of("gabled", height=3, to_eaves=1), (9.0, 12.0)),  # levels do not
        (form_of("gabled", slope=0.5), (7.0, 9.0)),  # half of 8 m at 0.5
        (form_of("gabled", height=3, slope=0.5), (6.0, 9.0)),
        (form_of("gabled"), (9 - 0.7 * 4, 9.0)),
        (form_of("skillion", slope=0.25, direction=180), (7.0, 9.0)),  # over 8 m, lowest in the south
        (form_of("skillion", slope=0.25, direction=90), (6.0, 9.0)),  # over 12 m
        (form_of("skillion"), (9 - WIDEST_RISE, 9.0)),
        (form_of("pyramidal", height=4), (5.0, 9.0)),
        (form_of("mansard", height=4), (5.0, 9.0)),
        (form_of("flat"), (9.0, 9.0)),
        (form_of("gabled", height=8), (LEAST_EAVES, 9.0)),  # eaves at 1 m are raised
    ],
)
def test_a_form_over_a_house_without_points(form: np.ndarray, expected: tuple[float, float]) -> None:
    found, code, notes = give_form(form, 9.0)
    assert code == form[0, SHAPE]
    assert heights_of(found) == pytest.approx(expected)
    assert found.method.tolist() == [FLAT if ROOF_SHAPES[code] == "flat" else SKELETON]
    assert shapely.area(found.parts.polygons).sum() == pytest.approx(96)
    assert [note.kind for note in notes] == ["footprint-roof-form-lowered"] * int(form[0, HEIGHT] == 8)


def test_a_skillion_looks_downhill_where_it_is_told() -> None:
    found, _, _ = give_form(form_of("skillion", slope=0.25, direction=180), 9.0)
    assert roof_heights(
        found.roofs, np.zeros(2, np.int64), np.array([[106.0, 0.0], [106.0, 8.0]])
    ) == pytest.approx([7.0, 9.0])


def test_a_height_by_default_is_the_mean_one() -> None:
    found, _, _ = give_form(form_of("gabled", height=3), 6.0, source="default")
    assert heights_of(found) == pytest.approx((4.5, 7.5))


def test_points_tell_eaves_and_slope() -> None:
    points = points_on(5.0, 0.55)
    points[:6, 2] += 4.0  # a chimney
    found, _, notes = give_form(form_of("gabled"), 0.0, source="points", points=points)
    assert heights_of(found) == pytest.approx((5.0, 5.0 + 4 * 0.55), abs=0.01)
    stated, _, _ = give_form(form_of("gabled", height=4), 0.0, source="points", points=points_on(5.0, 1.0))
    assert heights_of(stated) == pytest.approx((5.0, 9.0))
    assert notes == []
    few, _, _ = give_form(form_of("gabled"), 0.0, source="points", points=points_on(5.0, 0.7, 3))
    assert heights_of(few) == pytest.approx((5.0, 7.8))


def test_the_order_of_points_does_not_matter() -> None:
    points = points_on(5.0, 0.55, 200) + np.random.default_rng(1).normal(0, 0.1, (200, 3)) * [0, 0, 1]
    one, _, _ = give_form(form_of("hipped"), 0.0, source="points", points=points)
    two, _, _ = give_form(form_of("hipped"), 0.0, source="points", points=points[::-1])
    assert one.roofs.plane.tobytes() == two.roofs.plane.tobytes()


def test_points_far_from_a_form_are_told() -> None:
    flat = points_on(9.0, 0.0, 60)
    found, code, notes = give_form(form_of("gabled", height=6), 0.0, source="points", points=flat)
    assert code == ROOF_SHAPES.index("gabled")
    assert [(note.kind, note.subject) for note in notes] == [("footprint-roof-form-off", "a")]
    assert found.method.tolist() == [SKELETON]


def test_forms_that_are_not_used() -> None:
    low = give_form(form_of("gabled", height=3), 2.2)
    assert low[1] == TOO_LOW
    assert [(note.kind, note.detail) for note in low[2]] == [
        ("footprint-roof-form-unused", "gabled: no room above eaves of 2 m")
    ]
    assert low[0].method.tolist() == [FLAT]


def test_parts_of_small_houses_stay_apart() -> None:
    tower = shapely.box(0, 0, 3, 3)  # four parts of 2.25 m2
    found, _, _ = give_form(form_of("pyramidal", height=2), 20.0, house=tower)
    assert len(found.parts.polygons) == 4
    assert heights_of(found) == pytest.approx((18.0, 20.0))


def test_a_pyramid_is_hipped_where_it_cannot_be() -> None:
    bent = shapely.Polygon([(0, 0), (20, 0), (20, 6), (6, 6), (6, 20), (0, 20)])
    _, code, notes = give_form(form_of("pyramidal", height=2), 9.0, house=bent)
    assert code == ROOF_SHAPES.index("hipped")
    assert [(note.kind, note.detail) for note in notes] == [
        ("footprint-roof-form-replaced", "pyramidal: an edge does not face the middle; hipped")
    ]
