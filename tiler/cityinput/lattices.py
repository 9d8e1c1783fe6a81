"""Heights of terrain between the cells of rasters that lie on one lattice (step 1.3)."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tiler.cityinput.rasters import Lattice

FINE = 0.5  # spacings of the terrain's nodes; smaller cells are averaged around each node
TIE = 1e-9  # share of a cell; cells that are as near as that to a node are equally near

Array = NDArray[np.float64]
Box = tuple[float, float, float, float]


@dataclass(frozen=True, eq=False)
class Cells:
    """Cells of a lattice in a box, of whatever file."""

    # Middle of the first cell of the southernmost row (m).
    x: float
    y: float
    # Size of a cell (m).
    dx: float
    dy: float
    z: Array  # (ny, nx): heights (m), NaN where there is none

    @classmethod
    def around(cls, box: Box, lattice: Lattice) -> "Cells":
        """Make room for the cells of a lattice in a box and two more around it; none has a height."""
        dx, dy = lattice.dx, lattice.dy
        i0, j0 = math.floor((box[0] - lattice.x) / dx) - 2, math.floor((box[1] - lattice.y) / dy) - 2
        i1, j1 = math.ceil((box[2] - lattice.x) / dx) + 2, math.ceil((box[3] - lattice.y) / dy) + 2
        empty = np.full((j1 - j0 + 1, i1 - i0 + 1), np.nan)
        return cls(lattice.x + i0 * dx, lattice.y + j0 * dy, dx, dy, empty)

    @property
    def box(self) -> Box:
        """Box of the middles of the cells (m)."""
        ny, nx = self.z.shape
        return self.x, self.y, self.x + (nx - 1) * self.dx, self.y + (ny - 1) * self.dy

    def put(self, units: NDArray[np.int32], lattice: Lattice, height_unit: float) -> None:
        """Give cells of a file their heights; where two files have one, the lower height counts."""
        column = units[:, 0] + round((lattice.x - self.x) / self.dx)
        row = units[:, 1] + round((lattice.y - self.y) / self.dy)
        here = (column >= 0) & (row >= 0) & (column < self.z.shape[1]) & (row < self.z.shape[0])
        column, row = column[here], row[here]
        self.z[row, column] = np.fmin(self.z[row, column], units[here, 2] * height_unit)


def interpolate_cells(cells: Cells, x: Array, y: Array, spacing: float) -> Array:
    """Give the heights of nodes, float64 (ny, nx) (m), from cells around all of them.

    Linear between the middles of the four cells around a node. Where some of these have no height, the others
    count by their weights, if the nearest is among them: so a raster reaches half a cell beyond its outer middles.
    NaN elsewhere. Cells smaller than half of the spacing are averaged first, those within half a spacing of the
    node.

    Parameters
    ----------
    cells : Cells
        The cells.
    x, y : float64, (nx,) and (ny,)
        Eastings of the columns of nodes, and northings of the rows (m).
    spacing : float
        Distance between nodes (m).
    """
    if max(cells.dx, cells.dy) < FINE * spacing:
        return _average(cells, x, y, spacing)
    (c, s), (r, t) = _split(x, cells.x, cells.dx, cells.z.shape[1]), _split(y, cells.y, cells.dy, cells.z.shape[0])
    total, weight, nearest, most = (np.zeros((len(y), len(x))) for _ in range(4))
    for dj, wj in ((0, 1 - t), (1, t)):
        for di, wi in ((0, 1 - s), (1, s)):
            z = cells.z[np.ix_(r + dj, c + di)]
            w = wj[:, np.newaxis] * wi[np.newaxis, :]
            most = np.maximum(most, w)
            w = np.where(np.isfinite(z), w, 0.0)
            nearest = np.maximum(nearest, w)
            total += w * np.where(np.isfinite(z), z, 0.0)
            weight += w
    with np.errstate(invalid="ignore", divide="ignore"):
        found: Array = np.where(nearest >= most - TIE, total / weight, np.nan)
    return found


def _split(at: Array, first: float, step: float, n: int) -> tuple[NDArray[np.int64], Array]:
    """Give the cell before each place, and how far it is on the way to the next."""
    place = (at - first) / step
    cell = np.clip(np.floor(place).astype(np.int64), 0, n - 2)
    return cell, place - cell


def _average(cells: Cells, x: Array, y: Array, spacing: float) -> Array:
    """Mean of the cells whose middles are within half a spacing of each node, in both directions."""
    sums = [np.zeros((len(y) + 1, len(x) + 1)) for _ in range(2)]
    row = np.floor((cells.y + np.arange(cells.z.shape[0]) * cells.dy - y[0]) / spacing + 0.5).astype(np.int64)
    column = np.floor((cells.x + np.arange(cells.z.shape[1]) * cells.dx - x[0]) / spacing + 0.5).astype(np.int64)
    row, column = (np.where((v >= 0) & (v < n), v, n) for v, n in ((row, len(y)), (column, len(x))))
    known = np.isfinite(cells.z)
    for total, values in zip(sums, (np.where(known, cells.z, 0.0), known.astype(np.float64)), strict=True):
        by_row = np.zeros((len(y) + 1, values.shape[1]))
        np.add.at(by_row, row, values)
        np.add.at(total.T, column, by_row.T)
    with np.errstate(invalid="ignore", divide="ignore"):
        found: Array = sums[0][:-1, :-1] / sums[1][:-1, :-1]
    return found
