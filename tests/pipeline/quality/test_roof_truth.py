"""Roofs held against the truth: a gabled house as it is, raised, flat, and with a plane more."""

from typing import Any

import numpy as np
import pytest
import shapely
from numpy.typing import NDArray

from pipeline.quality.roof_truth import Comparison, compare_roof, make_roof, summarise_roofs

Array = NDArray[np.float64]
BOX = shapely.box(100, 200, 110, 208)


def plane(a: float, b: float, c: float, x0: float, x1: float) -> dict[str, Any]:
    """A plane ``c + a (x - 100) + b (y - 200)`` over a strip of the house."""
    ring = [(x, y, c + a * (x - 100) + b * (y - 200)) for x, y in ((x0, 200), (x1, 200), (x1, 208), (x0, 208))]
    return {"plane": [a, b, c], "ring": ring}


WEST, EAST = plane(0.8, 0, 5, 100, 105), plane(-0.8, 0, 13, 105, 110)
TRUTH = {
    "type": "gabled",
    "planes": [WEST, EAST],
    "main": 2,
    "origin": (100.0, 200.0),
    "outline": list(BOX.exterior.coords),
}


def compare(*planes: dict[str, Any], lift: float = 0.0, outline: shapely.Polygon = BOX) -> Comparison:
    faces: list[list[Array]] = [[np.array(one["ring"]) + np.array([0, 0, lift])] for one in planes]
    return compare_roof(TRUTH, make_roof(faces, [outline]))


def test_a_roof_as_it_is_has_no_error() -> None:
    found = compare(WEST, EAST)
    assert (found.same_type, found.same_planes) == (True, True)
    np.testing.assert_allclose(found.angles, 0, atol=1e-5)
    np.testing.assert_allclose(found.errors, 0, atol=1e-9)
    assert len(found.errors) > 200
    assert found.outline == pytest.approx(0)


def test_each_error_is_told_as_what_it_is() -> None:
    raised = compare(WEST, EAST, lift=0.3)
    np.testing.assert_allclose(raised.errors, 0.3)
    assert raised.same_type
    flat = compare(plane(0, 0, 7, 100, 110))
    assert (flat.same_type, flat.same_planes) == (False, False)
    np.testing.assert_allclose(flat.angles, np.degrees(np.arctan(0.8)))
    more = compare(WEST, EAST, plane(0, 0, 6, 109, 110))
    assert (more.same_type, more.same_planes) == (True, False)
    wider = compare(WEST, EAST, outline=shapely.box(99, 200, 110, 208))
    assert wider.outline == pytest.approx(8 / 36)


def test_rows_are_by_true_type_with_what_the_model_lacks() -> None:
    rows = summarise_roofs([compare(WEST, EAST), compare(plane(0, 0, 7, 100, 110))], {"flat": 3})
    assert [(row["type"], row["houses"], row["lost"]) for row in rows] == [
        ("flat", 0, 3),
        ("gabled", 2, 0),
        ("all", 2, 3),
    ]
    assert rows[1]["right_type"] == rows[1]["right_planes"] == 0.5
    assert "right_type" not in rows[0]
