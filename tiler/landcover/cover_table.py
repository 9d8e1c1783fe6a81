"""Patches of the ground by class of land cover: our table, and those of users."""

import math
import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from pipeline.data.errors import ConfigError
from tiler.config.config import Config
from tiler.objects.places import place

GROUND = "ground"  # patch without any polygon
PAD = "pad"
MOST_PATCHES = 60  # numbers of patches end below 100, where those of buildings begin
NAME = re.compile(r"[a-z][a-z0-9_]{0,30}")
ROUGHNESS = (0.0, 5.0)  # m; what is taken, the first left out


@dataclass(frozen=True)
class CoverRow:
    """A patch of the ground."""

    patch: str  # its name, ``water``; in files it is ``ground_water``
    roughness: float  # roughness length z0 (m)
    level: bool  # whether each body of it is at one height
    classes: tuple[str, ...]  # words that files have for it, in small letters


# In the order in which they count where polygons overlap. Roughness lengths are of Wieringa's classification (J.
# Wieringa, "Updating the Davenport roughness classification", J. Wind Eng. Ind. Aerodyn. 41, 357-368, 1992); words
# are values of OpenStreetMap, of the Dutch BGT, and plain ones.
WORDS = {
    "water": "water river canal lake pond basin reservoir riverbank dock waterway waterdeel waterloop watervlakte",
    "street": "street road highway motorway primary secondary tertiary service pedestrian footway path cycleway "
    "parking paved wegdeel rijbaan voetpad fietspad",
    "rail": "rail railway tram spoorbaan",
    "sand": "sand beach bare_rock rock shingle mud quarry pitch",
    "forest": "forest wood trees tree_row bos",
    "scrub": "scrub heath orchard vineyard wetland struiken",
    "grass": "grass grassland meadow park garden village_green recreation_ground cemetery golf_course playground "
    "allotments groenvoorziening grasland",
    "field": "field farmland farm agriculture bouwland",
}
ROUGHNESSES = (0.0002, 0.005, 0.03, 0.005, 1.0, 0.25, 0.03, 0.1)  # m, of these in their order
TABLE = tuple(
    CoverRow(patch, z0, patch == "water", tuple(words.split()))
    for (patch, words), z0 in zip(WORDS.items(), ROUGHNESSES, strict=True)
)


def read_table(config: Config) -> tuple[CoverRow, ...]:
    """Read the patches of a run: those of its file, or ours; none where it has no land cover.

    ConfigError if the file is no table of patches.
    """
    if not config.covered:
        return ()
    rows = _read_file(config) if config.land_cover_table else TABLE
    if config.water_points and not any(row.level for row in rows):
        raise ConfigError(
            f"{config.land_cover_table}: no patch has level = true, and water_points makes water of one"
        )
    return rows


def _read_file(config: Config) -> tuple[CoverRow, ...]:
    path = place(config.land_cover_table)
    try:
        found = tomllib.loads(path.read_text())
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror}); check land_cover_table") from error
    except ValueError as error:
        raise ConfigError(f"{path}: not valid TOML ({error}); see docs/land-cover.md") from error
    rows = tuple(_read_row(f"{path}: [{name}]", name, row) for name, row in found.items())
    taken: dict[str, str] = {}
    for row in rows:
        for word in row.classes:
            if taken.setdefault(word, row.patch) != row.patch:
                raise ConfigError(f"{path}: class {word!r} is of {taken[word]} and of {row.patch}; give it to one")
    if not 1 <= len(rows) <= MOST_PATCHES:
        raise ConfigError(f"{path}: {len(rows)} patches; 1 to {MOST_PATCHES} are taken")
    return rows


def _read_row(where: str, name: str, row: Any) -> CoverRow:
    if not NAME.fullmatch(name) or name == PAD:
        raise ConfigError(f"{where}: a patch is named by up to 31 small letters, digits and _, and not {PAD!r}")
    known = {"z0", "classes", "level"}
    if not isinstance(row, Mapping) or not {"z0", "classes"} <= row.keys() <= known:
        raise ConfigError(f"{where}: must have z0 and classes, may have level, and nothing else")
    z0, classes, level = row["z0"], row["classes"], row.get("level", False)
    if isinstance(z0, bool) or not isinstance(z0, (int, float)) or not ROUGHNESS[0] < z0 <= ROUGHNESS[1]:
        raise ConfigError(f"{where}: z0 = {z0!r}: a roughness length above 0 m and of at most {ROUGHNESS[1]:g} m")
    if not isinstance(level, bool):
        raise ConfigError(f"{where}: level = {level!r}: true or false expected")
    if not isinstance(classes, list) or not classes or not all(isinstance(word, str) for word in classes):
        raise ConfigError(f"{where}: classes must be a list of words")
    return CoverRow(name, float(z0), level, tuple(class_word(word) for word in classes))


def class_word(value: Any) -> str:
    """Write the class that a feature has as tables do; empty where it has none.

    Examples
    --------
    >>> class_word(" Water "), class_word(7), class_word(None), class_word(float("nan"))
    ('water', '7', '', '')
    """
    missing = value is None or (isinstance(value, float) and math.isnan(value))
    return "" if missing else str(value).strip().lower()


def describe_patches(rows: tuple[CoverRow, ...], *, padded: bool) -> list[dict[str, Any]]:
    """Describe the patches of the ground for the record of a run, by their number: that of no polygon first."""
    if not rows:
        return []
    named = [{"patch": f"{GROUND}_{row.patch}", "z0 (m)": row.roughness, "level": row.level} for row in rows]
    pad = [{"patch": f"{GROUND}_{PAD}", "z0 (m)": None, "level": False}] if padded else []
    return [{"patch": GROUND, "z0 (m)": None, "level": False}, *named, *pad]
