"""A tile of a town: its points, and its pieces of the files of the town."""

import json
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from pipeline.architecture.levels import Footprint, outline_rings
from pipeline.architecture.parameters import House
from pipeline.architecture.representations import Representation
from pipeline.architecture.surfaces import ROOF, level_face, to_town
from pipeline.architecture.twins import degrade_house
from tiler.towns.parameter_files import house_json, house_xml
from tiler.towns.styles import Box, Town
from tiler.towns.synthetic_files import write_laz, write_laz_parts
from tiler.towns.town_cloud import scan_town
from tiler.towns.town_models import house_feature, lot_feature, tree_feature, variant_feature
from tiler.towns.town_scan import describe_truth, reach_of, scan_strips

CRS = "EPSG:3006"


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

    @property
    def cloud(self) -> Path:
        """Its file of points."""
        return self.directory / "tiles" / f"{self.box[0]:.0f}_{self.box[1]:.0f}.laz"

    @property
    def folder(self) -> Path:
        """Folder of its pieces, until they are in the files of the town."""
        return self.directory / f"part-{self.numbers[0]}-{self.numbers[1]}"

    def piece(self, kind: str) -> Path:
        """Its piece of a file."""
        return self.folder / kind


def write_tile(tile: TownTile) -> int:
    """Write the points of a tile and its pieces of the other files; its number of houses."""
    town, box = tile.town, tile.box
    far = town.reach + (reach_of(town) if tile.lidar else 0.0)
    around = box if not (tile.density or tile.lidar) else (box[0] - far, box[1] - far, box[2] + far, box[3] + far)
    own, near = [], []
    for lot in town.lots(around):
        if (house := town.draw(lot)) is not None:
            near.append(house)
            if box[0] <= lot.x < box[2] and box[1] <= lot.y < box[3]:
                own.append(house)
    tile.folder.mkdir(exist_ok=True)
    with ExitStack() as stack:
        kinds = ("outline", *tile.output.paths(tile.directory))
        files = {
            kind: stack.enter_context(tile.piece(kind).open("w", encoding="utf-8", newline="\n")) for kind in kinds
        }
        for house in own:
            files["outline"].write(json.dumps([house.id, *house_outline(house)]) + "\n")
            for kind, line in tile.output.house_lines(house).items():
                files[kind].write(line)
        files["model"].writelines(map(tree_feature, town.plants(box)))
        files["model"].writelines(lot_feature(lot, town.ground) for lot in town.open_lots(box))
    if tile.lidar:
        trees = list(town.plants(around))
        scan = scan_strips(town, box, near, trees, density=tile.lidar, errors=tile.class_errors)
        write_laz_parts(tile.cloud, scan, box, CRS)
    elif tile.density:
        write_laz(tile.cloud, scan_town(town, box, near, tile.numbers, density=tile.density), box, CRS)
    return len(own)


def house_outline(house: House) -> tuple[float, list[list[list[float]]]]:
    """Height from the ground to the ridge, and rings of the outline with parts (m): border, then courtyards."""
    (placed,) = to_town(house, [level_face(ROOF, outline_rings(house), 0.0)])
    rings = [[list(corner[:2]) for corner in ring] for ring in (placed.border, *placed.holes)]
    return round(house.height + house.roof.rise, 3), rings
