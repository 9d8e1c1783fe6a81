"""What is asked of a generalisation, as the command line has it."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from pipeline.data.errors import ConfigError, InputError
from tiler.generalisation import HEIGHTS

LEAST_TILE = 100.0  # m


@dataclass(frozen=True)
class Landmarks:
    """Which buildings stay as they are at every level."""

    # From which height (m) and volume (m3) on; 0 for none.
    height: float = 0.0
    volume: float = 0.0
    tag: str = ""  # ``ATTRIBUTE`` that is set, or ``ATTRIBUTE=VALUE``; ``""`` for none
    ids: frozenset[str] = frozenset()  # ids of buildings


def read_ids(text: str) -> frozenset[str]:
    """Read ids: a file with one a line, or a list with commas; InputError if the file cannot be read."""
    path = Path(text)
    if path.suffix in (".txt", ".csv") and not path.is_file():
        raise InputError(f"{path}: no such file; check the path of --landmarks")
    if not text or not path.is_file():
        return frozenset(filter(None, map(str.strip, text.split(","))))
    try:
        return frozenset(filter(None, map(str.strip, path.read_text(encoding="utf-8-sig").splitlines())))
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: ids cannot be read ({error}); give a text file with an id a line") from error


@dataclass(frozen=True)
class Asked:
    """Options of a generalisation; lengths in metres, areas in square metres."""

    # Th1: share of a cell without other objects that buildings must cover for the land use Building.
    least_share: float = 0.3
    most_area: float = 20_000.0  # Th2: cells up to this are aggregated for LoD0A
    fragment: float = 400.0  # cells below this are joined to the neighbour with the longest border
    street_width: float = 6.0  # of the streets along cells, half of which is cut from each block
    # A block keeps open space between its buildings up to this; 0 for all of the cell, as the paper has it.
    yard_width: float = 0.0
    block_gap: float = 6.0  # without roads: buildings that are closer are of one block
    adjacent: float = 0.1  # buildings up to this apart are adjacent
    block_height: str = HEIGHTS[0]  # what the mean height of a block keeps, one of `HEIGHTS`
    default_height: float = 6.0  # height of buildings of which none is known
    landmarks: Landmarks = field(default_factory=Landmarks)  # what is left out of generalisation
    tile_size: float = 1000.0  # side of the squares that are worked on one by one

    def __post_init__(self) -> None:
        """Refuse what is out of range, with a ConfigError."""
        for name, low, high in (
            ("least_share", 0.0, 1.0),
            *(
                (name, 0.0, math.inf)
                for name in ("most_area", "fragment", "street_width", "yard_width", "adjacent")
            ),
            ("block_gap", 0.5, 100.0),
            ("default_height", 0.1, 1000.0),
            ("tile_size", LEAST_TILE, 100_000.0),
        ):
            value = float(getattr(self, name))
            if not (math.isfinite(value) and low <= value <= high):
                bounds = f"{low:g} or more" if high == math.inf else f"{low:g} to {high:g}"
                raise ConfigError(f"--{name.replace('_', '-')} {value:g}: expected {bounds}; change it")
        if self.tile_size % 1:
            raise ConfigError(f"--tile-size {self.tile_size:g}: expected whole metres; change it")
        if self.block_height not in HEIGHTS:
            raise ConfigError(f"--block-height {self.block_height}: expected one of {', '.join(HEIGHTS)}")
        for name in ("height", "volume"):
            value = float(getattr(self.landmarks, name))
            if not (math.isfinite(value) and value >= 0):
                raise ConfigError(f"--landmark-{name} {value:g}: expected 0, for none, or more; change it")


@dataclass(frozen=True)
class Inputs:
    """Files of a generalisation."""

    models: Sequence[Path] = ()  # city models, or the folder of a run; none with `footprints`
    footprints: Path | None = None  # vector file of buildings
    # Of `footprints`, ``""`` for what is found.
    layer: str = ""
    id_attribute: str = ""
    height_attribute: str = ""
    # CRS of the output, ``""`` for that of the buildings, or the UTM zone where these are in degrees.
    crs: str = ""
    bounds: tuple[float, float, float, float] | None = None  # region (m); by default all there is
    # Barriers, and other objects that are none: ``FILE`` or ``FILE:LAYER`` each.
    roads: Sequence[Path] = ()
    railways: Sequence[Path] = ()
    water: Sequence[Path] = ()
    others: Sequence[Path] = ()

    def __post_init__(self) -> None:
        """Refuse what does not go together, with a ConfigError."""
        if bool(self.models) == (self.footprints is not None):
            raise ConfigError("buildings: give city models or the folder of a run, or --footprints; one of these")
        if self.models and (self.layer or self.id_attribute or self.height_attribute):
            raise ConfigError("--layer, --id-attribute, --height-attribute: are those of --footprints; give both")
        box = self.bounds
        if box is not None and not (all(map(math.isfinite, box)) and box[0] < box[2] and box[1] < box[3]):
            raise ConfigError(f"--bounds {' '.join(f'{v:g}' for v in box)}: expected XMIN < XMAX and YMIN < YMAX")


def read_options(given: Mapping[str, Any]) -> tuple[Inputs, Asked]:
    """Take what is given by the names of `OPTIONS`, others aside; errors as of both."""

    def pick(kind: Any) -> dict[str, Any]:
        return {one.name: given[one.name] for one in fields(kind) if one.name in given}

    marks = {name.removeprefix("landmark_"): given[name] for name in LANDMARKS if name in given}
    landmarks = Landmarks(**marks, ids=read_ids(given.get("landmarks", "")))
    return Inputs(**pick(Inputs)), Asked(**pick(Asked) | {"landmarks": landmarks})


LANDMARKS = ("landmark_height", "landmark_volume", "landmark_tag")
OPTIONS = (*(one.name for kind in (Inputs, Asked) for one in fields(kind)), *LANDMARKS)
