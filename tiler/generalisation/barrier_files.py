"""Roads, railways, water and other objects of vector files, by batches in the region's CRS."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyproj
import shapely
from numpy.typing import NDArray

from pipeline.data.errors import ConfigError, InputError
from tiler.footprints.footprint_source import is_finite
from tiler.generalisation.summary import Told
from tiler.georeference.crs import horizontal_crs
from tiler.georeference.footprints import footprint_frame
from tiler.georeference.frame import Frame, box_to_file, shapes_to_region
from tiler.objects.places import is_missing
from tiler.vectors.features import Box
from tiler.vectors.layers import Layer, describe_layer, scan_layer
from tiler.vectors.wkb import parse_wkb

BATCH = 20_000  # features in memory at once
HINT = (
    "of an extract of OpenStreetMap buildings alone are read; make files of its lines and areas: ogr2ogr "
    'roads.gpkg {0} lines -where "highway IS NOT NULL", ogr2ogr water.gpkg {0} multipolygons -where '
    "\"natural = 'water'\""
)


def scan_geometries(
    path: Path, *, crs: pyproj.CRS, around: Box, bounds: Box | None, told: Told
) -> Iterator[NDArray[np.object_]]:
    """Read lines and polygons of a vector file with one layer, without Z, in metres: object (n,) each time.

    Parameters
    ----------
    path, crs
        The file, and the CRS of the region.
    around : tuple of 4 floats
        Where the buildings are (m): it tells which reprojection is best.
    bounds : tuple of 4 floats, optional
        Lines and polygons are cut at this box (m).
    told : Told
        What is left out or assumed is counted here.

    Raises
    ------
    InputError
        If the file cannot be read, or is an extract of OpenStreetMap.
    ConfigError
        If it has several layers.
    """
    if is_missing(path):
        raise InputError(f"{path}: no such file; check the path")
    try:
        layer = describe_layer(path)
    except ConfigError as error:  # several layers
        raise ConfigError(f"{error}; make a file of it: ogr2ogr one.gpkg {path.name} LAYER") from None
    if layer.gdal is not None and layer.gdal.driver == "OSM":
        raise InputError(f"{path}: {HINT.format(path.name)}")
    own = horizontal_crs(layer.crs)
    if own is None:
        told.say(f"{path.name}: states no CRS, taken in that of the buildings")
    frame = Frame() if own is None else footprint_frame(own, crs, bounds or around)[0]
    box = None if bounds is None else box_to_file(frame, bounds)
    for features in scan_layer(layer, [], box, batch=BATCH):
        geometry, _, broken = parse_wkb(features.wkb)
        told.counts[f"features of {path.name} that cannot be read"] += len(broken | features.broken)
        geometry = shapely.force_2d(geometry[~shapely.is_missing(geometry)])
        geometry = shapes_to_region(frame, geometry)
        taken = is_finite(geometry) & ~shapely.is_empty(geometry) & (shapely.get_dimensions(geometry) > 0)
        left = f"points and features without a place in {path.name}, left out: lines or areas are taken"
        told.counts[left] += int((~taken).sum())
        geometry = geometry[taken]
        if bounds is not None:
            wrong = ~shapely.is_valid(geometry)
            geometry[wrong] = shapely.make_valid(geometry[wrong])
            geometry = shapely.intersection(geometry, shapely.box(*bounds))
            geometry = geometry[~shapely.is_empty(geometry)]
        if len(geometry):
            yield geometry


def extent_of(layer: Layer) -> Box:
    """Read a layer for its extent, in its own CRS; InputError if it has none."""
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for features in scan_layer(layer, [], None, batch=BATCH):
        limits = shapely.bounds(parse_wkb(features.wkb)[0]).reshape(-1, 4)
        limits = limits[np.isfinite(limits).all(axis=1)]
        low = np.minimum(low, limits[:, :2].min(axis=0, initial=np.inf))
        high = np.maximum(high, limits[:, 2:].max(axis=0, initial=-np.inf))
    if not np.isfinite([*low, *high]).all():
        raise InputError(f"{layer.path}: has no feature with a place; give another file")
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])
