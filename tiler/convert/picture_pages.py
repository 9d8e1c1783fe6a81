"""Pages of pictures for textures of detailed models: squares filled row by row, written as PNG."""

from dataclasses import dataclass, field
from typing import IO

import numpy as np
from deflate import zlib_compress

from pipeline.facades.graph import Insert
from pipeline.facades.pictures import PIXEL, Colours, Image, Picture, count_pixels, draw_picture
from tiler.pictures.png import RGB, frame_png

PAGE = 1024  # pixels, side of a page
GUTTER = 2  # pixels around a picture that repeat its border, for viewers that blur textures
LEVEL = 9  # of libdeflate


@dataclass(frozen=True)
class Place:
    """Where a picture is: page, its lower left corner there (pixels from the upper left), size of a pixel (m)."""

    page: int
    left: int
    low: int
    pixel: float


@dataclass
class Pages:
    """Pages as they are filled; those that are full are in a file, one behind the other."""

    colours: Colours  #: as of `draw_picture`
    file: IO[bytes]  #: where pages are put
    sizes: list[int] = field(default_factory=list)  #: bytes of each page in it, a multiple of 4
    _page: Image | None = None
    _drawn: dict[Insert, Image] = field(default_factory=dict)
    _places: dict[object, Place] = field(default_factory=dict)
    _left: int = 0
    _top: int = 0
    _below: int = 0

    def place(self, picture: Picture) -> Place:
        """Find a place for a picture; equal ones of a page share it."""
        products = tuple((insert, *(round(x / PIXEL) for x in corner)) for insert, corner in picture.products)
        key = (count_pixels(picture.size), products)
        if key not in self._places:
            image = draw_picture(picture, self.colours, self._drawn)
            coarser = -(-max(image.shape[:2]) // (PAGE - 2 * GUTTER))
            place = self._put(image[::-coarser, ::coarser][::-1], PIXEL * coarser)
            self._places[key] = place
        return self._places[key]

    def _put(self, image: Image, pixel: float) -> Place:
        padded = np.pad(image, ((GUTTER, GUTTER), (GUTTER, GUTTER), (0, 0)), mode="edge")
        height, width = padded.shape[:2]
        if self._left + width > PAGE:
            self._left, self._top = 0, self._below
        if self._page is None or self._top + height > PAGE:
            self.close()
            self._page = np.full((PAGE, PAGE, 3), 255, np.uint8)
        self._page[self._top : self._top + height, self._left : self._left + width] = padded
        place = Place(len(self.sizes), self._left + GUTTER, self._top + height - GUTTER, pixel)
        self._left, self._below = self._left + width, max(self._below, self._top + height)
        return place

    def close(self) -> None:
        """Write the page that is being filled, if there is one."""
        if self._page is not None:
            png = write_png(self._page)
            self.sizes.append(self.file.write(png + b"\0" * (-len(png) % 4)))
        self._page = None
        self._places.clear()
        self._left = self._top = self._below = 0


def write_png(image: Image) -> bytes:
    """Give an image, uint8 (height, width, 3), as PNG: differences to the row above, which pack well."""
    height, width = image.shape[:2]
    rows = np.diff(image.reshape(height, -1), axis=0, prepend=np.zeros((1, 3 * width), np.uint8))
    data = np.column_stack((np.full(height, 2, np.uint8), rows)).tobytes()
    return frame_png((width, height), RGB, bytes(zlib_compress(data, LEVEL)))
