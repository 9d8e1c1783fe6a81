"""Widths of a pad around the region: what is asked for, in metres or in heights of the tallest building."""

import math
from collections.abc import Sequence

from pipeline.data.errors import ConfigError
from tiler.config.domain_height import Height, height_in_metres

SIDES = ("west", "east", "south", "north")
LEAST_NODES = 4  # of the terrain's grid, across a pad: the outermost ones are level


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
