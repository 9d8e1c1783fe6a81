"""Vertical spacing that grows from the ground: a first layer of given height, each next one higher by a ratio.

At the height h above the ground the step upwards is min(s, M + (G - 1) h): M, M G, M G^2 and so on until s, the
spacing of the place without growth. Between these heights, steps are counted linearly. Only sums and products are
taken, so that the result is the same on every machine.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.data.kernel import kernel

# Levels where steps have half of their full height may move; the second one above the ground is the first.
MOVABLE_STEP = 0.5
ABOVE_FIRST = 1.5  # first layers


@dataclass(frozen=True)
class Growth:
    """How vertical spacing grows from the ground.

    Raises
    ------
    ValueError
        If one of them is out of bounds.
    """

    first: float  #: height M of the first layer above open ground (m), above 0
    ratio: float  #: ratio G of a layer's height to that of the layer below it, at least 1

    def __post_init__(self) -> None:
        if not (0 < self.first < np.inf and 1 <= self.ratio < np.inf):
            raise ValueError(f"first layer {self.first} m, ratio {self.ratio}; expected above 0, and 1 or more")


def full_height(spacing: float | NDArray[np.float64], growth: Growth) -> NDArray[np.float64]:
    """Height above the ground at which steps have grown to a spacing (m); infinite where they never do.

    Parameters
    ----------
    spacing : float or float64, (n,)
        Spacing without growth (m).
    growth : Growth
        First layer and ratio.

    Examples
    --------
    >>> full_height(np.array([8.0, 0.5]), Growth(1.0, 1.25)).tolist()
    [28.0, 0.0]
    """
    missing = np.maximum(np.asarray(spacing, np.float64) - growth.first, 0.0)
    if growth.ratio == 1:
        return np.where(missing > 0, np.inf, 0.0)
    height: NDArray[np.float64] = missing / (growth.ratio - 1)
    return height


def movable_height(spacing: NDArray[np.float64], growth: Growth) -> NDArray[np.float64]:
    """Height above the ground from which levels may be moved without spoiling the lowest layers (m), (n,).

    Parameters
    ----------
    spacing : float64, (n,)
        Spacing of each column without growth (m).
    growth : Growth
        First layer and ratio.
    """
    height = np.maximum(full_height(MOVABLE_STEP * spacing, growth), ABOVE_FIRST * growth.first)
    return np.where(full_height(spacing, growth) == 0, 0.0, height)


def layer_levels(height: float, spacing: float, growth: Growth) -> NDArray[np.float64]:
    """Cut a slab into layers of growing height, at least two.

    Parameters
    ----------
    height : float
        Height of the slab (m).
    spacing : float
        Height that layers grow to (m).
    growth : Growth
        First layer and ratio.

    Returns
    -------
    float64, (l,)
        Heights of the levels above the bottom (m), from 0 to `height`: those of the closest whole number of
        layers, all stretched or squeezed by the same part of a step.

    Examples
    --------
    >>> layer_levels(7.0, 2.0, Growth(1.0, 2.0)).tolist()
    [0.0, 1.0, 3.0, 5.0, 7.0]
    """
    steps = count_steps(height, spacing, growth.first, growth.ratio)
    n = max(int(np.floor(steps + 0.5)), 2)
    levels = [height_of_steps(k * (steps / n), spacing, growth.first, growth.ratio) for k in range(n)]
    return np.array([*levels, height])


@kernel
def count_steps(height: float, spacing: float, first: float, ratio: float) -> float:
    """Number of steps from the ground up to a height (m), the last one in part."""
    steps, step = 0.0, min(first, spacing)
    while step < spacing and height >= step:
        height -= step
        steps += 1
        step = min(step * ratio, spacing)
    return steps + height / step


@kernel
def height_of_steps(steps: float, spacing: float, first: float, ratio: float) -> float:
    """Height above the ground (m) that a number of steps leads to: the inverse of `count_steps`."""
    height, step = 0.0, min(first, spacing)
    while step < spacing and steps >= 1:
        height += step
        steps -= 1
        step = min(step * ratio, spacing)
    return height + steps * step


@kernel
def stagger_weight(height: float, spacing: float, first: float, ratio: float) -> float:
    """Part of its shift that a level keeps: nothing in the first layer, all of it where steps are full."""
    if first >= spacing:
        return 1.0
    weight = (height - first) * (ratio - 1) / (spacing - first)
    return min(max(weight, 0.0), 1.0)
