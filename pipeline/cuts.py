"""Straight cuts through a house, where its roof points fall best into two heights (for `levels`)."""

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

MAX_DIRECTIONS = 4  # directions of walls along which cuts are tried, those with most wall first
SAME_DIRECTION = 0.0872  # sine of 5 degrees; walls that differ by less count as one direction
MAX_TRIES = 4  # cuts that are tried on the outline, the best first
MIN_GAIN = 0.05  # least share of the squares around the mean height that a cut takes away
BLUNT = 0.866  # cosine of 30 degrees, the least angle between a new wall and another
ON_EDGE = 1e-6  # m; a corner of a neighbour this close to an edge lies on it

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Cut:
    """The line of the places whose product with ``normal`` is ``offset``.

    Attributes
    ----------
    along, normal : float64, (2,)
        Unit vectors along and across the line.
    offset : float
        Distance from the origin (m).
    """

    along: Array
    normal: Array
    offset: float


@dataclass(frozen=True, eq=False)
class _Outline:
    """Edges of all rings of a polygon, from ``a`` to ``b``, float64 (m, 2)."""

    polygon: shapely.Polygon
    a: Array
    b: Array


@dataclass(frozen=True, eq=False)
class _Walls:
    """The walls that a cut puts into an outline.

    Attributes
    ----------
    ends : float64, (k, 2, 2)
        From and to.
    edges : int64, (k, 2)
        Edge of the outline that each end divides, -1 where it is a vertex already.
    """

    ends: Array
    edges: NDArray[np.int64]


def cut_best(
    polygon: shapely.Polygon, xyz: Array, *, clearance: float, min_area: float, min_points: int
) -> tuple[NDArray[np.object_], Array]:
    """Cut a polygon where its points fall best into two heights.

    Parameters
    ----------
    polygon : shapely.Polygon
        Valid, with or without holes.
    xyz : float64, (n, 3)
        Points inside (m).
    clearance : float
        A new wall ends at a vertex or keeps this distance (m) from it.
    min_area, min_points
        What is about the least on either side of the line (m², and points).

    Returns
    -------
    pieces : object, (k,)
        Polygons that cover the old one without overlap; the old one alone if no cut is found.
    corners : float64, (c, 2)
        Ends of the new walls.

    Notes
    -----
    The lines are parallel to the walls of the polygon. For each direction the points are sorted across it,
    and running sums give the sum of squares around the two mean heights for every place of the line:
    O(n log n). A line through a courtyard or a concave outline may leave three pieces and more.

    A line that passes a vertex within `clearance` bends through it. A wall is given up where it would still
    come closer to another vertex than `clearance` (or half the distance between that vertex and the one where
    the wall ends, if they are close themselves), or where it meets another wall at less than 30 degrees.
    """
    outline = _open_outline(polygon)
    shapely.prepare(polygon)
    least = max(min_points, int(len(xyz) * min_area / (2 * polygon.area)))  # half of it: points may be sparse
    for cut in rank_cuts(outline.a, outline.b, xyz, clearance=clearance, min_points=least):
        walls = _place_walls(outline, cut, clearance)
        if len(walls.ends):
            pieces = _divide(outline, walls)
            if len(pieces) > 1:
                return pieces, walls.ends.reshape(-1, 2)
    return np.array([polygon], dtype=object), np.empty((0, 2))


