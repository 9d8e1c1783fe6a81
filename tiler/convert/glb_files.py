"""glTF 2.0 in one binary file: a node a building with its id and attributes, a primitive a kind of face.

Each node has a place of its own, so vertices, which are float32, are counted from the building's corner.
"""

import json
import math
import struct
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from pipeline.architecture import surfaces
from pipeline.data.errors import InputError
from pipeline.data.mesh import Marker
from pipeline.facades.pictures import BALCONY
from tiler.cityinput.faces import DOOR, GROUND, INSTALLATION, PICTURED, ROOF, WALL, WINDOW
from tiler.convert.features import origin_of
from tiler.convert.inputs import ModelSource
from tiler.convert.obj_files import GROUPS
from tiler.convert.picture_pages import PAGE, Pages
from tiler.convert.triangles import SolidBuilding, iter_triangles
from tiler.formats.glb import AXES
from tiler.georeference.crs import crs_text
from tiler.tiles3d.gltf import COLOURS, FLOAT, INDICES, MOST_BYTES, UNSIGNED_INT, VERTICES

Array = NDArray[np.float64]
COPY_BYTES = 1 << 20
MATERIALS = {ROOF: Marker.ROOF, WALL: Marker.WALL, GROUND: Marker.GROUND}
# Kinds that detailed buildings have beside those of `GROUPS`: names and colours.
DETAILS = {
    WINDOW: ("window", (0.2, 0.28, 0.36)),
    DOOR: ("door", (0.4, 0.24, 0.14)),
    INSTALLATION: ("installation", (0.6, 0.6, 0.6)),
}
# Of views with vertices, corners and places on pages; and bytes of a row, where accessors share a view.
TARGETS = {0: {"target": VERTICES}, 1: {"target": INDICES}, 2: {"target": VERTICES}}
STRIDES = {0: 12, 2: 8}
SAMPLER = {"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071}  # smooth, clamped at the edge
LISTS = ("nodes", "meshes", "accessors")


@dataclass
class _Buffers:
    """Parts of the file as they grow, each in a temporary file: lists of the document, vertices, corners."""

    groups: list[int]  # kinds of faces, in the order of their materials
    lists: dict[str, IO[bytes]]
    vertices: IO[bytes]
    corners: IO[bytes]
    on_pages: IO[bytes]  # places on pages, of vertices that show pictures
    pages: Pages
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
        parts = ("vertices", "corners", "on_pages", "pages")
        files = {name: stack.enter_context(TemporaryFile()) for name in (*LISTS, *parts)}
        lists: dict[str, IO[bytes]] = {name: files[name] for name in LISTS}
        vertices, corners, on_pages, pages = (files[name] for name in parts)
        groups = [*GROUPS, *(DETAILS if detailed else ())]
        own = Pages(picture_colours(), pages)
        buffers = _Buffers(groups, lists, vertices, corners, on_pages, own)
        origin = origin_of(source)
        for one in iter_triangles(source, lod):
            _add(buffers, one, origin)
        if not buffers.n["nodes"]:
            raise InputError("no building has surfaces above level 0, and GLB no empty meshes; give another --lod")
        _assemble(path, buffers, source)


def _add(buffers: _Buffers, one: SolidBuilding, origin: Any) -> None:
    corner = one.xyz.min(axis=0)
    position = _add_vertices(buffers, one.xyz - corner)
    primitives = []
    for material, kind in enumerate(buffers.groups):
        rows = one.triangles[one.kind == kind]
        if not len(rows):
            continue
        number = _add_corners(buffers, rows)
        primitives.append({"attributes": {"POSITION": position}, "indices": number, "material": material})
    primitives += _add_pictures(buffers, one, corner)
    mesh = buffers.append("meshes", {"name": one.id, "primitives": primitives})
    east, north, up = (corner - origin).tolist()
    node = {"mesh": mesh, "name": one.id, "translation": [east, up, -north + 0.0]}
    buffers.append("nodes", node | ({"extras": one.attributes} if one.attributes else {}))


def _add_vertices(buffers: _Buffers, local: Array) -> int:
    # Adding 0 turns -0 into 0.
    turned = (local[:, [0, 2, 1]] * [1, 1, -1] + 0.0).astype("<f4")
    place = {"bufferView": 0, "byteOffset": buffers.vertices.tell(), "componentType": FLOAT, "count": len(local)}
    low, high = turned.min(axis=0).tolist(), turned.max(axis=0).tolist()
    buffers.vertices.write(turned.tobytes())
    return buffers.append("accessors", place | {"type": "VEC3", "min": low, "max": high})


def _add_corners(buffers: _Buffers, triangles: NDArray[np.int64]) -> int:
    place = {"bufferView": 1, "byteOffset": buffers.corners.tell(), "componentType": UNSIGNED_INT}
    buffers.corners.write(triangles.astype("<u4").tobytes())
    return buffers.append("accessors", place | {"count": triangles.size, "type": "SCALAR"})


def _add_pictures(buffers: _Buffers, one: SolidBuilding, corner: Array) -> Iterator[dict[str, Any]]:
    """Add the triangles that show pictures: a primitive a page, with vertices of its own."""
    triangles = one.triangles[one.kind == PICTURED]
    by_page: dict[int, list[tuple[Array, Array]]] = {}
    for k in np.unique(one.picture).tolist():
        picture = one.pictures[k]
        place = buffers.pages.place(picture)
        xyz = one.xyz[triangles[one.picture == k].ravel()]
        flat = picture.frame.to_local(xyz)[:, [0, 2]] / place.pixel
        by_page.setdefault(place.page, []).append((xyz, [place.left, place.low] + flat * [1, -1]))
    for page, parts in by_page.items():
        xyz, pixels = (np.concatenate(some) for some in zip(*parts, strict=True))
        position = _add_vertices(buffers, xyz - corner)
        rows = {"bufferView": 2, "byteOffset": buffers.on_pages.tell(), "componentType": FLOAT, "count": len(xyz)}
        on_page = buffers.append("accessors", rows | {"type": "VEC2"})
        buffers.on_pages.write((pixels / PAGE).astype("<f4").tobytes())
        yield {
            "attributes": {"POSITION": position, "TEXCOORD_0": on_page},
            "indices": _add_corners(buffers, np.arange(len(xyz)).reshape(-1, 3)),
            "material": len(buffers.groups) + page,
        }


def picture_colours() -> dict[str, tuple[int, int, int]]:
    """Colours of materials, which are linear, as sRGB."""
    linear = {surfaces.WALL: COLOURS[Marker.WALL], BALCONY: DETAILS[INSTALLATION][1]}
    linear |= {surfaces.WINDOW: DETAILS[WINDOW][1], surfaces.DOOR: DETAILS[DOOR][1]}

    def encode(value: float) -> int:
        return round(255 * (1.055 * math.pow(value, 1 / 2.4) - 0.055))

    return {kind: (encode(red), encode(green), encode(blue)) for kind, (red, green, blue) in linear.items()}


def _assemble(path: Path, buffers: _Buffers, source: ModelSource) -> None:
    n_nodes = buffers.n["nodes"]
    buffers.pages.close()
    sizes = [buffers.vertices.tell(), buffers.corners.tell()]
    pages = buffers.pages.sizes
    if pages:
        sizes += [buffers.on_pages.tell(), *pages]
    data, shared = sum(sizes), n_nodes > 1 or bool(pages)
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
        "materials": [*map(_material, buffers.groups), *map(_page_material, range(len(pages)))],
        "bufferViews": [
            {"buffer": 0, **({"byteOffset": sum(sizes[:k])} if k else {}), "byteLength": size}
            | TARGETS.get(k, {})
            | ({"byteStride": STRIDES[k]} if k in STRIDES and shared else {})
            for k, size in enumerate(sizes)
        ],
        "buffers": [{"byteLength": data}],
    }
    if pages:
        head["images"] = [{"bufferView": len(TARGETS) + k, "mimeType": "image/png"} for k in range(len(pages))]
        head["textures"] = [{"sampler": 0, "source": k} for k in range(len(pages))]
        head["samplers"] = [SAMPLER]
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
        total = 28 + size + data
        if total > MOST_BYTES:
            raise InputError(f"{total} bytes as GLB; bound: {MOST_BYTES}; convert the files one by one")
        with path.open("wb") as file:
            file.write(struct.pack("<4sII", b"glTF", 2, total) + struct.pack("<I4s", size, b"JSON"))
            _copy(text, file)
            file.write(struct.pack("<I4s", data, b"BIN\0"))
            for part in (buffers.vertices, buffers.corners, buffers.on_pages, buffers.pages.file):
                _copy(part, file)


def _copy(source: IO[bytes], target: IO[bytes]) -> None:
    source.seek(0)
    while piece := source.read(COPY_BYTES):
        target.write(piece)


def _material(kind: int) -> dict[str, Any]:
    name, colour = DETAILS[kind] if kind in DETAILS else (GROUPS[kind], COLOURS[MATERIALS.get(kind, Marker.WALL)])
    surface = {"baseColorFactor": [*colour, 1.0], "metallicFactor": 0.0, "roughnessFactor": 1.0}
    return {"name": name, "pbrMetallicRoughness": surface, "doubleSided": True}


def _page_material(page: int) -> dict[str, Any]:
    surface = {"baseColorTexture": {"index": page}, "metallicFactor": 0.0, "roughnessFactor": 1.0}
    return {"name": f"pictures-{page + 1}", "pbrMetallicRoughness": surface, "doubleSided": True}
