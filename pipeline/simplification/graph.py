"""The planar graph of walls: vertices on a millimetre grid, walls as edges, faces (step 2.1, our way)."""

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.geometry.rounding import round_corners

MILLIMETRES = 1000.0  # grid steps a metre
Pairs = tuple[NDArray[np.int64], NDArray[np.int64]]


@dataclass(frozen=True, eq=False)
class WallGraph:
    """Walls of many clusters of buildings as one graph; edges never join two clusters."""

    #: (n, 2): vertices in whole millimetres: differences and their products are exact up to 90 km
    xy: NDArray[np.float64]
    #: (n,): the cluster of each vertex; vertices are unique and sorted by (cluster, x, y)
    cluster: NDArray[np.int64]
    edges: NDArray[np.int64]  #: (m, 2): vertex indices, ascending in each row; rows are unique and sorted
    slack: NDArray[np.float64]  #: (m,): how far an edge may already be from the walls that it stands for (mm)

    def vectors(self) -> NDArray[np.float64]:
        """Give each edge's vector (mm)."""
        result: NDArray[np.float64] = self.xy[self.edges[:, 1]] - self.xy[self.edges[:, 0]]
        return result

    def lengths(self) -> NDArray[np.float64]:
        """Give each edge's length (mm)."""
        result: NDArray[np.float64] = np.hypot(*self.vectors().T)
        return result

    def edge_clusters(self) -> NDArray[np.int64]:
        """Give each edge's cluster."""
        result: NDArray[np.int64] = self.cluster[self.edges[:, 0]]
        return result

    def degrees(self) -> NDArray[np.int64]:
        """Count the edges at each vertex."""
        result: NDArray[np.int64] = np.bincount(self.edges.reshape(-1), minlength=len(self.xy))
        return result

    def keep(self, edges: NDArray[np.bool_]) -> "WallGraph":
        """Drop the other edges, then all that dangles."""
        return _prune(self.xy, self.cluster, self.edges[edges], self.slack[edges])


@dataclass(frozen=True, eq=False)
class Faces:
    """The bounded faces of a `WallGraph`."""

    polygons: NDArray[np.object_]  #: (f,): shell counter-clockwise, holes clockwise (mm)
    cluster: NDArray[np.int64]  #: (f,): ascending
    #: (m, 2): face on the left and on the right of each edge, seen from its first vertex; -1 outside
    sides: NDArray[np.int64]


def make_graph(
    xy: NDArray[np.float64], cluster: NDArray[np.int64], edges: NDArray[np.int64], slack: NDArray[np.float64]
) -> WallGraph:
    """Make a graph: unite equal vertices and equal edges, drop loops, dangling edges and lone vertices.

    Parameters
    ----------
    xy, cluster, edges, slack
        As in `WallGraph`, in any order and with repetitions; of equal edges the least slack counts.
    """
    rows, index = _unite(np.column_stack((cluster, xy)))
    ends = np.sort(index[edges], axis=1)
    proper = ends[:, 0] != ends[:, 1]
    ends, slack = ends[proper], slack[proper]
    order = np.lexsort((slack, ends[:, 1], ends[:, 0]))
    ends, slack = ends[order], slack[order]
    first = np.ones(len(ends), np.bool_)
    first[1:] = (ends[1:] != ends[:-1]).any(axis=1)
    ends, slack = ends[first], slack[first]
    return _prune(rows[:, 1:], rows[:, 0].astype(np.int64), ends, slack)


def _prune(
    xy: NDArray[np.float64], cluster: NDArray[np.int64], edges: NDArray[np.int64], slack: NDArray[np.float64]
) -> WallGraph:
    """Drop dangling edges and lone vertices; all else is in order already."""
    while len(edges):
        holds = (np.bincount(edges.reshape(-1), minlength=len(xy))[edges] > 1).all(axis=1)
        if holds.all():
            break
        edges, slack = edges[holds], slack[holds]
    used = np.zeros(len(xy), np.bool_)
    used[edges] = True
    number = np.cumsum(used) - 1
    return WallGraph(xy[used], cluster[used], number[edges], slack)


def join_graphs(graphs: list[WallGraph]) -> WallGraph:
    """Put graphs of different clusters together."""
    offsets = np.cumsum([0, *(len(graph.xy) for graph in graphs)])
    return make_graph(
        np.concatenate([graph.xy for graph in graphs]),
        np.concatenate([graph.cluster for graph in graphs]),
        np.concatenate([graph.edges + start for graph, start in zip(graphs, offsets, strict=False)]),
        np.concatenate([graph.slack for graph in graphs]),
    )


