"""Input that nobody vouches for: bounded, refused or escaped, with the documented exit code and one line."""

import ast
import json
import os
import struct
import time
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pyproj
import pytest
import shapely

from pipeline.data.errors import ConfigError, InputError
from tests.helpers.bad_input import (
    BOUNDS,
    HOUSE,
    QUICK,
    call,
    call_apart,
    check_call,
    nested_wkb,
    put_wkb,
    write_city,
    write_cloud,
    write_houses,
    write_parquet,
)
from tests.helpers.result_parts import parts, write_parts
from tiler.objects.requests import trust_addresses
from tiler.pointclouds import ingest
from tiler.store.out_folder import refuse_inputs_within
from tiler.store.store import Store

Capture = pytest.CaptureFixture[str]
Damage = Callable[[Path], None]


@pytest.fixture
def city(tmp_path: Path) -> Path:
    return write_city(tmp_path / "city")


def arguments(city: Path, *others: str | Path, cloud: str = "cloud.laz", houses: str = "house.gpkg") -> list[str]:
    given = ["run", city / cloud, "--footprints", city / houses, "--out", city / "out", *QUICK, *others]
    return [str(each) for each in given]


def patch(path: Path, place: int, form: str, value: float) -> None:
    data = bytearray(path.read_bytes())
    struct.pack_into("<" + form, data, place, value)
    path.write_bytes(data)


def patch_cloud(place: int, form: str, value: float, suffix: str = "laz") -> Damage:
    def damage(city: Path) -> None:
        if suffix == "las":
            laspy.read(city / "cloud.laz").write(city / "cloud.las")
            (city / "cloud.laz").unlink()
        patch(city / f"cloud.{suffix}", place, form, value)

    return damage


def first_record(city: Path) -> None:
    patch(city / "cloud.laz", 375 + 20, "H", 65535)


def extended_record(city: Path) -> None:
    """Put a record behind the points that claims an exabyte."""
    path = city / "cloud.laz"
    data = bytearray(path.read_bytes())
    struct.pack_into("<QI", data, 235, len(data), 1)
    data += struct.pack("<H16sHQ32s", 0, b"LASF_Spec", 1, 2**60, b"")
    path.write_bytes(data)


def many_records(city: Path) -> None:
    path = city / "cloud.laz"
    data = bytearray(path.read_bytes())
    struct.pack_into("<QI", data, 235, len(data), 2_000_000)
    path.write_bytes(data + bytes(120_000_000))


def records_before_points(city: Path) -> None:
    patch(city / "cloud.laz", 96, "I", 70_000_000)
    with (city / "cloud.laz").open("r+b") as file:
        file.truncate(71_000_000)


def copies_of_a_point(city: Path) -> None:
    write_cloud(city / "cloud.laz", np.tile([318030.0, 6399030.0, 2.0], (3_000_000, 1)), 2)


def folder_of_that_name(city: Path) -> None:
    (city / "cloud.laz").unlink()
    (city / "cloud.laz").mkdir()


def pipe(name: str) -> Damage:
    def damage(city: Path) -> None:
        (city / name).unlink()
        os.mkfifo(city / name)

    return damage


def circular_link(city: Path) -> None:
    (city / "cloud.laz").unlink()
    (city / "cloud.laz").symlink_to("cloud.laz")


def written(content: str | bytes, name: str = "house.gpkg") -> Damage:
    def damage(city: Path) -> None:
        (city / name).write_bytes(content if isinstance(content, bytes) else content.encode())

    return damage


def cut(name: str, share: float) -> Damage:
    def damage(city: Path) -> None:
        data = (city / name).read_bytes()
        (city / name).write_bytes(data[: int(len(data) * share)])

    return damage


