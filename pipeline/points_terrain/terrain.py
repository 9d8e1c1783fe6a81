"""Step 1.3: the digital terrain map (DTM), bin means of ground points with all empty nodes filled.

A region in one piece takes `compute_dtm`. Tiles take the same steps one by one: `bin_units` for their own nodes,
`raster.join_dtm` with the neighbours' as far as `terrain_fill.FILL_RINGS`, `flood_terrain`, `coarsen`; then
`merge_coarse` and `coarse_terrain` for the region; then `fill_terrain`. The bytes are the same.
"""

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from pipeline.data.classes import GROUND, WATER
from pipeline.data.kernel import kernel
from pipeline.data.pointcloud import PointCloud
from pipeline.points_terrain.las_points import Box, Triple, UnitPoints, is_within
from pipeline.points_terrain.raster import (
    HEIGHT_UNIT,
    Dtm,
    NodeWindow,
    cut_nodes,
    grow_window,
    join_dtm,
    node_window,
    round_height,
    sample_dtm,
    sample_grid,
    window_of,
    windows_meet,
)
from pipeline.points_terrain.terrain_fill import coarse_terrain, coarsen, fill_terrain, flood_terrain

__all__ = [
    "HEIGHT_UNIT",
    "Dtm",
    "bin_ground",
    "bin_nodes",
    "bin_units",
    "compute_dtm",
    "cut_terrain",
    "fill_dtm",
    "join_terrain",
    "sample_dtm",
    "sample_grid",
]


def bin_nodes(
    clouds: Iterable[PointCloud], window: NodeWindow, *, spacing: float
) -> tuple[Dtm, NDArray[np.int32]]:
    """Average the ground points (classes 2 and 9) around each node.

    Parameters
    ----------
    clouds : iterable of PointCloud
        Points as far as half a spacing beyond the nodes, in parts of any size, each looked at once; those of
        other classes or farther are passed over.
    window : NodeWindow
        Nodes.
    spacing : float
        Distance between nodes (m); a point counts for its closest node.

    Returns
    -------
    Dtm
        Bin means, NaN where a bin is empty.
    int32, (ny, nx)
        Points in each bin.

    Notes
    -----
    Heights are summed as whole numbers of `HEIGHT_UNIT`: neither the order of the points matters nor how they are
    parted. Means are rounded to it.
    """
    total, count = np.zeros((window.ny, window.nx)), np.zeros((window.ny, window.nx), np.int32)
    for cloud in clouds:
        _sum_bins(cloud.xyz, cloud.classification, spacing, window.i0, window.j0, total, count)
    return Dtm(_average_bins(total, count), window.i0, window.j0, spacing), count


def bin_units(parts: Iterable[UnitPoints], box: Box, window: NodeWindow, *, spacing: float) -> Dtm:
    """Average the ground points within a box around each node, as `bin_nodes` does, from units of their files.

    Parameters
    ----------
    parts : iterable of UnitPoints
        Points, each looked at once; those of other classes or outside the box are passed over.
    box : tuple of 4 floats
        xmin, ymin, xmax, ymax (m); the borders belong to the box.
    window : NodeWindow
        Nodes.
    spacing : float
        Distance between nodes (m).

    Returns
    -------
    Dtm
        Bin means, NaN where a bin is empty.

    Notes
    -----
    Coordinates in metres, twice as many bytes as the units, are nowhere in memory.
    """
    total, count = np.zeros((window.ny, window.nx)), np.zeros((window.ny, window.nx), np.int32)
    for part in parts:
        rows = part.units, part.scale, part.offset, part.classification
        _sum_units(*rows, box, spacing, window.i0, window.j0, total, count)
    return Dtm(_average_bins(total, count), window.i0, window.j0, spacing)


@kernel
def _sum_bins(
    xyz: NDArray[np.float64],
    classification: NDArray[np.uint8],
    spacing: float,
    i0: int,
    j0: int,
    total: NDArray[np.float64],
    count: NDArray[np.int32],
) -> None:
    """Add the heights of ground points to the total around each node, in whole `HEIGHT_UNIT`, and count them."""
    for k in range(len(xyz)):
        if classification[k] == GROUND or classification[k] == WATER:
            _add_point(xyz[k, 0], xyz[k, 1], xyz[k, 2], spacing, i0, j0, total, count)


