"""Pictures of streets with trees, and where the trees are."""

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter


def draw_street(seed: int, size: tuple[int, int] = (300, 400)) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Draw walls with windows, a roof, a street and trees; gives the picture (h, w, 3) and the trees (h, w).

    Light, colours of walls, roofs and leaves differ with the seed; some walls are green.
    """
    rng = np.random.default_rng(seed)
    h, w = size
    x: float
    y: float
    light = rng.uniform(0.75, 1.15)
    image = np.empty((h, w, 3))
    image[: h // 5] = rng.choice([[150, 60, 45], [90, 90, 100], [120, 95, 75]])
    image[: h // 5 : 6] *= 0.85
    image[h // 5 :] = rng.choice([[200, 180, 150], [170, 95, 80], [215, 215, 210], [165, 185, 150]])
    image[h - h // 8 :] = 110
    for y in range(h // 5 + 15, h - h // 8 - 40, 55):
        for x in range(15 + int(rng.integers(20)), w - 35, 48):
            image[y : y + 34, x : x + 24] = rng.uniform(30, 90) + np.array([0, 8, 16])
            image[y : y + 34, x + 11 : x + 13] = 225
    ys, xs = np.mgrid[:h, :w]
    trees = np.zeros((h, w), np.bool_)
    for _ in range(int(rng.integers(2, 5))):
        x, y, r = rng.uniform(0, w), rng.uniform(h * 0.5, h), rng.uniform(30, 65)
        trees |= (xs - x) ** 2 + (ys - y) ** 2 < (r + gaussian_filter(rng.normal(size=size), 6) * 60) ** 2
    leaves = rng.choice([[75, 110, 50], [95, 120, 60], [60, 90, 55]]) * (
        1 + 0.9 * gaussian_filter(rng.normal(size=(h, w, 1)), (1.2, 1.2, 0))
    )
    image = np.where(trees[..., np.newaxis], leaves, image + gaussian_filter(rng.normal(size=(h, w, 1)), 9) * 40)
    return np.clip(image * light + rng.normal(size=image.shape) * 7, 0, 255).astype(np.uint8), trees
