"""Points and cells of columns made a block at a time (step 3.6): a tile never has all of them in memory.

There are some five cells to a point: 16 bytes for each of these, and what is measured of them, would be most of
what a tile takes; next come 24 bytes for each point.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.columns.columns import count_by_triangle, merge_columns
from pipeline.data.kernel import kernel
from pipeline.data.mesh import ColumnMesh, TetMesh
from pipeline.plane_mesh.plane import signed_areas
from pipeline.quality.histograms import QUALITY_BINS, Histogram, merge_histograms, no_values, quality_histograms
from pipeline.quality.quality import measure_cells

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


class UsedPoints:
    """The points that cells of columns use, made when they are asked for: column by column from below.

    Parameters
    ----------
    mesh : ColumnMesh
        The columns.
    used : bool, (n_levels,)
        Levels that cells use, see `find_used_points`.

    Attributes
    ----------
    n_points : int
        Number of points.
    column : int32, (n_levels,)
        Column of each level.

    Notes
    -----
    Memory is 4 bytes a level, where coordinates would be 24.

    Examples
    --------
    >>> from pipeline.data.mesh import PlaneMesh
    >>> plane = PlaneMesh(np.array([[0.0, 0], [1, 0], [0, 1]]), np.array([[0, 1, 2]], np.int32), np.array([-1]))
    >>> start, z = np.array([0, 2, 4, 6]), np.array([0.0, 1, 0, 1, 0, 1])
    >>> prism = ColumnMesh(plane, start, z, np.zeros((1, 3), np.int32))
    >>> points = UsedPoints(prism, np.array([True, True, False, True, True, True]))
    >>> points.levels(1, 4), points.place(points.levels(2, 3))
    (array([1, 3, 4], dtype=int32), array([[1., 0., 1.]]))
    >>> points.numbers(np.array([1, 4]))
    array([1, 3])
    """

    def __init__(self, mesh: ColumnMesh, used: NDArray[np.bool_]) -> None:
        self._mesh = mesh
        self._unused = np.flatnonzero(~used)
        self._before = self._unused - np.arange(len(self._unused))  # points before each level that is not used
        self.n_points = len(used) - len(self._unused)
        self.column = np.repeat(np.arange(len(mesh.plane.xy), dtype=np.int32), np.diff(mesh.z_start))

    def levels(self, begin: int, end: int) -> NDArray[np.int32]:
        """Tell which levels the points from one to before another are, int32 (end - begin,)."""
        points = np.arange(begin, end)
        return (points + np.searchsorted(self._before, points, side="right")).astype(np.int32)

    def numbers(self, levels: NDArray[Any]) -> NDArray[np.int64]:
        """Tell which points some levels are that are used, int64 (k,); for all of them see `number_used`."""
        return levels - np.searchsorted(self._unused, levels)

    def place(self, levels: NDArray[np.int32]) -> NDArray[np.float64]:
        """Give the coordinates of levels (k,), float64 (k, 3) (m)."""
        points = np.empty((len(levels), 3))
        _place(self._mesh.plane.xy, self.column, self._mesh.z, levels, points)
        return points


@kernel
def _place(
    xy: NDArray[np.float64],
    column: NDArray[np.int32],
    z: NDArray[np.float64],
    levels: NDArray[np.int32],
    points: NDArray[np.float64],
) -> None:
    for k in range(len(levels)):
        at = column[levels[k]]
        points[k, 0], points[k, 1], points[k, 2] = xy[at, 0], xy[at, 1], z[levels[k]]


class CellBlocks:
    """The cells of one or more column meshes over the same points, in the order of `expand_cells`.

    Parameters
    ----------
    parts : sequence of (ColumnMesh, int32 (n_levels,) or None)
        Meshes whose cells come one after the other, and which of all levels theirs are: the same without.

    Attributes
    ----------
    n_cells : int
        Cells of all meshes.

    Examples
    --------
    >>> from pipeline.data.mesh import PlaneMesh
    >>> plane = PlaneMesh(np.array([[0.0, 0], [1, 0], [0, 1]]), np.array([[0, 1, 2]], np.int32), np.array([-1]))
    >>> start, z = np.array([0, 2, 4, 6]), np.array([0.0, 1, 0, 1, 0, 1])
    >>> prism = ColumnMesh(plane, start, z, np.zeros((1, 3), np.int32))
    >>> blocks = CellBlocks([(prism, None)])
    >>> blocks.n_cells, blocks.make(1, 3).shape
    (3, (2, 4))
    """

    def __init__(self, parts: Sequence[tuple[ColumnMesh, NDArray[np.int32] | None]]) -> None:
        self._parts = [(mesh, level, signed_areas(mesh.plane) < 0) for mesh, level in parts]
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
            Levels that are their corners.
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
        (mesh, level, clockwise), start = self._parts[k], self._starts[k]
        low = int(np.searchsorted(start, begin, side="right")) - 1
        high = int(np.searchsorted(start, end, side="left"))
        cells = merge_columns(mesh, slice(low, high), clockwise, int(start[high] - start[low]))
        cells = cells[begin - start[low] : end - start[low]]
        return cells if level is None else level[cells]


class QualityMeter:
    """Measures cells as they pass by, on their way to a file.

    Attributes
    ----------
    histograms : dict of str to Histogram
        Counts of each measure of the cells so far, as from `quality_histograms`.
    """

    def __init__(self) -> None:
        self.histograms: dict[str, Histogram] = {
            name: no_values(limits, bins) for name, (limits, bins) in QUALITY_BINS.items()
        }

    def take(self, corners: NDArray[np.float64]) -> None:
        """Measure cells by their corners, float64 (4 k, 3): some thousands at a time stay in the cache."""
        cells = np.arange(len(corners), dtype=np.int32).reshape(-1, 4)
        found = quality_histograms(measure_cells(TetMesh(corners, cells)))
        self.histograms = {name: merge_histograms([self.histograms[name], part]) for name, part in found.items()}