CLOUDS: list[tuple[str, Damage, str]] = [
    ("10^9 points in a small LAZ", patch_cloud(247, "Q", 10**9), "bytes are believed to hold at most"),
    ("2^63 points in a small LAZ", patch_cloud(247, "Q", 2**63), "bytes are believed to hold at most"),
    ("10^9 points in a small LAS", patch_cloud(247, "Q", 10**9, "las"), "the file ends early"),
    ("copies of one point", copies_of_a_point, "of 3000000 points could be read"),
    ("a record longer than its place", first_record, "records end at byte"),
    ("an extended record of an exabyte", extended_record, "its 1 extended records end at byte"),
    ("very many extended records", many_records, "2000000 extended records > 1000000"),
    ("records of 70 MB", records_before_points, "bytes of records > 64000000"),
    ("a point of 1 byte", patch_cloud(105, "H", 1), "point size, header says 1 "),
    ("a scale of 10^9", patch_cloud(131, "d", 1e9), "x scale 1e+09 is not within"),
    ("an offset of 10^300", patch_cloud(155, "d", 1e300), "x offset 1e+300"),
    ("cut in the header", cut("cloud.laz", 0.01), "within its header"),
    ("cut in the points", cut("cloud.laz", 0.7), "its chunk table should begin"),
    ("empty", written("", "cloud.laz"), "is no LAS or LAZ file: it begins with b''"),
    ("a folder of that name", folder_of_that_name, "holds no .las or .laz file"),
    ("a pipe of that name", pipe("cloud.laz"), "no such file or folder"),
    ("a link to itself", circular_link, "no such file or folder"),
]


@pytest.mark.parametrize(("damage", "text"), [case[1:] for case in CLOUDS], ids=[case[0] for case in CLOUDS])
def test_point_clouds(city: Path, capsys: Capture, damage: Damage, text: str) -> None:
    damage(city)
    cloud = "cloud.las" if (city / "cloud.las").exists() else "cloud.laz"
    found = call(capsys, *arguments(city, cloud=cloud))
    check_call(found)
    assert found.code == 1
    assert text in found.err
    assert str(city / cloud) in found.err


@pytest.mark.parametrize("value", [1e12, float("nan")])
def test_bounds_that_are_none_are_those_of_the_points(city: Path, capsys: Capture, value: float) -> None:
    patch_cloud(179, "d", value)(city)
    found = call(capsys, *arguments(city))
    assert found.code == 0
    assert "points were read for it" in found.out


@pytest.mark.long
def test_no_claim_of_a_file_takes_memory(city: Path) -> None:
    """A whole run of the tiny city takes some 300 MB; the points that are claimed would take 30 GB."""
    patch(city / "cloud.laz", 247, "Q", 10**9)
    extended_record(city)
    found = call_apart(*arguments(city), megabytes=450)
    assert found.code == 1, found
    many_records(city)
    assert call_apart(*arguments(city), megabytes=450).code == 1


@pytest.mark.long
def test_two_million_copies_of_a_point_are_read_in_bounded_memory(city: Path) -> None:
    write_cloud(city / "cloud.laz", np.tile([318030.0, 6399030.0, 2.0], (1_900_000, 1)), 2)
    found = call_apart(
        "run", city / "cloud.laz", "--bounds", *map(str, BOUNDS), "--out", city / "o", megabytes=900
    )
    assert found.code == 0, found


def test_too_many_points_in_one_place(city: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ingest, "MOST_POINTS", 1000)
    found = call(capsys, *arguments(city))
    check_call(found)
    assert found.code == 1
    assert "points in the square of 64 m at (31" in found.err
    skipped = call(capsys, *arguments(city, "--skip-unreadable", "--overwrite"))
    assert skipped.code in {1, 3}


def test_unreadable_by_its_permissions(city: Path, capsys: Capture) -> None:
    for name in ("cloud.laz", "house.gpkg"):
        (city / name).chmod(0)
        if os.access(city / name, os.R_OK):
            pytest.skip("the superuser may read everything")
        found = call(capsys, *arguments(city))
        check_call(found)
        assert found.code == 1
        assert f"{city / name}: cannot be read (Permission denied)" in found.err
        (city / name).chmod(0o600)


def test_patterns_do_not_follow_links_in_circles(city: Path, capsys: Capture) -> None:
    for k in range(12):
        (city / f"loop{k}").symlink_to(city, target_is_directory=True)
    begin = time.monotonic()
    found = call(capsys, "plan", city / "**" / "*.laz", *QUICK)
    assert found.code == 0, found.err
    assert "1 " in found.out
    assert time.monotonic() - begin < 20


# Footprints


@pytest.mark.long
def test_nested_geometries_do_not_end_the_process(city: Path) -> None:
    """GEOS recurses and ends the process by a signal where the stack ends."""
    put_wkb(city / "house.gpkg", nested_wkb(2_000_000, 6))
    found = call_apart(*arguments(city), megabytes=900)
    check_call(found)
    assert found.code == 1, found  # no building was meshed
    notes = json.loads((city / "out" / "run.json").read_text())["notes"]
    assert notes["footprint-unreadable"]["count"] == 1
    write_parquet(city / "house.parquet", [nested_wkb(100_000, 7), nested_wkb(100_000), shapely.to_wkb(HOUSE)])
    found = call_apart(*arguments(city, "--overwrite", houses="house.parquet"), megabytes=900)
    assert found.code == 3, found
    record = json.loads((city / "out" / "run.json").read_text())
    assert (record["counts"]["buildings"], record["notes"]["footprint-unreadable"]["count"]) == (1, 2)


