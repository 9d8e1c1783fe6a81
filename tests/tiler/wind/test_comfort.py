"""Comfort: classes and mean speeds worked out by hand."""

import numpy as np
import pytest

from tiler.wind.comfort import CRITERIA, LocalWind
from tiler.wind.rose import WindRose


@pytest.mark.parametrize(
    ("share", "expected"),
    [(0.0, 1), (0.0249, 1), (0.025, 2), (0.06, 3), (0.1, 4), (0.2, 5), (1.0, 5), (np.nan, 0)],
)
def test_classes_of_nen_8100(share: float, expected: int) -> None:
    assert CRITERIA["nen8100"].classify(lambda speed: np.array([share])).tolist() == [expected]


def test_danger_of_nen_8100() -> None:
    found = CRITERIA["nen8100_danger"].classify(lambda speed: np.array([0.0004, 0.0005, 0.003]))
    assert found.tolist() == [1, 2, 3]


def test_classes_of_lawson() -> None:
    """A place whose wind is over 5 m/s for 6 % of the time, over 7 m/s for 4 %, is for standing; and so on."""
    exceeded = {4.0: [0.04, 0.06, 0.5, 0.5, 0.5], 6.0: [0.0, 0.04, 0.06, 0.5, 0.5]}
    exceeded |= {8.0: [0.0, 0.0, 0.049, 0.05, 0.5], 10.0: [0.0, 0.0, 0.0, 0.01, 0.05]}
    assert CRITERIA["lawson"].classify(lambda speed: np.array(exceeded[speed])).tolist() == [1, 2, 3, 4, 5]


def test_wind_of_two_directions() -> None:
    """0.6 of the time 6 m/s from one side, 0.3 from the other at 4 m/s, 0.1 calm."""
    rose = WindRose(np.array([0.0, 180.0]), np.array([0.6, 0.3]), np.array([6.0, 4.0]), np.full(2, np.nan), 0.1)
    factors = np.array([[1.0, 0.5, np.nan], [0.5, 1.5, 1.0]])
    local = LocalWind(rose, factors, np.array([0, 1]))
    assert local.mean_speed()[:2] == pytest.approx([0.6 * 6 + 0.3 * 2, 0.6 * 3 + 0.3 * 6])
    assert np.isnan(local.mean_speed()[2])
    assert local.exceeded(5.0)[:2].tolist() == [0.6, 0.3]
    assert CRITERIA["nen8100"].classify(local.exceeded).tolist() == [5, 5, 0]


def test_two_sectors_of_one_simulated_direction_add_up() -> None:
    rose = WindRose(np.array([0.0, 10.0]), np.array([0.5, 0.5]), np.array([2.0, 8.0]), np.array([1.0, 1.0]), 0.0)
    local = LocalWind(rose, np.array([[2.0]]), np.array([0, 0]))
    assert local.mean_speed() == pytest.approx([10.0])
    assert local.exceeded(4.0) == pytest.approx([0.5 * np.exp(-1) + 0.5 * np.exp(-0.25)])
