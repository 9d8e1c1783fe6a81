"""Land cover in the plane: the patch of each place, and the edges between patches (before step 3.1, ours)."""

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.geometry.inside import find_inside
from pipeline.plane_mesh.plane import ring_edges
from stitch.tiling.grid import Bounds
from stitch.tiling.walls import cut_edges, find_on_walls

STEPS = 2  # to a clearance, in which edges are looked at
SHARPEST = 0.8660254037844386  # cosine of 30 degrees; edges that meet at less are too close
BESIDE = 0.25  # clearances from an edge, where its two sides are looked up
ON_EDGE = 1e-6  # m; closer than that, a vertex is on an edge, but for rounding


@dataclass(frozen=True, eq=False)
class LandCover:
    """Polygons of land cover."""

    polygons: NDArray[np.object_]  #: (p,): valid polygons, which may overlap
    #: (p,): patch of each, from 1: of several at a place the lowest counts; 0 is that of no polygon
    row: NDArray[np.int64]
    core: Bounds | None = None  #: the region without its pad (m), None without one
    pad: int = 0  #: patch of all that is outside of it


def find_patches(cover: LandCover, xy: NDArray[np.float64]) -> NDArray[np.int8]:
    """Find the patch of the ground at places, int8 (k,).

    Parameters
    ----------
    cover : LandCover
        All polygons that meet the places.
    xy : float64, (k, 2)
        Places (m).

    Examples
    --------
    >>> boxes = np.array([shapely.box(0, 0, 4, 4), shapely.box(2, 0, 8, 4)])
    >>> find_patches(LandCover(boxes, np.array([2, 1])), np.array([[1.0, 1], [3, 1], [7, 1], [9, 9]])).tolist()
    [2, 1, 1, 0]
    """
    far = np.iinfo(np.int64).max
    best = np.full(len(xy), far)
    polygon, point = find_inside(xy, cover.polygons)
    np.minimum.at(best, point, cover.row[polygon])
    best[best == far] = 0
    if cover.core is not None:
        best[((xy < cover.core[:2]) | (xy > cover.core[2:])).any(axis=1)] = cover.pad
    return best.astype(np.int8)


def cover_edges(
    cover: LandCover, walls: NDArray[np.float64], within: shapely.Geometry, *, mesh_size: float, clearance: float
) -> NDArray[np.float64]:
    """Find the edges between patches that are to be edges of the mesh.

    Parameters
    ----------
    cover : LandCover
        Polygons.
    walls : float64, (w, 2, 2)
        Walls of buildings in pieces (m).
    within : Polygon or MultiPolygon
        The region; edges keep the clearance from its sides.
    mesh_size : float
        Target edge length (m).
    clearance : float
        Least distance of an edge to walls and other edges (m).

    Returns
    -------
    float64, (e, 2, 2)
        Straight pieces (m), the smaller end first; they meet in their ends only.

    Notes
    -----
    Outlines are cut into pieces (`cut_edges`), sorted by patch and place, and each is looked at every half
    clearance. What is closer than the clearance to a wall, or to a piece that comes before it, gives way, whether
    that piece stays or not; pieces that share an end may meet there at 30 degrees or more. So what stays of a
    piece follows from what is within a clearance of it alone: all who see these find the same, bit for bit. What
    has the same patch on both sides is no edge, and parts shorter than the clearance are none either.
    """
    rings = [cover.polygons[cover.row == row] for row in np.unique(cover.row)]
    rings += [] if cover.core is None else [np.array([shapely.box(*cover.core)])]
    cut = [cut_edges(ring_edges(shapely.get_rings(ring)), mesh_size=mesh_size) for ring in rings]
    flat = np.concatenate([np.empty((0, 2, 2)), *cut]).reshape(-1, 4)
    _, first = np.unique(flat, axis=0, return_index=True)
    pieces = flat[np.sort(first)].reshape(-1, 2, 2)
    across = pieces[:, 1] - pieces[:, 0]
    length = np.sqrt(across[:, 0] ** 2 + across[:, 1] ** 2)
    n = np.maximum(np.ceil(STEPS * length / clearance), 1).astype(np.int64)
    start = np.concatenate(([0], np.cumsum(n + 1)))  # of the places on each piece
    of = np.repeat(np.arange(len(pieces)), n + 1)
    step = np.arange(len(of)) - start[of]
    places = pieces[of, 0] + across[of] * (step / n[of])[:, None]
    places[start[1:] - 1] = pieces[:, 1]
    free = _are_free(places, of, pieces, walls, within, clearance)
    low = np.flatnonzero(step < n[of])  # each but the last begins a part
    part = of[low]
    middle = (places[low] + places[low + 1]) / 2
    side = BESIDE * clearance * np.column_stack((-across[part, 1], across[part, 0])) / length[part, None]
    kept = free[low] & free[low + 1]
    kept[kept] = find_patches(cover, middle[kept] + side[kept]) != find_patches(cover, middle[kept] - side[kept])
    chosen = low[kept]
    # Parts that follow each other on a piece are one.
    breaks = np.flatnonzero(np.diff(chosen, prepend=-9) != 1)
    begin, end = chosen[breaks], np.append(chosen[breaks[1:] - 1], chosen[-1:]) + 1
    found = np.stack((places[begin], places[end]), axis=1)
    long = ((found[:, 1] - found[:, 0]) ** 2).sum(axis=1) >= clearance**2
    edges: NDArray[np.float64] = found[long]
    return edges


