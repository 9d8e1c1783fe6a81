"""Rounds that give a planar graph of walls its clearance (step 2.1, our way)."""

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.simplification.graph import (
    WallGraph,
    find_close,
    find_crossings,
    find_near,
    join_graphs,
    make_graph,
    thread_edges,
)

# Real blocks settle within 10 rounds; what does not by now never will.
MAX_ROUNDS = 40
# Walls count up to this length (mm) where corners are ranked: longer ones are no more important.
LONG_WALL = 10_000.0
# A vertex closer than this (mm) to the line between its neighbours is on it: coordinates are whole millimetres.
STRAIGHT = 1.5
Step = tuple[WallGraph, NDArray[np.int64]]


def settle(
    graph: WallGraph, *, clearance: float, chain_tolerance: float, least_moved: bool = False
) -> tuple[WallGraph, NDArray[np.int64], Counter[str]]:
    """Simplify and snap walls until no two features are closer than the clearance.

    Parameters
    ----------
    graph : WallGraph
        Noded walls.
    clearance : float
        Least distance of two vertices, and of a vertex and an edge that does not end in it (mm).
    chain_tolerance : float
        A vertex of two walls goes if that moves no wall farther than this from where it was noded (mm).
    least_moved : bool
        Of vertices that are united, the one stays whose move would take its walls over most ground, not the one
        of the longest walls and the sharpest turn.

    Returns
    -------
    graph : WallGraph
        Each cluster in the state in which it settled, or was after `MAX_ROUNDS`.
    restless : int64
        Clusters that did not settle, ascending.
    counts : Counter
        ``"rounds"`` (of the cluster that took most), and how many vertices were ``"straightened"``,
        ``"collapsed"``, ``"contracted"``, edges ``"bent"`` and ``"crossings"`` noded.

    Notes
    -----
    A round straightens chains, collapses vertices that are too close, and leads each edge that a vertex is too
    close to through the closest one, or, where that would only turn a thin triangle over, contracts the vertex
    with the nearer end of the edge. Straightening, collapsing and contracting take vertices away, bending
    replaces an edge by two shorter ones: this ends by itself. Only then are the crossings noded that are left
    (an edge bent first may cross one that is bent next), which adds vertices and is why there is a cap. Every
    choice depends on one cluster alone, and a cluster that a round leaves as it was is done: all at once or
    one by one gives the same bits.
    """
    steps: tuple[tuple[str, Callable[[WallGraph, float], Step], float], ...] = (
        ("straightened", straighten, chain_tolerance),
        ("collapsed", partial(collapse, least_moved=least_moved), clearance),
        ("contracted", partial(contract, least_moved=least_moved), clearance),
        ("bent", bend, clearance),
    )
    done, counts = [], Counter[str]()
    rounds = 0
    restless = np.unique(graph.cluster)
    while len(restless) and rounds < MAX_ROUNDS:
        rounds += 1
        changed: list[NDArray[np.int64]] = []
        for name, step, length in steps:
            graph, where = step(graph, length)
            counts[name] += len(where)
            changed.append(where)
        graph, where = node_crossings(graph, np.concatenate(changed))
        counts["crossings"] += len(where)
        changed.append(where)
        restless = np.unique(np.concatenate(changed))
        still = np.isin(graph.edge_clusters(), restless)
        done.append(graph.keep(~still))
        graph = graph.keep(still)
    counts["rounds"] = rounds
    return join_graphs([*done, graph]), restless, counts


def straighten(graph: WallGraph, tolerance: float) -> Step:
    """Drop the vertices of two walls that make no shape; give the cluster of each.

    The thinnest triangle of a vertex and its neighbours goes first, and only where no other vertex lies in it,
    so nothing crosses.
    """
    where: list[NDArray[np.int64]] = []
    while True:
        drop, sides, slack = _choose_needless(graph, tolerance)
        if not len(drop):
            return graph, _concatenate(where)
        where.append(graph.cluster[drop])
        gone = np.isin(graph.edges, drop).any(axis=1)
        edges = np.concatenate((graph.edges[~gone], sides))
        slacks = np.concatenate((graph.slack[~gone], slack))
        graph = make_graph(graph.xy, graph.cluster, edges, slacks)


def collapse(graph: WallGraph, clearance: float, *, least_moved: bool = False) -> Step:
    """Unite the vertices closer than the clearance with the most important one around."""
    (i, j), distance = find_near(graph, clearance)
    i, j, distance = np.concatenate((i, j)), np.concatenate((j, i)), np.tile(distance, 2)
    rank = _rank(graph)
    if least_moved:
        passed = np.full(len(rank), np.inf)
        np.minimum.at(passed, i, _measure_passed(graph, i, j))
        rank[np.lexsort((rank, -passed))] = np.arange(len(rank))
    state = _choose_keepers(rank, i, j)
    target = np.arange(len(graph.xy))
    leads = state[i] & ~state[j]
    i, j, distance = i[leads], j[leads], distance[leads]
    order = np.lexsort((rank[i], distance, j))
    follower, first = np.unique(j[order], return_index=True)
    target[follower] = i[order][first]
    return _unite_vertices(graph, target), graph.cluster[follower]


