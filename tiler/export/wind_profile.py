"""The wind before it meets the city: its direction, the logarithmic profile, and what k-epsilon makes of it."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
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


class WindWords(TypedDict, total=False):
    """Options of a wind case, as the command line has them."""

    direction: list[float]
    wind_speed: float
    wind_height: float
    roughness: float
    patch_roughness: list[str]


@dataclass(frozen=True)
class Wind:
    """The wind at the inlet.

    Attributes
    ----------
    directions : tuple of float
        Where it comes from: degrees clockwise from north of the CRS.
    speed, height : float
        Speed (m/s) at a height above the inlet's lowest ground (m).
    roughness : float
        Roughness length upstream, and of the ground (m).
    patches : mapping of str to float
        Roughness lengths of patches that differ (m).
    """

    directions: tuple[float, ...] = (WEST,)
    speed: float = 5.0
    height: float = 10.0
    roughness: float = 0.5
    patches: Mapping[str, float] = field(default_factory=dict)

    @property
    def friction(self) -> float:
        """Friction velocity (m/s): speed = friction / kappa ln((height + roughness) / roughness)."""
        return KAPPA * self.speed / math.log((self.height + self.roughness) / self.roughness)

    @property
    def k(self) -> float:
        """Turbulent kinetic energy (m2/s2), the same at all heights."""
        return self.friction**2 / math.sqrt(C_MU)

    def speed_at(self, height: ArrayLike) -> Floats:
        """Return the speed (m/s) at heights above the ground (m)."""
        above = np.asarray(height, np.float64)
        return np.asarray(self.friction / KAPPA * np.log((above + self.roughness) / self.roughness))

    def epsilon_at(self, height: ArrayLike) -> Floats:
        """Return the dissipation (m2/s3) at heights above the ground (m)."""
        return np.asarray(self.friction**3 / (KAPPA * (np.asarray(height, np.float64) + self.roughness)))


def make_wind(words: WindWords) -> Wind:
    """Make the wind of options.

    Raises
    ------
    ConfigError
        If one is out of range, or a direction is there twice.
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
    return Wind(directions, patches=_read_patches(words.get("patch_roughness", ())), **numbers)


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
