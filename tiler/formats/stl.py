"""STL as text: the boundary with one solid a patch.

Text, not binary: a binary file holds one solid without a name, and its coordinates are float32, which far from
the CRS's origin rounds them by centimetres. Programs that tell patches apart, as snappyHexMesh and
surfaceFeatures do, take them from the text.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tiler.export.export import PER_BUILDING, Format
from tiler.export.foam_patches import facets_by_key, patch_of_key
from tiler.export.pieces import slices
from tiler.export.surface import Surface, keys_asked, survey_surface, write_surface

_CORNER = "      vertex" + " %23.16e" * 3 + "\n"
# Each number has the same width, so that the place of every facet is known from counts.
FACET = "  facet normal" + " %13.6e" * 3 + "\n    outer loop\n" + _CORNER * 3 + "    endloop\n  endfacet\n"
FACET_BYTES = len(FACET % ((0.0,) * 12))


def write_stl(path: Path, surface: Surface, *, buildings: str | None = None) -> None:
    """Write a boundary as STL.

    Parameters
    ----------
    path : Path
        The file.
    surface : Surface
        The boundary; normals point out of the air.
    buildings : {"patches"}, optional
        Give each building, walls and roofs, a solid of its own instead of the two.

    Notes
    -----
    Coordinates have 17 digits, so vertices that facets share read as equal float64. Memory holds one piece. Each
    piece is read twice.
    """
    keys_of = keys_asked(buildings)
    survey = survey_surface(surface, keys_of)
    with path.open("wb") as file:
        places = {}
        for key, n in survey.facets.items():
            name = patch_of_key(key, surface.ground).name
            file.write(f"solid {name}\n".encode())
            places[key] = file.tell()
            file.seek(n * FACET_BYTES, 1)
            file.write(f"endsolid {name}\n".encode())
        for k in range(len(surface.names)):
            piece = surface.read(k)
            for key, chosen in facets_by_key(places, keys_of(piece)):
                file.seek(places[key])
                for rows in slices(len(chosen)):
                    file.write(_render(piece.points[piece.facets[chosen[rows]]]))
                places[key] += len(chosen) * FACET_BYTES


def _render(corners: NDArray[np.float64]) -> bytes:
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    # Adding 0 turns -0 into 0; a component below 1e-99 would need a digit more.
    normal = np.divide(normal, length, out=np.zeros_like(normal), where=length > 0).round(12) + 0.0
    rows = np.column_stack((normal, _wide_enough(corners).reshape(-1, 9)))
    return (FACET * len(rows) % tuple(rows.ravel().tolist())).encode()


def _wide_enough(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Take for 0 what needs three digits of exponent: no metre is that short."""
    return np.where(np.abs(values) < 1e-99, 0.0, values)


FORMAT = Format(
    "the boundary as STL, text, one solid a patch", write_surface(write_stl), options=PER_BUILDING, suffix=".stl"
)
