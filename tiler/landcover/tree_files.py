"""Trees of vector files: crowns, or positions with a width, as rows for the store."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyproj
import shapely
from numpy.typing import NDArray

from pipeline.data.citymodel import Footprints, make_ids
from pipeline.data.notes import Note
from pipeline.data.roof_forms import no_forms
from tiler.footprints.footprint_index import FootprintBlock, block_footprints, no_footprints
from tiler.footprints.footprint_source import is_finite
from tiler.georeference.frame import shapes_to_region
from tiler.landcover.cover_files import open_file
from tiler.vectors.features import Box, Features
from tiler.vectors.layers import scan_layer
from tiler.vectors.lengths import metres_of

HEIGHT, BASE, WIDTH = "height", "base", "crown"  # attributes (m): of the top and of the crown's foot above ground
CROWN = 6.0  # m; width of the crown of a position that states none
BASE_COLUMN = 0  # of `Footprints.forms`, which has room for numbers of a row
AREAS = (shapely.GeometryType.POLYGON, shapely.GeometryType.MULTIPOLYGON)


def scan_trees(path: Path, *, crs: pyproj.CRS, bounds: Box) -> Iterator[FootprintBlock]:
    """Read the trees of a vector file of polygons or points that meet a box of the region (m), by batches.

    Gives crowns; heights are those of the tops above ground (m), NaN where the file states none, and the first
    column of forms has the feet of the crowns. InputError if the file cannot be read.
    """
    hint = f'trees: ogr2ogr -where "other_tags like \'%natural"=>"tree%\'" trees.gpkg {path.name} points'
    source = open_file(path, "trees", hint, crs=crs, bounds=bounds)
    names = [name for name in (HEIGHT, BASE, WIDTH) if name in source.layer.fields]
    left = 0
    for features in scan_layer(source.layer, names, source.box):
        there = np.flatnonzero([blob is not None for blob in features.wkb])
        shapes = shapely.force_2d(shapely.from_wkb(features.wkb[there], on_invalid="fix"))
        shapes = shapes_to_region(source.frame, shapes)
        height, base, width = (_lengths(features, name)[there] for name in (HEIGHT, BASE, WIDTH))
        kind = shapely.get_type_id(shapes)
        points = kind == shapely.GeometryType.POINT
        radius = np.where(np.isfinite(width) & (width > 0), width, CROWN)[points] / 2
        shapes[points] = shapely.buffer(shapes[points], radius, quad_segs=4)
        usable = is_finite(shapes) & (points | np.isin(kind, AREAS)) & ~(height <= 0)
        left += len(features.wkb) - int(usable.sum())
        shapes[~usable] = None
        kept = usable & shapely.intersects(shapes, shapely.box(*bounds))
        parts, owner = shapely.get_parts(shapely.normalize(shapes[kept]), return_index=True)
        forms = no_forms(len(parts))
        forms[:, BASE_COLUMN] = base[kept][owner]
        yield block_footprints(Footprints(parts, make_ids(parts), height[kept][owner], forms), [])
    if left:
        note = Note("trees-left-out", path.name, detail=f"{left} features are no area or point, or have no height")
        yield no_footprints([note])


def _lengths(features: Features, name: str) -> NDArray[np.float64]:
    values = features.columns.get(name)
    if values is None:
        return np.full(len(features.wkb), np.nan)
    return np.array([metres_of(value) for value in values], np.float64)
