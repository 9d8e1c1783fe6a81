"""Plants in images: patches told by a trained classifier of their colours and edges.

Features are those of the paper (Gobbetti et al. 2011, section 4): means of RGB and HSV, a histogram of hue in five
bins, and edge orientations; spreads of brightness are added.
"""

import json
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_closing

from pipeline.data.errors import ConfigError, InputError
from pipeline.data.kernel import kernel
from tiler.convert.convert import refuse_output
from tiler.store.atomic import replacing
from tiler.store.run_folder import WRONG_FIELD
from tiler.textures.cameras import Array
from tiler.textures.images import Pixels, read_pixels

PATCH = 15  # pixels, as in the paper
HUES, EDGES = 5, 6  # bins
COLOURED = 0.08  # saturation from which on a pixel has a hue
FEATURES = 6 + HUES + EDGES + 3
HIDDEN, ROUNDS = 12, 300  # neurons, and steps of the optimiser
MIXED = 0.2  # part of a patch: what is between this and the rest teaches nothing
FORMAT = "citystitch vegetation 1"


@dataclass(frozen=True, eq=False)
class Classifier:
    """Layers of a small network: a patch shows plants where the last value is above 0."""

    patch: int  #: side of a patch (pixels)
    #: (f,): of the features of the training
    mean: Array
    spread: Array
    weights: list[Array]  #: each (n, m): of each layer; between layers negative values become 0
    offsets: list[Array]  #: each (m,): of each layer

    def shows_plants(self, features: Array) -> NDArray[np.bool_]:
        """Tell of features (n, f) whether they are of plants, (n,)."""
        values = (features - self.mean) / self.spread
        for k, (weights, offsets) in enumerate(zip(self.weights, self.offsets, strict=True)):
            values = (np.maximum(values, 0) if k else values) @ weights + offsets
        found: NDArray[np.bool_] = values[:, 0] > 0
        return found


