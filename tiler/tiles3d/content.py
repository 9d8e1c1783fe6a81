"""The content of a tile: glTF 2.0 in one binary file, with features that tell what each vertex belongs to.

Vertices are float32, counted from a place in the tile's middle, with x to the east, y up and z to the south there;
the matrix of the root node puts them on the globe. Normals are bytes (KHR_mesh_quantization). Features stand in
property tables (EXT_mesh_features, EXT_structural_metadata).
"""

import json
import math
from collections.abc import Callable, Mapping
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
EXTENSIONS = ["EXT_mesh_features", "EXT_structural_metadata", "KHR_mesh_quantization"]


@dataclass(frozen=True, eq=False)
class Surface:
    """Triangles, each of a material, on vertices of which each belongs to a feature.

    Attributes
    ----------
    xyz : float64, (n, 3)
        Vertices in the CRS (m). Faces that meet in an edge to be seen have vertices of their own.
    triangles : int64, (m, 3)
        Their corners, counter-clockwise seen from outside.
    material : int64, (m,)
        `pipeline.data.mesh.Marker`, or the number of a patch of ground.
    feature : int64, (n,)
        Row of each vertex in the table of features.
    skirt : int
        How many of the last vertices hang from a border: they are lit like level ground.
    """

    xyz: Array
    triangles: Ints
    material: Ints
    feature: Ints
    skirt: int = 0


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


def make_content(layers: list[Layer], globe: Globe, names: Callable[[int], str]) -> tuple[bytes, Region]:
    """Make the content of a tile.

    Parameters
    ----------
    layers : list of Layer
        What it has, none of it empty.
    globe : Globe
        Where the coordinates lie.
    names : callable
        Gives the name of a material.

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
    document = _Document(blob, sorted({int(m) for layer in layers for m in np.unique(layer.surface.material)}))
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

    def __init__(self, blob: Blob, materials: list[int]) -> None:
        self._blob, self._materials = blob, materials
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
        n = len(position)
        attributes = {
            "POSITION": self._accessor(
                position, FLOAT, "VEC3", min=position.min(axis=0).tolist(), max=position.max(axis=0).tolist()
            ),
            "NORMAL": self._accessor(_normals(local, triangles, surface.skirt), BYTE, "VEC3", normalized=True),
            "_FEATURE_ID_0": self._accessor(surface.feature.astype("<f4"), FLOAT, "SCALAR"),
        }
        features = [{"featureCount": _count(layer.columns), "attribute": 0, "propertyTable": len(self._tables)}]
        primitives = []
        kind, dtype = (UNSIGNED_SHORT, "<u2") if n < 2**16 else (UNSIGNED_INT, "<u4")
        for material in np.unique(of).tolist():
            corners = triangles[of == material].astype(dtype).ravel()
            view = self._blob.add(corners.tobytes(), target=INDICES)
            self._accessors.append(
                {"bufferView": view, "componentType": kind, "count": len(corners), "type": "SCALAR"}
            )
            primitives.append(
                {
                    "attributes": attributes,
                    "indices": len(self._accessors) - 1,
                    "material": self._materials.index(material),
                    "extensions": {"EXT_mesh_features": {"featureIds": features}},
                }
            )
        self._meshes.append({"name": layer.name, "primitives": primitives})
        self._tables.append(add_table(self._blob, layer.name, layer.columns))
        self._classes[layer.name] = describe_class(layer.columns)

    def _accessor(self, values: NDArray[Any], component: int, kind: str, **words: Any) -> int:
        stride = {BYTE: 4}.get(component)
        view = self._blob.add(values.tobytes(), target=VERTICES, **({"byteStride": stride} if stride else {}))
        self._accessors.append(
            {"bufferView": view, "componentType": component, "count": len(values), "type": kind} | words
        )
        return len(self._accessors) - 1

    def finish(self, matrix: Array, size: int, names: Callable[[int], str]) -> dict[str, Any]:
        n = len(self._meshes)
        nodes = [{"mesh": k, "name": mesh["name"]} for k, mesh in enumerate(self._meshes)]
        schema = {"id": "citystitch", "classes": self._classes}
        return {
            "asset": {"version": "2.0", "generator": "citystitch"},
            "extensionsUsed": EXTENSIONS,
            "extensionsRequired": EXTENSIONS[2:],
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
