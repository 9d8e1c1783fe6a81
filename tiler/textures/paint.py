"""Texels of the surfaces of a tile: from their best images, the rest filled with colour."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import log2
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from tiler.textures.cameras import Camera
from tiler.textures.images import MOST_LEVEL, Pyramid
from tiler.textures.surfaces import Bins, Surface
from tiler.textures.views import Plants, Ranking, open_view, texel_grid, texel_middles
from tiler.textures.visibility import SEEN, sample_pixels

IMAGES = 3  # that a surface takes texels of: the best, and for what it does not show the next ones
LARGEST = 2048  # texels along a side of a surface
NO_IMAGE = 255


@dataclass(frozen=True, eq=False)
class Painted:
    """A surface with its texels."""

    pixels: NDArray[np.uint8]  #: (h, w, 3): colours, the first row at the top
    #: (h, w): which of its images a texel is of, 0 for the best; `NO_IMAGE` where none shows it
    rank: NDArray[np.uint8]
    inside: NDArray[np.bool_]  #: (h, w): whether the middle of a texel is in the surface
    texel: float  #: side of a texel (m)
    scale: float  #: pixels of its images per metre, the mean of its texels; 0 where none shows it

    @property
    def share(self) -> float:
        """Part of its texels that an image shows."""
        return float(((self.rank != NO_IMAGE) & self.inside).sum() / max(int(self.inside.sum()), 1))


@dataclass(eq=False)
class _Canvas:
    """A surface while it is painted."""

    surface: Surface
    texel: float
    inside: NDArray[np.bool_]
    pixels: NDArray[np.uint8]
    rank: NDArray[np.uint8]
    scale: NDArray[np.float32]


def paint_surfaces(
    surfaces: Sequence[Surface],
    cameras: Sequence[Camera],
    ranking: Ranking,
    bins: Bins,
    images: Path,
    plants_of: Callable[[Camera], Plants],
    *,
    texel: float,
    least: float,
) -> list[Painted | None]:
    """Paint surfaces, an image at a time; None for one that no image shows.

    Parameters as of `tiler.textures.views.rank_images`; `images` is the folder of images, `texel` the side of a
    texel (m). InputError if an image is damaged.
    """
    uses: dict[int, list[tuple[int, int]]] = {}
    canvases: list[_Canvas | None] = []
    for row, (surface, best) in enumerate(zip(surfaces, ranking.best, strict=True)):
        canvases.append(_stretch(surface, texel) if best else None)
        for rank, number in enumerate(best[:IMAGES]):
            uses.setdefault(number, []).append((row, rank))
    for number in sorted(uses):
        camera, own = cameras[number], uses[number]
        view = open_view(camera, [surfaces[row] for row, _ in own], bins, plants_of(camera))
        if view is None:
            continue
        pyramid = Pyramid(images / camera.name)
        for row, rank in own:
            canvas = canvases[row]
            if canvas is None:
                continue
            open_texels = canvas.inside & (canvas.rank > rank)
            if not open_texels.any():
                continue
            points = texel_middles(canvas.surface, canvas.texel, open_texels)
            state, place, scale = view.see(points, canvas.surface)
            seen = (state == SEEN) & (scale >= least)
            if not seen.any():
                continue
            level = min(max(int(log2(max(float(np.median(scale[seen])) * canvas.texel, 1.0))), 0), MOST_LEVEL)
            colours = np.empty((int(seen.sum()), 3))
            sample_pixels(pyramid.level(level), place[seen] / 2**level, colours)
            rows = np.flatnonzero(open_texels)[seen]
            canvas.pixels.reshape(-1, 3)[rows] = np.round(colours)
            canvas.rank.reshape(-1)[rows] = rank
            canvas.scale.reshape(-1)[rows] = scale[seen]
    return [None if canvas is None else _finish(canvas) for canvas in canvases]


def _stretch(surface: Surface, texel: float) -> _Canvas:
    texel = max(texel, float(surface.size.max()) / LARGEST)
    inside = texel_grid(surface, texel)
    inside = inside if inside.any() else np.ones_like(inside)
    shape = inside.shape
    return _Canvas(
        surface, texel, inside, np.zeros((*shape, 3), np.uint8), np.full(shape, NO_IMAGE, np.uint8),
        np.zeros(shape, np.float32),
    )  # fmt: skip


def _finish(canvas: _Canvas) -> Painted | None:
    """Fill texels without an image: in the surface with the mean of the others, around it with the nearest."""
    seen = canvas.rank != NO_IMAGE
    if not seen.any():
        return None
    pixels = canvas.pixels
    pixels[canvas.inside & ~seen] = np.round(pixels[seen].mean(axis=0))
    if not canvas.inside.all():
        near = distance_transform_edt(~canvas.inside, return_distances=False, return_indices=True)
        pixels = pixels[near[0], near[1]]
    return Painted(pixels, canvas.rank, canvas.inside, canvas.texel, float(canvas.scale[seen].mean()))
