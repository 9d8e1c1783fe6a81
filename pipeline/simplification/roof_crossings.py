"""Nodes where the roofs on both sides of a wall change order along it (step 2.3, ours).

Between two sloped roofs one may be the higher at one end of their wall and the lower at the other. Without a node
where they meet, each would have a wall in the air of the other.
"""

from itertools import pairwise

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.data.roofs import Roofs, is_flat, plane_heights, roof_heights
from pipeline.geometry.inside import list_edges

GRID = 1e-3  # m; nodes lie on it, as all vertices of a planar city model
LEAST_STEP = 0.5  # m; roofs closer than that at an end of a wall are joined there by the mesher, and need no node
NEAR_WALL = 0.7  # of the clearance: a node keeps that from walls that do not end in its own


def add_crossings(
    polygons: NDArray[np.object_], roofs: Roofs, *, clearance: NDArray[np.float64]
) -> tuple[NDArray[np.object_], int, int]:
    """Set a node on each wall between two roofs where these change order.

    Parameters
    ----------
    polygons : object, (n,)
        Faces of one planar graph: where two of them share a wall, both have its vertices, to the bit.
    roofs : Roofs
        The roof of each.
    clearance : float64, (n,)
        A node is that far from the ends of its wall (m), and 0.7 of it from other walls: the least of both faces.

    Returns
    -------
    object, (n,)
        The polygons; those without a node are as they were.
    int
        Number of nodes.
    int
        Number of walls without room for one: the mesher joins the roofs at the end where they are closer.
    """
    ends, sides = party_walls(polygons)
    sloped = ~is_flat(roofs)
    some = sloped[sides].any(axis=1)
    ends, sides = ends[some], sides[some]
    if not len(ends):
        return polygons, 0, 0
    place, wall = _find_crossings(ends, sides, roofs)
    xy = ends[wall, 0] + place[:, None] * (ends[wall, 1] - ends[wall, 0])
    xy = np.rint(xy / GRID) * GRID
    length = np.hypot(*(ends[wall, 1] - ends[wall, 0]).T)
    apart = clearance[sides[wall]].min(axis=1)
    room = (place * length >= apart) & ((1 - place) * length >= apart)
    room &= ~_is_near_others(polygons, xy, ends[wall], NEAR_WALL * apart)
    follows = np.append(False, (wall[1:] == wall[:-1]) & (np.diff(place * length) < apart[1:]))
    room &= ~follows
    added = _insert(polygons, sides[wall[room]], ends[wall[room]], xy[room])
    return added, int(room.sum()), len(np.unique(wall[~room]))


def party_walls(polygons: NDArray[np.object_]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Walls between two polygons: ends (w, 2, 2), the smaller first, and both polygons (w, 2)."""
    edges = list_edges(polygons)
    a, b, of = edges.a, edges.b, np.repeat(np.arange(len(polygons)), np.diff(edges.start))
    swap = (b[:, 0] < a[:, 0]) | ((b[:, 0] == a[:, 0]) & (b[:, 1] < a[:, 1]))
    a[swap], b[swap] = b[swap], a[swap]
    order = np.lexsort((of, b[:, 1], b[:, 0], a[:, 1], a[:, 0]))
    rows = np.column_stack((a, b))[order]
    same = np.flatnonzero((rows[1:] == rows[:-1]).all(axis=1))
    sides = np.column_stack((of[order[same]], of[order[same + 1]])).astype(np.int64)
    two = sides[:, 0] != sides[:, 1]
    return rows[same][two].reshape(-1, 2, 2), sides[two]


def _find_crossings(
    ends: NDArray[np.float64], sides: NDArray[np.int64], roofs: Roofs
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Places (0 to 1) along walls where their roofs change order, wall by wall, ascending."""
    along = [np.zeros(len(ends)), np.ones(len(ends))]
    for k in (0, 1):  # where a roof reaches one of its limits its line bends
        height = plane_heights(roofs, np.repeat(sides[:, k], 2), ends.reshape(-1, 2)).reshape(-1, 2)
        rise = height[:, 1] - height[:, 0]
        for limit in roofs.limits[sides[:, k]].T:
            with np.errstate(divide="ignore", invalid="ignore"):
                t = (limit - height[:, 0]) / rise
            along.append(np.where((t > 0) & (t < 1), t, 0.0))
    t = np.sort(np.stack(along, axis=1), axis=1)
    xy = ends[:, :1] + t[:, :, None] * (ends[:, 1:] - ends[:, :1])
    one, two = (
        roof_heights(roofs, np.repeat(sides[:, k], t.shape[1]), xy.reshape(-1, 2)).reshape(t.shape) for k in (0, 1)
    )
    gap = one - two
    apart = np.abs(gap[:, [0, -1]]).min(axis=1) >= LEAST_STEP
    changes = (gap[:, :-1] * gap[:, 1:] < 0) & apart[:, None]
    wall, piece = np.nonzero(changes)
    before, after = gap[wall, piece], gap[wall, piece + 1]
    share = before / (before - after)
    return t[wall, piece] + share * (t[wall, piece + 1] - t[wall, piece]), wall


def _is_near_others(
    polygons: NDArray[np.object_],
    xy: NDArray[np.float64],
    ends: NDArray[np.float64],
    distance: NDArray[np.float64],
) -> NDArray[np.bool_]:
    """Whether places are close to a wall other than their own."""
    edges = list_edges(polygons)
    segments = np.stack((edges.a, edges.b), axis=1)
    tree = shapely.STRtree(shapely.linestrings(segments))
    at, near = tree.query(shapely.points(xy), predicate="dwithin", distance=distance)
    one, other = segments[near], ends[at]
    own = (one == other).all(axis=(1, 2)) | (one == other[:, ::-1]).all(axis=(1, 2))
    result = np.zeros(len(xy), np.bool_)
    result[at[~own]] = True
    return result


def _insert(
    polygons: NDArray[np.object_], sides: NDArray[np.int64], ends: NDArray[np.float64], xy: NDArray[np.float64]
) -> NDArray[np.object_]:
    """Insert nodes in the rings of both polygons beside their walls."""
    nodes: dict[tuple[int, tuple[float, ...]], list[tuple[float, float]]] = {}
    for (one, two), (a, b), place in zip(sides.tolist(), ends.tolist(), xy.tolist(), strict=True):
        for polygon in (one, two):
            nodes.setdefault((polygon, (*a, *b)), []).append((place[0], place[1]))
            nodes.setdefault((polygon, (*b, *a)), []).insert(0, (place[0], place[1]))
    result = polygons.copy()
    for polygon in np.unique(sides).tolist():
        rings = []
        for ring in (polygons[polygon].exterior, *polygons[polygon].interiors):
            line = shapely.get_coordinates(ring).tolist()
            longer = [line[0]]
            for a, b in pairwise(line):
                longer += [*nodes.get((polygon, (*a, *b)), []), b]
            rings.append(longer)
        result[polygon] = shapely.Polygon(rings[0], rings[1:])
    return result
