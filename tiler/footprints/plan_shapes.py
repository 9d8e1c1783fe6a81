"""Geometries of a vector layer in plan, in a region's CRS, with some attributes."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import pyproj
import shapely

from pipeline.data.errors import ConfigError, InputError
from tiler.footprints.footprint_attributes import known_attribute
from tiler.footprints.footprint_source import check_extent
from tiler.georeference.crs import crs_name, horizontal_crs
from tiler.georeference.footprints import footprint_frame
from tiler.georeference.frame import Frame, shapes_to_region
from tiler.objects.places import is_missing, place
from tiler.vectors.features import Box
from tiler.vectors.layers import Layer, describe_layer, scan_layer, split_layer
from tiler.vectors.wkb import parse_wkb

BATCH = 20_000  # features in memory at once


def open_shapes(
    text: str, option: str, *, crs: pyproj.CRS, box: Box, say: Callable[[str], None]
) -> tuple[Layer, Frame]:
    """Open a vector file that an option names, as ``FILE`` or ``FILE:LAYER``.

    Parameters
    ----------
    text, option : str
        The file, and the option, for messages.
    crs, box
        CRS of the region, and a box of it (m), which tells which reprojection is best.
    say : callable
        Told what is assumed: a file without a CRS is taken in that of the region.

    Returns
    -------
    Layer, Frame
        The layer, and how its coordinates become those of the region.

    Raises
    ------
    ConfigError
        If it has several layers and none is named, or not the named one.
    InputError
        If it is missing or damaged, or its coordinates are no degrees, as those of GeoJSON without a CRS must be.
    """
    name, chosen = split_layer(text)
    path = place(name)
    if is_missing(path):
        raise InputError(f"{path}: no such file; check the path of {option}")
    try:
        layer = describe_layer(path, chosen)
    except ConfigError as error:
        raise ConfigError(f"{error}; write {option} = {name}:LAYER") from None
    own = horizontal_crs(layer.crs)
    if own is not None and own.is_geographic:
        check_extent(layer.path, find_extent(layer), own)
    if own is None:
        say(f"{path.name}: states no CRS, taken as {crs_name(crs)}")
    return layer, Frame() if own is None else footprint_frame(own, crs, box)[0]


def find_extent(layer: Layer) -> Box | None:
    """Give the extent of a layer in its own CRS, which is read for it where it states none; None if empty."""
    if layer.extent is not None:
        return layer.extent
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for features in scan_layer(layer, [], None, batch=BATCH):
        limits = shapely.bounds(parse_wkb(features.wkb)[0]).reshape(-1, 4)
        limits = limits[np.isfinite(limits).all(axis=1)]
        low = np.minimum(low, limits[:, :2].min(axis=0, initial=np.inf))
        high = np.maximum(high, limits[:, 2:].max(axis=0, initial=-np.inf))
    return (
        (float(low[0]), float(low[1]), float(high[0]), float(high[1]))
        if np.isfinite([*low, *high]).all()
        else None
    )


def scan_shapes(
    text: str,
    names: Sequence[str],
    option: str,
    *,
    crs: pyproj.CRS,
    bounds: Box,
    say: Callable[[str], None] = lambda _: None,
) -> Iterator[tuple[str, shapely.Geometry, list[Any]]]:
    """Read the features of a vector layer, one after the other.

    Parameters
    ----------
    text : str
        ``FILE`` or ``FILE:LAYER``.
    names : sequence of str
        Attributes.
    option : str
        Name of the option that names the file, for messages.
    crs, bounds
        CRS of the region, and its box (m).
    say : callable
        As of `open_shapes`.

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
    source, frame = open_shapes(text, option, crs=crs, box=bounds, say=say)
    columns = [known_attribute(source, name, {*source.fields, source.fid_name}) for name in names]
    for features in scan_layer(source, columns, None):
        values = zip(*(features.columns[name] for name in columns), strict=True)
        for fid, blob, row in zip(features.fids, features.wkb, values, strict=True):
            subject = f"{source.path}: feature {fid}" + (
                f" of layer {source.name}" if split_layer(text)[1] else ""
            )
            if blob is None:
                raise InputError(f"{subject}: has no geometry; mend or remove it")
            geometry = shapes_to_region(frame, shapely.force_2d(shapely.from_wkb(blob, on_invalid="fix")))
            if not np.isfinite(shapely.get_coordinates(geometry)).all() or shapely.is_empty(geometry):
                raise InputError(f"{subject}: has no place in the region's CRS; mend or remove it")
            yield subject, geometry, list(row)
