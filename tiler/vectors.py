"""Building footprints from vector files: CRS, box, polygons, ids and given heights (step 1.2)."""

from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import shapely
from numpy.typing import NDArray

from pipeline.citymodel import Footprints, make_ids
from pipeline.errors import ConfigError, InputError
from pipeline.notes import Note
from tiler.crs import crs_name, horizontal_crs, same_crs
from tiler.layers import Box, Layer, describe_layer, list_some, read_layer

# Attributes that hold a building's own id, first found first taken, in any case: Dutch BAG (and its
# ten letters in SHP), INSPIRE and GML, OpenStreetMap, then names in general use.
ID_ATTRIBUTES = (
    *("identificatie", "identifica", "gml_id", "inspireid", "localid", "uuid", "osm_id", "@id"),
    *("building_id", "buildingid", "bldg_id", "id", "gid", "fid", "objectid"),
)

_BOX_MARGIN = 0.01  # share of the box's size added after reprojection, whose straight edges bend
_POLYGONAL = (shapely.GeometryType.POLYGON, shapely.GeometryType.MULTIPOLYGON)


def read_footprint_crs(path: str | Path, layer: str = "") -> pyproj.CRS | None:
    """Read the CRS that a footprint file states.

    Parameters
    ----------
    path : str or Path
        SHP, GPKG, GeoJSON or GeoParquet.
    layer : str
        Name of the layer, ``""`` for the only one.

    Returns
    -------
    pyproj.CRS or None
        None if it states none, or one without a place on Earth.

    Raises
    ------
    InputError
        If the file cannot be read.
    ConfigError
        If the layer does not exist, or there are several and none is named.
    """
    crs = describe_layer(Path(path), layer).crs
    return None if horizontal_crs(crs) is None else crs


def read_footprints(
    path: str | Path,
    *,
    crs: pyproj.CRS,
    bounds: Box,
    layer: str = "",
    id_attribute: str = "",
    height_attribute: str = "",
) -> tuple[Footprints, tuple[Note, ...]]:
    """Read the footprints that meet a box (step 1.2).

    Parameters
    ----------
    path : str or Path
        SHP, GPKG, GeoJSON or GeoParquet.
    crs : pyproj.CRS
        The region's CRS, to which footprints in another are reprojected.
    bounds : tuple of 4 floats
        xmin, ymin, xmax, ymax in the region's CRS (m); the borders belong to the box.
    layer : str
        Name of the layer, ``""`` for the only one.
    id_attribute : str
        Attribute with the building's id; ``""`` for the first of `ID_ATTRIBUTES` that the layer has.
    height_attribute : str
        Attribute with the height above ground (m); ``""`` for none.

    Returns
    -------
    Footprints
        By ascending id. Polygons and multipolygons as they came, valid or not, without Z.
    tuple of Note
        What was left out, assumed or renamed; a note each for ``footprint-not-polygon``,
        ``footprint-unreadable``, ``footprint-not-finite``, ``footprint-id-missing``,
        ``footprint-id-repeated`` and ``footprint-height-missing``; and one a file for
        ``footprints-without-crs``, ``footprints-reprojected``, ``footprints-outside`` and
        ``footprints-reader-warning``.

    Raises
    ------
    InputError
        If the file cannot be read, or its coordinates do not fit its CRS.
    ConfigError
        If the layer or an attribute does not exist.

    Notes
    -----
    The id attribute is chosen by its name alone, so that a building's id does not depend on which others
    are read with it. A building without an id gets one from its geometry. An id that several different
    geometries carry is completed by their geometry.
    """
    info = describe_layer(Path(path), layer)
    id_name, height_name = _id_attribute(info, id_attribute), _attribute(info, height_attribute)
    own = horizontal_crs(info.crs)
    notes = _crs_notes(info, own, crs)
    source = crs if own is None or same_crs(own, crs) else own
    _check_extent(info, source)
    box = bounds if source is crs else _reproject_box(info, source, crs, bounds)
    features = read_layer(info, [name for name in (id_name, height_name) if name], box)
    notes += [Note("footprints-reader-warning", info.path.name, detail=text) for text in features.warned]

    geometry, rows, found = _polygonal(features.wkb)
    notes += found
    if source is not crs:
        forward = pyproj.Transformer.from_crs(source, crs, always_xy=True)
        geometry = shapely.transform(geometry, forward.transform, interleaved=False)
    keep, found = _finite_within(geometry, bounds)
    notes += found
    geometry, rows = geometry[keep], rows[keep]
    if len(geometry) == 0 and info.n_features != 0:
        notes.append(_outside(info))
    ids, found = _ids(geometry, features.columns[id_name][rows] if id_name else None)
    notes += found
    heights, found = _heights(geometry, ids, features.columns[height_name][rows] if height_name else None)
    order = np.argsort(ids, kind="stable")
    return Footprints(geometry[order], ids[order], heights[order]), (*notes, *found)


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


