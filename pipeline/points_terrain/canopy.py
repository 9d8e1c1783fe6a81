"""Canopies in columns: foot, top and leaf area density from points (beyond the paper)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

LEAST_POINTS = 3  # of leaves in a column; fewer are no canopy
FOOT_SHARE = 0.1  # of the points of leaves in a column that lie below its foot
LEAST_DEPTH = 1.0  # m; of a canopy
EXTINCTION = 0.5  # of leaves that stand in all directions alike
# Densities that a column may have (m2/m3), each a fifth above or below what is measured at most.
DENSITIES = np.round(0.1 * 1.4 ** np.arange(11), 3)


@dataclass(frozen=True, eq=False)
class Canopy:
    """Canopies in square columns, aligned with the CRS; row ``j``, column ``i`` of arrays (ny, nx)."""

    #: absolute heights (m); NaN where there is none
    base: NDArray[np.float64]
    top: NDArray[np.float64]
    #: leaf area density (m2/m3), one of `DENSITIES`, or what is given; 0 where there is no canopy
    density: NDArray[np.float32]
    #: indices of the first column: it reaches from ``i0 * size`` to ``(i0 + 1) * size``
    i0: int
    j0: int
    size: float  #: side of a column (m)


def find_canopy(
    leaves: NDArray[np.float64],
    ground: NDArray[np.float64],
    corner: tuple[int, int],
    shape: tuple[int, int],
    *,
    size: float,
    density: float = 0.0,
) -> Canopy:
    """Find canopies in points.

    Parameters
    ----------
    leaves : float64, (n, 3)
        Points of leaves (m).
    ground : float64, (g, 3)
        Points below them: ground and water (m).
    corner : (i0, j0)
        Indices of the first column.
    shape : (ny, nx)
        Number of columns.
    size : float
        Side of a column (m).
    density : float
        Leaf area density of all (m2/m3); 0 to measure it.

    Notes
    -----
    The foot is the height below which a tenth of the points of leaves lies, the top the highest one. The leaf area
    index is ``-ln(P) / 0.5``, with P the share of ground among the points of a column, each counted once more by
    half a point (Beer's law with leaves in all directions alike); its density is over the depth. Points are sorted
    first, so their order does not matter.

    Examples
    --------
    >>> z = np.arange(2.0, 12.0)
    >>> leaves, ground = np.column_stack((z * 0 + 1, z * 0 + 1, z)), np.array([[1.5, 1, 0]])
    >>> found = find_canopy(leaves, ground, (0, 0), (1, 2), size=2.0)
    >>> found.base.tolist(), found.top.tolist(), found.density.tolist()
    ([[3.0, nan]], [[11.0, nan]], [[0.5379999876022339, 0.0]])
    """
    n = shape[0] * shape[1]
    cell, z = _cells(leaves, corner, shape, size)
    order = np.lexsort((z, cell))
    cell, z = cell[order], z[order]
    count = np.bincount(cell, minlength=n)
    first = np.cumsum(count) - count
    known = np.flatnonzero(count >= LEAST_POINTS)
    base, top, found = np.full(n, np.nan), np.full(n, np.nan), np.zeros(n, np.float32)
    top[known] = z[first[known] + count[known] - 1]
    base[known] = np.minimum(
        z[first[known] + (FOOT_SHARE * count[known]).astype(np.int64)], top[known] - LEAST_DEPTH
    )
    below = np.bincount(_cells(ground, corner, shape, size)[0], minlength=n)[known]
    share = (below + 0.5) / (below + count[known] + 1)
    measured = -np.log(share) / EXTINCTION / (top[known] - base[known])
    found[known] = density or nearest_density(measured)
    return Canopy(base.reshape(shape), top.reshape(shape), found.reshape(shape), *corner, size)


def nearest_density(value: NDArray[np.float64]) -> NDArray[np.float64]:
    """Nearest of `DENSITIES` (m2/m3), by ratio."""
    nearest: NDArray[np.float64] = DENSITIES[np.abs(np.log(value[:, None] / DENSITIES)).argmin(axis=1)]
    return nearest


def densities_at(canopies: list[Canopy], places: NDArray[np.float64]) -> NDArray[np.float32]:
    """Leaf area density at places (n, 3) (m), float32 (n,), 0 where there are no leaves."""
    found = np.zeros(len(places), np.float32)
    for canopy in canopies:
        ny, nx = canopy.base.shape
        i = np.floor(places[:, 0] / canopy.size).astype(np.int64) - canopy.i0
        j = np.floor(places[:, 1] / canopy.size).astype(np.int64) - canopy.j0
        rows = np.flatnonzero((i >= 0) & (i < nx) & (j >= 0) & (j < ny))
        i, j, z = i[rows], j[rows], places[rows, 2]
        within = (z >= canopy.base[j, i]) & (z <= canopy.top[j, i])
        found[rows[within]] = canopy.density[j[within], i[within]]
    return found


def _cells(
    points: NDArray[np.float64], corner: tuple[int, int], shape: tuple[int, int], size: float
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Column of each point that is in one, row by row, and its height (m)."""
    i, j = (np.floor(points[:, k] / size).astype(np.int64) - corner[k] for k in (0, 1))
    inside = (i >= 0) & (i < shape[1]) & (j >= 0) & (j < shape[0])
    return (j * shape[1] + i)[inside], points[inside, 2]
