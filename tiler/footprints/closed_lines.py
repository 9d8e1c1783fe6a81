"""Closed lines as outlines, as drawings of CAD have them (step 1.2)."""

import numpy as np
import shapely

CLOSED = 0.01  # m; a line whose ends are this close is closed


def outline_lines(geometry: shapely.Geometry, *, metre: float = 1.0) -> shapely.Geometry | str:
    """Give the outline that lines enclose.

    Parameters
    ----------
    geometry : shapely.Geometry
        Line or multiline, or a collection of lines.
    metre : float
        Length of a metre in units of the coordinates.

    Returns
    -------
    shapely.Geometry or str
        Polygon or multipolygon; closed lines within others are holes. Or why there is none: the lines do not
        close, each by itself within `CLOSED` or all of them together from end to end.

    Examples
    --------
    >>> outline_lines(shapely.LineString([(0, 0), (4, 0), (4, 3), (0, 3), (0, 0)])).wkt
    'POLYGON ((0 0, 4 0, 4 3, 0 3, 0 0))'
    >>> outline_lines(shapely.LineString([(0, 0), (4, 0), (4, 3)]))
    'is an open line: its ends are 5 m apart'
    """
    lines = [line for line in shapely.get_parts(shapely.force_2d(geometry)) if not line.is_empty]
    gaps = [_gap(line) / metre for line in lines]
    if not all(np.isfinite(gaps)) or not lines:
        return "is a line without finite vertices"
    rings = [line for line, gap in zip(lines, gaps, strict=True) if gap <= CLOSED and len(line.coords) > 3]
    if len(rings) == len(lines):
        polygons = [shapely.Polygon(line) for line in rings]
        return polygons[0] if len(polygons) == 1 else _nest(polygons)
    if len(lines) == 1:
        return f"is an open line: its ends are {gaps[0]:.3g} m apart"
    faces, cuts, dangles, invalid = shapely.polygonize_full(lines)
    if faces.is_empty or not (cuts.is_empty and dangles.is_empty and invalid.is_empty):
        return f"is {len(lines)} lines that do not close together"
    return _nest(list(faces.geoms))


def _gap(line: shapely.LineString) -> float:
    ends = shapely.get_coordinates(line)[[0, -1]]
    return float(np.hypot(*(ends[1] - ends[0])))


def _nest(polygons: list[shapely.Polygon]) -> shapely.Geometry:
    """Join polygons so that each ring within another changes from house to courtyard and back."""
    shells = [shapely.make_valid(shapely.Polygon(polygon.exterior), method="structure") for polygon in polygons]
    shells.sort(key=lambda shell: (-shell.area, shapely.to_wkb(shell)))
    outline = shells[0]
    for shell in shells[1:]:
        outline = shapely.symmetric_difference(outline, shell)
    return outline
