"""Optimisation of adaptive columns: levels near the worst cells move up or down (ours, after step 3.5).

Plane coordinates, ground, top and seams stay, so the pass cannot open a mesh. A cell's worth is its radius ratio;
what is minimised around a level is the sum of its inverse's eighth powers, which the worst cell dominates. Where
sloped roofs meet, their levels may move too, a little way and at a price. Then the columns are merged anew at
their new heights; columns whose cells have become worse by that go back.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.columns.columns import count_by_triangle, merge_triangle
from pipeline.data.kernel import kernel
from pipeline.data.mesh import ColumnMesh
from pipeline.plane_mesh.plane import signed_areas

WORST = 0.5  # levels of cells with a radius ratio below this may move
WORST_ROOF = 0.2  # roofs of cells below this may move
BAD = 0.3  # cells below this must not be worse than the worst one around them was
SEARCH_SWEEPS = 10
FIRST_STEP = 0.15  # of the column's spacing
LAST_STEP = 0.02  # of the first step
HALF_RETURNS, RETURNS = 2, 10  # times that columns go back half of their way, and at all
PULL = 1000.0  # what a move by all of a level's slack costs: as a cell with a radius ratio of 0.42
MOST_LEVELS = 20_000  # that are searched together: some 400 bytes each, for the cells around them


def improve_columns(
    mesh: ColumnMesh,
    home: NDArray[np.float64],
    slack: NDArray[np.float64],
    spacing: NDArray[np.float64],
    *,
    passes: int,
    worst: float = WORST,
    rekey: Callable[[ColumnMesh], ColumnMesh] | None = None,
    flat_cells: bool = False,
) -> tuple[ColumnMesh, tuple[float, float], int]:
    """Move levels at the worst cells along their columns.

    Parameters
    ----------
    mesh : ColumnMesh
        Columns that ascend.
    home : float64, (z_start[-1],)
        Where each level should be (m).
    slack : float64, (z_start[-1],)
        How far each may be from there (m): 0 for those that stay, inf for those that are free.
    spacing : float64, (n,)
        Distance of levels in each column (m), which scales the search.
    passes : int
        Rounds of searching and merging; 0 returns the mesh as it is.
    worst : float
        Levels of cells with a radius ratio below this may move.
    rekey : callable, optional
        Gives a mesh whose levels moved the keys of the next round; without it keys move with their levels.
    flat_cells : bool
        Cells without a level that moves are flat on purpose, as those of a thin first layer: they do not count
        where the meshes before and after are compared.

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
    Merging anew changes cells beside those that were looked at: where a cell below `BAD` is worse than all around
    it were, the columns of its triangle go back, half of the way first. A round after which the sum over all cells
    is no less is the last one, and is dropped. Memory is that of the levels, and of the cells around those that
    may move, an area after the other where they are many: all others are made and measured a triangle at a time.
    """
    survey = ColumnSurvey(mesh, home, slack, flat_cells, worst)
    before, n_moved = survey.worst, 0
    for k in range(passes):
        cost, least = survey.cost, survey.worst
        z, moved = survey.search(FIRST_STEP * spacing)
        n_moved += moved
        survey.move(z)
        if not survey.cost < cost:
            return mesh, (before, least), n_moved
        mesh = replace(mesh, z=survey.z, key=survey.key)
        if k < passes - 1:
            mesh = mesh if rekey is None else rekey(mesh)
            survey = ColumnSurvey(mesh, home, slack, flat_cells, worst)
    return mesh, (before, survey.worst), n_moved


def split_columns(xy: NDArray[np.float64], count: NDArray[np.int64], most: int) -> list[NDArray[np.int64]]:
    """Split columns into areas of the plane with at most so many levels each, halved across their longer side.

    Parameters
    ----------
    xy : float64, (n, 2)
        Columns (m).
    count : int64, (n,)
        Levels of each; columns without any are in no area.
    most : int
        Levels of an area, unless one column alone has more.

    Returns
    -------
    list of int64 (k,)
        Columns of each area.

    Examples
    --------
    >>> split_columns(np.array([[0.0, 0], [9, 0], [3, 0], [1, 1]]), np.array([2, 2, 2, 0]), 4)
    [array([0, 2]), array([1])]
    """
    waiting, areas = [np.flatnonzero(count)], []
    while waiting:
        columns = waiting.pop()
        total = count[columns].sum()
        if total > most and len(columns) > 1:
            axis = int(np.ptp(xy[columns], axis=0).argmax())
            ordered = columns[np.argsort(xy[columns, axis], kind="stable")]
            half = int(np.searchsorted(np.cumsum(count[ordered]), total / 2)) + 1
            half = min(half, len(columns) - 1)
            waiting += [ordered[half:], ordered[:half]]
        elif total:
            areas.append(columns)
    return areas


class ColumnSurvey:
    """How good the cells over each triangle are, and which levels the bad ones have.

    Parameters
    ----------
    mesh, home, slack, flat_cells, worst
        As for `improve_columns`.

    Attributes
    ----------
    z : float64, (z_start[-1],)
        Heights of the levels (m).
    of_cells : float64, (m,)
        What the search minimises, of the cells over each triangle that count.
    least : float64, (m,)
        Smallest radius ratio over each triangle; negative where a cell is inverted.
    bad : bool, (z_start[-1],)
        Levels of cells that are worse than `worst`; roofs of those that are worse than `WORST_ROOF`.
    """

    def __init__(
        self,
        mesh: ColumnMesh,
        home: NDArray[np.float64],
        slack: NDArray[np.float64],
        flat_cells: bool,
        worst: float = WORST,
    ) -> None:
        m = len(mesh.plane.triangles)
        self._mesh, self._home, self._slack, self._flat_cells = mesh, home, slack, flat_cells
        self._worst = worst
        self._clockwise = signed_areas(mesh.plane) < 0
        self._n_cells = count_by_triangle(mesh)
        self._most = int(self._n_cells.max(initial=0))
        self.z = mesh.z
        self._lift = None if mesh.key is None else mesh.key - mesh.z
        self.of_cells, self.least = np.empty(m), np.empty(m)
        self._measure(np.ones(m, np.bool_))

    @property
    def key(self) -> NDArray[np.float64] | None:
        """Keys of the mesh at its heights, None where these are its keys."""
        return None if self._lift is None else self.z + self._lift

    @property
    def cost(self) -> float:
        """What the search minimises, over all cells that count."""
        return float(self.of_cells.sum())

    @property
    def worst(self) -> float:
        """Smallest radius ratio of all cells."""
        return float(self.least.min())

    def search(self, first_step: NDArray[np.float64]) -> tuple[NDArray[np.float64], int]:
        """Move levels of bad cells, by first steps of each column (m): all heights, and how many moved."""
        xy, triangles = self._mesh.plane.xy, self._mesh.plane.triangles
        z, n_moved = self.z.copy(), 0
        level = np.flatnonzero(self.bad & (self._slack > 0))
        column = self._columns_of(level)
        count = np.bincount(column, minlength=len(xy))
        place = np.full(len(z), -1, np.int32)  # of each level among those that are searched together
        for columns in split_columns(xy, count, MOST_LEVELS):
            here = np.zeros(len(xy), np.bool_)
            here[columns] = True
            part = here[column]
            searched, wanted = level[part], self._touch(here)
            place[searched] = np.arange(len(searched))
            room = int(self._n_cells[wanted].sum())
            cells, over = _gather(*self._merged(), wanted, self._most, self._clockwise, place, room)
            around = _cells_of_levels(cells, place, len(searched))
            place[searched] = -1
            way = (first_step[column[part]], self._home[searched], self._slack[searched])
            n_moved += _search(xy, triangles, self._clockwise, z, cells, over, searched, *around, *way)
        return z, n_moved

    def move(self, z: NDArray[np.float64]) -> None:
        """Take other heights, but for columns where a bad cell is worse than all around it were."""
        triangles, old_z = self._mesh.plane.triangles, self.z
        around = np.full(len(self._mesh.plane.xy), np.inf)
        np.minimum.at(around, triangles.ravel(), np.repeat(self.least, 3))
        least = np.minimum(around[triangles].min(axis=1), BAD)
        self._take(z)
        for k in range(RETURNS):
            worse = self.least < least
            if not worse.any():
                break
            back = np.zeros(len(self._mesh.plane.xy), np.bool_)
            back[triangles[worse]] = True
            way = 0.5 * (old_z + self.z) if k < HALF_RETURNS else old_z
            self._take(np.where(np.repeat(back, np.diff(self._mesh.z_start)), way, self.z))

    def _take(self, z: NDArray[np.float64]) -> None:
        """Take other heights and measure the cells around those that moved."""
        moved = np.zeros(len(self._mesh.plane.xy), np.bool_)
        moved[self._columns_of(np.flatnonzero(z != self.z))] = True
        self.z = z
        self._measure(self._touch(moved))

    def _columns_of(self, level: NDArray[np.int64]) -> NDArray[np.int64]:
        """Column of each of some levels (k,)."""
        return np.searchsorted(self._mesh.z_start, level, side="right") - 1

    def _touch(self, columns: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Find the triangles with one of some columns (n,), bool (m,)."""
        found: NDArray[np.bool_] = np.any(columns[self._mesh.plane.triangles], axis=1)
        return found

    def _merged(self) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int64], NDArray[np.float64], bool]:
        mesh, key = self._mesh, self.key
        key = self.z if key is None else key
        return mesh.plane.triangles, mesh.bottom, mesh.z_start, key, mesh.order == "heights"

    def _measure(self, wanted: NDArray[np.bool_]) -> None:
        self.bad = np.zeros(len(self.z), np.bool_)
        _survey(
            *self._merged(),
            wanted,
            self._most,
            self._clockwise,
            self._mesh.plane.xy,
            self.z,
            self._slack,
            self._flat_cells,
            self._worst,
            self.of_cells,
            self.least,
            self.bad,
        )


