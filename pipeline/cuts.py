"""New walls inside a house, placed along a line and clear of the others (for `house_levels`)."""

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.inside import Edges, are_inside, list_edges
from pipeline.lines import Line, rank_lines
from pipeline.segments import ON_EDGE, are_clear, divide_edges, find_nodes, insert_corners

AREA_TOLERANCE = 1e-5  # m²; what the pieces of a polygon may lack by rounding

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class _Outline:
    """A polygon and its edges, none of no length."""

    polygon: shapely.Polygon
    edges: Edges

    @property
    def a(self) -> Array:
        return self.edges.a

    @property
    def b(self) -> Array:
        return self.edges.b


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
    xy = shapely.get_coordinates(polygon)
    ring = np.zeros(len(xy), np.int64)
    if polygon.interiors:
        ring = shapely.get_coordinates(shapely.get_rings(polygon), return_index=True)[1]
    new_xy, ring = insert_corners(xy, ring, corners)
    if len(new_xy) == len(xy):
        return polygon
    shell, *holes = shapely.linearrings(new_xy, indices=ring)
    return shapely.polygons(shell, holes=holes or None)


def _cut(outline: _Outline, line: Line, clearance: float) -> tuple[NDArray[np.object_], Array]:
    walls = _place_walls(outline, line, clearance)
    pieces = _divide(outline, walls) if len(walls.ends) else np.empty(0, dtype=object)
    # A wall bent across an edge, never seen, would show here: its pieces do not close.
    if len(pieces) > 1 and abs(shapely.area(pieces).sum() - outline.polygon.area) <= AREA_TOLERANCE:
        return pieces, walls.ends.reshape(-1, 2)
    return np.array([outline.polygon], dtype=object), np.empty((0, 2))


def _open_outline(polygon: shapely.Polygon) -> _Outline:
    edges = list_edges(np.array([polygon]))
    long = (edges.a != edges.b).any(axis=1)
    return _Outline(polygon, Edges(np.array([0, long.sum()]), edges.a[long], edges.b[long]))


def _place_walls(outline: _Outline, line: Line, clearance: float) -> _Walls:
    """Walls along the line inside the outline, bent through the vertices within `clearance` of it."""
    side_a, side_b = outline.a @ line.normal - line.offset, outline.b @ line.normal - line.offset
    nodes, edge = find_nodes(outline.a, outline.b, side_a, side_b, clearance)
    order = np.argsort(nodes @ line.along, kind="stable")
    nodes, edge = nodes[order], edge[order]
    clear = np.flatnonzero(are_clear(nodes[:-1], nodes[1:], outline.a, outline.b, clearance))
    middle = (nodes[clear] + nodes[clear + 1]) / 2
    clear = clear[_inside(outline, middle)]
    walls = np.column_stack((clear, clear + 1))
    return _Walls(nodes[walls], edge[walls])


def _inside(outline: _Outline, xy: Array) -> NDArray[np.bool_]:
    return are_inside(np.array([outline.polygon]), np.zeros(len(xy), np.int64), xy, edges=outline.edges)


def _divide(outline: _Outline, walls: _Walls) -> NDArray[np.object_]:
    """Pieces of the polygon between its outline and the walls."""
    segments = divide_edges(outline.a, outline.b, walls.ends, walls.edges)
    pieces = shapely.get_parts(shapely.polygonize(shapely.linestrings(segments)))
    if not outline.polygon.interiors:
        return np.asarray(pieces)
    middle = shapely.get_coordinates(shapely.point_on_surface(pieces))
    return np.asarray(pieces[_inside(outline, middle)])
