"""Plan outlines of the geometries of a footprint file, whatever their kind (step 1.2)."""

from collections.abc import Set
from dataclasses import dataclass, field

import numpy as np
import shapely
from numpy.typing import NDArray

from tiler.footprints.closed_lines import outline_lines
from tiler.footprints.surfaces import is_surface, outline_faces
from tiler.pointclouds.las_header import COORDINATE_LIMIT
from tiler.vectors.features import Box
from tiler.vectors.wkb import parse_wkb

# Vertices of one footprint: the largest of a national register have some thousands. Up to this many take less than
# a minute however they lie, beyond it the time of geometric predicates grows with the square.
MAX_VERTICES = 100_000
_POLYGONAL = (shapely.GeometryType.POLYGON, shapely.GeometryType.MULTIPOLYGON)
_LINEAR = (shapely.GeometryType.LINESTRING, shapely.GeometryType.LINEARRING)


@dataclass(frozen=True)
class Finding:
    """What was done to a geometry, or why it is left out: one of a `pipeline.data.notes.Note` in the making.

    Attributes
    ----------
    kind : str
        As a note has it.
    row : int
        Row of the geometry.
    detail : str
        What was seen.
    box : tuple of 4 floats
        Its bounding box in the file's CRS; NaN where there is none.
    """

    kind: str
    row: int
    detail: str
    box: Box


@dataclass(frozen=True, eq=False)
class Outlines:
    """Plan outlines.

    Attributes
    ----------
    geometry : object, (m,)
        Polygons and multipolygons without Z, valid or not, not empty.
    rows : int64, (m,)
        The row of each among what was given, ascending.
    findings : list of Finding
        What was converted, and what is left out.
    """

    geometry: NDArray[np.object_]
    rows: NDArray[np.int64]
    findings: list[Finding] = field(default_factory=list)


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

    Notes
    -----
    Polygons alone are parsed and tested all at once; each of the others takes some 0.1 ms.
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
