"""The region's CRS: who decides, what is refused, and the command that mends it."""

import copy
from dataclasses import replace
from pathlib import Path

import pyproj
import pytest

from pipeline.errors import ConfigError, InputError
from tiler.clouds import CloudHeader
from tiler.crs import crs_name, horizontal_crs, parse_crs, resolve_crs, same_crs, utm_crs

RD = pyproj.CRS("EPSG:28992")
AMSTERDAM = (120600.0, 485900.0, 121200.0, 486500.0, -5.0, 60.0)
DEGREES = (4.88, 52.36, 4.89, 52.37, -5.0, 60.0)
NEW_YORK_FEET = (980000.0, 195000.0, 985000.0, 200000.0, 0.0, 300.0)


def cloud(crs: str | None, name: str = "a.laz", bounds: tuple[float, ...] = AMSTERDAM, n: int = 9) -> CloudHeader:
    box = (bounds[0], bounds[1], bounds[2], bounds[3], bounds[4], bounds[5])
    return CloudHeader(Path("in") / name, n, box, None if crs is None else pyproj.CRS(crs))


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


def test_asked_comes_first() -> None:
    crs, told = resolve_crs("EPSG:28992", [cloud(None)], pyproj.CRS("EPSG:4326"))
    assert crs == RD
    assert told == [
        "the point cloud states no CRS; using EPSG:28992 of --crs",
        "the footprints are reprojected from EPSG:4326 to EPSG:28992",
    ]
    assert resolve_crs("EPSG:7415", [cloud("EPSG:28992")], RD) == (RD, [])


def test_clouds_come_before_footprints() -> None:
    crs, told = resolve_crs(None, [cloud("EPSG:7415"), cloud(None, "b.laz")], pyproj.CRS("EPSG:32631"))
    assert crs == RD
    assert told == [
        "1 of 2 point clouds state no CRS; taken as EPSG:28992 of a.laz",
        "the footprints are reprojected from EPSG:32631 to EPSG:28992",
    ]


def test_footprints_come_last() -> None:
    told = ["the point cloud states no CRS; using EPSG:28992 of the footprints"]
    assert resolve_crs(None, [cloud(None)], RD) == (RD, told)
    empty = cloud("EPSG:32633", "empty.laz", n=0)
    assert resolve_crs(None, [empty, cloud(None)], RD) == (RD, told)


def test_nobody_knows() -> None:
    with pytest.raises(InputError, match="give --crs"):
        resolve_crs(None, [cloud(None)], None)
    with pytest.raises(InputError, match="give --crs"):
        resolve_crs(None, [cloud(None)], pyproj.CRS('LOCAL_CS["somewhere",UNIT["metre",1]]'))


@pytest.mark.parametrize("text", ["EPSG:0", "nonsense", ""])
def test_asked_must_be_a_crs(text: str) -> None:
    with pytest.raises(ConfigError, match="--crs"):
        resolve_crs(text, [cloud(None)], RD)
    with pytest.raises(ConfigError, match="--crs"):
        parse_crs(text)


def test_asked_must_be_somewhere() -> None:
    with pytest.raises(ConfigError, match="no place on Earth"):
        resolve_crs('LOCAL_CS["somewhere",UNIT["metre",1]]', [cloud(None)], RD)


def test_contradictions_name_both_sides() -> None:
    with pytest.raises(InputError, match=r"in/a\.laz: states EPSG:28992, but --crs asks for EPSG:32631"):
        resolve_crs("EPSG:32631", [cloud("EPSG:7415")], None)
    both = [cloud("EPSG:28992"), cloud(None, "n.laz"), cloud("EPSG:32631", "b.laz")]
    with pytest.raises(
        InputError, match=r"in/b\.laz: states EPSG:32631, but in/a\.laz states EPSG:28992"
    ) as caught:
        resolve_crs(None, both, None)
    assert "reprojection --filters.reprojection.out_srs=EPSG:28992" in str(caught.value)


