"""Optimisation of adaptive columns: free levels near the worst cells move up or down (ours, after step 3.5).

Plane coordinates, ground, roofs, top and seams stay, so the pass cannot open a mesh. A cell's worth is its
radius ratio; what is minimised around a level is the sum of its inverse's eighth powers, which the worst
cell dominates. Then the columns are merged anew at their new heights.
"""

from dataclasses import replace

import numba
import numpy as np
from numpy.typing import NDArray

from pipeline.columns import expand_again, expand_cells
from pipeline.mesh import ColumnMesh

WORST = 0.5  # levels of cells with a radius ratio below this may move
SEARCH_SWEEPS = 10
FIRST_STEP = 0.15  # of the column's spacing
LAST_STEP = 0.02  # of the first step
BLOCK = 64  # cells that are measured side by side


def improve_columns(
    mesh: ColumnMesh,
    free: NDArray[np.bool_],
    spacing: NDArray[np.float64],
    *,
    passes: int,
    flat_cells: bool = False,
) -> tuple[ColumnMesh, tuple[float, float], int]:
    """Move free levels at the worst cells along their columns.

    Parameters
    ----------
    mesh : ColumnMesh
        Columns that ascend.
    free : bool, (z_start[-1],)
        Levels that may move.
    spacing : float64, (n,)
        Distance of levels in each column (m), which scales the search.
    passes : int
        Rounds of searching and merging; 0 returns the mesh as it is.
    flat_cells : bool
        Cells without a free level are flat on purpose, as those of a thin first layer: they do not count where the
        rounds are compared.

    Returns
    -------
    ColumnMesh
        The mesh; its columns ascend.
    (float, float)
        Smallest radius ratio before and after.
    int
        Levels that moved, counted in each round.

    Notes
    -----
    Merging anew changes cells beside those that were looked at; of all rounds, the mesh with the least sum over
    all its cells is kept.
    """
    step = np.repeat(FIRST_STEP * spacing, np.diff(mesh.z_start))
    expanded = expand_cells(mesh)
    points, cells = expanded.points, expanded.cells
    ratio = radius_ratios(points, cells)
    best, least_cost = mesh, _total_cost(ratio, cells, free, flat_cells)
    before = after = float(ratio.min())
    n_moved = 0
    for _ in range(passes):
        active = _levels_of(cells, ratio < WORST, len(mesh.z)) & free
        start, of_level = _cells_of_levels(cells, active)
        n_moved += _search(points, cells, np.flatnonzero(active), start, of_level, step)
        moved = mesh.z != points[:, 2]
        mesh = replace(mesh, z=points[:, 2].copy())
        again = expand_again(mesh, cells, moved)
        ratio[again] = radius_ratios(points, cells[again])
        cost = _total_cost(ratio, cells, free, flat_cells)
        if cost < least_cost:
            best, least_cost, after = mesh, cost, float(ratio.min())
    return best, (before, after), n_moved


def radius_ratios(points: NDArray[np.float64], cells: NDArray[np.int32]) -> NDArray[np.float64]:
    """Measure 3 x inscribed over circumscribed radius of every cell; negative for an inverted one.

    Examples
    --------
    >>> corners = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    >>> float(radius_ratios(corners, np.array([[0, 1, 3, 2]], np.int32))[0].round(12))
    1.0
    """
    ratio: NDArray[np.float64] = _measure(points, cells)
    return ratio


def _total_cost(
    ratio: NDArray[np.float64], cells: NDArray[np.int32], free: NDArray[np.bool_], flat_cells: bool
) -> float:
    """What the search minimises, over all cells that count."""
    return float(_add_costs(ratio[free[cells].any(axis=1)] if flat_cells else ratio))


def _levels_of(cells: NDArray[np.int32], chosen: NDArray[np.bool_], n: int) -> NDArray[np.bool_]:
    levels = np.zeros(n, np.bool_)
    levels[cells[chosen]] = True
    return levels


@numba.njit(cache=True, nogil=True, inline="always")
def _radius_ratio(
    ax: float, ay: float, az: float, bx: float, by: float, bz: float,
    cx: float, cy: float, cz: float, dx: float, dy: float, dz: float,
) -> float:  # fmt: skip
    ux, uy, uz = bx - ax, by - ay, bz - az
    vx, vy, vz = cx - ax, cy - ay, cz - az
    wx, wy, wz = dx - ax, dy - ay, dz - az
    # Normals of the faces at the first corner, each twice the face's area long; the fourth closes them.
    px, py, pz = vy * wz - vz * wy, vz * wx - vx * wz, vx * wy - vy * wx
    qx, qy, qz = wy * uz - wz * uy, wz * ux - wx * uz, wx * uy - wy * ux
    rx, ry, rz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    sx, sy, sz = px + qx + rx, py + qy + ry, pz + qz + rz
    volume6 = ux * px + uy * py + uz * pz
    surface2 = (
        np.sqrt(px * px + py * py + pz * pz)
        + np.sqrt(qx * qx + qy * qy + qz * qz)
        + np.sqrt(rx * rx + ry * ry + rz * rz)
        + np.sqrt(sx * sx + sy * sy + sz * sz)
    )
    uu, vv, ww = ux * ux + uy * uy + uz * uz, vx * vx + vy * vy + vz * vz, wx * wx + wy * wy + wz * wz
    ex, ey, ez = uu * px + vv * qx + ww * rx, uu * py + vv * qy + ww * ry, uu * pz + vv * qz + ww * rz
    return float(6 * volume6 * abs(volume6) / (surface2 * np.sqrt(ex * ex + ey * ey + ez * ez)))


