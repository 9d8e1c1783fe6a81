"""Charts of the report as SVG, drawn by hand: no script, colours from the page's style."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from tiler.report.page import text

WIDTH, HEIGHT = 620, 230  # units of a histogram
LEFT, RIGHT, TOP, FOOT = 46, 12, 12, 38
GANTT_LEFT, GANTT_ROW = 134, 18


@dataclass(frozen=True, eq=False)
class Series:
    """One line or set of bars of a histogram."""

    name: str  #: for the legend
    share: NDArray[np.float64]  #: (n,): share of the values in each bin


def draw_histogram(title: str, axis: str, limits: tuple[float, float], series: Sequence[Series]) -> str:
    """Draw shares in bins of equal width: the first series as bars, others as lines.

    Parameters
    ----------
    title : str
        What it shows, for readers that do not see it.
    axis : str
        What is counted, with its unit.
    limits : (low, high)
        Range of the bins.
    series : sequence of Series
        At least one; all have the same number of bins.
    """
    most = max(float(each.share.max(initial=0.0)) for each in series) or 1.0
    step = _tick_step(most, 4)
    most = step * float(np.ceil(most / step - 1e-9))
    low, high = limits

    def x(value: float) -> float:
        return LEFT + (value - low) / (high - low) * (WIDTH - LEFT - RIGHT)

    def y(share: float) -> float:
        return HEIGHT - FOOT - share / most * (HEIGHT - FOOT - TOP)

    parts = []
    for tick in _ticks(0.0, most, step):
        parts.append(f'<path class="grid" d="M{LEFT} {y(tick):.1f}H{WIDTH - RIGHT}"/>')
        parts.append(f'<text x="{LEFT - 6}" y="{y(tick) + 4:.1f}" text-anchor="end">{100 * tick:.3g} %</text>')
    for tick in _ticks(low, high, _tick_step(high - low, 8)):
        parts.append(f'<path class="tick" d="M{x(tick):.1f} {HEIGHT - FOOT}v5"/>')
        parts.append(f'<text x="{x(tick):.1f}" y="{HEIGHT - FOOT + 18}" text-anchor="middle">{tick:.6g}</text>')
    for k, each in enumerate(series):
        edges = np.linspace(low, high, len(each.share) + 1)
        steps = "".join(
            f"V{y(share):.1f}H{x(end):.1f}" for share, end in zip(each.share.tolist(), edges[1:], strict=True)
        )
        close = f"V{y(0):.1f}Z" if k == 0 else ""
        parts.append(f'<path class="series{k}" d="M{x(low):.1f} {y(0):.1f}{steps}{close}"/>')
    parts.append(f'<path class="axis" d="M{LEFT} {HEIGHT - FOOT}H{WIDTH - RIGHT}"/>')
    parts.append(
        f'<text x="{(LEFT + WIDTH - RIGHT) / 2}" y="{HEIGHT - 4}" text-anchor="middle">{text(axis)}</text>'
    )
    chart = wrap_svg(title, (WIDTH, HEIGHT), "".join(parts))
    return chart + (_legend(series) if len(series) > 1 else "")


def draw_bars(title: str, rows: Sequence[tuple[str, float, str]]) -> str:
    """Draw a bar a row, of name, value and what to write beside it."""
    most = max((value for _, value, _ in rows), default=0.0) or 1.0
    parts = []
    for k, (name, value, words) in enumerate(rows):
        top = k * GANTT_ROW
        length = value / most * (WIDTH - GANTT_LEFT - 90)
        parts.append(f'<text x="{GANTT_LEFT - 8}" y="{top + 13}" text-anchor="end">{text(name)}</text>')
        parts.append(f'<rect class="bar" x="{GANTT_LEFT}" y="{top + 3}" width="{length:.1f}" height="12"/>')
        parts.append(f'<text x="{GANTT_LEFT + length + 6:.1f}" y="{top + 13}">{text(words)}</text>')
    return wrap_svg(title, (WIDTH, len(rows) * GANTT_ROW + 4), "".join(parts))


def draw_gantt(
    title: str, duration: float, names: Sequence[str], busy: NDArray[np.float64], tips: Sequence[str]
) -> str:
    """Draw when stages worked: a row each, the darker the more of its tasks were at work.

    Parameters
    ----------
    title : str
        What it shows.
    duration : float
        Length of the time axis (s).
    names : sequence of str
        Stages, (n,).
    busy : float64, (n, bins)
        Tasks at work in each slice of time.
    tips : sequence of str
        The text of each stage where a pointer rests on it.
    """
    scale = (WIDTH - GANTT_LEFT - RIGHT) / duration
    foot = len(names) * GANTT_ROW + 4
    parts = []
    for tick in _ticks(0.0, duration, _tick_step(duration, 6)):
        at = GANTT_LEFT + tick * scale
        parts.append(f'<path class="grid" d="M{at:.1f} 0V{foot}"/>')
        parts.append(f'<text x="{at:.1f}" y="{foot + 14}" text-anchor="middle">{tick:.6g}</text>')
    parts.append(f'<text x="{WIDTH - RIGHT}" y="{foot + 30}" text-anchor="end">seconds</text>')
    bins = busy.shape[1]
    slot = (WIDTH - GANTT_LEFT - RIGHT) / bins
    most = max(float(busy.max(initial=0.0)), 1e-9)
    for k, name in enumerate(names):
        top = k * GANTT_ROW
        levels = np.ceil(np.sqrt(busy[k] / most) * 5).astype(int)
        cuts = [0, *(np.flatnonzero(np.diff(levels)) + 1).tolist(), bins]
        runs = "".join(
            f'<rect class="busy{levels[a]}" x="{GANTT_LEFT + a * slot:.2f}" y="{top + 3}" '
            f'width="{max((b - a) * slot, 1.0):.2f}" height="12"/>'
            for a, b in pairwise(cuts)
            if levels[a]
        )
        label = f'<text x="{GANTT_LEFT - 8}" y="{top + 13}" text-anchor="end">{text(name)}</text>'
        parts.append(f"<g><title>{text(tips[k])}</title>{label}{runs}</g>")
    return wrap_svg(title, (WIDTH, foot + 34), "".join(parts))


def wrap_svg(title: str, size: tuple[float, float], content: str) -> str:
    """Make an SVG element with a title that screen readers tell."""
    return f'<svg viewBox="0 0 {size[0]:g} {size[1]:g}" role="img" aria-label="{text(title)}">{content}</svg>'


def rebin(counts: NDArray[np.int64], bins: int) -> NDArray[np.float64]:
    """Share of values in fewer bins; their number must divide that of the counts.

    Examples
    --------
    >>> rebin(np.array([1, 1, 2, 0]), 2).tolist()
    [0.5, 0.5]
    """
    total = max(int(counts.sum()), 1)
    shares: NDArray[np.float64] = counts.reshape(bins, -1).sum(axis=1) / total
    return shares


def _legend(series: Sequence[Series]) -> str:
    rows = "".join(f'<li><span class="key{k}"></span>{text(each.name)}</li>' for k, each in enumerate(series))
    return f'<ul class="legend">{rows}</ul>'


def _tick_step(extent: float, about: int) -> float:
    """Give 1, 2 or 5 times a power of ten, so that there are some `about` ticks."""
    rough = extent / about
    power = 10.0 ** np.floor(np.log10(rough))
    return float(next(step for step in (1.0, 2.0, 5.0, 10.0) if step * power >= rough * (1 - 1e-9)) * power)


def _ticks(low: float, high: float, step: float) -> list[float]:
    first, last = int(np.ceil(low / step - 1e-9)), int(np.floor(high / step + 1e-9))
    return [k * step for k in range(first, last + 1)]
