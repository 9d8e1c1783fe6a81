"""The content of a tile: glTF 2.0 in one binary file, with features that tell what each vertex belongs to.

Vertices are float32, counted from a place in the tile's middle, with x to the east, y up and z to the south there;
the matrix of the root node puts them on the globe. Normals are bytes (KHR_mesh_quantization); with Draco
(KHR_draco_mesh_compression), coordinates are whole steps of at most `STEP`. Features stand in property tables
(EXT_mesh_features, EXT_structural_metadata).
"""

import json
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tiler.tiles3d.globe import Array, Globe, geocentric, into_frame, local_frame
from tiler.tiles3d.gltf import (
    BYTE,
    CELLS,
    FLOAT,
    INDICES,
    UNSIGNED_INT,
    UNSIGNED_SHORT,
    VERTICES,
    begin_glb,
    make_material,
)
from tiler.tiles3d.metadata import Blob, Column, add_table, describe_class

Ints = NDArray[np.int64]
Region = tuple[float, float, float, float, float, float]  # west, south, east, north (radians), lowest, highest (m)
UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])  # from glTF's axes to those of tiles
EXTENSIONS = ["EXT_mesh_features", "EXT_structural_metadata"]
BYTES, DRACO = "KHR_mesh_quantization", "KHR_draco_mesh_compression"  # and one of these
STEP = 0.001  # m; of Draco's coordinates
NORMAL_BITS, LEVEL = 8, 7  # of Draco's normals, and how hard it tries, of 10
KINDS = {"POSITION": 0, "NORMAL": 1, "_FEATURE_ID_0": 4}  # Draco's types of attributes


@dataclass(frozen=True, eq=False)
class Surface:
    """Triangles, each of a material, on vertices of which each belongs to a feature."""

    #: (n, 3): vertices in the CRS (m). Faces that meet in an edge to be seen have vertices of their own
    xyz: Array
    triangles: Ints  #: (m, 3): their corners, counter-clockwise seen from outside
    material: Ints  #: (m,): `pipeline.data.mesh.Marker`, or the number of a patch of ground
    feature: Ints  #: (n,): row of each vertex in the table of features
    skirt: int = 0  #: how many of the last vertices hang from a border: they are lit like level ground


@dataclass(frozen=True, eq=False)
class Layer:
    """What a tile has of one kind: ``name`` of the node, and class of its features, and a row of each feature."""

    name: str
    surface: Surface
    columns: Mapping[str, Column]


def join_surfaces(parts: list[Surface]) -> Surface:
    """Put surfaces into one; features are numbered as they are."""
    starts = np.cumsum([0, *(len(part.xyz) for part in parts)])
    return Surface(
        np.concatenate([np.empty((0, 3)), *(part.xyz for part in parts)]),
        np.concatenate(
            [np.empty((0, 3), np.int64), *(part.triangles + k for part, k in zip(parts, starts, strict=False))]
        ),
        np.concatenate([np.empty(0, np.int64), *(part.material for part in parts)]),
        np.concatenate([np.empty(0, np.int64), *(part.feature for part in parts)]),
    )


def make_content(
    layers: list[Layer], globe: Globe, names: Callable[[int], str], *, draco: bool = False
) -> tuple[bytes, Region]:
    """Make the content of a tile.

    Parameters
    ----------
    layers : list of Layer
        What it has, none of it empty.
    globe : Globe
        Where the coordinates lie.
    names : callable
        Gives the name of a material.
    draco : bool
        Whether meshes are packed by Draco.

    Returns
    -------
    bytes
        The GLB file.
    Region
        The least region that holds it, the height from the ellipsoid.
    """
    places = [globe.geographic(layer.surface.xyz) for layer in layers]
    low = np.min([some.min(axis=0) for some in places], axis=0)
    high = np.max([some.max(axis=0) for some in places], axis=0)
    middle = (low + high) / 2
    frame = local_frame(float(middle[0]), float(middle[1]), float(low[2]))
    blob = Blob()
    materials = sorted({int(m) for layer in layers for m in np.unique(layer.surface.material)})
    document = _Document(blob, materials, draco=draco)
    for layer, own in zip(layers, places, strict=True):
        document.add(layer, into_frame(frame, geocentric(own))[:, [0, 2, 1]] * [1, 1, -1] + 0.0)
    matrix = UP.T @ frame @ UP + 0.0
    data = blob.bytes()
    text = json.dumps(document.finish(matrix, len(data), names), separators=(",", ":"), allow_nan=False)
    west, south, east, north = np.radians([low[0], low[1], high[0], high[1]]).tolist()
    region = (
        # One step of rounding outwards.
        math.nextafter(west, -math.inf),
        math.nextafter(south, -math.inf),
        math.nextafter(east, math.inf),
        math.nextafter(north, math.inf),
        float(low[2]),
        float(high[2]),
    )
    return begin_glb(text.encode(), len(data)) + data, region


