"""Plan outlines of the geometries of a footprint file, whatever their kind (step 1.2)."""

from collections.abc import Set
from dataclasses import dataclass, field

import numpy as np
import shapely
from numpy.typing import NDArray

from tiler.pointclouds.las_header import COORDINATE_LIMIT
from tiler.vectors.features import Box
from tiler.vectors.wkb import parse_wkb

# Vertices of one footprint: the largest of a national register have some thousands. Up to this many take less than
# a minute however they lie, beyond it the time of geometric predicates grows with the square.
MAX_VERTICES = 100_000
CLOSED = 0.01  # m; a line whose ends are this close is closed, as in drawings of CAD
GRID = 0.001  # m; faces that meet within this are joined
GAP = 0.01  # m; gaps between faces up to twice this wide are closed
STEEP = 0.002  # a face whose plan area is a smaller share of its area is vertical
_POLYGONAL = (shapely.GeometryType.POLYGON, shapely.GeometryType.MULTIPOLYGON)
_LINEAR = (shapely.GeometryType.LINESTRING, shapely.GeometryType.LINEARRING)


@dataclass(frozen=True)
class Finding:
    """What was done to a geometry, or why it is left out: one of a `pipeline.data.notes.Note` in the making."""

    kind: str  # as a note has it
    row: int  # row of the geometry
    detail: str
    box: Box  # its bounding box in the file's CRS; NaN where there is none


@dataclass(frozen=True, eq=False)
class Outlines:
    """Plan outlines."""

    geometry: NDArray[np.object_]  # (m,): polygons and multipolygons without Z, valid or not, not empty
    rows: NDArray[np.int64]  # (m,): the row of each among what was given, ascending
    findings: list[Finding] = field(default_factory=list)  # what was converted, and what is left out


def outline_all(wkb: NDArray[np.object_], *, metre: float = 1.0, curved: Set[int] = frozenset()) -> Outlines:
    """Give the plan outlines of geometries.

    Parameters
    ----------
    wkb : object, (n,)
        Well-known binary, None where there is none.
    metre : float
        Length of a metre in units of the coordinates: 1, some 9e-6 where these are degrees.
    curved : set of int
        Rows whose arcs GDAL made segments.

    Returns
    -------
    Outlines
        Polygons as they came, those of arcs told (``footprint-curve-linearised``); of surfaces in
        space and collections of polygons the outline of their faces (``footprint-outline-of-surface``); what
        closed lines enclose (``footprint-from-line``). Left out: ``footprint-not-polygon``,
        ``footprint-not-finite``, ``footprint-unreadable``, ``footprint-too-many-vertices``.
    """
    geometry, surfaces, broken = parse_wkb(wkb)
    found = {row: [("footprint-unreadable", reason)] for row, reason in broken.items()}
    for row in curved:
        told = f"arcs made segments of 4 degrees at most: {shapely.get_num_coordinates(geometry[row])} vertices"
        found[row] = [("footprint-curve-linearised", told)]
    kinds = shapely.get_type_id(geometry)
    polygonal = np.flatnonzero(np.isin(kinds, _POLYGONAL))
    surfaces |= set(polygonal[is_surface(geometry[polygonal])].tolist())
    place = shapely.bounds(geometry).reshape(-1, 4)
    for row in sorted(surfaces):
        _outline_surface(row, geometry, found, metre)
    for row in np.flatnonzero((kinds >= 0) & ~np.isin(kinds, _POLYGONAL)).tolist():
        if row not in surfaces:
            _outline_other(row, geometry, found, metre)
    geometry = shapely.force_2d(geometry)
    size = shapely.get_num_coordinates(geometry)
    for row in np.flatnonzero(size > MAX_VERTICES).tolist():
        detail = f"{size[row]} vertices > {MAX_VERTICES}; left out"
        found[row] = [("footprint-too-many-vertices", detail)]
        geometry[row] = None
    rows = np.flatnonzero(np.isin(shapely.get_type_id(geometry), _POLYGONAL) & ~shapely.is_empty(geometry))
    findings = [
        Finding(kind, row, detail, _box_of(place[row]))
        for row, told in sorted(found.items())
        for kind, detail in told
    ]
    return Outlines(geometry[rows], rows, findings)


def _box_of(sides: NDArray[np.float64]) -> Box:
    xmin, ymin, xmax, ymax = sides.tolist()
    return xmin, ymin, xmax, ymax


def _outline_surface(
    row: int, geometry: NDArray[np.object_], found: dict[int, list[tuple[str, str]]], metre: float
) -> None:
    parts = _flatten(geometry[row])
    faces = parts[shapely.get_type_id(parts) == shapely.GeometryType.POLYGON]
    others = f"; {len(parts) - len(faces)} points and lines left out" if len(faces) < len(parts) else ""
    outline, told = None, ("footprint-outline-of-surface", f"outline of {len(faces)} faces{others}")
    if not (np.abs(shapely.get_coordinates(faces)) <= COORDINATE_LIMIT).all():
        told = ("footprint-not-finite", f"a coordinate is NaN, infinite, or beyond ±{COORDINATE_LIMIT:g} m")
    else:
        try:
            outline = outline_faces(faces, metre=metre)
        except shapely.errors.GEOSException as error:
            told = ("footprint-unreadable", f"its {len(faces)} faces make no outline: {error}")
    if outline is not None and outline.is_empty:
        told = ("footprint-not-polygon", f"has {len(faces)} faces, all vertical or without area")
    geometry[row] = outline
    found.setdefault(row, []).append(told)


