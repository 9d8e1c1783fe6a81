"""Points over the lower surface of a mesh: which triangle is below each, and how high the surface is there."""

import numpy as np
from numpy.typing import NDArray

from pipeline.data.kernel import kernel
from pipeline.data.mesh import ColumnMesh

CELL = 4.0  # m, side of a cell of the index of points
NOWHERE = -1


def measure_surface(mesh: ColumnMesh, xyz: NDArray[np.float64]) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
    """Find the triangle of ground or roof over or under each point, and its height there.

    Parameters
    ----------
    mesh : ColumnMesh
        Columns, with ground and roofs as their lowest levels.
    xyz : float64, (n, 3)
        Points (m).

    Returns
    -------
    triangle : int32, (n,)
        Row of the plane mesh's triangles, the first of those that have the point on their border; -1 where there
        is none.
    residual : float64, (n,)
        Height of the surface minus that of the point (m); NaN where there is no triangle.

    Notes
    -----
    O(n log n) to sort the points into cells; each triangle looks at those in the cells that it touches.
    """
    plane, bottom = mesh.plane, mesh.bottom
    heights = mesh.z[mesh.z_start[plane.triangles] + bottom]
    triangle = np.full(len(xyz), NOWHERE, np.int32)
    residual = np.full(len(xyz), np.nan)
    if not len(xyz) or not len(bottom):
        return triangle, residual
    low = xyz[:, :2].min(axis=0)
    cell = np.floor((xyz[:, :2] - low) / CELL).astype(np.int64)
    n_x, n_y = (cell.max(axis=0) + 1).tolist()
    number = cell[:, 1] * n_x + cell[:, 0]
    order = np.argsort(number, kind="stable")
    start = np.searchsorted(number[order], np.arange(n_x * n_y + 1))
    corners = np.dstack([plane.xy[plane.triangles], heights])
    _locate(corners, xyz, order, start, (n_x, n_y), low, triangle, residual)
    return triangle, residual


@kernel
def _locate(
    corners: NDArray[np.float64],
    xyz: NDArray[np.float64],
    order: NDArray[np.int64],
    start: NDArray[np.int64],
    size: tuple[int, int],
    low: NDArray[np.float64],
    triangle: NDArray[np.int32],
    residual: NDArray[np.float64],
) -> None:
    for t in range(len(corners)):
        px, py, qx, qy = corners[t, 0, 0], corners[t, 0, 1], corners[t, 1, 0], corners[t, 1, 1]
        rx, ry = corners[t, 2, 0], corners[t, 2, 1]
        area = (qx - px) * (ry - py) - (qy - py) * (rx - px)
        if area == 0:
            continue
        i0 = max(0, int((min(px, qx, rx) - low[0]) // CELL))
        i1 = min(size[0] - 1, int((max(px, qx, rx) - low[0]) // CELL))
        j0 = max(0, int((min(py, qy, ry) - low[1]) // CELL))
        j1 = min(size[1] - 1, int((max(py, qy, ry) - low[1]) // CELL))
        for j in range(j0, j1 + 1):
            for i in range(i0, i1 + 1):
                for row in range(start[j * size[0] + i], start[j * size[0] + i + 1]):
                    k = order[row]
                    if triangle[k] != NOWHERE:
                        continue
                    x, y = xyz[k, 0], xyz[k, 1]
                    u = ((qx - x) * (ry - y) - (qy - y) * (rx - x)) / area
                    v = ((rx - x) * (py - y) - (ry - y) * (px - x)) / area
                    w = 1 - u - v
                    if u >= 0 and v >= 0 and w >= 0:
                        triangle[k] = t
                        residual[k] = (
                            u * corners[t, 0, 2] + v * corners[t, 1, 2] + w * corners[t, 2, 2] - xyz[k, 2]
                        )
