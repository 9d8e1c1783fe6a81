"""The pad: a margin of bare ground around the region, its widths and its tiles.

Guidelines keep the sides of the domain away from buildings: five times the height of the tallest one towards the
inlet and the sides, fifteen times behind (Franke et al., COST action 732, 2007), or ten (Tominaga et al., AIJ,
2008); both are cited in full in `tiler.config.domain_height`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from stitch.tiling.grid import Bounds, TileGrid, make_grid, tiles_present
from tiler.engine.run_context import SHARED


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
