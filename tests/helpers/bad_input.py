"""A tiny city as files, and the command line called on it, for tests with input that is bad on purpose."""

import json
import sqlite3
import struct
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pyogrio
import pyproj
import shapely
from numpy.typing import NDArray

from tests.helpers.cities import Bounds, cloud_over
from tiler.cli.main import main

BOUNDS: Bounds = (318000.0, 6399000.0, 318060.0, 6399060.0)
HOUSE = shapely.box(318020, 6399020, 318040, 6399040)
CODES = {0, 1, 2, 3}
# What keeps one run of the tiny city below a second.
QUICK = ("--mesh-size", "20", "--domain-height", "40", "--tile-size", "1000")


@dataclass(frozen=True)
class Call:
    """What a call of the command line left: exit code and what it printed."""

    code: int
    out: str
    err: str


def write_city(folder: Path, *, suffix: str = "laz") -> Path:
    """Write a cloud of 3,600 points and one house: ``cloud.<suffix>`` and ``house.gpkg``."""
    folder.mkdir(parents=True)
    cloud = cloud_over(BOUNDS, [(HOUSE, 10.0)], ground=2.0)
    write_cloud(folder / f"cloud.{suffix}", cloud.xyz, cloud.classification)
    write_houses(folder / "house.gpkg", [HOUSE])
    return folder


def quick_run(city: Path, out: Path, footprints: str = "house.gpkg") -> list[str | Path]:
    """Words of a quick run of the tiny city; no footprints where ``""`` is given."""
    given: list[str | Path] = ["--footprints", city / footprints] if footprints else []
    return ["run", city / "cloud.laz", *given, "--out", out, *QUICK]


def write_cloud(path: Path, xyz: NDArray[np.float64], classes: Any) -> Path:
    """Write a LAS 1.4 file with a CRS."""
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = np.full(3, 0.01), np.array([318000.0, 6399000.0, 0.0])
    header.add_crs(pyproj.CRS.from_epsg(3006))
    las = laspy.LasData(header)
    las.x, las.y, las.z = xyz.T
    las.classification = np.broadcast_to(np.asarray(classes, np.uint8), len(xyz))
    las.write(str(path))
    return path


def write_houses(
    path: Path, polygons: list[Any], *, ids: list[Any] | None = None, crs: str = "EPSG:3006", **fields: list[Any]
) -> Path:
    """Write footprints, with further fields, in the format of the path's suffix."""
    names = np.array([f"b{k}" for k in range(len(polygons))] if ids is None else ids)
    pyogrio.raw.write(
        path,
        geometry=shapely.to_wkb(np.array(polygons, object)),
        field_data=[names, *map(np.array, fields.values())],
        fields=["id", *fields],
        geometry_type="Unknown" if path.suffix == ".gpkg" else "Polygon",
        crs=crs,
    )
    return path


def put_wkb(path: Path, wkb: bytes) -> None:
    """Put raw well-known binary into every feature of a GeoPackage, past all checks of a writer."""
    with sqlite3.connect(path) as base:
        for (name,) in base.execute("select name from sqlite_master where type = 'trigger'").fetchall():
            base.execute(f'drop trigger "{name}"')
        box = struct.pack("<4d", BOUNDS[0], BOUNDS[2], BOUNDS[1], BOUNDS[3])
        base.execute(f'update "{path.stem}" set geom = ?', (b"GP\0\x03" + struct.pack("<i", 3006) + box + wkb,))
    base.close()


def write_parquet(path: Path, wkb: list[bytes], *, geo: Any = None) -> Path:
    """Write GeoParquet with raw well-known binary."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    crs = pyproj.CRS.from_epsg(3006).to_json_dict()
    geo = (
        {"primary_column": "geometry", "columns": {"geometry": {"encoding": "WKB", "crs": crs}}}
        if geo is None
        else geo
    )
    number: dict[bytes, int] = {}
    rows = [number.setdefault(blob, len(number)) for blob in wkb]  # equal ones are kept once, as Parquet does
    shapes = pa.DictionaryArray.from_arrays(pa.array(rows, pa.int32()), pa.array(list(number), pa.binary()))
    table = pa.table({"id": [f"b{k}" for k in range(len(wkb))], "geometry": shapes})
    text = geo if isinstance(geo, str) else json.dumps(geo)
    pq.write_table(table.replace_schema_metadata({"geo": text}), path)
    return path


def nested_wkb(levels: int, kind: int = 6) -> bytes:
    """Make a multipolygon of a multipolygon of a multipolygon ..."""
    return struct.pack("<BII", 1, kind, 1) * levels + struct.pack("<BII", 1, 3, 0)


def call(capsys: Any, *arguments: str | Path) -> Call:
    """Call the command line in this process."""
    capsys.readouterr()
    try:
        code = main([str(argument) for argument in arguments])
    except SystemExit as stop:  # of argparse
        code = int(stop.code or 0)
    captured = capsys.readouterr()
    return Call(code, captured.out, captured.err)


def call_apart(*arguments: str | Path, megabytes: int, timeout: float = 100) -> Call:
    """Call the command line in a process of its own, which ends with 99 where it took more memory."""
    text = (
        "import sys\n"
        "from tiler.cli.main import main\n"
        "from tiler.engine.task import peak_memory\n"
        "code = main(sys.argv[2:])\n"
        "peak = peak_memory() // 2**20\n"
        "print(f'{peak} MB')\n"
        "sys.exit(99 if peak > int(sys.argv[1]) else code)\n"
    )
    command = [sys.executable, "-c", text, str(megabytes), *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=timeout, check=False)
    return Call(done.returncode, done.stdout, done.stderr)


def check_call(found: Call) -> None:
    """Assert what holds of every call: a documented exit code, no traceback, one line about an error."""
    assert found.code in CODES, found
    assert "Traceback" not in found.err, found.err
    if found.code in {1, 2} and not found.err.startswith("usage:"):
        lines = [line for line in found.err.splitlines() if line]
        assert len(lines) == 1, found.err
        assert lines[0].startswith("citystitch: "), found.err
