"""A footprint file opened: which attributes, which CRS, and features made footprints (step 1.2)."""

from collections.abc import Set
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import shapely
from numpy.typing import NDArray

from pipeline.citymodel import Footprints, make_ids
from pipeline.errors import ConfigError, InputError
from pipeline.notes import Note
from tiler.crs import crs_name, horizontal_crs
from tiler.georeference.footprints import footprint_frame
from tiler.georeference.frame import Frame, box_to_file, to_region
from tiler.lasheader import COORDINATE_LIMIT
from tiler.layers import Box, Features, Layer, describe_layer, list_some
from tiler.plain_text import ID_LENGTH, printable, shorten
from tiler.wkb import parse_wkb

# Attributes that hold a building's own id, first found first taken, in any case: Dutch BAG (and its
# ten letters in SHP), INSPIRE and GML, OpenStreetMap, then names in general use.
ID_ATTRIBUTES = (
    *("identificatie", "identifica", "gml_id", "inspireid", "localid", "uuid", "osm_id", "@id"),
    *("building_id", "buildingid", "bldg_id", "id", "gid", "fid", "objectid"),
)

# Vertices of one footprint: the largest of a national register have some thousands. Up to this many take less than
# a minute however they lie, beyond it the time of geometric predicates grows with the square.
MAX_VERTICES = 100_000
_POLYGONAL = (shapely.GeometryType.POLYGON, shapely.GeometryType.MULTIPOLYGON)


@dataclass(frozen=True, eq=False)
class FootprintSource:
    """How footprints are read from one layer.

    Attributes
    ----------
    layer : Layer
        The layer.
    id_name, height_name : str
        Attributes with the id and with the height above ground, ``""`` for none.
    frame : Frame
        How coordinates of the file become those of the region.
    bounds : tuple of 4 floats
        The region (m), in its own CRS.
    box : tuple of 4 floats
        The region in the file's CRS.
    notes : tuple of Note
        What was assumed about the CRS.
    """

    layer: Layer
    id_name: str
    height_name: str
    frame: Frame
    bounds: Box
    box: Box
    notes: tuple[Note, ...]


def open_source(
    path: Path,
    *,
    crs: pyproj.CRS,
    bounds: Box,
    layer: str,
    id_attribute: str,
    height_attribute: str,
    frame: Frame | None = None,
) -> FootprintSource:
    """Decide how footprints are read from a file.

    Parameters
    ----------
    path, crs, bounds, layer, id_attribute, height_attribute, frame
        As `read_footprints` has them.

    Returns
    -------
    FootprintSource

    Raises
    ------
    InputError
        If the file cannot be read, or its coordinates do not fit its CRS.
    ConfigError
        If the layer or an attribute does not exist.
    """
    info = describe_layer(path, layer)
    id_name, height_name = _id_attribute(info, id_attribute), _attribute(info, height_attribute)
    own = horizontal_crs(info.crs)
    _check_extent(info, own or crs)
    if frame is None:
        frame = Frame() if own is None else footprint_frame(own, crs, bounds)[0]
    box = box_to_file(frame, bounds) if frame.changes_plan else bounds
    return FootprintSource(
        info, id_name, height_name, frame, bounds, box, tuple(_crs_notes(info, own, crs, frame))
    )


def make_footprints(
    source: FootprintSource, features: Features, repeated: Set[str]
) -> tuple[Footprints, list[Note]]:
    """Make footprints of features.

    Parameters
    ----------
    source : FootprintSource
        Where they come from.
    features : Features
        Any of its features, with the attributes of its id and height.
    repeated : set of str
        Ids that several different geometries of the file carry: they are completed by the geometry.

    Returns
    -------
    Footprints
        Those that meet the region, in the order of the features.
    list of Note
        As `read_footprints` gives them.
    """
    geometry, rows, notes = parse_polygons(features.wkb)
    if source.frame.changes_plan:
        geometry = shapely.transform(geometry, partial(to_region, source.frame))
    keep, found = _finite_within(geometry, source.bounds)
    notes += found
    geometry, rows = geometry[keep], rows[keep]
    ids, found = _ids(geometry, features.columns[source.id_name][rows] if source.id_name else None, repeated)
    notes += found
    given = features.columns[source.height_name][rows] if source.height_name else None
    heights, found = _heights(geometry, ids, given)
    return Footprints(geometry, ids, heights), notes + found


