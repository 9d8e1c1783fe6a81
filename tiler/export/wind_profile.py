"""The wind before it meets the city: its direction, its profile, logarithmic or a table, and its k and epsilon."""

import csv
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypedDict

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipeline.data.errors import ConfigError

Floats = NDArray[np.float64]
KAPPA, C_MU, C_1, C_2 = 0.41, 0.09, 1.44, 1.92
# The profile solves the equation of epsilon with this alone (Richards and Hoxey 1993); 1.3 is the usual one.
SIGMA_EPSILON = KAPPA**2 / ((C_2 - C_1) * math.sqrt(C_MU))
PARALLEL = 1e-6  # a side is along the wind if the cosine of its normal with it is smaller
PEDESTRIAN_HEIGHT = 1.75  # m above ground, at which the comfort of people is told
SIDES = {"west": (-1.0, 0.0), "east": (1.0, 0.0), "south": (0.0, -1.0), "north": (0.0, 1.0)}
WEST = 270.0
COLUMNS = ("height", "speed", "k", "epsilon")  # of a table of the profile


class WindWords(TypedDict, total=False):
    """Options of a wind case, as the command line has them."""

    direction: list[float]
    wind_speed: float
    wind_height: float
    roughness: float
    wind_table: str
    patch_roughness: list[str]


@dataclass(frozen=True)
class WindTable:
    """The wind at some heights; between them it is linear, beyond the first and last it stays."""

    height: tuple[float, ...]  #: heights above the inlet's lowest ground (m), ascending
    speed: tuple[float, ...]  #: speeds (m/s)
    #: turbulent kinetic energy (m2/s2) and its dissipation (m2/s3); empty where the file has none
    k: tuple[float, ...] = ()
    epsilon: tuple[float, ...] = ()


@dataclass(frozen=True)
class Wind:
    """The wind at the inlet."""

    directions: tuple[float, ...] = (WEST,)  #: where it comes from: degrees clockwise from north of the CRS
    #: speed (m/s) at a height above the inlet's lowest ground (m)
    speed: float = 5.0
    height: float = 10.0
    roughness: float = 0.5  #: roughness length upstream, and of the ground (m)
    patches: Mapping[str, float] = field(default_factory=dict)  #: roughness lengths of patches that differ (m)
    #: the profile, instead of the logarithmic one; `speed` is then that of the table at `height`
    table: WindTable | None = None

    @property
    def friction(self) -> float:
        """Friction velocity (m/s): speed = friction / kappa ln((height + roughness) / roughness).

        Of a table, that of the logarithmic profile closest to its speeds (least squares).
        """
        if self.table is None:
            return KAPPA * self.speed / self._log(self.height)
        logs = [self._log(height) for height in self.table.height]
        products = sum(u * log for u, log in zip(self.table.speed, logs, strict=True))
        return KAPPA * products / sum(log**2 for log in logs)

    def _log(self, height: float) -> float:
        return math.log((height + self.roughness) / self.roughness)

    def k_at(self, height: ArrayLike) -> Floats:
        """Return the turbulent kinetic energy (m2/s2): the same at all heights, if no table has it."""
        above = np.asarray(height, np.float64)
        if self.table is not None and self.table.k:
            return np.asarray(np.interp(above, self.table.height, self.table.k))
        return np.full_like(above, self.friction**2 / math.sqrt(C_MU))

    def speed_at(self, height: ArrayLike) -> Floats:
        """Return the speed (m/s) at heights above the ground (m)."""
        above = np.asarray(height, np.float64)
        if self.table is not None:
            return np.asarray(np.interp(above, self.table.height, self.table.speed))
        return np.asarray(self.friction / KAPPA * np.log((above + self.roughness) / self.roughness))

    def epsilon_at(self, height: ArrayLike) -> Floats:
        """Return the dissipation (m2/s3) at heights above the ground (m)."""
        above = np.asarray(height, np.float64)
        if self.table is not None and self.table.epsilon:
            return np.asarray(np.interp(above, self.table.height, self.table.epsilon))
        return np.asarray(self.friction**3 / (KAPPA * (above + self.roughness)))


