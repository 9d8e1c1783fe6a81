"""`citystitch texture`: textures of oriented images on the walls and roofs of a city model, tile by tile."""

import json
import math
import pickle
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from pipeline.data.errors import ConfigError
from tiler.convert.convert import refuse_output
from tiler.convert.features import origin_of
from tiler.convert.inputs import open_source
from tiler.executors.in_order import map_in_order
from tiler.export.export import EXPORT_RECORD
from tiler.georeference.crs import crs_text
from tiler.mesh_files.threads import check_workers
from tiler.store.atomic import replacing_folder
from tiler.textures.camera_files import read_cameras, usable_cameras
from tiler.textures.cameras import Array, Camera
from tiler.textures.images import pillow, read_pixels
from tiler.textures.paint import paint_surfaces
from tiler.textures.quality import BUILDINGS, SURFACES, TileQuality, judge, write_table
from tiler.textures.surfaces import Bins, sort_city
from tiler.textures.textured_glb import textured_glb
from tiler.textures.vegetation import Classifier, find_plants, read_classifier
from tiler.textures.views import Plants, plants_file, rank_images

RECORD = "textures.json"
LEAST_TILE = 10.0  # m


@dataclass(frozen=True)
class TextureAsked:
    """What is asked of textures, as the command line has it."""

    cameras: Path
    images: Path
    origin: str = ""
    geoid_height: float = 0.0
    vegetation: Path | None = None
    texel: float = 0.1
    least_resolution: float = 2.0
    tile_size: float = 250.0
    workers: int = 0
    overwrite: bool = False


@dataclass(frozen=True)
class _Job:
    """What all tiles have in common."""

    bins: Bins
    cameras: list[Camera]
    images: Path
    texel: float
    least: float
    origin: Array
    crs: str | None
    classifier: Classifier | None
    out: Path


def texture_models(inputs: Sequence[Path], output: Path, asked: TextureAsked) -> list[str]:
    """Write a textured GLB a tile, and tables of quality, into a folder; gives what must be known, a line each.

    Parameters
    ----------
    inputs : sequence of Path
        As of `tiler.convert.convert.convert_models`; the ground of a run hides, too.
    output : Path
        The folder; it appears whole or not at all.

    Raises
    ------
    ConfigError
        If an option is wrong, or the folder exists and is none of this command.
    InputError
        If an input, the cameras or an image cannot be read, or no image can be used.
    OutputError
        If the folder cannot be written.

    Notes
    -----
    Memory of a process: the surfaces and texels of a tile, the distances of one image, and one image.
    """
    _check(inputs, output, asked)
    origin = _origin(asked.origin)
    classifier = read_classifier(asked.vegetation) if asked.vegetation is not None else None
    runs = [path for path in inputs if path.is_dir()]
    told: Counter[str] = Counter()
    with open_source(inputs) as source, replacing_folder(output) as folder, TemporaryDirectory() as waiting:
        if source.in_degrees:
            raise ConfigError(
                "coordinates of the city are degrees, and textures need metres; convert it with --crs"
            )
        cameras = read_cameras(asked.cameras, origin, source.crs, asked.geoid_height, told)
        kept, left = usable_cameras(cameras, asked.images, source.low, source.high, told)
        work = Path(waiting)
        bins = sort_city(source, runs[0] if runs else None, work, asked.tile_size)
        told.update(source.told)
        (folder / "tiles").mkdir()
        job = _Job(
            bins, kept, asked.images, asked.texel, asked.least_resolution, origin_of(source),
            crs_text(source.crs) if source.crs is not None else None, classifier, folder / "tiles",
        )  # fmt: skip
        (work / "job").write_bytes(pickle.dumps(job))
        if classifier is not None:
            (work / "plants").mkdir()
            list(map_in_order(partial(_mask_image, work), range(len(kept)), asked.workers))
        found = list(map_in_order(partial(_texture_tile, work), bins.tiles, asked.workers))
        record = _write_tables(folder, found, left)
        (folder / RECORD).write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
        (folder / EXPORT_RECORD).write_text(json.dumps({"format": "textures", "tiles": len(found)}) + "\n")
    ground = [] if runs else ["no run, so no ground: buildings alone hide"]
    return [*source.notes, *ground, *(f"{n} {what}" for what, n in told.items() if n), *_lines(record)]


