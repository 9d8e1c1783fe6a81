"""A picture of a plan: tiles, those that are absent, file outlines and footprints, seen from above."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.errors import ConfigError
from stitch.grid import tiles_present
from tiler.footprints.footprint_sample import FootprintSample
from tiler.planning.plan import Survey
from tiler.store.atomic import replacing

if TYPE_CHECKING:
    from PIL import ImageDraw

SIDE = 1400  # pixels of the map's longer side
SAMPLES = 2  # pixels painted along each pixel shown
MARGIN, HEAD, FOOT = 30, 60, 64  # pixels left and right, above and below the map
LEAST_SIDE = 620  # pixels; a map is as wide as its legend
DRAWN_FOOTPRINTS = 200_000  # footprints that are drawn; of more, evenly spaced ones
SMALLEST = 2.0  # pixels; footprints that are smaller are dots
LINE_TILES = 8  # pixels; smaller tiles have no lines between them
NAME_TILES = 64  # pixels; smaller tiles have no names
PAPER, PRESENT, ABSENT, HATCH = (255, 255, 255), (243, 238, 226), (214, 214, 214), (186, 186, 186)
TILE_LINE, FILE_LINE, HOUSE, INK = (60, 50, 40), (38, 108, 190), (205, 148, 128), (30, 30, 30)


class _Map:
    """From metres to the pixels that are painted."""

    def __init__(self, boxes: NDArray[np.float64]) -> None:
        self.low, self.high = boxes[:, :2].min(axis=0), boxes[:, 2:].max(axis=0)
        extent = np.maximum(self.high - self.low, 1e-9)
        self.scale = SAMPLES * SIDE / float(extent.max())
        inner = np.ceil(extent * self.scale).astype(int)
        self.width = max(int(inner[0]), SAMPLES * LEAST_SIDE) + 2 * SAMPLES * MARGIN
        self.height = int(inner[1]) + SAMPLES * (HEAD + FOOT)
        self.left, self.bottom = SAMPLES * MARGIN, SAMPLES * HEAD + int(inner[1])

    def pixels(self, xy: NDArray[np.float64]) -> NDArray[np.float64]:
        """Pixels (n, 2), x to the right, y down."""
        return np.column_stack(
            (
                self.left + (xy[:, 0] - self.low[0]) * self.scale,
                self.bottom - (xy[:, 1] - self.low[1]) * self.scale,
            )
        )

    def box(self, box: NDArray[np.float64]) -> list[float]:
        """Pixels of a box: left, top, right, bottom."""
        (x0, y1), (x1, y0) = self.pixels(box.reshape(2, 2)).tolist()
        return [x0, y0, x1, y1]


def draw_plan(survey: Survey, sample: FootprintSample | None, path: Path) -> None:
    """Draw the tiles of a run over its files and footprints.

    Parameters
    ----------
    survey : Survey
        Region, tiles and files.
    sample : FootprintSample or None
        The footprints; beyond 200,000 evenly spaced ones are drawn.
    path : Path
        PNG file.

    Raises
    ------
    ConfigError
        If pillow is not installed.
    OutputError
        If the file cannot be written.

    Notes
    -----
    The colour of each pixel's tile is looked up, so the time does not grow with the number of tiles.
    """
    try:
        from PIL import Image, ImageDraw
    except ImportError as error:
        raise ConfigError("pictures need pillow: pip install citystitch[pictures]") from error
    files = np.array([cloud.bounds[:4] for cloud in survey.clouds]).reshape(-1, 4)
    view = _Map(np.array([survey.meshed.bounds]))
    image = Image.fromarray(_paint_tiles(view, survey))
    draw = ImageDraw.Draw(image)
    _draw_houses(image, draw, view, sample)
    for box in files.tolist():
        inside = np.array([*np.maximum(box[:2], view.low), *np.minimum(box[2:], view.high)])
        if (inside[2:] >= inside[:2]).all():
            draw.rectangle(view.box(inside), outline=FILE_LINE, width=2 * SAMPLES)
    _draw_lines(draw, view, survey)
    _draw_names(draw, view, survey)
    _draw_words(draw, view, survey, sample)
    small = image.resize((view.width // SAMPLES, view.height // SAMPLES), Image.Resampling.BOX)
    with replacing(path) as part:
        small.save(part, format="PNG")


def _paint_tiles(view: _Map, survey: Survey) -> NDArray[np.uint8]:
    grid, there = survey.meshed, tiles_present(survey.meshed)
    x = (np.arange(view.width) + 0.5 - view.left) / view.scale + view.low[0]
    y = (view.bottom - np.arange(view.height) - 0.5) / view.scale + view.low[1]
    column, row = (np.searchsorted(axis, at) - 1 for axis, at in zip(grid.lines, (x, y), strict=True))
    inside = np.multiply.outer((row >= 0) & (row < there.shape[1]), (column >= 0) & (column < there.shape[0]))
    last = np.array(there.shape) - 1
    present = there[np.clip(column, 0, last[0])[None, :], np.clip(row, 0, last[1])[:, None]]
    stripe = np.add.outer(np.arange(view.height), np.arange(view.width)) // (4 * SAMPLES) % 4 == 0
    kind = np.where(~inside, 0, np.where(present, 1, np.where(stripe, 3, 2)))
    return np.array([PAPER, PRESENT, ABSENT, HATCH], np.uint8)[kind]


def _draw_houses(image: Any, draw: "ImageDraw.ImageDraw", view: _Map, sample: FootprintSample | None) -> None:
    if sample is None or not len(sample):
        return
    step = math.ceil(len(sample) / DRAWN_FOOTPRINTS)
    rows = np.arange(0, len(sample), step)
    rows = rows[np.argsort(-sample.area[rows], kind="stable")]  # houses in the courtyards of others come later
    polygons, box = sample.polygons[rows], sample.box[rows]
    size = (box[:, 2:] - box[:, :2]).max(axis=1) * view.scale
    small = size < SMALLEST * SAMPLES
    dots = view.pixels((box[small, :2] + box[small, 2:]) / 2)
    for shift in np.ndindex(SAMPLES, SAMPLES):
        _clip_dots(draw, view, dots + shift)
    rings = shapely.get_rings(polygons[~small])
    outer = shapely.get_exterior_ring(shapely.get_parts(polygons[~small]))
    outside = {ring.wkb for ring in outer} if len(rings) > len(outer) else None
    for ring in rings:
        pixels = view.pixels(shapely.get_coordinates(ring))
        hole = outside is not None and ring.wkb not in outside
        draw.polygon(pixels.ravel().tolist(), fill=PRESENT if hole else HOUSE)
    (x0, y0, x1, y1), (width, height) = view.box(np.concatenate((view.low, view.high))), image.size
    for margin in ((0, 0, width, y0), (0, y1, width, height), (0, 0, x0, height), (x1, 0, width, height)):
        draw.rectangle(margin, fill=PAPER)


def _clip_dots(draw: "ImageDraw.ImageDraw", view: _Map, dots: NDArray[np.float64]) -> None:
    inside = (dots >= 0).all(axis=1) & (dots < (view.width, view.height)).all(axis=1)
    draw.point(dots[inside].ravel().tolist(), fill=HOUSE)


def _tile_pixels(view: _Map, survey: Survey) -> float:
    return survey.meshed.tile_size * view.scale / SAMPLES


def _draw_lines(draw: "ImageDraw.ImageDraw", view: _Map, survey: Survey) -> None:
    x, y = survey.meshed.lines
    inner = _tile_pixels(view, survey) >= LINE_TILES
    for at in (x if inner else x[[0, -1]]).tolist():
        draw.line(view.box(np.array([at, y[0], at, y[-1]])), fill=TILE_LINE, width=SAMPLES)
    for at in (y if inner else y[[0, -1]]).tolist():
        draw.line(view.box(np.array([x[0], at, x[-1], at])), fill=TILE_LINE, width=SAMPLES)


def _draw_names(draw: "ImageDraw.ImageDraw", view: _Map, survey: Survey) -> None:
    if _tile_pixels(view, survey) < NAME_TILES:
        return
    (x, y), first = survey.meshed.lines, survey.meshed.first
    for i, j in np.ndindex(len(x) - 1, len(y) - 1):
        (place,) = view.pixels(np.array([[(x[i] + x[i + 1]) / 2, (y[j] + y[j + 1]) / 2]])).tolist()
        _write(draw, place, f"{first.i + i}_{first.j + j}", 13, anchor="mm", halo=True)


def _draw_words(draw: "ImageDraw.ImageDraw", view: _Map, survey: Survey, sample: FootprintSample | None) -> None:
    """Title above, and below it the legend; a scale bar at the lower left."""
    there = tiles_present(survey.meshed)
    n_absent = int((~there).sum())
    title = f"{int(there.sum()):,} tiles of {survey.meshed.tile_size:g} m" + (
        f", {n_absent:,} absent" if n_absent else ""
    )
    title += f"; {len(survey.clouds):,} files" + (f"; {sample.total:,} footprints" if sample is not None else "")
    top = SAMPLES * HEAD
    _write(draw, [view.left, top * 0.5], title, 20, anchor="lm")
    length = _round_length(0.3 * SAMPLES * SIDE / view.scale)
    foot = view.bottom + SAMPLES * 22
    end = view.left + length * view.scale
    draw.line([view.left, foot, end, foot], fill=INK, width=3 * SAMPLES)
    for at in (view.left, end):
        draw.line([at, foot - 5 * SAMPLES, at, foot + 5 * SAMPLES], fill=INK, width=SAMPLES)
    words = f"{length / 1000:g} km" if length >= 1000 else f"{length:g} m"
    _write(draw, [view.left, foot + SAMPLES * 18], words, 14, anchor="lm")
    at = float(view.width - SAMPLES * MARGIN)
    for word, fill, line in (
        ("footprint", HOUSE, HOUSE),
        ("file", PAPER, FILE_LINE),
        ("absent tile", ABSENT, HATCH),
        ("tile", PRESENT, TILE_LINE),
    ):
        at -= SAMPLES * (9 * len(word))
        _write(draw, [at, foot + SAMPLES * 18], word, 14, anchor="lm")
        at -= SAMPLES * 22
        box = [at, foot + SAMPLES * 12, at + SAMPLES * 16, foot + SAMPLES * 24]
        draw.rectangle(box, fill=fill, outline=line, width=SAMPLES)
        at -= SAMPLES * 12


def _write(
    draw: "ImageDraw.ImageDraw", place: list[float], words: str, size: int, *, anchor: str, halo: bool = False
) -> None:
    from PIL import ImageFont

    font = ImageFont.load_default(size * SAMPLES)
    stroke = 2 * SAMPLES if halo else 0
    at = (place[0], place[1])
    draw.text(at, words, fill=INK, font=font, anchor=anchor, stroke_width=stroke, stroke_fill=PRESENT)


def _round_length(about: float) -> float:
    """Give 1, 2 or 5 times a power of ten that is not above a length.

    Examples
    --------
    >>> _round_length(187.0), _round_length(7.2e4)
    (100.0, 50000.0)
    """
    power = 10.0 ** math.floor(math.log10(about))
    return float(max(step for step in (1.0, 2.0, 5.0) if step * power <= about) * power)
