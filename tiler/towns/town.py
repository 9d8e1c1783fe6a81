"""Write a town: parameters of its houses, their city model, footprints, and the points of a flight."""

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from itertools import islice, product
from pathlib import Path
from shutil import copyfileobj, rmtree
from typing import IO

import numpy as np
import pyproj
import shapely

from pipeline.architecture.faults import list_faults
from pipeline.architecture.levels import LEVELS
from pipeline.architecture.parameters import House
from pipeline.architecture.representations import list_representations
from pipeline.data.errors import ConfigError, OutputError
from pipeline.points_terrain.synthetic import ORIGIN
from tiler.executors.in_order import map_in_order
from tiler.formats.gpkg import Column, fixed_time, write_rows
from tiler.mesh_files.threads import check_workers
from tiler.towns.parameter_files import XML_END, XML_HEAD
from tiler.towns.rule_files import read_rules
from tiler.towns.styles import Box, Town, make_town
from tiler.towns.synthetic_files import DAY
from tiler.towns.town_models import fault_feature, model_head
from tiler.towns.town_scan import check_flight
from tiler.towns.town_tile import (
    CRS,
    GIVEN,
    Batch,
    ModelOptions,
    Output,
    Pieces,
    TownTile,
    house_outline,
    scan_given,
    sort_houses,
    write_batch,
    write_tile,
)

TILE = 500.0  # m, of files of points, and of houses that are in memory at a time
MOST_SIZE, MOST_DENSITY = 1e6, 1000.0  # m, points/m2
CLASS_ERRORS = 0.01
BATCH = 500  # houses of other origins that are in memory at a time
BORDER = 20.0  # m, scanned around them
MOST_NOISE = 10.0  # m


@dataclass(frozen=True)
class TownFiles:
    """What `write_town` wrote: LAZ files, footprints, city model, parameters, truth; houses."""

    clouds: list[Path]
    footprints: Path
    models: Path
    parameters: Path
    truth: Path
    houses: int


def open_town(
    size: float,
    style: str,
    *,
    rules: Path | None,
    seed: int,
    relief: float,
    trees: float = 0.0,
    water: float = 0.0,
) -> Town:
    """Make a town on a square whose lower left corner is that of all synthetic cities.

    Parameters
    ----------
    size : float
        Side of the square (m).
    style : str
        One of `tiler.towns.styles.STYLES`.
    rules : Path, optional
        File with other rules than those of the style.
    seed, relief, trees, water
        As of `Town`.

    Raises
    ------
    ConfigError
        If a parameter or a rule is not known or out of range.
    """
    if not 0 < size < MOST_SIZE:
        raise ConfigError(f"--size {size:g}: expected more than 0 m, and less than {MOST_SIZE:g} m")
    bounds = (ORIGIN[0], ORIGIN[1], ORIGIN[0] + size, ORIGIN[1] + size)
    given = {} if rules is None else read_rules(rules)
    try:
        return make_town(bounds, style, given, seed=seed, relief=relief, trees=trees, water=water)
    except ValueError as error:
        raise ConfigError(f"{'synth' if rules is None else rules}: {error}") from error


def write_town(
    directory: Path,
    town: Town,
    output: Output,
    *,
    density: float,
    lidar: float = 0.0,
    class_errors: float = CLASS_ERRORS,
    workers: int = 0,
) -> TownFiles:
    """Write a town: the same parameters give the same bytes, whatever the workers.

    Parameters
    ----------
    directory : Path
        Folder to write to; made if it is missing.
    output : Output
        Files of houses, of `make_output`; with truth where it is scanned.
    density : float
        Points per square metre, seen from right above; with 0 there are no files of points.
    lidar : float
        Pulses per square metre of each strip of a scanner, instead of `density`; see `scan_strips`.
    class_errors : float
        Share of the scanner's points that have a wrong class.
    workers : int
        Processes that make tiles; 0 for this one.

    Raises
    ------
    ConfigError
        If the folder has files of points that are not of this town.
    OutputError
        If a file cannot be written.

    Notes
    -----
    Tiles are drawn once, each for all of its files: memory does not grow with the town.
    """
    check_scan(density, lidar, class_errors, workers)
    if lidar > 0:
        check_flight(town)
    tile = TownTile(directory, town, town.bounds, (0, 0), density, lidar, class_errors, output)
    tiles = [replace(tile, box=box, numbers=numbers) for box, numbers in list_tiles(town.bounds)]
    clouds = [one.cloud for one in tiles] if density or lidar else []
    with _open_town(directory, output, CRS, clouds=clouds) as files:
        for pieces in map_in_order(write_tile, tiles, workers):
            files.append(pieces)
    return _list_files(directory, clouds, files.houses)


