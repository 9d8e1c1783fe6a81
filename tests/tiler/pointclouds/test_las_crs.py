"""What LAS headers state of CRS and units, and chunks in the region's CRS."""

import struct
from typing import Any

import laspy
import numpy as np
import pyproj
import pytest
from laspy.vlrs.known import GeoDoubleParamsVlr, GeoKeyDirectoryVlr, WktCoordinateSystemVlr

from tiler.georeference.frame import Frame
from tiler.georeference.las_crs import LasCrs, read_las_crs
from tiler.pointclouds.las_chunks import PointChunk, coordinates_of, place_chunk, take_chunk

FOOT = 1200 / 3937


def header(keys: dict[int, int], *, wkt: str | None = None, doubles: tuple[float, ...] = ()) -> laspy.LasHeader:
    made = laspy.LasHeader(point_format=6, version="1.4")
    if wkt is not None:
        made.vlrs.append(WktCoordinateSystemVlr(wkt))
    if keys:
        record = GeoKeyDirectoryVlr()
        rows = [(key, 34736 if key == 3077 else 0, 1, value) for key, value in keys.items()]
        record.parse_record_data(struct.pack(f"<{4 + 4 * len(rows)}H", 1, 1, 0, len(rows), *sum(rows, ())))
        made.vlrs.append(record)
    if doubles:
        values = GeoDoubleParamsVlr()
        values.parse_record_data(struct.pack(f"<{len(doubles)}d", *doubles))
        made.vlrs.append(values)
    return made


def epsg(found: LasCrs) -> int | None:
    return None if found.crs is None else found.crs.to_epsg()


@pytest.mark.parametrize(
    ("keys", "code", "plan", "height"),
    [
        ({3072: 26910}, 26910, None, None),
        ({3072: 26910, 4096: 6360}, 26910, None, FOOT),
        ({3072: 26910, 4096: 8228}, 26910, None, 0.3048),
        ({3072: 26910, 4096: 5703}, 26910, None, 1.0),
        ({3072: 26910, 4096: 5103}, 26910, None, None),  # a datum, as older files have it
        ({3072: 26910, 4096: 5703, 4099: 9003}, 26910, None, FOOT),
        ({3072: 26910, 3076: 9001, 4099: 9002}, 26910, 1.0, 0.3048),
        ({3072: 26949, 3076: 9003}, 26949, FOOT, None),
        ({1024: 1, 2048: 4269, 3072: 32767, 3076: 9001}, None, 1.0, None),
        ({1024: 2, 2048: 4326}, 4326, None, None),
        ({1024: 1, 2048: 4326}, None, None, None),  # a projected CRS that is not stated
        ({}, None, None, None),
    ],
)
def test_keys(keys: dict[int, int], code: int | None, plan: float | None, height: float | None) -> None:
    found = read_las_crs(header(keys))
    assert (epsg(found), found.plan_unit, found.height_unit) == (code, plan, height)


def test_what_is_not_understood_is_told() -> None:
    assert "user-defined projection" in read_las_crs(header({3072: 32767})).unread
    assert "no CRS of the EPSG register" in read_las_crs(header({3072: 4})).unread
    assert "PROJ cannot parse" in read_las_crs(header({}, wkt="PROJCS[broken")).unread
    assert read_las_crs(header({3072: 26910})).unread == ""


def test_a_unit_of_its_own() -> None:
    found = read_las_crs(header({3072: 26910, 3076: 32767, 3077: 0}, doubles=(0.5,)))
    assert found.plan_unit == 0.5


def test_wkt_comes_before_keys_and_keys_complete_it() -> None:
    utm = pyproj.CRS("EPSG:26910").to_wkt()
    found = read_las_crs(header({3072: 28992, 3076: 9003, 4099: 9003}, wkt=utm))
    assert (epsg(found), found.plan_unit, found.height_unit) == (26910, None, FOOT)
    compound = pyproj.CRS("EPSG:2227+6360").to_wkt()
    assert read_las_crs(header({}, wkt=compound)).height_unit == FOOT
    esri = ",".join(pyproj.CRS(code).to_wkt("WKT1_ESRI") for code in ("EPSG:2227", "EPSG:6360"))
    assert read_las_crs(header({}, wkt=esri)).height_unit == FOOT
    sound = read_las_crs(header({3072: 28992}, wkt="PROJCS[broken"))
    assert epsg(sound) == 28992


def records(point_format: int, **fields: Any) -> laspy.ScaleAwarePointRecord:
    made = laspy.LasHeader(point_format=point_format, version="1.4" if point_format > 5 else "1.2")
    made.scales, made.offsets = np.array([0.01, 0.01, 0.1]), np.array([1000.0, 2000.0, 5.0])
    points = laspy.ScaleAwarePointRecord.zeros(3, header=made)
    points.x, points.y, points.z = [1001.0, 1002.5, 1000.0], [2001.0, 2000.0, 2003.25], [5.0, 6.0, 7.0]
    for name, values in fields.items():
        points[name] = np.array(values)
    return points


def test_model_key_points_are_ground_in_the_first_point_formats_alone() -> None:
    old = take_chunk(records(1, classification=[8, 2, 6]))
    assert (old.classification.tolist(), old.n_key_points) == ([2, 2, 6], 1)
    new = take_chunk(records(6, classification=[8, 2, 6]))
    assert (new.classification.tolist(), new.n_key_points) == ([8, 2, 6], 0)


def test_units_and_axes_change_exactly() -> None:
    chunk = take_chunk(records(6))
    xyz = coordinates_of(chunk)
    feet = place_chunk(chunk, Frame((0, FOOT), (1, FOOT), FOOT), (0.0, 0.0))
    np.testing.assert_allclose(coordinates_of(feet), xyz * FOOT, rtol=1e-15)
    assert feet.x is chunk.x
    turned = place_chunk(chunk, Frame((1, -1.0), (0, -1.0)), (0.0, 0.0))
    np.testing.assert_array_equal(coordinates_of(turned), np.column_stack([-xyz[:, 1], -xyz[:, 0], xyz[:, 2]]))


def test_reprojected_points_are_rounded_to_millimetres_and_lost_ones_withheld() -> None:
    x = np.array([545000, 545100, 2**31 - 1], np.int32)
    y = np.array([6867000, 6867100, 2**31 - 1], np.int32)
    nothing = np.zeros(3, np.uint8)
    chunk = PointChunk(x, y, x, (1.0, 1.0, 1.0), (0.0, 0.0, 0.0), nothing, nothing != 0)
    placed = place_chunk(chunk, Frame(source="EPSG:3857", target="EPSG:32631"), (628000.0, 5804000.0))
    assert placed.withheld.tolist() == [False, False, True]
    expected = pyproj.Transformer.from_crs("EPSG:3857", "EPSG:32631", always_xy=True).transform(x[:2], y[:2])
    np.testing.assert_allclose(coordinates_of(placed)[:2, :2].T, expected, atol=0.00051)
