"""glTF 2.0 in one binary file: a node a building with its id and attributes, a primitive a kind of face.

Each node has a place of its own, so vertices, which are float32, are counted from the building's corner.
"""

import json
import struct
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO, Any

from pipeline.data.errors import InputError
from pipeline.data.mesh import Marker
from tiler.cityinput.faces import DOOR, GROUND, INSTALLATION, ROOF, WALL, WINDOW
from tiler.convert.features import origin_of
from tiler.convert.inputs import ModelSource
from tiler.convert.obj_files import GROUPS
from tiler.convert.triangles import SolidBuilding, iter_triangles
from tiler.formats.glb import AXES
from tiler.georeference.crs import crs_text
from tiler.tiles3d.gltf import COLOURS, FLOAT, INDICES, MOST_BYTES, UNSIGNED_INT, VERTICES

COPY_BYTES = 1 << 20
MATERIALS = {ROOF: Marker.ROOF, WALL: Marker.WALL, GROUND: Marker.GROUND}
# Kinds that detailed buildings have beside those of `GROUPS`: names and colours.
DETAILS = {
    WINDOW: ("window", (0.2, 0.28, 0.36)),
    DOOR: ("door", (0.4, 0.24, 0.14)),
    INSTALLATION: ("installation", (0.6, 0.6, 0.6)),
}
LISTS = ("nodes", "meshes", "accessors")


@dataclass
class _Buffers:
    """Parts of the file as they grow, each in a temporary file: lists of the document, vertices, corners."""

    groups: list[int]  # kinds of faces, in the order of their materials
    lists: dict[str, IO[bytes]]
    vertices: IO[bytes]
    corners: IO[bytes]
    n: dict[str, int] = field(default_factory=lambda: dict.fromkeys(LISTS, 0))

    def append(self, name: str, thing: dict[str, Any]) -> int:
        """Add an entry to a list of the document; gives its number."""
        text = json.dumps(thing, separators=(",", ":"), allow_nan=False).encode("ascii")
        self.lists[name].write((b"," if self.n[name] else b"") + text)
        self.n[name] += 1
        return self.n[name] - 1


def write_glb(path: Path, source: ModelSource, lod: str, *, detailed: bool = False) -> None:
    """Write triangles of one level of detail, with ids as names of nodes and attributes as their extras.

    `detailed`: with materials for windows, doors and installations.

    Raises
    ------
    InputError
        If no building has surfaces, or the file would have 4 GiB or more.
    """
    with ExitStack() as stack:
        files = {name: stack.enter_context(TemporaryFile()) for name in (*LISTS, "vertices", "corners")}
        groups = [*GROUPS, *(DETAILS if detailed else ())]
        buffers = _Buffers(groups, {name: files[name] for name in LISTS}, files["vertices"], files["corners"])
        origin = origin_of(source)
        for one in iter_triangles(source, lod):
            _add(buffers, one, origin)
        if not buffers.n["nodes"]:
            raise InputError("no building has surfaces above level 0, and GLB no empty meshes; give another --lod")
        _assemble(path, buffers, source)


def _add(buffers: _Buffers, one: SolidBuilding, origin: Any) -> None:
    corner = one.xyz.min(axis=0)
    # Adding 0 turns -0 into 0.
    local = ((one.xyz - corner)[:, [0, 2, 1]] * [1, 1, -1] + 0.0).astype("<f4")
    place = {"bufferView": 0, "byteOffset": buffers.vertices.tell(), "componentType": FLOAT, "count": len(local)}
    low, high = local.min(axis=0).tolist(), local.max(axis=0).tolist()
    position = buffers.append("accessors", place | {"type": "VEC3", "min": low, "max": high})
    buffers.vertices.write(local.tobytes())
    primitives = []
    for material, kind in enumerate(buffers.groups):
        rows = one.triangles[one.kind == kind]
        if not len(rows):
            continue
        place = {"bufferView": 1, "byteOffset": buffers.corners.tell(), "componentType": UNSIGNED_INT}
        number = buffers.append("accessors", place | {"count": 3 * len(rows), "type": "SCALAR"})
        buffers.corners.write(rows.astype("<u4").tobytes())
        primitives.append({"attributes": {"POSITION": position}, "indices": number, "material": material})
    mesh = buffers.append("meshes", {"name": one.id, "primitives": primitives})
    east, north, up = (corner - origin).tolist()
    node = {"mesh": mesh, "name": one.id, "translation": [east, up, -north + 0.0]}
    buffers.append("nodes", node | ({"extras": one.attributes} if one.attributes else {}))


def _assemble(path: Path, buffers: _Buffers, source: ModelSource) -> None:
    split, data = buffers.vertices.tell(), buffers.corners.tell()
    n_nodes = buffers.n["nodes"]
    head = {
        "asset": {
            "version": "2.0",
            "generator": "citystitch",
            "extras": {
                "crs": crs_text(source.crs) if source.crs is not None else None,
                "origin": origin_of(source).tolist(),
                "axes": AXES,
            },
        },
        "scene": 0,
        "materials": [_material(kind) for kind in buffers.groups],
        "bufferViews": [
            {"buffer": 0, "byteLength": split, "target": VERTICES},
            {"buffer": 0, "byteOffset": split, "byteLength": data, "target": INDICES},
        ],
        "buffers": [{"byteLength": split + data}],
    }
    first = json.dumps(head, separators=(",", ":"))[:-1].encode("ascii")
    with TemporaryFile() as text:
        text.write(first + b',"scenes":[{"nodes":[')
        for k in range(0, n_nodes, 10_000):
            some = ",".join(map(str, range(k, min(k + 10_000, n_nodes))))
            text.write((f",{some}" if k else some).encode("ascii"))
        text.write(b"]}]")
        for name, file in buffers.lists.items():
            text.write(f',"{name}":['.encode("ascii"))
            _copy(file, text)
            text.write(b"]")
        text.write(b"}")
        text.write(b" " * (-text.tell() % 4))
        size = text.tell()
        total = 28 + size + split + data
        if total > MOST_BYTES:
            raise InputError(f"{total} bytes as GLB; bound: {MOST_BYTES}; convert the files one by one")
        with path.open("wb") as file:
            file.write(struct.pack("<4sII", b"glTF", 2, total) + struct.pack("<I4s", size, b"JSON"))
            _copy(text, file)
            file.write(struct.pack("<I4s", split + data, b"BIN\0"))
            _copy(buffers.vertices, file)
            _copy(buffers.corners, file)


def _copy(source: IO[bytes], target: IO[bytes]) -> None:
    source.seek(0)
    while piece := source.read(COPY_BYTES):
        target.write(piece)


def _material(kind: int) -> dict[str, Any]:
    name, colour = DETAILS[kind] if kind in DETAILS else (GROUPS[kind], COLOURS[MATERIALS.get(kind, Marker.WALL)])
    surface = {"baseColorFactor": [*colour, 1.0], "metallicFactor": 0.0, "roughnessFactor": 1.0}
    return {"name": name, "pbrMetallicRoughness": surface, "doubleSided": True}
