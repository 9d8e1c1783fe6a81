"""The rhythm of a façade: storeys and columns of windows, by how its rectified image repeats.

Edges along the storeys and along the columns are summed over the image. The lag at which these sums repeat best
is the height of a storey, or the width of a bay. All bays laid over each other give one, in which the window is
what differs from the wall.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
STOREY, BAY = (2.3, 6.0), (1.2, 9.0)  # m, least and most
LEAST_MATCH = 0.25  # of the autocorrelation, 1 for an image that repeats exactly
NEARLY = 0.9  # of the best match: the shortest lag from here on is taken, not a multiple of it


@dataclass(frozen=True)
class Beat:
    """What repeats along one axis: ``n`` pieces of ``size`` from ``start`` on (m), and how well, up to 1."""

    start: float
    size: float
    n: int
    match: float


@dataclass(frozen=True)
class Rhythm:
    """A façade's storeys from below, its bays from the left, and the window of a bay."""

    #: what repeats upwards and to the right
    storeys: Beat
    bays: Beat
    #: (float, float, float): width and height of a window, and its sill above the lower side of its storey (m); it
    #: is in the middle of its bay
    window: tuple[float, float, float]


def find_rhythm(grey: Array, width: float, height: float) -> Rhythm:
    """Find storeys, bays and windows of a façade.

    Parameters
    ----------
    grey : float64 (h, w)
        Rectified image of the façade alone, its first row at the top.
    width, height : float
        Of the façade (m).

    Raises
    ------
    ValueError
        If nothing repeats along an axis, with the axis and the match.
    """
    down, right = height / grey.shape[0], width / grey.shape[1]
    rows = np.abs(np.diff(grey, axis=0)).mean(axis=1)[::-1]
    columns = np.abs(np.diff(grey, axis=1)).mean(axis=0)
    tall, tall_match = _period(rows, down, STOREY, "upwards")
    wide, wide_match = _period(columns, right, BAY, "along the wall")
    inner_rows = _spread(grey, 1)[::-1]  # brightness differs most along rows with windows
    inner_columns = _spread(grey, 0)
    storeys = _place(inner_rows, down, tall, tall_match)
    bays = _place(inner_columns, right, wide, wide_match)
    mean = _mean_bay(grey[::-1], storeys, bays, down, right)
    low, high = _extent(np.abs(mean - _wall_of(mean)), axis=1)
    left, stop = _extent(np.abs(mean - _wall_of(mean)), axis=0)
    step_up, step_right = storeys.size / mean.shape[0], bays.size / mean.shape[1]
    window = ((stop - left) * step_right, (high - low) * step_up, low * step_up)
    return Rhythm(storeys, bays, window)


def _period(profile: Array, step: float, bounds: tuple[float, float], axis: str) -> tuple[float, float]:
    """Find the shortest lag (m) at which a profile repeats about as well as it does at any, and its match."""
    smooth = np.convolve(profile, np.ones(5) / 5, "same")
    signal = smooth - smooth.mean()
    least, most = int(bounds[0] / step), min(int(bounds[1] / step) + 1, int(len(signal) / 1.8))
    if least < 2 or most <= least + 2 or not signal.any():
        raise ValueError(f"{axis} the image has {len(profile)} pixels for {len(profile) * step:.1f} m: too few")
    match = np.full(most + 2, -1.0)
    for lag in range(least - 1, most + 2):
        a, b = signal[:-lag], signal[lag:]
        match[lag] = float((a * b).sum() / np.sqrt((a * a).sum() * (b * b).sum() + 1e-12))
    peaks = [k for k in range(least, most + 1) if match[k] >= match[k - 1] and match[k] >= match[k + 1]]
    best = max((match[k] for k in peaks), default=-1.0)
    if best < LEAST_MATCH:
        raise ValueError(f"nothing repeats {axis}: the best match is {best:.2f}; bound: {LEAST_MATCH}")
    lag = next(k for k in peaks if match[k] >= NEARLY * best)
    return _peak(match, lag) * step, float(match[lag])


def _peak(match: Array, lag: int) -> float:
    """Give the place of a peak between whole lags, by a parabola."""
    a, b, c = match[lag - 1 : lag + 2].tolist()
    bend = a - 2 * b + c
    return lag + (0.5 * (a - c) / bend if bend < 0 else 0.0)


def _spread(grey: Array, axis: int) -> Array:
    found: Array = np.percentile(grey, 85, axis=axis) - np.percentile(grey, 15, axis=axis)
    return found


def _place(profile: Array, step: float, size: float, match: float) -> Beat:
    """Place pieces of a size so that the middles of windows are in theirs, and as many as have windows."""
    middle = (np.arange(len(profile)) + 0.5) * step
    weight = profile - profile.min()
    angle = np.angle((weight * np.exp(2j * np.pi * middle / size)).sum())
    first = (float(angle) / (2 * np.pi) % 1) * size - size / 2
    length = len(profile) * step
    starts = np.arange(first, length, size)
    level = float(np.median(weight)) / 2
    kept = [
        float(start) for start in starts
        if start > -0.12 * size and start + size < length + 0.12 * size
        and weight[(middle > start + size / 3) & (middle < start + 2 * size / 3)].mean() > level
    ]  # fmt: skip
    start = max(kept[0], 0.0) if kept else 0.0
    return Beat(start, size, max(len(kept), 1), match)


def _mean_bay(upwards: Array, storeys: Beat, bays: Beat, down: float, right: float) -> Array:
    """Give the median of all bays, as an image whose first row is the lowest."""
    h, w = max(int(storeys.size / down), 2), max(int(bays.size / right), 2)
    found = []
    for j in range(storeys.n):
        for i in range(bays.n):
            row, column = (
                round((storeys.start + j * storeys.size) / down),
                round((bays.start + i * bays.size) / right),
            )
            part = upwards[row : row + h, column : column + w]
            if part.shape == (h, w):
                found.append(part)
    median: Array = np.median(found, axis=0) if found else upwards[:h, :w]
    return median


def _wall_of(mean: Array) -> float:
    """Give the brightness of the wall: the median around the bay."""
    rim = np.concatenate((mean[0], mean[-1], mean[:, 0], mean[:, -1]))
    return float(np.median(rim))


def _extent(off: Array, axis: int) -> tuple[int, int]:
    """Give the first and the last place along the other axis above half of the most."""
    profile = np.percentile(off, 75, axis=axis)
    inside = np.concatenate(([False], profile > 0.5 * profile.max(), [False]))
    change = np.flatnonzero(np.diff(inside.astype(int)))
    runs = change.reshape(-1, 2)
    return (int(runs[0, 0]), int(runs[-1, 1])) if len(runs) else (0, len(profile))
