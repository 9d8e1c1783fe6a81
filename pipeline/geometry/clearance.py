"""Soundness of a polygon for the 2D mesher, and the ladder of repairs that ends in it (step 2.1)."""

from collections.abc import Iterator

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.geometry.rings import compute_sharpest_corners, drop_needless_vertices, make_canonical

# Two edges that meet at less than this (degrees) make Triangle refine far into the corner.
SHARPEST_CORNER = 5.0
# Radii of the second rung as multiples of the floor, gentlest first.
BUFFER_RADII = (0.5, 1.0, 2.0)
# Corners below 2 arcsin(1 / limit) = 23 degrees are cut off when a buffer grows back.
MITRE_LIMIT = 5.0


def has_clearance(polygons: NDArray[np.object_], least: float) -> NDArray[np.bool_]:
    """Tell which polygons have no two features closer than a bound.

    Parameters
    ----------
    polygons : object, (n,)
        shapely Polygons, none empty.
    least : float
        Bound (m), positive.

    Returns
    -------
    bool, (n,)
        True for a valid polygon in which no vertex is closer than the bound to another vertex or to an edge
        that does not end in it, and no ring touches another ring.

    Notes
    -----
    GEOS passes over vertices that coincide, so a hole that touches the shell in one of its vertices does not
    count in its minimum clearance. Such a polygon is valid, but its walls meet in an edge of four faces, and
    Triangle does not survive the repeated vertex.

    References
    ----------
    The paper's section 4.3, conditions (i) and (ii) of an acceptable shape.

    Examples
    --------
    >>> square = [(0, 0), (9, 0), (9, 9), (0, 9)]
    >>> courts = [(3, 3), (3, 6), (6, 6), (6, 3)], [(0, 0), (2, 5), (5, 2)]
    >>> has_clearance(np.array([shapely.Polygon(square, [court]) for court in courts]), 1.0)
    array([ True, False])
    """
    apart = shapely.is_valid(polygons) & (shapely.minimum_clearance(polygons) >= least)
    holed = np.flatnonzero(shapely.get_num_interior_rings(polygons) > 0)
    if len(holed):
        apart[holed] &= shapely.is_simple(shapely.boundary(polygons[holed]))
    result: NDArray[np.bool_] = apart
    return result


def is_sound(polygons: NDArray[np.object_], floor: float) -> NDArray[np.bool_]:
    """Tell which polygons the 2D mesher can take.

    Parameters
    ----------
    polygons : object, (n,)
        shapely Polygons, none empty.
    floor : float
        Least minimum clearance (m).

    Returns
    -------
    bool, (n,)
        True for a polygon that has the clearance (`has_clearance`) and no corner, inside or outside, sharper
        than `SHARPEST_CORNER`.

    Examples
    --------
    >>> is_sound(np.array([shapely.box(0, 0, 5, 5), shapely.box(0, 0, 5, 0.09)]), 0.1)
    array([ True, False])
    """
    return has_clearance(polygons, floor) & (compute_sharpest_corners(polygons) >= SHARPEST_CORNER)


def make_sound(polygon: shapely.Polygon, floor: float) -> tuple[shapely.Polygon, str]:
    """Repair a polygon by the first rung of a ladder that makes it sound.

    Parameters
    ----------
    polygon : shapely.Polygon
        Valid, in canonical form.
    floor : float
        Least minimum clearance (m).

    Returns
    -------
    polygon : shapely.Polygon
        Sound (`is_sound`) and canonical.
    rung : str
        ``""`` if it was sound as it came; ``"repaired-simplify"``: triangles of three consecutive vertices
        thinner than `floor` went; ``"repaired-buffer"``: gaps closed and necks opened by buffers with mitred
        corners of at most twice the floor, or the polygon thickened by as much; ``"repaired-hull"``: the
        convex hull without such triangles, or, where even that is too thin, the rotated box around it grown
        by the floor.
    """
    if is_sound(np.array([polygon]), floor)[0]:
        return polygon, ""
    for rung, shape in _ladder(polygon, floor):
        candidate = _simplify(shape, floor)
        if candidate is not None and is_sound(np.array([candidate]), floor)[0]:
            return candidate, rung
    box = shapely.buffer(shapely.oriented_envelope(polygon), floor, join_style="mitre")
    return make_canonical(np.array([box]))[0], "repaired-hull"


def _ladder(polygon: shapely.Polygon, floor: float) -> Iterator[tuple[str, shapely.Geometry]]:
    yield "repaired-simplify", polygon
    for factor in BUFFER_RADII:
        yield "repaired-buffer", _buffer(polygon, floor * factor, -2 * floor * factor, floor * factor)
    for factor in BUFFER_RADII:
        yield "repaired-buffer", _buffer(polygon, floor * factor)
    yield "repaired-hull", shapely.convex_hull(polygon)


def _buffer(shape: shapely.Geometry, *distances: float) -> shapely.Geometry:
    for distance in distances:
        shape = shapely.buffer(shape, distance, join_style="mitre", mitre_limit=MITRE_LIMIT)
    return shape


def _simplify(shape: shapely.Geometry, floor: float) -> shapely.Polygon | None:
    if shape.geom_type != "Polygon" or shape.is_empty:
        return None
    thick, _ = drop_needless_vertices(make_canonical(np.array([shape])), floor)
    return None if thick[0] is None else make_canonical(thick)[0]