def circle(n: int) -> shapely.Polygon:
    angle = np.linspace(0, 2 * np.pi, n, endpoint=False)
    radius = 12 + np.random.default_rng(1).normal(0, 0.2, n)
    return shapely.Polygon(np.column_stack((318030 + radius * np.cos(angle), 6399030 + radius * np.sin(angle))))


def test_a_footprint_of_a_million_vertices_is_left_out_and_told(city: Path, capsys: Capture) -> None:
    write_houses(city / "house.gpkg", [circle(1_000_000), shapely.box(318006, 6399006, 318014, 6399014)])
    found = call(capsys, *arguments(city))
    check_call(found)
    assert found.code == 3
    record = json.loads((city / "out" / "run.json").read_text())
    (item,) = record["notes"]["footprint-too-many-vertices"]["items"]
    assert item["detail"] == "feature 1: 1000001 vertices > 100000; left out"
    assert record["counts"]["buildings"] == 1


@pytest.mark.long
def test_a_ragged_footprint_of_many_vertices_takes_seconds(city: Path) -> None:
    write_houses(city / "house.gpkg", [circle(99_000)])
    found = call_apart(*arguments(city, "--allow-empty"), megabytes=700, timeout=90)
    check_call(found)
    assert found.code == 0, found


CONTROL = "a\x1b[31m\n\x00b\u202ec\x7f"


def test_control_characters_of_attributes_are_escaped_everywhere(city: Path, capsys: Capture) -> None:
    write_parquet(city / "house.parquet", [shapely.to_wkb(HOUSE)])
    import pyarrow.parquet as pq

    table = pq.read_table(city / "house.parquet")
    pq.write_table(table.set_column(0, "id", [[CONTROL]]), city / "house.parquet")
    found = call(capsys, *arguments(city, houses="house.parquet"))
    check_call(found)
    assert found.code == 0, found.err
    model = (city / "out" / "citymodel.city.json").read_text()
    assert list(json.loads(model)["CityObjects"]) == [r"a\x1b[31m\n\x00b\u202ec\x7f"]
    for path in (city / "out").rglob("*.json"):
        assert not {sign for sign in path.read_text() if ord(sign) < 32 and sign not in "\n"}, path
    assert "\x1b" not in found.out
    assert call(capsys, "check", city / "out").code == 0


def test_long_ids_are_cut_and_stay_different(city: Path, capsys: Capture) -> None:
    other = shapely.box(318006, 6399006, 318014, 6399014)
    write_houses(city / "house.gpkg", [HOUSE, other], ids=["x" * 100_000 + end for end in "ab"])
    found = call(capsys, *arguments(city))
    check_call(found)
    names = list(json.loads((city / "out" / "citymodel.city.json").read_text())["CityObjects"])
    assert [len(name) for name in names] == [200, 200]
    assert names[0] != names[1]


def vrt(city: Path) -> None:
    (city / "house.gpkg").rename(city / "secret.gpkg")
    (city / "house.gpkg").write_text(
        '<OGRVRTDataSource><OGRVRTLayer name="secret"><SrcDataSource>'
        f"{city}/secret.gpkg</SrcDataSource><SrcLayer>house</SrcLayer></OGRVRTLayer></OGRVRTDataSource>"
    )


def zipped(city: Path) -> None:
    data = (city / "house.gpkg").read_bytes()
    with zipfile.ZipFile(city / "new.zip", "w") as archive:
        archive.writestr("house.gpkg", data)
    (city / "new.zip").replace(city / "house.gpkg")


def shapefile_without(*suffixes: str) -> Damage:
    def damage(city: Path) -> None:
        write_houses(city / "house.shp", [HOUSE])
        for suffix in suffixes:
            (city / f"house{suffix}").unlink()

    return damage


def raw(wkb: bytes) -> Damage:
    return lambda city: put_wkb(city / "house.gpkg", wkb)


def geojson(*rings: Any) -> str:
    crs = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::3006"}}
    shape = {"type": "Polygon", "coordinates": list(rings)}
    feature = {"type": "Feature", "properties": {"id": "a"}, "geometry": shape}
    return json.dumps({"type": "FeatureCollection", "crs": crs, "features": [feature]})


