"""Options of zones of detail: where buildings have which level of detail, and which target edge length."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from pipeline.data.errors import ConfigError
from tiler.words.plain_text import shorten

# Finest first: sloped planes, flat parts, one height an outline, and three levels of blocks.
LEVELS = ("2.2", "1.3", "1.2", "0C", "0B", "0A")
BLOCKS = LEVELS[3:]
REST = "rest"  # instead of a place: all that is in no zone
# Rings of a focus: level, and radius and edge length in those of the focus; the last one has no end.
RINGS = (("2.2", 1, 1), ("1.3", 2, 2), ("1.2", 4, 4))
RINGS_OF_BLOCKS = (*RINGS, ("0C", 8, 8), ("0B", 16, 16))
FOCUS_SIZE = 0.25  # mesh sizes; of a focus that states none
# Attributes of buildings in the city model: the level of detail that their zone asks for, and the point that
# decides on their zone.
LOD, LOD_POINT = "level_of_detail", "zone_point"
# Level, edge length (m), and place as well-known binary in hexadecimal digits, empty for the rest; finest first.
Zones = tuple[tuple[str, float, str], ...]


@dataclass(frozen=True)
class Circle:
    """A circle with a level of detail and a target edge length."""

    level: str  #: one of `LEVELS`
    size: float  #: target edge length (m)
    place: tuple[float, float, float]  #: (x, y, radius): in the region's CRS (m)


@dataclass(frozen=True)
class ZonesAsked:
    """What options say of zones."""

    circles: tuple[Circle, ...]  #: circles of both options
    files: tuple[str, ...]  #: vector files of further zones
    rest: str  #: level of all that lies in no zone


def is_file(text: str) -> bool:
    """Tell whether a value of ``lod_zones`` names a file."""
    first = text.split(",", maxsplit=1)[0].strip()
    if first == REST:
        return False
    try:
        float(first)
    except ValueError:
        return True
    return False


def read_zones_asked(zones: Sequence[str], focus: str, *, mesh_size: float, blocks: bool) -> ZonesAsked:
    """Read the options of zones.

    Parameters
    ----------
    zones : sequence of str
        Files, circles ``x,y,RADIUS,LEVEL,SIZE``, and the level of the rest, ``rest,LEVEL``.
    focus : str
        ``x,y,RADIUS`` or ``x,y,RADIUS,SIZE``; empty for none.
    mesh_size : float
        Target edge length of the rest (m).
    blocks : bool
        Whether there are blocks for the rings of a focus.

    Raises
    ------
    ConfigError
        With the value and what is expected.

    Examples
    --------
    >>> asked = read_zones_asked([], "10,20,500,5", mesh_size=20.0, blocks=False)
    >>> [(ring.level, ring.size, ring.place) for ring in asked.circles], asked.rest
    ([('2.2', 5.0, (10.0, 20.0, 500.0)), ('1.3', 10.0, (10.0, 20.0, 1000.0))], '1.2')
    >>> read_zones_asked(["9,9,50,1.2,8", "rest,0B", "zones.gpkg"], "", mesh_size=20.0, blocks=True).rest
    '0B'
    """
    circles, files, rest, n_rest = list[Circle](), list[str](), LEVELS[0], 0
    if focus:
        rings, rest = _read_focus(focus, mesh_size, RINGS_OF_BLOCKS if blocks else RINGS)
        circles += rings
    for text in zones:
        words = [word.strip() for word in text.split(",")]
        if is_file(text):
            files.append(text)
        elif words[0] == REST and len(words) == 2:
            rest, n_rest = check_level(words[1], f"lod_zones = {shorten(text, 100)}"), n_rest + 1
            if n_rest > 1:
                raise ConfigError(f"lod_zones = {shorten(text, 100)}: the rest has a level already; give one")
        else:
            circles.append(_read_circle(text, words, mesh_size))
    return ZonesAsked(tuple(circles), tuple(files), rest)


def _read_focus(text: str, mesh_size: float, rings: Sequence[tuple[str, int, int]]) -> tuple[list[Circle], str]:
    subject = f"focus = {shorten(text, 100)}"
    numbers = _read_numbers(text.split(","))
    if numbers is None or len(numbers) not in (3, 4):
        raise ConfigError(f"{subject}: x,y,RADIUS expected, or x,y,RADIUS,SIZE; in coordinates of the region")
    x, y, radius = numbers[:3]
    size = numbers[3] if len(numbers) == 4 else FOCUS_SIZE * mesh_size
    check_size(size, mesh_size, subject)
    _check_radius(radius, subject)
    circles = [
        Circle(level, min(size * coarser, mesh_size), (x, y, radius * times))
        for level, times, coarser in rings[:-1]
    ]
    return circles, rings[-1][0]


def _read_circle(text: str, words: Sequence[str], mesh_size: float) -> Circle:
    subject = f"lod_zones = {shorten(text, 100)}"
    numbers = _read_numbers([*words[:3], *words[4:]])
    if numbers is None or len(words) != 5:
        raise ConfigError(
            f"{subject}: a file expected, a circle x,y,RADIUS,LEVEL,SIZE, or {REST},LEVEL for all that is in no "
            "zone"
        )
    x, y, radius, size = numbers
    check_size(size, mesh_size, subject)
    _check_radius(radius, subject)
    return Circle(check_level(words[3], subject), size, (x, y, radius))


def _read_numbers(words: Sequence[str]) -> list[float] | None:
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        return None
    return numbers if all(map(math.isfinite, numbers)) else None


def check_level(level: str, subject: str) -> str:
    """Give a level back; ConfigError, whose message `subject` begins, where it is none."""
    if level not in LEVELS:
        raise ConfigError(f"{subject}: level {shorten(level, 20)!r}; must be one of {', '.join(LEVELS)}")
    return level


def check_size(size: float, mesh_size: float, subject: str) -> None:
    """Raise ConfigError if the size of a zone is out of bounds (m); `subject` begins the message."""
    if not 0.1 <= size <= mesh_size:
        raise ConfigError(
            f"{subject}: a size of {size:g} m; must be at least 0.1 m and at most that of the rest, mesh_size = "
            f"{mesh_size:g} m"
        )


def _check_radius(radius: float, subject: str) -> None:
    if radius <= 0:
        raise ConfigError(f"{subject}: a radius of {radius:g} m; must be above 0")