def _outline_other(
    row: int, geometry: NDArray[np.object_], found: dict[int, list[tuple[str, str]]], metre: float
) -> None:
    """Outline lines and collections in place; the others stay, and are told."""
    shape = geometry[row]
    parts = _flatten(shape)
    if not len(parts):
        return
    kinds = shapely.get_type_id(parts)
    if (kinds == shapely.GeometryType.POLYGON).any():
        _outline_surface(row, geometry, found, metre)
        return
    outline: shapely.Geometry | str = f"is a {shape.geom_type.lower()}"
    if np.isin(kinds, _LINEAR).all():
        try:
            outline = outline_lines(shapely.MultiLineString(list(parts)), metre=metre)
        except shapely.errors.GEOSException as error:
            outline = f"is a {shape.geom_type.lower()} that encloses no area: {error}"
    if isinstance(outline, str):
        found[row] = [("footprint-not-polygon", outline)]
        return
    geometry[row] = outline
    found.setdefault(row, []).append(("footprint-from-line", f"closed {shape.geom_type.lower()} taken as outline"))


def _flatten(shape: shapely.Geometry) -> NDArray[np.object_]:
    """Give the points, lines and polygons of a geometry, however its collections nest."""
    parts: NDArray[np.object_] = shapely.get_parts(shape)
    while (shapely.get_type_id(parts) > shapely.GeometryType.POLYGON).any():
        parts = np.concatenate([shapely.get_parts(part) for part in parts])
    kept: NDArray[np.object_] = parts[~shapely.is_empty(parts)]
    return kept


def outline_lines(geometry: shapely.Geometry, *, metre: float = 1.0) -> shapely.Geometry | str:
    """Give the area that lines enclose, closed ones within others as holes; or why there is none.

    Lines close each by itself within `CLOSED`, or all of them together from end to end. `metre` is the length of a
    metre in units of the coordinates.

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


def outline_faces(faces: NDArray[np.object_], *, metre: float = 1.0) -> shapely.Geometry:
    """Give the outline of faces, polygons (n,) with Z or without, in plan: polygon or multipolygon.

    It is the union of the faces that are not vertical, on a grid of `GRID`, with gaps up to twice `GAP` closed;
    an empty polygon if all are vertical. `metre` is the length of a metre in units of the coordinates.

    Examples
    --------
    >>> roof = shapely.Polygon([(0, 0, 3), (2, 0, 5), (2, 4, 5), (0, 4, 3)])
    >>> wall = shapely.Polygon([(2, 0, 5), (2, 4, 5), (2, 4, 0), (2, 0, 0)])
    >>> outline_faces(np.array([roof, wall])).normalize().wkt
    'POLYGON ((0 0, 0 4, 2 4, 2 0, 0 0))'
    """
    seen = faces[_is_seen(faces)]
    if not len(seen):
        return shapely.Polygon()
    flat = shapely.make_valid(shapely.force_2d(seen), method="structure", keep_collapsed=False)
    outline = _polygonal(shapely.union_all(flat, grid_size=GRID * metre))
    if _count_rings(outline) > 1:
        gap = {"join_style": "mitre", "mitre_limit": 5.0}
        closed = _polygonal(outline.buffer(GAP * metre, **gap).buffer(-GAP * metre, **gap))
        if not closed.is_empty and _count_rings(closed) < _count_rings(outline):
            return closed
    return outline


def is_surface(geometry: NDArray[np.object_]) -> NDArray[np.bool_]:
    """Tell the multipolygons (n,) with Z that are faces of a body rather than parts of an outline: bool (n,).

    Several faces have Z and are, seen from above, no valid multipolygon: they are vertical, lie over one another,
    or meet along edges.
    """
    several = shapely.has_z(geometry) & (shapely.get_num_geometries(geometry) > 1)
    found = np.zeros(len(geometry), np.bool_)
    with np.errstate(invalid="ignore"):
        found[several] = ~shapely.is_valid(shapely.force_2d(geometry[several]))
    return found


def _is_seen(faces: NDArray[np.object_]) -> NDArray[np.bool_]:
    """Compare the plan area of each face with its area, by the normals of Newell."""
    xyz, face = shapely.get_coordinates(shapely.get_exterior_ring(faces), include_z=True, return_index=True)
    first = np.unique(face, return_index=True)[1]
    low = np.zeros((len(faces), 3))
    low[face[first]] = xyz[first]
    arm = np.where(np.isnan(xyz), 0.0, xyz - low[face])
    same = face[1:] == face[:-1]
    cross = np.cross(arm[:-1][same], arm[1:][same])
    normal = np.stack([np.bincount(face[1:][same], side, minlength=len(faces)) for side in cross.T], axis=1)
    seen: NDArray[np.bool_] = np.abs(normal[:, 2]) > STEEP * np.linalg.norm(normal, axis=1)
    return seen


def _polygonal(geometry: shapely.Geometry) -> shapely.Geometry:
    parts = [part for part in shapely.get_parts(geometry) if part.geom_type == "Polygon" and not part.is_empty]
    return parts[0] if len(parts) == 1 else shapely.MultiPolygon(parts)


def _count_rings(geometry: shapely.Geometry) -> int:
    return len(shapely.get_rings(shapely.get_parts(geometry)))
