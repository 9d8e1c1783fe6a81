"""What attributes of footprints say of their roofs, in numbers: one row a footprint (step 1.2)."""

import numpy as np
from numpy.typing import NDArray

# The shapes that a roof may be given, in the words of ``roof:shape`` of OpenStreetMap.
ROOF_SHAPES = ("flat", "skillion", "hipped", "pyramidal", "gabled", "half-hipped", "mansard", "gambrel")
# Columns of an array of forms, float64 (n, 6); NaN where nothing is said, in all columns where there is no shape:
# the index into `ROOF_SHAPES`; the height of the roof from the eaves to its highest ridge (m); its slope;
# where it looks downhill (degrees clockwise from north); 1 for a ridge along the shorter side, 0 for the longer;
# 1 where the height of the footprint is that of the eaves, as levels count, and not that of the ridge.
SHAPE, HEIGHT, SLOPE, DIRECTION, ACROSS, TO_EAVES = range(6)
N_COLUMNS = 6
# What became of the form of a house, besides the index of its shape where the house has it: negative codes.
NO_FORM = -1
POINTS_TELL, TOO_LOW, NO_SKELETON, NO_HEIGHT = -2, -3, -4, -5


def block_forms(level: int, x: float, y: float) -> NDArray[np.float64]:
    """Give a block of generalised buildings its form, float64 (6,): flat.

    No roof has a negative slope: its own is -`level`, 1 or more. The next two columns, which no flat roof needs,
    are the place that decides on its zone (m).

    Examples
    --------
    >>> level, place = find_blocks(np.array([block_forms(3, 10.0, 20.0)]))
    >>> level.tolist(), place.tolist()
    ([3], [[10.0, 20.0]])
    """
    form = np.full(N_COLUMNS, np.nan)
    form[[SHAPE, SLOPE, DIRECTION, ACROSS]] = ROOF_SHAPES.index("flat"), -level, x, y
    return form


def find_blocks(forms: NDArray[np.float64]) -> tuple[NDArray[np.int8], NDArray[np.float64]]:
    """Level, int8 (n,), and place, float64 (n, 2), of those that are blocks; -1 and NaN of all others."""
    block = forms[:, SLOPE] < 0
    place = np.where(block[:, None], forms[:, [DIRECTION, ACROSS]], np.nan)
    return np.where(block, -forms[:, SLOPE], -1).astype(np.int8), place


def no_forms(n: int) -> NDArray[np.float64]:
    """Give n footprints no form, float64 (n, 6)."""
    return np.full((n, N_COLUMNS), np.nan)
