"""Walls in pieces that every tile and every strip cuts alike (before step 3.1)."""

from collections.abc import Sequence

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.plane_mesh.plane import ring_edges
from pipeline.plane_mesh.sizes import Finer, finer_sizes

LONGEST_PIECE = 1.5  # mesh sizes


def cut_walls(
    polygons: NDArray[np.object_], *, mesh_size: float, finer: Sequence[Finer] = ()
) -> NDArray[np.float64]:
    """Cut the walls of buildings into pieces.

    Parameters
    ----------
    polygons : object, (b,)
        Footprints that share walls vertex by vertex.
    mesh_size : float
        Target edge length at walls (m).
    finer : sequence of Finer
        Areas in which it is less.

    Returns
    -------
    float64, (w, 2, 2)
        Start and end of each piece (m), the start first by (x, y), no piece twice, sorted.

    Notes
    -----
    A wall is cut into as few equal pieces as `LONGEST_PIECE` allows, and these in half where the size in their
    middle is less. The cuts depend on the wall's two ends and the areas alone: whoever sees the wall, in whatever
    direction, has the same vertices on it, bit for bit. So a strip can take whole pieces where it ends, and none
    has to be clipped.

    Examples
    --------
    >>> len(cut_walls(np.array([shapely.box(0, 0, 4, 20)]), mesh_size=10.0))
    6
    """
    return _halve(cut_edges(ring_edges(shapely.get_rings(polygons)), mesh_size=mesh_size), finer, mesh_size)


def cut_edges(edges: NDArray[np.float64], *, mesh_size: float) -> NDArray[np.float64]:
    """Cut edges (s, 2, 2) in any direction into pieces as `cut_walls` does, where no size is finer."""
    edges = edges.copy()
    backwards = (edges[:, 0, 0] > edges[:, 1, 0]) | (
        (edges[:, 0, 0] == edges[:, 1, 0]) & (edges[:, 0, 1] > edges[:, 1, 1])
    )
    edges[backwards] = edges[backwards][:, ::-1]
    edges = np.unique(edges.reshape(-1, 4), axis=0).reshape(-1, 2, 2)
    across = edges[:, 1] - edges[:, 0]
    length = np.sqrt(across[:, 0] ** 2 + across[:, 1] ** 2)
    n = np.maximum(np.ceil(length / (LONGEST_PIECE * mesh_size)), 1).astype(np.int64)
    edge = np.repeat(np.arange(len(edges)), n)
    k = np.arange(len(edge)) - np.repeat(np.cumsum(n) - n, n)
    start, end = (edges[edge, 0] + across[edge] * (step / n[edge])[:, None] for step in (k, k + 1))
    start[k == 0] = edges[edge[k == 0], 0]
    end[k == n[edge] - 1] = edges[edge[k == n[edge] - 1], 1]
    return np.stack((start, end), axis=1)


def _halve(pieces: NDArray[np.float64], finer: Sequence[Finer], mesh_size: float) -> NDArray[np.float64]:
    """Halve pieces (w, 2, 2), in their order, until none is too long for the size in its middle."""
    while finer:
        middle = (pieces[:, 0] + pieces[:, 1]) / 2
        across = pieces[:, 1] - pieces[:, 0]
        length = np.sqrt(across[:, 0] ** 2 + across[:, 1] ** 2)
        long = length > LONGEST_PIECE * finer_sizes(finer, middle, mesh_size)
        if not long.any():
            break
        first = np.arange(len(pieces)) + np.cumsum(long) - long
        pieces = np.repeat(pieces, 1 + long, axis=0)
        pieces[first[long], 1] = pieces[first[long] + 1, 0] = middle[long]
    return pieces


def walls_within(walls: NDArray[np.float64], box: shapely.Polygon) -> NDArray[np.float64]:
    """Return the pieces that meet a box."""
    shapely.prepare(box)
    meets: NDArray[np.bool_] = shapely.intersects(box, shapely.linestrings(walls))
    return walls[meets]


def split_walls(walls: NDArray[np.float64], nodes: NDArray[np.float64], *, reach: float) -> NDArray[np.float64]:
    """Split pieces of walls at given vertices.

    Parameters
    ----------
    walls : float64, (w, 2, 2)
        Pieces.
    nodes : float64, (k, 2)
        Vertices (m); those that are on no piece do not matter.
    reach : float
        A vertex closer to a piece than this (m) is on it.

    Returns
    -------
    float64, (w2, 2, 2)
        The pieces; where a vertex is on one, the parts of it, which start and end in the vertex itself.
    """
    on, wall = find_on_walls(walls, nodes, reach=reach)
    if not len(on):
        return walls
    base = walls[wall, 0]
    across = walls[wall, 1] - base
    along = ((nodes[on] - base) * across).sum(axis=1)
    n = len(walls)
    # All vertices of all pieces in order: start, those on it, end.
    of_wall = np.concatenate((np.arange(n), wall, np.arange(n)))
    place = np.concatenate((np.full(n, -np.inf), along, np.full(n, np.inf)))
    xy = np.concatenate((walls[:, 0], nodes[on], walls[:, 1]))
    order = np.lexsort((place, of_wall))
    xy, of_wall = xy[order], of_wall[order]
    same = np.flatnonzero(of_wall[1:] == of_wall[:-1])
    parts: NDArray[np.float64] = np.stack((xy[same], xy[same + 1]), axis=1)
    return parts


def find_on_walls(
    walls: NDArray[np.float64], nodes: NDArray[np.float64], *, reach: float, ends: bool = False
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Find the vertices that are on a piece of wall, but for its `ends`: their rows, and those of the pieces."""
    nodes_on, wall = shapely.STRtree(shapely.linestrings(walls)).query(
        shapely.points(nodes), predicate="dwithin", distance=reach
    )
    if ends:
        return nodes_on, wall
    at_end = (nodes[nodes_on][:, None] == walls[wall]).all(axis=2).any(axis=1)
    return nodes_on[~at_end], wall[~at_end]
