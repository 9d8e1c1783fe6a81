"""Cells of columns made a block at a time (step 3.6): a tile never has all its cells in memory.

There are some five cells to a point: 16 bytes for each of these, and what is measured of them, would be most of
what a tile takes.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pipeline.columns import count_by_triangle, merge_columns
from pipeline.histograms import QUALITY_BINS, Histogram, merge_histograms, no_values, quality_histograms
from pipeline.mesh import Boundary, ColumnMesh, TetMesh
from pipeline.plane import signed_areas
from pipeline.quality import measure_cells

UNUSED = -1


def number_used(used: NDArray[np.bool_]) -> NDArray[np.int32]:
    """Number the points that cells use, in their order, int32; `UNUSED` for others.

    Examples
    --------
    >>> number_used(np.array([True, False, True]))
    array([ 0, -1,  1], dtype=int32)
    """
    number = np.cumsum(used, dtype=np.int32) - 1
    number[~used] = UNUSED
    return number


def place_points(mesh: ColumnMesh, used: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Give the coordinates of some points of a mesh, float64 (k, 3), column by column from below (m)."""
    column = np.repeat(np.arange(len(mesh.plane.xy), dtype=np.int32), np.diff(mesh.z_start))[used]
    points = np.empty((len(column), 3))
    for k in range(2):  # one after the other, as both would take as much again
        points[:, k] = mesh.plane.xy[:, k][column]
    points[:, 2] = mesh.z[used]
    return points


def renumber_boundary(boundary: Boundary, number: NDArray[np.int32]) -> Boundary:
    """Give facets the numbers of the points that are used."""
    return Boundary(number[boundary.facets], boundary.marker, boundary.building)


class CellBlocks:
    """The cells of one or more column meshes over the same points, in the order of `expand_cells`.

    Parameters
    ----------
    parts : sequence of (ColumnMesh, int32 (n_levels,))
        Meshes whose cells come one after the other, and the number that each level has as a point.

    Attributes
    ----------
    n_cells : int
        Cells of all meshes.

    Examples
    --------
    >>> from pipeline.mesh import PlaneMesh
    >>> plane = PlaneMesh(np.array([[0.0, 0], [1, 0], [0, 1]]), np.array([[0, 1, 2]], np.int32), np.array([-1]))
    >>> start, z = np.array([0, 2, 4, 6]), np.array([0.0, 1, 0, 1, 0, 1])
    >>> prism = ColumnMesh(plane, start, z, np.zeros((1, 3), np.int32))
    >>> blocks = CellBlocks([(prism, np.arange(6, dtype=np.int32))])
    >>> blocks.n_cells, blocks.make(1, 3).shape
    (3, (2, 4))
    """

    def __init__(self, parts: Sequence[tuple[ColumnMesh, NDArray[np.int32]]]) -> None:
        self._parts = [(mesh, number, signed_areas(mesh.plane) < 0) for mesh, number in parts]
        counts = [count_by_triangle(mesh) for mesh, _ in parts]
        self._starts = [np.concatenate(([0], np.cumsum(count))) for count in counts]
        self._first = np.concatenate(([0], np.cumsum([start[-1] for start in self._starts]))).tolist()
        self.n_cells = int(self._first[-1])

    def make(self, begin: int, end: int) -> NDArray[np.int32]:
        """Make the cells from one to before another.

        Parameters
        ----------
        begin, end : int
            Rows of all cells, 0 <= begin <= end <= n_cells.

        Returns
        -------
        int32, (end - begin, 4)
            Numbers of their points.
        """
        found = [
            self._make(k, max(begin - first, 0), min(end, self._first[k + 1]) - first)
            for k, first in enumerate(self._first[:-1])
            if begin < self._first[k + 1] and end > first
        ]
        if len(found) == 1:
            return found[0]
        return np.concatenate([np.empty((0, 4), np.int32), *found])

    def _make(self, k: int, begin: int, end: int) -> NDArray[np.int32]:
        """Make cells of one mesh: those over all triangles that they are over, and of these the ones asked for."""
        (mesh, number, clockwise), start = self._parts[k], self._starts[k]
        low = int(np.searchsorted(start, begin, side="right")) - 1
        high = int(np.searchsorted(start, end, side="left"))
        cells = merge_columns(mesh, slice(low, high), clockwise, int(start[high] - start[low]))
        rows: NDArray[np.int32] = number[cells[begin - start[low] : end - start[low]]]
        return rows


class QualityMeter:
    """Measures cells as they pass by, on their way to a file.

    Parameters
    ----------
    points : float64, (n, 3)
        Coordinates of the points that cells refer to (m).

    Attributes
    ----------
    histograms : dict of str to Histogram
        Counts of each measure of the cells so far, as from `quality_histograms`.
    """

    def __init__(self, points: NDArray[np.float64]) -> None:
        self._points = points
        self.histograms: dict[str, Histogram] = {
            name: no_values(limits, bins) for name, (limits, bins) in QUALITY_BINS.items()
        }

    def take(self, cells: NDArray[np.int32]) -> None:
        """Measure cells, int32 (k, 4): some thousands at a time stay in the processor's cache."""
        found = quality_histograms(measure_cells(TetMesh(self._points, cells)))
        self.histograms = {name: merge_histograms([self.histograms[name], part]) for name, part in found.items()}
