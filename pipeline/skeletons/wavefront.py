"""Wavefront of a polygon whose edges move inwards, and its events (for `straight_skeleton`)."""

import heapq
import math
from collections.abc import Sequence
from itertools import pairwise

from pipeline.data.errors import GeometryError

CONTACT = 1e-6  # m, what comes this close at one time meets there
PARALLEL = 1e-9  # sine of the angle below which edges of different speed count as parallel
REFLEX = 1e-9  # sine of the turn to the left below which a vertex is tested against edges that it may run into
TOUCHING = 1e-4  # radians by which the outer sides of two parts of the outline may overlap where they touch
SHRUNK, SPLIT, SET_OFF = range(3)  # kinds of events: an edge without length, a vertex on an edge, edges set off
EVENTS_PER_EDGE = 30  # far above what any polygon needs: a polygon of n edges has fewer than 2 n nodes

Point = tuple[float, float]


class Chain:
    """Vertices that end at a node one after the other, or none for an edge that is divided there.

    Attributes
    ----------
    run : list of int
        The vertices.
    before, after : int
        Vertices before and after them, which stay.
    left, right : int
        Edges before and after them.
    middle, half : float
        Direction of the middle of the outer side around the node, and half its angle (radians).
    born_before, born_after : int
        New vertices at the end of ``left`` and at the start of ``right``.
    """

    def __init__(self, run: list[int], ends: tuple[int, int], edges: tuple[int, int], along: list[Point]) -> None:
        self.run = run
        self.before, self.after = ends
        self.left, self.right = edges
        (ax, ay), (bx, by) = along[self.left], along[self.right]
        start = math.atan2(-ay, -ax)
        outer = (math.atan2(by, bx) - start) % (2 * math.pi)
        if outer < TOUCHING and len(run) > 1:  # edges that came to lie on each other: there is no inner side
            outer += 2 * math.pi
        self.half = 0.5 * outer
        self.middle = (start + self.half) % (2 * math.pi)
        self.born_before = self.born_after = -1

    def is_apart(self, other: "Chain") -> bool:
        """Tell whether the outer sides of two chains do not overlap."""
        turn = abs(self.middle - other.middle)
        return min(turn, 2 * math.pi - turn) >= self.half + other.half - TOUCHING


