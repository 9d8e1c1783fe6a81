"""`citystitch convert`: city models, or the model of a run, as another format."""

import math
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

from pipeline.data.errors import ConfigError
from tiler.cityinput.levels import CHOICES
from tiler.convert.citygml_files import write_citygml
from tiler.convert.cityjson_files import write_document, write_sequence
from tiler.convert.glb_files import write_glb
from tiler.convert.gpkg_files import write_gpkg
from tiler.convert.inputs import ModelSource, open_source
from tiler.convert.obj_files import write_obj
from tiler.convert.tiles import split_source
from tiler.georeference.crs import crs_name
from tiler.store.atomic import replacing, replacing_folder

LEAST_TILE = 10.0  # m
TILE = re.compile(r"-?\d+_-?\d+")  # names of files of tiles


@dataclass(frozen=True)
class Target:
    """A format that city models are converted to."""

    suffixes: tuple[str, ...]  # what the name of a file may end with
    # Writes a source to a path, at a level of detail where `one_level`.
    write: Callable[[Path, ModelSource, str], None]
    one_level: bool = False  # whether it holds each building at one level: it is a surface in metres
    around: bool = False  # whether it holds storeys, roads, plant cover and trees


TARGETS: Mapping[str, Target] = {
    "cityjson": Target((".json",), lambda path, source, _: write_document(path, source), around=True),
    "cityjsonseq": Target((".jsonl",), lambda path, source, _: write_sequence(path, source), around=True),
    "citygml2": Target((".gml", ".xml"), lambda path, source, _: write_citygml(path, source, "2.0"), around=True),
    "citygml3": Target((".gml", ".xml"), lambda path, source, _: write_citygml(path, source, "3.0"), around=True),
    "gpkg": Target((".gpkg",), lambda path, source, _: write_gpkg(path, source)),
    "obj": Target((".obj",), write_obj, one_level=True),
    "glb": Target((".glb",), write_glb, one_level=True),
}


@dataclass(frozen=True)
class Asked:
    """What is asked of a conversion, as the command line has it."""

    name: str
    lod: str = "auto"
    crs: str = ""
    axis_order: str = ""
    tile_size: float = 0.0
    overwrite: bool = False


def convert_models(inputs: Sequence[Path], output: Path, asked: Asked) -> list[str]:
    """Write city models as another format, and give what must be known of the file, a line each.

    Parameters
    ----------
    inputs : sequence of Path
        CityJSON, CityJSONSeq, CityGML or GeoPackage files, or the folder of a run.
    output : Path
        The file, or with a size of tiles the folder of their files ``i_j``; it appears whole or not at all.

    Raises
    ------
    ConfigError
        If the file exists, is an input or has another suffix; if an option does not go with the format.
    InputError
        If an input cannot be read.
    OutputError
        If the file cannot be written.

    Notes
    -----
    Buildings are read and written one at a time, as often as a format needs; but for CityJSON documents, which are
    read as a whole. Tiles wait as sequences in a temporary folder. Heights are never changed.
    """
    for name, value, known in (
        ("format", asked.name, tuple(TARGETS)),
        ("lod", asked.lod, CHOICES),
        ("axis order", asked.axis_order, ("", "xy", "yx")),
    ):
        if value not in known:
            raise ConfigError(f"{name} {value!r}: must be one of {', '.join(filter(None, known))}")
    target = TARGETS[asked.name]
    if not (math.isfinite(asked.tile_size) and (asked.tile_size == 0 or asked.tile_size >= LEAST_TILE)):
        raise ConfigError(f"tile size {asked.tile_size:g} m: at least {LEAST_TILE:g} m, or 0 for one file")
    if not asked.tile_size and output.suffix not in target.suffixes:
        raise ConfigError(
            f"{output}: a file of format {asked.name} ends with {' or '.join(target.suffixes)}; rename --output"
        )
    if asked.lod != "auto" and not target.one_level:
        raise ConfigError(f"--lod {asked.lod}: format {asked.name} has all levels side by side; leave --lod out")
    refuse_output(output, inputs, overwrite=asked.overwrite)
    if asked.tile_size and output.exists() and not _holds_tiles(output):
        raise ConfigError(f"{output}: is no folder of tiles, which would be replaced; give another --output")
    with open_source(inputs, crs=asked.crs, axis_order=asked.axis_order, around=target.around) as source:
        if target.one_level and source.in_degrees:
            name = crs_name(source.crs) if source.crs is not None else ""
            raise ConfigError(f"{name} is in degrees, and format {asked.name} in metres; give --crs EPSG:NNNN")
        told: Counter[str] = Counter()
        if asked.tile_size:
            with replacing_folder(output) as folder:
                told["files, a tile each"] = _write_tiles(folder, source, asked, told)
        else:
            with replacing(output) as part:
                target.write(part, source, asked.lod)
            told = source.told
        return [*source.notes, *(f"{number} {what}" for what, number in told.items() if number)]


def refuse_output(output: Path, inputs: Sequence[Path], *, overwrite: bool) -> None:
    """Raise a `ConfigError` for an output that is an input, or exists where it may not be replaced."""
    if output.resolve() in {path.resolve() for path in inputs}:
        raise ConfigError(f"{output}: is one of the inputs; give another --output")
    if output.exists() and not overwrite:
        raise ConfigError(f"{output}: exists; give another --output, or --overwrite")


def _holds_tiles(folder: Path) -> bool:
    return folder.is_dir() and all(TILE.fullmatch(path.stem) for path in folder.iterdir())


def _write_tiles(folder: Path, source: ModelSource, asked: Asked, told: Counter[str]) -> int:
    """Write a file for each tile, and count what is told of all; gives the number of files."""
    target = TARGETS[asked.name]
    if source.in_degrees:
        raise ConfigError(f"tiles of {asked.tile_size:g} m of a model in degrees; give --crs EPSG:NNNN")
    with TemporaryDirectory() as waiting:
        tiles = split_source(source, asked.tile_size, Path(waiting))
        told.update(source.told)
        for path in tiles:
            with open_source([path], axis_order="xy", around=target.around) as own:
                tile = replace(own, crs=source.crs)  # its name in the sequence may not tell it
                target.write(folder / f"{path.stem}{target.suffixes[0]}", tile, asked.lod)
                told.update(tile.told)
            path.unlink()
    return len(tiles)
