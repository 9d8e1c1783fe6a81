"""Forms of roofs by attributes: names of columns, words, units, bounds, and what is told of them (step 1.2)."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.data.errors import ConfigError
from pipeline.data.notes import count_notes
from pipeline.data.roof_forms import ACROSS, DIRECTION, HEIGHT, ROOF_SHAPES, SHAPE, SLOPE, TO_EAVES
from tests.tiler.vectors.test_vectors import WGS84, read, square, write
from tiler.vectors.roof_words import NO_SHAPE, NOTHING, direction_of, shape_of


def shapes_of(forms: np.ndarray) -> list[str]:
    return ["" if np.isnan(code) else ROOF_SHAPES[int(code)] for code in forms[:, SHAPE].tolist()]


def write_houses(path: Path, fields: Mapping[str, Sequence[Any]], **options: Any) -> Path:
    n = len(next(iter(fields.values())))
    values = {name: np.array(column, object) for name, column in fields.items()}
    return write(path, [square(12 * k, 5) for k in range(n)], {"id": list("abcdefgh")[:n], **values}, **options)


def test_tags_of_osm_in_columns(tmp_path: Path) -> None:
    path = write_houses(
        tmp_path / "a.gpkg",
        {
            "roof:shape": ["gabled", "Half-Hipped", "skillion", None, "onion", "flat"],
            "roof:height": ["3", "10 ft", None, "4", "2", "0"],
            "roof:angle": [None, None, "22,5°", None, None, None],
            "roof:direction": [None, None, "SW", "90", None, None],
            "roof:orientation": ["across", "along", None, None, None, "up"],
        },
    )
    footprints, notes = read(path)
    forms = footprints.forms
    assert shapes_of(forms) == ["gabled", "half-hipped", "skillion", "", "", "flat"]
    np.testing.assert_allclose(forms[:, HEIGHT], [3.0, 3.048, np.nan, np.nan, np.nan, np.nan])
    np.testing.assert_allclose(forms[:, SLOPE], [np.nan, np.nan, np.tan(np.pi / 8), np.nan, np.nan, np.nan])
    np.testing.assert_array_equal(forms[:, DIRECTION], [np.nan, np.nan, 225.0, np.nan, np.nan, np.nan])
    np.testing.assert_array_equal(forms[:, ACROSS], [1.0, 0.0, np.nan, np.nan, np.nan, np.nan])
    assert np.isnan(forms[:, TO_EAVES]).all()
    details = {note.kind: note.detail for note in notes}
    assert details == {
        "footprint-roof-forms": "1 flat, 1 gabled, 1 half-hipped, 1 skillion",
        "footprint-roof-forms-unknown": "1 onion",
    }


@pytest.mark.parametrize("name", ["a.gpkg", "a.geojson", "a.shp"])
def test_names_of_columns_as_they_come(tmp_path: Path, name: str) -> None:
    fields: dict[str, list[Any]] = {
        "roof_shape": ["hipped", "gabled"],
        "roof_heigh" if name == "a.shp" else "roof_height": ["2.5", None],
    }
    forms = read(write_houses(tmp_path / name, fields, geometry_type="Polygon"))[0].forms
    assert shapes_of(forms) == ["hipped", "gabled"]
    np.testing.assert_array_equal(forms[:, HEIGHT], [2.5, np.nan])


def test_further_tags_in_one_text(tmp_path: Path) -> None:
    text = ['"building:levels"=>"2","roof:shape"=>"gabled","roof:levels"=>"1"', '"roof:shape"=>"flat"', None]
    fields: dict[str, list[Any]] = {
        "osm_id": ["1", "2", "3"],
        "building": ["yes", "house", "yes"],
        "other_tags": text,
    }
    footprints, notes = read(write_houses(tmp_path / "a.gpkg", fields), id_attribute="id")
    assert shapes_of(footprints.forms) == ["gabled", "flat", ""]
    # Two levels of 3 m to the eaves, one of 3 m to the ridge.
    assert footprints.given_height[0] == 6.0
    assert footprints.forms[0, [HEIGHT, TO_EAVES]].tolist() == [3.0, 1.0]
    assert count_notes(notes)["footprint-roofs-by-levels"] == 1


def test_tags_of_an_extract(tmp_path: Path) -> None:
    corners = [(13.1, 52.0), (13.1002, 52.0), (13.1002, 52.0001), (13.1, 52.0001)]
    nodes = [f'<node id="{k}" lon="{x}" lat="{y}"/>' for k, (x, y) in enumerate(corners, start=1)]
    refs = "".join(f'<nd ref="{k}"/>' for k in (1, 2, 3, 4, 1))
    given = {"building": "yes", "height": "9", "roof:shape": "pyramidal", "roof:height": "4", "roof:colour": "red"}
    tags = "".join(f'<tag k="{key}" v="{value}"/>' for key, value in given.items())
    path = tmp_path / "a.osm"
    path.write_text(f'<osm version="0.6">{"".join(nodes)}<way id="5">{refs}{tags}</way></osm>')
    footprints, _ = read(path, crs=WGS84, bounds=(13.0, 51.9, 13.2, 52.1))
    assert shapes_of(footprints.forms) == ["pyramidal"]
    assert (footprints.given_height[0], footprints.forms[0, HEIGHT]) == (9.0, 4.0)


def test_codes_of_citygml(tmp_path: Path) -> None:
    """Beside codes, other columns are no tags of OSM: a `roof_height` may be absolute."""
    codes = ["1000", "1030.0", "3200", "1020", None]
    fields: dict[str, list[Any]] = {"roofType": codes, "roof_height": ["12.5"] * 5}
    footprints, notes = read(write_houses(tmp_path / "a.gpkg", fields))
    assert shapes_of(footprints.forms) == ["flat", "gabled", "hipped", "", ""]
    assert np.isnan(footprints.forms[:, HEIGHT]).all()
    assert [note.detail for note in notes if note.kind == "footprint-roof-forms-unknown"] == ["1 1020"]


def test_values_out_of_bounds_are_told_and_left_out(tmp_path: Path) -> None:
    fields: dict[str, list[Any]] = {
        "roof:shape": ["gabled", "hipped", "skillion", "gabled"],
        "roof:height": ["-1", "high", "2", "3"],
        "roof:angle": [None, "95", None, "30"],
        "roof:direction": [None, None, "up", None],
    }
    footprints, notes = read(write_houses(tmp_path / "a.gpkg", fields))
    assert np.isnan(footprints.forms[:2, 1:]).all()
    assert np.isnan(footprints.forms[2, DIRECTION])
    told = [(note.subject, note.detail) for note in notes if note.kind == "footprint-roof-unread"]
    assert told == [
        ("a", "roof:height '-1' is not 0.1 to 100 m"),
        ("b", "roof:height 'high' is not 0.1 to 100 m; roof:angle '95' is not 1 to 80 degrees"),
        ("c", "roof:direction 'up' is not 0 to 360 degrees, nor a word such as N, NNE or south-west"),
    ]


def test_an_attribute_that_is_asked_for(tmp_path: Path) -> None:
    path = write_houses(tmp_path / "a.gpkg", {"dak": ["gabled", "hipped"], "roof:shape": ["flat", "flat"]})
    assert shapes_of(read(path)[0].forms) == ["flat", "flat"]
    assert shapes_of(read(path, roof_attribute="dak")[0].forms) == ["gabled", "hipped"]
    with pytest.raises(ConfigError, match="no attribute 'roof'; it has: id, dak, roof:shape"):
        read(path, roof_attribute="roof")


def test_forms_tell_equal_footprints_apart_whatever_their_order(tmp_path: Path) -> None:
    shapes = [square(5, 5)] * 3
    kinds = np.array(["gabled", "flat", None], object)
    one = read(write(tmp_path / "one.gpkg", shapes, {"id": ["a"] * 3, "roof:shape": kinds}))[0]
    two = read(write(tmp_path / "two.gpkg", shapes, {"id": ["a"] * 3, "roof:shape": kinds[::-1]}))[0]
    assert shapes_of(one.forms) == shapes_of(two.forms)
    assert sorted(shapes_of(one.forms)) == ["", "flat", "gabled"]


def test_words() -> None:
    same = {"gable": "gabled", "GABLED ROOF": "gabled", "hip": "hipped", "half_hipped": "half-hipped"}
    same |= {"lean_to": "skillion", "1010": "skillion", "2100": "skillion", "1070": "pyramidal", "3400": "mansard"}
    assert {word: ROOF_SHAPES[shape_of(word)] for word in same} == same
    assert {shape_of(word) for word in ("dome", "round", "saltbox", "9.0", "1130", "nan", 1080)} == {NO_SHAPE}
    assert {shape_of(word) for word in (None, "", float("nan"))} == {NOTHING}
    assert [direction_of(word) for word in ("North", "north east", "wSw", 270, "359.5")] == [
        0,
        45,
        247.5,
        270,
        359.5,
    ]


def test_no_form_without_attributes(tmp_path: Path) -> None:
    footprints, notes = read(write_houses(tmp_path / "a.gpkg", {"name": ["x", "y"]}))
    assert footprints.forms.shape == (2, 6)
    assert np.isnan(footprints.forms).all()
    assert notes == ()
