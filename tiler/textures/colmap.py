"""Cameras of COLMAP: a folder with cameras and images as text or binary.

The format is that of colmap.github.io/format.html; coordinates of its world are the CRS's, less an origin.
"""

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from pipeline.data.errors import InputError
from tiler.textures.cameras import Array, Camera, turn_of_quaternion

# Models by number: name, and what its parameters are; those without distortion as of Brown are not supported.
MODELS = {
    0: ("SIMPLE_PINHOLE", "f cx cy"),
    1: ("PINHOLE", "fx fy cx cy"),
    2: ("SIMPLE_RADIAL", "f cx cy k1"),
    3: ("RADIAL", "f cx cy k1 k2"),
    4: ("OPENCV", "fx fy cx cy k1 k2 p1 p2"),
    5: ("OPENCV_FISHEYE", ""),
    6: ("FULL_OPENCV", "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6"),
    7: ("FOV", ""),
    8: ("SIMPLE_RADIAL_FISHEYE", ""),
    9: ("RADIAL_FISHEYE", ""),
    10: ("THIN_PRISM_FISHEYE", ""),
}
WORDS = dict(MODELS.values())
POINT_BYTES = 24  # of a point of an image: x, y and its number
Lens = tuple[int, int, Array, Array, Array]  # width, height, focal, centre, distortion


def read_colmap(folder: Path, origin: Array) -> Iterator[Camera]:
    """Read cameras; InputError if a file is damaged or a model is not supported, with its place."""
    read = _read_text if (folder / "cameras.txt").is_file() else _read_binary
    yield from read(folder, origin)


def _lens(place: str, model: str, width: int, height: int, values: list[float]) -> Lens:
    words = WORDS.get(model, "").split()
    named = dict(zip(words, values, strict=False))
    if not words or any(named.pop(word, 0.0) for word in ("k4", "k5", "k6")):
        known = ", ".join(name for name, text in WORDS.items() if text)
        raise InputError(
            f"{place}: camera model {model} {values} is not supported; undistort the images (colmap "
            f"image_undistorter) to PINHOLE; known: {known} with k4, k5 and k6 0"
        )
    if len(values) != len(words) or width < 1 or height < 1 or not np.isfinite(values).all():
        raise InputError(f"{place}: {width} x {height} pixels, parameters {values}; {model} has {words}")
    one = named.get("f", 0.0)
    focal = np.array([named.get("fx", one), named.get("fy", one)])
    if not (focal > 0).all():
        raise InputError(f"{place}: focal length {focal.tolist()} pixels; bound: above 0")
    distortion = np.array([named.get(word, 0.0) for word in ("k1", "k2", "k3", "p1", "p2")])
    return width, height, focal, np.array([named["cx"], named["cy"]]), distortion


def _camera(place: str, name: str, lens: Lens | None, pose: list[float], origin: Array) -> Camera:
    if lens is None or not np.isfinite(pose).all() or not any(pose[:4]):
        raise InputError(f"{place}: {name}: names no camera of the file, or has no pose ({pose}); export it again")
    turn = turn_of_quaternion(*pose[:4])
    return Camera(name, *lens, turn, origin - turn.T @ np.array(pose[4:7]))


def _rows(path: Path) -> Iterator[tuple[str, list[str]]]:
    """Give place and words of each line that is no comment; lines without words too."""
    for k, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
        if not line.startswith("#"):
            yield f"{path}:{k}", line.split()


def _read_text(folder: Path, origin: Array) -> Iterator[Camera]:
    lenses: dict[str, Lens] = {}
    for place, words in _rows(folder / "cameras.txt"):
        if words:
            try:
                number, model, width, height, *values = words
                lenses[number] = _lens(place, model, int(width), int(height), [float(v) for v in values])
            except ValueError:
                raise InputError(f"{place}: {' '.join(words)!r} is no camera; export the text again") from None
    rows = _rows(folder / "images.txt")
    for place, words in rows:
        if not words:
            continue
        try:
            pose, camera, name = [float(word) for word in words[1:8]], words[8], " ".join(words[9:])
        except (ValueError, IndexError):
            raise InputError(f"{place}: {' '.join(words)[:80]!r} is no image; export the text again") from None
        yield _camera(place, name, lenses.get(camera), pose, origin)
        next(rows, None)  # the points of the image, maybe none


def _read_binary(folder: Path, origin: Array) -> Iterator[Camera]:
    lenses: dict[int, Lens] = {}
    path = folder / "cameras.bin"
    with path.open("rb") as file:
        for k in range(_take(path, file, "<Q")[0]):
            number, model, width, height = _take(path, file, "<iiQQ")
            name, words = MODELS.get(model, (str(model), ""))
            values = _take(path, file, f"<{len(words.split())}d")
            lenses[number] = _lens(f"{path}: camera {k}", name, width, height, list(values))
    path = folder / "images.bin"
    with path.open("rb") as file:
        for k in range(_take(path, file, "<Q")[0]):
            _, *pose, camera = _take(path, file, "<i7di")
            text = b"".join(iter(lambda: _take(path, file, "<c")[0], b"\0"))
            name = text.decode("utf-8", "replace")
            file.seek(_take(path, file, "<Q")[0] * POINT_BYTES, 1)
            yield _camera(f"{path}: image {k}", name, lenses.get(camera), pose, origin)


def _take(path: Path, file: BinaryIO, form: str) -> tuple[Any, ...]:
    data = file.read(struct.calcsize(form))
    if len(data) < struct.calcsize(form):
        raise InputError(f"{path}: ends at byte {file.tell()}, within an entry; export it again")
    return struct.unpack(form, data)
