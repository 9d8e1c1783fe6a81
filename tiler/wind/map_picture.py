"""Maps as PNG: a raster in colours, with a legend."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tiler.wind.comfort import Classes
from tiler.wind.rose import Floats

Colour = tuple[int, int, int]
HOUSE: Colour = (120, 120, 124)  # where nothing is known
PAPER: Colour = (255, 255, 255)
INK: Colour = (30, 30, 34)
# From good to bad, told apart by people who are colour-blind.
GRADES: tuple[Colour, ...] = ((49, 104, 178), (116, 186, 199), (250, 232, 150), (238, 148, 70), (186, 36, 52))
RAMP: tuple[Colour, ...] = ((38, 48, 110), (45, 125, 160), (110, 190, 140), (240, 220, 90), (200, 60, 50))
WIDTH, SIDE = 900, 300  # pixels of the map's longer side at least, and of the legend
STEPS = 6  # of the legend of speeds


def draw_classes(path: Path, classes: Classes, *, title: str, names: Sequence[str]) -> None:
    """Draw classes (rows, columns), 0 where there is none, and the share of the ground that each has."""
    colours = [HOUSE, *(GRADES[round(k * (len(GRADES) - 1) / max(len(names) - 1, 1))] for k in range(len(names)))]
    counts = np.bincount(classes.ravel(), minlength=len(colours))
    known = max(int(counts[1:].sum()), 1)
    rows = [
        (colour, f"{name}  {counts[number] / known:.1%}")
        for number, (colour, name) in enumerate(zip(colours[1:], names, strict=True), start=1)
    ]
    _draw(path, np.array(colours, np.uint8)[classes], title, rows)


def draw_speeds(path: Path, values: Floats, *, title: str, unit: str) -> None:
    """Draw values (rows, columns), NaN where there is none, from 0 to the 99.5th percentile."""
    known = values[~np.isnan(values)]
    most = float(np.percentile(known, 99.5)) if len(known) else 1.0
    most = most if most > 0 else 1.0
    share = np.nan_to_num(np.clip(values / most, 0.0, 1.0))
    pixels = _ramp(share)
    pixels[np.isnan(values)] = HOUSE
    steps = np.linspace(0.0, 1.0, STEPS)
    shades = [(int(r), int(g), int(b)) for r, g, b in _ramp(steps)]
    labels = [f"{step * most:.2f} {unit}" for step in steps]
    labels[-1] = f"{labels[-1]} and more"
    _draw(path, pixels, title, list(zip(shades, labels, strict=True)))


def _ramp(share: Floats) -> NDArray[np.uint8]:
    places = np.linspace(0.0, 1.0, len(RAMP))
    channels = [np.interp(share, places, [colour[k] for colour in RAMP]) for k in range(3)]
    return np.stack(channels, axis=-1).round().astype(np.uint8)


def _draw(path: Path, pixels: NDArray[np.uint8], title: str, rows: Sequence[tuple[Colour, str]]) -> None:
    from PIL import Image, ImageDraw, ImageFont

    n_rows, n_columns = pixels.shape[:2]
    # A pixel of a small raster becomes a square of several; a large raster is thinned.
    scale = max(1, WIDTH // max(n_rows, n_columns))
    thin = max(1, max(n_rows, n_columns) // (4 * WIDTH))
    shown = Image.fromarray(np.ascontiguousarray(pixels[::thin, ::thin]))
    shown = shown.resize((shown.width * scale, shown.height * scale), Image.Resampling.NEAREST)
    height = max(shown.height, 60 + 30 * len(rows))
    page = Image.new("RGB", (shown.width + SIDE, height), PAPER)
    page.paste(shown, (0, 0))
    pen = ImageDraw.Draw(page)
    left = shown.width + 16
    pen.text((left, 14), title, fill=INK, font=ImageFont.load_default(17))
    for number, (colour, text) in enumerate(rows):
        top = 52 + 30 * number
        pen.rectangle((left, top, left + 24, top + 18), fill=colour, outline=INK)
        pen.text((left + 34, top + 2), text, fill=INK, font=ImageFont.load_default(13))
    page.save(path, format="png", optimize=True)
