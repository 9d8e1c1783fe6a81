"""GeoPackage of features as 3DBAG delivers it: a layer for each level of detail, a row for each object."""

from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from tiler.cityinput.geopackage import IDS, OUTLINES, PART
from tiler.convert.features import Feature, Geometry, iter_features, level_text, origin_of
from tiler.convert.inputs import ModelSource
from tiler.formats.gpkg import Column, Kinds, fixed_time, make_column, write_rows
from tiler.georeference.crs import crs_text, horizontal_crs

# Others are lod12_3d, lod2_3d, ...
ID = IDS[0]
OWN = (*IDS, PART, "fid", "geom", "geometry")
BATCH = 2000  # features that are held at a time

Row = tuple[str, str, dict[str, Any], Any]  # id of the building, of its part, attributes, geometry


def write_gpkg(path: Path, source: ModelSource) -> None:
    """Write layers by level; columns `ID` of the building, `PART` of what the row is, and all attributes.

    Attributes of a part are those of its building, but for what it has itself. Kinds of faces have no place. The
    source is read twice: once for the types of attributes.
    """
    kinds: Kinds = {}
    for building in source.buildings():
        for own in building.attributes.values():
            for key, value in own.items():
                kinds.setdefault(key, set()).add(type(value))
    columns = _column_names(kinds)
    begun: set[str] = set()
    with fixed_time():
        waiting = iter_features(source)
        while features := list(islice(waiting, BATCH)):
            layers: dict[str, list[Row]] = {}
            for feature in features:
                for layer, row in _rows(feature, source):
                    layers.setdefault(layer, []).append(row)
            for layer, rows in layers.items():
                _append(path, layer, rows, kinds, (columns, source), append=layer in begun)
                begun.add(layer)


def _column_names(kinds: Kinds) -> dict[str, str]:
    """Name the column of each attribute: SQLite does not tell capital letters from small ones."""
    taken, found = set(OWN), {}
    for key in kinds:
        name = key
        while name.lower() in taken:
            name += "_"
        taken.add(name.lower())
        found[key] = name
    return found


def _rows(feature: Feature, source: ModelSource) -> Iterator[tuple[str, Row]]:
    places = feature.vertices * source.step + origin_of(source)
    house = feature.objects[0]
    for one in feature.objects:
        attributes = house.attributes | one.attributes
        for item in one.geometries:
            plan = item.lod < 1
            layer = OUTLINES if plan else f"lod{level_text(item.lod).replace('.', '')}_3d"
            yield layer, (house.id, one.id, attributes, _polygons(item, places[:, :2] if plan else places))


def _polygons(item: Geometry, places: Any) -> Any:
    faces = [
        shapely.Polygon(places[border], [places[ring] for ring in holes]) for _, (border, *holes) in item.faces
    ]
    return shapely.MultiPolygon(faces)


def _append(
    path: Path,
    layer: str,
    rows: list[Row],
    kinds: Kinds,
    names: tuple[dict[str, str], ModelSource],
    *,
    append: bool,
) -> None:
    columns, source = names
    found: dict[str, Column] = {
        ID: (np.array([row[0] for row in rows], np.object_), None),
        PART: (np.array([row[1] for row in rows], np.object_), None),
    }
    for key, name in columns.items():
        found[name] = make_column([row[2].get(key) for row in rows], kinds[key])
    flat = layer == OUTLINES
    crs = horizontal_crs(source.crs) if flat else source.crs
    write_rows(
        path,
        shapely.to_wkb(np.array([row[3] for row in rows], np.object_), flavor="iso"),
        found,
        layer=layer,
        crs=crs_text(crs) if crs is not None else None,
        kind="MultiPolygon" if flat else "MultiPolygon Z",
        append=append,
    )