def contract(graph: WallGraph, clearance: float, *, least_moved: bool = False) -> Step:
    """Unite vertices with the end of a close edge where bending would only turn a thin triangle over."""
    (vertex, edge), _ = find_close(graph, clearance)
    flips = ~_shortens(graph, vertex, edge)
    vertex, edge = vertex[flips], edge[flips]
    ends = graph.edges[edge]
    far = np.hypot(*(graph.xy[ends] - graph.xy[vertex][:, None]).transpose(2, 0, 1))
    end = ends[np.arange(len(ends)), (far[:, 1] < far[:, 0]).astype(np.int64)]
    low, high = np.minimum(vertex, end), np.maximum(vertex, end)
    order = np.lexsort((high, low))
    low, high = low[order], high[order]
    first = np.full(len(graph.xy), len(low))
    np.minimum.at(first, low, np.arange(len(low)))
    np.minimum.at(first, high, np.arange(len(low)))
    mine = (first[low] == np.arange(len(low))) & (first[high] == np.arange(len(low)))
    low, high = low[mine], high[mine]
    rank = _rank(graph)
    stays = rank[low] < rank[high]
    if least_moved:
        passed = _measure_passed(graph, low, high) - _measure_passed(graph, high, low)
        stays = np.where(passed == 0, stays, passed > 0)
    target = np.arange(len(graph.xy))
    target[np.where(stays, high, low)] = np.where(stays, low, high)
    return _unite_vertices(graph, target), graph.cluster[low]


def bend(graph: WallGraph, clearance: float) -> Step:
    """Lead each edge that has vertices too close to it through the closest one."""
    (vertex, edge), distance = find_close(graph, clearance)
    bends = np.flatnonzero(_shortens(graph, vertex, edge))
    order = bends[np.lexsort((vertex[bends], distance[bends], edge[bends]))]
    edge, first = np.unique(edge[order], return_index=True)
    vertex, moved = vertex[order][first], distance[order][first]
    return thread_edges(graph, edge, vertex, moved), graph.cluster[vertex]


def node_crossings(graph: WallGraph, spare: NDArray[np.int64]) -> Step:
    """Put a vertex on the grid where two edges cross, but for some clusters."""
    i, j = find_crossings(graph)
    ripe = ~np.isin(graph.edge_clusters()[i], spare)
    i, j = i[ripe], j[ripe]
    if not len(i):
        return graph, np.zeros(0, np.int64)
    u, v = graph.vectors()[i], graph.vectors()[j]
    origin = graph.xy[graph.edges[i, 0]]
    offset = graph.xy[graph.edges[j, 0]] - origin
    share = (offset[:, 0] * v[:, 1] - offset[:, 1] * v[:, 0]) / (u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0])
    place = np.rint(origin + share[:, None] * u)
    where = graph.edge_clusters()[i]
    number = len(graph.xy) + np.arange(len(i))
    grown = replace(graph, xy=np.concatenate((graph.xy, place)), cluster=np.concatenate((graph.cluster, where)))
    none = np.zeros(2 * len(i))
    return thread_edges(grown, np.concatenate((i, j)), np.tile(number, 2), none), where