@numba.njit(cache=True, nogil=True)
def _inverse_power(ratio: float) -> float:
    if ratio <= 0:
        return np.inf
    square = 1 / (ratio * ratio)
    return square * square * square * square


@numba.njit(cache=True, nogil=True, inline="always")
def _lay_out(points: NDArray[np.float64], cell: NDArray[np.int32], at: NDArray[np.float64], i: int) -> None:
    """Write the corners of a cell into column i, a row for each coordinate."""
    for c in range(4):
        p = cell[c]
        for k in range(3):
            at[3 * c + k, i] = points[p, k]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _measure_block(at: NDArray[np.float64], n: int, ratio: NDArray[np.float64]) -> None:
    """Radius ratio of the first n columns: corners side by side let the machine take several cells at once."""
    for i in range(n):
        ratio[i] = _radius_ratio(
            at[0, i], at[1, i], at[2, i], at[3, i], at[4, i], at[5, i],
            at[6, i], at[7, i], at[8, i], at[9, i], at[10, i], at[11, i],
        )  # fmt: skip


@numba.njit(cache=True, nogil=True)
def _measure(points: NDArray[np.float64], cells: NDArray[np.int32]) -> NDArray[np.float64]:
    """Radius ratio of every cell."""
    ratio, block = np.empty(len(cells)), np.empty(BLOCK)
    at = np.empty((12, BLOCK))
    for first in range(0, len(cells), BLOCK):
        n = min(BLOCK, len(cells) - first)
        for i in range(n):
            _lay_out(points, cells[first + i], at, i)
        _measure_block(at, n, block)
        ratio[first : first + n] = block[:n]
    return ratio


@numba.njit(cache=True, nogil=True)
def _add_costs(ratio: NDArray[np.float64]) -> float:
    total = 0.0
    for i in range(len(ratio)):
        total += _inverse_power(ratio[i])
    return total


@numba.njit(cache=True, nogil=True)
def _cells_of_levels(
    cells: NDArray[np.int32], active: NDArray[np.bool_]
) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """Cells around each active level: those of the k-th are ``of_level[start[k]:start[k + 1]]``."""
    number = np.cumsum(active) - 1
    start = np.zeros(active.sum() + 1, np.int64)
    for i in range(len(cells)):
        for k in range(4):
            if active[cells[i, k]]:
                start[number[cells[i, k]] + 1] += 1
    for p in range(len(start) - 1):
        start[p + 1] += start[p]
    place = start[:-1].copy()
    of_level = np.empty(start[-1], np.int32)
    for i in range(len(cells)):
        for k in range(4):
            if active[cells[i, k]]:
                p = number[cells[i, k]]
                of_level[place[p]] = i
                place[p] += 1
    return start, of_level


@numba.njit(cache=True, nogil=True)
def _cost(at: NDArray[np.float64], row: NDArray[np.int64], z: float, n: int, ratio: NDArray[np.float64]) -> float:
    """Cost of the first n cells with one corner of each, whose height is in that row, at z."""
    for i in range(n):
        at[row[i], i] = z
    _measure_block(at, n, ratio)
    return float(_add_costs(ratio[:n]))


@numba.njit(cache=True, nogil=True)
def _search(
    points: NDArray[np.float64],
    cells: NDArray[np.int32],
    level: NDArray[np.int64],
    start: NDArray[np.int64],
    of_level: NDArray[np.int32],
    first_step: NDArray[np.float64],
) -> int:
    """Try a step up or down at each level in turn, the last good direction first."""
    step = first_step[level]
    moved = np.zeros(len(level), np.bool_)
    most = np.diff(start).max() if len(level) else 0
    at, ratio, row = np.empty((12, most)), np.empty(most), np.empty(most, np.int64)
    for _ in range(SEARCH_SWEEPS):
        for k in range(len(level)):
            p = level[k]
            if abs(step[k]) < LAST_STEP * first_step[p]:
                continue
            around = of_level[start[k] : start[k + 1]]
            n = len(around)
            for i in range(n):
                cell = cells[around[i]]
                _lay_out(points, cell, at, i)
                for c in range(4):
                    if cell[c] == p:
                        row[i] = 3 * c + 2
            z = points[p, 2]
            here = _cost(at, row, z, n, ratio)
            if _cost(at, row, z + step[k], n, ratio) < here:
                points[p, 2] = z + step[k]
                step[k] *= 1.25
                moved[k] = True
                continue
            if _cost(at, row, z - step[k], n, ratio) < here:
                points[p, 2] = z - step[k]
                step[k] *= -1.25
                moved[k] = True
                continue
            step[k] *= 0.5
    return int(moved.sum())
