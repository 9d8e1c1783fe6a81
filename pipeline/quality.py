"""Shape measures of tetrahedra and their percentiles, for the report."""

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from pipeline.mesh import TetMesh

PERCENTILES = (0.0, 0.1, 1.0, 5.0, 50.0, 95.0, 99.0, 99.9, 100.0)


@dataclass(frozen=True, eq=False)
class Quality:
    """Measures of each cell.

    Attributes
    ----------
    radius_ratio : float32, (m,)
        3 x inscribed over circumscribed radius: 1 for the regular tetrahedron, 0 for a flat one.
    min_dihedral : float32, (m,)
        Smallest of the six dihedral angles (degrees): 70.5 at best.
    aspect_ratio : float32, (m,)
        Longest edge over 2 sqrt(6) inscribed radii: 1 at best.
    """

    radius_ratio: NDArray[np.float32]
    min_dihedral: NDArray[np.float32]
    aspect_ratio: NDArray[np.float32]


def measure_cells(mesh: TetMesh) -> Quality:
    """Measure every cell.

    Examples
    --------
    >>> corner = TetMesh(np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]),
    ...                  np.array([[0, 1, 3, 2]], dtype=np.int32))
    >>> regular = measure_cells(corner)
    >>> round(float(regular.radius_ratio[0]), 5), round(float(regular.min_dihedral[0]), 3)
    (1.0, 70.529)
    """
    result = np.empty((3, len(mesh.cells)), np.float32)
    _measure(mesh.points, mesh.cells, result)
    return Quality(result[0], result[1], result[2])


def quality_percentiles(quality: Quality) -> dict[str, dict[str, float]]:
    """Percentiles of each measure, by name and percentile."""
    table = {}
    for name in ("radius_ratio", "min_dihedral", "aspect_ratio"):
        values = np.percentile(getattr(quality, name), PERCENTILES)
        table[name] = {f"{p:g}": round(float(v), 4) for p, v in zip(PERCENTILES, values, strict=True)}
    return table


@numba.njit(cache=True, nogil=True)
def _measure(points: NDArray[np.float64], cells: NDArray[np.int32], result: NDArray[np.float32]) -> None:
    normal = np.empty((4, 3))
    size = np.empty(4)
    for c in range(len(cells)):
        p0 = points[cells[c, 0]]
        u = points[cells[c, 1]] - p0
        v = points[cells[c, 2]] - p0
        w = points[cells[c, 3]] - p0
        # Normals of the faces opposite to corners 1, 2, 3, 0, each twice the face's area long.
        normal[1] = np.cross(v, w)
        normal[2] = np.cross(w, u)
        normal[3] = np.cross(u, v)
        normal[0] = -(normal[1] + normal[2] + normal[3])
        volume6 = abs(np.dot(u, normal[1]))
        surface2 = 0.0
        for k in range(4):
            size[k] = np.sqrt(np.dot(normal[k], normal[k]))
            surface2 += size[k]
        inner = volume6 / surface2
        centre = np.dot(u, u) * normal[1] + np.dot(v, v) * normal[2] + np.dot(w, w) * normal[3]
        outer = np.sqrt(np.dot(centre, centre)) / (2 * volume6)
        steepest = -1.0
        for i in range(4):
            for j in range(i):
                steepest = max(steepest, -np.dot(normal[i], normal[j]) / (size[i] * size[j]))
        longest = max(np.dot(u, u), np.dot(v, v), np.dot(w, w))
        longest = max(longest, np.dot(u - v, u - v), np.dot(v - w, v - w), np.dot(w - u, w - u))
        result[0, c] = 3 * inner / outer
        result[1, c] = np.degrees(np.arccos(min(steepest, 1.0)))
        result[2, c] = np.sqrt(longest) / (2 * np.sqrt(6.0) * inner)
