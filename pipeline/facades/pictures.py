"""Pictures of flat assets and façades, drawn of the full assets: what a texture shows in the place of polygons."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.architecture.parameters import Flat
from pipeline.architecture.surfaces import WALL, Surface
from pipeline.facades.assets import Made, build
from pipeline.facades.facade import Frame
from pipeline.facades.graph import Insert

PIXEL = 0.1  # m
FINE = 8  # a pixel is the mean of so many by so many places
BALCONY = "BuildingInstallation"  # kind of the polygons of balconies
SHADES = (1.0, 0.85, 0.65)  # of what is in the wall's plane or before it, as deep as a frame, deeper
Image = NDArray[np.uint8]
Colours = Mapping[str, tuple[int, int, int]]  # sRGB, 0 to 255, of each kind of surface


@dataclass(frozen=True, eq=False)
class Picture:
    """What a flat polygon shows: assets in the rectangle from the corner of a frame on, of a size (m)."""

    frame: Frame
    size: Flat
    products: Sequence[tuple[Insert, Flat]]  # with their lower left corners (m)
    kind: str  # of the polygon


def count_pixels(size: Flat) -> tuple[int, int]:
    """Give how many pixels a rectangle has along and upwards (m); the last ones may reach beyond it.

    Examples
    --------
    >>> count_pixels((1.2, 0.95))
    (12, 10)
    """
    width, height = (max(1, int(np.ceil(length / PIXEL - 1e-6))) for length in size)
    return width, height


def draw_picture(picture: Picture, colours: Colours, drawn: dict[Insert, Image]) -> Image:
    """Draw a picture, uint8 (height, width, 3), its upper left pixel first; `drawn` keeps assets."""
    width, height = count_pixels(picture.size)
    image = np.full((height, width, 3), colours[WALL], np.uint8)
    for insert, corner in picture.products:
        if insert not in drawn:
            drawn[insert] = draw_asset(insert, colours)
        left, low = (round(place / PIXEL) for place in corner)
        asset = drawn[insert][max(0, low + len(drawn[insert]) - height) :, : max(0, width - left)]
        top = height - low - len(asset)
        image[top : top + len(asset), left : left + asset.shape[1]] = asset
    return image


def draw_asset(insert: Insert, colours: Colours) -> Image:
    """Draw an asset with all its polygons, as seen from far before the wall."""
    made = Made()
    build(made, insert, (0.0, 0.0), 100)
    found = [(one, one.kind) for one in made.surfaces]
    found += [(one, BALCONY) for parts in made.installations for one in parts]
    width, height = count_pixels((insert.width, insert.height))
    canvas = np.full((height * FINE, width * FINE, 3), colours[WALL], np.float64)
    upright = [(one, kind) for one, kind in found if len({point[1] for point in one.border}) == 1]
    for one, kind in sorted(upright, key=lambda each: -each[0].border[0][1]):  # the deepest first
        away = one.border[0][1]
        shade = SHADES[(away > 0) + (away > insert.depth)]
        canvas[_find_pixels(one, canvas.shape[:2])] = np.round(shade * np.array(colours[kind]))
    mean: NDArray[np.float64] = canvas.reshape(height, FINE, width, FINE, 3).mean(axis=(1, 3))
    image: Image = np.round(mean)[::-1].astype(np.uint8)
    return image


def _find_pixels(one: Surface, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Find what of a canvas, upwards and along, is in the rectangle of a surface and in none of its holes."""
    inside = np.zeros(shape, np.bool_)
    for ring, value in [(one.border, True), *((hole, False) for hole in one.holes)]:
        (left, right), (low, high) = (
            (round(min(place) * FINE / PIXEL), round(max(place) * FINE / PIXEL))
            for place in ([point[k] for point in ring] for k in (0, 2))
        )
        inside[max(low, 0) : high, max(left, 0) : right] = value
    return inside
