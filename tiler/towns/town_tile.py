"""A tile of a town, or a batch of given houses: points, and pieces of the files of the town."""

import json
import math
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from pipeline.architecture.levels import Footprint, outline_rings
from pipeline.architecture.parameters import House
from pipeline.architecture.plants import Tree
from pipeline.architecture.representations import Representation
from pipeline.architecture.surfaces import ROOF, level_face, to_town
from pipeline.architecture.twins import degrade_house
from tiler.towns.parameter_files import house_json, house_xml, read_json
from tiler.towns.styles import Box, Town
from tiler.towns.synthetic_files import write_laz, write_laz_parts
from tiler.towns.town_cloud import scan_town
from tiler.towns.town_models import house_feature, lot_feature, tree_feature, variant_feature
from tiler.towns.town_scan import describe_truth, reach_of, scan_strips

CRS = "EPSG:3006"
GIVEN = "part-given"  # folder of given houses by tile, until they are scanned


class ModelOptions(NamedTuple):
    """Which geometry the city model has: see `pipeline.architecture.levels.make_level`."""

    levels: Sequence[str] = ("1.2", "2.2")
    footprint: Footprint = "walls"
    top: str = "half"
    solid: bool = True


class Output(NamedTuple):
    """Which files of houses are written."""

    models: ModelOptions = ModelOptions()  # of the city model
    variants: tuple[Representation, ...] = ()  # each of which has a file of its own
    degrade: float = 0.0  # standard deviation of the noise of degraded twins (m); 0 for none
    truth: bool = False  # whether the truth is written
    seed: int = 1  # what noise is drawn from

    def paths(self, directory: Path) -> dict[str, Path]:
        """Give the files by their kinds, as of `house_lines`."""
        found = {
            "json": directory / "parameters.jsonl",
            "xml": directory / "parameters.xml",
            "model": directory / "town.city.jsonl",
        }
        if self.degrade:
            found |= {"twin": directory / "twins.jsonl", "twin-model": directory / "twins.city.jsonl"}
        if self.truth:
            found["truth"] = directory / "truth.jsonl"
        return found | {one.name: directory / "variants" / f"{one.name}.city.jsonl" for one in self.variants}

    def house_lines(self, house: House) -> dict[str, str]:
        """Give what each file has of a house."""
        models = self.models._asdict()
        lines = {"json": house_json(house), "xml": house_xml(house), "model": house_feature(house, **models)}
        if self.degrade:
            twin = degrade_house(house, self.degrade, seed=self.seed)
            lines |= {"twin": house_json(twin), "twin-model": house_feature(twin, **models)}
        if self.truth:
            lines["truth"] = json.dumps(describe_truth(house)) + "\n"
        return lines | {one.name: variant_feature(house, one) for one in self.variants}


@dataclass(frozen=True, eq=False)
class TownTile:
    """A tile of a town: what `write_tile` makes its files of."""

    directory: Path  # folder of the town
    # As of `write_town`.
    town: Town
    box: Box  # of the tile (m)
    numbers: tuple[int, int]  # of the tile
    density: float
    lidar: float
    class_errors: float
    output: Output
    crs: str = CRS  # of its points

    @property
    def cloud(self) -> Path:
        """Its file of points."""
        return self.directory / "tiles" / f"{self.box[0]:.0f}_{self.box[1]:.0f}.laz"

    @property
    def around(self) -> Box:
        """What its points may be seen at, and all that may hide them (m)."""
        if not (self.density or self.lidar):
            return self.box
        far = self.town.reach + (reach_of(self.town) if self.lidar else 0.0)
        return self.box[0] - far, self.box[1] - far, self.box[2] + far, self.box[3] + far


@dataclass(frozen=True, eq=False)
class Pieces:
    """Pieces of the files of a town, until they are in them: a folder, and houses in it."""

    folder: Path
    houses: int


