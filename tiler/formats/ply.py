"""PLY, binary: the boundary with shared vertices, and the marker and building of each facet."""

from pathlib import Path

import numpy as np

from pipeline.data.errors import InputError
from tiler.export.export import LARGEST_PART, ORIGIN, Format
from tiler.export.foam_patches import patch_of_key
from tiler.export.surface import Surface, SurfaceSurvey, place_vertices, survey_surface, write_surface

VERTEX_BYTES = 24
# PLY has no integers of 64 bits; the number of a building is below 2^53, so a double holds it exactly.
FACE = np.dtype([("n", "u1"), ("vertex", "<i4", 3), ("marker", "<i4"), ("building", "<f8")])
MOST_VERTICES = 2**31


def write_ply(path: Path, surface: Surface) -> None:
    """Write a boundary as PLY.

    Parameters
    ----------
    path : Path
        The file.
    surface : Surface
        The boundary; facets are counter-clockwise seen from outside the air.

    Raises
    ------
    InputError
        If it has more than 2^31 vertices.

    Notes
    -----
    Vertices stand in the order of their numbers, facets piece by piece. Memory holds one piece, and a quarter of a
    byte a point of the mesh. Each piece is read twice.
    """
    survey = survey_surface(surface)
    if survey.n_vertices > MOST_VERTICES:
        raise InputError(
            f"boundary: {survey.n_vertices} vertices; PLY's bound: {MOST_VERTICES}; export parts of the region"
        )
    with path.open("wb") as file:
        file.write(_header(survey, surface.ground))
        start = file.tell()
        face = start + survey.n_vertices * VERTEX_BYTES
        for k in range(len(surface.names)):
            piece = surface.read(k)
            runs, facets = place_vertices(piece, survey.vertices)
            for first, points in runs:
                file.seek(start + first * VERTEX_BYTES)
                file.write(np.ascontiguousarray(points, "<f8").data)
            rows = np.empty(len(facets), FACE)
            rows["n"], rows["vertex"], rows["marker"], rows["building"] = 3, facets, piece.marker, piece.building
            file.seek(face)
            file.write(rows.tobytes())
            face += rows.nbytes


def _header(survey: SurfaceSurvey, ground: tuple[str, ...]) -> bytes:
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment marker {key} {patch_of_key(key, ground).name}" for key in survey.facets),
        f"element vertex {survey.n_vertices}",
        *(f"property double {axis}" for axis in "xyz"),
        f"element face {survey.n_facets}",
        "property list uchar int vertex_indices",
        "property int marker",
        "property double building",
        "end_header",
        "",
    ]
    return "\n".join(lines).encode()


FORMAT = Format(
    "the boundary as PLY, binary, with marker and building",
    write_surface(write_ply),
    options=(LARGEST_PART, ORIGIN),
    suffix=".ply",
)