def polygon_wkb(xy: list[tuple[float, float]], claimed: int | None = None) -> bytes:
    values = [value for pair in xy for value in pair]
    return struct.pack("<BIII", 1, 3, 1, len(xy) if claimed is None else claimed) + struct.pack(
        f"<{len(values)}d", *values
    )


CORNERS = [(318020.0, 6399020.0), (318040.0, 6399020.0), (318040.0, 6399040.0), (318020.0, 6399020.0)]
DEEP = '{"type":"FeatureCollection","features":[{"type":"Feature","properties":{"a":' + "[" * 100_000

NO_NUMBER = "1 footprint with a coordinate that is no number was dropped"
UNREADABLE = "1 footprint has a geometry that cannot be read"
FOOTPRINTS: list[tuple[str, Damage, str, int, str]] = [
    ("VRT", vrt, "house.gpkg", 1, "points to other data (<ogrvrtdatasource)"),
    (
        "GDALG",
        written('{"type": "gdal_streamed_alg", "command_line": "gdal vector pipeline"}'),
        "house.gpkg",
        1,
        "points to",
    ),
    (
        "WFS",
        written("<OGRWFSDataSource><URL>http://127.0.0.1:9/</URL></OGRWFSDataSource>"),
        "house.gpkg",
        1,
        "points to",
    ),
    ("a zip archive", zipped, "house.gpkg", 1, "is none of SHP, GPKG, GeoJSON, FlatGeobuf"),
    ("plain text", written("hello"), "house.gpkg", 1, "is none of"),
    ("empty", written(""), "house.gpkg", 1, "is empty"),
    ("a pipe", pipe("house.gpkg"), "house.gpkg", 1, "is no regular file"),
    ("empty Parquet", written("", "house.parquet"), "house.parquet", 1, "is empty"),
    ("text Parquet", written("hello", "house.parquet"), "house.parquet", 1, "cannot be read as GeoParquet"),
    ("a server", lambda _: None, "https://127.0.0.1:9/a.gpkg", 1, "nothing has answered at https://127.0.0.1:9"),
    ("a virtual file", lambda _: None, "/vsicurl/http:/127.0.0.1:9/a.gpkg", 1, "no such file"),
    ("half a GPKG", cut("house.gpkg", 0.5), "house.gpkg", 1, "cannot be read"),
    ("deep GeoJSON", written(DEEP, "a.geojson"), "a.geojson", 1, "cannot be read"),
    ("half a GeoJSON", written(geojson(CORNERS)[:-40], "a.geojson"), "a.geojson", 1, "cannot be read"),
    ("GeoJSON of words", written(geojson([["a", "b"]]), "a.geojson"), "a.geojson", 1, "no building was meshed"),
    ("shapefile without index", shapefile_without(".shx"), "house.shp", 1, "SHAPE_RESTORE_SHX"),
    ("shapefile without table", shapefile_without(".dbf"), "house.shp", 0, ""),
    ("shapefile without CRS", shapefile_without(".prj"), "house.shp", 0, "the footprint file states no CRS"),
    ("NaN", raw(polygon_wkb([*CORNERS[:2], (float("nan"), 0.0), CORNERS[3]])), "house.gpkg", 1, NO_NUMBER),
    ("infinite", raw(polygon_wkb([*CORNERS[:2], (float("inf"), 0.0), CORNERS[3]])), "house.gpkg", 1, NO_NUMBER),
    ("huge", raw(polygon_wkb([*CORNERS[:2], (1e300, 1e300), CORNERS[3]])), "house.gpkg", 1, NO_NUMBER),
    (
        "large",
        raw(polygon_wkb([*CORNERS[:2], (9e7, 9e7), CORNERS[3]])),
        "house.gpkg",
        0,
        "1 footprint on the region's border was clipped",
    ),
    ("claimed vertices", raw(polygon_wkb(CORNERS, 2**31)), "house.gpkg", 1, UNREADABLE),
    ("claimed polygons", raw(struct.pack("<BII", 1, 6, 2**32 - 1)), "house.gpkg", 1, UNREADABLE),
    (
        "an id that is no UTF-8",
        written(geojson(CORNERS).encode().replace(b'"a"', b'"\xe1"'), "a.geojson"),
        "a.geojson",
        0,
        "the reader of the footprints gave 1 warning",
    ),
    ("a curve", raw(struct.pack("<BIII", 1, 10, 1, 0)), "house.gpkg", 1, "no building was meshed"),
    ("no geometry at all", raw(b""), "house.gpkg", 1, "no building was meshed"),
    ("an unknown kind", raw(struct.pack("<BII", 1, 999, 1)), "house.gpkg", 1, UNREADABLE),
]