@dataclass(frozen=True, eq=False)
class Batch:
    """Houses of other origins that are made together: number, parameters, and files that they go to."""

    directory: Path
    number: int
    houses: Sequence[House]
    output: Output


def write_batch(batch: Batch) -> Pieces:
    """Write the pieces of a batch."""
    folder = batch.directory / f"part-{batch.number}"
    return _write_pieces(folder, batch.houses, batch.output)


def _write_pieces(folder: Path, houses: Sequence[House], output: Output) -> Pieces:
    folder.mkdir(exist_ok=True)
    with ExitStack() as stack:
        files = {
            kind: stack.enter_context((folder / kind).open("w", encoding="utf-8", newline="\n"))
            for kind in ("outline", *output.paths(folder))
        }
        for house in houses:
            files["outline"].write(json.dumps([house.id, *house_outline(house)]) + "\n")
            for kind, line in output.house_lines(house).items():
                files[kind].write(line)
    return Pieces(folder, len(houses))


def write_tile(tile: TownTile) -> Pieces:
    """Write the points of a tile and its pieces of the other files."""
    town, box = tile.town, tile.box
    own, near = [], []
    for lot in town.lots(tile.around):
        if (house := town.draw(lot)) is not None:
            near.append(house)
            if box[0] <= lot.x < box[2] and box[1] <= lot.y < box[3]:
                own.append(house)
    pieces = _write_pieces(tile.directory / f"part-{tile.numbers[0]}-{tile.numbers[1]}", own, tile.output)
    with (pieces.folder / "model").open("a", encoding="utf-8", newline="\n") as file:
        file.writelines(map(tree_feature, town.plants(box)))
        file.writelines(lot_feature(lot, town.ground) for lot in town.open_lots(box))
    _write_points(tile, near, list(town.plants(tile.around)))
    return pieces


def _write_points(tile: TownTile, houses: Sequence[House], trees: Sequence[Tree]) -> None:
    town, box = tile.town, tile.box
    if tile.lidar:
        scan = scan_strips(town, box, houses, trees, density=tile.lidar, errors=tile.class_errors)
        write_laz_parts(tile.cloud, scan, box, tile.crs)
    elif tile.density:
        write_laz(tile.cloud, scan_town(town, box, houses, tile.numbers, density=tile.density), box, tile.crs)


def sort_houses(folder: Path, houses: Iterable[House], side: float) -> None:
    """Add houses to the files of tiles that they stand in, by the corner of their front."""
    lines: dict[str, list[str]] = {}
    for house in houses:
        lines.setdefault(f"{int(house.x // side)}_{int(house.y // side)}", []).append(house_json(house))
    for name, own in lines.items():
        with (folder / name).open("a", encoding="utf-8") as file:
            file.writelines(own)


def scan_given(tile: TownTile) -> None:
    """Write the points of a tile of houses that `sort_houses` has put into files."""
    folder, (i, j) = tile.directory / GIVEN, tile.numbers
    files = [folder / f"{i + east}_{j + north}" for east in (-1, 0, 1) for north in (-1, 0, 1)]
    houses = [house for path in files if path.exists() for house in read_json(path)]
    _write_points(tile, [house for house in houses if _is_near(house, tile.around)], [])


def _is_near(house: House, box: Box) -> bool:
    far = math.hypot(house.length, house.width) + house.roof.overhang
    far += max((part.depth for part in house.parts), default=0.0)
    return box[0] - far <= house.x < box[2] + far and box[1] - far <= house.y < box[3] + far


def house_outline(house: House) -> tuple[float, list[list[list[float]]]]:
    """Height from the ground to the ridge, and rings of the outline with parts (m): border, then courtyards."""
    (placed,) = to_town(house, [level_face(ROOF, outline_rings(house), 0.0)])
    rings = [[list(corner[:2]) for corner in ring] for ring in (placed.border, *placed.holes)]
    return round(house.height + house.roof.rise, 3), rings
