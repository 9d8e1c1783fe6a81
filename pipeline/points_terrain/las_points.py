"""Points as a LAS file has them, in whole units: coordinates, what is usable, and cuts to a box (step 1.1)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.data.classes import HIGH_NOISE, LOW_NOISE
from pipeline.data.kernel import kernel
from pipeline.geometry.inside import is_covered

KEPT, OUTSIDE, WITHHELD, NOISE, ABSURD = range(5)
REASONS = ("kept", "outside", "withheld", "noise", "absurd")
LEFT_OUT = -1  # what a class becomes whose points are not wanted
HEIGHT_LIMIT = 10_000.0  # m; no ground, building or return lies beyond

Box = tuple[float, float, float, float]
Triple = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class UnitPoints:
    """Points of one file in its own units."""

    units: NDArray[np.int32]  #: (n, 3): coordinates in units of the file, as in `find_coordinates`
    #: size of a unit along each axis, and place of unit 0 (m)
    scale: Triple
    offset: Triple
    classification: NDArray[np.uint8]  #: (n,): ASPRS class of each point


@kernel
def find_coordinates(
    x: NDArray[np.int32], y: NDArray[np.int32], z: NDArray[np.int32], scale: Triple, offset: Triple
) -> NDArray[np.float64]:
    """Give the coordinates (m), float64 (n, 3), of points in units of a file: ``units * scale + offset``."""
    xyz = np.empty((len(x), 3))
    for k in range(len(x)):
        xyz[k, 0] = x[k] * scale[0] + offset[0]
        xyz[k, 1] = y[k] * scale[1] + offset[1]
        xyz[k, 2] = z[k] * scale[2] + offset[2]
    return xyz


@kernel
def count_values(values: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Count how often each of 256 values occurs, int64 (256,), in a fifth of the time that numpy takes.

    Four counts take turns: in one, a value that comes again waits until it is counted.

    Examples
    --------
    >>> np.flatnonzero(count_values(np.array([2, 6, 2], np.uint8))).tolist()
    [2, 6]
    """
    some, count = np.zeros((4, 256), np.int64), np.zeros(256, np.int64)
    for k in range(len(values)):
        some[k % 4, values[k]] += 1
    for turn in some:
        count += turn
    return count


@kernel
def judge_points(
    x: NDArray[np.int32],
    y: NDArray[np.int32],
    z: NDArray[np.int32],
    scale: Triple,
    offset: Triple,
    classification: NDArray[np.uint8],
    withheld: NDArray[np.bool_],
    box: Box,
) -> NDArray[np.uint8]:
    """Say what becomes of each point: the first reason to drop it of `REASONS`, or `KEPT`.

    Parameters
    ----------
    x, y, z : int32, (n,)
        Coordinates in units of the file, as in `find_coordinates`.
    scale, offset : tuple of 3 floats
        Size of a unit along each axis, and place of unit 0 (m).
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
    verdict = np.empty(len(x), np.uint8)
    for k in range(len(x)):
        if not is_within(x[k] * scale[0] + offset[0], y[k] * scale[1] + offset[1], box):
            verdict[k] = OUTSIDE
        elif withheld[k]:
            verdict[k] = WITHHELD
        elif classification[k] == LOW_NOISE or classification[k] == HIGH_NOISE:
            verdict[k] = NOISE
        else:
            verdict[k] = KEPT if abs(z[k] * scale[2] + offset[2]) <= HEIGHT_LIMIT else ABSURD
    return verdict


@kernel
def cut_units(
    units: NDArray[np.int32],
    classification: NDArray[np.uint8],
    scale: Triple,
    offset: Triple,
    box: Box,
    become: NDArray[np.int16],
    cover: tuple[int, int, NDArray[np.bool_]] | None,
    xyz: NDArray[np.float64],
    classes: NDArray[np.uint8],
) -> int:
    """Write the coordinates and classes of the wanted points within a box and a cover, in their old order.

    Parameters
    ----------
    units : int32, (n, 3)
        Coordinates in units of the file, as in `find_coordinates`.
    classification : uint8, (n,)
        ASPRS classes.
    scale, offset : tuple of 3 floats
        Size of a unit along each axis, and place of unit 0 (m).
    box : tuple of 4 floats
        xmin, ymin, xmax, ymax (m); the borders belong to the box.
    become : int16, (256,)
        Class that each class becomes; `LEFT_OUT` for those that are not wanted.
    cover : tuple, optional
        ``i0``, ``j0`` and ``marked`` of a `Cover`; None where all of the box is wanted.
    xyz : float64, (m, 3)
        Room for ``m >= n`` coordinates (m); the first rows are written.
    classes : uint8, (m,)
        Room for their classes, likewise.

    Returns
    -------
    int
        Number of points that were written.

    Raises
    ------
    ValueError
        If there is no room for all points.

    Notes
    -----
    Each point is written, and the next one over it if it was not wanted: no processor can guess which are, and to
    guess wrong takes longer than to write.
    """
    if min(len(xyz), len(classes)) < len(units):
        raise ValueError("no room for all points")
    n = 0
    for k in range(len(units)):
        new = become[classification[k]]
        if new == LEFT_OUT:
            continue
        x, y = units[k, 0] * scale[0] + offset[0], units[k, 1] * scale[1] + offset[1]
        wanted = is_within(x, y, box)
        if cover is not None:
            wanted &= is_covered(x, y, cover[0], cover[1], cover[2])
        xyz[n, 0], xyz[n, 1], xyz[n, 2] = x, y, units[k, 2] * scale[2] + offset[2]
        classes[n] = new
        n += wanted
    return n


@kernel(inline="always")
def is_within(x: float, y: float, box: Box) -> bool:
    """Tell whether a place is in a box; the borders belong to it."""
    return (box[0] <= x) & (x <= box[2]) & (box[1] <= y) & (y <= box[3])
