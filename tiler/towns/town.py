"""Write a town: parameters of its houses, their city model, footprints, and the points of a flight."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyogrio
import pyproj
import shapely

from pipeline.architecture.levels import LEVELS, Footprint, outline_ring
from pipeline.architecture.parameters import House
from pipeline.architecture.surfaces import GROUND, Surface, to_town
from pipeline.data.errors import ConfigError, OutputError
from pipeline.points_terrain.synthetic import ORIGIN
from tiler.towns.parameter_files import write_json, write_xml
from tiler.towns.rule_files import read_rules
from tiler.towns.styles import Box, Town, make_town
from tiler.towns.synthetic_files import GPKG_TIME, write_laz
from tiler.towns.town_cloud import scan_town
from tiler.towns.town_models import write_models

CRS = "EPSG:3006"
TILE = 500.0  # m, of files of points, and of houses that are in memory at a time
MOST_SIZE, MOST_DENSITY = 1e6, 1000.0  # m, points/m2
REACH = 100.0  # m from the middle of a lot, beyond which nothing of its house is


@dataclass(frozen=True)
class TownFiles:
    """What `write_town` wrote: LAZ files, footprints, city model, parameters as JSON and XML; number of houses."""

    clouds: list[Path]
    footprints: Path
    models: Path
    parameters: Path
    parameters_xml: Path
    houses: int


class ModelOptions(NamedTuple):
    """Which geometry the city model has: see `pipeline.architecture.levels.make_level`."""

    levels: Sequence[str] = ("1.2", "2.2")
    footprint: Footprint = "walls"
    top: str = "half"
    solid: bool = True


def open_town(size: float, style: str, *, rules: Path | None, seed: int, relief: float) -> Town:
    """Make a town on a square whose lower left corner is that of all synthetic cities.

    Parameters
    ----------
    size : float
        Side of the square (m).
    style : str
        One of `tiler.towns.styles.STYLES`.
    rules : Path, optional
        File with other rules than those of the style.
    seed : int
        Not negative; the same seed gives the same town.
    relief : float
        Highest minus lowest ground, about (m).

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
        return make_town(bounds, style, given, seed=seed, relief=relief)
    except ValueError as error:
        raise ConfigError(f"{'synth' if rules is None else rules}: {error}") from error


def write_town(directory: Path, town: Town, *, density: float, models: ModelOptions) -> TownFiles:
    """Write a town: the same parameters give the same bytes.

    Parameters
    ----------
    directory : Path
        Folder to write to; made if it is missing.
    town : Town
        The town.
    density : float
        Points per square metre; with 0 there are no files of points.
    models : ModelOptions
        Levels and variants of the city model.

    Raises
    ------
    ConfigError
        If the folder has files of points that are not of this town, or there is no such level.
    OutputError
        If a file cannot be written.

    Notes
    -----
    Houses and points are made tile by tile: memory does not grow with the town.
    """
    if unknown := [level for level in models.levels if level not in LEVELS]:
        raise ConfigError(f"--levels {unknown[0]}: expected some of {', '.join(LEVELS)}")
    if not 0 <= density <= MOST_DENSITY:
        raise ConfigError(f"--density {density:g}: expected 0 to {MOST_DENSITY:g} points per m2")
    files = TownFiles(
        [_tile_path(directory, box) for box, _ in list_tiles(town.bounds)] if density > 0 else [],
        directory / "footprints.gpkg",
        directory / "town.city.jsonl",
        directory / "parameters.jsonl",
        directory / "parameters.xml",
        0,
    )
    try:
        (directory / "tiles").mkdir(parents=True, exist_ok=True)
        strangers = set((directory / "tiles").iterdir()) - set(files.clouds)
        if strangers:
            raise ConfigError(f"{min(strangers)}: is not of this town; give an empty folder or remove it")
        write_json(list_houses(town), files.parameters)
        write_xml(list_houses(town), files.parameters_xml)
        number = write_models(list_houses(town), files.models, crs=pyproj.CRS(CRS), **models._asdict())
        _write_footprints(town, files.footprints)
        for box, part in list_tiles(town.bounds) if density > 0 else ():
            around = box[0] - REACH, box[1] - REACH, box[2] + REACH, box[3] + REACH
            cloud = scan_town(town, box, list(town.houses(around)), part, density=density)
            write_laz(_tile_path(directory, box), cloud, box, CRS)
    except (OSError, pyogrio.errors.DataSourceError) as error:
        raise OutputError(f"{directory}: cannot be written ({error}); give a folder that can") from error
    return replace(files, houses=number)


def list_tiles(bounds: Box) -> Iterator[tuple[Box, tuple[int, int]]]:
    """List the tiles of a town, on whole multiples of their size: box and numbers."""
    west, south, east, north = bounds
    columns = range(int(np.floor(west / TILE)), int(np.ceil(east / TILE)))
    rows = range(int(np.floor(south / TILE)), int(np.ceil(north / TILE)))
    for i, j in product(columns, rows):
        box = max(west, i * TILE), max(south, j * TILE), min(east, (i + 1) * TILE), min(north, (j + 1) * TILE)
        yield box, (i, j)


def list_houses(town: Town) -> Iterator[House]:
    """Draw the houses of a town, tile by tile."""
    for box, _ in list_tiles(town.bounds):
        yield from town.houses(box)


def _tile_path(directory: Path, box: Box) -> Path:
    return directory / "tiles" / f"{box[0]:.0f}_{box[1]:.0f}.laz"


def _write_footprints(town: Town, path: Path) -> None:
    """Write outlines of houses with their parts, with id, and height from the ground to the ridge (m)."""
    path.unlink(missing_ok=True)
    pyogrio.set_gdal_config_options(GPKG_TIME)
    try:
        for box, _ in list_tiles(town.bounds):
            houses = list(town.houses(box))
            if not houses and path.exists():
                continue
            outlines = [
                to_town(house, [Surface(GROUND, [(x, y, 0.0) for x, y in outline_ring(house)], [])])[0].border
                for house in houses
            ]
            polygons = np.array([shapely.Polygon([corner[:2] for corner in ring]) for ring in outlines], object)
            fields = {
                "id": np.array([house.id for house in houses], object),
                "height": np.array([round(house.height + house.roof.rise, 3) for house in houses], np.float64),
            }
            pyogrio.raw.write(
                path,
                shapely.to_wkb(polygons),
                list(fields.values()),
                list(fields),
                geometry_type="Polygon",
                crs=CRS,
                layer="footprints",
                append=path.exists(),
            )
    finally:
        pyogrio.set_gdal_config_options(dict.fromkeys(GPKG_TIME))