def _crs_notes(info: Layer, own: pyproj.CRS | None, crs: pyproj.CRS) -> list[Note]:
    name = info.path.name
    if own is None:
        return [Note("footprints-without-crs", name, detail=f"taken as {crs_name(crs)}, the region's CRS")]
    if not same_crs(own, crs):
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


def _reproject_box(info: Layer, source: pyproj.CRS, crs: pyproj.CRS, bounds: Box) -> Box:
    transformer = pyproj.Transformer.from_crs(crs, source, always_xy=True)
    xmin, ymin, xmax, ymax = transformer.transform_bounds(*bounds, densify_pts=21)
    margin = _BOX_MARGIN * max(xmax - xmin, ymax - ymin)
    box = (xmin - margin, ymin - margin, xmax + margin, ymax + margin)
    if not np.isfinite(box).all() or xmin > xmax:
        raise InputError(
            f"{info.path}: the region {bounds} of {crs_name(crs)} has no place in {crs_name(source)}, "
            "the CRS of the footprints; check --crs and --bounds"
        )
    return box


def _polygonal(wkb: NDArray[np.object_]) -> tuple[NDArray[np.object_], NDArray[np.int64], list[Note]]:
    """Parse geometries, and give the polygonal ones with their rows."""
    with np.errstate(invalid="ignore"):  # GEOS compares NaN coordinates
        geometry = shapely.force_2d(shapely.from_wkb(wkb, on_invalid="fix"))
    stored = np.array([blob is not None for blob in wkb], bool)
    kinds = shapely.get_type_id(geometry)
    polygonal = np.isin(kinds, _POLYGONAL) & ~shapely.is_empty(geometry)
    other = ~np.isin(kinds, _POLYGONAL) & (kinds >= 0)
    notes = _notes("footprint-unreadable", geometry[stored & (kinds < 0)], "the geometry cannot be parsed")
    for kind in np.unique(kinds[other]):
        name = shapely.GeometryType(kind).name.lower()
        notes += _notes("footprint-not-polygon", geometry[kinds == kind], f"is a {name}")
    rows = np.flatnonzero(polygonal)
    return geometry[rows], rows, notes


def _finite_within(geometry: NDArray[np.object_], bounds: Box) -> tuple[NDArray[np.bool_], list[Note]]:
    coordinates, owner = shapely.get_coordinates(geometry, return_index=True)
    finite = np.ones(len(geometry), bool)
    finite[owner[~np.isfinite(coordinates).all(axis=1)]] = False
    notes = _notes("footprint-not-finite", geometry[~finite], "a coordinate is NaN or infinite")
    keep = finite.copy()
    keep[finite] = shapely.intersects(geometry[finite], shapely.box(*bounds))
    return keep, notes


def _outside(info: Layer) -> Note:
    extent = "unknown" if info.extent is None else ", ".join(f"{value:.10g}" for value in info.extent)
    return Note(
        "footprints-outside", info.path.name, detail=f"none meets the region; extent of the file: {extent}"
    )


def _ids(geometry: NDArray[np.object_], values: NDArray[Any] | None) -> tuple[NDArray[np.str_], list[Note]]:
    """Give each footprint its id, see `read_footprints`."""
    made = make_ids(geometry) if len(geometry) else np.empty(0, np.str_)
    if values is None:
        return made, []
    given = np.array([_text(value) for value in values], dtype=np.str_)
    missing = given == ""
    notes = _notes("footprint-id-missing", geometry[missing], "named by its geometry", made[missing])
    ids = np.where(missing, made, given)
    pairs = np.unique(np.column_stack((ids, made)), axis=0)
    names, n_shapes = np.unique(pairs[:, 0], return_counts=True)
    repeated = np.isin(ids, names[n_shapes > 1])
    completed = np.char.add(np.char.add(ids, "-"), made)
    ids = np.where(repeated, completed, ids)
    notes += _notes("footprint-id-repeated", geometry[repeated], "completed by its geometry", ids[repeated])
    return ids, notes


def _text(value: Any) -> str:
    """Write an id as text, whole floats as integers (a column with nulls is read as float).

    Examples
    --------
    >>> _text(12.0), _text(" a1 "), _text(None), _text(float("nan"))
    ('12', 'a1', '', '')
    """
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
    details = [f"{value!r} is no height above 0 m" for value in values[bad]]
    return heights, _notes("footprint-height-missing", geometry[bad], details, ids[bad])


def _number(value: Any) -> float:
    try:
        return float(value)
    except (TypeError, ValueError):
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
