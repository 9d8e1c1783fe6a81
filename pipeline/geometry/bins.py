"""Bins of a regular grid, to find the polygons near one polygon while polygons come and go (step 2.1)."""

import numpy as np
import shapely
from numpy.typing import NDArray


class Bins:
    """Which polygons' bounding boxes touch which cells of a regular grid.

    Parameters
    ----------
    polygons : object, (n,)
        shapely Polygons, all in the bins at first.
    size : float
        Width of a cell (m). It changes the cost of a search, not its answer.

    Attributes
    ----------
    bounds : float64, (n, 4)
        Least x, least y, greatest x, greatest y of each polygon (m); stale for one that was removed.
    cells : dict of (int, int) to set of int
        Indices of the polygons in each cell.

    Examples
    --------
    >>> row = np.array([shapely.box(x, 0, x + 4, 4) for x in (0, 5, 12)])
    >>> bins = Bins(row, 10.0)
    >>> bins.find(1, 1.0), bins.find(1, 3.0)
    (array([0]), array([0, 2]))
    """

    def __init__(self, polygons: NDArray[np.object_], size: float) -> None:
        self.size = size
        self.bounds = np.zeros((len(polygons), 4))
        self.cells: dict[tuple[int, int], set[int]] = {}
        for i, polygon in enumerate(polygons):
            self.insert(i, polygon)

    def insert(self, i: int, polygon: shapely.Polygon) -> None:
        """Put polygon ``i`` into the cells that its bounding box touches."""
        self.bounds[i] = polygon.bounds
        for cell in self._touched(self.bounds[i]):
            self.cells.setdefault(cell, set()).add(i)

    def remove(self, i: int) -> None:
        """Take polygon ``i`` out of its cells."""
        for cell in self._touched(self.bounds[i]):
            self.cells[cell].discard(i)

    def find(self, i: int, distance: float) -> NDArray[np.int64]:
        """Find the other polygons, ascending, whose bounding boxes come within a distance (m) of ``i``'s."""
        grown = self.bounds[i] + distance * np.array([-1.0, -1.0, 1.0, 1.0])
        seen: set[int] = set()
        seen.update(*(self.cells.get(cell, ()) for cell in self._touched(grown)))
        seen.discard(i)
        near = np.array(sorted(seen), dtype=np.int64)
        box = self.bounds[near]
        close = near[(box[:, :2] <= grown[2:]).all(axis=1) & (box[:, 2:] >= grown[:2]).all(axis=1)]
        return np.asarray(close, dtype=np.int64)

    def _touched(self, bounds: NDArray[np.float64]) -> list[tuple[int, int]]:
        low_x, low_y, high_x, high_y = np.floor(bounds / self.size).astype(int).tolist()
        return [(x, y) for x in range(low_x, high_x + 1) for y in range(low_y, high_y + 1)]
