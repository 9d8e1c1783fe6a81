"""A plot with two logarithmic axes, drawn with Pillow."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

WIDTH, HEIGHT, LEFT, RIGHT, TOP, BOTTOM = 1000, 560, 70, 230, 20, 50
# Colours that stay apart for those who see few, after Okabe and Ito.
COLOURS = ("#000000", "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#7f7f7f")


def draw_log_plot(
    path: Path, sizes: Sequence[float], series: Mapping[str, Sequence[float]], *, x: str, y: str
) -> None:
    """Draw lines over one axis, the last one thick, with a dashed line of slope one through its first value.

    Parameters
    ----------
    path : Path
        PNG file to write.
    sizes : sequence of float
        Positions along the axis.
    series : mapping of str to sequence of float
        A line each; values that are not positive are left out.
    x, y : str
        Names of the axes.
    """
    from PIL import Image, ImageDraw

    values = [value for line in series.values() for value in line if value > 0]
    low, high = np.floor(np.log10(max(min(values), 1e-3))), np.ceil(np.log10(max(values)))
    first, last = np.log10(min(sizes)), np.log10(max(sizes))
    image = Image.new("RGB", (WIDTH, HEIGHT), "white")
    pen = ImageDraw.Draw(image)

    def place(size: float, value: float) -> tuple[float, float]:
        across = LEFT + (np.log10(size) - first) / (last - first) * (WIDTH - LEFT - RIGHT)
        up = HEIGHT - BOTTOM - (np.log10(value) - low) / (high - low) * (HEIGHT - TOP - BOTTOM)
        return float(across), float(up)

    for decade in np.arange(low, high + 1):
        begin, end = place(min(sizes), 10**decade), place(max(sizes), 10**decade)
        pen.line([begin, end], fill="#dddddd")
        pen.text((8, begin[1] - 6), f"{10**decade:g}", fill="black")
    for size in sizes:
        foot = place(size, 10**low)
        pen.line([foot, (foot[0], foot[1] + 5)], fill="black")
        pen.text((foot[0] - 15, foot[1] + 8), f"{size:.3g}", fill="black")
    pen.text(((WIDTH - RIGHT) / 2, HEIGHT - 18), x, fill="black")
    pen.text((8, 4), y, fill="black")
    *_, whole = series.values()
    for k in range(0, 40, 2):  # slope one
        parts = [10 ** (first + (last - first) * part / 40) for part in (k, k + 1)]
        ends = [place(size, whole[0] * size / sizes[0]) for size in parts]
        if min(end[1] for end in ends) >= TOP:
            pen.line(ends, fill="#999999")
    for k, (name, line) in enumerate(series.items()):
        colour, thick = COLOURS[k % len(COLOURS)], 4 if k == len(series) - 1 else 2
        points = [place(size, value) for size, value in zip(sizes, line, strict=True) if value >= 10**low]
        if len(points) > 1:
            pen.line(points, fill=colour, width=thick)
        for point in points:
            _mark(pen, point, colour, k // len(COLOURS))
        height = TOP + 10 + 20 * k
        pen.line([(WIDTH - RIGHT + 20, height), (WIDTH - RIGHT + 50, height)], fill=colour, width=thick)
        _mark(pen, (WIDTH - RIGHT + 35, height), colour, k // len(COLOURS))
        pen.text((WIDTH - RIGHT + 58, height - 6), name, fill="black")
    image.save(path, optimize=True)


def _mark(pen: object, at: tuple[float, float], colour: str, shape: int) -> None:
    """A disc, or a square for the second turn of colours."""
    box = (at[0] - 3, at[1] - 3, at[0] + 3, at[1] + 3)
    getattr(pen, "rectangle" if shape else "ellipse")(box, fill=colour)
