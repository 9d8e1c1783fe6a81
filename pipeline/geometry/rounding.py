"""Polygons rounded to a grid without a noder, where one would change nothing (steps 1.7, 2.1 and 2.4)."""

import numpy as np
import shapely
from numpy.typing import NDArray

CLEAR = 4  # spacings; corners and walls that are farther apart are out of a noder's reach
HALF = 0.499  # of a spacing; what lies farther from the grid is rounded to either side


def round_corners(polygons: NDArray[np.object_], grid: float) -> tuple[NDArray[np.object_], NDArray[np.bool_]]:
    """Round corners to a grid, and tell where that is all that noding on it would do.

    Parameters
    ----------
    polygons : object, (n,)
        shapely Polygons.
    grid : float
        Spacing of the grid.

    Returns
    -------
    rounded : object, (n,)
        The polygons with rounded corners, ring by ring; they may be invalid or have no area where not clear.
    clear : bool, (n,)
        True for a valid polygon whose corners and walls stay apart by more than `CLEAR` spacings, and none of
        whose corners is half way between two places; False for an empty one.

    Examples
    --------
    >>> rounded, clear = round_corners(np.array([shapely.box(0.1, 0, 9.2, 9), shapely.box(0, 0, 9, 2)]), 1.0)
    >>> rounded[0], clear.tolist()
    (<POLYGON ((9 0, 9 9, 0 9, 0 0, 9 0))>, [True, False])
    """
    xy, owner = shapely.get_coordinates(polygons, return_index=True)
    steps = xy / grid
    places = np.rint(steps)
    doubtful = (np.abs(steps - places) > HALF).any(axis=1)
    doubtful[1:] |= (places[1:] == places[:-1]).all(axis=1) & (owner[1:] == owner[:-1])
    rounded: NDArray[np.object_] = shapely.set_coordinates(polygons.copy(), places * grid)
    clear = (np.bincount(owner, doubtful, len(polygons)) == 0) & ~shapely.is_empty(polygons)
    clear &= (shapely.minimum_clearance(rounded) > CLEAR * grid) & shapely.is_valid(rounded)
    return rounded, clear