@pytest.mark.parametrize(
    ("damage", "name", "code", "text"), [case[1:] for case in FOOTPRINTS], ids=[case[0] for case in FOOTPRINTS]
)
def test_footprints(
    city: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch, damage: Damage, name: str, code: int, text: str
) -> None:
    monkeypatch.setattr("tiler.objects.requests.FIRST_PATIENCE", 0.1)
    trust_addresses(True)  # as after an earlier run
    damage(city)
    houses = name if name.startswith(("http", "/")) else str(city / name)
    found = call(capsys, "run", city / "cloud.laz", "--footprints", houses, "--out", city / "out", *QUICK)
    check_call(found)
    assert found.code == code, found
    assert text in (found.err if code in {1, 2} else " ".join(found.out.split())), found.out + found.err


def test_values_that_parquet_keeps_once_do_not_expand_without_end(city: Path) -> None:
    """A file of 1 MB, whose polygons or ids would take 40 GB in one batch."""
    large = shapely.to_wkb(circle(50_000))
    write_parquet(city / "a.parquet", [large] * 50_000)
    assert (city / "a.parquet").stat().st_size < 2_000_000
    found = call_apart(*arguments(city, houses="a.parquet"), megabytes=900)
    check_call(found)
    assert found.code == 1, found
    assert "50000 rows expand to 40001450000 bytes" in found.err


def test_deep_metadata_of_parquet(city: Path, capsys: Capture) -> None:
    write_parquet(city / "a.parquet", [shapely.to_wkb(HOUSE)], geo='{"columns":' + "[" * 100_000)
    found = call(capsys, *arguments(city, houses="a.parquet"))
    check_call(found)
    assert found.code == 1
    assert "cannot be read as GeoParquet" in found.err


# Configurations


def config(city: Path, text: str) -> Path:
    (city / "run.toml").write_text(text)
    return city / "run.toml"


def inputs(*lines: str) -> str:
    return "\n".join(['[input]\npointcloud = "cloud.laz"\nfootprints = "house.gpkg"', *lines])


CONFIGS: list[tuple[str, str, str]] = [
    ("nested arrays", "[mesh]\nmesh_size = " + "[" * 50_000, "nested too deep"),
    ("nested tables", "[mesh]\nmesh_size = " + "{a=" * 50_000, "nested too deep"),
    ("a deep dotted key", "[mesh]\nmesh_size" + ".a" * 5_000 + " = 1", "mesh_size = {...}: float expected"),
    ("an integer of 5,000 digits", "[mesh]\nmesh_size = 1" + "0" * 5_000, "not valid TOML"),
    ("an integer of 1,000 digits", "[mesh]\nmesh_size = 1" + "0" * 1_000, "a whole number of 3322 bits"),
    ("workers of 1,000 digits", "[run]\nworkers = 1" + "0" * 1_000, "a whole number of 3322 bits"),
    ("a date", "[mesh]\nmesh_size = 2020-01-01", "float expected, not date"),
    ("a list for a number", "[mesh]\nmesh_size = [1, 2]", "mesh_size = [...]: float expected"),
    ("a table for a path", "[run]\nout = {a = 1}", "out = {...}: str expected"),
    ("a zero byte in a path", inputs('[run]\nout = "a\\u0000b"'), "has control characters"),
    ("an escape in a path", '[input]\npointcloud = "\\u001b[31m"', "has control characters"),
    ("a long value", inputs(f'layer = "{"x" * 20_000}"'), "20000 characters; at most 10000"),
    ("out beside", inputs('[run]\nout = "../elsewhere"'), "outside the folder of the file"),
    ("out elsewhere", inputs('[run]\nout = "/tmp/elsewhere"'), "outside the folder of the file"),
    ("out through a link", inputs('[run]\nout = "link/out"'), "outside the folder of the file"),
    ("a scheduler", inputs('[run]\nscheduler = "tcp://127.0.0.1:9"'), "a file may not name a scheduler"),
    ("a cluster", inputs('[run]\ncluster = "slurm.toml"'), "a file may not name a cluster"),
    ("bounds of 10^12 m", inputs("bounds = [0, 0, 1e12, 1e12]"), "more than 32766 tiles of 1250 m to a side"),
    ("terrain of micrometres", inputs("[terrain]\ndtm_spacing = 1e-6"), "nodes in a tile of 1250 m"),
    ("terrain of 10^-300 m", inputs("[terrain]\ndtm_spacing = 1e-300"), "inf nodes in a tile"),
    ("terrain of 10^300 m", inputs("[terrain]\ndtm_spacing = 1e300"), "the extent of a tile, whose terrain"),
    (
        "cells without number",
        inputs("[mesh]\nmesh_size = 0.1\ndomain_height = 1e9"),
        "cells in a tile of 10 m > 2.15e+09",
    ),
    ("unknown section with an escape", '["\\u001b[31m"]\na = 1', r"unknown section [\x1b[31m]"),
]