@kernel(inline="always")
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


@kernel
def _inverse_power(ratio: float) -> float:
    if ratio <= 0:
        return np.inf
    square = 1 / (ratio * ratio)
    return square * square * square * square


@kernel(inline="always")
def _columns_of_cell(
    triangle: NDArray[np.int32], clockwise: bool, cell: NDArray[np.int32]
) -> tuple[np.int32, np.int32, np.int32, np.int32]:
    """Columns of the corners of a cell over a triangle, by the order in which `merge_triangle` writes them."""
    a, b, c = triangle[0], triangle[2 if clockwise else 1], triangle[1 if clockwise else 2]
    above = cell[3] - 1  # the last corner is the level above one of the others
    return a, b, c, a if above == cell[0] else b if above == cell[1] else c


@kernel(inline="always")
def _lay_out(
    xy: NDArray[np.float64],
    triangle: NDArray[np.int32],
    clockwise: bool,
    z: NDArray[np.float64],
    cell: NDArray[np.int32],
    at: NDArray[np.float64],
    i: int,
) -> None:
    """Write the corners of a cell over a triangle into column i, a row for each coordinate."""
    a, b, c, d = _columns_of_cell(triangle, clockwise, cell)
    at[0, i], at[1, i], at[2, i] = xy[a, 0], xy[a, 1], z[cell[0]]
    at[3, i], at[4, i], at[5, i] = xy[b, 0], xy[b, 1], z[cell[1]]
    at[6, i], at[7, i], at[8, i] = xy[c, 0], xy[c, 1], z[cell[2]]
    at[9, i], at[10, i], at[11, i] = xy[d, 0], xy[d, 1], z[cell[3]]


