"""How far footprints lie beside the roofs of a point cloud: the shift that fits best, from the data alone."""

import math

import numpy as np
import shapely
from numpy.typing import NDArray

REACH = 8.0  # m; shifts are looked for as far as this along both axes
STEP = 0.25  # m between the shifts that are tried
SIDE = 2 * round(REACH / STEP) + 1  # number of shifts along an axis
EVEN = 32  # cells; sides of grids are multiples of it
LEAST_HOUSES = 3
LEAST_GAIN = 0.01  # of the roof points looked at, by which the best shift must fit better than none
TOP = 0.03  # of the range of scores: shifts so close to the best are averaged
TOLD = 0.5  # m; a smaller shift is within what roofs and registers differ by

COMPASS = ("east", "north-east", "north", "north-west", "west", "south-west", "south", "south-east")


def score_shifts(
    polygons: NDArray[np.object_], xy: NDArray[np.float64], roof: NDArray[np.bool_]
) -> tuple[NDArray[np.int64], int]:
    """Count, for each shift of some footprints, the roof points within them less the ground points within them.

    Parameters
    ----------
    polygons : object, (n,)
        Valid polygons or multipolygons (m).
    xy : float64, (m, 2)
        Points at least as far as `REACH` around them (m).
    roof : bool, (m,)
        Whether a point is one of a roof; else it is of the ground.

    Returns
    -------
    int64, (SIDE, SIDE)
        Sum over the footprints, by the shift along y, then x, from -`REACH` in steps of `STEP`. Scores of several
        tiles add up.
    int
        Roof points within `REACH` of a footprint, those near several counted for each.

    Notes
    -----
    For each footprint a correlation of two grids of `STEP`, by fast Fourier transforms, whose sums are whole
    numbers and rounded to them: the order of the footprints does not matter.
    """
    total, n_roof = np.zeros((SIDE, SIDE), np.int64), 0
    order = np.argsort(xy[:, 0], kind="stable")
    xy, roof = xy[order], roof[order]
    for polygon in polygons:
        xmin, ymin, xmax, ymax = polygon.bounds
        low = np.floor(np.array([xmin, ymin]) / STEP - 1) * STEP - REACH
        nx, ny = (
            math.ceil((high + REACH + STEP - start) / STEP) for high, start in zip((xmax, ymax), low, strict=True)
        )
        first, last = np.searchsorted(xy[:, 0], [low[0], low[0] + nx * STEP])
        cell = np.floor((xy[first:last] - low) / STEP).astype(np.int64)
        near = ((cell >= 0) & (cell < (nx, ny))).all(axis=1)
        cell, on_roof = cell[near], roof[first:last][near]
        sign = np.where(on_roof, 1, -1)
        points = np.zeros((ny, nx))
        np.add.at(points, (cell[:, 1], cell[:, 0]), sign)
        x, y = low[0] + (np.arange(nx) + 0.5) * STEP, low[1] + (np.arange(ny) + 0.5) * STEP
        inside = shapely.contains_xy(polygon, *np.meshgrid(x, y))
        total += _correlate(points, inside.astype(np.float64))
        n_roof += int(np.count_nonzero(on_roof))
    return total, n_roof


def _correlate(points: NDArray[np.float64], inside: NDArray[np.float64]) -> NDArray[np.int64]:
    """Sum points over the cells inside, for each shift of these."""
    ny, nx = points.shape
    half = SIDE // 2
    size = [-(-(n + half) // EVEN) * EVEN for n in (ny, nx)]  # products of small primes take the least time
    spectrum = np.fft.rfft2(points, size) * np.conj(np.fft.rfft2(inside, size))
    found = np.fft.irfft2(spectrum, size)
    rows = np.arange(-half, half + 1)
    return np.rint(found[np.ix_(rows % size[0], rows % size[1])]).astype(np.int64)


def best_shift(scores: NDArray[np.int64], n_roof: int, n_houses: int) -> tuple[float, float] | None:
    """Find the shift of footprints that fits the roof points best.

    Parameters
    ----------
    scores : int64, (SIDE, SIDE)
        From `score_shifts`.
    n_roof : int
        Likewise.
    n_houses : int
        Number of footprints.

    Returns
    -------
    tuple of 2 floats, or None
        Along x and y (m): moved by it, footprints lie on the roofs. (0, 0) where another does not fit better by
        `LEAST_GAIN`; None where there are too few houses, or the best lies at the edge of what was tried.

    Examples
    --------
    >>> house = np.array([shapely.box(0, 0, 10, 8)], object)
    >>> x, y = np.meshgrid(np.arange(-20, 30, 0.5), np.arange(-20, 30, 0.5))
    >>> xy = np.column_stack([x.ravel(), y.ravel()])
    >>> roof = (xy >= (3, -2)).all(axis=1) & (xy <= (13, 6)).all(axis=1)
    >>> dx, dy = best_shift(*score_shifts(house, xy, roof), 3)
    >>> abs(dx - 3) < 0.3, abs(dy + 2) < 0.3
    (True, True)
    """
    if n_houses < LEAST_HOUSES or n_roof == 0:
        return None
    half, best = SIDE // 2, int(scores.max())
    if best - int(scores[half, half]) < LEAST_GAIN * n_roof:
        return 0.0, 0.0
    top = scores >= best - TOP * (best - int(scores.min()))
    rows, columns = np.nonzero(top)
    weight = (scores[top] - (best - TOP * (best - scores.min()))).astype(np.float64) + 1.0
    y, x = (float(np.average(place, weights=weight) - half) * STEP for place in (rows, columns))
    peak = np.abs(np.argwhere(scores == best) - half).max()
    return None if peak >= half else (round(x, 2), round(y, 2))


def describe_shift(shift: tuple[float, float]) -> str:
    """Say how far, and where to, footprints lie beside the roofs.

    Examples
    --------
    >>> describe_shift((3.0, 0.0))
    '3.0 m to the west of'
    """
    x, y = shift
    towards = COMPASS[round(math.atan2(-y, -x) / (math.pi / 4)) % 8]
    return f"{math.hypot(x, y):.1f} m to the {towards} of"
