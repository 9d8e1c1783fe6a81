"""Read 3D Tiles again, by nothing of ours: subtrees, contents, features."""

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
from numpy.typing import NDArray

Cell = tuple[int, int, int]
PACKED = "KHR_draco_mesh_compression"
TYPES = {"SCALAR": 1, "VEC3": 3}
COMPONENTS = {5120: "i1", 5123: "<u2", 5125: "<u4", 5126: "<f4", "FLOAT32": "<f4", "FLOAT64": "<f8"}
UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])


@dataclass
class WalkedTile:
    """A tile as its subtree has it."""

    region: NDArray[np.float64]
    error: float
    content: bool
    children: list[Cell] = field(default_factory=list)


@dataclass
class Part:
    """A mesh of a content: geocentric vertices, triangles by material, feature of each vertex, and their table."""

    places: NDArray[np.float64]
    triangles: dict[str, NDArray[np.int64]]
    feature: NDArray[np.int64]
    table: dict[str, list[Any]]


def split_subtree(path: Path) -> tuple[dict[str, Any], bytes]:
    """Split a subtree into its document and its buffer."""
    data = path.read_bytes()
    n, size = int.from_bytes(data[8:16], "little"), int.from_bytes(data[16:24], "little")
    assert (data[:4], data[4:8], n % 8, size % 8, len(data)) == (b"subt", b"\1\0\0\0", 0, 0, 24 + n + size)
    return json.loads(data[24 : 24 + n]), data[24 + n :]


def _view(document: dict[str, Any], data: bytes, k: int) -> bytes:
    view = document["bufferViews"][k]
    assert view["byteOffset"] % 8 == 0
    return data[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]


def _bits(document: dict[str, Any], data: bytes, said: dict[str, int], n: int) -> list[int]:
    if "constant" in said:
        return list(range(n)) if said["constant"] else []
    packed = np.frombuffer(_view(document, data, said["bitstream"]), np.uint8)
    assert len(packed) == math.ceil(n / 8)
    found: list[int] = np.flatnonzero(np.unpackbits(packed, bitorder="little")[:n]).tolist()
    assert len(found) == said["availableCount"]
    return found


def _morton(code: int, levels: int) -> tuple[int, int]:
    word = f"{code:0{2 * levels}b}" if levels else ""
    return int(word[1::2] or "0", 2), int(word[::2] or "0", 2)