def find_kept(
    xy: NDArray[np.float64], edges: NDArray[np.float64], triangles: NDArray[np.int32]
) -> NDArray[np.int32]:
    """Find the edges of a mesh that lie on given ones.

    Parameters
    ----------
    xy : float64, (n, 2)
        Its vertices (m).
    edges : float64, (e, 2, 2)
        Edges that it was made with (m).
    triangles : int32, (m, 3)
        Its triangles.

    Returns
    -------
    int32, (k, 2)
        Pairs of vertices.
    """
    if not len(edges):
        return np.empty((0, 2), np.int32)
    used = np.unique(triangles)
    on, edge = find_on_walls(edges, xy[used], reach=ON_EDGE, ends=True)
    along = ((xy[used[on]] - edges[edge, 0]) * (edges[edge, 1] - edges[edge, 0])).sum(axis=1)
    order = np.lexsort((along, edge))
    vertex, edge = used[on[order]], edge[order]
    same = edge[1:] == edge[:-1]
    return np.stack((vertex[:-1][same], vertex[1:][same]), axis=1).astype(np.int32)


def _are_free(
    places: NDArray[np.float64],
    of: NDArray[np.int64],
    pieces: NDArray[np.float64],
    walls: NDArray[np.float64],
    within: shapely.Geometry,
    clearance: float,
) -> NDArray[np.bool_]:
    """Whether places on pieces keep the clearance from walls, sides of the region, and pieces that come first."""
    points = shapely.points(places)
    free: NDArray[np.bool_] = shapely.contains_xy(within, places[:, 0], places[:, 1])
    sides = shapely.linestrings(ring_edges(shapely.get_rings(shapely.get_parts(within))))
    for lines in (sides, shapely.linestrings(walls)):
        free[shapely.STRtree(lines).query(points, predicate="dwithin", distance=clearance)[0]] = False
    row, other = shapely.STRtree(shapely.linestrings(pieces)).query(
        points, predicate="dwithin", distance=clearance
    )
    earlier = other < of[row]
    row, other = row[earlier], other[earlier]
    free[row[~_meet_wide(pieces[of[row]], pieces[other])]] = False
    return free


def _meet_wide(one: NDArray[np.float64], two: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether pieces (k, 2, 2) share an end, and meet there at 30 degrees or more."""
    wide = np.zeros(len(one), np.bool_)
    for a in (0, 1):
        for b in (0, 1):
            u, v = one[:, 1 - a] - one[:, a], two[:, 1 - b] - two[:, b]
            dot = u[:, 0] * v[:, 0] + u[:, 1] * v[:, 1]
            size = np.sqrt((u[:, 0] ** 2 + u[:, 1] ** 2) * (v[:, 0] ** 2 + v[:, 1] ** 2))
            wide |= (one[:, a] == two[:, b]).all(axis=1) & (dot <= SHARPEST * size)
    return wide
