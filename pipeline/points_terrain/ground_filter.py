"""A ground filter for clouds without ground classes: progressive opening of the lowest surface.

Only on request (`--ground-filter`); what it says is ground is named so in the report. The idea is that of
the progressive morphological filter (Zhang et al., 2003, IEEE TGRS 41(4)): openings with growing windows
cut off whatever rises more steeply than terrain does.
"""

import math
from collections.abc import Iterable

import numpy as np
import scipy  # what is asked of it is imported then
from numpy.typing import NDArray

from pipeline.data.classes import GROUND, HIGH_NOISE, LOW_NOISE, UNCLASSIFIED
from pipeline.data.pointcloud import PointCloud

CELL = 1.0  # m, side of a cell of the lowest surface; cells are aligned with the CRS
WINDOWS = (2, 4, 8, 16, 32)  # m, half-widths of the openings: the last must exceed the widest roof's half
SLOPE = 0.15  # terrain rises no more than this over a window
STEP = 0.5  # m, allowed above the opened surface whatever the window
GAP = 16  # cells as far as this from a point get a height; farther ones are as good as outside the cloud

Bounds = tuple[float, float, float, float]

# An opening looks twice as far as its half-width, and each looks at the result of the one before. One cell
# more, because the cloud may end within a cell.
FILTER_REACH = CELL * (2 * sum(math.ceil(width / CELL) for width in WINDOWS) + GAP + 1)  # m


def classify_ground(cloud: PointCloud, *, bounds: Bounds | None = None) -> PointCloud:
    """Classify as ground (2) what lies within half a metre of the opened lowest surface.

    Parameters
    ----------
    cloud : PointCloud
        Points of any class; noise (7, 18) is passed over.
    bounds : (xmin, ymin, xmax, ymax), optional
        Area that the points were taken from (m), all of them inside. A tile gives its box grown by `FILTER_REACH`
        and clipped to the region. Without it, the points' own bounding box.

    Returns
    -------
    PointCloud
        The same points; ground has class 2, what had class 2 and is not ground has class 1.

    Raises
    ------
    ValueError
        If a point that is not noise lies outside `bounds`.

    Notes
    -----
    The classes of points farther than `FILTER_REACH` inside `bounds` do not depend on what is beyond, bit for
    bit; a side of `bounds` that is the region's is the end of the data for every tile alike. Empty cells are
    filled ring by ring with the lowest height beside them, `GAP` rings deep; the rest of a larger gap takes no
    part, like the outside of the cloud. The order of the points does not matter. Cost is linear in points and
    cells.
    """
    if bounds is None:
        xy = cloud.xyz[_are_usable(cloud), :2]
        if not len(xy):
            return cloud
        bounds = (*xy.min(axis=0).tolist(), *xy.max(axis=0).tolist())
    return classify_above(cloud, find_terrain([cloud], bounds), bounds)


def find_terrain(clouds: Iterable[PointCloud], bounds: Bounds) -> NDArray[np.float64]:
    """Open the lowest surface of points that come in parts; each part is looked at once.

    Parameters
    ----------
    clouds : iterable of PointCloud
        All points within the bounds, in parts of any size.
    bounds : (xmin, ymin, xmax, ymax)
        As for `classify_ground`.

    Returns
    -------
    float64, (ny, nx)
        Height of the opened surface (m) in each cell; infinite where no point is near.

    Raises
    ------
    ValueError
        If a point that is not noise lies outside the bounds.
    """
    nx, ny = _find_cells(np.array(bounds)[None, 2:], bounds)[0] + 1
    lowest = np.full((ny, nx), np.inf)
    for cloud in clouds:
        xyz = cloud.xyz[_are_usable(cloud)]
        column, row = _find_cells(xyz, bounds).T
        np.minimum.at(lowest, (row, column), xyz[:, 2])
    return _open_progressively(_fill_gaps(lowest))


def classify_above(cloud: PointCloud, terrain: NDArray[np.float64], bounds: Bounds) -> PointCloud:
    """Classify points of a part of the bounds by the surface that `find_terrain` found there."""
    usable = _are_usable(cloud)
    xyz = cloud.xyz[usable]
    column, row = _find_cells(xyz, bounds).T
    is_ground = np.zeros(len(usable), np.bool_)
    is_ground[usable] = xyz[:, 2] <= terrain[row, column] + STEP
    classes = np.where(cloud.classification == GROUND, UNCLASSIFIED, cloud.classification)
    return PointCloud(cloud.xyz, np.where(is_ground, GROUND, classes).astype(np.uint8))


def _are_usable(cloud: PointCloud) -> NDArray[np.bool_]:
    return ~np.isin(cloud.classification, (LOW_NOISE, HIGH_NOISE))


def _find_cells(xy: NDArray[np.float64], bounds: Bounds) -> NDArray[np.int64]:
    """Column and row of the cell of each point, counted from the bounds' lower corner."""
    low, high = np.floor(np.array(bounds).reshape(2, 2) / CELL).astype(np.int64)
    cell: NDArray[np.int64] = np.floor(xy[:, :2] / CELL).astype(np.int64)
    if (cell < low).any() or (cell > high).any():
        raise ValueError(f"points outside {bounds}")
    cell -= low
    return cell


def _fill_gaps(surface: NDArray[np.float64]) -> NDArray[np.float64]:
    for _ in range(GAP):
        beside = scipy.ndimage.minimum_filter(surface, size=3, mode="constant", cval=np.inf)
        surface = np.where(np.isinf(surface), beside, surface)
    return surface


def _open_progressively(surface: NDArray[np.float64]) -> NDArray[np.float64]:
    """Lower each cell that rises above the opening by more than the window allows; infinite cells take no part."""
    gap = np.isinf(surface)
    terrain = surface.copy()
    for half_width in WINDOWS:
        size = 2 * math.ceil(half_width / CELL) + 1
        eroded = scipy.ndimage.minimum_filter(terrain, size=size, mode="constant", cval=np.inf)
        eroded[gap] = -np.inf
        opened = scipy.ndimage.maximum_filter(eroded, size=size, mode="constant", cval=-np.inf)
        object_cells = ~gap & (terrain > opened + (SLOPE * half_width + STEP))
        terrain = np.where(object_cells, opened, terrain)
    return terrain
