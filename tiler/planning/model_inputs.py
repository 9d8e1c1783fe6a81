"""City models and rasters of terrain in a plan: their headers, and the region that they make."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from pipeline.data.errors import InputError
from pipeline.data.notes import Note
from tiler.cityinput.rasters import list_raster_files, read_raster_header
from tiler.cityinput.sources import CLOUD, MODEL, TERRAIN, kind_of, read_model_header
from tiler.config.config import Config
from tiler.georeference.crs import box_around
from tiler.georeference.frame import Frame
from tiler.objects.places import identify, is_url
from tiler.pointclouds.clouds import CloudHeader, each_once, list_files

MARGIN = 20.0  # m around the buildings of a city model that are meshed, where there is no point cloud
SUFFIXES = {
    MODEL: (".json", ".jsonl", ".gml", ".xml", ".citygml", ".gpkg"),
    TERRAIN: (".tif", ".tiff", ".vrt"),
}
WORDS = {MODEL: "city model", TERRAIN: "raster of terrain"}
OPTIONS = {MODEL: "--buildings", TERRAIN: "--terrain"}


def read_other_headers(config: Config) -> tuple[list[CloudHeader], dict[str, str]]:
    """Read the headers of all city models and rasters, and say why others cannot be read, where these are skipped.

    Raises
    ------
    InputError
        If one is missing, of another kind, or cannot be read.
    """
    headers, unreadable = list[CloudHeader](), dict[str, str]()
    for kind, sources in ((MODEL, config.buildings), (TERRAIN, config.terrain)):
        read = partial(_read_other, kind, config.axis_order)
        found, others = read_headers(find_files(sources, kind), read, skip=config.skip_unreadable)
        headers += found
        unreadable |= others
    return headers, unreadable


def read_headers(
    paths: Iterable[Path], read: Callable[[Path], CloudHeader], *, skip: bool
) -> tuple[list[CloudHeader], dict[str, str]]:
    """Read the headers of files, and why some cannot be read; with `skip` these do not end it."""
    headers, unreadable = list[CloudHeader](), dict[str, str]()
    for path in paths:
        try:
            headers.append(read(path))
        except InputError as error:
            if not skip:
                raise
            unreadable[str(path)] = str(error)
    return headers, unreadable


def _read_other(kind: str, axis_order: str, path: Path) -> CloudHeader:
    if (found := kind_of(path)) != kind:
        raise InputError(f"{path}: is {_describe(found)}, no {WORDS[kind]}; {OPTIONS[kind]} takes these")
    return read_model_header(path, axis_order) if kind == MODEL else read_raster_header(path)


def _describe(kind: str) -> str:
    return {CLOUD: "neither JSON nor XML nor a raster", MODEL: "JSON or XML", TERRAIN: "a raster"}[kind]


def find_files(sources: Sequence[str], kind: str) -> list[Path]:
    """Find the files that files, globs and folders stand for, sorted, each once.

    InputError if one is missing, stands for no file, or is a URL.
    """
    found: list[Path] = []
    for source in sources:
        if is_url(source):
            raise InputError(f"{source}: a {WORDS[kind]} is read from a disk; copy it there")
        files = list_files(Path(source), SUFFIXES[kind])
        if not files:
            raise InputError(f"{source}: no {WORDS[kind]} is there; check the path")
        found += files
    return each_once(found)


def order_headers(headers: Sequence[CloudHeader]) -> list[CloudHeader]:
    """Put first what decides on the region's CRS: point clouds, then what has a projected one."""
    return sorted(
        headers, key=lambda header: (header.kind != CLOUD, header.crs is None or header.crs.is_geographic)
    )


def turn_frames(headers: Sequence[CloudHeader]) -> list[CloudHeader]:
    """Let frames take the coordinates of files in their own order, where the northing comes first in them."""
    return [replace(one, frame=_turn(one.frame)) if one.swapped else one for one in headers]


def _turn(frame: Frame) -> Frame:
    (east, one), (north, other) = frame.east, frame.north
    return replace(frame, east=(1 - east, one), north=(1 - north, other))


