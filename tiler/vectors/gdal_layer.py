"""A layer of a vector file opened by GDAL: which one, by which options, and what it says about itself (step 1.2).

pyogrio and pyarrow are imported where they are used: few tasks need them.
"""

import json
import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape, quoteattr

import numpy as np

from pipeline.data.errors import ConfigError, InputError
from tiler.vectors.features import Box
from tiler.vectors.shapefile import check_complete, find_wide_columns, is_shapefile
from tiler.vectors.vector_forms import check_form

OSM_OPTIONS = Path(__file__).with_name("osm.ini")
_NAMED = 20  # layers or fields that a message lists
_FIRST_FEATURE = 1 << 20  # bytes of a GeoJSON in which its first feature is looked for
_OSM_LAYERS = {"points", "lines", "multilinestrings", "multipolygons", "other_relations"}
_OSM_POLYGONS = "multipolygons"


@dataclass(frozen=True)
class GdalLayer:
    """How GDAL reads a layer, and what it says about it."""

    path: Path
    source: Path | bytes  # what is opened: the file, or a VRT that points to it
    name: str
    options: dict[str, str]  # open options of the driver
    info: dict[str, Any]  # as `pyogrio.read_info` gives it
    driver: str  # name of GDAL's driver for the file, ``""`` where that is not known
    chosen: bool  # whether the layer was chosen among several

    @property
    def fid_name(self) -> str:
        """Column with the numbers of the features, ``""`` where the file has none."""
        return str(self.info["fid_column"])

    @property
    def geometry_name(self) -> str:
        """Column with the geometries, ``""`` where the file has no name for it."""
        return str(self.info["geometry_name"] or "")

    @property
    def fields(self) -> tuple[str, ...]:
        """Names of the attributes."""
        return tuple(str(field) for field in self.info["fields"])

    def dtype_of(self, field: str) -> str:
        """Type of an attribute, ``""`` where there is none of that name."""
        return dict(zip(self.fields, map(str, self.info["dtypes"]), strict=True)).get(field, "")

    @property
    def extent(self) -> Box | None:
        """Extent as stated; None if unknown or if there are no features."""
        found = self.info["total_bounds"]
        if found is None or not np.isfinite(found).all():
            return None
        xmin, ymin, xmax, ymax = (float(value) for value in found)
        return xmin, ymin, xmax, ymax


def open_layer(path: Path, layer: str) -> GdalLayer:
    """Find a layer of a file on a disk, and describe it without reading its features.

    `layer` is its name; ``""`` for the only one that has geometries, or that of the polygons in OSM data.

    Raises
    ------
    InputError
        If the file is damaged, or has no layer with geometries.
    ConfigError
        If the layer does not exist, or if there are several and none is named.

    Notes
    -----
    pyogrio refuses layers whose stated type is TIN, polyhedral surface, triangle, or any geometry with Z, whatever
    their features are. They are opened through a VRT that states no type.
    """
    check_form(path)
    options = {}
    if is_shapefile(path):
        check_complete(path)
        if find_wide_columns(path):
            options["ADJUST_TYPE"] = "YES"
    with gdal_as_input_error(path, []):
        spatial = _list_spatial(path)
        name = _choose(path, spatial, layer)
        source, info = _read_info(path, name, options)
        if info["driver"] == "OSM":
            options["CONFIG_FILE"] = str(OSM_OPTIONS)
            source, info = _read_info(path, name, options)
        if info["driver"] == "GeoJSON" and info["total_bounds"] is None:  # a Feature or a geometry alone
            source, info = _read_info(path, name, options | {"force_total_bounds": True})
        driver = str(info["driver"])
        if isinstance(source, bytes):
            driver = "GPKG" if _is_sqlite(path) else ""
    chosen = not layer and len(spatial) > 1
    if isinstance(source, bytes):
        options = {}  # of the driver of the file, not of the VRT
    return GdalLayer(path, source, name, options, info, driver, chosen)


