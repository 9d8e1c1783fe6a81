"""Footprint files that pyogrio does not write: blobs of any kind, tables of Shapefiles, extracts of OSM."""

import sqlite3
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyogrio
import pyproj
import shapely

RD = pyproj.CRS("EPSG:28992")
X, Y = 120000.0, 486000.0
BOX = (X, Y, X + 100, Y + 100)
Ring = Sequence[Sequence[float]]


def square(x: float, y: float, size: float = 10) -> Any:
    return shapely.box(X + x, Y + y, X + x + size, Y + y + size)


def blob(kind: int, *parts: bytes, count: int | None = None) -> bytes:
    """Well-known binary of a collection: its kind, the number of parts, and these."""
    return struct.pack("<BII", 1, kind, len(parts) if count is None else count) + b"".join(parts)


def chain(kind: int, points: Ring) -> bytes:
    """Well-known binary of a line or a circular string."""
    flat = [value for point in points for value in point]
    return struct.pack("<BII", 1, kind, len(points)) + struct.pack(f"<{len(flat)}d", *flat)


def face(kind: int, ring: Ring) -> bytes:
    """Well-known binary of a polygon or triangle with one ring."""
    flat = [value for point in ring for value in point]
    return struct.pack("<BIII", 1, kind, 1, len(ring)) + struct.pack(f"<{len(flat)}d", *flat)


def write_gpkg(
    path: Path, blobs: Sequence[Any], *, declared: str = "GEOMETRY", z: int = 0, unindexed: Sequence[int] = ()
) -> Path:
    """Write blobs as the geometries of a GeoPackage, indexed as squares of 10 m in a row, with ids a, b, c.

    Parameters
    ----------
    path : Path
        The file.
    blobs : sequence
        Well-known binary, or what else stands in the column: text, numbers, None, bytes that begin with ``!``
        without a header.
    declared : str
        Type of the layer.
    z : int
        Whether Z is prohibited (0), mandatory (1) or allowed (2).
    unindexed : sequence of int
        Rows that the index does not know.
    """
    squares = np.array([square(10 * k, 5, 9) for k in range(len(blobs))], object)
    ids = np.array([chr(97 + k) for k in range(len(blobs))], object)
    pyogrio.raw.write(
        path, shapely.to_wkb(squares), [ids], ["id"], layer="b", geometry_type="Unknown", crs="EPSG:28992"
    )
    database = sqlite3.connect(path)
    for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'trigger'").fetchall():
        database.execute(f'DROP TRIGGER "{name}"')
    head = b"GP\x00\x01" + struct.pack("<i", 28992)
    for row, value in enumerate(blobs):
        stored = head + value if isinstance(value, bytes) and not value.startswith(b"!") else value
        database.execute("UPDATE b SET geom = ? WHERE fid = ?", (stored, row + 1))
    for row in unindexed:
        database.execute("DELETE FROM rtree_b_geom WHERE id = ?", (row + 1,))
    database.execute("UPDATE gpkg_geometry_columns SET geometry_type_name = ?, z = ?", (declared, z))
    database.commit()
    database.close()
    return path


def write_table(path: Path, column: tuple[str, str, int], values: Sequence[bytes]) -> Path:
    """Write a Shapefile of squares whose table has one column: name, type and width; without a .cpg."""
    squares = np.array([square(15 * k, 5) for k in range(len(values))], object)
    name, kind, width = column
    pyogrio.raw.write(
        path,
        shapely.to_wkb(squares),
        [np.array(["x"] * len(values), object)],
        ["x"],
        geometry_type="Polygon",
        crs="EPSG:28992",
    )
    head = struct.pack("<BBBBIHH20x", 3, 126, 1, 1, len(values), 65, 1 + width)
    head += name.encode().ljust(11, b"\0") + kind.encode() + bytes(4) + struct.pack("<BB", width, 0) + bytes(14)
    rows = [b" " + (value.rjust(width) if kind == "N" else value.ljust(width)) for value in values]
    path.with_suffix(".dbf").write_bytes(head + b"\r" + b"".join(rows) + b"\x1a")
    path.with_suffix(".cpg").unlink(missing_ok=True)
    return path