class _Document:
    """The JSON of a content, layer by layer."""

    def __init__(self, blob: Blob, materials: list[int], *, draco: bool) -> None:
        self._blob, self._materials, self._draco = blob, materials, draco
        self._accessors: list[dict[str, Any]] = []
        self._meshes: list[dict[str, Any]] = []
        self._classes: dict[str, Any] = {}
        self._tables: list[dict[str, Any]] = []

    def add(self, layer: Layer, local: Array) -> None:
        """Add a layer, with its vertices (n, 3) in the frame of the tile and glTF's axes."""
        position = local.astype("<f4")
        surface = layer.surface
        drawn = _has_three_places(surface.triangles, position)
        triangles, of = surface.triangles[drawn], surface.material[drawn]
        features = [{"featureCount": _count(layer.columns), "attribute": 0, "propertyTable": len(self._tables)}]
        draw = self._pack if self._draco else self._lay
        normals = _normals(local, triangles, surface.skirt)
        primitives = [
            primitive
            | {
                "material": self._materials.index(material),
                "extensions": primitive.get("extensions", {}) | {"EXT_mesh_features": {"featureIds": features}},
            }
            for material, primitive in draw(position, normals, surface.feature, triangles, of)
        ]
        self._meshes.append({"name": layer.name, "primitives": primitives})
        self._tables.append(add_table(self._blob, layer.name, layer.columns))
        self._classes[layer.name] = describe_class(layer.columns)

    def _lay(
        self, position: NDArray[np.float32], normals: NDArray[np.int8], feature: Ints, triangles: Ints, of: Ints
    ) -> Iterator[tuple[int, dict[str, Any]]]:
        """Give materials and primitives, on vertices that they share."""
        attributes = {
            "POSITION": self._accessor(
                position, FLOAT, "VEC3", min=position.min(axis=0).tolist(), max=position.max(axis=0).tolist()
            ),
            "NORMAL": self._accessor(normals, BYTE, "VEC3", normalized=True),
            "_FEATURE_ID_0": self._accessor(feature.astype("<f4"), FLOAT, "SCALAR"),
        }
        kind, dtype = (UNSIGNED_SHORT, "<u2") if len(position) < 2**16 else (UNSIGNED_INT, "<u4")
        for material in np.unique(of).tolist():
            corners = triangles[of == material].astype(dtype).ravel()
            view = self._blob.add(corners.tobytes(), target=INDICES)
            indices = self._describe(kind, len(corners), "SCALAR", bufferView=view)
            yield material, {"attributes": attributes, "indices": indices}

    def _pack(
        self, position: NDArray[np.float32], normals: NDArray[np.int8], feature: Ints, triangles: Ints, of: Ints
    ) -> Iterator[tuple[int, dict[str, Any]]]:
        """Give materials and primitives, each packed with its vertices."""
        import DracoPy  # not for those who do not ask for it

        low = position.min(axis=0).tolist()
        span = max(float(np.ptp(position, axis=0).max()), STEP)  # of all: what meets, still meets
        number, dtype = (UNSIGNED_SHORT, np.uint16) if feature.max() < 2**16 else (FLOAT, np.float32)
        for material in np.unique(of).tolist():
            used, corner = np.unique(triangles[of == material], return_inverse=True)
            data = DracoPy.encode(
                position[used],
                corner.reshape(-1, 3).astype(np.uint32),
                quantization_bits=math.ceil(math.log2(span / STEP + 1)),
                quantization_range=span,
                quantization_origin=low,
                compression_level=LEVEL,
                normals=normals[used, :3] / 127.0,
                normal_quantization_bits=NORMAL_BITS,
                generic_attributes={0: feature[used, np.newaxis].astype(dtype)},
            )
            mesh = DracoPy.decode(data)  # which may have split or joined vertices
            n, xyz = len(mesh.points), mesh.points
            ends = {"min": xyz.min(axis=0).tolist(), "max": xyz.max(axis=0).tolist()}
            attributes = {
                "POSITION": self._describe(FLOAT, n, "VEC3", **ends),
                "NORMAL": self._describe(FLOAT, n, "VEC3"),
                "_FEATURE_ID_0": self._describe(number, n, "SCALAR"),
            }
            ids = {one["attribute_type"]: one["unique_id"] for one in mesh.attributes}
            named = {name: ids[kind] for name, kind in KINDS.items()}
            packed = {"bufferView": self._blob.add(data), "attributes": named}
            indices = self._describe(UNSIGNED_INT, mesh.faces.size, "SCALAR")
            yield material, {"attributes": attributes, "indices": indices, "extensions": {DRACO: packed}}

    def _accessor(self, values: NDArray[Any], component: int, kind: str, **words: Any) -> int:
        stride = {BYTE: 4}.get(component)
        view = self._blob.add(values.tobytes(), target=VERTICES, **({"byteStride": stride} if stride else {}))
        return self._describe(component, len(values), kind, bufferView=view, **words)

    def _describe(self, component: int, n: int, kind: str, **words: Any) -> int:
        first = {"bufferView": words.pop("bufferView")} if "bufferView" in words else {}
        self._accessors.append(first | {"componentType": component, "count": n, "type": kind} | words)
        return len(self._accessors) - 1

    def finish(self, matrix: Array, size: int, names: Callable[[int], str]) -> dict[str, Any]:
        n = len(self._meshes)
        nodes = [{"mesh": k, "name": mesh["name"]} for k, mesh in enumerate(self._meshes)]
        schema = {"id": "citystitch", "classes": self._classes}
        packed = DRACO if self._draco else BYTES
        return {
            "asset": {"version": "2.0", "generator": "citystitch"},
            "extensionsUsed": [*EXTENSIONS, packed],
            "extensionsRequired": [packed],
            "extensions": {"EXT_structural_metadata": {"schema": schema, "propertyTables": self._tables}},
            "scene": 0,
            "scenes": [{"nodes": [n]}],
            "nodes": [*nodes, {"children": list(range(n)), "matrix": matrix.T.ravel().tolist()}],
            "meshes": self._meshes,
            "materials": [
                make_material(material, names(material)) | {"doubleSided": material == CELLS}
                for material in self._materials
            ],
            "accessors": self._accessors,
            "bufferViews": self._blob.views,
            "buffers": [{"byteLength": size}],
        }


def _count(columns: Mapping[str, Column]) -> int:
    return len(next(iter(columns.values())))


def _has_three_places(triangles: Ints, position: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Tell which triangles (m, 3) have not shrunk to a line in single precision."""
    a, b, c = (position[triangles[:, k]] for k in range(3))
    kept: NDArray[np.bool_] = (a != b).any(axis=1) & (b != c).any(axis=1) & (c != a).any(axis=1)
    return kept


def _normals(xyz: Array, triangles: Ints, skirt: int) -> NDArray[np.int8]:
    """Give unit normals at vertices, the mean of their triangles by area, as bytes (n, 4): the last is 0."""
    a, b, c = (xyz[triangles[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    total = np.zeros_like(xyz)
    for axis in range(3):
        weight = np.repeat(cross[:, axis], 3)
        total[:, axis] = np.bincount(triangles.ravel(), weight, len(xyz))
    total[len(xyz) - skirt :] = 0.0, 1.0, 0.0
    length = np.linalg.norm(total, axis=1, keepdims=True)
    total = np.where(length > 0, total / np.where(length > 0, length, 1), [0.0, 1.0, 0.0])
    found = np.zeros((len(xyz), 4), np.int8)
    found[:, :3] = np.round(127 * total)
    return found
