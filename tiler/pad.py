"""The pad: a margin of bare ground around the region, its widths and its tiles.

Guidelines keep the sides of the domain away from buildings: five times the height of the tallest one towards the
inlet and the sides, fifteen times behind (Franke et al., COST action 732, 2007), or ten (Tominaga et al., AIJ,
2008); both are cited in full in `tiler.domain`.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import ConfigError
from stitch.grid import Bounds, TileGrid, make_grid, tiles_present
from tiler.context import SHARED
from tiler.domain import Height, height_in_metres

SIDES = ("west", "east", "south", "north")
LEAST_NODES = 4  # of the terrain's grid, across a pad: the outermost ones are level


@dataclass(frozen=True)
class Pad:
    """A region within its pad.

    Attributes
    ----------
    core : (xmin, ymin, xmax, ymax)
        The region that was asked for, with its buildings and points (m).
    grid : TileGrid
        Tiles of core and pad.
    """

    core: Bounds
    grid: TileGrid


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


def pad_bounds(core: Bounds, widths: Sequence[float]) -> Bounds:
    """Grow a region by the widths of its pad: west, east, south, north (m).

    Examples
    --------
    >>> pad_bounds((0.0, 0.0, 10.0, 20.0), (1.0, 2.0, 3.0, 4.0))
    (-1.0, -3.0, 12.0, 24.0)
    """
    west, east, south, north = widths
    return core[0] - west, core[1] - south, core[2] + east, core[3] + north


def pad_grid(core: TileGrid, bounds: Bounds, *, mesh_size: float, open_size: float) -> TileGrid:
    """Lay tiles over a region and its pad.

    Parameters
    ----------
    core : TileGrid
        Tiles of the region.
    bounds : (xmin, ymin, xmax, ymax)
        Region and pad (m).
    mesh_size, open_size : float
        As in `make_grid`.

    Returns
    -------
    TileGrid
        Tiles between multiples of the tile size, as any. One that shares area with an absent tile of the region is
        absent too; all others are there.

    Notes
    -----
    Every line within the region is a line of the larger grid: no tile of this has parts of two of the region's.
    """
    whole = make_grid(bounds, tile_size=core.tile_size, mesh_size=mesh_size, open_size=open_size)
    column, row = (_tiles_below(outer, inner) for outer, inner in zip(whole.lines, core.lines, strict=True))
    meets = np.logical_and.outer(column >= 0, row >= 0)
    present = ~meets | tiles_present(core)[np.ix_(np.maximum(column, 0), np.maximum(row, 0))]
    return replace(whole, present=None if present.all() else present)


def _tiles_below(outer: NDArray[np.float64], inner: NDArray[np.float64]) -> NDArray[np.int64]:
    """Which interval of some lines each interval of finer ones meets; -1 where it meets none."""
    low, high = np.maximum(outer[:-1], inner[0]), np.minimum(outer[1:], inner[-1])
    at = np.searchsorted(inner, (low + high) / 2, side="right") - 1
    found: NDArray[np.int64] = np.where(high - low > SHARED, np.clip(at, 0, len(inner) - 2), -1)
    return found
