"""Sharp corners of the wall graph, and corners in which houses only touch (step 2.1, our way).

Both are mended by one operation, the cut: a point on each of the walls that bound a sector at a corner, a new wall
between them, and one or all of the old pieces between these points and the corner go.
"""

from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.simplification.graph import Faces, WallGraph, make_graph
from pipeline.simplification.labels import OPEN

# Walls that meet at a smaller angle (degrees) are cut: the 2D mesher refines far into such a corner.
SHARP = 20.0
# A cut is this much wider than the clearance, so that rounding to the grid does not spoil it.
MARGIN = 1.05
# No cut takes more of a wall than this many times the clearance: at a sharp tip, where houses part.
LONGEST_TIP = 40.0
LONGEST_PART = 4.0
# A sector wider than this (degrees) has no chord that keeps away from its corner.
WIDEST_CUT = 140.0


@dataclass(frozen=True, eq=False)
class Spokes:
    """The ends of all walls, around each vertex counter-clockwise."""

    #: (2m,): the vertex, the wall's other end, and the wall
    vertex: NDArray[np.int64]
    head: NDArray[np.int64]
    edge: NDArray[np.int64]
    #: (2m,): the next and the last spoke around the vertex
    after: NDArray[np.int64]
    before: NDArray[np.int64]
    angle: NDArray[np.float64]  #: (2m,): from this spoke to the next one (radians)
    label: NDArray[np.int64]  #: (2m,): label of the face between this spoke and the next one


def find_touches(graph: WallGraph, faces: Faces, label: NDArray[np.int64]) -> NDArray[np.int64]:
    """Find the vertices around which houses and open ground take turns more than once."""
    sides = np.append(label, OPEN)[faces.sides]
    outer = (sides == OPEN).any(axis=1)
    count = np.bincount(graph.edges[outer].reshape(-1), minlength=len(graph.xy))
    return np.flatnonzero(count > 2)


def mend_corners(
    graph: WallGraph, faces: Faces, label: NDArray[np.int64], *, clearance: float, manifold: bool
) -> tuple[WallGraph, NDArray[np.int64], Counter[str]]:
    """Cut sharp corners and, if asked for, the corners in which houses touch.

    Parameters
    ----------
    graph, faces, label
        As `pipeline.simplification.labels.dissolve` leaves them, with clearance.
    clearance : float
        Least length of a cut and of what it leaves of a wall (mm).
    manifold : bool
        Open or close the corners of `find_touches`.

    Returns
    -------
    graph : WallGraph
        With new walls along the cuts. Other features may be too close to them: settle again.
    where : int64
        Cluster of each cut.
    counts : Counter
        ``"blunted"``, ``"opened"`` and ``"closed"`` corners.

    Notes
    -----
    The tip of a sharp sector goes to the face behind the wall on whose other side the angle is smaller. A
    touching corner is opened by cutting the houses of one sector, the narrowest one that has the room, else
    closed by giving the tip of an open sector to the house next to it. Corners where no wall is
    long enough stay. A wall is used by one cut only; what that leaves out has its turn after the next rounds.
    """
    if not len(graph.edges):
        return graph, np.zeros(0, np.int64), Counter()
    spokes = list_spokes(graph, faces, label)
    cuts = _Cuts(graph, spokes, clearance)
    if manifold:
        for vertex in find_touches(graph, faces, label):
            cuts.part(int(vertex))
    for spoke in np.flatnonzero(spokes.angle < np.radians(SHARP)):
        cuts.blunt(int(spoke))
    return cuts.apply(), np.array(cuts.where, np.int64), cuts.counts


def list_spokes(graph: WallGraph, faces: Faces, label: NDArray[np.int64]) -> Spokes:
    """List the ends of all walls around their vertices."""
    vertex, head = graph.edges.T.reshape(-1), graph.edges[:, ::-1].T.reshape(-1)
    edge = np.tile(np.arange(len(graph.edges)), 2)
    left = np.append(label, OPEN)[faces.sides].T.reshape(-1)
    way = graph.xy[head] - graph.xy[vertex]
    bearing = np.arctan2(way[:, 1], way[:, 0])
    order = np.lexsort((bearing, vertex))
    vertex, bearing = vertex[order], bearing[order]
    first = np.searchsorted(vertex, vertex)
    last = np.searchsorted(vertex, vertex, side="right") - 1
    row = np.arange(len(vertex))
    after = np.where(row == last, first, row + 1)
    before = np.where(row == first, last, row - 1)
    angle = (bearing[after] - bearing) % (2 * np.pi)
    return Spokes(vertex, head[order], edge[order], after, before, angle, left[order])


