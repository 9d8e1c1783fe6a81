"""Roads, railways, water and other objects of vector files, by batches in the region's CRS."""

from collections.abc import Iterator

import numpy as np
import pyproj
import shapely
from numpy.typing import NDArray

from pipeline.data.errors import InputError
from tiler.footprints.footprint_source import is_finite
from tiler.footprints.plan_shapes import open_shapes
from tiler.generalisation.summary import Told
from tiler.georeference.frame import box_to_file, shapes_to_region
from tiler.vectors.features import Box
from tiler.vectors.layers import scan_layer
from tiler.vectors.wkb import parse_wkb

BATCH = 20_000  # features in memory at once
HINT = (
    "of an extract of OpenStreetMap buildings alone are read; make files of its lines and areas: ogr2ogr "
    'roads.gpkg {0} lines -where "highway IS NOT NULL", ogr2ogr water.gpkg {0} multipolygons -where '
    "\"natural = 'water'\""
)


def scan_geometries(
    text: str, option: str, *, crs: pyproj.CRS, around: Box, bounds: Box | None, told: Told
) -> Iterator[NDArray[np.object_]]:
    """Read lines and polygons of a vector file, without Z, in metres: object (n,) each time.

    Parameters
    ----------
    text, option, crs
        As of `open_shapes`.
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
        If it has several layers and none is named.
    """
    layer, frame = open_shapes(text, option, crs=crs, box=bounds or around, say=told.say)
    path = layer.path
    if layer.gdal is not None and layer.gdal.driver == "OSM":
        raise InputError(f"{path}: {HINT.format(path.name)}")
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
