"""Parts of maps in SVG: polygons as a raster, which does not grow with their number, and a scale bar."""

import base64
import math
import zlib

import numpy as np
import shapely
from numpy.typing import NDArray

from tiler.pictures.png import PALETTE, frame_png


class FootprintRaster:
    """Footprints on a raster, for maps that look the same whatever their number.

    Parameters
    ----------
    bounds : (xmin, ymin, xmax, ymax)
        What the raster covers (m).
    pixels : int
        Along its longer side.

    Examples
    --------
    >>> raster = FootprintRaster((0, 0, 4, 2), 4)
    >>> raster.add(np.array([shapely.box(1, 0, 3, 1)]))
    >>> raster.shares().tolist()
    [[0, 0, 0, 0], [0, 255, 255, 0]]
    """

    SAMPLES = 2  # looked at along each pixel

    def __init__(self, bounds: tuple[float, float, float, float], pixels: int) -> None:
        width, height = bounds[2] - bounds[0], bounds[3] - bounds[1]
        self._low, self._step = np.array(bounds[:2]), max(width, height) / (pixels * self.SAMPLES)
        rows, columns = (
            self.SAMPLES * max(1, round(side / self._step / self.SAMPLES)) for side in (height, width)
        )
        # How often outlines are crossed upwards less downwards, on the way from the west to each sample.
        self._turns = np.zeros((rows, columns + 1), np.int32)

    def add(self, polygons: NDArray[np.object_]) -> None:
        """Add polygons or multipolygons (n,); samples whose centres are within them count."""
        rings = shapely.get_rings(shapely.orient_polygons(shapely.get_parts(polygons)))
        xy, ring = shapely.get_coordinates(rings, return_index=True)
        place = (xy - self._low) / self._step - 0.5  # centres are whole numbers
        edge = np.flatnonzero(ring[1:] == ring[:-1])
        (ax, ay), (bx, by) = place[edge].T, place[edge + 1].T
        rows, columns = self._turns.shape
        first, last = (np.clip(np.ceil(end(ay, by)), 0, rows).astype(int) for end in (np.minimum, np.maximum))
        n = last - first
        k = np.repeat(np.arange(len(edge)), n)
        row = np.arange(n.sum()) - np.repeat(np.cumsum(n) - n, n) + first[k]
        x = ax[k] + (row - ay[k]) / (by[k] - ay[k]) * (bx[k] - ax[k])
        column = np.clip(np.ceil(x), 0, columns - 1).astype(int)
        np.add.at(self._turns, (row, column), np.where(by[k] > ay[k], -1, 1))

    def shares(self) -> NDArray[np.uint8]:
        """Give how much of each pixel is covered, 0 to 255; row 0 in the north."""
        covered = np.cumsum(self._turns[:, :-1], axis=1) > 0
        rows, columns = covered.shape
        shape = (rows // self.SAMPLES, self.SAMPLES, columns // self.SAMPLES, self.SAMPLES)
        found: NDArray[np.uint8] = np.rint(covered.reshape(shape).mean(axis=(1, 3))[::-1] * 255).astype(np.uint8)
        return found


def encode_png(alpha: NDArray[np.uint8], colour: str = "#464646") -> bytes:
    """Write a picture of one colour, as opaque as each pixel says, as PNG.

    Parameters
    ----------
    alpha : uint8, (rows, columns)
        Opacity, row 0 at the top.
    colour : str
        ``"#rrggbb"``.
    """
    rows, columns = alpha.shape
    lines = np.zeros((rows, 1 + columns), np.uint8)
    lines[:, 1:] = alpha
    palette = (b"PLTE", 256 * bytes.fromhex(colour[1:])), (b"tRNS", bytes(range(256)))
    return frame_png((columns, rows), PALETTE, zlib.compress(lines.tobytes(), 9), palette)


def draw_image(png: bytes, size: tuple[float, float], attributes: str = "") -> str:
    """Make an SVG image that carries a PNG file, stretched to a size."""
    data = base64.b64encode(png).decode()
    return (
        f'<image width="{size[0]:.1f}" height="{size[1]:.1f}" preserveAspectRatio="none" {attributes} '
        f'href="data:image/png;base64,{data}"/>'
    )


def draw_scale_bar(width: float, height: float, scale: float) -> str:
    """Draw a bar of a round length below a map, and where north is; 44 units high.

    Parameters
    ----------
    width, height : float
        Of the map (units).
    scale : float
        Units a metre.
    """
    about = 0.3 * width / scale
    power = 10.0 ** math.floor(math.log10(about))
    length = max(step for step in (1.0, 2.0, 5.0) if step * power <= about) * power
    words = f"{length / 1000:g} km" if length >= 1000 else f"{length:g} m"
    end = 2 + length * scale
    return (
        f'<path class="scale" d="M2 {height + 8:.1f}v8H{end:.1f}v-8"/>'
        f'<text x="{end + 8:.1f}" y="{height + 26:.1f}">{words}</text>'
        f'<text x="{width - 4:.1f}" y="{height + 26:.1f}" text-anchor="end">north is up</text>'
    )