@kernel(error_model="numpy")
def _measure_block(at: NDArray[np.float64], n: int, ratio: NDArray[np.float64]) -> None:
    """Radius ratio of the first n columns: corners side by side let the machine take several cells at once."""
    for i in range(n):
        ratio[i] = _radius_ratio(
            at[0, i], at[1, i], at[2, i], at[3, i], at[4, i], at[5, i],
            at[6, i], at[7, i], at[8, i], at[9, i], at[10, i], at[11, i],
        )  # fmt: skip


@kernel
def _survey(
    triangles: NDArray[np.int32],
    bottom: NDArray[np.int32],
    z_start: NDArray[np.int64],
    key: NDArray[np.float64],
    by_height: bool,
    wanted: NDArray[np.bool_],
    most: int,
    clockwise: NDArray[np.bool_],
    xy: NDArray[np.float64],
    z: NDArray[np.float64],
    slack: NDArray[np.float64],
    flat_cells: bool,
    worst: float,
    of_cells: NDArray[np.float64],
    least: NDArray[np.float64],
    bad: NDArray[np.bool_],
) -> None:
    """Make and measure the cells over the triangles that are wanted: at most so many over one."""
    cells, at, ratio = np.empty((most, 4), np.int32), np.empty((12, most)), np.empty(most)
    first: Any = np.int64(0)  # for a constant, numba would compile `merge_triangle` once more
    for t in range(len(triangles)):
        if not wanted[t]:
            continue
        n = merge_triangle(triangles[t], bottom[t], z_start, key, by_height, clockwise[t], cells, first)
        for i in range(n):
            _lay_out(xy, triangles[t], clockwise[t], z, cells[i], at, i)
        _measure_block(at, n, ratio)
        of_cells[t], least[t] = 0.0, np.inf
        for i in range(n):
            least[t] = min(least[t], ratio[i])
            a, b, c, d = cells[i]
            if not flat_cells or slack[a] > 0 or slack[b] > 0 or slack[c] > 0 or slack[d] > 0:
                of_cells[t] += _inverse_power(ratio[i])
            if ratio[i] < worst:
                for level in (a, b, c, d):
                    bad[level] |= ratio[i] < WORST_ROOF or slack[level] == np.inf


