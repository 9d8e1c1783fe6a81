"""Merge two polygons by union, patch or convex hulls: the paper's Algorithms 2 and 3 (step 2.1)."""

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.geometry.clearance import has_clearance
from pipeline.geometry.holes import fill_small_holes
from pipeline.geometry.rings import drop_needless_vertices, make_canonical

# Grid of the unions (m): the paper unites with a precision, so vertices that differ by rounding meet.
UNION_GRID = 1e-3


def merge_polygons(
    a: shapely.Polygon,
    b: shapely.Polygon,
    *,
    clearance: float,
    max_iterations: int,
    min_hole_area: float,
    tolerance: float,
) -> tuple[shapely.Polygon, str]:
    """Make one polygon of two that are closer than the clearance (Algorithm 2).

    Parameters
    ----------
    a, b : shapely.Polygon
        Valid polygons.
    clearance : float
        Least minimum clearance of an accepted shape, and first tolerance of the vertex projections (m).
    max_iterations : int
        Patches that are tried; the tolerance of the projections doubles each time.
    min_hole_area : float
        Smaller holes are filled before a shape is tested (m²); see `fill_small_holes`.
    tolerance : float
        Triangles of three consecutive vertices thinner than this are left out before a shape is tested (m).

    Returns
    -------
    polygon : shapely.Polygon
        Canonical.
    method : str
        ``"union"``, ``"patch"``, ``"hulls"`` (union of the two convex hulls) or ``"hull"`` (convex hull of
        both, taken without a test).

    Notes
    -----
    Shapes are tested against the given clearance, not against the doubled one that the listing passes on:
    a larger patch must not have to be a coarser polygon.

    References
    ----------
    The paper's section 4.3, Algorithms 2 and 3 and their footnotes.
    """

    def accept(shape: shapely.Geometry) -> shapely.Polygon | None:
        return _accept(shape, clearance=clearance, min_hole_area=min_hole_area, tolerance=tolerance)

    union = shapely.union(a, b, grid_size=UNION_GRID)
    if (accepted := accept(union)) is not None:
        return accepted, "union"
    for k in range(max_iterations):
        points = [
            project_vertices(a, b, clearance * 2**k),
            project_vertices(b, a, clearance * 2**k),
        ]
        patch = shapely.convex_hull(shapely.multipoints(np.concatenate(points)))
        # A patch that is a point or a line adds nothing to a union that was refused.
        if shapely.get_dimensions(patch) < 2:
            continue
        if (accepted := accept(shapely.union(union, patch, grid_size=UNION_GRID))) is not None:
            return accepted, "patch"
    hulls = shapely.union(shapely.convex_hull(a), shapely.convex_hull(b), grid_size=UNION_GRID)
    if (accepted := accept(hulls)) is not None:
        return accepted, "hulls"
    hull = make_canonical(np.array([shapely.convex_hull(shapely.multipolygons([a, b]))]))
    return make_canonical(drop_needless_vertices(hull, tolerance)[0])[0], "hull"


def project_vertices(a: shapely.Polygon, b: shapely.Polygon, eps: float) -> NDArray[np.float64]:
    """Project the vertices of one polygon onto each edge of another that is close to them (Algorithm 3).

    Parameters
    ----------
    a, b : shapely.Polygon
        The polygon whose vertices and the polygon whose edges are meant, holes included.
    eps : float
        Tolerance (m).

    Returns
    -------
    float64, (k, 2)
        The nearest point of each such edge to each such vertex.

    Examples
    --------
    >>> project_vertices(shapely.box(0, 0, 1, 1), shapely.box(1.5, 0.25, 3, 9), 1.0)
    array([[1.5 , 0.25],
           [1.5 , 0.25],
           [1.5 , 1.  ],
           [1.5 , 0.25]])
    """
    vertices = np.concatenate([shapely.get_coordinates(ring)[:-1] for ring in shapely.get_rings(a)])
    rings = [shapely.get_coordinates(ring) for ring in shapely.get_rings(b)]
    start = np.concatenate([ring[:-1] for ring in rings])
    along = np.concatenate([np.diff(ring, axis=0) for ring in rings])
    low, high = np.minimum(start, start + along), np.maximum(start, start + along)
    near_b = ((vertices > low.min(axis=0) - eps) & (vertices < high.max(axis=0) + eps)).all(axis=1)
    near_a = ((high > vertices.min(axis=0) - eps) & (low < vertices.max(axis=0) + eps)).all(axis=1)
    vertices, start, along = vertices[near_b, None], start[near_a], along[near_a]
    share = ((vertices - start) * along).sum(axis=2) / (along**2).sum(axis=1)
    nearest = start + np.clip(share, 0.0, 1.0)[..., None] * along
    close: NDArray[np.float64] = nearest[np.hypot(*np.moveaxis(vertices - nearest, 2, 0)) < eps]
    return close


def _accept(
    shape: shapely.Geometry, *, clearance: float, min_hole_area: float, tolerance: float
) -> shapely.Polygon | None:
    """Give the shape's one polygon if it is valid and has the clearance, else None."""
    parts = shapely.get_parts(shape)
    parts = parts[shapely.get_type_id(parts) == shapely.GeometryType.POLYGON]
    if len(parts) != 1:
        return None
    whole, _ = fill_small_holes(parts, min_hole_area=min_hole_area, clearance=clearance)
    lean, _ = drop_needless_vertices(make_canonical(whole), tolerance)
    if lean[0] is None or not has_clearance(lean, clearance)[0]:
        return None
    return make_canonical(lean)[0]