@pytest.mark.parametrize(("text", "message"), [case[1:] for case in CONFIGS], ids=[case[0] for case in CONFIGS])
@pytest.mark.parametrize("command", ["run", "plan"])
def test_configurations(
    city: Path, tmp_path: Path, capsys: Capture, command: str, text: str, message: str
) -> None:
    (tmp_path / "far").mkdir()
    (city / "link").symlink_to(tmp_path / "far")
    found = call(capsys, command, config(city, text))
    check_call(found)
    assert found.code == 2, found
    assert message in found.err
    assert not list((tmp_path / "far").iterdir())


def test_a_configuration_of_100_megabytes_is_not_read(city: Path) -> None:
    path = config(city, "")
    with path.open("r+b") as file:
        file.truncate(100_000_000)
    found = call_apart("run", path, megabytes=250)
    check_call(found)
    assert found.code == 2, found
    assert "100000000 bytes > 1000000" in found.err


@pytest.mark.parametrize("name", ["pipe.toml", "device.toml", "folder.toml"])
def test_a_configuration_is_a_regular_file(city: Path, capsys: Capture, name: str) -> None:
    os.mkfifo(city / "pipe.toml")
    (city / "device.toml").symlink_to("/dev/zero")
    (city / "folder.toml").mkdir()
    found = call(capsys, "run", city / name)
    check_call(found)
    assert found.code == 2
    assert "is no regular file" in found.err


def test_the_command_line_may_decide_what_a_file_may_not(city: Path, tmp_path: Path, capsys: Capture) -> None:
    path = config(city, inputs('[run]\nout = "../elsewhere"'))
    found = call(capsys, "run", path, "--out", tmp_path / "mine", *QUICK)
    assert found.code == 0, found.err
    assert (tmp_path / "mine" / "mesh.pvtu").is_file()
    assert not (tmp_path / "elsewhere").exists()


# Output folders


@pytest.mark.parametrize("name", ["", "mesh", "boundary", "store.zarr", "store.zarr/points", "run.json"])
def test_nothing_is_removed_through_a_link(city: Path, tmp_path: Path, capsys: Capture, name: str) -> None:
    assert call(capsys, *arguments(city)).code == 0
    place, far = city / "out" / name, tmp_path / "far"
    place.rename(far)
    keep = far if far.is_file() else far / "keep.vtu"
    if far.is_dir():
        keep.write_text("keep")
    place.symlink_to(far)
    for others in (["--overwrite"], []):
        found = call(capsys, *arguments(city, *others))
        check_call(found)
        assert found.code == 2
        assert f"{place}: is a symbolic link to {far}" in found.err
    assert keep.exists()


def test_inputs_among_the_results_are_not_removed(city: Path, capsys: Capture) -> None:
    assert call(capsys, *arguments(city)).code == 0
    for name, option in (("cloud.laz", "cloud"), ("house.gpkg", "houses")):
        inside = city / "out" / "mesh" / name
        (city / name).rename(inside)
        found = call(capsys, *arguments(city, "--overwrite", **{option: f"out/mesh/{name}"}))
        check_call(found)
        assert found.code == 2
        assert f"{inside}: an input lies among the results" in found.err
        inside.rename(city / name)


def test_inputs_are_found_among_the_results_whichever_way_both_are_named(tmp_path: Path) -> None:
    far, near = tmp_path / "far", tmp_path / "near"
    far.mkdir()
    near.symlink_to(far)
    for out, given in ((near, far), (far, near)):
        with pytest.raises(ConfigError, match="lies among the results"):
            refuse_inputs_within(out / "out", [tmp_path / "cloud.laz", given / "out" / "mesh" / "cloud.laz"])
        refuse_inputs_within(out / "out", [given / "cloud.laz", given / "out" / "cloud.laz"])


# Results of someone else


ROWS = np.zeros((25_000, 3))


