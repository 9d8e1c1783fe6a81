"""LoD0B and LoD0A: land use of cells by equation (1), and blocks that stand for the buildings of cells."""

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.generalisation.aggregation import areas_of
from pipeline.generalisation.barriers import GRID

LEAST_PART = 1.0  # m2; smaller parts of a block are left out

Array = NDArray[np.float64]


def cut_block(
    cell: shapely.Geometry, others: shapely.Geometry, street: float, rim: shapely.Polygon
) -> shapely.Geometry:
    """Give what of a cell can be built on: A - A_other of equation (1) is its area.

    Parameters
    ----------
    cell : shapely.Geometry
        The cell, or several that were joined (m).
    others : shapely.Geometry
        Area of all other objects, empty for none.
    street : float
        Width of the street along the border (m): half of it lies in the cell.
    rim : shapely.Polygon
        The region: no street runs along its border.

    Returns
    -------
    shapely.Polygon or MultiPolygon
        Empty where nothing is left.
    """
    if street <= 0:
        return subtract(cell, others)
    beyond = shapely.difference(shapely.buffer(cell, street, join_style="mitre"), rim, grid_size=GRID)
    inner = shapely.buffer(_join([cell, beyond]), -street / 2, join_style="mitre")
    return subtract(inner if beyond.is_empty else shapely.intersection(inner, cell, grid_size=GRID), others)


def _join(parts: list[shapely.Geometry]) -> shapely.Geometry:
    return parts[0] if parts[1].is_empty else shapely.union_all(parts, grid_size=GRID)


def keep_near(block: shapely.Geometry, outlines: NDArray[np.object_], width: float) -> shapely.Geometry:
    """Keep of a block what is built, and open space between its buildings up to a width (beyond the paper).

    Parameters
    ----------
    block : shapely.Geometry
        From `cut_block` (m).
    outlines : object, (n,)
        The buildings that it stands for (m).
    width : float
        Yards up to this are filled (m); what is wider, and all space in front of the buildings, is left out.

    Examples
    --------
    >>> pair = np.array([shapely.box(10, 10, 20, 20), shapely.box(24, 10, 34, 20)])
    >>> keep_near(shapely.box(0, 0, 50, 50), pair, 5.0).area
    240.0
    """
    wide = shapely.union_all(shapely.buffer(outlines, width / 2, join_style="mitre"), grid_size=GRID)
    closed = shapely.buffer(wide, -width / 2, join_style="mitre")
    return areas_of(shapely.intersection(block, closed, grid_size=GRID), LEAST_PART)


def subtract(block: shapely.Geometry, others: shapely.Geometry) -> shapely.Geometry:
    """Cut out what stands for itself, on the grid of `GRID`; parts up to `LEAST_PART` go."""
    if others.is_empty:
        return areas_of(shapely.set_precision(block, GRID), LEAST_PART)
    return areas_of(shapely.difference(block, others, grid_size=GRID), LEAST_PART)


def is_building(built: Array, free: Array, least: float) -> NDArray[np.bool_]:
    """Tell land use by equation (1): Building where A_bldg / (A - A_other) > Th1, Other elsewhere.

    Parameters
    ----------
    built : float64, (n,)
        A_bldg (m2).
    free : float64, (n,)
        A - A_other (m2); 0 is Other.
    least : float
        Th1.

    Examples
    --------
    >>> is_building(np.array([40.0, 30, 5]), np.array([100.0, 100, 0]), 0.3).tolist()
    [True, False, False]
    """
    return (free > 0) & (built > least * free)


def mean_heights(area: Array, height: Array, group: NDArray[np.int64], block: Array, keeps: str) -> Array:
    """Give one height for the buildings of each group.

    Parameters
    ----------
    area, height : float64, (n,)
        Of each building (m2, m).
    group : int64, (n,)
        Which of the blocks stands for it.
    block : float64, (k,)
        Area of each block (m2).
    keeps : str
        ``"area"``: the mean of heights, weighted by area; roofs stay where they are. ``"volume"``: the volume of
        the buildings over the area of the block.

    Examples
    --------
    >>> one = np.array([100.0, 300]), np.array([20.0, 4]), np.zeros(2, np.int64), np.array([800.0])
    >>> mean_heights(*one, "area"), mean_heights(*one, "volume")
    (array([8.]), array([4.]))
    """
    volume = np.bincount(group, area * height, minlength=len(block))
    over = block if keeps == "volume" else np.bincount(group, area, minlength=len(block))
    return volume / over