def rank_cuts(a: Array, b: Array, xyz: Array, *, clearance: float, min_points: int) -> list[Cut]:
    """Rank the lines along the walls by the squares around the mean height that they take away.

    Parameters
    ----------
    a, b : float64, (m, 2)
        Ends of the walls (m).
    xyz : float64, (n, 3)
        Points (m).
    clearance : float
        A line passes through a vertex or by it at this distance (m).
    min_points : int
        Least number of points on either side.

    Returns
    -------
    list of Cut
        The best line through a vertex and the best between vertices for each direction, the best first;
        none that takes away less than `MIN_GAIN`.
    """
    z = xyz[:, 2] - xyz[:, 2].mean()
    n, total = len(z), float(z @ z)
    ranked: list[tuple[float, Cut]] = []
    for along in _directions(a, b) if total > 0 else ():
        normal = np.array([-along[1], along[0]])
        across = xyz[:, :2] @ normal
        order = np.argsort(across, kind="stable")
        across = across[order]
        left = np.arange(min_points, n - min_points + 1)  # points before the line
        gain = np.zeros(n + 1)
        gain[left] = np.cumsum(z[order])[left - 1] ** 2 * n / (left * (n - left)) / total
        vertex = np.unique(a @ normal)
        for offset, place in (
            (vertex, np.searchsorted(across, vertex)),
            _between(across, vertex, clearance),
        ):
            if len(offset):
                best = int(np.argmax(gain[place]))
                ranked.append((float(gain[place[best]]), Cut(along, normal, float(offset[best]))))
    ranked = [entry for entry in ranked if entry[0] >= MIN_GAIN]
    ranked.sort(key=lambda entry: -entry[0])
    return [cut for _, cut in ranked[:MAX_TRIES]]


def share_vertices(polygon: shapely.Polygon, corners: Array) -> shapely.Polygon:
    """Give a polygon those of `corners` that lie on its edges as vertices, to the bit."""
    if not len(corners):
        return polygon
    rings = [_add_vertices(shapely.get_coordinates(ring), corners) for ring in shapely.get_rings(polygon)]
    return shapely.Polygon(rings[0], rings[1:])


def distances_to_segments(xy: Array, a: Array, b: Array) -> Array:
    """Distances (m), float64 (k, n), of ``n`` places to the ``k`` segments from `a` to `b`."""
    d = b - a
    to = xy[None] - a[:, None]
    t = np.clip((to * d[:, None]).sum(axis=2) / (d * d).sum(axis=1)[:, None], 0, 1)
    off = to - t[..., None] * d[:, None]
    return np.asarray(np.hypot(off[..., 0], off[..., 1]))


def _open_outline(polygon: shapely.Polygon) -> _Outline:
    xy, ring = shapely.get_coordinates(shapely.get_rings(polygon), return_index=True)
    edge = (ring[1:] == ring[:-1]) & (xy[1:] != xy[:-1]).any(axis=1)
    return _Outline(polygon, xy[:-1][edge], xy[1:][edge])


def _directions(a: Array, b: Array) -> Array:
    """Unit vectors of the directions with most wall, each that of its longest wall."""
    d = b - a
    length = np.hypot(d[:, 0], d[:, 1])
    d = d / length[:, None]
    left = np.argsort(-length, kind="stable")
    found, total = [], []
    while len(left):
        along = d[left[0]]
        same = np.abs(d[left, 0] * along[1] - d[left, 1] * along[0]) <= SAME_DIRECTION
        found.append(along)
        total.append(length[left[same]].sum())
        left = left[~same]
    order = np.argsort(-np.array(total), kind="stable")[:MAX_DIRECTIONS]
    return np.array(found)[order]


def _between(across: Array, vertex: Array, clearance: float) -> tuple[Array, NDArray[np.int64]]:
    """Offsets midway between two points and clear of all vertices, and the number of points before them."""
    middle = (across[1:] + across[:-1]) / 2
    after = np.searchsorted(vertex, middle)
    low = vertex[np.maximum(after - 1, 0)]
    high = vertex[np.minimum(after, len(vertex) - 1)]
    clear = np.minimum(np.abs(middle - low), np.abs(high - middle)) >= clearance
    clear &= across[1:] > across[:-1]
    return middle[clear], np.flatnonzero(clear) + 1