def write_houses(
    directory: Path,
    houses: Callable[[], Iterable[House]],
    output: Output,
    *,
    town: Town,
    lidar: float = 0.0,
    class_errors: float = CLASS_ERRORS,
    crs: str = CRS,
    workers: int = 0,
) -> TownFiles:
    """Write houses of any origin, and points of a scanner if asked for; a few of them are in memory.

    Parameters
    ----------
    houses : callable
        Gives them, each time the same ones.
    town : Town
        The ground that is scanned, and its seed.
    crs : str
        Of the houses, metric.
    directory, output, lidar, class_errors, workers
        As of `write_town`.

    Raises
    ------
    ConfigError, OutputError
        As of `write_town`.
    """
    check_scan(0.0, lidar, class_errors, workers)
    tiles: list[TownTile] = []
    with ExitStack() as stack:
        if lidar:
            stack.callback(rmtree, directory / GIVEN, ignore_errors=True)
            town = _sort_given(directory / GIVEN, houses(), town)
            check_flight(town)
            tile = TownTile(directory, town, town.bounds, (0, 0), 0.0, lidar, class_errors, output, crs)
            tiles = [replace(tile, box=box, numbers=numbers) for box, numbers in list_tiles(town.bounds)]
        clouds = [one.cloud for one in tiles]
        files = stack.enter_context(_open_town(directory, output, crs, clouds=clouds))
        batches = (Batch(directory, number, batch, output) for number, batch in enumerate(_batches(houses())))
        for pieces in map_in_order(write_batch, batches, workers):
            files.append(pieces)
        for _ in map_in_order(scan_given, tiles, workers):
            pass
    return _list_files(directory, clouds, files.houses)


def _batches(houses: Iterable[House]) -> Iterator[list[House]]:
    rest = iter(houses)
    while batch := list(islice(rest, BATCH)):
        yield batch


def _sort_given(folder: Path, houses: Iterable[House], town: Town) -> Town:
    """Sort houses into files of tiles, and give the town that they make on the ground of another one."""
    low, high, top = np.full(2, np.inf), np.full(2, -np.inf), 0.0
    with _output_errors(folder.parent):
        rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
    for batch in _batches(houses):
        with _output_errors(folder.parent):
            sort_houses(folder, batch, TILE)
        corners = [corner for house in batch for ring in house_outline(house)[1] for corner in ring]
        low, high = np.minimum(low, np.min(corners, axis=0)), np.maximum(high, np.max(corners, axis=0))
        top = max(top, *(one.z + one.height + one.roof.rise for one in batch))
    if not np.isfinite(low).all():
        raise ConfigError("--lidar: there are no houses; give parameters or footprints of some")
    west, south = (np.floor(low) - BORDER).tolist()
    east, north = (np.ceil(high) + BORDER).tolist()
    return replace(town, bounds=(west, south, east, north), highest=top)


def check_scan(density: float, lidar: float, class_errors: float, workers: int) -> None:
    """Raise ConfigError for an option of points that is out of range."""
    for name, value in (("density", density), ("lidar", lidar)):
        if not 0 <= value <= MOST_DENSITY:
            raise ConfigError(f"--{name} {value:g}: expected 0 to {MOST_DENSITY:g} points per m2")
    if not 0 <= class_errors <= 1:
        raise ConfigError(f"--class-errors {class_errors:g}: expected 0 to 1")
    check_workers(workers)


def make_output(
    models: ModelOptions, variants: Sequence[str] = (), degrade: float = 0.0, *, truth: bool = False, seed: int = 1
) -> Output:
    """Choose the files of houses.

    `variants` are names of representations, each of which is written to a file of its own, ``"all"`` for all: see
    `list_representations`. All else is as of `Output`.

    Raises
    ------
    ConfigError
        If there is no such level or representation, or the noise is out of range.
    """
    if unknown := [level for level in models.levels if level not in LEVELS]:
        raise ConfigError(f"--levels {unknown[0]}: expected some of {', '.join(LEVELS)}")
    known = {one.name: one for one in list_representations()}
    names = list(known) if "all" in variants else list(dict.fromkeys(variants))
    if unknown := [name for name in names if name not in known]:
        raise ConfigError(f"--variants {unknown[0]}: no such representation; docs/town-variants.md lists them")
    if not 0 <= degrade <= MOST_NOISE:
        raise ConfigError(f"--degrade {degrade:g}: expected 0 to {MOST_NOISE:g} m")
    return Output(models, tuple(known[name] for name in names), degrade, truth, seed)


