"""Comfort of people in the wind: the criteria of NEN 8100 and of Lawson, from how often speeds are exceeded."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tiler.wind.rose import Floats, WindRose

Exceeded = Callable[[float], Floats]  # part of the time in which a speed (m/s) is exceeded, at each place
Classes = NDArray[np.uint8]
NO_CLASS = 0  # where there is no wind to speak of: houses, beyond the region


@dataclass(frozen=True)
class Criterion:
    """A scale of classes, from the best to the worst."""

    title: str  #: what it is, for people
    names: tuple[str, ...]  #: names of the classes 1, 2, ...
    speeds: tuple[float, ...]  #: speed (m/s) whose exceedance ends each class but the last
    shares: tuple[float, ...]  #: part of the time up to which it may be exceeded, for each of these

    def classify(self, exceeded: Exceeded) -> Classes:
        """Return the class of each place: the first whose speed is exceeded for less than its share of the time.

        Examples
        --------
        >>> CRITERIA["nen8100"].classify(lambda speed: np.array([0.0, 0.05, 0.3, np.nan])).tolist()
        [1, 3, 5, 0]
        """
        found = {speed: exceeded(speed) for speed in set(self.speeds)}
        first = found[self.speeds[0]]
        classes = np.full(first.shape, len(self.names), np.uint8)
        for number in range(len(self.speeds), 0, -1):
            classes[found[self.speeds[number - 1]] < self.shares[number - 1]] = number
        classes[np.isnan(first)] = NO_CLASS
        return classes


# NEN 8100:2006: mean wind at 1.75 m over 5 m/s, and over 15 m/s for danger.
# Lawson (1980, 2001) as London Docklands Development Corporation took it: speeds exceeded for 5 % of the time.
CRITERIA = {
    "nen8100": Criterion(
        "NEN 8100, comfort",
        ("A: sitting", "B: strolling, sitting short", "C: walking", "D: walking, poor", "E: poor for all"),
        (5.0,) * 4,
        (0.025, 0.05, 0.10, 0.20),
    ),
    "nen8100_danger": Criterion(
        "NEN 8100, danger", ("none", "limited risk", "dangerous"), (15.0,) * 2, (0.0005, 0.003)
    ),
    "lawson": Criterion(
        "Lawson (LDDC), comfort",
        ("sitting", "standing", "strolling", "walking", "uncomfortable"),
        (4.0, 6.0, 8.0, 10.0),
        (0.05,) * 4,
    ),
    "lawson_distress": Criterion("Lawson (LDDC), distress", ("none", "distress"), (15.0,), (0.00022,)),
}


@dataclass(frozen=True, eq=False)
class LocalWind:
    """The wind at places for all simulated directions."""

    rose: WindRose  #: the climate
    #: (d, ...): for each simulated direction the local speed over that of the undisturbed wind at the rose's
    #: height; NaN where it is unknown
    factors: Floats
    of_row: NDArray[np.int64]  #: (n,): simulated direction of each row of the rose

    def mean_speed(self) -> Floats:
        """Return the mean speed over the time at each place (m/s)."""
        weight = np.bincount(self.of_row, self.rose.share * self.rose.mean_speed(), minlength=len(self.factors))
        total = np.zeros(self.factors.shape[1:])
        for factor, part in zip(self.factors, weight.tolist(), strict=True):
            total += factor * part
        return total

    def exceeded(self, speed: float) -> Floats:
        """Return the part of the time in which the wind is faster than a speed (m/s), at each place."""
        total = np.zeros(self.factors.shape[1:])
        for row, (direction, share) in enumerate(zip(self.of_row.tolist(), self.rose.share.tolist(), strict=True)):
            total += share * self.rose.exceeded(row, self.factors[direction], speed)
        return total
