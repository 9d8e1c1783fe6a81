"""Points as a LAS file has them, in whole units: coordinates, what is usable, and cuts to a box (step 1.1)."""

import numba
import numpy as np
from numpy.typing import NDArray

from pipeline.pointcloud import HIGH_NOISE, LOW_NOISE

KEPT, OUTSIDE, WITHHELD, NOISE, ABSURD = range(5)
REASONS = ("kept", "outside", "withheld", "noise", "absurd")
HEIGHT_LIMIT = 10_000.0  # m; no ground, building or return lies beyond

Box = tuple[float, float, float, float]
Triple = tuple[float, float, float]


@numba.njit(cache=True, nogil=True)
def find_coordinates(units: NDArray[np.int32], scale: Triple, offset: Triple) -> NDArray[np.float64]:
    """Give the coordinates (m), float64 (n, 3), of points in units of a file: ``units * scale + offset``."""
    xyz = np.empty((len(units), 3))
    for k in range(len(units)):
        for axis in range(3):
            xyz[k, axis] = units[k, axis] * scale[axis] + offset[axis]
    return xyz


@numba.njit(cache=True, nogil=True)
def judge_points(
    xyz: NDArray[np.float64], classification: NDArray[np.uint8], withheld: NDArray[np.bool_], box: Box
) -> NDArray[np.uint8]:
    """Say what becomes of each point: the first reason to drop it of `REASONS`, or `KEPT`.

    Parameters
    ----------
    xyz : float64, (n, 3)
        Coordinates (m).
    classification : uint8, (n,)
        ASPRS classes.
    withheld : bool, (n,)
        Whether the file says not to use it.
    box : tuple of 4 floats
        xmin, ymin, xmax, ymax (m); the borders belong to the box.

    Returns
    -------
    uint8, (n,)
        Positions in `REASONS`.
    """
    verdict = np.empty(len(xyz), np.uint8)
    for k in range(len(xyz)):
        if not _is_within(xyz[k, 0], xyz[k, 1], box):
            verdict[k] = OUTSIDE
        elif withheld[k]:
            verdict[k] = WITHHELD
        elif classification[k] == LOW_NOISE or classification[k] == HIGH_NOISE:
            verdict[k] = NOISE
        else:
            verdict[k] = KEPT if abs(xyz[k, 2]) <= HEIGHT_LIMIT else ABSURD
    return verdict


@numba.njit(cache=True, nogil=True)
def cut_units(
    units: NDArray[np.int32], classification: NDArray[np.uint8], scale: Triple, offset: Triple, box: Box
) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Give the coordinates and classes of the points within a box, in their old order.

    Parameters
    ----------
    units : int32, (n, 3)
        Coordinates in units of the file, as in `find_coordinates`.
    classification : uint8, (n,)
        ASPRS classes.
    box : tuple of 4 floats
        xmin, ymin, xmax, ymax (m); the borders belong to the box.

    Returns
    -------
    xyz : float64, (k, 3)
        Coordinates (m).
    classification : uint8, (k,)
        Their classes.
    """
    n = 0
    for k in range(len(units)):
        n += _is_within(units[k, 0] * scale[0] + offset[0], units[k, 1] * scale[1] + offset[1], box)
    xyz, classes = np.empty((n, 3)), np.empty(n, np.uint8)
    n = 0
    for k in range(len(units)):
        x, y = units[k, 0] * scale[0] + offset[0], units[k, 1] * scale[1] + offset[1]
        if _is_within(x, y, box):
            xyz[n, 0], xyz[n, 1], xyz[n, 2] = x, y, units[k, 2] * scale[2] + offset[2]
            classes[n] = classification[k]
            n += 1
    return xyz, classes


@numba.njit(cache=True, nogil=True, inline="always")
def _is_within(x: float, y: float, box: Box) -> bool:
    return box[0] <= x <= box[2] and box[1] <= y <= box[3]