@dataclass(eq=False)
class _OpenTown:
    """Files of a town that is being written, by their kinds, and what is in them."""

    opened: Mapping[str, IO[bytes]]
    footprints: Path
    crs: str
    houses: int = 0

    def append(self, pieces: Pieces) -> None:
        """Append pieces to the files, and remove them."""
        for kind, file in self.opened.items():
            with (pieces.folder / kind).open("rb") as piece:
                copyfileobj(piece, file)
        with (pieces.folder / "outline").open() as lines:
            self.append_footprints([json.loads(line) for line in lines])
        rmtree(pieces.folder)
        self.houses += pieces.houses

    def append_footprints(self, rows: Sequence[tuple[str, float, list[list[list[float]]]]]) -> None:
        """Append outlines with id and height; a file without any is written, too."""
        there = self.footprints.exists()
        if not rows and there:
            return
        polygons = np.array([shapely.Polygon(border, holes) for *_, (border, *holes) in rows], object)
        columns: dict[str, Column] = {
            "id": (np.array([name for name, *_ in rows], object), None),
            "height": (np.array([height for _, height, _ in rows], np.float64), None),
        }
        with fixed_time(DAY):
            wkb = shapely.to_wkb(polygons)
            write_rows(self.footprints, wkb, columns, layer="footprints", crs=self.crs, append=there)


@contextmanager
def _open_town(directory: Path, output: Output, crs: str, *, clouds: Sequence[Path]) -> Iterator[_OpenTown]:
    """Open the files of a town with their heads, and close them with their ends."""
    with _output_errors(directory):
        (directory / "tiles").mkdir(parents=True, exist_ok=True)
        strangers = set((directory / "tiles").iterdir()) - set(clouds)
        if strangers:
            raise ConfigError(f"{min(strangers)}: is not of this town; give an empty folder or remove it")
        footprints = directory / "footprints.gpkg"
        footprints.unlink(missing_ok=True)
        if output.variants:
            (directory / "variants").mkdir(exist_ok=True)
        head = model_head(pyproj.CRS(crs)).encode()
        with ExitStack() as stack:
            paths = output.paths(directory)
            opened = {kind: stack.enter_context(path.open("wb")) for kind, path in paths.items()}
            for kind, path in paths.items():
                if path.name.endswith(".city.jsonl"):
                    opened[kind].write(head)
            opened["xml"].write(XML_HEAD.encode())
            yield _OpenTown(opened, footprints, crs)
            opened["xml"].write(XML_END.encode())


@contextmanager
def _output_errors(directory: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise OutputError(f"{directory}: cannot be written ({error}); give a folder that can") from error


def _list_files(directory: Path, clouds: list[Path], houses: int) -> TownFiles:
    return TownFiles(
        clouds,
        directory / "footprints.gpkg",
        directory / "town.city.jsonl",
        directory / "parameters.jsonl",
        directory / "truth.jsonl",
        houses,
    )


def write_faults(path: Path) -> None:
    """Write broken solids, a building each, as CityJSONSeq."""
    with path.open("w", encoding="ascii", newline="\n") as file:
        file.write(model_head(pyproj.CRS(CRS)))
        for number, fault in enumerate(list_faults()):
            file.write(fault_feature(fault, (ORIGIN[0] + 60.0 * number, ORIGIN[1], 10.0)))


def list_tiles(bounds: Box) -> Iterator[tuple[Box, tuple[int, int]]]:
    """List the tiles of a town, on whole multiples of their size: box and numbers."""
    west, south, east, north = bounds
    columns = range(int(np.floor(west / TILE)), int(np.ceil(east / TILE)))
    rows = range(int(np.floor(south / TILE)), int(np.ceil(north / TILE)))
    for i, j in product(columns, rows):
        box = max(west, i * TILE), max(south, j * TILE), min(east, (i + 1) * TILE), min(north, (j + 1) * TILE)
        yield box, (i, j)
