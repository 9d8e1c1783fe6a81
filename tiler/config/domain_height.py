"""The height of the domain: in metres or in heights of the tallest building, and what guidelines ask of it.

Air above the tallest building should be five times as high as the building, so the domain six times:
Franke et al., *Best practice guideline for the CFD simulation of flows in the urban environment*, COST action
732 (2007), and Tominaga et al., *AIJ guidelines for practical applications of CFD to pedestrian wind environment
around buildings*, J. Wind Eng. Ind. Aerodyn. 96 (2008), 1749-1761.
"""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pipeline.data.errors import ConfigError
from stitch.tiling.smallest_tile import LEAST_TILE

MULTIPLE = re.compile(r"([0-9]*\.?[0-9]+)\s*[hH]")
EXPECTED_TALLEST = 20.0  # m; the tallest building where a forecast needs one before there is a city model
GUIDELINE = 6.0  # heights of the tallest building: least height of the domain (COST 732, AIJ)
ROUNDING = 1e-9
Height = float | str
LEAST_SIDE = 10.0  # m
LARGE_SIDE = 1250.0  # m; for meshes of the size below, and coarser ones
LARGE_SIDE_SIZE = 10.0  # m
POWER = 0.9  # of the mesh size: cells in a tile grow somewhat as it falls
STEP = 10.0  # m; sides that are chosen are multiples of it
SIDES = ("west", "east", "south", "north")
LEAST_NODES = 4  # of the terrain's grid, across a pad: the outermost ones are level


@dataclass(frozen=True)
class Domain:
    """The domain of a region, as the stages from its seams on have it."""

    height: float  #: height above the smoothed terrain, or above the highest terrain where the top is flat (m)
    top: float | None  #: absolute height of a flat top (m); None where the top follows the terrain


def read_height(value: Height, name: str = "domain_height") -> Height:
    """Read a length: metres as a number, or a multiple of the height of the tallest building as a text.

    Raises
    ------
    ConfigError
        If it is neither.

    Examples
    --------
    >>> read_height("6 h"), read_height("80"), read_height(80.0)
    ('6H', 80.0, 80.0)
    """
    if isinstance(value, float):
        return value
    text = value.strip()
    found = MULTIPLE.fullmatch(text)
    if found and float(found[1]) > 0:
        return f"{float(found[1]):g}H"
    try:
        return float(text)
    except ValueError:
        raise ConfigError(
            f"{name} = {text[:40]!r}: expected metres, or a multiple of the tallest building's height as 6H"
        ) from None


def height_in_metres(height: Height, tallest: float) -> float:
    """Height of the domain (m), given that of the tallest building (m).

    Examples
    --------
    >>> height_in_metres("6H", 21.5), height_in_metres(80.0, 21.5)
    (129.0, 80.0)
    """
    return float(height[:-1]) * tallest if isinstance(height, str) else height


def resolve_height(height: Height, top: str, facts: Mapping[str, Any]) -> Domain:
    """Decide height and top of the domain from what the stage ``domain`` found.

    Parameters
    ----------
    height : float or str
        As configured.
    top : "terrain" or "flat"
        As configured.
    facts : mapping
        ``"tallest"`` (m) and, with a flat top, ``"highest_ground"`` (m).

    Raises
    ------
    ConfigError
        If the height is a multiple of the tallest building's, and there is none.
    """
    tallest = float(facts["tallest"])
    if isinstance(height, str) and tallest <= 0:
        raise ConfigError(f"domain_height = {height}: there are no buildings in the region; give it in metres")
    metres = height_in_metres(height, tallest)
    return Domain(metres, float(facts["highest_ground"]) + metres if top == "flat" else None)


def is_low(height: float, tallest: float) -> bool:
    """Whether guidelines ask for a higher domain.

    Examples
    --------
    >>> is_low(100.0, 20.0), is_low(120.0, 20.0), is_low(100.0, 0.0)
    (True, False, False)
    """
    return height < GUIDELINE * tallest * (1 - ROUNDING)


def choose_tile_size(mesh_size: float, largest_size: float) -> float:
    """Choose the side of tiles (m) so that seams are few, and a worker takes some 300 to 450 MB.

    Parameters
    ----------
    mesh_size, largest_size : float
        Target edge length at walls, and the largest one in the region (m).

    Notes
    -----
    Nothing else counts, so that a larger region has the same tiles. Larger tiles have fewer seams and tasks,
    smaller ones take less memory and leave no worker idle: `docs/scaling.md` has the measurements.

    Examples
    --------
    >>> [choose_tile_size(size, size) for size in (20.0, 10.0, 5.0, 2.5)]
    [1250.0, 1250.0, 660.0, 350.0]
    """
    fine = min(mesh_size / LARGE_SIDE_SIZE, 1.0)
    side = math.floor(LARGE_SIDE * math.pow(fine, POWER) / STEP) * STEP
    return max(side, LEAST_SIDE, LEAST_TILE * largest_size)


def widths_in_metres(pad: Sequence[Height], tallest: float) -> tuple[float, float, float, float]:
    """Widths of a pad to the west, east, south and north (m), given the height of the tallest building (m).

    Raises
    ------
    ConfigError
        If one is a multiple of the tallest building's height, and there is none.

    Notes
    -----
    Multiples are rounded up to whole metres.

    Examples
    --------
    >>> widths_in_metres(("5H",), 21.5), widths_in_metres((200.0, "15H", 0.0, 0.0), 21.5)
    ((108.0, 108.0, 108.0, 108.0), (200.0, 323.0, 0.0, 0.0))
    """
    if tallest <= 0 and any(isinstance(width, str) for width in pad):
        shown = " ".join(map(str, pad))
        raise ConfigError(f"pad = {shown}: there are no buildings in the region; give it in metres")
    metres = [
        float(math.ceil(height_in_metres(width, tallest))) if isinstance(width, str) else width for width in pad
    ]
    west, east, south, north = metres * (4 // len(metres))
    return west, east, south, north


def check_widths(widths: Sequence[Height], *, mesh_size: float, dtm_spacing: float) -> None:
    """Refuse a pad that is narrower than a cell, or too narrow for its ground.

    Raises
    ------
    ConfigError
        With the width against its bound (m); multiples of a height that is not known are not looked at.
    """
    least = max(mesh_size, LEAST_NODES * dtm_spacing)
    for width in widths:
        if not isinstance(width, str) and width != 0 and not (math.isfinite(width) and width >= least):
            raise ConfigError(
                f"pad = {width:g} m: must be 0 for none, or at least {least:g} m (mesh_size, and {LEAST_NODES} "
                "times dtm_spacing)"
            )