def node_walls(polygons: NDArray[np.object_], cluster: NDArray[np.int64]) -> WallGraph:
    """Node the walls of all polygons, cluster by cluster, on the millimetre grid.

    Parameters
    ----------
    polygons : object, (n,)
        Valid shapely Polygons (mm).
    cluster : int64, (n,)
        The cluster of each; walls of different clusters do not meet.
    """
    names, owner, count = np.unique(cluster, return_inverse=True, return_counts=True)
    rounded, clear = round_corners(polygons, 1.0)
    clear &= count[owner] == 1  # walls of several houses may cross
    rings, ring_owner = shapely.get_rings(rounded[clear], return_index=True)
    ring_owner = owner[clear][ring_owner]
    others = np.flatnonzero(~clear)
    others = others[np.argsort(owner[others], kind="stable")]
    walls, index = shapely.get_rings(polygons[others], return_index=True)
    several, number = np.unique(owner[others][index], return_inverse=True)
    noded = shapely.union_all(shapely.multilinestrings(walls, indices=number)[:, None], grid_size=1.0, axis=1)
    lines, line_owner = shapely.get_parts(noded, return_index=True)
    xy, line = shapely.get_coordinates(np.concatenate((rings, lines)), return_index=True)
    start = np.flatnonzero(line[1:] == line[:-1])
    edges = np.column_stack((start, start + 1))
    name = names[np.concatenate((ring_owner, several[line_owner]))]
    return make_graph(np.rint(xy), name[line], edges, np.zeros(len(edges)))


def thread_edges(
    graph: WallGraph, edge: NDArray[np.int64], vertex: NDArray[np.int64], moved: NDArray[np.float64]
) -> WallGraph:
    """Lead edges through further vertices, in the order of their feet on the edge.

    Parameters
    ----------
    edge, vertex : int64, (k,)
        An edge, and a vertex that it shall lead through.
    moved : float64, (k,)
        How far that takes the edge (mm), added to its slack.
    """
    if not len(edge):
        return graph
    origin = graph.xy[graph.edges[edge, 0]]
    along = ((graph.xy[vertex] - origin) * graph.vectors()[edge]).sum(axis=1)
    order = np.lexsort((vertex, along, edge))
    edge, vertex, moved = edge[order], vertex[order], moved[order]
    hit, first = np.unique(edge, return_index=True)
    last = np.append(first[1:], len(edge)) - 1
    head = np.where(np.isin(np.arange(len(edge)), first), graph.edges[edge, 0], np.roll(vertex, 1))
    tail = np.column_stack((vertex[last], graph.edges[hit, 1]))
    slack = graph.slack[hit] + np.maximum.reduceat(moved, first)
    stays = np.ones(len(graph.edges), np.bool_)
    stays[hit] = False
    edges = np.concatenate((graph.edges[stays], np.column_stack((head, vertex)), tail))
    slacks = (graph.slack[stays], np.repeat(slack, last - first + 1), slack)
    return make_graph(graph.xy, graph.cluster, edges, np.concatenate(slacks))


def find_close(graph: WallGraph, distance: float) -> tuple[Pairs, NDArray[np.float64]]:
    """Find the vertices closer than a distance to an edge of their cluster that does not end in them.

    Parameters
    ----------
    distance : float
        Bound (mm).

    Returns
    -------
    vertex, edge : pair of int64, (k,)
        Sorted.
    distances : float64, (k,)
        Their distances (mm).
    """
    if not len(graph.edges):
        return (np.zeros(0, np.int64), np.zeros(0, np.int64)), np.zeros(0)
    tree = shapely.STRtree(shapely.linestrings(graph.xy[graph.edges]))
    vertex, edge = tree.query(_boxes_around(graph.xy, distance))
    foreign = (graph.edges[edge] != vertex[:, None]).all(axis=1)
    foreign &= graph.cluster[vertex] == graph.edge_clusters()[edge]
    vertex, edge = vertex[foreign], edge[foreign]
    vector = graph.vectors()[edge]
    offset = graph.xy[vertex] - graph.xy[graph.edges[edge, 0]]
    share = np.clip((offset * vector).sum(axis=1) / (vector**2).sum(axis=1), 0.0, 1.0)
    far = np.hypot(*(offset - share[:, None] * vector).T)
    close = np.flatnonzero(far < distance)
    close = close[np.lexsort((edge[close], vertex[close]))]
    return (vertex[close], edge[close]), far[close]


