"""glTF 2.0 in one binary file: the boundary as one mesh, with a primitive and a material a patch.

glTF has float32 and y up: coordinates are shifted to a local origin and turned, and the file's `extras` tell how.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.data.errors import InputError
from pipeline.data.mesh import Marker
from tiler.export.export import LARGEST_PART, Format
from tiler.export.foam_patches import FIRST_BUILDING, building_name, facets_by_key, is_house, patch_of_key
from tiler.export.surface import (
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
        Give each building a node of its own.

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
    The origin is the middle of the box in whole metres, at its lowest height. All patches share the vertices.
    Memory holds one piece, and a quarter of a byte a point of the mesh. Each piece is read twice.
    """
    keys_of = by_marker if buildings is None else _by_building_and_marker
    survey = survey_surface(surface, keys_of)
    if not survey.n_facets:
        raise InputError("boundary: has no facets, and GLB no empty meshes; mesh the region again")
    origin = np.floor([*(survey.low + survey.high)[:2] / 2, survey.low[2]])
    text = json.dumps(_document(survey, origin, crs, surface.ground), separators=(",", ":")).encode()
    data = _data_bytes(survey)
    head = begin_glb(text, data)
    total = len(head) + data
    if total > MOST_BYTES:
        raise InputError(
            f"boundary: {total} bytes as GLB; bound: {MOST_BYTES}; use --format ply, or mesh a part of the region"
        )
    with path.open("wb") as file:
        file.write(head)
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


def _data_bytes(survey: SurfaceSurvey) -> int:
    return survey.n_vertices * VERTEX_BYTES + survey.n_facets * FACET_BYTES


def _document(
    survey: SurfaceSurvey, origin: NDArray[np.float64], crs: str, ground: tuple[str, ...]
) -> dict[str, Any]:
    # Rounding keeps order, so the corners of the box are turned into the exact least and greatest coordinates.
    box = _local(np.stack((survey.low, survey.high)), origin)
    split = survey.n_vertices * VERTEX_BYTES
    position = {
        "bufferView": 0,
        "componentType": FLOAT,
        "count": survey.n_vertices,
        "type": "VEC3",
        "min": box.min(axis=0).tolist(),
        "max": box.max(axis=0).tolist(),
    }
    indices, place = [], 0
    for n in survey.facets.values():
        accessor = {"bufferView": 1, "componentType": UNSIGNED_INT, "count": 3 * n, "type": "SCALAR"}
        indices.append(accessor | ({"byteOffset": place} if place else {}))
        place += n * FACET_BYTES
    materials = sorted({_of_key(key)[1] for key in survey.facets})
    primitives: dict[int, list[dict[str, Any]]] = {}
    for i, (number, marker) in enumerate(map(_of_key, survey.facets)):
        primitives.setdefault(number, []).append(
            {
                "attributes": {"POSITION": 0},
                "indices": 1 + i,
                "material": materials.index(marker),
                "extras": {"marker": int(marker)},
            }
        )
    names = {number: "boundary" if number < 0 else building_name(number) for number in primitives}
    nodes = [
        {"mesh": i, "name": name} | ({} if number < 0 else {"extras": {"building": number}})
        for i, (number, name) in enumerate(names.items())
    ]
    return {
        "asset": {
            "version": "2.0",
            "generator": "citystitch",
            "extras": {"crs": crs, "origin": origin.tolist(), "axes": AXES},
        },
        "scene": 0,
        "scenes": [{"nodes": list(range(len(nodes)))}],
        "nodes": nodes,
        "meshes": [{"name": names[number], "primitives": parts} for number, parts in primitives.items()],
        "materials": [make_material(marker, patch_of_key(marker, ground).name) for marker in materials],
        "accessors": [position, *indices],
        "bufferViews": [
            {"buffer": 0, "byteLength": split, "target": VERTICES},
            {"buffer": 0, "byteOffset": split, "byteLength": survey.n_facets * FACET_BYTES, "target": INDICES},
        ],
        "buffers": [{"byteLength": _data_bytes(survey)}],
    }


FORMAT = Format(
    "the boundary as glTF 2.0, binary, one material a patch",
    export_glb,
    options=("buildings", LARGEST_PART),
    suffix=".glb",
)