def _shortens(graph: WallGraph, vertex: NDArray[np.int64], edge: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Tell where both edges from a vertex to the ends of an edge are shorter than that edge."""
    legs = graph.xy[graph.edges[edge]] - graph.xy[vertex][:, None]
    result: NDArray[np.bool_] = (legs**2).sum(axis=2).max(axis=1) < (graph.vectors()[edge] ** 2).sum(axis=1)
    return result


def _rank(graph: WallGraph) -> NDArray[np.int64]:
    """Rank the vertices: junctions and sharp turns of long walls first, ties by (x, y)."""
    unit = graph.vectors() / graph.lengths()[:, None]
    pull, length = np.zeros_like(graph.xy), np.zeros(len(graph.xy))
    for end, sign in ((0, 1.0), (1, -1.0)):
        np.add.at(pull, graph.edges[:, end], sign * unit)
        np.add.at(length, graph.edges[:, end], graph.lengths())
    turn = np.where(graph.degrees() == 2, np.hypot(*pull.T), 2.0)
    weight = np.rint(turn * np.minimum(length, LONG_WALL))
    rank = np.empty(len(weight), np.int64)
    rank[np.lexsort((np.arange(len(weight)), -weight))] = np.arange(len(weight))
    return rank


def _measure_passed(graph: WallGraph, vertex: NDArray[np.int64], goal: NDArray[np.int64]) -> NDArray[np.float64]:
    """Measure the ground (mm²) that the walls of each vertex pass over if it moves to another one."""
    order = np.argsort(graph.edges.reshape(-1), kind="stable")
    far, degree = graph.edges[:, ::-1].reshape(-1)[order], graph.degrees()
    count = degree[vertex]
    of = np.repeat(np.arange(len(vertex)), count)
    first = (np.cumsum(degree) - degree)[vertex] - (np.cumsum(count) - count)
    wall = graph.xy[far[first[of] + np.arange(len(of))]] - graph.xy[vertex][of]
    area: NDArray[np.float64] = np.abs(_cross((graph.xy[goal] - graph.xy[vertex])[of], wall)) / 2
    return np.bincount(of, area, len(vertex)).astype(np.float64)


def _choose_keepers(rank: NDArray[np.int64], i: NDArray[np.int64], j: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Choose the vertices that a walk by rank would keep, leaving out the neighbours of those kept."""
    kept, open_ = np.zeros(len(rank), np.bool_), np.ones(len(rank), np.bool_)
    while open_.any():
        live = open_[i] & open_[j]
        i, j = i[live], j[live]
        best = np.full(len(rank), len(rank))
        np.minimum.at(best, i, rank[j])
        leads = open_ & (rank < best)
        kept |= leads
        open_ &= ~leads
        open_[j[leads[i]]] = False
    return kept


def _unite_vertices(graph: WallGraph, target: NDArray[np.int64]) -> WallGraph:
    return make_graph(graph.xy, graph.cluster, target[graph.edges], graph.slack)


def _choose_needless(
    graph: WallGraph, tolerance: float
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Choose vertices to drop, no two of them neighbours, with the edges that take their place."""
    two = np.flatnonzero(graph.degrees() == 2)
    ends = graph.edges.reshape(-1)
    order = np.argsort(ends, kind="stable")
    start = np.searchsorted(ends[order], two)
    edges = np.column_stack((order[start], order[start + 1])) // 2 if len(two) else np.zeros((0, 2), np.int64)
    sides = graph.edges[edges].sum(axis=2) - two[:, None]
    back, ahead = graph.xy[sides[:, 0]] - graph.xy[two], graph.xy[sides[:, 1]] - graph.xy[two]
    # A closed triangle has its third wall already: without the vertex nothing would be left.
    base = np.hypot(*(ahead - back).T)
    altitude = np.abs(back[:, 0] * ahead[:, 1] - back[:, 1] * ahead[:, 0]) / np.maximum(base, 1.0)
    altitude = np.where((back * ahead).sum(axis=1) < 0, altitude, np.inf)
    slack = graph.slack[edges].max(axis=1, initial=0.0) + altitude
    thin = np.flatnonzero((slack <= tolerance) | (altitude < STRAIGHT))
    thin = thin[_is_empty(graph, two[thin], sides[thin])]
    rank = np.full(len(graph.xy), len(graph.xy))
    rank[two[thin[np.lexsort((two[thin], altitude[thin]))]]] = np.arange(len(thin))
    first = rank[two[thin]] < rank[sides[thin]].min(axis=1, initial=len(graph.xy))
    chosen = thin[first]
    return two[chosen], sides[chosen], slack[chosen]


def _is_empty(graph: WallGraph, vertex: NDArray[np.int64], sides: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Tell which triangles of a vertex and its two neighbours hold no other vertex of their cluster."""
    corners = np.column_stack((vertex, sides))
    xy = graph.xy[corners]
    boxes = shapely.box(*xy.min(axis=1).T, *xy.max(axis=1).T)
    around = np.flatnonzero(np.isin(graph.cluster, graph.cluster[vertex]))
    triangle, point = shapely.STRtree(shapely.points(graph.xy[around])).query(boxes)
    point = around[point]
    other = (corners[triangle] != point[:, None]).all(axis=1) & (
        graph.cluster[vertex[triangle]] == graph.cluster[point]
    )
    triangle, point = triangle[other], point[other]
    a, b, c = xy[triangle].transpose(1, 0, 2)
    p = graph.xy[point]
    turns = np.stack([_cross(v - u, p - u) for u, v in ((a, b), (b, c), (c, a))])
    inside = (turns >= 0).all(axis=0) | (turns <= 0).all(axis=0)
    empty = np.ones(len(vertex), np.bool_)
    empty[triangle[inside]] = False
    return empty


def _cross(u: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
    result: NDArray[np.float64] = u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]
    return result


def _concatenate(parts: list[NDArray[np.int64]]) -> NDArray[np.int64]:
    return np.concatenate([np.zeros(0, np.int64), *parts])