def _attribute(info: Layer, asked: str) -> str:
    """Check that an attribute exists; a GeoJSON file without features has none, and needs none."""
    if asked and asked not in info.fields:
        if info.n_features == 0:
            return ""
        raise ConfigError(f"{info.path}: has no attribute {asked!r}; it has: {list_some(info.fields)}")
    return asked


def _id_attribute(info: Layer, asked: str) -> str:
    if asked:
        return _attribute(info, asked)
    lower = {field.lower(): field for field in info.fields}
    return next((lower[name] for name in ID_ATTRIBUTES if name in lower), "")


def _crs_notes(info: Layer, own: pyproj.CRS | None, crs: pyproj.CRS, frame: Frame) -> list[Note]:
    name = info.path.name
    if own is None and not frame.changes_plan:
        return [Note("footprints-without-crs", name, detail=f"taken as {crs_name(crs)}, the region's CRS")]
    if own is None:
        return [Note("footprints-without-crs", name, detail="taken in the CRS and units of the point clouds")]
    if frame.changes_plan:
        return [Note("footprints-reprojected", name, detail=f"from {crs_name(own)} to {crs_name(crs)}")]
    return []


def _check_extent(info: Layer, crs: pyproj.CRS) -> None:
    """Refuse degrees beyond the pole: GeoJSON without a CRS means degrees, whatever its author meant."""
    if crs.is_geographic and info.extent is not None and max(abs(v) for v in info.extent) > 360:
        raise InputError(
            f"{info.path}: states {crs_name(crs)} (degrees), but its coordinates reach "
            f"{max(info.extent, key=abs):g}; GeoJSON without a CRS means degrees: state the true one, "
            f'ogr2ogr -a_srs EPSG:<code> mended.gpkg "{info.path}"'
        )


def parse_polygons(wkb: NDArray[np.object_]) -> tuple[NDArray[np.object_], NDArray[np.int64], list[Note]]:
    """Parse geometries, and give the polygonal ones with their rows.

    Parameters
    ----------
    wkb : object, (n,)
        Well-known binary, None where there is none.

    Returns
    -------
    geometry : object, (m,)
        Polygons and multipolygons without Z, valid or not.
    rows : int64, (m,)
        Their rows.
    notes : list of Note
        What cannot be parsed, and what is something else.
    """
    with np.errstate(invalid="ignore"):  # GEOS compares NaN coordinates
        geometry = shapely.force_2d(parse_wkb(wkb))
    stored = np.array([blob is not None for blob in wkb], bool)
    kinds = shapely.get_type_id(geometry)
    polygonal = np.isin(kinds, _POLYGONAL) & ~shapely.is_empty(geometry)
    other = ~np.isin(kinds, _POLYGONAL) & (kinds >= 0)
    notes = _notes("footprint-unreadable", geometry[stored & (kinds < 0)], "the geometry cannot be parsed")
    for kind in np.unique(kinds[other]):
        notes += _notes("footprint-not-polygon", geometry[kinds == kind], f"is a {_kind_name(kind)}")
    size = shapely.get_num_coordinates(geometry)
    large = polygonal & (size > MAX_VERTICES)
    details = [f"{n} vertices > {MAX_VERTICES}; left out" for n in size[large]]
    notes += _notes("footprint-too-many-vertices", geometry[large], details)
    rows = np.flatnonzero(polygonal & ~large)
    return geometry[rows], rows, notes


def _kind_name(kind: int) -> str:
    try:
        return str(shapely.GeometryType(kind).name.lower())
    except ValueError:  # curves, which GEOS knows and shapely has no name for
        return f"geometry of type {kind}"