class Wavefront:
    """A moving outline: vertices in rings, each between two edges of the polygon, and the nodes where they end.

    Edge ``e`` lies at time ``t`` on the line of the places ``x`` with ``normal[e] · x = offset[e] + speed[e] t``.
    Each vertex moves along a straight line from its birth node to its death node; the faces of the two edges
    beside it lie on either side of that line. Going around the face of an edge, counter-clockwise, the lines of
    the end vertices of the edge are passed upwards and those of its start vertices downwards. What follows is
    noted at each event, so that faces need no search.

    Attributes
    ----------
    start : list of float
        Time when each edge sets off; it stays where it is before.
    speed : list of float
        Speed of each edge now.
    birth, death : list of int
        Nodes where each vertex begins and ends; -1 while it moves.
    after_up, after_down : list of int
        What follows when the line of a vertex was passed upwards (downwards): ``2 v`` up along that of vertex
        ``v``, ``2 v + 1`` down along it, -1 for the end of the face.
    first, end : list of int
        Vertices where each edge starts and ends at the beginning.
    node_xy, node_time : list
        Place (m) and time of each node.
    """

    def __init__(
        self, rings: Sequence[Sequence[Point]], speed: Sequence[float], start: Sequence[float] | None = None
    ) -> None:
        self.start = [0.0] * len(speed) if start is None else list(start)
        self.speed = [s if t == 0 else 0.0 for s, t in zip(speed, self.start, strict=True)]
        self._waiting = {e: s for e, (s, t) in enumerate(zip(speed, self.start, strict=True)) if t > 0}
        self.along: list[Point] = []
        self.normal: list[Point] = []
        self.offset: list[float] = []
        self.birth: list[int] = []
        self.death: list[int] = []
        self.after_up: list[int] = []
        self.after_down: list[int] = []
        self.first: list[int] = []
        self.end: list[int] = []
        self.node_xy: list[Point] = []
        self.node_time: list[float] = []
        self._before: list[int] = []
        self._after: list[int] = []
        self._left: list[int] = []  # the edge that ends at the vertex
        self._right: list[int] = []  # the edge that starts at it
        self._path: list[tuple[float, float, float, float, float]] = []  # x, y, time, velocity
        self._moving: dict[int, None] = {}  # a set in the order of births
        self._starts: list[list[int]] = []  # start vertices that each edge ever had
        self._queue: list[tuple[float, int, int, int]] = []
        self._at_once: list[tuple[int, tuple[int, ...]]] = []
        self._now = 0.0
        for ring in rings:
            self._add_ring(ring)
        self._events_left = EVENTS_PER_EDGE * len(self.offset) + 100
        xs, ys = zip(*(xy for ring in rings for xy in ring), strict=True)
        self._bounds = min(xs) - CONTACT, min(ys) - CONTACT, max(xs) + CONTACT, max(ys) + CONTACT

    def run(self) -> None:
        """Move the outline until nothing is left of it.

        Raises
        ------
        GeometryError
            If edges are left that no event ends, or there are more events than any polygon has.
        """
        vertices = list(self._moving)
        for v in vertices:
            self._set_motion(v)
        for v in vertices:
            self._add_shrinking(v)
            self._add_splits(v)
        for t in sorted({self.start[e] for e in self._waiting}):
            heapq.heappush(self._queue, (t, SET_OFF, -1, -1))
        while self._queue and self._moving:
            time, kind, v, other = heapq.heappop(self._queue)
            if self._happens(time, kind, v, other):
                self._now = max(self._now, time)
                self._take_event(kind, v, other)
        if self._moving:
            raise GeometryError(f"{len(self._moving)} edges meet no other edge{self._place()}")

    def _add_ring(self, ring: Sequence[Point]) -> None:
        start, n = len(self.offset), len(ring)
        for k, (x, y) in enumerate(ring):
            to_x, to_y = ring[(k + 1) % n]
            length = math.hypot(to_x - x, to_y - y)
            ux, uy = (to_x - x) / length, (to_y - y) / length
            self.along.append((ux, uy))
            self.normal.append((-uy, ux))
            # The middle halves the rounding of both ends.
            self.offset.append(-uy * 0.5 * (x + to_x) + ux * 0.5 * (y + to_y))
            node = self._add_node((x, y), 0.0)
            self.first.append(self._add_vertex((start + (k - 1) % n, start + k), node))
            self._starts.append([start + k])
        for k in range(n):
            self._before[start + k] = start + (k - 1) % n
            self._after[start + k] = start + (k + 1) % n
            self.end.append(start + (k + 1) % n)

    def _add_node(self, xy: Point, time: float) -> int:
        node = len(self.node_xy)
        self.node_xy.append(xy)
        self.node_time.append(time)
        return node

    def _add_vertex(self, edges: tuple[int, int], node: int) -> int:
        v = len(self.birth)
        self.birth.append(node)
        self.death.append(-1)
        self.after_up.append(-1)
        self.after_down.append(-1)
        self._before.append(v)
        self._after.append(v)
        self._left.append(edges[0])
        self._right.append(edges[1])
        x, y = self.node_xy[node]
        self._path.append((x, y, self._now, 0.0, 0.0))
        self._moving[v] = None
        return v

    def _at(self, v: int, time: float) -> Point:
        x, y, since, vx, vy = self._path[v]
        return x + vx * (time - since), y + vy * (time - since)

    def ahead(self, e: int, xy: Point, time: float) -> float:
        """Distance of a place ahead of an edge's line."""
        nx, ny = self.normal[e]
        return nx * xy[0] + ny * xy[1] - self.offset[e] - self.speed[e] * time

    # Motion and what it leads to

    def _set_motion(self, v: int) -> None:
        """Give a vertex its velocity, and put it on both of its lines where they define a place."""
        i, j = self._left[v], self._right[v]
        (ax, ay), (bx, by), p, q = self.normal[i], self.normal[j], self.speed[i], self.speed[j]
        cross = ax * by - ay * bx
        x, y, time, _, _ = self._path[v]
        if p == q:
            square = (ax + bx) ** 2 + (ay + by) ** 2
            f = 2 * p / square if square > PARALLEL**2 else 0.0
            vx, vy = f * (ax + bx), f * (ay + by)
        elif abs(cross) > PARALLEL:
            vx, vy = (p * by - q * ay) / cross, (q * ax - p * bx) / cross
        else:
            vx, vy = 0.0, 0.0
        if abs(cross) > 1e-3:
            r, s = self.ahead(i, (x, y), time), self.ahead(j, (x, y), time)
            x, y = x - (r * by - s * ay) / cross, y - (s * ax - r * bx) / cross
        self._path[v] = x, y, time, vx, vy

    def _add_shrinking(self, v: int) -> None:
        """Note when the edge that starts at a vertex has no length."""
        other, e = self._after[v], self._right[v]
        (ux, uy), now = self.along[e], self._now
        (x, y), (to_x, to_y) = self._at(v, now), self._at(other, now)
        vx, vy = self._path[v][3:]
        to_vx, to_vy = self._path[other][3:]
        rate = ux * (to_vx - vx) + uy * (to_vy - vy)
        if rate < 0:
            length = ux * (to_x - x) + uy * (to_y - y)
            heapq.heappush(self._queue, (now + max(length, 0.0) / -rate, SHRUNK, v, other))

    def _add_splits(self, v: int) -> None:
        """Note when a vertex that may run into edges meets the line of each of them."""
        i, j = self._left[v], self._right[v]
        (ax, ay), (bx, by) = self.along[i], self.along[j]
        if ax * by - ay * bx > REFLEX:
            return
        now, (vx, vy) = self._now, self._path[v][3:]
        x, y = self._at(v, now)
        low_x, low_y, high_x, high_y = self._bounds
        speed, offset, queue = self.speed, self.offset, self._queue
        for e, (nx, ny) in enumerate(self.normal):
            rate = nx * vx + ny * vy - speed[e]
            if rate < 0 and e not in (i, j):
                ahead = nx * x + ny * y - offset[e] - speed[e] * now
                if ahead > -CONTACT:
                    lasts = ahead / -rate if ahead > 0 else 0.0
                    if low_x <= x + vx * lasts <= high_x and low_y <= y + vy * lasts <= high_y:
                        heapq.heappush(queue, (now + lasts, SPLIT, v, e))

    def _happens(self, time: float, kind: int, v: int, other: int) -> bool:
        """Tell whether an event that was noted is still to come."""
        if kind == SET_OFF:
            return True
        if v not in self._moving:
            return False
        if kind == SHRUNK:
            return other in self._moving and self._after[v] == other
        xy = self._at(v, time)
        return any(self._holds(s, xy, time) for s in self._starts[other] if s in self._moving)

    def _holds(self, s: int, xy: Point, time: float) -> bool:
        """Tell whether the edge that starts at vertex ``s`` has a place on it."""
        e = self._right[s]
        ux, uy = self.along[e]
        (x, y), (to_x, to_y) = self._at(s, time), self._at(self._after[s], time)
        start, stop = ux * (xy[0] - x) + uy * (xy[1] - y), ux * (xy[0] - to_x) + uy * (xy[1] - to_y)
        return start >= -CONTACT and stop <= CONTACT and abs(self.ahead(e, xy, time)) <= CONTACT

    # Events

    def _take_event(self, kind: int, v: int, other: int) -> None:
        if kind == SET_OFF:
            self._set_off()
        elif kind == SPLIT:
            self._meet(self._at(v, self._now), (v,))
        else:
            xy = self._at(v, self._now)
            to = self._at(other, self._now)
            self._meet((0.5 * (xy[0] + to[0]), 0.5 * (xy[1] + to[1])), (v, other))
        while self._at_once:
            to_v, ending = self._at_once.pop()
            if all(end in self._moving for end in ending):
                self._meet(self._at(to_v, self._now), ending)

    def _meet(self, xy: Point, ending: tuple[int, ...]) -> None:
        """End what meets at a place, the vertices ``ending`` in any case, and join the edges around it anew."""
        self._events_left -= 1
        if self._events_left < 0:
            raise GeometryError(f"more than {EVENTS_PER_EDGE} events an edge{self._place()}")
        gathered, divided = self._gather(xy, ending)
        loops, chains = self._chain(gathered, divided)
        chains = self._choose(chains, ending)
        if not loops and (not chains or (len(chains) == 1 and len(chains[0].run) == 1)):
            return
        node = self._node_at(xy)
        for loop in loops:
            self._end(loop, node)
            self._link_inside([*loop, loop[0]])
        self._start(
            [self._join(chains[k], chains[(k + 1) % len(chains)], node) for k in range(len(chains))], chains
        )

    def _gather(self, xy: Point, ending: tuple[int, ...]) -> tuple[set[int], list[int]]:
        """Find the vertices at a place, and the start vertices of edges that have it between their ends."""
        now = self._now
        gathered, divided = set(ending), []
        for s in self._moving:
            if abs(self.ahead(self._right[s], xy, now)) <= 4 * CONTACT:
                ends = s, self._after[s]
                near = [end for end in ends if end in gathered or math.dist(self._at(end, now), xy) <= CONTACT]
                gathered.update(near)
                if not near and self._holds(s, xy, now):
                    divided.append(s)
        return gathered, [s for s in divided if s not in gathered and self._after[s] not in gathered]

    def _chain(self, gathered: set[int], divided: list[int]) -> tuple[list[list[int]], list[Chain]]:
        """Put vertices at a place one after the other where an edge joins them; whole rings apart."""
        chains = [Chain([], (s, self._after[s]), (self._right[s], self._right[s]), self.along) for s in divided]
        left = dict.fromkeys(sorted(gathered))
        for v in sorted(gathered):
            if self._before[v] not in gathered:
                run = [v]
                while self._after[run[-1]] in gathered:
                    run.append(self._after[run[-1]])
                for u in run:
                    del left[u]
                last = run[-1]
                ends, edges = (self._before[v], self._after[last]), (self._left[v], self._right[last])
                chains.append(Chain(run, ends, edges, self.along))
        loops = []
        while left:
            loop = [next(iter(left))]
            while self._after[loop[-1]] != loop[0]:
                loop.append(self._after[loop[-1]])
            for u in loop:
                del left[u]
            loops.append(loop)
        return loops, chains

    def _choose(self, chains: list[Chain], ending: tuple[int, ...]) -> list[Chain]:
        """Keep the chain of the event and those that touch it from outside, in their order around the place.

        The rest are parts of the outline that were at the place before and left it: their outer sides overlap.
        """
        chosen = [chain for chain in chains if ending[0] in chain.run]
        if not chosen or len(chains) == 1:
            return chosen
        for chain in chains:
            if chain is not chosen[0] and all(chain.is_apart(other) for other in chosen):
                chosen.append(chain)
        return sorted(chosen, key=lambda chain: chain.middle)

    def _node_at(self, xy: Point) -> int:
        """Give the node at a place: one that is there at this time, or a new one."""
        for node, (place, time) in enumerate(zip(self.node_xy, self.node_time, strict=True)):
            if abs(place[0] - xy[0]) <= 2 * CONTACT and abs(place[1] - xy[1]) <= 2 * CONTACT:
                xy = place
                if abs(time - self._now) <= 4 * CONTACT:
                    return node
        return self._add_node(xy, self._now)

    def _end(self, run: list[int], node: int) -> None:
        for v in run:
            self.death[v] = node
            del self._moving[v]

    def _link_inside(self, run: list[int]) -> None:
        """Close the faces of the edges between vertices that end at one node."""
        for start, stop in pairwise(run):
            self.after_up[stop] = 2 * start + 1

    def _join(self, one: Chain, other: Chain, node: int) -> int:
        """Make the vertex between the edge that leaves one chain and the edge that comes to the other."""
        v = self._add_vertex((other.left, one.right), node)
        self._starts[one.right].append(v)
        self._before[v], self._after[v] = other.before, one.after
        one.born_after, other.born_before = v, v
        return v

    def _start(self, born: list[int], chains: list[Chain]) -> None:
        """Put new vertices in the place of those that end, and note what they lead to."""
        for chain in chains:
            before, after = chain.born_before, chain.born_after
            if chain.run:
                self._end(chain.run, self.birth[before])
                self._link_inside(chain.run)
                self.after_up[chain.run[0]] = 2 * before
                self.after_down[after] = 2 * chain.run[-1] + 1
            else:
                self.after_down[after] = 2 * before
        for v in born:
            self._after[self._before[v]] = v
            self._before[self._after[v]] = v
        for v in born:
            if v in self._moving:
                self._close_flat(v)
        self._begin([v for v in born if v in self._moving])

    def _begin(self, born: list[int]) -> None:
        """Let new vertices move, and note what follows from it."""
        for v in born:
            self._set_motion(v)
        for v in born:
            self._find_at_once(v)
            self._add_shrinking(v)
            if self._before[v] not in born:
                self._add_shrinking(self._before[v])
            self._add_splits(v)

    def _set_off(self) -> None:
        """Let the edges move whose time it is: their vertices end, and others begin there."""
        ready = {e for e in self._waiting if self.start[e] <= self._now}
        there = {self._right[v] for v in self._moving}
        for e in ready:
            speed = self._waiting.pop(e)
            if e in there:  # else others met above it: it is a gable
                self.speed[e] = speed
                self.offset[e] -= speed * self._now
        born = []
        for old in list(self._moving):
            edges = self._left[old], self._right[old]
            if ready.intersection(edges):
                node = self._node_at(self._at(old, self._now))
                v = self._add_vertex(edges, node)
                self._starts[edges[1]].append(v)
                self._end([old], node)
                self.after_up[old], self.after_down[v] = 2 * v, 2 * old + 1
                self._before[v], self._after[v] = self._before[old], self._after[old]
                self._after[self._before[v]] = self._before[self._after[v]] = v
                born.append(v)
        self._begin(born)
        for v in self._moving:
            self._add_splits(v)

    def _close_flat(self, v: int) -> None:
        """End a ring of two edges, which lie on each other, or of one without length."""
        other = self._after[v]
        if self._after[other] != v:
            return
        self._end([v] if other == v else [v, other], self.birth[v])  # the line of the other one is the ridge
        self.after_up[v] = 2 * other + 1
        self.after_up[other] = 2 * v + 1

    def _find_at_once(self, v: int) -> None:
        """Note what a new vertex between parallel edges leads to at the same time.

        Edges that came to lie on each other end where the shorter one ends. Of edges on one line with different
        speeds the faster one takes the place of the slower one.
        """
        i, j, now = self._left[v], self._right[v], self._now
        (ax, ay), (bx, by) = self.along[i], self.along[j]
        before, after = self._before[v], self._after[v]
        if ax * bx + ay * by > 0:
            if self.speed[i] != self.speed[j] and abs(ax * by - ay * bx) <= PARALLEL:
                slow = after if self.speed[j] < self.speed[i] else before
                self._at_once.append((slow, (slow, v)))
            return
        here, start, stop = self._at(v, now), self._at(before, now), self._at(after, now)
        from_start, to_stop = math.dist(here, start), math.dist(here, stop)
        if to_stop <= from_start and abs(self.ahead(i, stop, now)) <= CONTACT:
            self._at_once.append((after, (after,)))
        elif from_start < to_stop and abs(self.ahead(j, start, now)) <= CONTACT:
            self._at_once.append((before, (before,)))

    def _place(self) -> str:
        """Name the place where the wavefront is."""
        xy = self._at(next(iter(self._moving)), self._now) if self._moving else self.node_xy[-1]
        return f" near ({xy[0]:.3f}, {xy[1]:.3f}) at distance {self._now:.3f}"
