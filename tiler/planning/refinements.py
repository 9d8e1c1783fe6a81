"""Boxes, circles, and areas of a file, in which cells are finer than in the rest of a region."""

from functools import partial
from pathlib import Path

import numpy as np
import pyproj
import shapely

from pipeline.data.errors import InputError
from tiler.config.config import Config, check_refinement, read_refinement
from tiler.footprints.footprint_attributes import known_attribute
from tiler.georeference.crs import horizontal_crs
from tiler.georeference.footprints import footprint_frame
from tiler.georeference.frame import Frame, to_region
from tiler.objects.places import is_missing, place
from tiler.planning.region import Region
from tiler.vectors.layers import describe_layer, scan_layer
from tiler.vectors.lengths import number_of

MOST_PLACES = 20_000  # vertices of all areas: every task has them
MOST_SIZES = 50  # different ones: each is looked up on its own

Refinements = tuple[tuple[float, str], ...]


def read_refinements(config: Config, region: Region) -> Refinements:
    """Read what is to be finer: size (m) and geometry, as well-known binary in hexadecimal digits, of each.

    Parameters
    ----------
    config : Config
        Parameters of the run.
    region : Region
        The region, in whose CRS geometries are given.

    Returns
    -------
    tuple of (float, str)
        Sorted, none twice. Areas and lines of the file as they are, wherever they lie.

    Raises
    ------
    ConfigError
        If the file has no such attribute, or a size is out of bounds.
    InputError
        If the file cannot be read, has a feature without size or geometry, or too many vertices or sizes.
    """
    found = [read_refinement(text, config.largest_size) for text in config.refine]
    areas = {(size, shapely.to_wkb(_make_shape(*place), hex=True, byte_order=1)) for size, place in found}
    if config.refine_areas:
        areas |= _read_file(place(config.refine_areas), config, region)
    n_places = int(shapely.get_num_coordinates(shapely.from_wkb([text for _, text in areas])).sum())
    n_sizes = len({size for size, _ in areas})
    if n_places > MOST_PLACES or n_sizes > MOST_SIZES:
        raise InputError(
            f"{config.refine_areas}: {n_places} vertices and {n_sizes} sizes to refine; at most {MOST_PLACES} and "
            f"{MOST_SIZES} are taken: simplify or dissolve the areas"
        )
    return tuple(sorted(areas))


def _make_shape(*place: float) -> shapely.Polygon:
    """Polygon of a box, or of a circle: 64 sides, vertices on whole millimetres, the same on any processor."""
    if len(place) == 4:
        return shapely.box(*place)
    x, y, radius = place
    return shapely.set_precision(shapely.Point(x, y).buffer(radius), 0.001, mode="pointwise")


def _read_file(path: Path, config: Config, region: Region) -> set[tuple[float, str]]:
    if is_missing(path):
        raise InputError(f"{path}: no such file; check the path of refine_areas")
    layer = describe_layer(path)
    name = known_attribute(layer, config.refine_attribute, {*layer.fields, layer.fid_name})
    own, crs = horizontal_crs(layer.crs), pyproj.CRS.from_user_input(region.crs)
    frame = Frame() if own is None else footprint_frame(own, crs, region.bounds)[0]
    areas: set[tuple[float, str]] = set()
    for features in scan_layer(layer, [name] if name else [], None):
        for fid, blob, value in zip(features.fids, features.wkb, features.columns[name], strict=True):
            size, subject = number_of(value), f"{path}: feature {fid}"
            if np.isnan(size) or blob is None:
                raise InputError(f"{subject}: has no {'geometry' if blob is None else name}; mend or remove it")
            check_refinement(size, config.largest_size, subject)
            geometry = shapely.force_2d(shapely.from_wkb(blob, on_invalid="fix"))
            if frame.changes_plan:
                geometry = shapely.transform(geometry, partial(to_region, frame))
            if not np.isfinite(shapely.get_coordinates(geometry)).all() or shapely.is_empty(geometry):
                raise InputError(f"{subject}: has no place in the region's CRS; mend or remove it")
            areas.add((size, shapely.to_wkb(geometry, hex=True, byte_order=1)))
    return areas
