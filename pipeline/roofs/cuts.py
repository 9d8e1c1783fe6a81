"""New walls inside a house, placed along a line and clear of the others (for `house_levels`)."""

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.geometry.outlines import Outline
from pipeline.geometry.segments import divide_edges, place_walls
from pipeline.roofs.lines import Line, rank_lines

AREA_TOLERANCE = 1e-5  # m²; what the pieces of a polygon may lack by rounding

Array = NDArray[np.float64]

NO_PIECES = np.empty(0, dtype=object), np.empty((0, 2))


def cut_best(
    outline: Outline, xyz: Array, *, clearance: float, min_area: float, min_points: int
) -> tuple[NDArray[np.object_], Array]:
    """Cut a polygon where its points fall best into two heights.

    Parameters
    ----------
    outline : Outline
        A valid polygon, with or without holes.
    xyz : float64, (n, 3)
        Points inside (m).
    clearance : float
        A new wall ends at a vertex or keeps this distance (m) from it.
    min_area, min_points
        What is about the least on either side of the line (m², and points).

    Returns
    -------
    pieces : object, (k,)
        Polygons that cover the old one without overlap; none if no cut is found.
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
    least = max(min_points, int(len(xyz) * min_area / (2 * outline.area)))  # half of it: points may be sparse
    a, b = outline.ends
    for line in rank_lines(a, b, xyz, clearance=clearance, min_points=least):
        pieces, corners = cut_along(outline, line, clearance=clearance)
        if len(pieces):
            return pieces, corners
    return NO_PIECES


def cut_along(outline: Outline, line: Line, *, clearance: float) -> tuple[NDArray[np.object_], Array]:
    """Cut a polygon along a line, by the rules and with the results of `cut_best`."""
    a, b = outline.ends
    walls, edge = place_walls(a, b, line.along, line.offset, clearance)
    if not len(walls):
        return NO_PIECES
    pieces = shapely.get_parts(shapely.polygonize(shapely.linestrings(divide_edges(a, b, walls, edge))))
    if outline.n_rings > 1:
        pieces = pieces[shapely.contains(outline.polygon, shapely.point_on_surface(pieces))]
    # A wall bent across an edge, never seen, would show here: its pieces do not close.
    if len(pieces) > 1 and abs(shapely.area(pieces).sum() - outline.area) <= AREA_TOLERANCE:
        return pieces, walls.reshape(-1, 2)
    return NO_PIECES
