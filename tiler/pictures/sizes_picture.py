"""A run's plane mesh from above: triangles coloured by the length of their edges, neighbouring tiles by hue."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.mesh import Marker
from tiler.pictures.picture_data import City
from tiler.pictures.picture_parts import LINE_COLOUR, blend, tile_keys

# From short to long edges, for tiles whose column and row are both odd or both even, and for the others.
RAMPS = (("#0b2545", "#2f6690", "#7fb2d6", "#e4f1fa"), ("#4a1c05", "#a8501b", "#e8a667", "#fdf0e0"))
SHARPNESS = 2  # pixels drawn for one that is kept, in each direction
LEGEND = 46  # pixels under the map
LEAST_TRIANGLE = 3.0  # pixels that the middle triangle's edges need for lines to be drawn
EXTREMES = (2.0, 98.0)  # percentiles of edges between which colours change


def plan_edges(city: City) -> NDArray[np.float64]:
    """Mean length of the edges of each facet in plan (m), float64 (k,)."""
    corners = city.points[city.facets][:, :, :2]
    across = corners - np.roll(corners, -1, axis=1)
    length: NDArray[np.float64] = np.sqrt((across**2).sum(axis=2)).mean(axis=1)
    return length


def draw_sizes(city: City, size: tuple[int, int]) -> NDArray[np.uint8]:
    """Draw ground and roofs from above, north upwards, with a legend under them.

    Parameters
    ----------
    city : City
        The boundary.
    size : (int, int)
        Width and height (pixels).

    Returns
    -------
    uint8, (height, width, 3)
        The picture; the same bytes for the same run.

    Raises
    ------
    InputError
        If a piece is not named after a tile.
    ValueError
        If the picture is too small for its legend.
    """
    from PIL import Image, ImageDraw

    width, height = size
    if height <= LEGEND:
        raise ValueError(f"size {width} x {height} must have more than {LEGEND} rows, which the legend takes")
    shown = city.marker != Marker.WALL
    edges = plan_edges(city)[shown]
    low, high = np.percentile(edges, EXTREMES)
    share = (edges - low) / max(high - low, 1e-9)
    odd = tile_keys(city).sum(axis=1)[city.piece[shown]] % 2
    rgb = np.where(odd[:, None] == 0, *(blend(share, ramp) for ramp in RAMPS))
    box = city.points[:, :2].min(axis=0), city.points[:, :2].max(axis=0)
    scale = SHARPNESS * float(min(np.array([width, height - LEGEND]) / (box[1] - box[0])))
    margin = (SHARPNESS * np.array([width, height - LEGEND]) - scale * (box[1] - box[0])) / 2
    places = (city.points[:, :2] - box[0]) * scale + margin
    places[:, 1] = SHARPNESS * (height - LEGEND) - places[:, 1]
    image = Image.new("RGB", (SHARPNESS * width, SHARPNESS * height), "white")
    draw = ImageDraw.Draw(image)
    line = LINE_COLOUR if np.median(edges) * scale > LEAST_TRIANGLE * SHARPNESS else None
    for corners, colour in zip(places[city.facets[shown]].tolist(), rgb.tolist(), strict=True):
        draw.polygon([tuple(corner) for corner in corners], fill=tuple(colour), outline=line)
    for corners in places[city.facets[~shown]].tolist():
        draw.line([tuple(corner) for corner in corners], fill="black", width=SHARPNESS)
    _add_legend(draw, float(low), float(high), size)
    return np.asarray(image.resize(size, Image.Resampling.BOX))


def _add_legend(draw: Any, low: float, high: float, size: tuple[int, int]) -> None:
    """Add both ramps between their lengths."""
    from PIL import ImageFont

    width, height = (SHARPNESS * pixels for pixels in size)
    left, right, top = width // 4, 3 * width // 4, height - SHARPNESS * (LEGEND - 10)
    steps = np.linspace(0, 1, right - left)
    for row, ramp in enumerate(RAMPS):
        first = top + row * 13 * SHARPNESS
        for k, colour in enumerate(blend(steps, ramp).tolist()):
            draw.line([(left + k, first), (left + k, first + 11 * SHARPNESS)], fill=tuple(colour))
    font, gap, y = ImageFont.load_default(size=14 * SHARPNESS), 8 * SHARPNESS, top + 4 * SHARPNESS
    draw.text((left - gap, y), f"edges of {low:.1f} m", fill="black", font=font, anchor="ra")
    draw.text((right + gap, y), f"{high:.1f} m", fill="black", font=font, anchor="la")
