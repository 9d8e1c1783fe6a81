"""What is told of roofs of planes: attributes worked out by hand, fit by method, and the worst houses."""

import numpy as np
import pytest
import shapely

from pipeline.data.citymodel import CityModel
from pipeline.data.roof_forms import NO_FORM, ROOF_SHAPES
from pipeline.data.roofs import ROOF_FALLBACKS, ROOF_METHODS, Roofs
from pipeline.quality.building_facts import describe_roofs
from pipeline.quality.point_fidelity import HouseFidelity, measure_houses
from pipeline.quality.roof_fits import WORST, RoofFits
from pipeline.roofs.roof_points import make_roof_points

PLANES, FAMILY, FLAT = (np.int8(ROOF_METHODS.index(name)) for name in ("planes", "family", "flat"))
NO_FORMS = np.full(3, NO_FORM)
FEW = np.int8(ROOF_FALLBACKS.index("few roof points"))


def make_model() -> CityModel:
    """House "a" of two parts whose planes rise to the north and to the east, and a flat house "b"."""
    boxes = shapely.box([0, 4, 20], [0, 0, 0], [4, 8, 22], [10, 10, 5])
    roofs = Roofs(
        np.array([[0, 1, 3.0], [0.75, 0, 4], [0, 0, 6]]),
        np.array([[0, 0], [0, 0], [0, 0.0]]),
        np.array([[5, 50.0], [-9, 50], [6, 6]]),
    )
    ids = np.array(["a-part1", "a-part2", "b"])
    return CityModel(boxes, ids, np.arange(3), np.zeros(3), roofs, ((),) * 3, np.array(["a", "a", "b"]))


def make_fit(n: list[int], rmse: list[float], median: list[float], within: list[float]) -> HouseFidelity:
    zero = np.zeros(len(n))
    return HouseFidelity(np.array(n), np.array(rmse), zero, zero + 1, np.array(median), np.array(within))


def test_attributes_of_roofs() -> None:
    fit = make_fit([80, 20, 0], [1.0, 3.0, np.nan], [0.1, 0.5, np.nan], [0.75, 0.25, np.nan])
    forms = np.array([-2, -2, ROOF_SHAPES.index("flat")])
    told = describe_roofs(make_model(), np.array([PLANES, PLANES, FLAT]), np.array([0, 0, FEW]), forms, fit)
    assert told["roof_method"] == ["planes", "planes", "flat"]
    assert told["roof_fallback"] == ["", "", "few roof points"]
    assert told["roof_form"] == ["", "", "flat"]
    assert told["roof_parts"] == [2, 2, 1]
    assert told["roof_planes"] == [2, 2, 1]
    assert told["roof_density"] == [2.0, 0.5, 0.0]
    assert told["roof_clipped"] == [0.2, 0.0, 0.0]  # z = y + 3 is below 5 on 2 of 10 m
    assert told["roof_slope"] == [45.0, 36.9, 0.0]
    assert told["roof_azimuth"] == [180.0, 270.0, None]  # down to the south and to the west
    low, high = 5 * 0.2 + (5 + 13) / 2 * 0.8, 4 + 0.75 * 6
    assert told["lod13_height"] == pytest.approx([low, high, 6])
    assert told["lod12_height"] == pytest.approx([(low + high) / 2] * 2 + [6])


def test_fit_by_method_and_the_worst_houses() -> None:
    fits, model = RoofFits(), make_model()
    fit = make_fit([80, 20, 100], [1.0, 3.0, 2.0], [0.1, 0.5, 0.2], [0.75, 0.25, 0.5])
    method = np.array([PLANES, PLANES, FLAT])
    fits.add(model, method, fit, describe_roofs(model, method, np.array([0, 0, FEW]), NO_FORMS, fit))
    assert fits.by_method() == {
        "planes": {"buildings": 2, "points": 100, "rmse": round(2.6**0.5, 4), "median": 0.3, "within": 0.65},
        "flat": {"buildings": 1, "points": 100, "rmse": 2.0, "median": 0.2, "within": 0.5},
    }
    assert [(one["id"], one["worst_part"], one["parts"], one["rmse"]) for one in fits.worst] == [
        ("b", "b", 1, 2.0),
        ("a", "a-part2", 2, 1.612),
    ]
    assert (
        fits.worst[0]["why"]
        == "few roof points: one height; most points fit: façade points or what stands on the roof"
    )
    assert fits.worst[1]["why"].startswith("0.50 points a m2")


def test_houses_without_points_or_with_few_are_not_listed() -> None:
    fits, model = RoofFits(), make_model()
    fit = make_fit([0, 0, 7], [np.nan, np.nan, 9.0], [np.nan, np.nan, 1.0], [np.nan, np.nan, 0.0])
    method = np.array([FAMILY, FAMILY, FLAT])
    fits.add(model, method, fit, describe_roofs(model, method, np.array([0, 0, 0]), NO_FORMS, fit))
    assert fits.worst == []
    assert fits.by_method()["family"] == {"buildings": 2, "points": 0}


def test_the_worst_of_many_blocks_do_not_depend_on_their_order() -> None:
    rng = np.random.default_rng(4)
    blocks = []
    for k in range(12):
        n = 9
        ids = np.array([f"h{k}-{i}" for i in range(n)])
        boxes = shapely.box(np.arange(n), [0] * n, np.arange(n) + 1, [1] * n)
        roofs = Roofs(np.zeros((n, 3)), np.zeros((n, 2)), np.zeros((n, 2)))
        model = CityModel(boxes, ids, np.arange(n), np.zeros(n), roofs, ((),) * n, ids)
        fit = make_fit([9] * n, rng.uniform(0, 5, n).round(1).tolist(), [0.0] * n, [1.0] * n)
        blocks.append((model, fit))
    found = []
    for order in (range(12), reversed(range(12))):
        fits = RoofFits()
        for k in order:
            model, fit = blocks[k]
            method = np.full(len(model), FLAT)
            fits.add(
                model,
                method,
                fit,
                describe_roofs(model, method, np.zeros(len(model), np.int8), np.full(len(model), NO_FORM), fit),
            )
        found.append(fits.worst)
    assert found[0] == found[1]
    assert len(found[0]) == WORST
    largest = sorted((value for _, fit in blocks for value in fit.rmse), reverse=True)[:WORST]
    assert [one["rmse"] for one in found[0]] == pytest.approx(largest)


def test_median_and_share_of_near_points_of_a_house() -> None:
    """Distances 0.1, 0.2, 0.3 and 4 of one house, 0.25 of another, and none of a third."""
    xyz = np.array([[1, 1, 9.9], [1, 2, 10.2], [2, 1, 10.3], [2, 2, 6.0], [11, 1, 4.75]])
    boxes = shapely.box([0, 10, 20], [0] * 3, [3, 13, 23], [3] * 3)
    roofs = Roofs(np.tile([0.0, 0.0, 10.0], (3, 1)), np.zeros((3, 2)), np.array([[10, 10], [5.0, 5], [1, 1]]))
    found = measure_houses(make_roof_points(np.array([0, 4, 5, 5]), xyz), boxes, roofs)
    assert found.median[:2] == pytest.approx([0.25, 0.25])
    assert found.within[:2].tolist() == [0.5, 1.0]
    assert np.isnan(found.median[2])
    assert np.isnan(found.within[2])
