"""Step 1.1: whether class 2 is ground."""

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.points_terrain.ground_check import compare_ground, is_upside_down

Heights = tuple[float, float]  # mean and standard deviation (m)
CELLS, N = 4, 1000


def upside_down(
    ground: Heights, other: Heights, *, share: float = 0.5, slope: float = 0.0, number: int = 1
) -> bool:
    """What is said of cells with points of class 2 and of another, on a slope (m from side to side)."""
    rng = np.random.default_rng(1)
    classes = np.where(rng.random(CELLS * N) < share, number, 2).astype(np.uint8)
    z: NDArray[np.float64] = np.where(
        classes == 2, rng.normal(*ground, CELLS * N), rng.normal(*other, CELLS * N)
    ) + slope * rng.random(CELLS * N)
    return is_upside_down(compare_ground(z, classes, np.arange(0, CELLS * N + 1, N)))


@pytest.mark.parametrize(
    ("ground", "other", "slope"),
    [
        ((8.0, 4.0), (0.0, 0.1), 0.0),  # plants over ground, as in DALES
        ((8.0, 4.0), (0.0, 0.1), 20.0),
        ((3.0, 3.0), (0.0, 1.0), 0.0),  # all that is not ground over it, as in Flanders' first model
        ((7.0, 0.1), (0.0, 0.1), 0.0),  # flat roofs alone
        ((7.0, 0.1), (0.0, 0.1), 20.0),
    ],
)
@pytest.mark.parametrize("number", [0, 1])
def test_what_lies_over_the_rest_is_no_ground(ground: Heights, other: Heights, slope: float, number: int) -> None:
    assert upside_down(ground, other, slope=slope, number=number)


@pytest.mark.parametrize(
    ("ground", "other", "share"),
    [
        ((0.0, 0.1), (6.0, 4.0), 0.5),  # trees and roofs
        ((0.0, 0.1), (0.0, 0.2), 0.5),  # points close to the ground
        ((2.5, 0.2), (0.0, 1.0), 0.5),  # quays over water without a class, with boats
        ((9.0, 6.0), (0.0, 6.0), 0.1),  # few points without a class: under a bridge
        ((0.0, 0.1), (-300.0, 50.0), 0.01),  # low noise
    ],
)
@pytest.mark.parametrize("slope", [0.0, 20.0])
def test_real_ground_is_ground(ground: Heights, other: Heights, share: float, slope: float) -> None:
    assert not upside_down(ground, other, share=share, slope=slope)


def test_other_classes_do_not_count() -> None:
    assert not upside_down((8.0, 4.0), (0.0, 0.1), number=9)


def test_no_points_say_nothing() -> None:
    steps = compare_ground(np.empty(0), np.empty(0, np.uint8), np.zeros(1, np.int64))
    assert not is_upside_down(steps)