def _place_walls(outline: _Outline, cut: Cut, clearance: float) -> _Walls:
    """Walls along the line inside the outline, bent through the vertices within `clearance` of it."""
    side_a, side_b = outline.a @ cut.normal - cut.offset, outline.b @ cut.normal - cut.offset
    crossed = np.flatnonzero(side_a * side_b < 0)
    share = side_a[crossed] / (side_a[crossed] - side_b[crossed])
    places = outline.a[crossed] + share[:, None] * (outline.b[crossed] - outline.a[crossed])
    free = (_distances(places, outline.a) >= clearance).all(axis=1)
    near = outline.a[np.abs(side_a) < clearance]
    nodes = np.concatenate((near, places[free]))
    edge = np.concatenate((np.full(len(near), -1), crossed[free]))
    order = np.argsort(nodes @ cut.along, kind="stable")
    nodes, edge = nodes[order], edge[order]
    a, b = nodes[:-1], nodes[1:]
    length = np.hypot(*(b - a).T)
    long = (length >= clearance) & (length > 0)
    clear = np.zeros(len(long), np.bool_)
    clear[long] = _is_clear(outline, a[long], b[long], clearance)
    return _Walls(np.stack((a, b), axis=1)[clear], np.stack((edge[:-1], edge[1:]), axis=1)[clear])


def _is_clear(outline: _Outline, a: Array, b: Array, clearance: float) -> NDArray[np.bool_]:
    """Tell which walls run inside the outline, clear of the edges and vertices that they do not end at."""
    middle = (a + b) / 2
    inside = shapely.contains_xy(outline.polygon, middle[:, 0], middle[:, 1])
    room = shapely.distance(shapely.points(middle), outline.polygon.boundary)
    wide = room >= np.minimum(clearance, np.hypot(*(b - a).T) / 4)
    from_end = np.minimum(_distances(a, outline.a), _distances(b, outline.a))
    needed = np.minimum(clearance, from_end / 2) - ON_EDGE
    far = (distances_to_segments(outline.a, a, b) >= needed).all(axis=1)
    return np.asarray(inside & wide & far & _is_blunt(outline, a, b) & _is_blunt(outline, b, a))


def _is_blunt(outline: _Outline, start: Array, end: Array) -> NDArray[np.bool_]:
    """Tell which walls leave the outline at `start` at no sharp angle."""
    along = (end - start) / np.hypot(*(end - start).T)[:, None]
    meets = distances_to_segments(start, outline.a, outline.b).T <= ON_EDGE
    sharp = np.zeros(len(start), np.bool_)
    for other in (outline.a, outline.b):
        way = other[None] - start[:, None]
        length = np.hypot(way[..., 0], way[..., 1])
        ahead = (way * along[:, None]).sum(axis=2) > BLUNT * length
        sharp |= (meets & ahead & (length > ON_EDGE)).any(axis=1)
    return ~sharp


def _divide(outline: _Outline, walls: _Walls) -> NDArray[np.object_]:
    """Pieces of the polygon between its outline and the walls."""
    place, edge = walls.ends.reshape(-1, 2), walls.edges.reshape(-1)
    edge, first = np.unique(edge, return_index=True)
    place, edge = place[first][edge >= 0], edge[edge >= 0]  # an edge meets a line once
    whole = np.ones(len(outline.a), np.bool_)
    whole[edge] = False
    segments = np.concatenate(
        (
            np.stack((outline.a[whole], outline.b[whole]), axis=1),
            np.stack((outline.a[edge], place), axis=1),
            np.stack((place, outline.b[edge]), axis=1),
            walls.ends,
        )
    )
    pieces = shapely.get_parts(shapely.polygonize(shapely.linestrings(segments)))
    middle = shapely.get_coordinates(shapely.point_on_surface(pieces))
    return np.asarray(pieces[shapely.contains_xy(outline.polygon, middle[:, 0], middle[:, 1])])


def _distances(p: Array, q: Array) -> Array:
    d = p[:, None] - q[None]
    return np.asarray(np.hypot(d[..., 0], d[..., 1]))


def _add_vertices(ring: Array, corners: Array) -> Array:
    a, b = ring[:-1], ring[1:]
    between = distances_to_segments(corners, a, b) <= ON_EDGE
    between &= (_distances(a, corners) > ON_EDGE) & (_distances(b, corners) > ON_EDGE)
    edge, corner = np.nonzero(between)
    if not len(edge):
        return ring
    from_start = np.hypot(*(corners[corner] - a[edge]).T)
    order = np.lexsort((from_start, edge))
    return np.insert(ring, edge[order] + 1, corners[corner[order]], axis=0)
