"""Geometries of a vector layer in plan, in a region's CRS, with some attributes."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import shapely

from pipeline.data.errors import InputError
from tiler.footprints.footprint_attributes import known_attribute
from tiler.georeference.crs import horizontal_crs
from tiler.georeference.footprints import footprint_frame
from tiler.georeference.frame import Frame, shapes_to_region
from tiler.objects.places import is_missing
from tiler.vectors.features import Box
from tiler.vectors.layers import describe_layer, scan_layer


def scan_shapes(
    path: Path, names: Sequence[str], option: str, *, crs: pyproj.CRS, bounds: Box, layer: str = ""
) -> Iterator[tuple[str, shapely.Geometry, list[Any]]]:
    """Read the features of a vector layer, one after the other.

    Parameters
    ----------
    path : Path
        The file.
    names : sequence of str
        Attributes.
    option : str
        Name of the option that names the file, for messages.
    crs, bounds
        CRS of the region, and its box (m).
    layer : str
        Name of the layer; by default the only one.

    Yields
    ------
    tuple of str, Geometry, list
        What to call the feature in a message; without Z, in the region's CRS, wherever it lies; its values of the
        attributes.

    Raises
    ------
    ConfigError
        If the file has no such layer or attribute.
    InputError
        If the file cannot be read, or has a feature without geometry.
    """
    if is_missing(path):
        raise InputError(f"{path}: no such file; check the path of {option}")
    source = describe_layer(path, layer)
    columns = [known_attribute(source, name, {*source.fields, source.fid_name}) for name in names]
    own = horizontal_crs(source.crs)
    frame = Frame() if own is None else footprint_frame(own, crs, bounds)[0]
    for features in scan_layer(source, columns, None):
        values = zip(*(features.columns[name] for name in columns), strict=True)
        for fid, blob, row in zip(features.fids, features.wkb, values, strict=True):
            subject = f"{path}: feature {fid}" + (f" of layer {layer}" if layer else "")
            if blob is None:
                raise InputError(f"{subject}: has no geometry; mend or remove it")
            geometry = shapes_to_region(frame, shapely.force_2d(shapely.from_wkb(blob, on_invalid="fix")))
            if not np.isfinite(shapely.get_coordinates(geometry)).all() or shapely.is_empty(geometry):
                raise InputError(f"{subject}: has no place in the region's CRS; mend or remove it")
            yield subject, geometry, list(row)