def npy(shape: str, dtype: str = "'<f8'") -> bytes:
    """An array of numpy's format that claims another shape or type than the bytes of `ROWS` have."""
    head = f"{{'descr': {dtype}, 'fortran_order': False, 'shape': {shape}}}".ljust(117).encode() + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head + ROWS.tobytes()


SMALL: list[tuple[str, bytes, str]] = [
    ("rows", npy("(1000000000000000, 3)"), "buffer is too small"),
    ("columns", npy("(25000, 1000000000000000)"), "too"),
    ("no numbers", npy("('a',)"), "shape is not valid"),
    ("less than none", npy("(-1,)"), "an array of (-1,)"),
    ("axes", npy(f"({'1, ' * 20})"), "an array of (1, 1,"),
    ("objects", npy("(3,)", "'|O'"), "an array of (3,) object"),
    ("records", npy("(3,)", "[('a', '<f8')]"), "an array of"),
    ("a call", npy("(3,)", "print(1)"), "malformed node"),
    ("cut", npy("(3,)")[:40], "array header"),
    ("nothing", b"", "magic"),
]


@pytest.mark.parametrize(("data", "message"), [case[1:] for case in SMALL], ids=[case[0] for case in SMALL])
def test_a_small_array_is_not_believed(tmp_path: Path, data: bytes, message: str) -> None:
    store = Store(tmp_path / "store.zarr")
    store.write("s", "n", {"a": ROWS[:3]})
    file = store.file("s", "n")
    write_parts(file, parts(file) | {"a.npy": data})
    with pytest.raises(Exception, match="is damaged") as caught:
        store.read("s", "n")
    assert message in str(caught.value)


