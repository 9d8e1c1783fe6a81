"""A picture of a plan, as SVG: tiles, those that are absent, file outlines and footprints, seen from above."""

from pathlib import Path

import numpy as np

from stitch.tiling.grid import tiles_present
from tiler.planning.footprint_sample import FootprintSample
from tiler.planning.plan import Survey
from tiler.report.svg_map import FootprintRaster, draw_image, draw_scale_bar, encode_png
from tiler.store.atomic import replacing

SIDE = 1400  # units of the map's longer side, and pixels of its footprints
MARGIN, HEAD, FOOT = 30, 60, 84  # units left and right, above and below the map
LEAST_SIDE = 620  # units; a map is as wide as its legend
LINE_TILES = 8  # units; smaller tiles have no lines between them
NAME_TILES = 64  # units; smaller tiles have no names
HOUSE = "#cd9480"
STYLE = f"""
text {{ font: 14px sans-serif; fill: #1e1e1e }} .title {{ font-size: 20px }}
.name {{ font-size: 13px; text-anchor: middle; stroke: #f3eee2; stroke-width: 4px; paint-order: stroke }}
.tile {{ fill: #f3eee2 }} .absent {{ fill: url(#hatch) }} .footprint {{ fill: {HOUSE} }}
.lines {{ stroke: #3c3228; fill: none }} .file {{ fill: none; stroke: #266cbe; stroke-width: 2px }}
.scale {{ fill: none; stroke: #1e1e1e; stroke-width: 2px }}
"""
HATCH = (
    '<pattern id="hatch" width="12" height="12" patternUnits="userSpaceOnUse" patternTransform="rotate(45)">'
    '<rect width="12" height="12" fill="#d6d6d6"/><rect width="4" height="12" fill="#bababa"/></pattern>'
)


def draw_plan(survey: Survey, sample: FootprintSample | None, path: Path) -> None:
    """Draw the tiles of a run over its files and footprints.

    Parameters
    ----------
    survey : Survey
        Region, tiles and files.
    sample : FootprintSample or None
        The footprints.
    path : Path
        SVG file.

    Raises
    ------
    OutputError
        If the file cannot be written.

    Notes
    -----
    Tiles that are there are drawn row by row as far as they reach, and footprints as one raster: the file does not
    grow with the number of either, but for files of points, of which each has an outline.
    """
    grid, there = survey.meshed, tiles_present(survey.meshed)
    west, south, east, north = grid.bounds
    scale = SIDE / max(east - west, north - south)
    width, height = (east - west) * scale, (north - south) * scale
    x, y = (grid.lines[0] - west) * scale, (north - grid.lines[1]) * scale
    parts = [f'<rect class="absent" width="{width:.1f}" height="{height:.1f}"/>']
    for j, row in enumerate(there.T):
        first, last = np.flatnonzero(np.diff(np.r_[0, row, 0])).reshape(-1, 2).T
        for begin, end in zip(x[first].tolist(), x[last].tolist(), strict=True):
            parts.append(_rect("tile", begin, y[j + 1], end, y[j]))
    if sample is not None and len(sample):
        raster = FootprintRaster((west, south, east, north), SIDE)
        raster.add(sample.polygons)
        parts.append(draw_image(encode_png(raster.shares(), HOUSE), (width, height)))
    boxes = np.array([cloud.bounds[:4] for cloud in survey.clouds]).reshape(-1, 4)
    low, high = np.maximum(boxes[:, :2], (west, south)), np.minimum(boxes[:, 2:], (east, north))
    for (x0, y0), (x1, y1) in zip(low.tolist(), high.tolist(), strict=True):
        if x0 <= x1 and y0 <= y1:
            left, top = (x0 - west) * scale, (north - y1) * scale
            parts.append(_rect("file", left, top, (x1 - west) * scale, (north - y0) * scale))
    side = grid.tile_size * scale
    shown_x, shown_y = (x, y) if side >= LINE_TILES else (x[[0, -1]], y[[0, -1]])
    lines = [f"M{at:.1f} 0V{height:.1f}" for at in shown_x] + [f"M0 {at:.1f}H{width:.1f}" for at in shown_y]
    parts.append(f'<path class="lines" d="{"".join(lines)}"/>')
    if side >= NAME_TILES:
        for i, j in np.ndindex(there.shape):
            place = f'x="{(x[i] + x[i + 1]) / 2:.1f}" y="{(y[j] + y[j + 1]) / 2 + 5:.1f}"'
            parts.append(f'<text class="name" {place}>{grid.first.i + i}_{grid.first.j + j}</text>')
    parts.append(draw_scale_bar(width, height, scale))
    parts.append(_draw_legend(height + 56))
    title = f'<text class="title" x="{MARGIN}" y="{HEAD / 2 + 6}">{_describe(survey, sample)}</text>'
    size = max(width, LEAST_SIDE) + 2 * MARGIN, height + HEAD + FOOT
    with replacing(path) as part:
        part.write_text(
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{size[0]:.0f}" height="{size[1]:.0f}" '
            f'viewBox="0 0 {size[0]:.1f} {size[1]:.1f}"><style>{STYLE}</style><defs>{HATCH}</defs>'
            f'<rect width="100%" height="100%" fill="#fff"/>{title}'
            f'<g transform="translate({MARGIN} {HEAD})">{"".join(parts)}</g></svg>\n'
        )


def _rect(style: str, left: float, top: float, right: float, foot: float) -> str:
    size = f'width="{right - left:.1f}" height="{foot - top:.1f}"'
    return f'<rect class="{style}" x="{left:.1f}" y="{top:.1f}" {size}/>'


def _draw_legend(top: float) -> str:
    keys = (("tile", "tile"), ("absent", "absent tile"), ("file", "file"), ("footprint", "footprint"))
    return "".join(
        _rect(f"key {style}", 140 * k, top, 140 * k + 16, top + 12)
        + f'<text x="{140 * k + 24}" y="{top + 11:.1f}">{words}</text>'
        for k, (style, words) in enumerate(keys)
    )


def _describe(survey: Survey, sample: FootprintSample | None) -> str:
    there = tiles_present(survey.meshed)
    n_absent = int((~there).sum())
    words = f"{int(there.sum()):,} tiles of {survey.meshed.tile_size:g} m"
    words += f", {n_absent:,} absent" if n_absent else ""
    words += f"; {len(survey.clouds):,} file{'s' if len(survey.clouds) != 1 else ''}"
    return words + (f"; {sample.total:,} footprints" if sample is not None else "")
