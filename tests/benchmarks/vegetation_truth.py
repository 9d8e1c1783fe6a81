"""The classifier of plants on ten drawn streets: `python -m tests.benchmarks.vegetation_truth`."""

import time
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from PIL import Image

from tests.helpers.street_pictures import draw_street
from tiler.textures.images import read_pixels
from tiler.textures.vegetation import find_plants, read_classifier, train_classifier

STREETS = 10


def main() -> None:
    """Train, and print the accuracy by leave-one-out and the time an image."""
    with TemporaryDirectory() as name:
        images, masks, output = (Path(name) / part for part in ("images", "masks", "plants.json"))
        images.mkdir()
        masks.mkdir()
        for seed in range(STREETS):
            pixels, trees = draw_street(seed)
            Image.fromarray(pixels).save(images / f"{seed}.png")
            Image.fromarray(trees.astype(np.uint8) * 255).save(masks / f"{seed}.png")
        print(*train_classifier(images, masks, output), sep="\n")
        classifier, pixels = read_classifier(output), np.tile(read_pixels(images / "0.png"), (10, 10, 1))
        find_plants(classifier, pixels[:60, :60])  # compiles the kernel
        begun = time.process_time()
        find_plants(classifier, pixels)
        spent, size = time.process_time() - begun, pixels.shape[0] * pixels.shape[1] / 1e6
        print(f"{spent:.2f} s of CPU for {size:.0f} M pixels")


if __name__ == "__main__":
    main()
