"""glTF 2.0 in one binary file: the boundary as one mesh with a primitive a patch, or a node a patch.

glTF has float32 and y up: coordinates are shifted to a local origin and turned, and the file's `extras` tell how.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from shutil import copyfileobj
from tempfile import TemporaryDirectory
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from pipeline.data.errors import InputError
from pipeline.data.mesh import Marker
from tiler.export.export import LARGEST_PART, Format
from tiler.export.foam_patches import FIRST_BUILDING, building_name, facets_by_key, is_house, patch_of_key
from tiler.export.surface import (
    KeysOf,
    Surface,
    SurfacePiece,
    SurfaceSurvey,
    by_marker,
    open_surface,
    place_vertices,
    survey_surface,
)
from tiler.mesh_files.run_files import RunSource, crs_of
from tiler.store.atomic import replacing
from tiler.tiles3d.gltf import FLOAT, INDICES, MOST_BYTES, UNSIGNED_INT, VERTICES, begin_glb, make_material

VERTEX_BYTES = FACET_BYTES = 12
AXES = "x east, y up, z south; easting = origin[0] + x, northing = origin[1] - z, height = origin[2] + y"


def export_glb(output: Path, source: RunSource, *, buildings: str | None = None) -> None:
    """Write the boundary of a finished run as GLB.

    Parameters
    ----------
    output : Path
        The file; it appears whole or not at all.
    source : Path or RunFiles
        Folder of the run.
    buildings : {"patches"}, optional
        Give walls and roofs of each building, and each other patch, a node with vertices of its own.

    Raises
    ------
    InputError
        If the run is not finished, or a file of it is missing or damaged; if the file would be longer than GLB
        allows.
    OutputError
        If the file cannot be written.
    """
    surface = open_surface(source)
    crs = crs_of(source)
    with replacing(output) as part:
        write_glb(part, surface, crs=crs, buildings=buildings)


def write_glb(path: Path, surface: Surface, *, crs: str, buildings: str | None = None) -> None:
    """Write a boundary as GLB.

    Parameters
    ----------
    path : Path
        The file.
    surface : Surface
        The boundary; facets are counter-clockwise seen from outside the air, and drawn from both sides.
    crs : str
        CRS of its coordinates.
    buildings : {"patches"}, optional
        See `export_glb`.

    Raises
    ------
    InputError
        If the boundary is empty, or the file would have 4 GiB or more.

    Notes
    -----
    The origin is the middle of the box in whole metres, at its lowest height. Memory holds one piece, and a
    quarter of a byte a point of the mesh; with ``buildings`` the largest patch, too. Each piece is read twice.
    """
    keys_of = by_marker if buildings is None else _by_building_and_marker
    survey = survey_surface(surface, keys_of)
    if not survey.n_facets:
        raise InputError("boundary: has no facets, and GLB no empty meshes; mesh the region again")
    origin = np.floor([*(survey.low + survey.high)[:2] / 2, survey.low[2]])
    if buildings is None:
        # Rounding keeps order, so the corners of the box are turned into the exact least and greatest coordinates.
        box = _local(np.stack((survey.low, survey.high)), origin)
        ends = box.min(axis=0), box.max(axis=0)
        patches = {key: _Patch(n, 0, survey.n_vertices, *ends) for key, n in survey.facets.items()}
        head = _head(patches, survey.n_vertices, origin, crs, surface.ground, {-1: list(patches)})
        with path.open("wb") as file:
            file.write(head)
            _write_shared(file, surface, survey, keys_of, origin)
        return
    with TemporaryDirectory(dir=path.parent) as folder:
        names = shared, vertices, facets = [Path(folder) / name for name in ("shared", "vertices", "facets")]
        with shared.open("wb") as file:
            _write_shared(file, surface, survey, keys_of, origin)
        patches = _part_patches(shared, vertices, facets, survey)
        n_vertices, nodes = vertices.stat().st_size // VERTEX_BYTES, {key: [key] for key in patches}
        head = _head(patches, n_vertices, origin, crs, surface.ground, nodes)
        with path.open("wb") as file:
            file.write(head)
            for name in names[1:]:
                with name.open("rb") as part:
                    copyfileobj(part, file)


@dataclass(frozen=True, eq=False)
class _Patch:
    """A primitive: facets, and vertices from the first one on, with the ends of their coordinates."""

    n_facets: int
    first: int
    n_vertices: int
    low: NDArray[np.float32]
    high: NDArray[np.float32]


def _write_shared(
    file: BinaryIO, surface: Surface, survey: SurfaceSurvey, keys_of: KeysOf, origin: NDArray[np.float64]
) -> None:
    """Write all vertices, each once, then facets patch by patch."""
    start = file.tell()
    places, place = {}, start + survey.n_vertices * VERTEX_BYTES
    for key, n in survey.facets.items():
        places[key] = place
        place += n * FACET_BYTES
    for k in range(len(surface.names)):
        piece = surface.read(k)
        runs, facets = place_vertices(piece, survey.vertices)
        for first, points in runs:
            file.seek(start + first * VERTEX_BYTES)
            file.write(_local(points, origin).tobytes())
        for key, rows in facets_by_key(places, keys_of(piece)):
            file.seek(places[key])
            file.write(facets[rows].astype("<u4").tobytes())
            places[key] += len(rows) * FACET_BYTES


def _part_patches(shared: Path, vertices: Path, facets: Path, survey: SurfaceSurvey) -> dict[int, _Patch]:
    """Give each patch vertices of its own, from a file of shared ones into two."""
    patches, first = {}, 0
    points = np.memmap(shared, "<f4", "r", shape=(survey.n_vertices, 3))
    with shared.open("rb") as source, vertices.open("wb") as of_vertices, facets.open("wb") as of_facets:
        source.seek(survey.n_vertices * VERTEX_BYTES)
        for key, n in survey.facets.items():
            used, corners = np.unique(np.fromfile(source, "<u4", 3 * n), return_inverse=True)
            own = points[used]
            of_vertices.write(own.tobytes())
            of_facets.write(corners.astype("<u4").tobytes())
            patches[key] = _Patch(n, first, len(used), own.min(axis=0), own.max(axis=0))
            first += len(used)
    return patches


def _by_building_and_marker(piece: SurfacePiece) -> NDArray[np.int64]:
    """Give walls and roofs of a building two keys that follow each other."""
    roof = piece.marker == Marker.ROOF
    keys = FIRST_BUILDING + 2 * piece.building + roof
    return np.where(is_house(piece.marker, piece.building), keys, piece.marker)


def _of_key(key: int) -> tuple[int, int]:
    """Return number of building, -1 for none, and marker of a key."""
    if key < FIRST_BUILDING:
        return -1, key
    number, roof = divmod(key - FIRST_BUILDING, 2)
    return number, Marker.ROOF if roof else Marker.WALL


def _local(points: NDArray[np.float64], origin: NDArray[np.float64]) -> NDArray[np.float32]:
    """Shift points (n, 3) to the origin and turn them: east, up, south. Adding 0 turns -0 into 0."""
    return ((points - origin)[:, [0, 2, 1]] * [1, 1, -1] + 0.0).astype("<f4")


def _head(
    patches: Mapping[int, _Patch],
    n_vertices: int,
    origin: NDArray[np.float64],
    crs: str,
    ground: tuple[str, ...],
    nodes: Mapping[int, list[int]],
) -> bytes:
    """Give what comes before vertices and facets; InputError if the file would be longer than GLB allows."""
    n_facets = sum(patch.n_facets for patch in patches.values())
    sizes = n_vertices * VERTEX_BYTES, n_facets * FACET_BYTES
    document = _document(patches, sizes, origin, crs, ground, nodes)
    head = begin_glb(json.dumps(document, separators=(",", ":")).encode(), sum(sizes))
    total = len(head) + sum(sizes)
    if total > MOST_BYTES:
        raise InputError(
            f"boundary: {total} bytes as GLB; bound: {MOST_BYTES}; use --format ply, or mesh a part of the region"
        )
    return head


def _document(
    patches: Mapping[int, _Patch],
    sizes: tuple[int, int],
    origin: NDArray[np.float64],
    crs: str,
    ground: tuple[str, ...],
    nodes: Mapping[int, list[int]],
) -> dict[str, Any]:
    """Describe the scene; `nodes` has the patches of each by a key, -1 for the whole boundary."""
    materials = sorted({_of_key(key)[1] for key in patches})
    names = {marker: patch_of_key(marker, ground).name for marker in materials}
    accessors: list[dict[str, Any]] = []
    position: dict[int, int] = {}  # accessor by first vertex
    primitives, place = {}, 0
    for key, patch in patches.items():
        marker = _of_key(key)[1]
        if patch.first not in position:
            position[patch.first] = len(accessors)
            offset = patch.first * VERTEX_BYTES
            ends = {"min": patch.low.tolist(), "max": patch.high.tolist()}
            accessors.append(_accessor(0, offset, FLOAT, patch.n_vertices, "VEC3") | ends)
        primitives[key] = {
            "attributes": {"POSITION": position[patch.first]},
            "indices": len(accessors),
            "material": materials.index(marker),
            "extras": {"marker": int(marker)},
        }
        accessors.append(_accessor(1, place, UNSIGNED_INT, 3 * patch.n_facets, "SCALAR"))
        place += patch.n_facets * FACET_BYTES
    told = {key: _name_node(key, names) for key in nodes}
    stride = {"byteStride": VERTEX_BYTES} if len(position) > 1 else {}
    return {
        "asset": {
            "version": "2.0",
            "generator": "citystitch",
            "extras": {"crs": crs, "origin": origin.tolist(), "axes": AXES},
        },
        "scene": 0,
        "scenes": [{"nodes": list(range(len(nodes)))}],
        "nodes": [{"mesh": i} | node for i, node in enumerate(told.values())],
        "meshes": [
            {"name": told[key]["name"], "primitives": [primitives[one] for one in parts]}
            for key, parts in nodes.items()
        ],
        "materials": [make_material(marker, names[marker]) for marker in materials],
        "accessors": accessors,
        "bufferViews": [
            {"buffer": 0, "byteLength": sizes[0], "target": VERTICES} | stride,
            {"buffer": 0, "byteOffset": sizes[0], "byteLength": sizes[1], "target": INDICES},
        ],
        "buffers": [{"byteLength": sum(sizes)}],
    }


def _accessor(view: int, offset: int, component: int, count: int, kind: str) -> dict[str, Any]:
    told = {"bufferView": view, "componentType": component, "count": count, "type": kind}
    return told | ({"byteOffset": offset} if offset else {})


def _name_node(key: int, names: Mapping[int, str]) -> dict[str, Any]:
    """Name a node; no name ends in a digit, as programs number equal names that way."""
    if key < 0:
        return {"name": "boundary"}
    number, marker = _of_key(key)
    if number < 0:
        return {"name": names[marker]}
    return {"name": f"{building_name(number)}_{names[marker]}", "extras": {"building": number}}


FORMAT = Format(
    "the boundary as glTF 2.0, binary, one material a patch",
    export_glb,
    options=("buildings", LARGEST_PART),
    suffix=".glb",
)
