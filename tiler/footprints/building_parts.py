"""Parts of buildings of OpenStreetMap (``building:part``): what they and the outline around them keep (step 1.2).

By Simple 3D Buildings the parts of a building stand for it where there are any, and its outline does not. Here
every place has one footprint: that of the highest part over it, else that of the outline.
"""

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from tiler.footprints.footprint_attributes import height_columns, read_heights
from tiler.footprints.plan_outlines import outline_all
from tiler.georeference.frame import Frame, box_to_file, shapes_to_region
from tiler.vectors.features import Box
from tiler.vectors.layers import BATCH, Layer, scan_layer
from tiler.vectors.osm_tags import is_part

REACH = 500.0  # m beyond the region within which parts are looked for: of buildings that stand on its border
OWN_SHARE = 0.5  # share of a part that lies within the outline of its building
LEAST_AREA, LEAST_WIDTH = 4.0, 0.5  # m2 and m, of a piece of a footprint that is kept
SEEN = 0.01  # m2, of an overlap
Rank = tuple[float, float, bytes]


@dataclass(frozen=True, eq=False)
class BuildingParts:
    """The parts of buildings in a file."""

    polygons: NDArray[np.object_]  # (n,): valid Polygons and MultiPolygons in the region's CRS (m)
    area: NDArray[np.float64]  # (n,): their areas (m²)
    # The lower rank is seen from above where two parts overlap: that of the greater height, then, without a height
    # or of the same, of the smaller area.
    ranks: list[Rank]
    tree: shapely.STRtree  # of the polygons


@dataclass(frozen=True, eq=False)
class Shares:
    """What footprints keep beside the parts of buildings over them."""

    geometry: NDArray[np.object_]  # (k,): polygons and MultiPolygons; empty where nothing is left
    share: NDArray[np.float64]  # (k,): share of the area that is left; 1 where nothing was taken


def find_building_parts(
    layer: Layer, frame: Frame, bounds: Box, *, height_name: str, batch: int = BATCH
) -> BuildingParts | None:
    """Read the parts of buildings in and around a region; None where there is none, or data are not of OSM.

    Parameters
    ----------
    layer, batch
        As of `scan_layer`.
    frame : Frame
        How coordinates of the file become those of the region.
    bounds : tuple of 4 floats
        The region (m), in its own CRS.
    height_name : str
        Attribute with heights, as of `read_heights`.

    Notes
    -----
    A pass through the region of its own, as a part may stand in the file before or after its outline. Memory holds
    all parts of the region.
    """
    tags = layer.tags
    if tags is None or not (tags.more or "building:part" in tags.column):
        return None
    near = bounds[0] - REACH, bounds[1] - REACH, bounds[2] + REACH, bounds[3] + REACH
    box = box_to_file(frame, near)
    shapes, heights = [np.empty(0, np.object_)], [np.empty(0)]
    for features in scan_layer(layer, height_columns(layer, height_name), box, batch=batch):
        hits = np.flatnonzero(is_part(tags, features.columns))
        curved = frozenset(np.flatnonzero(np.isin(hits, list(features.curved))).tolist())
        outlines = outline_all(features.wkb[hits], metre=layer.metre, curved=curved)
        geometry = outlines.geometry
        finite = np.isfinite(shapely.bounds(geometry).reshape(-1, 4)).all(axis=1)
        shapes.append(mend_polygons(shapes_to_region(frame, geometry)[finite]))
        heights.append(read_heights(layer, height_name, features)[0][hits[outlines.rows[finite]]])
    polygons = np.concatenate(shapes)
    if not len(polygons):
        return None
    ranks = _rank(polygons, np.concatenate(heights))
    return BuildingParts(polygons, shapely.area(polygons), ranks, shapely.STRtree(polygons))


def share_places(
    parts: BuildingParts, geometry: NDArray[np.object_], is_one: NDArray[np.bool_], height: NDArray[np.float64]
) -> Shares:
    """Take from footprints what belongs to parts of buildings: each place belongs to one footprint.

    Parameters
    ----------
    geometry : object, (k,)
        Polygons and MultiPolygons of the file.
    is_one : bool, (k,)
        True for a part of a building: parts of lower rank are taken from it. From another footprint all parts are
        taken that lie in it by `OWN_SHARE`.
    height : float64, (k,)
        Heights above ground (m), NaN where there is none.

    Returns
    -------
    Shares
        Pieces below `LEAST_AREA`, or narrower than `LEAST_WIDTH`, are not kept of what something was taken from.
    """
    kept, share = geometry.copy(), np.ones(len(geometry))
    row, part = parts.tree.query(geometry, predicate="intersects")
    order = np.argsort(row, kind="stable")
    touched, start = np.unique(row[order], return_index=True)
    polygons = mend_polygons(geometry[touched])
    ranks = _rank(polygons, height[touched])
    for k, over in enumerate(np.split(part[order], start[1:]) if len(touched) else []):
        i = touched[k]
        common = shapely.area(shapely.intersection(polygons[k], parts.polygons[over]))
        if is_one[i]:
            takes = np.array([parts.ranks[one] < ranks[k] for one in over.tolist()], np.bool_)
        else:
            takes = common >= OWN_SHARE * parts.area[over]
        taken = over[takes & (common > SEEN)].tolist()
        if taken:
            highest_first = sorted(taken, key=parts.ranks.__getitem__)  # whatever the order of the file
            kept[i] = subtract_polygons(polygons[k], parts.polygons[highest_first])
            share[i] = shapely.area(kept[i]) / shapely.area(polygons[k])
    return Shares(kept, share)


def subtract_polygons(polygon: shapely.Geometry, others: NDArray[np.object_]) -> shapely.Geometry:
    """Subtract polygons from one; of the rest, pieces that are large and wide enough."""
    rest = shapely.get_parts(shapely.difference(polygon, shapely.union_all(others)))
    wide = ~shapely.is_empty(shapely.buffer(rest, -LEAST_WIDTH / 2))
    rest = rest[wide & (shapely.area(rest) >= LEAST_AREA)]
    return rest[0] if len(rest) == 1 else shapely.multipolygons(rest)


def mend_polygons(geometry: NDArray[np.object_]) -> NDArray[np.object_]:
    """Make polygons valid, those that are stay as they are."""
    mended = geometry.copy()
    bad = ~shapely.is_valid(geometry)
    mended[bad] = shapely.make_valid(geometry[bad], method="structure", keep_collapsed=False)
    return mended


def _rank(polygons: NDArray[np.object_], height: NDArray[np.float64]) -> list[Rank]:
    """Rank parts: a greater height is lower, 0 stands for none; equal polygons are told apart by nothing."""
    known = np.where(np.isfinite(height), -height, 0.0).tolist()
    outlines = shapely.to_wkb(polygons, output_dimension=2, byte_order=1)
    return list(zip(known, shapely.area(polygons).tolist(), outlines.tolist(), strict=True))
