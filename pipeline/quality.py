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
    # Twice the area vector of the faces opposite to corners 0, 1, 2, 3, outwards or inwards alike.
    nx, ny, nz = np.empty(4), np.empty(4), np.empty(4)
    size = np.empty(4)
    for c in range(len(cells)):
        p = points[cells[c, 0]]
        ux, uy, uz = points[cells[c, 1], 0] - p[0], points[cells[c, 1], 1] - p[1], points[cells[c, 1], 2] - p[2]
        vx, vy, vz = points[cells[c, 2], 0] - p[0], points[cells[c, 2], 1] - p[1], points[cells[c, 2], 2] - p[2]
        wx, wy, wz = points[cells[c, 3], 0] - p[0], points[cells[c, 3], 1] - p[1], points[cells[c, 3], 2] - p[2]
        nx[1], ny[1], nz[1] = vy * wz - vz * wy, vz * wx - vx * wz, vx * wy - vy * wx
        nx[2], ny[2], nz[2] = wy * uz - wz * uy, wz * ux - wx * uz, wx * uy - wy * ux
        nx[3], ny[3], nz[3] = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        nx[0], ny[0], nz[0] = -nx[1] - nx[2] - nx[3], -ny[1] - ny[2] - ny[3], -nz[1] - nz[2] - nz[3]
        surface = 0.0
        for k in range(4):
            size[k] = np.sqrt(nx[k] * nx[k] + ny[k] * ny[k] + nz[k] * nz[k])
            surface += size[k]
        volume = abs(ux * nx[1] + uy * ny[1] + uz * nz[1])
        inner = volume / surface
        uu, vv, ww = ux * ux + uy * uy + uz * uz, vx * vx + vy * vy + vz * vz, wx * wx + wy * wy + wz * wz
        sx = uu * nx[1] + vv * nx[2] + ww * nx[3]
        sy = uu * ny[1] + vv * ny[2] + ww * ny[3]
        sz = uu * nz[1] + vv * nz[2] + ww * nz[3]
        outer = np.sqrt(sx * sx + sy * sy + sz * sz) / (2 * volume)
        sharpest = -1.0
        for i in range(4):
            for j in range(i):
                cosine = -(nx[i] * nx[j] + ny[i] * ny[j] + nz[i] * nz[j]) / (size[i] * size[j])
                sharpest = max(sharpest, cosine)
        longest = max(
            uu,
            vv,
            ww,
            (ux - vx) ** 2 + (uy - vy) ** 2 + (uz - vz) ** 2,
            (vx - wx) ** 2 + (vy - wy) ** 2 + (vz - wz) ** 2,
            (wx - ux) ** 2 + (wy - uy) ** 2 + (wz - uz) ** 2,
        )
        result[0, c] = 3 * inner / outer
        result[1, c] = np.degrees(np.arccos(min(sharpest, 1.0)))
        result[2, c] = np.sqrt(longest) / (2 * np.sqrt(6.0) * inner)