def make_wind(words: WindWords) -> Wind:
    """Make the wind of options.

    Raises
    ------
    ConfigError
        If one is out of range, a direction is there twice, or a table is wrong or beside a speed.
    """
    base = Wind()
    directions = tuple(value % 360.0 for value in words.get("direction", base.directions))
    if not all(math.isfinite(value) for value in directions):
        raise ConfigError("--direction: must be degrees from north, as 240")
    if len(set(map(case_name, directions))) < len(directions):
        raise ConfigError(f"--direction: {', '.join(f'{value:g}' for value in directions)}: give each once")
    numbers = {}
    for name, default in (("speed", base.speed), ("height", base.height), ("roughness", base.roughness)):
        option = name if name == "roughness" else f"wind_{name}"
        numbers[name] = value = float(words.get(option, default))  # type: ignore[arg-type]
        if not 0 < value < math.inf:
            raise ConfigError(f"--{option.replace('_', '-')} {value:g}: must be more than 0")
    patches = _read_patches(words.get("patch_roughness", ()))
    wind = Wind(directions, numbers["speed"], numbers["height"], numbers["roughness"], patches)
    if "wind_table" not in words:
        return wind
    if "wind_speed" in words:
        raise ConfigError("--wind-speed: the speed is that of --wind-table; leave one out")
    wind = replace(wind, table=read_wind_table(Path(words["wind_table"])))
    if not (speed := float(wind.speed_at(wind.height))) > 0:
        raise ConfigError(
            f"--wind-height {wind.height:g}: --wind-table has no speed there; give a height where it has"
        )
    return replace(wind, speed=speed)


def read_wind_table(path: Path) -> WindTable:
    """Read a CSV file with a head line: ``height`` and ``speed``, and ``k`` and ``epsilon`` if it has these.

    Raises
    ------
    ConfigError
        If it cannot be read, a column is missing or unknown, or a row is wrong: names the line.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"--wind-table {path}: cannot be read ({error}); check the path") from None
    rows = [[cell.strip() for cell in row] for row in csv.reader(text.splitlines())]
    head, body = (rows[0] if rows else []), rows[1:]
    if len(set(head)) < len(head) or not {"height", "speed"} <= set(head) <= set(COLUMNS):
        raise ConfigError(
            f"--wind-table {path}: its first line is {','.join(head)!r}; it must name height and speed, and may "
            "name k and epsilon"
        )
    columns: dict[str, list[float]] = {name: [] for name in head}
    for line, row in enumerate(body, start=2):
        if not any(row):
            continue
        try:
            values = dict(zip(head, map(float, row), strict=True))
        except ValueError:
            raise ConfigError(
                f"--wind-table {path}, line {line}: {len(head)} numbers are needed: {','.join(row)}"
            ) from None
        least = {"height": 0.0, "speed": 0.0, "k": math.ulp(0.0), "epsilon": math.ulp(0.0)}
        for name, value in values.items():
            if not least[name] <= value < math.inf:
                bound = "more than 0" if least[name] else "0 or more"
                raise ConfigError(f"--wind-table {path}, line {line}: {name} {value:g} must be {bound}")
            columns[name].append(value)
        heights = columns["height"]
        if len(heights) > 1 and heights[-1] <= heights[-2]:
            raise ConfigError(
                f"--wind-table {path}, line {line}: height {heights[-1]:g} must be above {heights[-2]:g} m"
            )
    if len(columns["height"]) < 2 or not max(columns["speed"]) > 0:
        raise ConfigError(f"--wind-table {path}: needs two heights or more, and a speed above 0")
    return WindTable(**{name: tuple(values) for name, values in columns.items()})


def _read_patches(words: Iterable[str]) -> dict[str, float]:
    patches = {}
    for word in words:
        name, _, text = word.partition("=")
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not name or not 0 < value < math.inf:
            raise ConfigError(f"--patch-roughness {word}: must be PATCH=METRES, as ground=0.03")
        patches[name] = value
    return patches


def case_name(direction: float) -> str:
    """Name the folder of a direction.

    Examples
    --------
    >>> case_name(240.0), case_name(22.5)
    ('wind_240', 'wind_22.5')
    """
    return f"wind_{direction:g}"


def flow_of(direction: float) -> tuple[float, float]:
    """Return the way in which the wind goes, east and north, for where it comes from (degrees from north).

    Examples
    --------
    >>> flow_of(270.0), flow_of(180.0), flow_of(225.0)
    ((1.0, 0.0), (0.0, 1.0), (0.707106781187, 0.707106781187))
    """
    angle = math.radians(direction)
    return round(-math.sin(angle), 12) + 0.0, round(-math.cos(angle), 12) + 0.0


def split_sides(direction: float, sides: Iterable[str]) -> tuple[list[str], list[str], list[str]]:
    """Return which of the sides of a domain the wind enters, which it leaves by, and along which it goes.

    Examples
    --------
    >>> split_sides(240.0, SIDES), split_sides(270.0, SIDES)
    ((['west', 'south'], ['east', 'north'], []), (['west'], ['east'], ['south', 'north']))
    """
    east, north = flow_of(direction)
    found: tuple[list[str], list[str], list[str]] = ([], [], [])
    for side in sides:
        out = SIDES[side][0] * east + SIDES[side][1] * north
        found[0 if out < -PARALLEL else 1 if out > PARALLEL else 2].append(side)
    return found