def test_a_compressed_file_in_a_result_is_refused(tmp_path: Path) -> None:
    store = Store(tmp_path / "store.zarr")
    store.write("s", "n", {"a": ROWS[:3]})
    found = parts(store.file("s", "n"))
    with zipfile.ZipFile(store.file("s", "n"), "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in (found | {"a.npy": bytes(10**7)}).items():
            archive.writestr(name, data)
    with pytest.raises(InputError, match="a compressed file in the zip"):
        store.read("s", "n")


def grid(*chunk: int) -> dict[str, Any]:
    return {"chunk_grid": {"name": "regular", "configuration": {"chunk_shape": chunk}}}


LARGE: list[tuple[str, dict[str, Any], str]] = [
    ("rows", {"shape": [10**15, 3]}, "1 files for the 40000000000 chunks"),
    ("columns", {"shape": [25_000, 10**15]}, "1 files for"),
    ("less than none", {"shape": [-1, 3]}, "is damaged"),
    ("another type", {"data_type": "complex128", "fill_value": [0, 0]}, "an array of (25000, 3) complex128"),
    ("other codecs", {"codecs": [{"name": "bytes", "configuration": {"endian": "little"}}]}, "codecs BytesCodec"),
    ("large chunks", grid(10**12, 3), "chunks of 1000000000000 rows"),
    ("wide chunks", grid(25_000, 10**12), "chunks of 25000 rows"),
    ("no chunks", grid(0, 3), "is damaged"),
]


@pytest.mark.parametrize(("change", "message"), [case[1:] for case in LARGE], ids=[case[0] for case in LARGE])
def test_a_large_array_is_not_believed(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    store = Store(tmp_path / "store.zarr")
    store.write("s", "n", {"a": ROWS})
    file = store.file("s", "n")
    document = json.loads(parts(file)["a/zarr.json"])
    write_parts(file, parts(file) | {"a/zarr.json": json.dumps(document | change).encode()})
    with pytest.raises(Exception, match="is damaged") as caught:
        store.read_rows("s", "n", "a", 0, 5)
    assert message in str(caught.value)


CHUNKS: list[tuple[str, bytes]] = [
    ("a cut head", b"\2\1\x21\x08"),
    ("not Blosc", b"hello world, and more"),
    ("4 GB", b"\2\1\x21\x08" + struct.pack("<III", 2**32 - 1, 2**18, 100) + bytes(84)),
]


@pytest.mark.parametrize("data", [case[1] for case in CHUNKS], ids=[case[0] for case in CHUNKS])
def test_chunks_are_not_believed(tmp_path: Path, data: bytes) -> None:
    store = Store(tmp_path / "store.zarr")
    store.write("s", "n", {"a": ROWS})
    file = store.file("s", "n")
    write_parts(file, parts(file) | {"a/c/0/0": data})
    with pytest.raises(Exception, match=r"is damaged .*does not unpack to 600000 bytes"):
        store.read_rows("s", "n", "a", 0, 5)


def test_files_of_a_run_from_someone_else(city: Path, tmp_path: Path, capsys: Capture) -> None:
    assert call(capsys, *arguments(city)).code == 0
    out = city / "out"
    index = (out / "mesh.pvtu").read_text()
    laughs = '<!DOCTYPE a [<!ENTITY a "aaaaaaaaaa">]>'
    (piece,) = (out / "mesh").iterdir()
    (tmp_path / "secret.vtu").write_bytes(piece.read_bytes())
    changes = {
        "it has declarations": index.replace("<VTKFile", laughs + "<VTKFile", 1),
        "lies outside its folder": index.replace(f"mesh/{piece.name}", "../../secret.vtu"),
        "secret.vtu lies outside": index.replace(f"mesh/{piece.name}", str(tmp_path / "secret.vtu")),
    }
    for message, text in changes.items():
        assert text != index
        (out / "mesh.pvtu").write_text(text)
        found = call(capsys, "export", out, "--format", "vtu", "-o", tmp_path / "a.vtu")
        check_call(found)
        assert found.code == 1
        assert message in found.err
        check_call(call(capsys, "check", out))
    (out / "run.json").write_text('{"schema":' + "[" * 100_000)
    commands: list[list[str | Path]] = [
        ["check", out],
        ["export", out, "--format", "vtu", "-o", tmp_path / "a.vtu"],
    ]
    for command in commands:
        found = call(capsys, *command)
        check_call(found)
        assert found.code == 1


# The code itself

FORBIDDEN = {
    "eval",
    "exec",
    "compile",
    "__import__",
    "loads",
    "load",
    "Unpickler",
    "read_pickle",
    "system",
    "popen",
}
SAFE_MODULES = {"json", "tomllib"}


def suspicious_calls(source: str) -> list[str]:
    """List calls that run or unpickle what they are given, and arguments that let numpy do so."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if not isinstance(node, ast.Call):
            continue
        module = ast.unparse(node.func.value) if isinstance(node.func, ast.Attribute) else ""
        name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
        if name in FORBIDDEN and module not in SAFE_MODULES | {"re"}:
            found.append(ast.unparse(node))
        found += [
            ast.unparse(node) for word in node.keywords if word.arg in {"allow_pickle", "object_codec", "shell"}
        ]
    return found


def test_nothing_that_is_read_is_run_or_unpickled() -> None:
    root = Path(__file__).parents[3]
    files = [path for package in ("pipeline", "stitch", "tiler") for path in (root / package).rglob("*.py")]
    assert len(files) > 50
    found = {call for path in files for call in suspicious_calls(path.read_text())}
    # An error is pickled and unpickled in one process, to learn whether it would survive the way from a worker.
    # Tasks are sent to workers by Dask, which pickles what it sends: who may connect to its scheduler is trusted.
    # What a process remembers of files is in its memory alone, pickled by itself so that each reader gets a copy.
    # What workers of `check`, `generalise` and `texture` and their command leave for each other waits in a folder
    # that it makes for itself alone (TemporaryDirectory); np.load unpickles nothing, if it is not told to.
    assert found == {
        "pickle.loads(pickle.dumps(error))",
        "pickle.loads(known.found[key][1])",
        "loads(packed)",
        "pickle.load(file)",
        "pickle.loads(path.read_bytes())",
        "pickle.loads((work / 'job').read_bytes())",
        "np.load(plants_file(work, camera.name))",
        "np.load(folder / f'{name}.npy', mmap_mode='r')",
        "np.lib.format.write_array(entry, array, version=(1, 0), allow_pickle=False)",
    }


@pytest.mark.parametrize(
    "source",
    [
        "eval(text)",
        "np.load(path)",
        "np.load(path, allow_pickle=True)",
        "pickle.load(file)",
        "exec(code)",
        "os.system(x)",
    ],
)
def test_the_search_finds_what_it_looks_for(source: str) -> None:
    assert suspicious_calls(source)


def test_a_crs_is_read_from_no_file(city: Path, capsys: Capture) -> None:
    (city / "a.prj").write_text(pyproj.CRS.from_epsg(3006).to_wkt())
    for text in (str(city / "a.prj"), f"@{city / 'a.prj'}", "(" * 100_000, "PROJCS[" * 50_000, "{" * 5_000):
        found = call(capsys, *arguments(city, "--crs", text))
        check_call(found)
        assert found.code == 2, found.err[:300]
