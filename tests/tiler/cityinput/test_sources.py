"""Names of CRSs, the order of axes, and kinds of files."""

from pathlib import Path

import pyproj
import pytest

from tests.tiler.cityinput.models import house_gml, house_json, write_gml, write_json
from tiler.cityinput.crs_names import NamedCrs, read_crs_name
from tiler.cityinput.sources import choose_axes, kind_of, read_model_header


@pytest.mark.parametrize(
    ("text", "plan", "height", "registered"),
    [
        ("urn:ogc:def:crs:EPSG::25833", 25833, None, True),
        ("http://www.opengis.net/def/crs/EPSG/0/7415", 28992, 5709, True),
        ("https://www.opengis.net/def/crs/EPSG/0/2056", 2056, None, True),
        ("http://www.opengis.net/def/crs/EPSG/6.12/3068", 3068, None, True),
        ("urn:ogc:def:crs,crs:EPSG:6.12:3068,crs:EPSG:6.12:5783", 3068, 5783, True),
        ("EPSG:25832", 25832, None, False),
        ("EPSG:25832+7837", 25832, 7837, False),
        ("http://www.opengis.net/gml/srs/epsg.xml#25832", 25832, None, False),
        ("urn:adv:crs:ETRS89_UTM32*DE_DHHN2016_NH", 25832, 7837, False),
        ("urn:adv:crs:ETRS89_UTM33*GCG2016", 25833, None, False),
        ("urn:adv:crs:DE_DHDN_3GK3*DE_DHHN92_NH", 31467, 5783, False),
        ("CH1903", 21781, None, False),
    ],
)
def test_names_of_crs(text: str, plan: int, height: int | None, registered: bool) -> None:
    found = read_crs_name(text)
    assert found.crs is not None
    codes = [part.to_epsg() for part in found.crs.sub_crs_list] if found.crs.is_compound else [found.crs.to_epsg()]
    assert codes == [plan] if height is None else codes == [plan, height]
    assert found.registered_axes is registered


def test_a_name_that_means_nothing_has_no_crs() -> None:
    assert read_crs_name("Lokales System").crs is None
    assert read_crs_name("").crs is None


VIENNA = NamedCrs(pyproj.CRS("EPSG:31256"), True, "urn:ogc:def:crs:EPSG::31256")
RD = NamedCrs(pyproj.CRS("EPSG:28992"), True, "")
JAPAN = NamedCrs(pyproj.CRS("EPSG:6697"), True, "")
NOBODY = NamedCrs(None, False, "")
UTM = (500_000.0, 5_000_000.0, 500_100.0, 5_000_100.0)


@pytest.mark.parametrize(
    ("name", "box", "sense", "asked", "swapped"),
    [
        (VIENNA, (3289.0, 340452.0, 3361.0, 340525.0), (0, 0), "", False),  # against the letter of the URN
        (VIENNA, (340452.0, 3289.0, 340525.0, 3361.0), (0, 0), "", True),
        (VIENNA, (3289.0, 340452.0, 3361.0, 340525.0), (0, 0), "yx", True),  # whoever asks decides
        (JAPAN, (34.13, 131.72, 34.14, 131.73), (0, 0), "", True),
        (RD, (100_000.0, 450_000.0, 100_100.0, 450_100.0), (0, 9), "", False),  # its place is clear
        (NOBODY, UTM, (10, 0), "", False),
        (NOBODY, UTM, (0, 10), "", True),  # inside out
        (NOBODY, UTM, (5, 5), "", False),
    ],
)
def test_the_order_of_axes_by_evidence(
    name: NamedCrs, box: tuple[float, float, float, float], sense: tuple[int, int], asked: str, swapped: bool
) -> None:
    assert choose_axes(name, box, sense, asked)[0] is swapped


def test_solids_and_roofs_show_a_wrong_order(tmp_path: Path) -> None:
    right = read_model_header(write_gml(tmp_path / "a.gml", house_gml(), crs=""))
    wrong = read_model_header(write_gml(tmp_path / "b.gml", house_gml(swap=True), crs=""))
    assert (right.swapped, wrong.swapped) == (False, True)
    assert right.bounds == wrong.bounds
    assert "1 of 1 solids and roofs would be inside out" in wrong.axes


def test_kinds_of_files(tmp_path: Path) -> None:
    assert kind_of(write_json(tmp_path / "a.bin", house_json())) == "model"
    assert kind_of(write_gml(tmp_path / "a.txt", "")) == "model"
    for name, data, kind in (
        ("a.las", b"LASF\0", "cloud"), ("a.tif", b"II*\0", "terrain"),
        ("a.vrt", b"<VRTDataset rasterXSize='1'>", "terrain"),
    ):  # fmt: skip
        (tmp_path / name).write_bytes(data)
        assert kind_of(tmp_path / name) == kind