def walk_tree(folder: Path) -> dict[Cell, WalkedTile]:
    """Walk all subtrees from the root."""
    root = json.loads((folder / "tileset.json").read_text())["root"]
    tiling = root["implicitTiling"]
    levels = tiling["subtreeLevels"]
    tiles: dict[Cell, WalkedTile] = {}
    waiting, seen = [(0, 0, 0)], set()
    while waiting:
        level, x, y = waiting.pop()
        path = folder / tiling["subtrees"]["uri"].format(level=level, x=x, y=y)
        seen.add(path)
        document, data = split_subtree(path)
        n = (4**levels - 1) // 3
        there = _bits(document, data, document["tileAvailability"], n)
        filled = set(_bits(document, data, document["contentAvailability"][0], n))
        table = document["propertyTables"][document["tileMetadata"]]
        assert table["count"] == len(there)
        columns = {
            key: np.frombuffer(_view(document, data, table["properties"][key]["values"]), "<f8")
            for key in ("region", "error")
        }
        for row, place in enumerate(there):
            down = next(k for k in range(levels) if place < (4 ** (k + 1) - 1) // 3)
            a, b = _morton(place - (4**down - 1) // 3, down)
            cell = (level + down, (x << down) + a, (y << down) + b)
            region = columns["region"][6 * row : 6 * row + 6]
            tiles[cell] = WalkedTile(region, float(columns["error"][row]), place in filled)
        for code in _bits(document, data, document["childSubtreeAvailability"], 4**levels):
            a, b = _morton(code, levels)
            waiting.append((level + levels, (x << levels) + a, (y << levels) + b))
    for level, x, y in sorted(tiles):
        if level:
            tiles[level - 1, x // 2, y // 2].children.append((level, x, y))
    assert set(folder.glob("subtrees/*/*/*")) == seen
    assert max(level for level, _, _ in tiles) + 1 == tiling["availableLevels"]
    return tiles


def read_content(path: Path) -> tuple[dict[str, Any], dict[str, Part]]:
    """Read a content: its document, and its meshes by name, on the globe."""
    data = path.read_bytes()
    size = int.from_bytes(data[12:16], "little")
    document, body = json.loads(data[20 : 20 + size]), data[28 + size :]
    assert document["buffers"] == [{"byteLength": len(body)}]
    parts = {}
    tables = document["extensions"]["EXT_structural_metadata"]
    matrix = next(np.array(node["matrix"]).reshape(4, 4).T for node in document["nodes"] if "matrix" in node)
    for mesh in document["meshes"]:
        primitives = mesh["primitives"]
        names = [document["materials"][one["material"]]["name"] for one in primitives]
        (ids,) = primitives[0]["extensions"]["EXT_mesh_features"]["featureIds"]
        if PACKED in primitives[0]["extensions"]:
            vertices, feature, triangles = _unpack(document, body, primitives, names)
        else:
            attributes = primitives[0]["attributes"]
            vertices = _accessor(document, body, attributes["POSITION"])
            feature = _accessor(document, body, attributes[f"_FEATURE_ID_{ids['attribute']}"]).ravel()
            triangles = {
                name: _accessor(document, body, one["indices"]).reshape(-1, 3).astype(np.int64)
                for name, one in zip(names, primitives, strict=True)
            }
        position = vertices.astype(np.float64)
        places = (UP @ matrix @ np.column_stack((position, np.ones(len(position)))).T).T[:, :3]
        table = _read_table(document, body, tables, tables["propertyTables"][ids["propertyTable"]])
        assert ids["featureCount"] == len(next(iter(table.values())))
        parts[mesh["name"]] = Part(places, triangles, feature.astype(np.int64), table)
    return document, parts


def _unpack(
    document: dict[str, Any], body: bytes, primitives: list[dict[str, Any]], names: list[str]
) -> tuple[NDArray[Any], NDArray[Any], dict[str, NDArray[np.int64]]]:
    """Unpack primitives of Draco, one after the other."""
    import DracoPy

    places, features, triangles, n = [], [], {}, 0
    for name, primitive in zip(names, primitives, strict=True):
        packed = primitive["extensions"][PACKED]
        mesh = DracoPy.decode(_view(document, body, packed["bufferView"]))
        own = {one["unique_id"]: one["data"] for one in mesh.attributes}
        assert {len(own[k]) for k in packed["attributes"].values()} == {len(mesh.points)}
        for key, k in primitive["attributes"].items():
            assert document["accessors"][k]["count"] == len(own[packed["attributes"][key]])
        assert document["accessors"][primitive["indices"]]["count"] == mesh.faces.size
        places.append(own[packed["attributes"]["POSITION"]])
        features.append(own[packed["attributes"]["_FEATURE_ID_0"]].ravel())
        triangles[name] = mesh.faces.astype(np.int64) + n
        n += len(mesh.points)
    return np.concatenate(places), np.concatenate(features), triangles


def _accessor(document: dict[str, Any], body: bytes, k: int) -> NDArray[Any]:
    accessor = document["accessors"][k]
    width = TYPES[accessor["type"]]
    raw = np.frombuffer(_view(document, body, accessor["bufferView"]), COMPONENTS[accessor["componentType"]])
    stride = document["bufferViews"][accessor["bufferView"]].get("byteStride", 0) // raw.itemsize or width
    found: NDArray[Any] = raw.reshape(-1, stride)[:, :width]
    assert len(found) * width == accessor["count"] * width
    return found


def _read_table(
    document: dict[str, Any], body: bytes, tables: dict[str, Any], table: dict[str, Any]
) -> dict[str, list[Any]]:
    found: dict[str, list[Any]] = {}
    properties = tables["schema"]["classes"][table["class"]]["properties"]
    for key, words in table["properties"].items():
        values = _view(document, body, words["values"])
        if properties[key]["type"] == "STRING":
            ends = np.frombuffer(_view(document, body, words["stringOffsets"]), "<u4").tolist()
            found[key] = [values[a:b].decode() for a, b in pairwise(ends)]
        else:
            numbers = np.frombuffer(values, COMPONENTS[properties[key]["componentType"]]).tolist()
            found[key] = [None if value == properties[key]["noData"] else value for value in numbers]
        assert len(found[key]) == table["count"]
    return found


def contents(folder: Path) -> Iterator[tuple[Cell, Path]]:
    """Give the contents that lie in a tileset."""
    for path in sorted(folder.glob("content/*/*/*.glb")):
        level, x = path.parts[-3:-1]
        yield (int(level), int(x), int(path.stem)), path


def to_degrees(places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Give longitude, latitude (degrees) and height (m) of geocentric places."""
    back = pyproj.Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True)
    return np.column_stack(back.transform(*places.T))


def ellipsoid(places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Give geocentric places of longitude, latitude (degrees) and height (m) by the formula of WGS 84."""
    a, f = 6_378_137.0, 1 / 298.257223563
    lon, lat = np.radians(places[:, :2]).T
    e2 = f * (2 - f)
    n = a / np.sqrt(1 - e2 * np.sin(lat) ** 2)
    h = places[:, 2]
    return np.column_stack(
        (
            (n + h) * np.cos(lat) * np.cos(lon),
            (n + h) * np.cos(lat) * np.sin(lon),
            (n * (1 - e2) + h) * np.sin(lat),
        )
    )
