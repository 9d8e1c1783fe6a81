"""Boxes, circles, and areas of a file, in which cells are finer than in the rest of a region."""

import numpy as np
import pyproj
import shapely

from pipeline.data.errors import InputError
from tiler.config.config import Config, check_refinement
from tiler.config.zones import Zones
from tiler.footprints.plan_shapes import scan_shapes
from tiler.planning.lod_zones import make_shape
from tiler.planning.region import Region
from tiler.vectors.lengths import number_of

MOST_PLACES = 20_000  # vertices of all areas: every task has them
MOST_SIZES = 50  # different ones: each is looked up on its own

Refinements = tuple[tuple[float, str], ...]


def read_refinements(config: Config, region: Region, zones: Zones = ()) -> Refinements:
    """Read what is to be finer: size (m) and geometry, as well-known binary in hexadecimal digits, of each.

    Sorted, none twice, those of `zones` among them. Areas and lines of the file as they are, in the region's CRS,
    wherever they lie.

    Raises
    ------
    ConfigError
        If the file has no such attribute, or a size is out of bounds.
    InputError
        If the file cannot be read, has a feature without size or geometry, or too many vertices or sizes.
    """
    found = list(config.refinements_asked)
    areas = {(size, shapely.to_wkb(make_shape(*place), hex=True, byte_order=1)) for size, place in found}
    if config.refine_areas:
        areas |= _read_file(config, region)
    areas |= {(size, shape) for _, size, shape in zones if shape and size < config.mesh_size}
    n_places = int(shapely.get_num_coordinates(shapely.from_wkb([text for _, text in areas])).sum())
    n_sizes = len({size for size, _ in areas})
    if n_places > MOST_PLACES or n_sizes > MOST_SIZES:
        raise InputError(
            f"{config.refine_areas or 'zones'}: {n_places} vertices and {n_sizes} sizes to refine; at most "
            f"{MOST_PLACES} and {MOST_SIZES} are taken: simplify or dissolve the areas"
        )
    return tuple(sorted(areas))


def _read_file(config: Config, region: Region) -> set[tuple[float, str]]:
    areas: set[tuple[float, str]] = set()
    name = config.refine_attribute
    crs = pyproj.CRS.from_user_input(region.crs)
    shapes = scan_shapes(config.refine_areas, [name], "refine_areas", crs=crs, bounds=region.bounds)
    for subject, geometry, (value,) in shapes:
        size = number_of(value)
        if np.isnan(size):
            raise InputError(f"{subject}: has no {name}; mend or remove it")
        check_refinement(size, config.largest_size, subject)
        areas.add((size, shapely.to_wkb(geometry, hex=True, byte_order=1)))
    return areas
