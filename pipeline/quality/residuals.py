"""Residuals of heights: their sums, which tiles add up, and what is told of them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.data.kernel import kernel
from pipeline.quality.histograms import Histogram, count_values, merge_histograms, percentile

UNIT = 1e-4  # m; residuals are summed as whole numbers of it, so that the order does not matter
HISTOGRAM_LIMITS = (0.0, 50.0)  # m, of absolute residuals
HISTOGRAM_BINS = 5_000  # of 1 cm


@dataclass(frozen=True)
class Residuals:
    """Heights of the model minus heights of the points."""

    n: int  #: number of points; the other values are NaN if there are none
    rmse: float  #: root of the mean square (m)
    #: percentiles of the absolute values (m)
    p50: float
    p95: float
    bias: float  #: mean (m), positive where the model is too high


@dataclass(frozen=True, eq=False)
class ResidualSums:
    """Sums of residuals."""

    n: int  #: number of points
    total: int  #: sum of the residuals, each rounded to 1e-4 m, in this unit
    squares: int  #: sum of their squares, in this unit squared. It may exceed 64 bits
    absolute: Histogram  #: absolute values (m) in bins of 1 cm up to 50 m


def sum_residuals(residual: NDArray[np.float64]) -> ResidualSums:
    """Sum up residuals (m), which are finite, in any order.

    Examples
    --------
    >>> sums = sum_residuals(np.array([-1.0, 1.0, 3.0, -3.0]))
    >>> sums.n, sums.total, sums.squares
    (4, 0, 2000000000)
    """
    absolute = count_values(np.abs(residual), HISTOGRAM_LIMITS, HISTOGRAM_BINS)
    total, upper, lower = _sum_units(residual)
    return ResidualSums(len(residual), int(total), (int(upper) << 32) + int(lower), absolute)


@kernel
def _sum_units(residual: NDArray[np.float64]) -> tuple[int, int, int]:
    """Sum of residuals in `UNIT`, and of their squares in two halves, neither of which can overflow 64 bits."""
    total = upper = lower = 0
    for value in residual:
        units = int(np.rint(value / UNIT))
        square = units * units
        total += units
        upper += square >> 32
        lower += square & 0xFFFFFFFF
    return total, upper, lower


def merge_residuals(parts: Sequence[ResidualSums]) -> ResidualSums:
    """Add up the sums of tiles, in any order.

    Raises
    ------
    ValueError
        If there are no parts.
    """
    return ResidualSums(
        sum(part.n for part in parts),
        sum(part.total for part in parts),
        sum(part.squares for part in parts),
        merge_histograms([part.absolute for part in parts]),
    )


def conclude(sums: ResidualSums) -> Residuals:
    """Say what the sums tell.

    Returns
    -------
    Residuals
        RMSE and bias differ from those of `summarise` by the rounding to 1e-4 m alone; the percentiles by up to
        1 cm below 50 m.

    Examples
    --------
    >>> found = conclude(sum_residuals(np.array([-1.0, 1.0, 3.0, -3.0])))
    >>> found.n, round(found.rmse, 3), found.bias
    (4, 2.236, 0.0)
    """
    if not sums.n:
        nan = float("nan")
        return Residuals(0, nan, nan, nan, nan)
    return Residuals(
        sums.n,
        (sums.squares / sums.n) ** 0.5 * UNIT,
        percentile(sums.absolute, 50),
        percentile(sums.absolute, 95),
        sums.total / sums.n * UNIT,
    )


def summarise(residual: NDArray[np.float64]) -> Residuals:
    """Summarise residuals (m) in any order, exactly.

    Examples
    --------
    >>> summarise(np.array([-1.0, 1.0, 3.0, -3.0]))
    Residuals(n=4, rmse=2.23606797749979, p50=2.0, p95=3.0, bias=0.0)
    """
    if not len(residual):
        nan = float("nan")
        return Residuals(0, nan, nan, nan, nan)
    residual = np.sort(residual)
    p50, p95 = np.percentile(np.abs(residual), [50, 95])
    return Residuals(
        len(residual), float(np.sqrt(np.mean(residual**2))), float(p50), float(p95), float(residual.mean())
    )