def headers_of_region(headers: Sequence[CloudHeader]) -> list[CloudHeader]:
    """Give the headers whose extent is that of the region: point clouds; without any, buildings on their terrain.

    Buildings are given `MARGIN` around them, within the extent of the rasters where there are some. Without both,
    it is that of the rasters.
    """
    known = [one for one in headers if one.n_points]
    kinds = {kind: [one for one in known if one.kind == kind] for kind in (CLOUD, MODEL, TERRAIN)}
    if kinds[CLOUD] or not kinds[MODEL]:
        return kinds[CLOUD] or kinds[TERRAIN]
    grown = [_grow(one) for one in kinds[MODEL]]
    if not kinds[TERRAIN]:
        return grown
    most = box_around(one.bounds for one in kinds[TERRAIN])
    cut = [_cut(one, most) for one in grown]
    kept = [one for one in cut if one.bounds[0] < one.bounds[2] and one.bounds[1] < one.bounds[3]]
    if not kept:
        box, other = grown[0].bounds, kinds[TERRAIN][0]
        raise InputError(
            f"{grown[0].path}: its buildings at ({box[0]:.1f}, {box[1]:.1f}) lie off all rasters of terrain, such "
            f"as {other.path} at ({other.bounds[0]:.1f}, {other.bounds[1]:.1f}); check their CRSs, or --axis-order"
        )
    return kept


def headers_of_tiles(headers: Sequence[CloudHeader]) -> list[CloudHeader]:
    """Give the headers below whose boxes there are tiles: those with ground; without any, those of buildings."""
    ground = [one for one in headers if one.kind != MODEL and one.n_points]
    return ground or [_grow(one) for one in headers if one.n_points]


def _grow(header: CloudHeader) -> CloudHeader:
    xmin, ymin, xmax, ymax, *heights = header.bounds
    grown = (xmin - MARGIN, ymin - MARGIN, xmax + MARGIN, ymax + MARGIN, heights[0], heights[1])
    return replace(header, bounds=grown)


def _cut(header: CloudHeader, most: Sequence[float]) -> CloudHeader:
    xmin, ymin, xmax, ymax, *heights = header.bounds
    box = (max(xmin, most[0]), max(ymin, most[1]), min(xmax, most[2]), min(ymax, most[3]))
    return replace(header, bounds=(*box, heights[0], heights[1]))


def describe_others(headers: Sequence[CloudHeader], config: Config) -> tuple[list[str], list[Note]]:
    """Tell what is taken of city models and rasters: messages, and notes for the record."""
    models = [one for one in headers if one.kind == MODEL]
    words, notes = [], []
    if models:
        n = sum(one.n_buildings for one in models)
        files = "1 city model" if len(models) == 1 else f"{len(models)} city models"
        words.append(f"{n} {'building' if n == 1 else 'buildings'} in {files}")
    if models and config.keeps_model_roofs:
        finer = f", {config.finer_clearance:g} m where roofs would be off" if config.finer_clearance else ""
        words.append(
            f"walls keep {config.clearance:g} m from each other (--clearance){finer}: more makes fewer cells, and "
            "moves walls of the model by up to as much"
        )
    for one in models:
        if one.axes:
            order = "the northing" if one.swapped else "the easting"
            text = f"{one.path.name}: {order} comes first, {one.axes}; --axis-order says otherwise"
            notes.append(Note("model-axes", one.path.name, detail=text))
            words.append(text)
    has_ground = config.pointcloud or config.terrain
    if models and not has_ground:
        text = "no ground is given: terrain is that of the model, else between the feet of its buildings"
        notes.append(Note("model-ground", models[0].path.name, detail=text))
        words.append(f"{text}; --terrain takes a raster")
    return words, notes


def identify_file(header: CloudHeader) -> str:
    """Change when a file does, or one of those that it names."""
    if header.kind != TERRAIN:
        return identify(header.path)
    return "; ".join(identify(path) for path in list_raster_files(header.path) if path.exists())