class _Cuts:
    """Cuts to make at once, no two at one wall."""

    def __init__(self, graph: WallGraph, spokes: Spokes, clearance: float) -> None:
        self.graph, self.spokes, self.clearance = graph, spokes, clearance
        self.length = graph.lengths()[spokes.edge]
        self.gone = np.zeros(len(graph.edges), np.bool_)
        self.points: list[NDArray[np.float64]] = []
        self.owners: list[int] = []
        self.edges: list[tuple[int, int]] = []
        self.where: list[int] = []
        self.counts = Counter[str]()

    def blunt(self, first: int) -> None:
        """Cut off the tip of a sharp sector."""
        pair = [first, int(self.spokes.after[first])]
        radius = MARGIN * self.clearance / (2 * np.sin(self.spokes.angle[first] / 2))
        if radius > LONGEST_TIP * self.clearance:
            return
        shorter = float(self.length[pair].min())
        behind = self.spokes.angle[[self.spokes.before[first], pair[1]]]
        going = {pair[int(behind[1] < behind[0])]}
        if self._cut(pair, shorter if radius > shorter - self.clearance else radius, going):
            self.counts["blunted"] += 1

    def part(self, vertex: int) -> None:
        """Open a corner in which houses touch, else close it."""
        runs = self._list_runs(vertex)
        built = [run for run in runs if self.spokes.label[run[0]] != OPEN]
        for run in sorted(built, key=self._measure_run):
            if self._cut(run, self._choose_radius(run), set(run)):
                self.counts["opened"] += 1
                return
        for run in sorted((run for run in runs if run not in built), key=self._measure_run):
            if self._cut(run, self._choose_radius(run), {run[0]}):
                self.counts["closed"] += 1
                return

    def apply(self) -> WallGraph:
        """Make the cuts."""
        graph = self.graph
        if not self.where:
            return graph
        ends = np.array(self.edges, np.int64)
        return make_graph(
            np.concatenate((graph.xy, np.reshape(self.points, (-1, 2)))),
            np.append(graph.cluster, np.array(self.owners, np.int64)),
            np.concatenate((graph.edges[~self.gone], ends)),
            # A cut is meant to stay: no slack is left to straighten it away.
            np.append(graph.slack[~self.gone], np.full(len(ends), np.inf)),
        )

    def _list_runs(self, vertex: int) -> list[list[int]]:
        """List the runs of built and of open sectors around a vertex by their spokes, both borders included."""
        spokes = self.spokes
        start, stop = np.searchsorted(spokes.vertex, [vertex, vertex + 1])
        built = spokes.label[start:stop] != OPEN
        runs = []
        for k in np.flatnonzero(built != np.roll(built, 1)):
            run = [int(start + k), int(spokes.after[start + k])]
            while (spokes.label[run[-1]] != OPEN) == built[k]:
                run.append(int(spokes.after[run[-1]]))
            runs.append(run)
        return runs

    def _measure_run(self, run: list[int]) -> tuple[float, int]:
        return float(self.spokes.angle[run[:-1]].sum()), run[0]

    def _choose_radius(self, run: list[int]) -> float:
        """Choose the least distance from the corner at which cuts keep away from it and from its other walls."""
        sectors = self.spokes.angle[run[:-1]]
        if sectors.max() > np.radians(WIDEST_CUT):
            return np.inf
        beside = self.spokes.angle[[self.spokes.before[run[0]], run[-1]]]
        narrow = np.sin(np.minimum(beside, np.pi / 2))
        factor = np.max([0.5 / np.sin(sectors / 2).min(), 1 / np.cos(sectors / 2).min(), 1 / narrow.min()])
        return float(MARGIN * self.clearance * factor) if factor <= LONGEST_PART else np.inf

    def _cut(self, run: list[int], radius: float, going: set[int]) -> bool:
        """Join points at a distance along some spokes; the first pieces of those in ``going`` go."""
        spokes, graph = self.spokes, self.graph
        used = spokes.edge[run]
        if self.length[run].min() < radius or self.gone[used].any():
            return False
        number = len(graph.xy) + len(self.points)
        whole = self.length[run] < radius + self.clearance
        nodes = np.where(whole, spokes.head[run], number + np.arange(len(run)))
        chords = np.sort(np.column_stack((nodes[:-1], nodes[1:])), axis=1)
        if (chords[:, None] == graph.edges[spokes.edge]).all(axis=2).any():
            return False  # a triangle would vanish
        vertex = int(spokes.vertex[run[0]])
        way = graph.xy[spokes.head[run]] - graph.xy[vertex]
        self.owners.extend([int(graph.cluster[vertex])] * len(run))
        self.points.extend(np.rint(graph.xy[vertex] + way * (radius / self.length[run])[:, None]))
        self.edges.extend((int(a), int(b)) for a, b in chords)
        for spoke, node in zip(run, nodes, strict=True):
            if spoke not in going:
                self.edges.append((vertex, int(node)))
            if node != spokes.head[spoke]:
                self.edges.append((int(node), int(spokes.head[spoke])))
        self.gone[used] = True
        self.where.append(int(graph.cluster[vertex]))
        return True
