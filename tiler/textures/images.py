"""Image files: their size, their pixels at falling resolutions, and JPEG."""

from functools import cached_property
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.data.errors import ConfigError, InputError

QUALITY = 90  # of JPEG
MOST_LEVEL = 5  # halvings
Pixels = NDArray[np.uint8]


def pillow() -> Any:
    """Import Pillow's module of images; ConfigError without it."""
    try:
        from PIL import Image
    except ImportError as error:
        raise ConfigError("textures need Pillow: pip install 'citystitch[textures]'") from error
    return Image


def image_size(path: Path) -> tuple[int, int]:
    """Read width and height (pixels) of the head of a file; InputError if it is missing or no image."""
    opener = pillow()
    try:
        with opener.open(path) as image:
            width, height = image.size
    except (OSError, ValueError, opener.DecompressionBombError) as error:
        raise _unread(path, error) from None
    return width, height


def read_pixels(path: Path) -> Pixels:
    """Read an image as RGB, uint8 (height, width, 3), as it lies in the file; InputError if it is damaged."""
    opener = pillow()
    try:
        with opener.open(path) as image:
            return np.asarray(image.convert("RGB"))
    except (OSError, ValueError, SyntaxError, opener.DecompressionBombError) as error:
        raise _unread(path, error) from None


def _unread(path: Path, error: Exception) -> InputError:
    reason = "is not there" if isinstance(error, FileNotFoundError) else f"cannot be read ({error})"
    return InputError(f"{path}: {reason}")


class Pyramid:
    """An image and its halves, each the mean of four pixels of the one before."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._halves: list[Pixels] = []

    @cached_property
    def whole(self) -> Pixels:
        """The image."""
        return read_pixels(self._path)

    def level(self, k: int) -> Pixels:
        """Give the image halved `k` times."""
        while len(self._halves) < k:
            last = self._halves[-1] if self._halves else self.whole
            image = pillow().fromarray(last).reduce(2)
            self._halves.append(np.asarray(image))
        return self._halves[k - 1] if k else self.whole


def jpeg(pixels: Pixels) -> bytes:
    """Write RGB pixels (h, w, 3) as JPEG."""
    file = BytesIO()
    pillow().fromarray(pixels).save(file, "JPEG", quality=QUALITY, subsampling=0)
    return file.getvalue()
