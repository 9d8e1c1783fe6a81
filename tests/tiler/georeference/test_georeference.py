"""Where a region lies: CRS, units and axes of clouds and footprints, from headers alone."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest

from pipeline.data.errors import ConfigError, InputError
from tiler.config.config import Config
from tiler.georeference.frame import AS_IT_IS, Frame, box_to_file, box_to_region, to_region
from tiler.georeference.metric import find_metric
from tiler.georeference.operation import find_operation
from tiler.planning import cloud_crs
from tiler.planning.establish_georeference import FOOTPRINTS, Georeference, establish_georeference, find_inexact
from tiler.pointclouds.clouds import CloudHeader

RD = pyproj.CRS("EPSG:28992")
AMSTERDAM = (120600.0, 485900.0, 121200.0, 486500.0, -5.0, 60.0)
DEGREES = (4.88, 52.36, 4.89, 52.37, -5.0, 60.0)
NEW_YORK_FEET = (980000.0, 195000.0, 985000.0, 200000.0, 0.0, 300.0)
NEW_YORK = (585000.0, 4511000.0, 586000.0, 4512000.0, 0.0, 300.0)
FOOT = 1200 / 3937
NOWHERE = pyproj.CRS('LOCAL_CS["somewhere",UNIT["metre",1]]')


def cloud(
    crs: str | None,
    name: str = "a.laz",
    bounds: tuple[float, ...] = AMSTERDAM,
    n: int = 9,
    plan: float | None = None,
    height: float | None = None,
    unread: str = "",
) -> CloudHeader:
    box = (bounds[0], bounds[1], bounds[2], bounds[3], bounds[4], bounds[5])
    stated = None if crs is None else pyproj.CRS(crs)
    return CloudHeader(Path("in") / name, n, box, stated, plan, height, unread)


def establish(
    *clouds: CloudHeader, footprints: pyproj.CRS | str | None = None, extent: Any = None, **asked: Any
) -> Georeference:
    crs = pyproj.CRS(footprints) if isinstance(footprints, str) else footprints
    found = establish_georeference(Config(**asked), clouds, crs, extent)
    assert json.loads(json.dumps(found.record)) == found.record
    assert found.messages == [note.detail for note in found.notes]
    return found


def test_a_metric_cloud_is_taken_as_it_is() -> None:
    found = establish(cloud("EPSG:7415"), footprints=RD)
    assert (found.crs, found.messages, found.footprints) == (RD, [], AS_IT_IS)
    assert found.clouds[0].frame == AS_IT_IS
    assert found.clouds[0].bounds == AMSTERDAM


def test_clouds_come_before_footprints() -> None:
    found = establish(cloud("EPSG:7415"), cloud(None, "b.laz"), footprints="EPSG:32631")
    assert found.crs == RD
    assert found.messages[0] == "1 of 2 point clouds state no CRS; taken as EPSG:28992 of a.laz"
    assert found.messages[1].startswith("the footprints are reprojected from EPSG:32631 to EPSG:28992 by ")
    assert "accurate to 1 m" in found.messages[1]


def test_footprints_come_last() -> None:
    told = ["the point cloud states no CRS; using EPSG:28992 of the footprints"]
    assert establish(cloud(None), footprints=RD).messages == told
    empty = cloud("EPSG:32633", "empty.laz", n=0)
    found = establish(empty, cloud(None), footprints=RD)
    assert (found.crs, found.messages) == (RD, told)
    assert found.clouds[0] is empty


def test_nobody_knows() -> None:
    for footprints in (None, NOWHERE):
        with pytest.raises(InputError, match="give --crs"):
            establish(cloud(None), footprints=footprints)
    with pytest.raises(InputError, match="user-defined projection"):
        establish(cloud(None, unread="GeoTIFF key 3072 = 32767, a user-defined projection"))


def test_asked_must_be_a_projected_crs() -> None:
    for text in ("EPSG:0", "nonsense"):
        with pytest.raises(ConfigError, match="--crs"):
            establish(cloud(None), footprints=RD, crs=text)
    with pytest.raises(ConfigError, match="no place on Earth"):
        establish(cloud(None), crs=NOWHERE.to_wkt())
    with pytest.raises(InputError, match=r"--crs EPSG:4326 is geographic.*--crs EPSG:32631 --reproject"):
        establish(cloud(None, bounds=DEGREES), crs="EPSG:4326")
    with pytest.raises(InputError, match="axes to the north and west"):
        establish(cloud(None), crs="EPSG:2296")


def test_feet_in_plan_and_height_become_the_metric_crs_of_the_register() -> None:
    found = establish(cloud("EPSG:2263+6360", bounds=NEW_YORK_FEET))
    assert found.crs == pyproj.CRS("EPSG:32118")
    frame = found.clouds[0].frame
    assert (frame.east, frame.north, frame.height, frame.source) == ((0, FOOT), (1, FOOT), FOOT, "")
    np.testing.assert_allclose(found.clouds[0].bounds, np.array(NEW_YORK_FEET) * FOOT)
    assert "heights in US survey feet converted to metres" in " ".join(found.messages)
    assert "converted to EPSG:32118 in metres" in " ".join(found.messages)
    # the same place by PROJ
    forward = pyproj.Transformer.from_crs("EPSG:2263", "EPSG:32118", always_xy=True)
    np.testing.assert_allclose(forward.transform(*NEW_YORK_FEET[:2]), found.clouds[0].bounds[:2], atol=0.002)


def test_heights_alone_in_feet() -> None:
    for header in (cloud("EPSG:32618+6360", bounds=NEW_YORK), cloud("EPSG:32618", bounds=NEW_YORK, height=FOOT)):
        frame = establish(replace(header, height_unit=FOOT)).clouds[0].frame
        assert (frame.east, frame.height) == ((0, 1.0), FOOT)
        assert not frame.changes_plan
    found = establish(cloud(None, bounds=NEW_YORK), crs="EPSG:32618+6360")
    assert found.clouds[0].frame.height == FOOT
    assert found.clouds[0].bounds[5] == pytest.approx(300 * FOOT)


def test_heights_without_a_unit_are_in_that_of_plan_and_it_is_told() -> None:
    found = establish(cloud("EPSG:2263", bounds=NEW_YORK_FEET))
    assert found.clouds[0].frame.height == FOOT
    assert any("no record states the unit of heights; taken in US survey feet" in text for text in found.messages)
    metric = establish(cloud("EPSG:2263", bounds=NEW_YORK_FEET), height_unit="m")
    assert metric.clouds[0].frame.height == 1.0
    overruled = establish(cloud("EPSG:32618", bounds=NEW_YORK, height=FOOT), height_unit="m")
    assert overruled.clouds[0].frame.height == 1.0
    assert "states heights in US survey feet; taken in metres by --height-unit" in overruled.messages[0]


def test_a_unit_of_a_key_counts_beside_a_code_in_metres() -> None:
    feet = (656168.0, 918635.0, 656560.0, 919028.0, 0.0, 60.0)  # 200,000 and 280,000 m of EPSG:26949
    found = establish(cloud("EPSG:26949", bounds=feet, plan=FOOT, height=FOOT))
    assert found.crs == pyproj.CRS("EPSG:26949")
    assert found.clouds[0].frame.east == (0, FOOT)
    assert "GeoTIFF key 3076 says US survey feet" in found.messages[0]
    # a key that puts the cloud off its CRS is not believed
    wrong = establish(cloud("EPSG:28992", plan=1000.0))
    assert wrong.clouds[0].frame.east == (0, 1.0)
    assert "coordinates are taken in metres" in wrong.messages[0]


def test_web_mercator_is_never_meshed_as_metres() -> None:
    denver = (-11687000.0, 4827000.0, -11686000.0, 4828000.0, 0.0, 9.0)
    for asked in ({}, {"crs": "EPSG:3857"}):
        with pytest.raises(
            InputError, match=r"a metre on the ground is 1.30. m in plan.*--crs EPSG:32613 --reproject"
        ):
            establish(cloud("EPSG:3857", bounds=denver), **asked)
    found = establish(cloud("EPSG:3857", bounds=denver), reproject=True)
    assert found.crs == pyproj.CRS("EPSG:32613")
    assert found.record["scale of the projection"] == pytest.approx(1.0, abs=0.001)
    box = found.clouds[0].bounds
    assert box[2] - box[0] == pytest.approx(1000 / 1.304, rel=0.01)
    assert "reprojected from EPSG:3857 to EPSG:32613" in found.messages[0]


def test_a_cloud_in_degrees_is_reprojected_where_asked_for() -> None:
    with pytest.raises(InputError, match=r"is geographic.*--reproject --crs EPSG:32631.*pdal translate"):
        establish(cloud("EPSG:4326", bounds=DEGREES))
    with pytest.raises(InputError, match="--crs EPSG:28992"):
        establish(cloud("EPSG:4326", bounds=DEGREES), crs="EPSG:28992")
    with pytest.raises(InputError, match="look like degrees"):
        establish(cloud(None, bounds=DEGREES), footprints=RD)
    found = establish(cloud("EPSG:4326", bounds=DEGREES), crs="EPSG:28992", reproject=True)
    assert found.crs == RD
    assert 120000 < found.clouds[0].bounds[0] < 122000
    silent = establish(cloud(None, bounds=DEGREES), reproject=True)
    assert "taken as EPSG:4326" in silent.messages[0]
    with pytest.raises(InputError, match="no projected CRS"):
        establish(cloud("EPSG:4978"))


def test_axes_to_the_west_and_south_are_turned() -> None:
    krovak = (1042500.0, 742600.0, 1042700.0, 742800.0, 0.0, 9.0)  # southing, westing
    found = establish(cloud("EPSG:5513", bounds=krovak))
    assert found.crs == pyproj.CRS("EPSG:5514")
    assert found.clouds[0].bounds[:4] == (-742800.0, -1042700.0, -742600.0, -1042500.0)
    assert "axes to the west and south" in found.messages[0]
    cape = (53400.0, 3754700.0, 53600.0, 3754900.0, 0.0, 9.0)  # westing, southing
    found = establish(cloud("EPSG:2048", bounds=cape))
    assert found.clouds[0].bounds[:4] == (-53600.0, -3754900.0, -53400.0, -3754700.0)
    # a file that has the code, but eastings and northings all the same
    plain = establish(cloud("EPSG:5513", bounds=(-742800.0, -1042700.0, -742600.0, -1042500.0, 0.0, 9.0)))
    assert plain.clouds[0].frame == AS_IT_IS
    assert "the coordinates grow to the east and north" in plain.messages[0]
    # northing before easting
    swapped = establish(cloud("EPSG:28992", bounds=(485900.0, 120600.0, 486500.0, 121200.0, 0.0, 9.0)))
    assert swapped.clouds[0].bounds[:4] == AMSTERDAM[:4]
    assert "the northing comes first" in swapped.messages[0]
    with pytest.raises(InputError, match="axes to the north and west"):
        establish(cloud("EPSG:2296"))


def test_asked_overrules_what_is_stated_where_coordinates_are_plausible() -> None:
    found = establish(cloud("EPSG:4269"), crs="EPSG:28992")
    assert found.crs == RD
    assert "states EPSG:4269; taken as EPSG:28992 of --crs" in found.messages[0]
    assert establish(cloud("EPSG:32633"), crs="EPSG:28992").clouds[0].frame == AS_IT_IS
    with pytest.raises(InputError, match=r"states EPSG:28992, but --crs asks for EPSG:3006.*--reproject"):
        establish(cloud("EPSG:28992"), crs="EPSG:3006")
    moved = establish(cloud("EPSG:28992"), crs="EPSG:25831", reproject=True)
    assert 628000 < moved.clouds[0].bounds[0] < 629000
    assert list(moved.operations) == ["a.laz"]


def test_clouds_of_different_crss() -> None:
    both = (
        cloud("EPSG:28992"),
        cloud(None, "n.laz"),
        cloud("EPSG:32631", "b.laz", (628000.0, 5804000.0, 628100.0, 5804100.0, 0.0, 9.0)),
    )
    with pytest.raises(InputError, match=r"b\.laz: states EPSG:32631, others EPSG:28992; add --reproject"):
        establish(*both)
    found = establish(*both, reproject=True)
    assert found.crs == RD
    assert found.clouds[0].frame == found.clouds[1].frame == AS_IT_IS
    assert found.clouds[2].frame.source == "EPSG:32631"


def test_names_of_one_crs_are_one() -> None:
    hamburg = (565000.0, 5934000.0, 565100.0, 5934100.0, 0.0, 9.0)
    found = establish(
        cloud("EPSG:25832", bounds=hamburg), cloud("EPSG:32632", "b.laz", hamburg), footprints="EPSG:25832"
    )
    assert {header.frame for header in found.clouds} == {AS_IT_IS}
    assert "less than 0.1 m" in found.messages[0]
    assert found.operations == {}
    # of two spellings, the one of the register is the region's
    finland = (385000.0, 6671000.0, 385100.0, 6671100.0, 0.0, 9.0)
    fields = pyproj.CRS("EPSG:3067").to_json_dict()
    fields["name"], fields["base_crs"]["name"] = "EUREF-FIN / TM35FIN(E,N)", "EUREF-FIN"
    fields["base_crs"].pop("datum_ensemble")
    ellipsoid = {"name": "GRS 1980", "semi_major_axis": 6378137, "inverse_flattening": 298.257222101}
    fields["base_crs"]["datum"] = {"type": "GeodeticReferenceFrame", "name": "EUREF-FIN", "ellipsoid": ellipsoid}
    del fields["id"], fields["base_crs"]["id"]
    renamed = pyproj.CRS.from_json_dict(fields).to_wkt()
    assert pyproj.CRS(renamed).to_epsg() is None
    found = establish(cloud(renamed, bounds=finland), footprints="EPSG:3067")
    assert found.crs.to_epsg() == 3067
    assert found.footprints == AS_IT_IS


def test_clouds_that_state_the_same_are_looked_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[pyproj.CRS] = []

    def count(crs: pyproj.CRS) -> Any:
        seen.append(crs)
        return find_metric(crs)

    monkeypatch.setattr(cloud_crs, "find_metric", count)
    one = cloud("EPSG:28992")
    establish(*(replace(one, path=Path(f"{k}.laz")) for k in range(50)))
    assert len(seen) == 1


def test_footprints_that_are_reprojected_tell_operation_accuracy_and_grid() -> None:
    penzance = (147000.0, 30400.0, 147200.0, 30600.0, 0.0, 9.0)
    found = establish(cloud("EPSG:27700", bounds=penzance), footprints="EPSG:4326")
    (operation,) = found.operations.values()
    assert operation.accuracy == 2.0
    assert operation.missing_grids == ("uk_os_OSTN15_NTv2_OSGBtoETRS.tif",)
    (note,) = find_inexact(found, 1.0)
    assert (note.kind, note.subject) == ("crs-accuracy", FOOTPRINTS)
    assert "pyproj sync --file uk_os_OSTN15_NTv2_OSGBtoETRS.tif" in note.detail
    assert find_inexact(found, 2.0) == []
    exact = establish(
        cloud("EPSG:32631", bounds=(628000.0, 5804000.0, 628100.0, 5804100.0, 0.0, 9.0)), footprints="EPSG:4326"
    )
    assert exact.operations[FOOTPRINTS].accuracy == 0.0


def test_an_unknown_accuracy_is_no_good_one() -> None:
    operation = find_operation(
        pyproj.CRS("EPSG:4269"), pyproj.CRS("EPSG:6339"), (550000.0, 4180000.0, 551000.0, 4181000.0)
    )
    assert operation.accuracy is None
    assert operation.is_worse_than(1000.0)
    assert "accuracy unknown" in operation.describe()


def test_footprints_without_a_crs_are_where_the_cloud_is() -> None:
    found = establish(cloud("EPSG:2263+6360", bounds=NEW_YORK_FEET), extent=NEW_YORK_FEET[:4])
    assert found.footprints == Frame((0, FOOT), (1, FOOT))
    assert "the footprints state no CRS; taken as EPSG:2263" in found.messages[-1]
    metric = tuple(value * FOOT for value in NEW_YORK_FEET[:4])
    assert establish(cloud("EPSG:2263+6360", bounds=NEW_YORK_FEET), extent=metric).footprints == AS_IT_IS


def test_a_crs_that_proj_cannot_transform_is_refused() -> None:
    with pytest.raises(InputError, match=r"ESRI:102470, or PROJ has no transformation of it"):
        establish(cloud("ESRI:102470", bounds=(100000.0, -2500000.0, 100100.0, -2499900.0, 0.0, 9.0)))


def test_a_cloud_off_its_crs_is_told() -> None:
    far = cloud(None, bounds=(318000.0, 6399000.0, 319000.0, 6400000.0, 0.0, 9.0))
    assert len(establish(far, crs="EPSG:3006").messages) == 1
    with pytest.raises(InputError, match="outside the area of use of EPSG:28992"):
        establish(far, crs="EPSG:28992")
    found = establish(cloud("EPSG:3006", bounds=(318000.0, 4399000.0, 319000.0, 4400000.0, 0.0, 9.0)))
    assert "outside the area of use of EPSG:3006" in found.messages[0]


@pytest.mark.parametrize(
    ("crs", "found"),
    [
        ("EPSG:2248", "EPSG:26985"),  # false easting rounded to a thousandth of a foot
        ("EPSG:2868", "EPSG:2762"),  # international feet
        ("ESRI:102645", "EPSG:26945"),
        ("EPSG:3006", "EPSG:3006"),  # northing first in the register, easting first in files
        ("EPSG:2193", "EPSG:2193"),
        ("EPSG:3031", "EPSG:3031"),  # around a pole
        ("EPSG:2065", "EPSG:5221"),
    ],
)
def test_the_metric_crs_of_a_projected_one(crs: str, found: str) -> None:
    metric = find_metric(pyproj.CRS(crs))
    assert metric is not None
    assert ":".join(metric.crs.to_authority()) == found


def test_a_projection_that_no_register_has_in_metres_is_made() -> None:
    metric = find_metric(pyproj.CRS("EPSG:24370"))  # Indian yards
    assert metric is not None
    assert metric.crs.axis_info[0].unit_conversion_factor == 1.0
    turned = find_metric(pyproj.CRS("EPSG:22275"))  # Cape / Lo15: westing, southing
    assert turned is not None
    assert [axis.direction for axis in turned.crs.axis_info] == ["east", "north"]
    assert find_metric(pyproj.CRS("EPSG:2296")) is None  # northing, westing


def test_boxes_go_there_and_back() -> None:
    turned = Frame((1, -1.0), (0, -1.0))
    box = (1042500.0, 742600.0, 1042700.0, 742800.0)
    assert box_to_file(turned, box_to_region(turned, box)) == box
    moved = Frame(source="EPSG:3857", target="EPSG:28992")
    mercator = (542000.0, 6867000.0, 542300.0, 6867300.0)
    there = box_to_file(moved, box_to_region(moved, mercator))
    assert there[0] <= mercator[0] < mercator[2] <= there[2]
    assert there[1] <= mercator[1] < mercator[3] <= there[3]
    with pytest.raises(InputError, match="has no place"):
        box_to_region(Frame(source="EPSG:32631", target="EPSG:28992"), (1e8, 1e8, 2e8, 2e8))
    assert to_region(AS_IT_IS, np.array([[1.0, 2.0]])).tolist() == [[1.0, 2.0]]


@pytest.mark.parametrize("crs", [None, "EPSG:28992"])
def test_coordinates_like_degrees_are_told_whatever_is_stated_or_asked_for(crs: str | None) -> None:
    for asked in ({"crs": "EPSG:25831"}, {}):
        with pytest.raises(InputError, match="look like degrees, where cells need metres; give --reproject --crs"):
            establish(cloud(crs, bounds=DEGREES), footprints=RD, **asked)
    found = establish(cloud(crs, bounds=DEGREES), footprints=RD, crs="EPSG:25831", reproject=True)
    assert found.crs == pyproj.CRS("EPSG:25831")
    assert 627_000 < found.clouds[0].bounds[0] < found.clouds[0].bounds[2] < 629_000


def test_metres_below_a_geographic_crs_are_no_degrees() -> None:
    for asked in ({}, {"reproject": True}):
        with pytest.raises(
            InputError, match=r"geographic \(degrees\), but .* are none; give the CRS .* with --crs"
        ):
            establish(cloud("EPSG:4269", bounds=AMSTERDAM), footprints=RD, **asked)
    assert establish(cloud("EPSG:4269", bounds=AMSTERDAM), footprints=RD, crs="EPSG:28992").crs == RD


def test_one_cloud_in_degrees_among_others_is_told() -> None:
    with pytest.raises(
        InputError, match=r"b\.laz: states no CRS, and its coordinates, 4\.88 .* look like degrees"
    ):
        establish(cloud("EPSG:28992"), cloud(None, "b.laz", DEGREES))


def test_the_register_is_asked_for_a_crs_of_the_place() -> None:
    """Zone 35 of ETRS89 in Bulgaria has the parameters of TM35FIN in Finland."""
    base = (
        'GEOGCS["EUREF-FIN",DATUM["EUREF-FIN",SPHEROID["GRS 1980",6378137,298.257222101]],'
        'PRIMEM["Greenwich",0],UNIT["degree",0.0174532925199433]]'
    )
    wkt = (
        f'PROJCS["EUREF-FIN / TM35FIN(E,N)",{base},PROJECTION["Transverse_Mercator"],'
        'PARAMETER["latitude_of_origin",0],PARAMETER["central_meridian",27],PARAMETER["scale_factor",0.9996],'
        'PARAMETER["false_easting",500000],PARAMETER["false_northing",0],UNIT["metre",1],'
        'AXIS["Easting",EAST],AXIS["Northing",NORTH]]'
    )
    helsinki = (385_000.0, 6_671_000.0, 386_000.0, 6_672_000.0, 0.0, 60.0)
    found = establish(cloud(wkt, bounds=helsinki), footprints="EPSG:4326")
    area = found.crs.area_of_use
    assert found.crs.to_epsg() is not None
    assert area is not None
    assert area.north > 60
    assert area.west < 25 < area.east


@pytest.mark.parametrize(
    ("crs", "box", "extent", "words"),
    [
        # Krovak: a CRS to the south and west, coordinates to the east and north
        ("EPSG:5513", (-743_000.0, -1_043_000.0, -742_000.0, -1_042_000.0), None, "but the coordinates grow"),
        # the northing first, in clouds and footprints
        ("EPSG:3006", (6_651_000.0, 500_000.0, 6_652_000.0, 501_000.0), None, "are those of the point clouds"),
        # the same, where the clouds are as their CRS says
        (
            "EPSG:5513",
            (1_042_000.0, 742_000.0, 1_043_000.0, 743_000.0),
            (-743_000.0, -1_043_000.0, -742_000.0, -1_042_000.0),
            "but the coordinates grow",
        ),
    ],
)
def test_footprints_too_have_the_axes_that_their_coordinates_show(
    crs: str, box: tuple[float, ...], extent: tuple[float, ...] | None, words: str
) -> None:
    extent = extent or box
    found = establish(cloud(crs, bounds=(*box, 0.0, 60.0)), footprints=crs, extent=extent)
    assert words in found.messages[-1]
    region = found.clouds[0].bounds[:4]
    assert box_to_region(found.footprints, (extent[0], extent[1], extent[2], extent[3])) == region


def test_footprints_alone_with_the_northing_first_are_left_as_they_are() -> None:
    extent = (485_900.0, 120_600.0, 486_500.0, 121_200.0)
    assert establish(cloud("EPSG:28992"), footprints=RD, extent=extent).footprints == AS_IT_IS
