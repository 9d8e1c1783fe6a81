"""Coordinate reference systems: compared, named, and where they have a place."""

import copy
import math

import pyproj
import pytest

from pipeline.data.errors import ConfigError
from tiler.georeference.crs import (
    crs_name,
    horizontal_crs,
    is_on_its_place,
    is_one,
    move_between,
    parse_crs,
    same_crs,
    scale_of,
    utm_crs,
)

RD = pyproj.CRS("EPSG:28992")
AMSTERDAM = (120600.0, 485900.0, 121200.0, 486500.0, -5.0, 60.0)


@pytest.mark.parametrize("form", ["WKT1_ESRI", "WKT1_GDAL", "WKT2_2019"])
def test_one_crs_in_many_spellings_is_one(form: str) -> None:
    written = pyproj.CRS(RD.to_wkt(form))
    assert same_crs(RD, written)
    assert crs_name(horizontal_crs(written) or written) == "EPSG:28992"


def test_the_horizontal_part() -> None:
    for text in ("EPSG:28992", "EPSG:7415", "EPSG:28992+5773"):
        assert horizontal_crs(pyproj.CRS(text)) == RD
    bound = pyproj.CRS(
        RD.to_wkt("WKT1_GDAL").replace(',AUTHORITY["EPSG","6289"]]', ",TOWGS84[565,50,465,0,0,0,0]]")
    )
    assert bound.is_bound
    assert horizontal_crs(bound) == RD
    assert horizontal_crs(pyproj.CRS("EPSG:32631").to_3d()) == pyproj.CRS("EPSG:32631")
    assert horizontal_crs(pyproj.CRS('LOCAL_CS["somewhere",UNIT["metre",1]]')) is None
    assert horizontal_crs(None) is None


def test_axis_order_does_not_matter_but_the_projection_does() -> None:
    sweden = pyproj.CRS("EPSG:3006")  # northing first in the register, easting first in ESRI's spelling
    for form in ("WKT1_ESRI", "WKT1_GDAL"):
        written = pyproj.CRS(sweden.to_wkt(form))
        assert not sweden.equals(written, ignore_axis_order=True)
        assert same_crs(sweden, written)
        assert horizontal_crs(written) == sweden
    assert not same_crs(RD, pyproj.CRS("EPSG:28991"))
    assert not same_crs(pyproj.CRS("EPSG:32631"), pyproj.CRS("EPSG:25831"))


def test_axis_order_does_not_matter_outside_the_register_either() -> None:
    ours = pyproj.CRS("EPSG:3006").to_json_dict()
    del ours["id"]
    ours["conversion"]["parameters"][3]["value"] = 123456.0  # an own false easting
    theirs = copy.deepcopy(ours)
    theirs["coordinate_system"]["axis"].reverse()
    one, other = (pyproj.CRS.from_json_dict(fields) for fields in (ours, theirs))
    assert horizontal_crs(one) is not None
    assert same_crs(one, other)
    assert not same_crs(one, pyproj.CRS("EPSG:3006"))


def test_utm_zones_at_the_edges() -> None:
    wgs84 = pyproj.CRS("EPSG:4326")
    assert utm_crs((-180, 10, -180, 10), wgs84) == "EPSG:32601"
    assert utm_crs((180, -10, 180, -10), wgs84) == "EPSG:32760"
    assert utm_crs((200, 10, 300, 10), wgs84) is None
    assert utm_crs(AMSTERDAM, RD) == "EPSG:32631"


@pytest.mark.parametrize("text", ["EPSG:0", "nonsense", ""])
def test_what_is_no_crs_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="--crs"):
        parse_crs(text)


def test_an_area_across_the_date_line() -> None:
    crs = pyproj.CRS("EPSG:3851")  # New Zealand's continental shelf, 160 degrees east to 171 west
    assert crs.area_of_use is not None
    assert crs.area_of_use.east < 0 < crs.area_of_use.west
    forward = pyproj.Transformer.from_crs("EPSG:4326", crs, always_xy=True)
    for lon, lat, there in (
        (-176.5, -44.0, True),
        (174.8, -41.3, True),
        (-150.0, -44.0, False),
        (140.0, -44.0, False),
    ):
        x, y = forward.transform(lon, lat)
        assert is_on_its_place((x, y, x + 10, y + 10), crs) is there


def test_names_of_one_crs_are_told_by_what_the_transformation_does() -> None:
    box = (565000.0, 5934000.0, 566000.0, 5935000.0)
    assert not same_crs(pyproj.CRS("EPSG:25832"), pyproj.CRS("EPSG:32632"))
    assert is_one(pyproj.CRS("EPSG:25832"), pyproj.CRS("EPSG:32632"), box)
    assert not is_one(pyproj.CRS("EPSG:25832"), pyproj.CRS("EPSG:25833"), box)
    australia = (500000.0, 6000000.0, 501000.0, 6001000.0)
    moved = move_between(pyproj.CRS("EPSG:28354"), pyproj.CRS("EPSG:7854"), australia)
    assert 1.0 < moved < 2.5  # GDA94 to GDA2020
    assert move_between(pyproj.CRS("EPSG:4326"), RD, AMSTERDAM) == math.inf


@pytest.mark.parametrize(
    ("crs", "box", "scale"),
    [
        ("EPSG:28992", AMSTERDAM, 1.000),
        ("EPSG:32631", (500000.0, 5800000.0, 500100.0, 5800100.0), 0.9996),
        ("EPSG:3857", (545000.0, 6867000.0, 545100.0, 6867100.0), 1.638),
        ("EPSG:3857", (-11687000.0, 4827000.0, -11686900.0, 4827100.0), 1.304),
    ],
)
def test_the_scale_of_a_projection(crs: str, box: tuple[float, ...], scale: float) -> None:
    assert scale_of(box, pyproj.CRS(crs)) == pytest.approx(scale, abs=0.002)
