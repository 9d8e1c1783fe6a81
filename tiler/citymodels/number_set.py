"""A set of 64-bit numbers that grows: 8 bytes a number, and as quick to ask when it has millions."""

import numpy as np
from numpy.typing import NDArray


class NumberSet:
    """Numbers that were added so far, in sorted arrays, each at least twice as long as the next.

    Notes
    -----
    Two arrays that are nearly as long are merged, so each number is moved some log2(n) times in all, and asked for
    in some log2(n) arrays. To sort all anew for every block makes a country quadratic.

    Examples
    --------
    >>> seen = NumberSet()
    >>> seen.add(np.array([5, 3, 9]))
    >>> seen.has(np.array([3, 4, 9])).tolist()
    [True, False, True]
    """

    def __init__(self) -> None:
        self._arrays: list[NDArray[np.int64]] = []

    def add(self, numbers: NDArray[np.int64]) -> None:
        """Add numbers, int64 (n,), in any order; one that is there already counts once more in memory."""
        if len(numbers):
            self._arrays.append(np.sort(numbers))
        while len(self._arrays) > 1 and len(self._arrays[-2]) < 2 * len(self._arrays[-1]):
            last = self._arrays.pop()
            # Stable sorting merges two runs that are sorted in one pass.
            self._arrays[-1] = np.sort(np.concatenate((self._arrays[-1], last)), kind="stable")

    def has(self, numbers: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Tell of each number whether it was added, bool (n,)."""
        found = np.zeros(len(numbers), np.bool_)
        for array in self._arrays:
            place = np.minimum(np.searchsorted(array, numbers), len(array) - 1)
            found |= array[place] == numbers
        return found
