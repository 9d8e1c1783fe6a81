"""Wind roses: how often the undisturbed wind comes from where, and how fast."""

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.data.errors import InputError

Floats = NDArray[np.float64]
WEIBULL = ("direction", "share", "scale", "shape")
TABLE = ("direction", "speed", "share")
MARGIN = 1e-3  # by which shares may add up to more than all


@dataclass(frozen=True, eq=False)
class WindRose:
    """The climate of the wind at the reference height, ``n`` rows."""

    direction: Floats  #: (n,): where the wind comes from (degrees from north)
    share: Floats  #: (n,): part of the time; they add up to 1 less `calm`
    speed: Floats  #: (n,): weibull's scale, or where `shape` is NaN the speed itself (m/s)
    shape: Floats  #: (n,): weibull's shape
    calm: float  #: part of the time without wind

    def mean_speed(self) -> Floats:
        """Return the mean speed of each row (m/s), (n,).

        Examples
        --------
        >>> rose = WindRose(np.zeros(2), np.full(2, 0.5), np.array([4.0, 4.0]), np.array([2.0, np.nan]), 0.0)
        >>> rose.mean_speed().round(4).tolist()
        [3.5449, 4.0]
        """
        known = np.nan_to_num(self.shape, nan=1.0)
        factor = np.array([math.gamma(1 + 1 / shape) for shape in known.tolist()])
        return np.where(np.isnan(self.shape), self.speed, self.speed * factor)

    def exceeded(self, row: int, factor: Floats, speed: float) -> Floats:
        """Return the part of a row's time in which a local wind is faster than a speed.

        Parameters
        ----------
        row : int
            Which row.
        factor : float64, any shape
            Local speed over that at the reference height; NaN where it is unknown, which stays.
        speed : float
            The speed (m/s).

        Examples
        --------
        >>> rose = WindRose(np.zeros(1), np.ones(1), np.array([5.0]), np.array([1.0]), 0.0)
        >>> rose.exceeded(0, np.array([0.0, 1.0, np.nan]), 5.0).round(4).tolist()
        [0.0, 0.3679, nan]
        """
        scale, shape = float(self.speed[row]), float(self.shape[row])
        if math.isnan(shape):
            return np.where(np.isnan(factor), np.nan, factor * scale > speed)
        with np.errstate(divide="ignore"):
            ratio = speed / (factor * scale)
        return np.exp(-(ratio**shape))


def read_rose(path: Path) -> WindRose:
    """Read a wind rose from a CSV file.

    Parameters
    ----------
    path : Path
        With the columns ``direction, share, scale, shape`` (a Weibull distribution a sector), or ``direction,
        speed, share`` (a row a sector and class of speed). Shares are parts of 1, or percent if they add up to
        more than 1; what is left to all is calm.

    Raises
    ------
    InputError
        If it cannot be read, has other columns, or a value that cannot be.
    """
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file, skipinitialspace=True)
            names = tuple(name.strip().lower() for name in reader.fieldnames or ())
            rows = [dict(zip(names, row.values(), strict=False)) for row in reader]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: cannot be read as CSV ({error}); give a wind rose, see docs/wind.md") from None
    columns = next((some for some in (WEIBULL, TABLE) if set(some) <= set(names)), None)
    if columns is None or not rows:
        raise InputError(
            f"{path}: {len(rows)} rows of {', '.join(names) or 'no columns'}; a wind rose has rows of "
            f"{', '.join(WEIBULL)} or of {', '.join(TABLE)}"
        )
    values = np.array([_read_row(path, number, row, columns) for number, row in enumerate(rows, start=2)])
    return _make_rose(path, dict(zip(columns, values.T, strict=True)))


def _read_row(path: Path, number: int, row: Mapping[str, str | None], columns: Sequence[str]) -> list[float]:
    values = []
    for name in columns:
        try:
            value = float(row.get(name) or "")
        except ValueError:
            value = math.nan
        positive = value > 0 if name in ("scale", "shape") else value >= 0
        if not math.isfinite(value) or not (positive or name == "direction"):
            bound = "more than 0" if name in ("scale", "shape") else "a number from 0 on"
            raise InputError(f"{path}: line {number}: {name} is {row.get(name)!r}, must be {bound}")
        values.append(value)
    return values


def _make_rose(path: Path, columns: Mapping[str, Floats]) -> WindRose:
    share = columns["share"]
    total = float(share.sum())
    whole = 1.0 if total <= 1 + MARGIN else 100.0
    if not 0 < total <= whole * (1 + MARGIN):
        raise InputError(f"{path}: shares add up to {total:g}, expected at most 1, or 100 percent")
    calm = max(0.0, 1.0 - total / whole)
    share = share / whole if total <= whole else share / total
    weibull = "shape" in columns
    speed = columns["scale" if weibull else "speed"]
    shape = columns["shape"] if weibull else np.full(len(speed), np.nan)
    return WindRose(columns["direction"] % 360.0, share, speed, shape, calm)


def nearest_directions(rose: WindRose, simulated: Sequence[float]) -> tuple[NDArray[np.int64], Floats]:
    """Find for each row of a rose the simulated direction that stands for it, and how far off that is (degrees).

    Of two that are as far the one that stands first is taken.

    Examples
    --------
    >>> rose = WindRose(np.array([350.0, 100.0]), np.ones(2), np.ones(2), np.ones(2), 0.0)
    >>> nearest_directions(rose, [0.0, 90.0])
    (array([0, 1]), array([10., 10.]))
    """
    off = np.abs((rose.direction[:, None] - np.array(simulated)[None, :] + 180.0) % 360.0 - 180.0)
    row: NDArray[np.int64] = off.argmin(axis=1)
    return row, off.min(axis=1)
