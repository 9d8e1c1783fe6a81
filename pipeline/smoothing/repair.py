"""The monotone repair of columns after steps 3.3 and 3.5: no inverted cell, ever.

A cell is inverted exactly where a column does not ascend. The repair looks at one column at a time, so
its result does not depend on tiles; levels that are given (ground, roofs) stay.
"""

import numpy as np
from numpy.typing import NDArray

from pipeline.data.errors import GeometryError
from pipeline.data.kernel import kernel


def repair_columns(
    z: NDArray[np.float64], kept: NDArray[np.int32], fixed: NDArray[np.bool_], *, min_gap: float
) -> tuple[NDArray[np.float64], int]:
    """Move levels so that every column ascends by at least `min_gap`.

    Parameters
    ----------
    z : float64, (n, l)
        Heights (m).
    kept : int32, (n,)
        First level of each column that a cell uses; lower ones are passed over.
    fixed : bool, (n, l)
        Levels that stay.
    min_gap : float
        Least distance between levels (m). Between two fixed levels that are too close for it, half of
        what an even spacing would give.

    Returns
    -------
    float64, (n, l)
        Heights; a column that ascends already is untouched.
    int
        Number of levels moved.

    Raises
    ------
    GeometryError
        If two fixed levels of a column do not ascend.
    """
    result = z.copy()
    moved, broken = _repair(result, kept, fixed, min_gap)
    if broken >= 0:
        raise GeometryError(
            f"column {broken}: two given heights do not ascend ({np.round(z[broken], 3).tolist()} m); "
            "raise --roof-clearance or mend the building there"
        )
    return result, moved


@kernel
def _repair(
    z: NDArray[np.float64], kept: NDArray[np.int32], fixed: NDArray[np.bool_], min_gap: float
) -> tuple[int, int]:
    n, levels = z.shape
    moved = 0
    for i in range(n):
        ascends = True
        for k in range(kept[i], levels - 1):
            ascends &= z[i, k + 1] - z[i, k] >= min_gap
        low = kept[i]
        while not ascends and low < levels - 1:
            high = low + 1
            while high < levels and not fixed[i, high]:
                high += 1
            gap = min_gap
            if high < levels:
                if z[i, high] <= z[i, low]:
                    return moved, i
                gap = min(min_gap, 0.5 * (z[i, high] - z[i, low]) / (high - low))
            for k in range(low + 1, min(high, levels)):
                value = max(z[i, k], z[i, k - 1] + gap)
                if high < levels:
                    value = min(value, z[i, high] - (high - k) * gap)
                if value != z[i, k]:
                    z[i, k] = value
                    moved += 1
            low = high
    return moved, -1