def _finite_within(geometry: NDArray[np.object_], bounds: Box) -> tuple[NDArray[np.bool_], list[Note]]:
    coordinates, owner = shapely.get_coordinates(geometry, return_index=True)
    finite = np.ones(len(geometry), bool)
    finite[owner[~(np.abs(coordinates) <= COORDINATE_LIMIT).all(axis=1)]] = False  # NaN too
    detail = f"a coordinate is NaN, infinite, or beyond ±{COORDINATE_LIMIT:g} m"
    notes = _notes("footprint-not-finite", geometry[~finite], detail)
    keep = finite.copy()
    keep[finite] = shapely.intersects(geometry[finite], shapely.box(*bounds))
    return keep, notes


def _ids(
    geometry: NDArray[np.object_], values: NDArray[Any] | None, repeated: Set[str]
) -> tuple[NDArray[np.str_], list[Note]]:
    """Give each footprint its id, see `read_footprints`."""
    given = (
        np.full(len(geometry), "") if values is None else np.array([id_text(value) for value in values], np.str_)
    )
    missing = given == ""
    again = np.fromiter((name in repeated for name in given.tolist()), bool, len(given)) & ~missing
    made = np.full(len(given), "", dtype="<U14")
    made[missing | again] = make_ids(geometry[missing | again])
    ids = np.where(missing, made, given)
    ids = np.where(again, np.char.add(np.char.add(given, "-"), made), ids)
    if values is None:
        return ids, []
    notes = _notes("footprint-id-missing", geometry[missing], "named by its geometry", made[missing])
    notes += _notes("footprint-id-repeated", geometry[again], "completed by its geometry", ids[again])
    return ids, notes


def id_text(value: Any) -> str:
    """Write an id as text, whole floats as integers (a column with nulls may be read as float).

    Parameters
    ----------
    value : Any
        As the file has it.

    Returns
    -------
    str
        ``""`` where there is none. Control characters are escaped, and what is longer than `ID_LENGTH` ends in a
        hash: an id becomes a key of files and part of messages.

    Examples
    --------
    >>> id_text(12.0), id_text(" a1 "), id_text(None), id_text(float("nan"))
    ('12', 'a1', '', '')
    """
    return shorten(printable(_plain_id(value)), ID_LENGTH)


def _plain_id(value: Any) -> str:
    if isinstance(value, str):
        return value.strip()
    if isinstance(value, float | np.floating):
        return f"{value:.17g}" if np.isfinite(value) else ""
    return "" if value is None else str(value).strip()


def _heights(
    geometry: NDArray[np.object_], ids: NDArray[np.str_], values: NDArray[Any] | None
) -> tuple[NDArray[np.float64], list[Note]]:
    if values is None:
        return np.full(len(geometry), np.nan), []
    heights = np.array([_number(value) for value in values], dtype=np.float64)
    bad = ~(heights > 0) | ~np.isfinite(heights)
    heights[bad] = np.nan
    details = [f"{shorten(repr(value), ID_LENGTH)} is no height above 0 m" for value in values[bad]]
    return heights, _notes("footprint-height-missing", geometry[bad], details, ids[bad])


def _number(value: Any) -> float:
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError):
        return float("nan")


def _notes(
    kind: str,
    geometry: NDArray[np.object_],
    detail: str | list[str],
    subjects: NDArray[np.str_] | None = None,
) -> list[Note]:
    """Make one note a geometry, at the middle of its bounding box."""
    boxes = shapely.bounds(geometry)
    x, y = (boxes[:, 0] + boxes[:, 2]) / 2, (boxes[:, 1] + boxes[:, 3]) / 2
    details = [detail] * len(geometry) if isinstance(detail, str) else detail
    names = [""] * len(geometry) if subjects is None else [str(name) for name in subjects]
    return [
        Note(kind, name, float(px), float(py), text)
        for name, px, py, text in zip(names, x, y, details, strict=True)
    ]
