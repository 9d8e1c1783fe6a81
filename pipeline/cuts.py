"""New walls inside a house, placed along a line and clear of the others (for `house_levels`)."""

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.lines import Line, rank_lines

BLUNT = 0.866  # cosine of 30 degrees, the least angle between a new wall and another
AREA_TOLERANCE = 1e-5  # m²; what the pieces of a polygon may lack by rounding
ON_EDGE = 1e-6  # m; a corner of a neighbour this close to an edge lies on it

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class _Outline:
    """Edges of all rings of a polygon, from ``a`` to ``b``, float64 (m, 2)."""

    polygon: shapely.Polygon
    a: Array
    b: Array


@dataclass(frozen=True, eq=False)
class _Walls:
    """The walls that a line puts into an outline.

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
    least = max(min_points, int(len(xyz) * min_area / (2 * polygon.area)))  # half of it: points may be sparse
    for line in rank_lines(outline.a, outline.b, xyz, clearance=clearance, min_points=least):
        pieces, corners = _cut(outline, line, clearance)
        if len(pieces) > 1:
            return pieces, corners
    return np.array([polygon], dtype=object), np.empty((0, 2))


def cut_along(polygon: shapely.Polygon, line: Line, *, clearance: float) -> tuple[NDArray[np.object_], Array]:
    """Cut a polygon along a line, by the rules and with the results of `cut_best`."""
    return _cut(_open_outline(polygon), line, clearance)


def share_vertices(polygon: shapely.Polygon, corners: Array) -> shapely.Polygon:
    """Give a polygon those of `corners` that lie on its edges as vertices, to the bit."""
    low_x, low_y, high_x, high_y = polygon.bounds
    inside = (corners >= [low_x - ON_EDGE, low_y - ON_EDGE]) & (corners <= [high_x + ON_EDGE, high_y + ON_EDGE])
    corners = corners[inside.all(axis=1)]
    if not len(corners):
        return polygon
    old = [shapely.get_coordinates(ring) for ring in shapely.get_rings(polygon)]
    new = [_add_vertices(ring, corners) for ring in old]
    if all(len(ring) == len(before) for ring, before in zip(new, old, strict=True)):
        return polygon
    return shapely.Polygon(new[0], new[1:])


def distances_to_segments(xy: Array, a: Array, b: Array) -> Array:
    """Distances (m), float64 (k, n), of ``n`` places to the ``k`` segments from `a` to `b`."""
    d = b - a
    to = xy[None] - a[:, None]
    t = np.clip((to * d[:, None]).sum(axis=2) / (d * d).sum(axis=1)[:, None], 0, 1)
    off = to - t[..., None] * d[:, None]
    return np.asarray(np.hypot(off[..., 0], off[..., 1]))


def _cut(outline: _Outline, line: Line, clearance: float) -> tuple[NDArray[np.object_], Array]:
    walls = _place_walls(outline, line, clearance)
    pieces = _divide(outline, walls) if len(walls.ends) else np.empty(0, dtype=object)
    # A wall bent across an edge, never seen, would show here: its pieces do not close.
    if len(pieces) > 1 and abs(shapely.area(pieces).sum() - outline.polygon.area) <= AREA_TOLERANCE:
        return pieces, walls.ends.reshape(-1, 2)
    return np.array([outline.polygon], dtype=object), np.empty((0, 2))


def _open_outline(polygon: shapely.Polygon) -> _Outline:
    xy, ring = shapely.get_coordinates(shapely.get_rings(polygon), return_index=True)
    shapely.prepare(polygon)
    edge = (ring[1:] == ring[:-1]) & (xy[1:] != xy[:-1]).any(axis=1)
    return _Outline(polygon, xy[:-1][edge], xy[1:][edge])


def _place_walls(outline: _Outline, line: Line, clearance: float) -> _Walls:
    """Walls along the line inside the outline, bent through the vertices within `clearance` of it."""
    side_a, side_b = outline.a @ line.normal - line.offset, outline.b @ line.normal - line.offset
    crossed = np.flatnonzero(side_a * side_b < 0)
    share = side_a[crossed] / (side_a[crossed] - side_b[crossed])
    places = outline.a[crossed] + share[:, None] * (outline.b[crossed] - outline.a[crossed])
    free = (_distances(places, outline.a) >= clearance).all(axis=1)
    near = outline.a[np.abs(side_a) < clearance]
    nodes = np.concatenate((near, places[free]))
    edge = np.concatenate((np.full(len(near), -1), crossed[free]))
    order = np.argsort(nodes @ line.along, kind="stable")
    nodes, edge = nodes[order], edge[order]
    a, b = nodes[:-1], nodes[1:]
    length = np.hypot(*(b - a).T)
    long = (length >= clearance) & (length > 0)
    clear = np.zeros(len(long), np.bool_)
    clear[long] = _is_clear(outline, a[long], b[long], clearance)
    return _Walls(np.stack((a, b), axis=1)[clear], np.stack((edge[:-1], edge[1:]), axis=1)[clear])


def _is_clear(outline: _Outline, a: Array, b: Array, clearance: float) -> NDArray[np.bool_]:
    """Tell which walls run inside, clear of the edges and vertices that they do not end at, and end bluntly."""
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