def find_near(graph: WallGraph, distance: float) -> tuple[Pairs, NDArray[np.float64]]:
    """Find the pairs of vertices of one cluster closer than a distance.

    Parameters
    ----------
    distance : float
        Bound (mm).

    Returns
    -------
    i, j : pair of int64, (k,)
        Each pair once, ``i < j``, in no settled order.
    distances : float64, (k,)
        Their distances (mm).
    """
    i, j = shapely.STRtree(shapely.points(graph.xy)).query(_boxes_around(graph.xy, distance))
    later = (i < j) & (graph.cluster[i] == graph.cluster[j])
    i, j = i[later], j[later]
    far = np.hypot(*(graph.xy[i] - graph.xy[j]).T)
    near = far < distance
    return (i[near], j[near]), far[near]


def _boxes_around(xy: NDArray[np.float64], distance: float) -> NDArray[np.object_]:
    """Boxes that hold all that is within a distance of each point."""
    x, y = xy.T
    boxes: NDArray[np.object_] = shapely.box(x - distance, y - distance, x + distance, y + distance)
    return boxes


def find_crossings(graph: WallGraph) -> Pairs:
    """Find the pairs of edges of one cluster that cross in a point inside both."""
    if not len(graph.edges):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    lines = shapely.linestrings(graph.xy[graph.edges])
    i, j = shapely.STRtree(lines).query(lines)
    later = (i < j) & (graph.edge_clusters()[i] == graph.edge_clusters()[j])
    i, j = i[later], j[later]
    across = (_turn(graph, i, j, 0) * _turn(graph, i, j, 1) < 0) & (
        _turn(graph, j, i, 0) * _turn(graph, j, i, 1) < 0
    )
    order = np.lexsort((j[across], i[across]))
    return i[across][order], j[across][order]


def trace_faces(graph: WallGraph) -> Faces:
    """Find the faces of a graph without crossings; edges with one face on both sides bound none."""
    if not len(graph.edges):
        return Faces(np.zeros(0, object), np.zeros(0, np.int64), np.zeros((0, 2), np.int64))
    names, owner = np.unique(graph.edge_clusters(), return_inverse=True)
    walls = shapely.multilinestrings(shapely.linestrings(graph.xy[graph.edges]), indices=owner)
    polygons, index = shapely.get_parts(shapely.polygonize(walls[:, None]), return_index=True)
    polygons = shapely.orient_polygons(polygons)
    rings, face = shapely.get_rings(polygons, return_index=True)
    xy, ring = shapely.get_coordinates(rings, return_index=True)
    rows = np.column_stack((names[index][face[ring]], xy))
    _, number = _unite(np.concatenate((np.column_stack((graph.cluster, graph.xy)), rows)))
    number = number[len(graph.xy) :]
    start = np.flatnonzero(ring[1:] == ring[:-1])
    tail, head, of_face = number[start], number[start + 1], face[ring[start]]
    code = graph.edges[:, 0] * len(graph.xy) + graph.edges[:, 1]
    at = np.searchsorted(code, np.minimum(tail, head) * len(graph.xy) + np.maximum(tail, head))
    sides = np.full((len(graph.edges), 2), -1)
    sides[at, (tail > head).astype(np.int64)] = of_face
    return Faces(polygons, names[index], sides)


def _turn(graph: WallGraph, edge: NDArray[np.int64], other: NDArray[np.int64], end: int) -> NDArray[np.float64]:
    """Tell on which side of an edge an end of another one lies: 1 left, -1 right, 0 on it. Exact."""
    vector = graph.vectors()[edge]
    offset = graph.xy[graph.edges[other, end]] - graph.xy[graph.edges[edge, 0]]
    side: NDArray[np.float64] = np.sign(vector[:, 0] * offset[:, 1] - vector[:, 1] * offset[:, 0])
    return side


def _unite(rows: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Sort rows and drop repetitions; give each row's place in the result."""
    order = np.lexsort(rows.T[::-1])
    ordered = rows[order]
    first = np.ones(len(rows), np.bool_)
    first[1:] = (ordered[1:] != ordered[:-1]).any(axis=1)
    index = np.empty(len(rows), np.int64)
    index[order] = np.cumsum(first) - 1
    return ordered[first], index
