"""Three façades whose rhythm is known, drawn: `python -m tests.benchmarks.facade_rhythm FILE.png`.

Windows differ (curtains, blinds, reflections), the wall has stains, bricks and noise, the light falls off; the
second has shops below, the third a tree before it. The picture shows storeys and bays as they are found.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from scipy.ndimage import gaussian_filter

from pipeline.facades.rhythm import find_rhythm

PIXEL = 0.03  # m


@dataclass(frozen=True)
class Known:
    """A façade: width (m), ground floor, storeys and their height, bays and their width, window and sill."""

    width: float
    base: float
    storey: float
    storeys: int
    bay: float
    bays: int
    window: tuple[float, float, float]
    wall: tuple[int, int, int]
    shops: bool = False
    tree: bool = False

    @property
    def height(self) -> float:
        """Height (m): with 0.4 m of cornice."""
        return self.base + self.storeys * self.storey + 0.4


FACADES = (
    Known(14.4, 0.5, 2.9, 5, 2.4, 6, (1.2, 1.5, 0.8), (196, 170, 140)),
    Known(18.0, 4.2, 3.4, 4, 3.0, 6, (1.4, 2.1, 0.5), (168, 92, 74), shops=True),
    Known(13.0, 0.6, 3.1, 4, 3.2, 4, (1.7, 1.6, 0.9), (214, 210, 200), tree=True),
)


def draw(known: Known, seed: int) -> NDArray[np.uint8]:
    """Draw the image of a façade."""
    rng = np.random.default_rng(seed)
    h, w = int(known.height / PIXEL), int(known.width / PIXEL)
    stains = gaussian_filter(rng.normal(size=(h, w)), 12) * 120
    image = np.array(known.wall, float) + stains[..., np.newaxis]
    image[np.arange(h) % 4 == 0] -= 5  # courses
    margin = (known.width - known.bays * known.bay) / 2
    wide, tall, sill = known.window
    for j in range(known.storeys):
        for i in range(known.bays):
            x = margin + (i + 0.5) * known.bay - wide / 2
            y = known.base + j * known.storey + sill
            box = (
                slice(h - int((y + tall) / PIXEL), h - int(y / PIXEL)),
                slice(int(x / PIXEL), int((x + wide) / PIXEL)),
            )
            shape = image[box].shape
            image[box] = rng.uniform(25, 75) + np.array([0, 5, 15])
            image[box][: int(shape[0] * rng.choice([0, 0, 0.3, 0.6]))] = rng.uniform(150, 220)  # blinds
            image[box][:, shape[1] // 2 - 1 : shape[1] // 2 + 1] = 225
            image[box][[0, 1, -2, -1]] = 230
            image[box][:, [0, 1, -2, -1]] = 230
    if known.shops:
        image[h - int(3.4 / PIXEL) : h - int(0.3 / PIXEL), int(0.8 / PIXEL) : -int(0.8 / PIXEL)] = (50, 55, 60)
        image[h - int(3.9 / PIXEL) : h - int(3.4 / PIXEL)] = (40, 90, 60)
    if known.tree:
        y, x = np.mgrid[:h, :w] * PIXEL
        crown = (x - 3.0) ** 2 + ((h * PIXEL - y) - 3.0) ** 2 < (
            2.4 + gaussian_filter(rng.normal(size=(h, w)), 8) * 6
        ) ** 2
        leaves = np.array([70, 110, 45]) + rng.normal(size=(h, w, 1)) * 28
        image[crown] = leaves[crown]
    image *= np.linspace(1.08, 0.85, w)[np.newaxis, :, np.newaxis]
    return np.clip(image + rng.normal(size=image.shape) * 6, 0, 255).astype(np.uint8)


def main(path: Path) -> None:
    """Draw the façades with what is found, and print it beside what is known."""
    pictures = []
    for seed, known in enumerate(FACADES):
        pixels = draw(known, seed)
        found = find_rhythm(pixels.mean(axis=2), known.width, known.height)
        print(f"known: storeys {known.storeys} x {known.storey}, from {known.base}; "
              f"bays {known.bays} x {known.bay}; window {known.window}")  # fmt: skip
        print(f"found: storeys {found.storeys}; bays {found.bays}; window {np.round(found.window, 2).tolist()}")
        image = Image.fromarray(pixels)
        pen = ImageDraw.Draw(image)
        for beat, upwards in ((found.storeys, True), (found.bays, False)):
            for k in range(beat.n + 1):
                at = (beat.start + k * beat.size) / PIXEL
                line = (
                    (0, image.height - at, image.width, image.height - at)
                    if upwards
                    else (at, 0, at, image.height)
                )
                pen.line(line, fill=(255, 40, 40), width=3)
        wide, tall, sill = found.window
        for j in range(found.storeys.n):
            for i in range(found.bays.n):
                x = found.bays.start + (i + 0.5) * found.bays.size - wide / 2
                y = found.storeys.start + j * found.storeys.size + sill
                corners = (x, known.height - y - tall, x + wide, known.height - y)
                pen.rectangle([value / PIXEL for value in corners], outline=(40, 220, 255), width=2)
        pictures.append(image)
    whole = Image.new("RGB", (sum(p.width for p in pictures) + 40, max(p.height for p in pictures)), "white")
    x = 0
    for image in pictures:
        whole.paste(image, (x, whole.height - image.height))
        x += image.width + 20
    whole.resize((whole.width * 2 // 3, whole.height * 2 // 3)).quantize(64).quantize(64).save(path)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
