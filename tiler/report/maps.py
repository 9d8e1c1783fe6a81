"""Maps of the region: tiles coloured by a value over the footprints, as SVG; of many tiles, blocks of some."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from tiler.config.zones import LEVELS, Zones
from tiler.report.charts import wrap_svg
from tiler.report.page import text
from tiler.report.svg_map import draw_image, draw_scale_bar, encode_png

SIDE = 900.0  # units of the longer side
MOST_CELLS = 2_500  # rectangles of a map
SHADES = 7
FOOT = 44.0  # units below a map, for its scale
FOOTPRINTS = "footprints"  # id of the image that further maps show again


@dataclass(frozen=True, eq=False)
class Mapped:
    """Tiles, or blocks of tiles, with their texts."""

    box: NDArray[np.float64]  #: (n, 4): xmin, ymin, xmax, ymax (m)
    value: NDArray[np.float64]  #: (n,): least value of a block's tiles, or their sum; NaN where it is not known
    label: list[str]  #: name of the tile, or of the block
    tiles_along: int  #: tiles along the side of a block; 1 where each is drawn


def gather_tiles(
    names: Sequence[str],
    box: NDArray[np.float64],
    value: NDArray[np.float64],
    *,
    tile_size: float,
    least: bool,
    most: int = MOST_CELLS,
) -> Mapped:
    """Put tiles together to blocks until there are few enough to draw.

    Parameters
    ----------
    names : sequence of str
        Names of tiles, (n,).
    box : float64, (n, 4)
        Their boxes (m).
    value : float64, (n,)
        What the map shows.
    tile_size : float
        Side of a tile (m).
    least : bool
        Whether a block shows the least value of its tiles; else their sum.
    most : int
        Rectangles that there may be.
    """
    if len(names) <= most:
        return Mapped(box, value, list(names), 1)
    along = 1
    middle = (box[:, :2] + box[:, 2:]) / 2
    while True:
        along *= 2
        place = np.floor(middle / (along * tile_size)).astype(np.int64)
        blocks, row = np.unique(place, axis=0, return_inverse=True)
        if len(blocks) <= most:
            break
    row = row.reshape(-1)
    joined = np.full((len(blocks), 4), np.inf)
    for k, function, sign in ((0, np.minimum, 1), (1, np.minimum, 1), (2, np.minimum, -1), (3, np.minimum, -1)):
        function.at(joined[:, k], row, sign * box[:, k])
        joined[:, k] *= sign
    if least:
        found = np.full(len(blocks), np.inf)
        np.minimum.at(found, row, np.where(np.isnan(value), np.inf, value))
        found[np.isinf(found)] = np.nan
    else:
        found = np.bincount(row, np.nan_to_num(value), len(blocks))
    number = np.bincount(row, minlength=len(blocks))
    return Mapped(joined, found, [f"{n} tiles" for n in number.tolist()], along)


def draw_map(
    title: str,
    bounds: tuple[float, float, float, float],
    mapped: Mapped,
    *,
    limits: tuple[float, float],
    unit: str,
    footprints: NDArray[np.uint8] | None,
    missing: Sequence[tuple[Sequence[float], str]] = (),
    marks: Sequence[tuple[NDArray[np.float64], str]] = (),
) -> str:
    """Draw tiles by value, from light for the first limit to dark for the second, with a legend.

    Parameters
    ----------
    title : str
        What it shows.
    bounds : (xmin, ymin, xmax, ymax)
        The region (m).
    mapped : Mapped
        Tiles or blocks.
    limits : (light, dark)
        Values of the first and the last shade; the second may be less than the first.
    unit : str
        What is written after a value.
    footprints : uint8, (rows, columns), or None
        To draw over the tiles, row 0 in the north; None to show those of the page's first map again.
    missing : sequence of (box, words)
        Tiles that failed, and their texts. Where there is no tile the ground is hatched.
    marks : sequence of (places, class)
        Places (n, 2) to mark (m).
    """
    west, south, east, north = bounds
    scale = SIDE / max(east - west, north - south)
    width, height = (east - west) * scale, (north - south) * scale
    parts = [f'<rect class="absent" width="{width:.1f}" height="{height:.1f}"/>']

    def rect(box: Sequence[float], style: str, words: str) -> str:
        x, y = (box[0] - west) * scale, (north - box[3]) * scale
        size = f'width="{(box[2] - box[0]) * scale:.1f}" height="{(box[3] - box[1]) * scale:.1f}"'
        return f'<rect class="{style}" x="{x:.1f}" y="{y:.1f}" {size}><title>{text(words)}</title></rect>'

    shades = shade(mapped.value, limits)
    for box, k, value, label in zip(
        mapped.box.tolist(), shades.tolist(), mapped.value.tolist(), mapped.label, strict=True
    ):
        words = f"{label}: not known" if math.isnan(value) else f"{label}: {tell(value)}{unit}"
        parts.append(rect(box, f"shade{k}" if k >= 0 else "unknown", words))
    parts.append(_footprints(footprints, width, height))
    parts += [rect(box, "missing", words) for box, words in missing]
    for places, style in marks:
        inside = ((places >= (west, south)) & (places <= (east, north))).all(axis=1)
        dots = "".join(
            f"M{(x - west) * scale:.1f} {(north - y) * scale:.1f}h0" for x, y in places[inside].tolist()
        )
        parts.append(f'<path class="{style}" d="{dots}"/>')
    parts.append(draw_scale_bar(width, height, scale))
    chart = wrap_svg(title, (round(width, 1), round(height + FOOT, 1)), "".join(parts))
    covered = float(((mapped.box[:, 2:] - mapped.box[:, :2]).prod(axis=1)).sum()) if len(mapped.box) else 0.0
    kinds = {
        "unknown": ("not known", bool((shades < 0).any())),
        "absent": ("no tile: no data there", covered < 0.999 * (east - west) * (north - south)),
        "missing": ("tile that failed", len(missing) > 0),
    }
    keys = [(style, words) for style, (words, there) in kinds.items() if there]
    return f'<div class="map">{chart}</div>' + _legend(limits, unit, keys)


def draw_levels(bounds: tuple[float, float, float, float], zones: Zones) -> str:
    """Draw the zones of detail over the footprints of the page's first map, the finest darkest, with a legend.

    Parameters
    ----------
    bounds : (xmin, ymin, xmax, ymax)
        The region (m).
    zones : Zones
        With the rest.
    """
    west, south, east, north = bounds
    scale = SIDE / max(east - west, north - south)
    width, height = (east - west) * scale, (north - south) * scale
    region, parts = shapely.box(*bounds), list[str]()
    finest_last = sorted(zones, key=lambda zone: (bool(zone[2]), LEVELS.index(zone[0])), reverse=True)
    for level, size, place in [finest_last[-1], *finest_last[:-1]]:
        inside = shapely.intersection(region, shapely.from_wkb(place)) if place else region
        rings = shapely.get_rings(shapely.get_parts(inside[()] if isinstance(inside, np.ndarray) else inside))
        lines = [(shapely.get_coordinates(ring) - (west, north)) * (scale, -scale) for ring in rings]
        path = "".join("M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in line.tolist()) + "Z" for line in lines)
        words = f"level {level}, cells of {size:g} m"
        style = f'class="{_level_style(level)}" fill-rule="evenodd"'
        parts.append(f'<path {style} d="{path}"><title>{words}</title></path>')
    parts += [_footprints(None, width, height), draw_scale_bar(width, height, scale)]
    chart = wrap_svg("Zones of detail", (round(width, 1), round(height + FOOT, 1)), "".join(parts))
    shown = [level for level in LEVELS if level in {level for level, _, _ in zones}]
    keys = "".join(f'<li><span class="key {_level_style(level)}"></span> level {level}</li>' for level in shown)
    return f'<div class="map">{chart}</div><ul class="legend">{keys}</ul>'


def _level_style(level: str) -> str:
    return f"shade{SHADES - 1 - LEVELS.index(level)}"


def shade(value: NDArray[np.float64], limits: tuple[float, float]) -> NDArray[np.int64]:
    """Give the shade of each value, 0 to `SHADES` - 1; -1 where it is not known.

    Examples
    --------
    >>> shade(np.array([0.6, 0.2, np.nan]), (0.5, 0.1)).tolist()
    [0, 5, -1]
    """
    known = np.nan_to_num(value, nan=limits[0])
    extent = limits[1] - limits[0]
    place = np.floor((known - limits[0]) / (extent or 1.0) * SHADES).clip(0, SHADES - 1).astype(np.int64)
    found: NDArray[np.int64] = np.where(np.isnan(value), -1, place)
    return found


def tell(value: float) -> str:
    """Write a value of a map.

    Examples
    --------
    >>> tell(1552034.0), tell(0.25254), tell(63.43)
    ('1,552,034', '0.253', '63.4')
    """
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"


def _footprints(footprints: NDArray[np.uint8] | None, width: float, height: float) -> str:
    if footprints is None:
        return f'<use href="#{FOOTPRINTS}"/>'
    attributes = f'id="{FOOTPRINTS}" class="footprints"'
    return draw_image(encode_png(footprints), (width, height), attributes)


def _legend(limits: tuple[float, float], unit: str, keys: Sequence[tuple[str, str]]) -> str:
    shades = "".join(f'<span class="key shade{k}"></span>' for k in range(SHADES))
    rows = [f"<li>{tell(limits[0])}{text(unit)} {shades} {tell(limits[1])}{text(unit)}</li>"]
    for style, words in (("footprint", "footprint"), *keys):
        rows.append(f'<li><span class="key {style}"></span> {words}</li>')
    return f'<ul class="legend">{"".join(rows)}</ul>'
