"""Zones with a level of detail: circles, and polygons of vector files."""

from collections.abc import Callable

import numpy as np
import pyproj
import shapely

from pipeline.data.errors import InputError
from tiler.config.config import Config, check_blocks
from tiler.config.zones import LEVELS, Zones, check_level, check_size
from tiler.footprints.plan_shapes import scan_shapes
from tiler.georeference.crs import crs_name
from tiler.objects.places import place
from tiler.planning.region import Region
from tiler.stages.blocks import LAYERS
from tiler.vectors.layers import describe_layer
from tiler.vectors.lengths import number_of

MOST_ZONES = 1000  # every task has them


def read_zones(config: Config, region: Region, say: Callable[[str], None] = lambda _: None) -> Zones:
    """Read the zones of a run, in the region's CRS, and the level of the rest; none without zones.

    The finest level first, the rest last; places as they are, wherever they lie. `say` is told of files without a
    CRS.

    Raises
    ------
    ConfigError
        If a level or a size is out of bounds, or takes blocks that are not given.
    InputError
        If a file cannot be read, has features without level, size or area, or too many.
    """
    if not config.zoned:
        return ()
    asked = config.zones_asked
    zones = {
        (circle.level, circle.size, shapely.to_wkb(make_shape(*circle.place), hex=True, byte_order=1))
        for circle in asked.circles
    }
    for name in asked.files:
        crs = pyproj.CRS.from_user_input(region.crs)
        shapes = scan_shapes(name, ["level", "size"], "lod_zones", crs=crs, bounds=region.bounds, say=say)
        for subject, geometry, (level, value) in shapes:
            size = number_of(value)
            if np.isnan(size) or level is None or not geometry.area > 0:
                raise InputError(f"{subject}: a level, a size in metres and an area expected; mend or remove it")
            check_size(size, config.mesh_size, subject)
            check_blocks([check_level(str(level).strip(), subject)], config, subject)
            zones.add((str(level).strip(), size, shapely.to_wkb(geometry, hex=True, byte_order=1)))
    if len(zones) > MOST_ZONES:
        raise InputError(
            f"{len(zones)} zones; at most {MOST_ZONES} are taken: dissolve those of one level and size"
        )
    return (*sorted(zones, key=lambda zone: (LEVELS.index(zone[0]), *zone)), (asked.rest, config.mesh_size, ""))


def describe_absent(zones: Zones, region: Region) -> list[str]:
    """Tell of zones that lie outside of the region: a part of a larger one, or coordinates that are wrong."""
    shapes = shapely.from_wkb([place for _, _, place in zones if place])
    absent = shapes[~shapely.intersects(shapes, shapely.box(*region.bounds))]
    if not len(absent):
        return []
    x, y = shapely.get_coordinates(shapely.centroid(absent[:1]))[0].tolist()
    return [
        f"{len(absent)} of {len(shapes)} zones lie outside of the region, the first one at {x:.10g}, {y:.10g}: "
        f"no cell or building has their level; are x and y those of {crs_name(pyproj.CRS(region.crs))}?"
    ]


def check_generalised(config: Config, zones: Zones) -> None:
    """Refuse a file of blocks that has not the layers which the zones take; InputError."""
    if config.generalised and {level for level, _, _ in zones} & LAYERS.keys():
        for layer in ("cells", *LAYERS.values()):
            describe_layer(place(config.generalised), layer)


def make_shape(*numbers: float) -> shapely.Polygon:
    """Polygon of a box, or of a circle: 64 sides, vertices on whole millimetres, the same on any processor."""
    if len(numbers) == 4:
        return shapely.box(*numbers)
    x, y, radius = numbers
    return shapely.set_precision(shapely.Point(x, y).buffer(radius), 0.001, mode="pointwise")