def test_clouds_that_share_a_crs_are_compared_once(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []

    def count(one: pyproj.CRS, other: pyproj.CRS) -> bool:
        seen.append(1)
        return same_crs(one, other)

    monkeypatch.setattr("tiler.crs.same_crs", count)
    first, other = cloud("EPSG:28992"), cloud("EPSG:28992+5709", "b.laz")
    clouds = [replace(header, path=Path(f"{k}.laz")) for k in range(20) for header in (first, other)]
    crs, said = resolve_crs(None, clouds, None)
    assert (crs, said) == (pyproj.CRS("EPSG:28992"), [])
    assert len(seen) <= 2
    strange = cloud("EPSG:32631", "z.laz")
    with pytest.raises(InputError, match=r"z.laz: states EPSG:32631, but .*0.laz states EPSG:28992"):
        resolve_crs(None, [*clouds, strange], None)


def test_a_geographic_cloud_is_refused_with_the_command() -> None:
    with pytest.raises(InputError, match="is geographic") as caught:
        resolve_crs(None, [cloud("EPSG:4326", bounds=DEGREES)], None)
    assert str(caught.value).endswith(
        'pdal translate "in/a.laz" "in/a_metric.laz" reprojection --filters.reprojection.in_srs=EPSG:4326 '
        "--filters.reprojection.out_srs=EPSG:32631 --writers.las.a_srs=EPSG:32631"
    )
    with pytest.raises(InputError, match="out_srs=EPSG:28992"):
        resolve_crs("EPSG:28992", [cloud("EPSG:4326", bounds=DEGREES)], None)


def test_feet_are_refused_with_the_command() -> None:
    with pytest.raises(InputError, match="easting in US survey foot") as caught:
        resolve_crs(None, [cloud("EPSG:2263", bounds=NEW_YORK_FEET)], None)
    assert "--filters.reprojection.out_srs=EPSG:32618" in str(caught.value)
    assert "assign" not in str(caught.value)
    with pytest.raises(InputError, match="easting in US survey foot") as caught:
        resolve_crs(None, [cloud("EPSG:2263+6360", bounds=NEW_YORK_FEET)], None)
    assert "reprojection assign --filters.reprojection.in_srs=EPSG:2263 " in str(caught.value)
    assert '"Z = Z * 0.3048006096' in str(caught.value)


def test_heights_in_feet_are_refused_with_the_command() -> None:
    for asked, stated in ((None, "EPSG:32618+6360"), ("EPSG:32618+6360", None)):
        with pytest.raises(InputError, match="height in US survey foot") as caught:
            resolve_crs(asked, [cloud(stated, bounds=(585000.0, 4511000.0, 586000.0, 4512000.0, 0.0, 9.0))], None)
        assert "a_metric.laz" in str(caught.value)
        assert "assign --filters.assign.value" in str(caught.value)
        assert str(caught.value).endswith("--writers.las.a_srs=EPSG:32618")
        assert "reprojection" not in str(caught.value)


def test_geocentric_is_refused() -> None:
    with pytest.raises(InputError, match="no projected CRS"):
        resolve_crs(None, [cloud("EPSG:4978")], None)


def test_asked_degrees_are_refused() -> None:
    with pytest.raises(InputError, match="--crs: the CRS EPSG:4326 is geographic") as caught:
        resolve_crs("EPSG:4326", [cloud(None, bounds=DEGREES)], None)
    assert "out_srs=EPSG:32631" in str(caught.value)


def test_degrees_of_footprints_are_never_taken_for_the_cloud() -> None:
    with pytest.raises(InputError, match="the footprints: the CRS EPSG:4326 is geographic") as caught:
        resolve_crs(None, [cloud(None)], pyproj.CRS("EPSG:4326"))
    assert "ogr2ogr -t_srs" in str(caught.value)
    assert "pdal" not in str(caught.value)  # these coordinates are no degrees


def test_a_cloud_far_from_its_crs_is_told() -> None:
    far = cloud(None, bounds=(318000.0, 6399000.0, 319000.0, 6400000.0, 0.0, 9.0))
    assert "outside the area of use of EPSG:28992" in resolve_crs("EPSG:28992", [cloud(None), far], None)[1][-1]
    assert len(resolve_crs("EPSG:3006", [far], None)[1]) == 1


def test_utm_zones_at_the_edges() -> None:
    wgs84 = pyproj.CRS("EPSG:4326")
    assert utm_crs((-180, 10, -180, 10), wgs84) == "EPSG:32601"
    assert utm_crs((180, -10, 180, -10), wgs84) == "EPSG:32760"
    assert utm_crs((200, 10, 300, 10), wgs84) is None
    assert utm_crs(AMSTERDAM, RD) == "EPSG:32631"


def test_an_area_across_the_date_line() -> None:
    crs = pyproj.CRS("EPSG:3851")  # New Zealand's continental shelf, 160 degrees east to 171 west
    assert crs.area_of_use is not None
    assert crs.area_of_use.east < 0 < crs.area_of_use.west
    forward = pyproj.Transformer.from_crs("EPSG:4326", crs, always_xy=True)
    for lon, lat, told in ((-176.5, -44.0, 1), (174.8, -41.3, 1), (-150.0, -44.0, 2), (140.0, -44.0, 2)):
        x, y = forward.transform(lon, lat)
        where = cloud(None, bounds=(x, y, x + 10, y + 10, 0.0, 9.0))
        assert len(resolve_crs("EPSG:3851", [where], None)[1]) == told
