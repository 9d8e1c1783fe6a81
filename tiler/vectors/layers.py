"""Vector files: what a layer says about itself, and its features within a box (step 1.2)."""

import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import pyproj

from pipeline.data.errors import ConfigError, InputError
from pipeline.data.notes import Note
from tiler.objects.places import is_missing
from tiler.objects.results import local_copy
from tiler.vectors import geoparquet
from tiler.vectors.features import Box, Features, to_objects
from tiler.vectors.gdal_features import check_readable, scan_features
from tiler.vectors.gdal_layer import GdalLayer, has_whole_ids, open_layer
from tiler.vectors.osm_tags import STOREY, OsmTags, find_osm_tags
from tiler.vectors.vector_forms import read_head

BATCH = 50_000  # features in memory at once

_DEGREE = 111_320.0  # m, of latitude


@dataclass(frozen=True)
class Layer:
    """What one layer of a vector file says about itself."""

    path: Path
    name: str  # name of the layer; ``""`` for Parquet, which has one
    crs: pyproj.CRS | None  # as stated, None if not
    fields: tuple[str, ...]
    n_features: int  # number of features; -1 if the driver would have to read them all to know
    extent: Box | None  # xmin, ymin, xmax, ymax in the file's CRS; None if unknown or if there are no features
    # What stands for the numbers of the features where it is asked for as an attribute: of a GeoJSON with whole
    # numbers as ids ``"id"``, which is among `fields` then; the column of a GeoPackage, which is not.
    fid_name: str = ""
    notes: tuple[Note, ...] = ()  # what was assumed about the file
    gdal: GdalLayer | None = None  # how GDAL reads it; None for Parquet

    @cached_property
    def tags(self) -> OsmTags | None:
        """Tags of OSM data; None for other data."""
        return find_osm_tags(self.fields)

    @property
    def metre(self) -> float:
        """Length of a metre in units of the coordinates, to a percent."""
        if self.crs is None:
            return 1.0
        if self.crs.is_geographic:
            return 1 / _DEGREE
        return 1 / float(self.crs.axis_info[0].unit_conversion_factor) if self.crs.axis_info else 1.0


def split_layer(text: str) -> tuple[str, str]:
    """Split ``FILE:LAYER`` into both; the layer is ``""`` where none is named, or a file has that name.

    Examples
    --------
    >>> split_layer("city.gpkg:roads"), split_layer("s3://bucket/roads.gpkg")
    (('city.gpkg', 'roads'), ('s3://bucket/roads.gpkg', ''))
    """
    path, _, layer = text.rpartition(":")
    return (path, layer) if path and "/" not in layer and not Path(text).exists() else (text, "")


def describe_layer(path: Path, layer: str = "") -> Layer:
    """Describe a layer without reading its features.

    Parameters
    ----------
    path : Path
        SHP, GPKG, GeoJSON, FlatGeobuf, OSM or GeoParquet; see `check_form`. Of an object, Parquet is read by
        ranges; all others are fetched first.
    layer : str
        Name of the layer; ``""`` for the only one that has geometries.

    Raises
    ------
    InputError
        If the file is missing, damaged, or has no layer with geometries.
    ConfigError
        If the layer does not exist, or if there are several and none is named.
    """
    if not geoparquet.is_parquet(path):
        path = local_copy(path)
    if is_missing(path):
        raise InputError(f"{path}: no such file; check the path of the footprints")
    if geoparquet.is_parquet(path):
        if layer:
            raise ConfigError(f"{path}: Parquet has no layers, but layer {layer!r} is asked for; leave it out")
        read_head(path)
        column, fields, n_features, extent = geoparquet.describe(path)
        return Layer(path, "", column.crs, fields, n_features, extent, notes=column.notes)
    gdal = open_layer(path, layer)
    fields, fid_name = gdal.fields, gdal.fid_name
    if "json" in gdal.driver.lower() and "id" not in fields and has_whole_ids(path):
        fields, fid_name = (*fields, "id"), "id"
    return Layer(
        path,
        gdal.name,
        _parse(path, gdal.info["crs"]),
        fields,
        int(gdal.info["features"]),
        gdal.extent,
        fid_name,
        tuple(_notes(gdal)),
        gdal,
    )


