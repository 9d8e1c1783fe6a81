"""Uploaded binary glTF (GLB): the triangles of its scene as the faces of one building, in the region's CRS.

Uploads come from strangers, so we read them ourselves. trimesh 5.2, which nothing else here needs, reads a file
that requires Draco as if it did not, opens the file on this machine that a buffer's ``uri`` names, takes places
at 1e300 m, and drops ``asset.extras``, where our own files say where they stand. It refuses cycles of nodes and
cut files as we do, and takes 0.3 s for 500,000 triangles (we 0.8 s).
"""

import json
import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.data.errors import InputError
from tiler.cityinput.faces import FARTHEST, NO_LOD, UNKNOWN, Faces, ModelBuilding, Shape

MAGIC = b"glTF"
MOST_TRIANGLES = 1_000_000
TRIANGLES = 4  # mode of a primitive
# Types of numbers by their codes.
PLACE_TYPES = {5126: "<f4"}
INDEX_TYPES = {5121: "u1", 5123: "<u2", 5125: "<u4"}
Array = NDArray[np.float64]


def read_glb(path: Path, position: Sequence[float] | None = None) -> ModelBuilding:
    """Read all triangles of a GLB file as one building, whose id is the name of the file.

    Parameters
    ----------
    path : Path
        The file: y is up, x east and -z north, in metres.
    position : 3 floats, optional
        Easting, northing and height (m) of its origin in the region's CRS; by default ``asset.extras.origin``, as
        our own files have it.

    Returns
    -------
    ModelBuilding
        Its faces are of unknown kind: which are roofs follows from how they lie.

    Raises
    ------
    InputError
        If the file is damaged, needs an extension or another file, has no or too many triangles, or no position
        is known.

    References
    ----------
    glTF 2.0, https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html
    """
    try:
        document, data = _split(path.read_bytes())
        if needed := document.get("extensionsRequired"):
            raise InputError(f"{path}: needs {', '.join(map(str, needed))}; write it without extensions")
        origin = np.array(position or document["asset"].get("extras", {}).get("origin", ()), np.float64)
        if origin.shape != (3,):
            raise InputError(f"{path}: does not say where it stands; give the position of its origin")
        corners = np.concatenate([np.empty((0, 3)), *_scene(document, data)])
    except (ValueError, KeyError, IndexError, TypeError, AttributeError, struct.error, RecursionError) as error:
        raise InputError(f"{path}: is no GLB file as glTF 2.0 has it ({error!r}); write it anew") from None
    if not len(corners) or not (np.abs(corners) < FARTHEST).all():
        raise InputError(f"{path}: has no triangles in its scene, or some at no place; check it in a viewer")
    xyz = corners[:, [0, 2, 1]] * (1, -1, 1) + origin
    n = len(xyz) // 3
    faces = Faces(xyz, np.arange(0, len(xyz) + 1, 3), np.arange(n + 1), np.full(n, UNKNOWN, np.int8))
    return ModelBuilding(path.stem, (Shape(path.stem, NO_LOD, False, faces),))


def _split(content: bytes) -> tuple[dict[str, Any], bytes]:
    """Give the document and the buffer of a file."""
    magic, version, _ = struct.unpack_from("<4sII", content)
    if magic != MAGIC or version != 2:
        raise ValueError(f"begins with {magic!r}, version {version}")
    length, kind = struct.unpack_from("<I4s", content, 12)
    if kind != b"JSON":
        raise ValueError(f"its first chunk is {kind!r}")
    document = json.loads(content[20 : 20 + length])
    rest = 20 + length
    n, kind = struct.unpack_from("<I4s", content, rest) if len(content) > rest else (0, b"BIN\0")
    data = content[rest + 8 : rest + 8 + n]
    if any("uri" in one for one in document.get("buffers", [])) or kind != b"BIN\0" or len(data) < n:
        raise ValueError("its buffer is elsewhere, or cut off")
    return document, data


def _scene(document: dict[str, Any], data: bytes) -> Iterator[Array]:
    """Give the corners (3 n, 3) of the triangles of each primitive, in the axes of the scene."""
    nodes, left = document["nodes"], MOST_TRIANGLES
    waiting = [(k, np.eye(4)) for k in document["scenes"][document.get("scene", 0)]["nodes"]]
    for _ in range(len(nodes)):  # a node has one parent at most
        if not waiting:
            return
        k, above = waiting.pop()
        matrix = above @ _matrix(nodes[k])
        waiting += [(child, matrix) for child in nodes[k].get("children", ())]
        for primitive in document["meshes"][nodes[k]["mesh"]]["primitives"] if "mesh" in nodes[k] else ():
            if primitive.get("mode", TRIANGLES) > TRIANGLES:
                raise ValueError("has strips or fans of triangles")
            if primitive.get("mode", TRIANGLES) < TRIANGLES:
                continue  # points and lines
            places = _accessor(document, data, primitive["attributes"]["POSITION"], "VEC3")
            number = primitive.get("indices")
            rows = np.arange(len(places)) if number is None else _accessor(document, data, number, "SCALAR")
            left -= len(rows) // 3
            if left < 0 or len(rows) % 3:
                raise ValueError(f"more than {MOST_TRIANGLES:,} triangles, or a part of one")
            yield places[rows.reshape(-1).astype(np.int64)] @ matrix[:3, :3].T + matrix[:3, 3]
    if waiting:
        raise ValueError("a node has several parents")


def _matrix(node: dict[str, Any]) -> Array:
    """Give the transformation of a node, (4, 4)."""
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    x, y, z, w = node.get("rotation", (0.0, 0.0, 0.0, 1.0))
    found = np.eye(4)
    found[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    found[:3, :3] *= node.get("scale", (1.0, 1.0, 1.0))
    found[:3, 3] = node.get("translation", (0.0, 0.0, 0.0))
    return found


def _accessor(document: dict[str, Any], data: bytes, number: int, kind: str) -> NDArray[Any]:
    """Read the rows of an accessor, (n, 3) of places or (n, 1) of indices."""
    found = document["accessors"][number]
    view = document["bufferViews"][found["bufferView"]]
    types = PLACE_TYPES if kind == "VEC3" else INDEX_TYPES
    if found["type"] != kind or "sparse" in found:
        raise ValueError(f"accessor {number} is sparse, or of type {found['type']}")
    dtype, columns, n = np.dtype(types[found["componentType"]]), 3 if kind == "VEC3" else 1, int(found["count"])
    step = view.get("byteStride", columns * dtype.itemsize)
    first, start = view.get("byteOffset", 0), found.get("byteOffset", 0)
    own = data[first : first + view["byteLength"]]
    if min(first, start, n - 1, step - 1) < 0 or start + step * (n - 1) + columns * dtype.itemsize > len(own):
        raise ValueError(f"accessor {number} is beyond its part of the buffer")
    return np.ndarray((n, columns), dtype, own, start, (step, dtype.itemsize))
