"""Step 1.3: the digital terrain map (DTM), a raster of ground heights that is sampled bilinearly."""

import math
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from pipeline.errors import InputError
from pipeline.pointcloud import GROUND, WATER, PointCloud

# Heights are summed as whole numbers of this unit, so that a bin's mean does not depend on the order
# of its points: sums of whole numbers below 2**53 are exact in float64.
HEIGHT_UNIT = 1e-4  # m


@dataclass(frozen=True, eq=False)
class Dtm:
    """Ground heights at the nodes of a grid that is aligned with the CRS.

    Attributes
    ----------
    z : float64, (ny, nx)
        Height (m) at node ``(x, y) = ((i0 + i) * spacing, (j0 + j) * spacing)``, row ``j``, column ``i``.
    i0, j0 : int
        Region-wide index of the first column and row: the same node has the same index in every tile.
    spacing : float
        Distance between nodes (m).
    """

    z: NDArray[np.float64]
    i0: int
    j0: int
    spacing: float


def bin_ground(
    cloud: PointCloud, bounds: tuple[float, float, float, float], *, spacing: float
) -> tuple[Dtm, NDArray[np.int64]]:
    """Average the ground points (classes 2 and 9) around each node of the grid over `bounds`.

    Parameters
    ----------
    cloud : PointCloud
        Points; those of other classes or beyond the grid are passed over.
    bounds : (xmin, ymin, xmax, ymax)
        Area that the grid covers (m); it reaches to the next multiples of `spacing`.
    spacing : float
        Distance between nodes (m); a point counts for its closest node.

    Returns
    -------
    Dtm
        Bin means, NaN where a bin is empty.
    int64, (ny, nx)
        Points in each bin.
    """
    i0, j0 = math.floor(bounds[0] / spacing), math.floor(bounds[1] / spacing)
    nx, ny = math.ceil(bounds[2] / spacing) - i0 + 1, math.ceil(bounds[3] / spacing) - j0 + 1
    ground = cloud.xyz[(cloud.classification == GROUND) | (cloud.classification == WATER)]
    i = np.rint(ground[:, 0] / spacing).astype(np.int64) - i0
    j = np.rint(ground[:, 1] / spacing).astype(np.int64) - j0
    inside = (i >= 0) & (i < nx) & (j >= 0) & (j < ny)
    key = j[inside] * nx + i[inside]
    units = np.rint(ground[inside, 2] / HEIGHT_UNIT)
    count = np.bincount(key, minlength=nx * ny)
    total = np.bincount(key, weights=units, minlength=nx * ny)
    mean = np.full(nx * ny, np.nan)
    np.divide(total * HEIGHT_UNIT, count, out=mean, where=count > 0)
    return Dtm(mean.reshape(ny, nx), i0, j0, spacing), count.reshape(ny, nx)


def fill_dtm(dtm: Dtm) -> Dtm:
    """Fill empty nodes from the border of each empty area, one ring after the other.

    A node gets the mean of those of its eight neighbours that were known before its ring began.
    Cost is linear in the nodes.

    Raises
    ------
    InputError
        If no node has a height.
    """
    if np.isnan(dtm.z).all():
        raise InputError(
            f"terrain, step 1.3: none of the {dtm.z.size} nodes has a ground point (class 2 or 9); "
            "check the bounds and the classes of the point cloud, or ask for --ground-filter"
        )
    z = dtm.z.copy()
    _flood(z)
    return Dtm(z, dtm.i0, dtm.j0, dtm.spacing)


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


def sample_dtm(dtm: Dtm, xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sample ground heights bilinearly.

    Parameters
    ----------
    dtm : Dtm
        Terrain without empty nodes.
    xy : float64, (n, 2)
        Places (m). Beyond the grid, the closest place on its border is sampled.

    Returns
    -------
    float64, (n,)
        Heights (m).

    Notes
    -----
    The position in a cell comes from region-wide indices, so two tiles that hold the same nodes get the
    same bits.
    """
    height = np.empty(len(xy))
    _sample(dtm.z, dtm.i0, dtm.j0, dtm.spacing, xy, height)
    return height


@numba.njit(cache=True, nogil=True)
def _sample(
    z: NDArray[np.float64],
    i0: int,
    j0: int,
    spacing: float,
    xy: NDArray[np.float64],
    height: NDArray[np.float64],
) -> None:
    ny, nx = z.shape
    for k in range(len(xy)):
        u = min(max(xy[k, 0] / spacing, float(i0)), float(i0 + nx - 1))
        v = min(max(xy[k, 1] / spacing, float(j0)), float(j0 + ny - 1))
        i = min(int(np.floor(u)), i0 + max(nx - 2, 0))
        j = min(int(np.floor(v)), j0 + max(ny - 2, 0))
        s, t = u - i, v - j
        left, low = i - i0, j - j0
        right, high = min(left + 1, nx - 1), min(low + 1, ny - 1)
        below = (1 - s) * z[low, left] + s * z[low, right]
        above = (1 - s) * z[high, left] + s * z[high, right]
        height[k] = (1 - t) * below + t * above


@numba.njit(cache=True, nogil=True)
def _flood(z: NDArray[np.float64]) -> None:
    ny, nx = z.shape
    queued = np.zeros(z.shape, np.bool_)
    front = [(0, 0)]
    front.clear()
    for j in range(ny):
        for i in range(nx):
            if np.isnan(z[j, i]) and _known_mean(z, j, i)[1] > 0:
                queued[j, i] = True
                front.append((j, i))
    while len(front) > 0:
        values = np.empty(len(front))
        for k, (j, i) in enumerate(front):
            values[k] = _known_mean(z, j, i)[0]
        for k, (j, i) in enumerate(front):
            z[j, i] = values[k]
        ring = [(0, 0)]
        ring.clear()
        for j, i in front:
            for q in range(max(j - 1, 0), min(j + 2, ny)):
                for p in range(max(i - 1, 0), min(i + 2, nx)):
                    if np.isnan(z[q, p]) and not queued[q, p]:
                        queued[q, p] = True
                        ring.append((q, p))
        front = ring


@numba.njit(cache=True, nogil=True)
def _known_mean(z: NDArray[np.float64], j: int, i: int) -> tuple[float, int]:
    total, count = 0.0, 0
    for q in range(max(j - 1, 0), min(j + 2, z.shape[0])):
        for p in range(max(i - 1, 0), min(i + 2, z.shape[1])):
            if not np.isnan(z[q, p]):
                total += z[q, p]
                count += 1
    return (total / count if count > 0 else 0.0), count
