"""Cameras of Bundler: ``bundle.out`` and the list of images beside it.

Its cameras look along -z with y up, and pixels count from the middle of the image.
"""

from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from pipeline.data.errors import InputError
from tiler.textures.cameras import Array, Camera

FLIP = np.diag([1.0, -1.0, -1.0])
LISTS = ("list.txt", "../list.txt")
PER_CAMERA = 15


def read_bundler(path: Path, origin: Array, told: Counter[str]) -> Iterator[Camera]:
    """Read cameras; those without a focal length were not oriented, and are counted.

    InputError if the file is damaged, or `LISTS` has not as many names as there are cameras.
    """
    lists = [path.parent / name for name in LISTS]
    names_file = next((one for one in lists if one.is_file()), None)
    if names_file is None:
        raise InputError(f"{path}: names no images, and {lists[0]} is not there; put the list of images there")
    names = [line.split()[0] for line in names_file.read_text(encoding="utf-8").splitlines() if line.split()]
    text = path.read_text(encoding="utf-8", errors="replace")
    words = [word for line in text.splitlines() if not line.startswith("#") for word in line.split()]
    try:
        n = int(words[0])
        values = np.array(words[2 : 2 + PER_CAMERA * n], np.float64).reshape(n, PER_CAMERA)
    except (ValueError, IndexError):
        raise InputError(f"{path}: has not the cameras that its head states; write it again") from None
    if len(names) != n:
        raise InputError(f"{names_file}: {len(names)} images, and {path} has {n} cameras; give its own list")
    for name, row in zip(names, values, strict=True):
        focal, k1, k2 = row[:3].tolist()
        turn = row[3:12].reshape(3, 3)
        if not focal > 0 or not np.isfinite(row).all() or not np.allclose(turn @ turn.T, np.eye(3), atol=1e-3):
            told["images without an orientation, left out"] += 1
            continue
        lens = np.full(2, focal), np.zeros(2), np.array([k1, k2, 0.0, 0.0, 0.0])
        yield Camera(name, 0, 0, *lens, FLIP @ turn, origin - turn.T @ row[12:])
