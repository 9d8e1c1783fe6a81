"""Files of cameras of any kind, and which of their images can be used."""

from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyproj

from pipeline.data.errors import ConfigError, InputError
from tiler.textures.bundler import read_bundler
from tiler.textures.cameras import Array, Camera
from tiler.textures.colmap import read_colmap
from tiler.textures.images import image_size
from tiler.textures.opensfm import read_opensfm

FARTHEST = 5_000.0  # m from the box of the city: cameras beyond it do not show it
# Where a project has its cameras, within its folder.
PLACES = ("cameras.txt", "cameras.bin", "sparse/0/cameras.txt", "sparse/0/cameras.bin", "sparse/cameras.txt",
          "sparse/cameras.bin", "opensfm/reconstruction.json", "reconstruction.json", "bundle.out",
          "bundle/bundle.out")  # fmt: skip


def read_cameras(
    path: Path, origin: Array | None, crs: pyproj.CRS | None, lift: float, told: Counter[str]
) -> Iterator[Camera]:
    """Read cameras of COLMAP, Bundler, OpenSfM or OpenDroneMap, by the names of their files.

    Parameters
    ----------
    path : Path
        A file, or a folder with one of `PLACES`.
    origin : float64 (3,), optional
        Place in the CRS (m) that their coordinates count from. Only OpenSfM's reference can stand for it.
    crs, lift
        See `read_opensfm`.
    told : Counter of str
        What is left out is counted here.

    Raises
    ------
    ConfigError
        If there is no such file, or an origin must be given.
    InputError
        If a file is damaged, or a camera is not supported.
    """
    found = next((path / name for name in PLACES if (path / name).is_file()), None) if path.is_dir() else path
    if found is None or not found.is_file():
        raise ConfigError(f"--cameras {path}: holds none of {', '.join(PLACES)}; give the file or its folder")
    try:
        if found.suffix == ".json":
            yield from read_opensfm(found, origin, crs, lift)
            return
        if origin is None:
            raise ConfigError(
                f"{found}: does not state what its coordinates count from; give --origin X,Y,Z, in the CRS of the "
                "city (0,0,0 if they are of it)"
            )
        if found.suffix == ".out":
            yield from read_bundler(found, origin, told)
        elif found.stem in ("cameras", "images"):
            yield from read_colmap(found.parent, origin)
        else:
            raise ConfigError(f"--cameras {found}: is no file of {', '.join(PLACES)}; give one")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{found}: cannot be read ({error}); export the cameras again") from None


def usable_cameras(
    cameras: Iterator[Camera], images: Path, low: Array, high: Array, told: Counter[str]
) -> tuple[list[Camera], list[tuple[str, str]]]:
    """Sort cameras whose images can be used, by name, from those left out with the reason.

    Parameters
    ----------
    cameras : iterator of Camera
        All cameras.
    low, high : float64 (3,)
        Box of the city (m).
    told : Counter of str
        What is left out is counted here.

    Raises
    ------
    InputError
        If no image can be used: with the first reason.
    """
    kept, out = [], []
    for camera in sorted(cameras, key=lambda one: one.name):
        off = float(np.linalg.norm(np.maximum(np.maximum(low - camera.place, camera.place - high), 0.0)))
        if not off <= FARTHEST:
            where = ", ".join(f"{value:.0f}" for value in camera.place)
            out.append((camera.name, f"its camera at {where} is {off:.0f} m from the city; bound: {FARTHEST:g} m"))
            continue
        try:
            size = image_size(images / camera.name)
        except InputError as error:
            out.append((camera.name, str(error)))
            continue
        if camera.width and size != (camera.width, camera.height):
            stated = f"{camera.width} x {camera.height}"
            out.append((camera.name, f"is {size[0]} x {size[1]} pixels, and its camera {stated}"))
            continue
        kept.append(camera.sized(*size))
    if not kept:
        first = f" {out[0][0]}: {out[0][1]}" if out else ""
        raise InputError(f"{images}: none of {len(out)} images can be used;{first}; see --images and --origin")
    told["images left out, see images.csv"] += len(out)
    return kept, out
