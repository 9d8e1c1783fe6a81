"""Shape measures of tetrahedra and their percentiles, for the report."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.data.kernel import kernel
from pipeline.data.mesh import TetMesh

AT_ONCE = 248  # cells measured together: 24 kB of corners, whose rows do not share the places of a cache
PERCENTILES = (0.0, 0.1, 1.0, 5.0, 50.0, 95.0, 99.0, 99.9, 100.0)


@dataclass(frozen=True, eq=False)
class Quality:
    """Measures of each cell."""

    #: (m,): 3 x inscribed over circumscribed radius: 1 for the regular tetrahedron, 0 for a flat one
    radius_ratio: NDArray[np.float32]
    min_dihedral: NDArray[np.float32]  #: (m,): smallest of the six dihedral angles (degrees): 70.5 at best
    #: (m,): longest edge over 2 sqrt(6) inscribed radii: 1 at best, infinite for a flat one
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


@kernel
def _measure(points: NDArray[np.float64], cells: NDArray[np.int32], result: NDArray[np.float32]) -> None:
    """Measure cells, some at a time: their corners lie by coordinate, so that one instruction takes several."""
    corner, found = np.empty((12, AT_ONCE)), np.empty((3, AT_ONCE))
    for start in range(0, len(cells), AT_ONCE):
        end = min(start + AT_ONCE, len(cells))
        for c in range(start, end):
            for k in range(4):
                for axis in range(3):
                    corner[3 * k + axis, c - start] = points[cells[c, k], axis]
        _measure_some(corner, end - start, found)
        for c in range(start, end):
            result[0, c], result[2, c] = found[0, c - start], found[2, c - start]
            result[1, c] = np.degrees(np.arccos(min(found[1, c - start], 1.0)))


# By numpy's rules, for division by zero: a flat cell has a ratio of 0, or NaN if its corners are on a circle.
@kernel(error_model="numpy")
def _measure_some(corner: NDArray[np.float64], n: int, found: NDArray[np.float64]) -> None:
    """Measure n cells by their corners: radius ratio, cosine of the least dihedral angle, aspect ratio."""
    for c in range(n):
        ux, uy, uz = corner[3, c] - corner[0, c], corner[4, c] - corner[1, c], corner[5, c] - corner[2, c]
        vx, vy, vz = corner[6, c] - corner[0, c], corner[7, c] - corner[1, c], corner[8, c] - corner[2, c]
        wx, wy, wz = corner[9, c] - corner[0, c], corner[10, c] - corner[1, c], corner[11, c] - corner[2, c]
        # Twice the area vectors of the faces opposite to corners 1, 2, 3 and 0, outwards or inwards alike.
        ax, ay, az = vy * wz - vz * wy, vz * wx - vx * wz, vx * wy - vy * wx
        bx, by, bz = wy * uz - wz * uy, wz * ux - wx * uz, wx * uy - wy * ux
        cx, cy, cz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        ox, oy, oz = -ax - bx - cx, -ay - by - cy, -az - bz - cz
        o, a = np.sqrt(ox * ox + oy * oy + oz * oz), np.sqrt(ax * ax + ay * ay + az * az)
        b, d = np.sqrt(bx * bx + by * by + bz * bz), np.sqrt(cx * cx + cy * cy + cz * cz)
        volume = abs(ux * ax + uy * ay + uz * az)
        inner = volume / (o + a + b + d)
        uu, vv, ww = ux * ux + uy * uy + uz * uz, vx * vx + vy * vy + vz * vz, wx * wx + wy * wy + wz * wz
        sx, sy, sz = uu * ax + vv * bx + ww * cx, uu * ay + vv * by + ww * cy, uu * az + vv * bz + ww * cz
        outer = np.sqrt(sx * sx + sy * sy + sz * sz) / (2 * volume)
        found[1, c] = max(
            -(ax * ox + ay * oy + az * oz) / (a * o),
            -(bx * ox + by * oy + bz * oz) / (b * o),
            -(cx * ox + cy * oy + cz * oz) / (d * o),
            -(bx * ax + by * ay + bz * az) / (b * a),
            -(cx * ax + cy * ay + cz * az) / (d * a),
            -(cx * bx + cy * by + cz * bz) / (d * b),
        )
        uv = (ux - vx) ** 2 + (uy - vy) ** 2 + (uz - vz) ** 2
        vw = (vx - wx) ** 2 + (vy - wy) ** 2 + (vz - wz) ** 2
        wu = (wx - ux) ** 2 + (wy - uy) ** 2 + (wz - uz) ** 2
        longest = max(uu, vv, ww, uv, vw, wu)
        found[0, c] = 3 * inner / outer
        found[2, c] = np.sqrt(longest) / (2 * np.sqrt(6.0) * inner)
