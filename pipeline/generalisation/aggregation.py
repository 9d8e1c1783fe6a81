"""LoD0C: adjacent buildings of a cell as one."""

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.generalisation.barriers import GRID
from pipeline.geometry.components import join_pairs

Index = NDArray[np.int64]


def find_adjacent(outlines: NDArray[np.object_], cell: Index, landmark: NDArray[np.bool_], gap: float) -> Index:
    """Find which buildings become one: chains of buildings of a cell that are closer than a gap.

    Parameters
    ----------
    outlines : object, (n,)
        Valid polygons and multipolygons (m).
    cell : int64, (n,)
        Cell that each is registered to.
    landmark : bool, (n,)
        Buildings that stay alone.
    gap : float
        Greatest distance of adjacent buildings (m).

    Returns
    -------
    int64, (n,)
        For each building the first row of those that it is one with.
    """
    rows = np.flatnonzero(~landmark)
    near = shapely.STRtree(outlines[rows]).query(outlines[rows], "dwithin", gap)
    one, other = rows[near[0]], rows[near[1]]
    kept = (one < other) & (cell[one] == cell[other])
    return join_pairs(len(outlines), np.column_stack((one, other))[kept])


def merge_outlines(outlines: NDArray[np.object_], gap: float) -> shapely.Geometry:
    """Merge adjacent outlines; one alone stays as it is.

    Parameters
    ----------
    outlines : object, (n,)
        What `find_adjacent` puts together.
    gap : float
        Gaps up to this are closed, and details of the outline below half of it go (m).

    Returns
    -------
    shapely.Polygon or MultiPolygon
        On the grid of `GRID` where there are several.
    """
    if len(outlines) == 1:
        return outlines[0]
    merged = shapely.union_all(outlines, grid_size=GRID)
    if merged.geom_type != "Polygon" and gap > 0:
        # Half a grid step more, as a gap of just that width stays open otherwise.
        wide = shapely.buffer(merged, (gap + GRID) / 2, join_style="mitre")
        closed = shapely.buffer(wide, -(gap + GRID) / 2, join_style="mitre")
        merged = shapely.union_all([closed, merged], grid_size=GRID)
    return areas_of(shapely.simplify(merged, gap / 2))


def areas_of(geometry: shapely.Geometry, least: float = 0.0) -> shapely.Geometry:
    """Give the polygons of a geometry whose area is more than `least` (m2); a polygon where it is one."""
    parts = shapely.get_parts(shapely.get_parts(geometry))
    kept = parts[(shapely.get_type_id(parts) == shapely.GeometryType.POLYGON) & (shapely.area(parts) > least)]
    return kept[0] if len(kept) == 1 else shapely.multipolygons(kept)