def _check(inputs: Sequence[Path], output: Path, asked: TextureAsked) -> None:
    pillow()
    check_workers(asked.workers)
    refuse_output(output, inputs, overwrite=asked.overwrite)
    if output.exists() and not (output / RECORD).is_file():
        raise ConfigError(f"{output}: is no folder of textures, which would be replaced; give another --output")
    for name, value, low in (
        ("texel", asked.texel, 0.005), ("tile-size", asked.tile_size, LEAST_TILE),
        ("least-resolution", asked.least_resolution, 0.0),
    ):  # fmt: skip
        if not (math.isfinite(value) and value >= low):
            raise ConfigError(f"--{name} {value:g}: bound: at least {low:g}; give another")
    if not asked.images.is_dir():
        raise ConfigError(f"--images {asked.images}: is no folder; give that of the images")


def _origin(text: str) -> Array | None:
    if not text:
        return None
    try:
        found = np.array([float(word) for word in text.split(",")])
    except ValueError:
        found = np.empty(0)
    if found.shape != (3,) or not np.isfinite(found).all():
        raise ConfigError(f"--origin {text}: is not X,Y,Z: three numbers with commas between them")
    return found


def _load(work: Path) -> _Job:
    job: _Job = pickle.loads((work / "job").read_bytes())
    return job


def _mask_image(work: Path, number: int) -> None:
    """Find the plants of an image; they wait in a file."""
    job = _load(work)
    if job.classifier is not None:
        name = job.cameras[number].name
        np.save(plants_file(work, name), find_plants(job.classifier, read_pixels(job.images / name)))


def _texture_tile(work: Path, code: int) -> TileQuality:
    """Write the file of a tile."""
    job = _load(work)
    tile, name, classifier = job.bins.tile(code), job.bins.name(code), job.classifier

    def plants_of(camera: Camera) -> Plants:
        if classifier is None:
            return Plants()
        return Plants(np.load(plants_file(work, camera.name)), float(classifier.patch))

    ranking = rank_images(tile.surfaces, job.cameras, job.bins, plants_of, job.least)
    painted = paint_surfaces(
        tile.surfaces, job.cameras, ranking, job.bins, job.images, plants_of, texel=job.texel, least=job.least
    )
    quality = judge(name, tile, painted, ranking, job.cameras)
    extras = [
        {**own, **{f"texture_{key}": row[key] for key in ("visible", "pixels_per_metre", "images")}}
        for own, row in zip(tile.attributes, quality.buildings, strict=True)
    ]
    (job.out / f"{name}.glb").write_bytes(textured_glb(tile, painted, extras, job.origin, job.crs))
    return quality


def _write_tables(folder: Path, found: list[TileQuality], left: list[tuple[str, str]]) -> dict[str, object]:
    rows = [row for one in found for row in one.buildings]
    write_table(folder / "buildings.csv", BUILDINGS, rows)
    write_table(folder / "surfaces.csv", SURFACES, (row for one in found for row in one.surfaces))
    write_table(folder / "images.csv", ("image", "reason"), ({"image": a, "reason": b} for a, b in left))
    area = sum(row["area"] for row in rows)
    seen = sum(row["area"] * row["visible"] for row in rows)
    scale = sum(row["area"] * row["visible"] * row["pixels_per_metre"] for row in rows)
    return {
        "tiles": len(found),
        "buildings": len(rows),
        "surfaces": sum(row["surfaces"] for row in rows),
        "textured": sum(row["textured"] for row in rows),
        "area": round(area, 1),
        "visible": round(seen / area, 4) if area else 0.0,
        "pixels_per_metre": round(scale / seen, 2) if seen else 0.0,
        "images_left_out": len(left),
    }


def _lines(record: dict[str, object]) -> list[str]:
    return [
        f"{record['buildings']} buildings in {record['tiles']} tiles; {record['textured']} of "
        f"{record['surfaces']} walls and roofs have textures",
        f"images show {100 * float(str(record['visible'])):.1f} % of their {record['area']} m², with "
        f"{record['pixels_per_metre']} pixels a metre; the rest is in surfaces.csv",
    ]
