"""Buildings of GeoPackages as 3DBAG delivers them: a layer of polygons in space for each level of detail."""

import re
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from itertools import groupby, islice
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.data.errors import InputError
from tiler.cityinput.faces import NO_LOD, OUTLINE, UNKNOWN, Faces, ModelBuilding, Shape, check_places
from tiler.vectors.features import to_objects
from tiler.vectors.gdal_layer import quote
from tiler.vectors.wkb import parse_wkb, strip_header

SIGNATURE = b"SQLite format 3\0"
IDS = ("identificatie", "gml_id", "building_id", "id")  # columns with a building's id, the first that is there
OUTLINES = "pand"  # layer with outlines in plan
PART = "part"  # column with the id of the part that a row is, where it is one
BATCH = 500  # buildings whose geometries are parsed at a time
_LEVEL = re.compile(r"lod(\d)(\d)?_3d")


@dataclass(frozen=True)
class _Layer:
    """A table with geometries: the columns of these and of ids, its level, and the name of its CRS."""

    table: str
    geometry: str
    id: str
    lod: float
    crs: str


def scan_geopackage(path: Path, *, attributes: bool = False) -> Iterator[str | ModelBuilding]:
    """Give the name of the CRS, and the buildings by ascending id.

    Layers ``lod12_3d``, ``lod13_3d`` and ``lod22_3d`` have the level of their name, ``pand`` that of outlines;
    other layers in space have none. Rows of one id are one building. With `attributes` columns are read: of each
    the first value of its rows.

    Raises
    ------
    InputError
        If the file has no such layer, or cannot be read.
    """
    try:
        with closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro&immutable=1", uri=True)) as base:
            layers = _list_layers(path, base)
            yield layers[0].crs
            rows = _list_rows(base, layers)
            buildings = (
                (name, [(layer, number) for _, layer, number in group])
                for name, group in groupby(rows, key=lambda row: row[0])
            )
            while batch := list(islice(buildings, BATCH)):
                yield from _read_batch(base, layers, batch, attributes)
    except sqlite3.Error as error:
        raise InputError(f"{path}: cannot be read as a GeoPackage ({error}); copy it again") from error


def _list_layers(path: Path, base: sqlite3.Connection) -> list[_Layer]:
    found = []
    query = (
        "SELECT g.table_name, g.column_name, g.z, s.organization, s.organization_coordsys_id "
        "FROM gpkg_geometry_columns g LEFT JOIN gpkg_spatial_ref_sys s ON s.srs_id = g.srs_id ORDER BY 1"
    )
    for table, column, z, organization, code in base.execute(query).fetchall():
        columns = {row[1].lower(): row[1] for row in base.execute(f"PRAGMA table_info({quote(table)})")}
        level = _LEVEL.fullmatch(table.lower())
        name = next((columns[one] for one in IDS if one in columns), "")
        outline = table.lower() == OUTLINES
        if not name or not (z or outline):
            continue
        lod = float(f"{level[1]}.{level[2] or 0}") if level else 0.0 if outline else NO_LOD
        crs = f"{organization.upper()}:{code}" if organization and int(code) > 0 else ""
        found.append(_Layer(table, column, name, lod, crs))
    if not any(layer.lod for layer in found):
        raise InputError(
            f"{path}: has no layer of polygons in space with ids ({', '.join(IDS)}); footprints are taken by "
            "--footprints"
        )
    return found


def _list_rows(base: sqlite3.Connection, layers: list[_Layer]) -> Iterator[tuple[str, int, int]]:
    """Id, layer and row of all geometries, by id; it is these that the database sorts."""
    parts = [
        f"SELECT CAST({quote(layer.id)} AS TEXT), {k}, rowid FROM {quote(layer.table)} "
        f"WHERE {quote(layer.id)} IS NOT NULL AND {quote(layer.geometry)} IS NOT NULL"
        for k, layer in enumerate(layers)
    ]
    yield from base.execute(" UNION ALL ".join(parts) + " ORDER BY 1, 2, 3")


def _read_batch(
    base: sqlite3.Connection,
    layers: list[_Layer],
    batch: list[tuple[str, list[tuple[int, int]]]],
    all_columns: bool,
) -> Iterator[ModelBuilding]:
    blobs, faults = [], list[str]()
    values: dict[str, dict[str, dict[str, Any]]] = {}
    owners = list[str]()
    for name, rows in batch:
        for layer, number in rows:
            one = layers[layer]
            columns = "*" if all_columns else quote(one.geometry)
            found = base.execute(f"SELECT {columns} FROM {quote(one.table)} WHERE rowid = ?", (number,))
            row = dict(zip((column[0] for column in found.description), found.fetchone(), strict=True))
            stripped, fault = strip_header(row.pop(one.geometry))
            owners.append(str(row.pop(PART, None) or name))
            known = values.setdefault(name, {}).setdefault(owners[-1], {})
            for key, value in row.items():
                if key not in (one.id, "fid", "ogc_fid") and value is not None and not isinstance(value, bytes):
                    known.setdefault(key, value)
            blobs.append(stripped)
            faults.append(fault)
    geometry, _, broken = parse_wkb(to_objects(blobs))
    k = 0
    for name, rows in batch:
        shapes, told = [], []
        for layer, _ in rows:
            lod = layers[layer].lod
            if geometry[k] is None:
                told.append(f"a geometry of {layers[layer].table}: {faults[k] or broken.get(k, 'is empty')}")
            else:
                try:
                    faces = _make_faces(geometry[k], OUTLINE if lod == 0 else UNKNOWN)
                    shapes.append(Shape(owners[k], lod, lod > 0, faces))
                except ValueError as error:
                    told.append(f"a geometry of {layers[layer].table}: {error}")
            k += 1
        yield ModelBuilding(name, tuple(shapes), faults=tuple(told), attributes=values[name])


def _make_faces(geometry: shapely.Geometry, kind: int) -> Faces:
    parts = np.array([geometry], object)
    while (shapely.get_type_id(parts) > shapely.GeometryType.POLYGON).any():
        parts = shapely.get_parts(parts)
    parts = parts[(shapely.get_type_id(parts) == shapely.GeometryType.POLYGON) & ~shapely.is_empty(parts)]
    rings, part = shapely.get_rings(parts, return_index=True)
    xyz, ring = shapely.get_coordinates(rings, include_z=True, return_index=True)
    last = np.append(ring[1:] != ring[:-1], True) if len(ring) else np.zeros(0, np.bool_)
    xyz, ring = xyz[~last], ring[~last]
    xyz[np.isnan(xyz[:, 2]), 2] = 0.0  # in plan alone
    ring_start: NDArray[np.int64] = np.searchsorted(ring, np.arange(len(rings) + 1))
    return Faces(
        check_places(xyz),
        ring_start,
        np.searchsorted(part, np.arange(len(parts) + 1)),
        np.full(len(parts), kind, np.int8),
    )
