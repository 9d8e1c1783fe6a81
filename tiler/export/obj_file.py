"""A boundary as Wavefront OBJ: shared vertices, one group a patch."""

from pathlib import Path

from tiler.export.foam_patches import facets_by_key, patch_of_key
from tiler.export.pieces import write_lines
from tiler.export.surface import Surface, keys_asked, place_vertices, survey_surface

VERTEX = "v" + " %24.16e" * 3 + "\n"
VERTEX_BYTES = len(VERTEX % ((0.0,) * 3))


def write_obj(path: Path, surface: Surface, *, buildings: str | None = None) -> None:
    """Write a boundary as OBJ.

    Parameters
    ----------
    path : Path
        The file.
    surface : Surface
        The boundary; facets are counter-clockwise seen from outside the air.
    buildings : {"patches"}, optional
        Give each building, walls and roofs, a group of its own instead of the two.

    Notes
    -----
    Coordinates have 17 digits. Numbers are padded to one width, so that the place of every line is known from
    counts. Memory holds one piece, and a quarter of a byte a point of the mesh. Each piece is read twice.
    """
    keys_of = keys_asked(buildings)
    survey = survey_surface(surface, keys_of)
    digits = len(str(survey.n_vertices))
    line = f"f %{digits}d %{digits}d %{digits}d\n"
    width = 3 * digits + 5
    with path.open("wb") as file:
        file.write(b"# boundary of the air, metres\no boundary\n")
        start = file.tell()
        file.seek(start + survey.n_vertices * VERTEX_BYTES)
        places = {}
        for key, n in survey.facets.items():
            file.write(f"g {patch_of_key(key, surface.ground).name}\n".encode())
            places[key] = file.tell()
            file.seek(n * width, 1)
        file.truncate()
        for k in range(len(surface.names)):
            piece = surface.read(k)
            runs, facets = place_vertices(piece, survey.vertices)
            for first, points in runs:
                file.seek(start + first * VERTEX_BYTES)
                write_lines(file, VERTEX, points)
            for key, rows in facets_by_key(places, keys_of(piece)):
                file.seek(places[key])
                write_lines(file, line, facets[rows] + 1)
                places[key] += len(rows) * width
