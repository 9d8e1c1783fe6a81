"""A ground filter for clouds without ground classes: progressive opening of the lowest surface.

Only on request (`--ground-filter`); what it says is ground is named so in the report. The idea is that of
the progressive morphological filter (Zhang et al., 2003, IEEE TGRS 41(4)): openings with growing windows
cut off whatever rises more steeply than terrain does.
"""

import math

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from pipeline.pointcloud import GROUND, HIGH_NOISE, LOW_NOISE, UNCLASSIFIED, PointCloud

CELL = 1.0  # m, side of a cell of the lowest surface
WINDOWS = (2, 4, 8, 16, 32)  # m, half-widths of the openings: the last must exceed the widest roof's half
SLOPE = 0.15  # terrain rises no more than this over a window
STEP = 0.5  # m, allowed above the opened surface whatever the window


def classify_ground(cloud: PointCloud) -> PointCloud:
    """Classify as ground (2) what lies within half a metre of the opened lowest surface.

    Parameters
    ----------
    cloud : PointCloud
        Points of any class; noise (7, 18) is passed over.

    Returns
    -------
    PointCloud
        The same points; ground has class 2, what had class 2 and is not ground has class 1.
    """
    usable = ~np.isin(cloud.classification, (LOW_NOISE, HIGH_NOISE))
    if not usable.any():
        return cloud
    cell = np.floor(cloud.xyz[:, :2] / CELL).astype(np.int64)
    low_corner = cell[usable].min(axis=0)
    nx, ny = (cell[usable].max(axis=0) - low_corner + 1).tolist()
    column, row = np.clip(cell - low_corner, 0, [nx - 1, ny - 1]).T
    lowest = np.full((ny, nx), np.inf)
    np.minimum.at(lowest, (row[usable], column[usable]), cloud.xyz[usable, 2])
    terrain = _open_progressively(_fill_nearest(lowest))
    is_ground = usable & (cloud.xyz[:, 2] <= terrain[row, column] + STEP)
    classes = np.where(cloud.classification == GROUND, UNCLASSIFIED, cloud.classification)
    return PointCloud(cloud.xyz, np.where(is_ground, GROUND, classes).astype(np.uint8))


def _fill_nearest(surface: NDArray[np.float64]) -> NDArray[np.float64]:
    index = ndimage.distance_transform_edt(np.isinf(surface), return_distances=False, return_indices=True)
    filled: NDArray[np.float64] = surface[tuple(index)]
    return filled


def _open_progressively(surface: NDArray[np.float64]) -> NDArray[np.float64]:
    """Lower each cell that rises above the opening by more than the window allows."""
    terrain = surface.copy()
    for half_width in WINDOWS:
        size = 2 * math.ceil(half_width / CELL) + 1
        opened = ndimage.grey_opening(terrain, size=(size, size), mode="nearest")
        object_cells = terrain - opened > SLOPE * half_width + STEP
        terrain = np.where(object_cells, opened, terrain)
    return terrain
