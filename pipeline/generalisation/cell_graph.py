"""Cells of a region by numbers alone: small ones joined to the neighbour with the longest border."""

import heapq

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.int64]


class SmallCells:
    """Joins small cells to the neighbour with the longest border, the smallest first, in a region given by parts.

    Parameters
    ----------
    limit : float
        Cells below this are fragments, and any neighbour takes them; with `alike` cells up to this are joined with
        each other (m2).
    alike : bool
        Whether only small cells take others in, until they are greater than `limit`.

    Notes
    -----
    A joined cell is a cell: it goes on while it is small. Of equal borders the greater neighbour, then the smaller
    number is taken. With `alike` no result is greater than twice the limit.

    The result is that of all cells at once. Joining a cell depends on its neighbours and changes their borders, so
    cells three borders apart do not matter to each other. A cell is joined when all cells within two borders are
    known, and no smaller one of them waits. Memory holds cells that wait and their neighbours, some hundred bytes
    for each border: those near the end of the known part, and beside a cell that reaches beyond it.
    """

    def __init__(self, limit: float, *, alike: bool = False) -> None:
        self.limit, self.alike, self.taken = limit, alike, 0  # how many were taken in by others
        self.size: dict[int, float] = {}
        self.first: dict[int, int] = {}  # the smallest number that a cell took in, where that is below its own
        self.beside: dict[int, dict[int, float]] = {}

    def add(self, cells: Index, area: Array, pairs: Index, length: Array) -> None:
        """Add cells with ascending numbers (n,), greater than all before, and borders by the lesser number.

        Parameters
        ----------
        cells : int64, (n,)
            With `alike` only those that may be joined.
        area : float64, (n,)
            Of each (m2).
        pairs : int64, (p, 2)
            Cells that share a border, the lesser number first, each pair once. The other one may be still to come.
        length : float64, (p,)
            Of that border (m).
        """
        self.size.update(zip(cells.tolist(), area.tolist(), strict=True))
        for (a, b), border in zip(pairs.tolist(), length.tolist(), strict=True):
            if a in self.size and (self.is_small(a) or not self.alike):
                self.beside.setdefault(a, {})[b] = border
                self.beside.setdefault(b, {})[a] = border

    def is_small(self, cell: int) -> bool:
        """Whether a cell is to be joined."""
        size = self.size[cell]
        return size <= self.limit if self.alike else size < self.limit

    def join(self, end: int) -> list[tuple[int, int]]:
        """Join what can be joined when all cells with numbers below `end` are known.

        Returns
        -------
        list of (int, int)
            A cell, and the one that stands for it from then on, in the order in which it happened: that which took
            it in, at last the smallest number of all that became one. What is named here is not given again.
        """
        self._drop(end)
        beside, size, joined = self.beside, self.size, []
        ahead = [cell for cell in beside if cell >= end]
        blocked = {*ahead}.union(*(beside[cell] for cell in ahead))  # what waits, and what is next to it
        waiting = [(size[cell], cell) for cell in beside if cell < end and self.is_small(cell)]
        heapq.heapify(waiting)
        while waiting:
            known, cell = heapq.heappop(waiting)
            if cell not in beside or known != size[cell]:
                continue
            if cell in blocked or not blocked.isdisjoint(beside[cell]):
                blocked.add(cell)
                blocked.update(beside[cell])
                continue
            near = [other for other in beside[cell] if not self.alike or self.is_small(other)]
            if not near:
                continue
            into = max(near, key=lambda other: (beside[cell][other], size[other], -other))
            for other, border in beside.pop(cell).items():
                del beside[other][cell]
                if other != into:
                    beside[into][other] = beside[other][into] = beside[into].get(other, 0.0) + border
            size[into] += size.pop(cell)
            self.first[into] = min(self.first.get(into, into), self.first.pop(cell, cell))
            joined.append((cell, into))
            self.taken += 1
            if self.is_small(into):
                heapq.heappush(waiting, (size[into], into))
        self._drop(end)
        for cell in size.keys() - self.beside.keys():
            del size[cell]
            if (first := self.first.pop(cell, cell)) != cell:
                joined.append((cell, first))
        return joined

    def _drop(self, end: int) -> None:
        """Drop borders of which none can be looked at, as cells only grow, and cells that are left alone."""
        for cell, near in self.beside.items():
            for other in [other for other in near if not self._counts(cell, other, end)]:
                del near[other]
        self.beside = {cell: near for cell, near in self.beside.items() if near}

    def _counts(self, cell: int, other: int, end: int) -> bool:
        small = [one >= end or (one in self.size and self.is_small(one)) for one in (cell, other)]
        return all(small) if self.alike else any(small)
