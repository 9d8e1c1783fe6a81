"""Which column of a Parquet file holds geometries, how they are stored, and in which CRS (step 1.2).

A file says so by the metadata of GeoParquet, by the types GEOMETRY and GEOGRAPHY of Parquet itself, by those of
GeoArrow, or not at all.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import shapely
from numpy.typing import NDArray

from pipeline.data.errors import InputError
from pipeline.data.notes import Note
from tiler.vectors.wkb import parse_wkb

LONGITUDE_LATITUDE = "OGC:CRS84"  # what GeoParquet and Parquet take where a file says nothing
_NAMES = ("geometry", "geom", "wkb_geometry", "the_geom", "wkb", "shape")  # in files that do not say
_LOOKED_AT = 100  # geometries of a file without metadata
# GeoArrow's own encodings: kind of geometry, and how deep its lists nest.
_NESTED = {
    "point": (shapely.GeometryType.POINT, 0),
    "linestring": (shapely.GeometryType.LINESTRING, 1),
    "polygon": (shapely.GeometryType.POLYGON, 2),
    "multipoint": (shapely.GeometryType.MULTIPOINT, 1),
    "multilinestring": (shapely.GeometryType.MULTILINESTRING, 2),
    "multipolygon": (shapely.GeometryType.MULTIPOLYGON, 3),
}


@dataclass(frozen=True)
class GeometryColumn:
    """The column with the geometries."""

    name: str
    encoding: str  # ``"WKB"``, or one of GeoArrow: ``"polygon"`` and the like
    # None where the file says that it is unknown, or where it says nothing and coordinates are no degrees.
    crs: pyproj.CRS | None
    bbox: list[float] | None = None  # extent, as GeoParquet has it
    covering: dict[str, Any] | None = None  # columns with the bounding box of each feature, as GeoParquet has them
    notes: tuple[Note, ...] = ()  # what was assumed


def find_geometry(path: Path, table: Any) -> GeometryColumn:
    """Find the column with the geometries of a `pyarrow.parquet.ParquetFile`.

    Raises
    ------
    InputError
        If there is none that is known.

    References
    ----------
    GeoParquet 1.1, "Column metadata"; Apache Parquet, "Geospatial types"; GeoArrow 0.2, "Memory layout".
    """
    schema = table.schema_arrow
    geo = json.loads((schema.metadata or {}).get(b"geo", b"{}"))
    stated = geo.get("columns", {}).get(geo.get("primary_column", ""))
    if stated is not None:
        encoding = str(stated.get("encoding"))
        if encoding != "WKB" and encoding not in _NESTED:
            raise InputError(
                f"{path}: has geometries as {encoding}; write them as WKB, or convert the file to GPKG"
            )
        crs = stated.get("crs", LONGITUDE_LATITUDE)
        covering = stated.get("covering", {}).get("bbox")
        crs = None if crs is None else pyproj.CRS.from_user_input(crs)
        return GeometryColumn(geo["primary_column"], encoding, crs, stated.get("bbox"), covering)
    found = _by_parquet_type(table) or _by_arrow_type(schema) or _by_name(path, table)
    if found is None:
        raise InputError(
            f"{path}: has no column with geometries: neither metadata of GeoParquet nor a column of type "
            f"GEOMETRY, nor WKB in a column with a usual name ({', '.join(_NAMES)}); write it as GeoParquet, or "
            "convert it to GPKG"
        )
    return found


def read_geometry(column: Any, encoding: str) -> list[bytes | None]:
    """Give the geometries of a batch, a `pyarrow.Array` of some encoding, as well-known binary."""
    if encoding == "WKB":
        blobs: list[bytes | None] = column.to_pylist()
        return blobs
    import pyarrow as pa

    if not pa.types.is_nested(column.type):
        raise ValueError(f"a column of {column.type} is no {encoding} of GeoArrow")
    kind, depth = _NESTED[encoding]
    valid = np.flatnonzero(column.is_valid().to_numpy(zero_copy_only=False))
    lists, offsets = column.take(valid), list[NDArray[np.int64]]()
    for _ in range(depth):
        start = lists.offsets.to_numpy().astype(np.int64)
        offsets.insert(0, start - start[0])
        lists = lists.flatten()
    geometry = shapely.from_ragged_array(kind, _coordinates(lists), tuple(offsets) or None)
    found = np.full(len(column), None, np.object_)
    found[valid] = shapely.to_wkb(geometry, flavor="iso")
    return list(found)


def _coordinates(vertices: Any) -> NDArray[np.float64]:
    """Give the vertices of GeoArrow, of a column each or one behind the other, as rows of x, y and z."""
    import pyarrow as pa

    if pa.types.is_struct(vertices.type):
        names = [field.name for field in vertices.type if field.name in ("x", "y", "z")]
        sides = [vertices.field(name).to_numpy(zero_copy_only=False) for name in names]
        return np.ascontiguousarray(np.stack(sides, axis=1), np.float64)
    width = vertices.type.list_size
    flat = vertices.flatten().to_numpy(zero_copy_only=False).reshape(-1, width)
    has_z = width == 4 or (width == 3 and vertices.type.value_field.name != "xym")
    return np.ascontiguousarray(flat[:, : 3 if has_z else 2], np.float64)


def _by_parquet_type(table: Any) -> GeometryColumn | None:
    """Find a column of type GEOMETRY or GEOGRAPHY, the one with a usual name first."""
    found = {}
    for k in range(len(table.schema.names)):
        column = table.schema.column(k)
        kind = json.loads(column.logical_type.to_json())
        if kind.get("Type") in ("Geometry", "Geography") and "." not in column.path:
            found[column.path] = kind.get("crs") or LONGITUDE_LATITUDE
    if not found:
        return None
    name = next((name for name in _NAMES if name in found), next(iter(found)))
    return GeometryColumn(name, "WKB", _parse_crs(found[name], table.schema_arrow.metadata or {}))


def _parse_crs(text: str, metadata: dict[bytes, bytes]) -> pyproj.CRS:
    """Parse a CRS of Parquet: ``srid:`` and a code, ``projjson:`` and a key of the metadata, or any text."""
    if text.startswith("srid:"):
        return pyproj.CRS.from_epsg(int(text.removeprefix("srid:")))
    if text.startswith("projjson:"):
        text = metadata[text.removeprefix("projjson:").encode()].decode()
    return pyproj.CRS.from_user_input(json.loads(text) if text.startswith("{") else text)


def _by_arrow_type(schema: Any) -> GeometryColumn | None:
    for field in schema:
        metadata = field.metadata or {}
        kind = metadata.get(b"ARROW:extension:name", b"").decode().removeprefix("geoarrow.")
        if kind == "wkb" or kind in _NESTED:
            crs = json.loads(metadata.get(b"ARROW:extension:metadata") or b"{}").get("crs")
            encoding = "WKB" if kind == "wkb" else kind
            return GeometryColumn(field.name, encoding, None if crs is None else pyproj.CRS.from_user_input(crs))
    return None


def _by_name(path: Path, table: Any) -> GeometryColumn | None:
    """Find a column with WKB by its name; coordinates that may be degrees are taken for longitude and latitude."""
    import pyarrow as pa

    schema = table.schema_arrow
    lower = {
        field.name.lower(): field
        for field in schema
        if pa.types.is_binary(field.type) or pa.types.is_large_binary(field.type)
    }
    name = next((lower[name].name for name in _NAMES if name in lower), None)
    if name is None:
        return None
    part = next(table.iter_batches(_LOOKED_AT, columns=[name]), None)
    blobs = [] if part is None else [blob for blob in part.column(0).to_pylist() if blob is not None]
    geometry, _, _ = parse_wkb(np.array([*blobs, None], np.object_)[:-1])
    if blobs and all(shape is None for shape in geometry):
        return None
    sides = shapely.bounds(geometry).reshape(-1, 4)
    degrees = bool(len(sides)) and bool((np.nan_to_num(np.abs(sides)) <= (180, 90, 180, 90)).all())
    crs = pyproj.CRS.from_user_input(LONGITUDE_LATITUDE) if degrees else None
    taken = "longitude and latitude (OGC:CRS84), as its coordinates may be degrees" if degrees else "no CRS"
    detail = f"no metadata of GeoParquet: column {name} taken as geometry, with {taken}"
    return GeometryColumn(name, "WKB", crs, notes=(Note("footprints-without-metadata", path.name, detail=detail),))