class OsmTown:
    """Nodes, ways and relations of a small extract."""

    def __init__(self) -> None:
        self.nodes: list[tuple[float, float]] = []
        self.ways: list[tuple[int, list[int], dict[str, str]]] = []
        self.relations: list[tuple[int, list[int], dict[str, str]]] = []
        self.to_degrees = pyproj.Transformer.from_crs(RD, "EPSG:4326", always_xy=True).transform

    def way(self, number: int, outline: Any, **tags: str) -> "OsmTown":
        first = len(self.nodes) + 1
        self.nodes += [self.to_degrees(*xy) for xy in outline.exterior.coords[:-1]]
        refs = [*range(first, len(self.nodes) + 1), first]
        self.ways.append((number, refs, {key.replace("__", ":"): value for key, value in tags.items()}))
        return self

    def relation(self, number: int, ways: list[int], **tags: str) -> "OsmTown":
        self.relations.append((number, ways, {"type": "multipolygon", **tags}))
        return self

    def write_xml(self, path: Path) -> Path:
        def tags(given: dict[str, str]) -> str:
            return "".join(f"<tag k={key!r} v={value!r}/>" for key, value in given.items())

        lines = ["<?xml version='1.0' encoding='UTF-8'?>", "<osm version='0.6'>"]
        lines += [
            f"<node id='{k + 1}' lat='{lat:.9f}' lon='{lon:.9f}'/>" for k, (lon, lat) in enumerate(self.nodes)
        ]
        for number, refs, given in self.ways:
            nodes = "".join(f"<nd ref='{ref}'/>" for ref in refs)
            lines.append(f"<way id='{number}'>{nodes}{tags(given)}</way>")
        for number, members, given in self.relations:
            ways = "".join(f"<member type='way' ref='{ref}' role='outer'/>" for ref in members)
            lines.append(f"<relation id='{number}'>{ways}{tags(given)}</relation>")
        path.write_text("\n".join([*lines, "</osm>"]))
        return path

    def write_pbf(self, path: Path) -> Path:
        texts = [""]

        def index(text: str) -> int:
            if text not in texts:
                texts.append(text)
            return texts.index(text)

        def keys(given: dict[str, str]) -> bytes:
            if not given:
                return b""
            return _field(2, _packed(index(key) for key in given)) + _field(
                3, _packed(index(value) for value in given.values())
            )

        nodes = ways = relations = b""  # a group each: one may not hold different kinds
        for k, (lon, lat) in enumerate(self.nodes):
            place = [_zigzag(k + 1), _zigzag(round(lat * 1e9)), _zigzag(round(lon * 1e9))]
            node = b"\x08" + _varint(place[0]) + b"\x40" + _varint(place[1]) + b"\x48" + _varint(place[2])
            nodes += _field(1, node)
        for number, refs, given in self.ways:
            steps = np.diff([0, *refs]).tolist()
            ways += _field(3, b"\x08" + _varint(number) + keys(given) + _field(8, _packed(map(_zigzag, steps))))
        for number, members, given in self.relations:
            steps = np.diff([0, *members]).tolist()
            roles = _field(8, _packed(index("outer") for _ in members))
            kinds = _field(10, _packed(1 for _ in members))
            body = (
                b"\x08" + _varint(number) + keys(given) + roles + _field(9, _packed(map(_zigzag, steps))) + kinds
            )
            relations += _field(4, body)
        table = b"".join(_field(1, text.encode()) for text in texts)
        block = (
            _field(1, table) + _field(2, nodes) + _field(2, ways) + _field(2, relations) + b"\x88\x01" + _varint(1)
        )  # granularity of 1e-9 degrees
        header = _field(4, b"OsmSchema-V0.6")
        path.write_bytes(_pbf_blob(b"OSMHeader", header) + _pbf_blob(b"OSMData", block))
        return path


def _varint(value: int) -> bytes:
    found = bytearray()
    while value > 0x7F:
        found.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*found, value])


def _zigzag(value: int) -> int:
    return 2 * value if value >= 0 else -2 * value - 1


def _field(number: int, data: bytes) -> bytes:
    return _varint(number << 3 | 2) + _varint(len(data)) + data


def _packed(values: Any) -> bytes:
    return b"".join(map(_varint, values))


def _pbf_blob(kind: bytes, data: bytes) -> bytes:
    body = _field(1, data) + b"\x10" + _varint(len(data))
    head = _field(1, kind) + b"\x18" + _varint(len(body))
    return struct.pack(">I", len(head)) + head + body
