"""Point formats, versions and flags of LAS as files have them: what is read of each."""

import json
import shlex
import struct
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pyproj
import pytest
from laspy.vlrs.known import WktCoordinateSystemVlr
from laspy.vlrs.vlrlist import VLRList

from tests.helpers.deliveries import write_delivery
from tests.helpers.whole_clouds import read_points
from tests.tiler.georeference.test_deliveries import DELIVERIES
from tests.tiler.pointclouds.test_clouds import EVERYWHERE, ORIGIN
from tiler.cli.main import main
from tiler.config.config import make_config
from tiler.config.config_file import load_config, write_config
from tiler.pointclouds.clouds import find_clouds, read_header
from tiler.pointclouds.ingest import read_cells
from tiler.store.out_folder import command_alone

N = 130_000  # more than two chunks of LAZ, which have 50,000 points
VERSIONS = dict.fromkeys((0, 1), "1.1") | dict.fromkeys((2, 3), "1.2") | dict.fromkeys((4, 5), "1.3")
CLASSES = (1, 2, 6, 9, 26)


def write(path: Path, point_format: int, *, version: str = "", n: int = N, **fields: Any) -> laspy.LasData:
    """Write a cloud of some fields; return its points."""
    rng = np.random.default_rng(3)
    header = laspy.LasHeader(point_format=point_format, version=version or VERSIONS.get(point_format, "1.4"))
    header.scales, header.offsets = np.full(3, 0.01), ORIGIN
    las = laspy.LasData(header)
    las.x, las.y, las.z = (ORIGIN + rng.uniform(0, 200, (n, 3)).round(2)).T
    las.classification = rng.choice(np.array(CLASSES, np.uint8), n)
    for name, values in fields.items():
        las[name] = values
    las.write(path)
    return las


def assert_same(path: Path, las: laspy.LasData, kept: Any = slice(None)) -> None:
    """Compare what is read of a file, whole and by cells, with some of its points."""
    cloud, counts = read_points(path, EVERYWHERE)
    np.testing.assert_allclose(cloud.xyz, np.asarray(las.xyz)[kept], atol=1e-6)
    np.testing.assert_array_equal(cloud.classification, np.asarray(las.classification)[kept])
    assert counts["read"] == len(las.points)
    cells = list(read_cells(path, EVERYWHERE))
    assert sum(len(block.units) for block in cells) == len(cloud.xyz)
    found = np.bincount(np.concatenate([block.classification for block in cells]), minlength=32)
    np.testing.assert_array_equal(found, np.bincount(cloud.classification, minlength=32))