@kernel
def _sum_units(
    units: NDArray[np.int32],
    scale: Triple,
    offset: Triple,
    classification: NDArray[np.uint8],
    box: Box,
    spacing: float,
    i0: int,
    j0: int,
    total: NDArray[np.float64],
    count: NDArray[np.int32],
) -> None:
    """Do what `_sum_bins` does, for points in units of a file, and within a box."""
    for k in range(len(units)):
        if classification[k] == GROUND or classification[k] == WATER:
            x, y = units[k, 0] * scale[0] + offset[0], units[k, 1] * scale[1] + offset[1]
            if is_within(x, y, box):
                _add_point(x, y, units[k, 2] * scale[2] + offset[2], spacing, i0, j0, total, count)


@kernel(inline="always")
def _add_point(
    x: float,
    y: float,
    z: float,
    spacing: float,
    i0: int,
    j0: int,
    total: NDArray[np.float64],
    count: NDArray[np.int32],
) -> None:
    i, j = int(np.rint(x / spacing)) - i0, int(np.rint(y / spacing)) - j0
    if 0 <= i < total.shape[1] and 0 <= j < total.shape[0]:
        total[j, i] += np.rint(z / HEIGHT_UNIT)
        count[j, i] += 1


@kernel
def _average_bins(total: NDArray[np.float64], count: NDArray[np.int32]) -> NDArray[np.float64]:
    """Turn sums of heights, in `HEIGHT_UNIT`, into means (m), NaN where nothing is counted."""
    mean = np.empty(total.shape)
    for j in range(total.shape[0]):
        for i in range(total.shape[1]):
            mean[j, i] = round_height(total[j, i] * HEIGHT_UNIT / count[j, i]) if count[j, i] else np.nan
    return mean


def bin_ground(
    cloud: PointCloud, bounds: tuple[float, float, float, float], *, spacing: float
) -> tuple[Dtm, NDArray[np.int32]]:
    """Average the ground points around each node of a region, as `bin_nodes` does.

    Parameters
    ----------
    cloud : PointCloud
        Points.
    bounds : (xmin, ymin, xmax, ymax)
        The region (m); the grid reaches to the next multiples of `spacing`.
    spacing : float
        Distance between nodes (m).
    """
    return bin_nodes([cloud], node_window(bounds, spacing), spacing=spacing)


def fill_dtm(dtm: Dtm) -> Dtm:
    """Fill the empty nodes of a whole region's raster.

    Raises
    ------
    InputError
        If no node has a height.

    Notes
    -----
    Empty areas are flooded from their border; nodes deeper than `terrain_fill.RIM` take more and more of a
    coarse level. Cost is linear in the nodes.
    """
    flooded = flood_terrain(dtm, window_of(dtm))
    return fill_terrain(flooded, coarse_terrain(coarsen(flooded)))[0]


def join_terrain(parts: Sequence[Dtm], window: NodeWindow) -> Dtm:
    """Put the terrain of neighbouring tiles together; nodes of tiles that are absent stay NaN.

    Parameters and errors as in `join_dtm`; `cut_terrain` fills them.
    """
    return join_dtm([part for part in parts if windows_meet(window_of(part), window)], window)


def cut_terrain(dtm: Dtm, window: NodeWindow) -> Dtm:
    """Cut terrain to a window, in which nodes of tiles that are absent are filled from those around.

    Parameters
    ----------
    dtm : Dtm
        Terrain, NaN at nodes of tiles that are absent.
    window : NodeWindow
        Nodes to return; those beyond the raster are left out.

    Raises
    ------
    InputError
        If no node of the window has a height.

    Notes
    -----
    What is filled depends on the heights within the window and on no others. Two tasks that compute the same
    column must therefore cut to the same window, however far each of them reads.

    Examples
    --------
    >>> dtm = Dtm(np.array([[5.0, 3.0, np.nan, np.nan]]), 10, 0, 1.0)
    >>> cut_terrain(dtm, NodeWindow(11, 0, 9, 1)).z
    array([[3., 3., 3.]])
    """
    inner = grow_window(window, 0, within=window_of(dtm))
    part = Dtm(cut_nodes(dtm.z, window_of(dtm), inner), inner.i0, inner.j0, dtm.spacing)
    return fill_dtm(part) if np.isnan(part.z).any() else part


def compute_dtm(cloud: PointCloud, bounds: tuple[float, float, float, float], *, spacing: float = 1.0) -> Dtm:
    """Compute the terrain over `bounds` from classified ground points (paper, step 1.3).

    Parameters, errors and notes as in `bin_ground` and `fill_dtm`.

    Examples
    --------
    >>> cloud = PointCloud(np.array([[0.2, 0.0, 3.0], [1.0, 1.1, 5.0]]), np.array([2, 2], dtype=np.uint8))
    >>> compute_dtm(cloud, (0.0, 0.0, 1.0, 1.0)).z
    array([[3., 4.],
           [4., 5.]])
    """
    return fill_dtm(bin_ground(cloud, bounds, spacing=spacing)[0])
