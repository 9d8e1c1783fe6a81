"""Parts of roofs as cycles of nodes: cut at a level, joined with a neighbour (for `skeleton_roofs`)."""

from collections.abc import Sequence
from itertools import pairwise

from pipeline.data.errors import GeometryError

SAME_LEVEL = 1e-9  # of a time, below which a node is on the level of a cut


class LevelCuts:
    """Cuts of cycles at one level; cycles beside each other get the same nodes.

    Attributes
    ----------
    xy : list of (float, float)
        Places of all nodes; those of cuts are added.
    time : list of float
        Level of each node.
    """

    def __init__(self, xy: Sequence[tuple[float, float]], time: Sequence[float], level: float) -> None:
        self.xy, self.time = list(xy), list(time)
        self._level = level
        self._found: dict[tuple[int, int], int] = {}

    def cut(self, cycle: Sequence[int], along: tuple[float, float]) -> tuple[list[list[int]], list[list[int]]]:
        """Cut the face of an edge.

        Parameters
        ----------
        cycle : sequence of int
            Nodes around the face, counter-clockwise.
        along : (float, float)
            Unit vector along its edge.

        Returns
        -------
        below, above : list of list of int
            Cycles of the pieces on either side of the level.
        """
        runs: dict[bool, list[list[int]]] = {False: [], True: []}
        is_above = [self.time[node] >= self._level - SAME_LEVEL for node in cycle]
        n = len(cycle)
        crossings = [k for k in range(n) if is_above[k] != is_above[(k + 1) % n]]
        if not crossings:
            runs[is_above[0]].append(list(cycle))
            return runs[False], runs[True]
        for k, stop in pairwise([*crossings, crossings[0] + n]):
            ends = [self._between(cycle[j % n], cycle[(j + 1) % n]) for j in (k, stop)]
            run = [ends[0], *(cycle[j % n] for j in range(k + 1, stop + 1)), ends[1]]
            runs[is_above[(k + 1) % n]].append([node for i, node in enumerate(run) if not i or node != run[i - 1]])
        return self._close(runs[False], along), self._close(runs[True], along)

    def _between(self, a: int, b: int) -> int:
        """Node where a line crosses the level: one of its ends if that is on it."""
        low, high = sorted((a, b), key=lambda node: self.time[node])
        if self.time[high] <= self._level + SAME_LEVEL:
            return high
        key = low, high
        if key not in self._found:
            (x, y), (to_x, to_y) = self.xy[low], self.xy[high]
            f = (self._level - self.time[low]) / (self.time[high] - self.time[low])
            self._found[key] = len(self.xy)
            self.xy.append((x + f * (to_x - x), y + f * (to_y - y)))
            self.time.append(self._level)
        return self._found[key]

    def _close(self, runs: list[list[int]], along: tuple[float, float]) -> list[list[int]]:
        """Close runs from level to level to cycles: the level is inside the face every other time."""

        def place(of_end: tuple[int, bool]) -> float:
            x, y = self.xy[runs[of_end[0]][-1 if of_end[1] else 0]]
            return along[0] * x + along[1] * y

        ends = sorted(((k, is_end) for k in range(len(runs)) for is_end in (False, True)), key=place)
        following = {}
        for one, other in zip(ends[::2], ends[1::2], strict=True):
            start, stop = sorted((one, other), key=lambda of_end: of_end[1])
            if start[1] or not stop[1]:
                raise GeometryError(f"the sides of a face cross the level {self._level:.6g} in no order")
            following[stop[0]] = start[0]
        cycles = []
        while following:
            k = next(iter(following))
            cycle: list[int] = []
            while k in following:
                cycle += runs[k]
                k = following.pop(k)
            cycles.append([node for i, node in enumerate(cycle) if node != cycle[i - 1]])
        return [cycle for cycle in cycles if len(set(cycle)) > 2]


def join_cycles(one: Sequence[int], other: Sequence[int]) -> list[int] | None:
    """Join two cycles that have sides in common; None where the result is not one simple cycle.

    Examples
    --------
    >>> join_cycles([0, 1, 2, 3], [1, 4, 5, 2])
    [0, 1, 4, 5, 2, 3]
    """
    sides = {*_sides(one), *_sides(other)}
    open_sides = [(a, b) for a, b in (*_sides(one), *_sides(other)) if (b, a) not in sides]
    following = dict(open_sides)
    if len(following) < len(open_sides) or len(open_sides) == len(one) + len(other):
        return None
    start = one[0] if one[0] in following else open_sides[0][0]
    cycle = [start]
    while (node := following[cycle[-1]]) != start:
        cycle.append(node)
        if len(cycle) > len(following):
            raise GeometryError(f"the sides of two parts around the nodes {cycle[:5]} do not close")
    return cycle if len(cycle) == len(following) else None


def _sides(cycle: Sequence[int]) -> list[tuple[int, int]]:
    return list(zip(cycle, [*cycle[1:], cycle[0]], strict=True))
