"""Histograms that tiles count and a region adds up, for percentiles in reports over many tiles."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.data.kernel import kernel
from pipeline.quality.quality import PERCENTILES, Quality

# Range and number of bins of each measure of quality: steps of 0.0005, 0.01 degrees and 0.01. The last of the
# aspect ratio reaches to the greatest.
QUALITY_BINS = {
    "radius_ratio": ((0.0, 1.0), 2_000),
    "min_dihedral": ((0.0, 90.0), 9_000),
    "aspect_ratio": ((1.0, 11.0), 1_000),
}


@dataclass(frozen=True, eq=False)
class Histogram:
    """Values counted in bins of equal width."""

    #: range of the bins. Values beyond it are counted in the first and the last one
    low: float
    high: float
    counts: NDArray[np.int64]  #: (b,): values in each bin
    #: least and greatest value, exact; infinity and minus infinity if there are none
    minimum: float
    maximum: float


def count_values(values: NDArray[np.floating], limits: tuple[float, float], bins: int) -> Histogram:
    """Count values in bins.

    Parameters
    ----------
    values : floating, (n,)
        Finite values in any order.
    limits : (low, high)
        Range of the bins.
    bins : int
        Number of bins.

    Raises
    ------
    ValueError
        If a value is not finite, the range is empty, or there are no bins.

    Examples
    --------
    >>> count_values(np.array([0.1, 0.2, 0.9, 7.0]), (0.0, 1.0), 2)
    Histogram(low=0.0, high=1.0, counts=array([2, 2]), minimum=0.1, maximum=7.0)
    """
    low, high = limits
    if not (low < high and bins > 0):
        raise ValueError(f"no histogram of {bins} bins from {low} to {high}")
    counts = np.zeros(bins, np.int64)
    least, greatest, n_finite = _count(values, float(low), float(high), counts)
    if n_finite < len(values):
        raise ValueError(f"{len(values) - n_finite} of {len(values)} values are not finite")
    return Histogram(low, high, counts, least, greatest)


def no_values(limits: tuple[float, float], bins: int) -> Histogram:
    """Histogram of no values, to which others are added."""
    return count_values(np.empty(0, np.float32), limits, bins)


@kernel
def _count(
    values: NDArray[np.floating], low: float, high: float, counts: NDArray[np.int64]
) -> tuple[float, float, int]:
    """Add values to their bins; give the least and the greatest, and the number of finite ones."""
    least, greatest, n_finite = np.inf, -np.inf, 0
    scale = len(counts) / (high - low)
    for given in values:
        value = np.float64(given)
        if np.isfinite(value):
            place = int(np.floor((min(max(value, low), high) - low) * scale))
            counts[min(place, len(counts) - 1)] += 1
            least, greatest = min(least, value), max(greatest, value)
            n_finite += 1
    return least, greatest, n_finite


def merge_histograms(parts: Sequence[Histogram]) -> Histogram:
    """Add up histograms of the same bins, in any order.

    Raises
    ------
    ValueError
        If there are no parts, or their bins differ.
    """
    bins = {(part.low, part.high, len(part.counts)) for part in parts}
    if len(bins) != 1:
        raise ValueError(f"cannot merge {len(parts)} histograms of {len(bins)} different bins")
    counts = np.zeros(len(parts[0].counts), np.int64)
    for part in parts:
        counts += part.counts
    return Histogram(
        parts[0].low,
        parts[0].high,
        counts,
        min(part.minimum for part in parts),
        max(part.maximum for part in parts),
    )


def share_below(histogram: Histogram, value: float) -> float:
    """Share of the values below one that parts two bins; NaN without values.

    Raises
    ------
    ValueError
        If `value` is within a bin, or not in the range.

    Examples
    --------
    >>> share_below(count_values(np.array([0.1, 0.24, 0.25, 7.0]), (0.0, 1.0), 4), 0.25)
    0.5
    """
    width = (histogram.high - histogram.low) / len(histogram.counts)
    place = round((value - histogram.low) / width)
    if not 0 < place < len(histogram.counts) or abs(histogram.low + place * width - value) > 1e-6 * width:
        raise ValueError(f"{value} is no border of bins of {width:g} from {histogram.low:g} to {histogram.high:g}")
    n = int(histogram.counts.sum())
    return int(histogram.counts[:place].sum()) / n if n else float("nan")


def percentile(histogram: Histogram, percent: float) -> float:
    """Estimate a percentile of the values that were counted, as `numpy.percentile` defines it.

    Parameters
    ----------
    histogram : Histogram
        Counts.
    percent : float
        0 to 100; these two are exact.

    Returns
    -------
    float
        Within a bin's width of that of the values themselves, as long as these lie in the range; NaN without
        values.

    Notes
    -----
    The values of a bin are taken to be spread evenly over it; the first and the last bin reach to the least and
    the greatest value, if these lie beyond the range.

    Examples
    --------
    >>> counted = count_values(np.array([1.0, 3.0, 4.0]), (0.0, 10.0), 10)
    >>> [percentile(counted, percent) for percent in (0, 25, 50, 100)]
    [1.0, 2.25, 3.5, 4.0]
    """
    if not 0 <= percent <= 100:
        raise ValueError(f"percentile {percent} is not between 0 and 100")
    up_to = np.cumsum(histogram.counts)
    n = int(up_to[-1])
    if not n:
        return float("nan")
    position = (n - 1) * (percent / 100)
    rank = min(int(position), n - 1)
    below = _value_of_rank(histogram, up_to, rank)
    above = _value_of_rank(histogram, up_to, min(rank + 1, n - 1))
    return below + (above - below) * (position - rank)


def quality_histograms(quality: Quality) -> dict[str, Histogram]:
    """Count each measure of the cells of a tile."""
    return {
        name: count_values(getattr(quality, name), limits, bins) for name, (limits, bins) in QUALITY_BINS.items()
    }


def histogram_percentiles(histograms: Mapping[str, Histogram]) -> dict[str, dict[str, float]]:
    """Percentiles by name and percentile: the table of `quality.quality_percentiles`, from histograms.

    Parameters
    ----------
    histograms : mapping of str to Histogram
        As from `quality_histograms`, merged by name.
    """
    return {
        name: {f"{percent:g}": round(percentile(histogram, percent), 4) for percent in PERCENTILES}
        for name, histogram in histograms.items()
    }


def _value_of_rank(histogram: Histogram, up_to: NDArray[np.int64], rank: int) -> float:
    if rank in {0, int(up_to[-1]) - 1}:
        return histogram.minimum if rank == 0 else histogram.maximum
    bins = len(up_to)
    k = int(np.searchsorted(up_to, rank, side="right"))
    width = (histogram.high - histogram.low) / bins
    start = histogram.low + k * width if k else min(histogram.low, histogram.minimum)
    end = histogram.low + (k + 1) * width if k < bins - 1 else max(histogram.high, histogram.maximum)
    count = int(histogram.counts[k])
    before = int(up_to[k]) - count
    value = start + (end - start) * ((rank - before + 0.5) / count)
    return min(max(value, histogram.minimum), histogram.maximum)
