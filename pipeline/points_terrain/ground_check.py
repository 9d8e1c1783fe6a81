"""Whether class 2 is ground in a cloud: other numberings would lay the terrain over roofs and trees (step 1.1)."""

import numpy as np
from numpy.typing import NDArray

from pipeline.data.classes import GROUND, UNCLASSIFIED

LEAST_POINTS = 20  # of each class in a cell that is looked at
LEAST_SHARE = 0.2  # of the points of class 2 in a cell, that those of no class must be: they may be ground
LEAST_STEP = 1.0  # m that class 2 is higher on average; what has no class is higher than real ground
LEAST_ROUGHNESS = (
    0.5  # m that class 2 is rougher, as standard deviation; a quay is smoother than what is on its water
)
HIGHER_THAN_QUAYS = 5.0  # m from which class 2 may be as smooth as a flat roof
LEAST_CELLS = 2
SAMPLE = 100_000  # points that are compared at most


def compare_ground(
    z: NDArray[np.float64], classification: NDArray[np.uint8], start: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Compare the heights of class 2 with those of points without a class (0 and 1), in cells.

    Parameters
    ----------
    z : float64, (n,)
        Heights (m), cell by cell.
    classification : uint8, (n,)
        ASPRS classes.
    start : int64, (c + 1,)
        Cell ``k`` has the points ``start[k]`` to ``start[k + 1]``.

    Returns
    -------
    float64, (k,)
        How much higher class 2 is on average (m), for the cells that have enough of both; 0 where it is smooth and
        less than 5 m higher, as a quay.

    Examples
    --------
    >>> z = np.concatenate((np.zeros(50), np.linspace(5, 9, 50)))
    >>> compare_ground(z, np.repeat(np.array([1, 2], np.uint8), 50), np.array([0, 100])).round(2)
    array([7.])
    """
    n_cells = len(start) - 1
    chosen = np.arange(0, len(z), max(len(z) // SAMPLE, 1))
    cell = np.repeat(np.arange(n_cells), np.diff(start))[chosen]
    z, classification = z[chosen], classification[chosen]
    ground, other = classification == GROUND, classification <= UNCLASSIFIED
    n_ground, n_other = (np.bincount(cell[rows], minlength=n_cells) for rows in (ground, other))
    enough = (n_ground >= LEAST_POINTS) & (n_other >= np.maximum(LEAST_POINTS, LEAST_SHARE * n_ground))
    mean, deviation = [], []
    for rows, n in ((ground & enough[cell], n_ground), (other & enough[cell], n_other)):
        centre = np.bincount(cell[rows], z[rows], n_cells) / np.maximum(n, 1)
        squares = np.bincount(cell[rows], (z[rows] - centre[cell[rows]]) ** 2, n_cells) / np.maximum(n, 1)
        mean.append(centre[enough])
        deviation.append(np.sqrt(squares[enough]))
    steps: NDArray[np.float64] = mean[0] - mean[1]
    steps[(steps < HIGHER_THAN_QUAYS) & (deviation[0] <= deviation[1] + LEAST_ROUGHNESS)] = 0.0
    return steps


def is_upside_down(steps: NDArray[np.float64]) -> bool:
    """Tell whether class 2 is no ground: it lies above the points without a class in most cells.

    Examples
    --------
    >>> is_upside_down(np.array([9.0, 8.0, -1.0])), is_upside_down(np.array([9.0, -3.0, -3.0]))
    (True, False)
    """
    high = int((steps > LEAST_STEP).sum())
    return high >= LEAST_CELLS and high > len(steps) / 2
