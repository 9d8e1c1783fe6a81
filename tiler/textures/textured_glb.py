"""A tile as binary glTF 2.0: a node a building, with textures of pages and colours where no image shows it."""

import json
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.data.errors import InputError
from pipeline.data.mesh import Marker
from tiler.cityinput.faces import ROOF
from tiler.formats.glb import AXES
from tiler.textures.atlas import Slot, draw_pages, pack
from tiler.textures.cameras import Array, rotate
from tiler.textures.images import jpeg
from tiler.textures.paint import Painted
from tiler.textures.surfaces import Surface, Tile
from tiler.tiles3d.gltf import COLOURS, FLOAT, MOST_BYTES, VERTICES, begin_glb

PLAIN = (("roof without image", Marker.ROOF), ("wall without image", Marker.WALL))


def textured_glb(
    tile: Tile, painted: Sequence[Painted | None], extras: Sequence[dict[str, Any]], origin: Array, crs: str | None
) -> bytes:
    """Write a tile.

    Parameters
    ----------
    painted : sequence of Painted or None
        Texels of each surface.
    extras : sequence of dict
        Attributes of each building.
    origin : float64 (3,)
        Place that coordinates count from (m).
    crs : str, optional
        Name of the CRS.

    Raises
    ------
    InputError
        If the file would have 4 GiB or more.
    """
    done = [k for k, one in enumerate(painted) if one is not None]
    parts = [one.pixels for one in painted if one is not None]
    slots, sizes = pack([(part.shape[1], part.shape[0]) for part in parts])
    slot_of = dict(zip(done, slots, strict=True))
    pages = [jpeg(page) for page in draw_pages(slots, sizes, parts)]
    groups: dict[int, dict[int, list[tuple[Array, Array | None]]]] = {}
    for k, surface in enumerate(tile.surfaces):
        one = painted[k]
        plain = len(pages) + (surface.kind != ROOF)
        material = plain if one is None else slot_of[k].page
        uv = None if one is None else _uv(surface, one, slot_of[k], sizes[slot_of[k].page])
        place = (surface.corners.reshape(-1, 3) - origin)[:, [0, 2, 1]] * [1, 1, -1] + 0.0
        groups.setdefault(surface.building, {}).setdefault(material, []).append((place, uv))
    data: list[bytes] = []
    views: list[dict[str, Any]] = []
    lists: dict[str, list[dict[str, Any]]] = {"accessors": [], "meshes": [], "nodes": []}

    size = 0

    def add_view(raw: bytes, **words: Any) -> int:
        nonlocal size
        views.append({"buffer": 0, "byteOffset": size, "byteLength": len(raw), **words})
        data.append(raw + b"\0" * (-len(raw) % 4))
        size += len(data[-1])
        return len(views) - 1

    def add_rows(rows: NDArray[Any], kind: str, **words: Any) -> int:
        view = add_view(rows.tobytes(), target=VERTICES)
        entry = {"bufferView": view, "componentType": FLOAT, "count": len(rows), "type": kind, **words}
        lists["accessors"].append(entry)
        return len(lists["accessors"]) - 1

    for building, own in sorted(groups.items()):
        primitives = []
        for material, rows in sorted(own.items()):
            xyz = np.concatenate([place for place, _ in rows]).astype("<f4")
            box = {"min": xyz.min(axis=0).tolist(), "max": xyz.max(axis=0).tolist()}
            attributes = {"POSITION": add_rows(xyz, "VEC3", **box)}
            if material < len(pages):
                uv = np.concatenate([uv for _, uv in rows if uv is not None]).astype("<f4")
                attributes["TEXCOORD_0"] = add_rows(uv, "VEC2")
            primitives.append({"attributes": attributes, "material": material})
        name = tile.names[building]
        lists["meshes"].append({"name": name, "primitives": primitives})
        lists["nodes"].append({"mesh": len(lists["meshes"]) - 1, "name": name, "extras": extras[building]})
    images = [{"bufferView": add_view(page), "mimeType": "image/jpeg"} for page in pages]
    document = {
        "asset": {
            "version": "2.0",
            "generator": "citystitch",
            "extras": {"crs": crs, "origin": origin.tolist(), "axes": AXES},
        },
        "scene": 0,
        "scenes": [{"nodes": list(range(len(lists["nodes"])))}],
        "materials": [_material(f"page {k}", baseColorTexture={"index": k}) for k in range(len(pages))]
        + [_material(name, baseColorFactor=[*COLOURS[marker], 1.0]) for name, marker in PLAIN],
        "bufferViews": views,
        "buffers": [{"byteLength": size}],
        **lists,
    }
    if pages:
        document["images"], document["samplers"] = images, [{"wrapS": 33071, "wrapT": 33071}]
        document["textures"] = [{"source": k, "sampler": 0} for k in range(len(pages))]
    text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode("ascii")
    if 28 + len(text) + size > MOST_BYTES:
        raise InputError(f"{size} bytes as GLB; bound: {MOST_BYTES}; give a smaller --tile-size")
    return begin_glb(text, size) + b"".join(data)


def _uv(surface: Surface, one: Painted, slot: Slot, page: tuple[int, int]) -> Array:
    local = rotate(surface.axes, surface.corners.reshape(-1, 3) - surface.origin)[:, :2] / one.texel
    local[:, 1] = one.pixels.shape[0] - local[:, 1]
    found: Array = (local + np.array([slot.x, slot.y])) / page
    return found


def _material(name: str, **colour: Any) -> dict[str, Any]:
    surface = {**colour, "metallicFactor": 0.0, "roughnessFactor": 1.0}
    return {"name": name, "pbrMetallicRoughness": surface, "doubleSided": True}