def has_whole_ids(path: Path) -> bool:
    """Whether the first feature of a GeoJSON has a whole number as its id.

    GDAL gives such ids as the numbers of the features, and numbers those without one itself, without saying which.
    """
    with path.open("rb") as file:
        text = file.read(_FIRST_FEATURE).decode(errors="ignore").lstrip("\ufeff\x1e \t\r\n")
    start = re.search(r'"features"\s*:\s*\[\s*(?=\{)', text)
    try:
        feature, _ = json.JSONDecoder().raw_decode(text, start.end() if start else 0)
    except (ValueError, RecursionError):
        return False
    if not isinstance(feature, dict) or feature.get("type") != "Feature":
        return False
    return isinstance(feature.get("id"), int) and not isinstance(feature["id"], bool)


def list_some(names: Sequence[str]) -> str:
    """List names for a message: the first twenty, and how many more."""
    more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    return (", ".join(names[:_NAMED]) or "none") + more


def ask_gpkg(path: Path, sql: str) -> list[str]:
    """Ask a GeoPackage for one column, as text."""
    import pyogrio

    values = pyogrio.raw.read(path, sql=sql, read_geometry=False)[3]
    return [str(value) for value in values[0]] if values else []


def quote(name: str) -> str:
    """Write a name of a table or column as SQL has it.

    Examples
    --------
    >>> quote("pand 2")
    '"pand 2"'
    """
    return '"' + name.replace('"', '""') + '"'


def _list_spatial(path: Path) -> list[str]:
    import pyogrio

    try:
        return [str(row[0]) for row in pyogrio.list_layers(path) if row[1] is not None]
    except pyogrio.errors.GeometryError:
        if not _is_sqlite(path):
            return [path.stem]
        return ask_gpkg(path, "SELECT table_name FROM gpkg_geometry_columns")


def _read_info(path: Path, name: str, options: Mapping[str, str | bool]) -> tuple[Path | bytes, dict[str, Any]]:
    import pyogrio

    try:
        return path, pyogrio.read_info(path, layer=name, **options)
    except pyogrio.errors.GeometryError:
        untyped = (
            f"<OGRVRTDataSource><OGRVRTLayer name={quoteattr(name)}>"
            f'<SrcDataSource relativeToVRT="0">{escape(str(path.absolute()))}</SrcDataSource>'
            f"<SrcLayer>{escape(name)}</SrcLayer><GeometryType>wkbUnknown</GeometryType>"
            "</OGRVRTLayer></OGRVRTDataSource>"
        ).encode()
        return untyped, pyogrio.read_info(untyped, layer=name)


def _is_sqlite(path: Path) -> bool:
    with path.open("rb") as file:
        return file.read(15) == b"SQLite format 3"


def _choose(path: Path, spatial: list[str], asked: str) -> str:
    if asked and asked not in spatial:
        raise ConfigError(f"{path}: has no layer {asked!r}; its layers are: {list_some(spatial)}")
    if not spatial:
        raise InputError(f"{path}: has no layer with geometries; give a file with footprint polygons")
    if not asked and len(spatial) > 1:
        if _OSM_POLYGONS in spatial and set(spatial) <= _OSM_LAYERS:
            return _OSM_POLYGONS
        raise ConfigError(f"{path}: has {len(spatial)} layers; name one of them: {list_some(spatial)}")
    return asked or spatial[0]


@contextmanager
def gdal_as_input_error(path: Path, warned: list[str]) -> Iterator[None]:
    """Turn what GDAL says into an InputError, and collect what it warns of."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            yield
        except (RuntimeError, ValueError, OSError) as error:  # pyogrio's own errors are RuntimeErrors
            move = "check that it is a vector file and complete, or copy it again"
            if is_shapefile(path):
                move = "copy its .shp, .shx, .dbf and .prj together, or make the index anew: "
                move += f'ogr2ogr --config SHAPE_RESTORE_SHX YES mended.gpkg "{path}"'
            raise InputError(f"{path}: cannot be read ({error}); {move}") from error
    warned.extend(str(item.message) for item in caught)
