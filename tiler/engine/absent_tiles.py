"""The tiles that are absent, found by place: every task asks which of them are near it."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tiler.engine.stage import Box


class Gaps:
    """Boxes that no tile covers, sorted from west to east.

    Parameters
    ----------
    boxes : sequence of tuple of float
        Boxes (m).
    """

    def __init__(self, boxes: Sequence[Box]) -> None:
        self._boxes = boxes
        sides = np.array(boxes, np.float64).reshape(-1, 4)
        self._order = np.argsort(sides[:, 0], kind="stable")
        self._sides = sides[self._order]
        self._widest = float((sides[:, 2] - sides[:, 0]).max(initial=0.0))

    def near(self, low: NDArray[np.float64], high: NDArray[np.float64]) -> list[Box]:
        """List the boxes that meet a closed box, in the order in which they were given.

        Parameters
        ----------
        low, high : float64, (2,)
            Lower left and upper right of the box (m).

        Notes
        -----
        Only the columns that it spans are looked at: O(sqrt(n)) for the squares of a grid.
        """
        western = self._sides[:, 0]
        # Twice the widest, as the difference of two sides is rounded.
        first = int(np.searchsorted(western, low[0] - 2 * self._widest, side="left"))
        last = int(np.searchsorted(western, high[0], side="right"))
        some = self._sides[first:last]
        close = (some[:, 0] <= high[0]) & (some[:, 1] <= high[1]) & (some[:, 2] >= low[0]) & (some[:, 3] >= low[1])
        return [self._boxes[k] for k in np.sort(self._order[first:last][close]).tolist()]