def scan_layer(
    layer: Layer, columns: Sequence[str], box: Box | None, *, geometry: bool = True, batch: int = BATCH
) -> Iterator[Features]:
    """Read the features of a layer that may meet a box, once, by batches.

    Parameters
    ----------
    layer : Layer
        From `describe_layer`.
    columns : sequence of str
        Attributes to read.
    box : tuple of 4 floats, or None
        xmin, ymin, xmax, ymax in the file's CRS; None for all features.
    geometry : bool
        False leaves the geometries out: None in every row.
    batch : int
        Features in memory at once.

    Yields
    ------
    Features
        In the order of the file or of its spatial index; all that meet the box, and others too. Features without
        geometry have no place and may be absent.

    Raises
    ------
    InputError
        If the file is damaged.
    """
    if layer.gdal is None:
        yield from geoparquet.scan(layer.path, columns, box, geometry=geometry, batch=batch)
        return
    at = layer.extent
    if box and at and box[0] <= at[0] and box[1] <= at[1] and box[2] >= at[2] and box[3] >= at[3]:
        box = None  # all features: then their number is known, and can be checked
    n_read = 0
    own = [name for name in columns if name != layer.fid_name or name in layer.gdal.fields]
    for features in scan_features(layer.gdal, own, box, geometry=geometry, batch=batch):
        n_read += len(features.wkb)
        if len(own) < len(columns):
            features.columns[layer.fid_name] = to_objects(features.fids.tolist())
        yield features
    # An extract of OSM does not tell its number, and its stream too ends at damage without a word.
    if (box is None and n_read < layer.n_features) or (geometry and layer.gdal.driver == "OSM"):
        check_readable(layer.gdal)


def _notes(gdal: GdalLayer) -> Iterator[Note]:
    name = gdal.path.name
    if find_osm_tags(gdal.fields) is not None:
        detail = (
            "building=* and building:part=* are taken; heights, where there are no roof points, by the tag "
            f"height, else building:levels x {STOREY:g} m"
        )
        yield Note("footprints-of-osm", name, detail=detail)
    if gdal.chosen and gdal.driver != "OSM":
        detail = f"{gdal.name}; building:part in the layer lines is not read: give the extract itself for it"
        yield Note("footprints-layer-chosen", name, detail=detail)


def _stored_crs(path: Path, text: str) -> pyproj.CRS | None:
    """Parse the definition that a GeoPackage has of a CRS: GDAL names codes that PROJ's register may lack."""
    authority, _, code = text.partition(":")
    if path.suffix.lower() != ".gpkg" or not code.isdigit():
        return None
    query = (
        "select definition from gpkg_spatial_ref_sys "
        "where organization = ? collate nocase and organization_coordsys_id = ?"
    )
    try:
        with closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True)) as table:
            (definition,) = table.execute(query, (authority, int(code))).fetchone()
            return pyproj.CRS.from_wkt(definition)
    except (sqlite3.Error, TypeError, ValueError, pyproj.exceptions.CRSError):
        return None


def _parse(path: Path, text: str | None) -> pyproj.CRS | None:
    if text is None:
        return None
    try:
        return pyproj.CRS.from_user_input(text)
    except pyproj.exceptions.CRSError as error:
        stored = _stored_crs(path, text)
        if stored is not None:
            return stored
        raise InputError(
            f"{path}: its CRS cannot be parsed ({text[:60]!r}...); write it anew: "
            f'ogr2ogr -a_srs EPSG:<code> mended.gpkg "{path}"'
        ) from error
