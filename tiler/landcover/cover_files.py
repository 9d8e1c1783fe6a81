"""Polygons of land cover in vector files, as rows for the store."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import pyproj
import shapely
from numpy.typing import NDArray

from pipeline.data.citymodel import Footprints, make_ids
from pipeline.data.errors import InputError
from pipeline.data.notes import Note
from tiler.footprints.footprint_attributes import known_attribute
from tiler.footprints.footprint_index import FootprintBlock, block_footprints, no_footprints
from tiler.footprints.footprint_source import FootprintSource, is_finite, open_source
from tiler.footprints.plan_outlines import outline_all
from tiler.georeference.frame import shapes_to_region
from tiler.landcover.cover_table import class_word
from tiler.objects.places import is_missing
from tiler.vectors.features import Box, Features
from tiler.vectors.layers import scan_layer
from tiler.vectors.lengths import number_of

LEVEL = "level"  # attribute with the height of water (m), where a file has it
MOST_WORDS = 10  # unknown classes that a note names


def scan_cover(
    path: Path, *, crs: pyproj.CRS, bounds: Box, field: str, rows: Mapping[str, int], tolerance: float
) -> Iterator[FootprintBlock]:
    """Read the polygons of a vector file that meet a box, by batches.

    Parameters
    ----------
    path, crs, bounds
        The file; CRS of the region, and its box (m).
    field : str
        Attributes with the class, with commas between them.
    rows : mapping of str to int
        Row of the table of each class, from 1.
    tolerance : float
        Outlines are simplified by this (m).

    Yields
    ------
    FootprintBlock
        Ids begin with the row in three digits, so that sorted ids are in the order of rows; heights are levels of
        water (m), NaN where a file states none.

    Raises
    ------
    InputError
        If the file cannot be read.
    ConfigError
        If it has none of the attributes.
    """
    hint = (
        f"areas: ogr2ogr cover.gpkg {path.name} multipolygons, and give --land-cover-field natural,landuse,leisure"
    )
    source = open_file(path, "land_cover", hint, crs=crs, bounds=bounds)
    known = {*source.layer.fields, source.layer.fid_name}
    asked = [name.strip() for name in field.split(",")]
    names = [name for name in asked if name in known] or [known_attribute(source.layer, asked[0], known)]
    level = [LEVEL] if LEVEL in source.layer.fields else []
    counts: Counter[str] = Counter()
    unknown: Counter[str] = Counter()
    columns = [name for name in (*names, *level) if name]
    for features in scan_layer(source.layer, columns, source.box):
        of_feature = _find_rows(features, names, rows, unknown)
        outlines = outline_all(features.wkb, metre=source.layer.metre, curved=features.curved)
        counts["land-cover-no-polygon"] += len(features.wkb) - len(outlines.rows)
        geometry = shapes_to_region(source.frame, outlines.geometry)
        finite = is_finite(geometry)
        counts["land-cover-no-polygon"] += int((~finite).sum())
        kept = finite & (of_feature[outlines.rows] > 0)
        levels = np.full(len(features.wkb), np.nan)
        if level:
            levels = np.array([number_of(value) for value in features.columns[LEVEL]], np.float64)
        rows_kept = outlines.rows[kept]
        yield _block(geometry[kept], of_feature[rows_kept], levels[rows_kept], bounds, tolerance)
    notes = [Note(kind, path.name, detail=f"{n} features") for kind, n in counts.items() if n]
    if unknown:
        words = ", ".join(f"{word} ({n})" for word, n in unknown.most_common(MOST_WORDS))
        detail = f"{sum(unknown.values())} polygons of {len(unknown)} classes: {words}"
        notes.append(Note("land-cover-unknown-class", path.name, detail=detail))
    yield no_footprints(notes)


def open_file(path: Path, parameter: str, hint: str, *, crs: pyproj.CRS, bounds: Box) -> FootprintSource:
    """Open a vector file that a parameter names; InputError where it is missing, or an extract of OpenStreetMap.

    `hint` says how areas or trees of an extract are made into a file.
    """
    if is_missing(path):
        raise InputError(f"{path}: no such file; check the path of {parameter}")
    source = open_source(path, crs=crs, bounds=bounds)
    if source.layer.gdal is not None and source.layer.gdal.driver == "OSM":
        raise InputError(
            f"{path}: of an extract of OpenStreetMap tags of buildings alone are read; make a file of its {hint}"
        )
    return source


def _find_rows(
    features: Features, names: Sequence[str], rows: Mapping[str, int], unknown: Counter[str]
) -> NDArray[np.int64]:
    """Row of the table of each feature, 0 for none; what the table does not know is counted."""
    found = np.zeros(len(features.wkb), np.int64)
    for k in range(len(found)):
        words = [word for name in names if name and (word := class_word(features.columns[name][k]))]
        found[k] = next((rows[word] for word in words if word in rows), 0)
        if words and not found[k]:
            unknown[words[0]] += 1
    return found


def _block(
    geometry: NDArray[np.object_],
    row: NDArray[np.int64],
    level: NDArray[np.float64],
    bounds: Box,
    tolerance: float,
) -> FootprintBlock:
    """Mend, simplify and name polygons that meet the region; one of several parts becomes several."""
    parts, owner = shapely.get_parts(shapely.make_valid(geometry), return_index=True)
    parts, again = shapely.get_parts(shapely.simplify(parts, tolerance), return_index=True)
    owner = owner[again]
    kept = shapely.get_type_id(parts) == shapely.GeometryType.POLYGON
    kept &= ~shapely.is_empty(parts) & shapely.intersects(parts, shapely.box(*bounds))
    parts, owner = shapely.normalize(parts[kept]), owner[kept]
    ids = np.array([f"{r:03d}-{name}" for r, name in zip(row[owner], make_ids(parts), strict=True)], np.str_)
    return block_footprints(Footprints(parts, ids, level[owner]), [])