@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize("point_format", range(11))
def test_every_point_format_is_read(point_format: int, suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"cloud{suffix}"
    assert_same(path, write(path, point_format, n=2000))


@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize("point_format", range(11))
def test_withheld_points_are_left_out_in_every_format(point_format: int, suffix: str, tmp_path: Path) -> None:
    """A field that is not decompressed has its chunk's first value everywhere: here that is withheld."""
    withheld = np.arange(N) % 3 == 0
    path = tmp_path / f"cloud{suffix}"
    las = write(path, point_format, withheld=withheld)
    assert_same(path, las, ~withheld)


@pytest.mark.parametrize("flag", ["synthetic", "key_point", "overlap"])
def test_other_flags_change_nothing(flag: str, tmp_path: Path) -> None:
    path = tmp_path / "cloud.laz"
    fields: dict[str, Any] = {flag: np.arange(2000) % 2}
    assert_same(path, write(path, 6, n=2000, **fields))


@pytest.mark.parametrize("byte", [0x20, 0x40, 0x60])
def test_flags_in_the_byte_of_an_old_class_are_no_part_of_it(byte: int, tmp_path: Path) -> None:
    path = tmp_path / "cloud.las"
    las = write(path, 1, n=2000)
    data = bytearray(path.read_bytes())
    begin, size = struct.unpack_from("<I", data, 96)[0], struct.unpack_from("<H", data, 105)[0]
    for k in range(2000):
        data[begin + k * size + 15] |= byte
    path.write_bytes(data)
    assert_same(path, las)


def test_las_1_0_has_two_bytes_before_its_points(tmp_path: Path) -> None:
    path = tmp_path / "cloud.las"
    las = write(path, 1, version="1.2", n=2000)
    data = bytearray(path.read_bytes())
    begin = struct.unpack_from("<I", data, 96)[0]
    data[25] = 0
    data[96:100] = struct.pack("<I", begin + 2)
    path.write_bytes(data[:begin] + b"\xdd\xcc" + data[begin:])
    assert_same(path, las)


@pytest.mark.parametrize("point_format", [1, 6])
def test_return_number_0_is_read(point_format: int, tmp_path: Path) -> None:
    path = tmp_path / "cloud.laz"
    none = np.zeros(2000, np.uint8)
    assert_same(path, write(path, point_format, n=2000, return_number=none, number_of_returns=none))


@pytest.mark.parametrize("point_format", [1, 3, 6, 8])
@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_extra_bytes_are_passed_over(point_format: int, suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"cloud{suffix}"
    las = write(path, point_format, n=2000)
    las.add_extra_dims(
        [laspy.ExtraBytesParams("Amplitude", np.uint16), laspy.ExtraBytesParams("height", np.float64)]
    )
    las.height[:] = 1e9
    las.write(path)
    assert_same(path, las)


def test_a_crs_behind_the_points_is_found(tmp_path: Path) -> None:
    path = tmp_path / "cloud.laz"
    las = write(path, 6, n=2000)
    las.header.global_encoding.wkt = True
    las.evlrs = VLRList([WktCoordinateSystemVlr(pyproj.CRS("EPSG:3006+5613").to_wkt("WKT1_GDAL"))])
    las.write(path)
    crs = read_header(path).crs
    assert crs is not None
    assert [one.name for one in crs.sub_crs_list] == ["SWEREF99 TM", "RH2000 height"]
    assert_same(path, las)


def test_hidden_files_of_a_folder_are_passed_over(tmp_path: Path) -> None:
    for name in ("a.laz", "._a.laz", ".b.las"):
        (tmp_path / name).touch()
    assert find_clouds([tmp_path]) == [tmp_path / "a.laz"]
    assert find_clouds([tmp_path / ".b.las"]) == [tmp_path / ".b.las"]  # it was named


def test_tiles_west_and_south_of_the_origin_are_named_on_the_command_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    values = write_delivery(tmp_path / "in", DELIVERIES["japan"])
    x, y = DELIVERIES["japan"].corner
    bounds = ["--bounds", f"{x:.4e}", f"{y:.0f}.", f"{x + 110}", f"{y + 110}"]
    run = ["run", *values["pointcloud"], "--footprints", values["footprints"], "--out", str(tmp_path / "out")]
    assert main([*run, "--mesh-size", "10", "--tile-size", "150", *bounds, "-q"]) == 0
    record = json.loads((tmp_path / "out" / "run.json").read_text())
    assert record["region"]["bounds"] == [x, y, x + 110, y + 110]
    (tile,) = record["tiles"]
    assert tile == "-56_-753"
    (program, *command) = shlex.split(command_alone(tmp_path / "out", tile))
    for words in (command, ["run", str(tmp_path / "out" / "config.toml"), f"--only={tile}"]):
        assert main(words) == 0
        assert capsys.readouterr().out.splitlines()[-1].endswith(f"{tile}.vtu")
    assert program == "citystitch"


@pytest.mark.parametrize("words", ["", "6,", "six", "6,300", "6,-1", "2", "6,9", "7", "6.5"])
def test_classes_that_mark_no_buildings_are_refused(words: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "cloud.laz", "--building-classes", words]) == 2
    assert "building_classes" in capsys.readouterr().err


def test_classes_that_mark_buildings_are_given_with_commas_or_as_a_list(tmp_path: Path) -> None:
    for given in ("6,67", "6, 67", [6, 67], (6, 67)):
        config = make_config({"building_classes": given})
        assert config.building_classes == (6, 67)
    (tmp_path / "config.toml").write_text(write_config(config))
    assert make_config(load_config(tmp_path / "config.toml")).building_classes == (6, 67)
    assert make_config({"building_classes": 67}).building_classes == (67,)
    assert make_config({}).building_classes == (6,)