@kernel
def _gather(
    triangles: NDArray[np.int32],
    bottom: NDArray[np.int32],
    z_start: NDArray[np.int64],
    key: NDArray[np.float64],
    by_height: bool,
    wanted: NDArray[np.bool_],
    most: int,
    clockwise: NDArray[np.bool_],
    place: NDArray[np.int32],
    room: int,
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Cells over wanted triangles that have a level with a place, and those triangles, in their order.

    All cells over these triangles have room.
    """
    cells = np.empty((most, 4), np.int32)
    found, over = np.empty((room, 4), np.int32), np.empty(room, np.int32)
    row = 0
    for t in range(len(triangles)):
        if not wanted[t]:
            continue
        n = merge_triangle(triangles[t], bottom[t], z_start, key, by_height, clockwise[t], cells, 0)
        for i in range(n):
            a, b, c, d = cells[i]
            if place[a] >= 0 or place[b] >= 0 or place[c] >= 0 or place[d] >= 0:
                found[row] = cells[i]
                over[row] = t
                row += 1
    return found[:row], over[:row]


@kernel
def _add_costs(ratio: NDArray[np.float64]) -> float:
    total = 0.0
    for i in range(len(ratio)):
        total += _inverse_power(ratio[i])
    return total


@kernel
def _cells_of_levels(
    cells: NDArray[np.int32], place: NDArray[np.int32], n: int
) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """Cells around each of n levels with a place: those of the k-th are ``of_level[start[k]:start[k + 1]]``."""
    start = np.zeros(n + 1, np.int64)
    for i in range(len(cells)):
        for k in range(4):
            p = place[cells[i, k]]
            if p >= 0:
                start[p + 1] += 1
    for p in range(n):
        start[p + 1] += start[p]
    end = start[:-1].copy()
    of_level = np.empty(start[-1], np.int32)
    for i in range(len(cells)):
        for k in range(4):
            p = place[cells[i, k]]
            if p >= 0:
                of_level[end[p]] = i
                end[p] += 1
    return start, of_level


@kernel
def _cost(at: NDArray[np.float64], row: NDArray[np.int64], z: float, n: int, ratio: NDArray[np.float64]) -> float:
    """Cost of the first n cells with one corner of each, whose height is in that row, at z."""
    for i in range(n):
        at[row[i], i] = z
    _measure_block(at, n, ratio)
    return float(_add_costs(ratio[:n]))


@kernel
def _price(way: float, slack: float) -> float:
    """What it costs that a level is so far from home: nothing where it is free."""
    part = way / slack
    return float(PULL * part * part) if abs(part) <= 1 else np.inf


@kernel
def _search(
    xy: NDArray[np.float64],
    triangles: NDArray[np.int32],
    clockwise: NDArray[np.bool_],
    z: NDArray[np.float64],
    cells: NDArray[np.int32],
    over: NDArray[np.int32],
    level: NDArray[np.int64],
    start: NDArray[np.int64],
    of_level: NDArray[np.int32],
    first_step: NDArray[np.float64],
    home: NDArray[np.float64],
    slack: NDArray[np.float64],
) -> int:
    """Try a step up or down at each level in turn, the last good direction first; heights are moved in place.

    Level ``level[k]`` may be ``slack[k]`` from ``home[k]``, and the way there has a price.
    """
    step = first_step.copy()
    moved = np.zeros(len(level), np.bool_)
    most = 0
    for k in range(len(level)):
        most = max(most, start[k + 1] - start[k])
    at, ratio, row = np.empty((12, most)), np.empty(most), np.empty(most, np.int64)
    for _ in range(SEARCH_SWEEPS):
        for k in range(len(level)):
            p = level[k]
            if abs(step[k]) < LAST_STEP * first_step[k]:
                continue
            around = of_level[start[k] : start[k + 1]]
            n = len(around)
            for i in range(n):
                cell, t = cells[around[i]], over[around[i]]
                _lay_out(xy, triangles[t], clockwise[t], z, cell, at, i)
                for c in range(4):
                    if cell[c] == p:
                        row[i] = 3 * c + 2
            height = z[p]
            here = _cost(at, row, height, n, ratio) + _price(height - home[k], slack[k])
            up, down = height + step[k], height - step[k]
            if _cost(at, row, up, n, ratio) + _price(up - home[k], slack[k]) < here:
                z[p] = up
                step[k] *= 1.25
                moved[k] = True
                continue
            if _cost(at, row, down, n, ratio) + _price(down - home[k], slack[k]) < here:
                z[p] = down
                step[k] *= -1.25
                moved[k] = True
                continue
            step[k] *= 0.5
    return int(moved.sum())