def patch_features(pixels: Pixels, patch: int = PATCH) -> tuple[Array, tuple[int, int]]:
    """Give the features (a * b, f) of the patches of an image, row by row, and their rows and columns.

    The last row and column may be cut off by the border of the image.
    """
    height, width = pixels.shape[:2]
    shape = -(-height // patch), -(-width // patch)
    sums = np.zeros((*shape, FEATURES + 1))
    _sum_patches(pixels, patch, sums)
    found = sums[..., :-1] / sums[..., -1:]
    edges = found[..., 6 + HUES : 6 + HUES + EDGES]
    edges /= edges.sum(axis=-1, keepdims=True) + 1e-4
    grey = found[..., :3].mean(axis=-1)
    found[..., -1] = np.sqrt(np.maximum(found[..., -1] - grey * grey, 0))
    return found.reshape(-1, FEATURES), shape


@kernel
def _sum_patches(pixels: Pixels, patch: int, sums: Array) -> None:
    """Add the values of the pixels (h, w, 3) of each patch, and their number at last, to sums (a, b, f + 1)."""
    height, width = pixels.shape[:2]
    for j in range(height):
        above, below = max(j - 1, 0), min(j + 1, height - 1)
        for i in range(width):
            total = sums[j // patch, i // patch]
            red, green, blue = pixels[j, i, 0] / 255.0, pixels[j, i, 1] / 255.0, pixels[j, i, 2] / 255.0
            value = max(red, green, blue)
            spread = value - min(red, green, blue)
            saturation = spread / value if value > 0.0 else 0.0
            total[0] += red
            total[1] += green
            total[2] += blue
            total[4] += saturation
            total[5] += value
            if saturation > COLOURED:
                if value == red:
                    hue = (green - blue) / spread / 6.0
                elif value == green:
                    hue = ((blue - red) / spread + 2.0) / 6.0
                else:
                    hue = ((red - green) / spread + 4.0) / 6.0
                hue = hue + 1.0 if hue < 0.0 else hue
                total[3] += hue
                total[6 + min(int(hue * HUES), HUES - 1)] += 1.0
            left, right = max(i - 1, 0), min(i + 1, width - 1)
            across = down = 0.0
            for c in range(3):
                across += (float(pixels[j, right, c]) - float(pixels[j, left, c])) / 1530.0
                down += (float(pixels[below, i, c]) - float(pixels[above, i, c])) / 1530.0
            strength = np.sqrt(across * across + down * down)
            if strength > 0.0:
                angle = np.arctan2(down, across) / np.pi
                angle = angle + 1.0 if angle < 0.0 else angle
                total[6 + HUES + min(int(angle * EDGES), EDGES - 1)] += strength
            total[6 + HUES + EDGES] += strength
            total[7 + HUES + EDGES] += 2.0 * green - red - blue
            total[8 + HUES + EDGES] += ((red + green + blue) / 3.0) ** 2
            total[9 + HUES + EDGES] += 1.0


def find_plants(classifier: Classifier, pixels: Pixels) -> NDArray[np.uint8]:
    """Give the patches (a, b) of an image that show plants, with small gaps closed."""
    return _close(classifier, *patch_features(pixels, classifier.patch))


def _close(classifier: Classifier, features: Array, shape: tuple[int, int]) -> NDArray[np.uint8]:
    plants = classifier.shows_plants(features).reshape(shape)
    return (plants | binary_closing(plants)).astype(np.uint8)


def read_classifier(path: Path) -> Classifier:
    """Read a classifier that `citystitch vegetation` wrote.

    Raises
    ------
    ConfigError
        If there is no such file.
    InputError
        If it is none, or has other features.
    """
    if not path.is_file():
        raise ConfigError(f"--vegetation {path}: no such file; write one with citystitch vegetation")
    try:
        read = json.loads(path.read_text(encoding="utf-8"))
        if read["format"] != FORMAT:
            raise ValueError(f"format {read['format']!r}; known: {FORMAT}")
        weights, offsets = ([np.array(one, np.float64) for one in read[key]] for key in ("weights", "offsets"))
        found = Classifier(int(read["patch"]), np.array(read["mean"]), np.array(read["spread"]), weights, offsets)
        if found.patch < 1 or not np.isfinite(found.shows_plants(np.zeros((1, FEATURES)))).all():
            raise ValueError("a patch without pixels")
    except (UnicodeDecodeError, *WRONG_FIELD) as error:
        raise InputError(f"{path}: is no classifier ({error!r}); train it again") from None
    return found


def train_classifier(images: Path, masks: Path, output: Path, *, overwrite: bool = False) -> list[str]:
    """Train a classifier with patches of labelled images, and write it; gives its accuracy, a line each image.

    The accuracy is that of pixels of an image by a classifier of all other images.

    Parameters
    ----------
    images, masks : Path
        Folders of images, and of their labels: images of the same size, ``NAME.png`` for an image ``NAME.*``, not
        black where there are plants.
    output : Path
        JSON file; it appears whole or not at all.
    overwrite : bool
        Whether it may exist.

    Raises
    ------
    ConfigError
        If scikit-learn is not there, or the file exists.
    InputError
        If there are not two labelled images with patches of both kinds, or one cannot be read.
    OutputError
        If the file cannot be written.
    """
    refuse_output(output, [images, masks], overwrite=overwrite)
    labelled = [_read_labelled(path, masks) for path in _list_images(images, masks)]
    if len(labelled) < 2:
        raise InputError(f"{masks}: labels of {len(labelled)} images of {images}; at least 2: one is left out")
    lines, rates = [], []
    for k, one in enumerate(labelled):
        found = fit_classifier([other for j, other in enumerate(labelled) if j != k])
        plants = np.kron(_close(found, one.features, one.shape), np.ones((PATCH, PATCH), np.uint8))
        right = plants[: one.mask.shape[0], : one.mask.shape[1]].astype(np.bool_) == one.mask
        rates.append(float(right.mean()))
        lines.append(f"{one.name}: {100 * rates[-1]:.1f} % of its pixels right, by the other images")
    whole = fit_classifier(labelled)
    document = {
        "format": FORMAT,
        "patch": whole.patch,
        "leave_one_out": round(float(np.mean(rates)), 4),
        "images": len(labelled),
        **{name: getattr(whole, name).tolist() for name in ("mean", "spread")},
        **{name: [rows.tolist() for rows in getattr(whole, name)] for name in ("weights", "offsets")},
    }
    with replacing(output) as part:
        part.write_text(json.dumps(document) + "\n", encoding="utf-8")
    return [*lines, f"leave-one-out accuracy: {100 * float(np.mean(rates)):.1f} % of {len(labelled)} images"]


@dataclass(frozen=True, eq=False)
class Labelled:
    """An image: features of its patches (a * b, f), a and b, and where it shows plants, bool (h, w)."""

    name: str
    features: Array
    shape: tuple[int, int]
    mask: NDArray[np.bool_]


def _list_images(images: Path, masks: Path) -> list[Path]:
    if not images.is_dir() or not masks.is_dir():
        raise ConfigError(f"{images}, --masks {masks}: one of them is no folder; give both")
    return sorted(path for path in images.iterdir() if (masks / f"{path.stem}.png").is_file() and path.is_file())


def _read_labelled(path: Path, masks: Path) -> Labelled:
    mask = masks / f"{path.stem}.png"
    pixels, labels = read_pixels(path), read_pixels(mask).any(axis=2)
    if pixels.shape[:2] != labels.shape:
        raise InputError(f"{mask}: {labels.shape[::-1]} pixels, and {path} {pixels.shape[1::-1]}; label it again")
    return Labelled(path.name, *patch_features(pixels), np.asarray(labels))


def fit_classifier(labelled: Sequence[Labelled]) -> Classifier:
    """Fit a network with one hidden layer to the patches that show plants alone, or none.

    InputError if there are none of a kind.
    """
    try:
        from sklearn.neural_network import MLPClassifier
    except ImportError as error:
        raise ConfigError("training needs scikit-learn: pip install 'citystitch[textures]'") from error
    rows, kinds = [np.empty((0, FEATURES))], [np.empty(0, np.bool_)]
    for one in labelled:
        (a, b), (height, width) = one.shape, one.mask.shape
        padded = np.pad(one.mask, ((0, a * PATCH - height), (0, b * PATCH - width)), mode="edge")
        share = padded.reshape(a, PATCH, b, PATCH).mean(axis=(1, 3)).ravel()
        clear = (share >= 1 - MIXED) | (share <= MIXED)
        rows.append(one.features[clear])
        kinds.append(share[clear] > 0.5)
    features, kind = np.concatenate(rows), np.concatenate(kinds)
    if kind.all() or not kind.any():
        what = "no plants" if not kind.any() else "nothing but plants"
        raise InputError(f"{', '.join(one.name for one in labelled)}: show {what}; label more images")
    mean, spread = features.mean(axis=0), features.std(axis=0) + 1e-6
    network = MLPClassifier((HIDDEN,), solver="lbfgs", alpha=1.0, max_iter=ROUNDS, random_state=0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of an optimum that is not reached: the accuracy is what counts
        network.fit((features - mean) / spread, kind)
    return Classifier(PATCH, mean, spread, list(network.coefs_), list(network.intercepts_))
