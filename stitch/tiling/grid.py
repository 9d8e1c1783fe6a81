"""The tile grid: squares aligned to the CRS, their corners and seams, and how far each of these looks."""

import math
from dataclasses import dataclass
from itertools import starmap
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stitch.tiling.smallest_tile import LEAST_TILE

Bounds = tuple[float, float, float, float]

CORNER_REACH = 25.0  # m; how far a corner may be from its nominal place
BAND = 35.0  # m; how far a seam may be from its nominal line
OPEN_BAND = 2.0  # open sizes; the same where sizes are graded, if that is more
# The first two where tiles are small, in tile sizes.
CORNER_SHARE = 1 / 6
BAND_SHARE = 1 / 4


class Key(NamedTuple):
    """Region-wide indices of a tile, or of the corner at its lower left."""

    i: int
    j: int


class SeamKey(NamedTuple):
    """A seam: it runs from corner (i, j) eastwards (axis 0) or northwards (axis 1)."""

    axis: int
    i: int
    j: int


@dataclass(frozen=True, eq=False)
class TileGrid:
    """Lines between tiles."""

    bounds: Bounds  #: (xmin, ymin, xmax, ymax): the region (m)
    tile_size: float  #: side of a tile (m)
    first: Key  #: indices of the first lines
    #: ascending places of the lines (m): the region's sides, and between them multiples of the tile size, line
    #: ``k`` of an axis at ``(first + k) * tile_size``. A line is left out that is closer than half a tile to a
    #: side, so tiles are between half and one and a half of their size
    lines: tuple[NDArray[np.float64], NDArray[np.float64]]
    #: which tiles there are, by column and row; all where it is None. The region is made of these: towards a tile
    #: that is absent it has a straight border
    present: NDArray[np.bool_] | None = None
    #: largest target edge length (m) where sizes are graded, 0 where they are the same everywhere
    open_size: float = 0.0


def make_grid(bounds: Bounds, *, tile_size: float, mesh_size: float, open_size: float = 0.0) -> TileGrid:
    """Lay the tile grid over a region.

    Raises
    ------
    ValueError
        If tiles are smaller than `LEAST_TILE` mesh sizes, or open sizes, or the region is empty.

    Examples
    --------
    >>> grid = make_grid((90.0, 30.0, 390.0, 130.0), tile_size=100.0, mesh_size=5.0)
    >>> grid.first, grid.lines[0], grid.lines[1]
    (Key(i=1, j=0), array([ 90., 200., 300., 390.]), array([ 30., 130.]))
    """
    size = max(mesh_size, open_size)
    if not tile_size >= LEAST_TILE * size > 0:
        raise ValueError(f"tile size {tile_size} m is below {LEAST_TILE:g} mesh sizes of {size} m")
    if not (bounds[0] < bounds[2] and bounds[1] < bounds[3]):
        raise ValueError(f"the region {bounds} is empty")
    i, x = _axis_lines(bounds[0], bounds[2], tile_size)
    j, y = _axis_lines(bounds[1], bounds[3], tile_size)
    return TileGrid(bounds, tile_size, Key(i, j), (x, y), open_size=open_size)


def tile_keys(grid: TileGrid) -> list[Key]:
    """List the tiles, column by column."""
    return list(starmap(Key, (np.argwhere(tiles_present(grid)) + grid.first).tolist()))


def tiles_present(grid: TileGrid) -> NDArray[np.bool_]:
    """Tell which tiles there are, by column and row: bool, (nx, ny)."""
    return np.ones([len(axis) - 1 for axis in grid.lines], np.bool_) if grid.present is None else grid.present


def has_tile(grid: TileGrid, tile: Key) -> bool:
    """Tell whether a tile lies in the region and is present."""
    at = tile.i - grid.first.i, tile.j - grid.first.j
    if not all(0 <= k < len(axis) - 1 for k, axis in zip(at, grid.lines, strict=True)):
        return False
    return grid.present is None or bool(grid.present[at])


def tile_box(grid: TileGrid, tile: Key) -> Bounds:
    """Box between the lines around a tile (m)."""
    i, j = tile.i - grid.first.i, tile.j - grid.first.j
    (xmin, xmax), (ymin, ymax) = grid.lines[0][i : i + 2].tolist(), grid.lines[1][j : j + 2].tolist()
    return xmin, ymin, xmax, ymax


def seam_line(grid: TileGrid, seam: SeamKey) -> Bounds:
    """Box of a seam's nominal line, without width (m)."""
    (xmin, ymin), (xmax, ymax) = (nominal_corner(grid, corner) for corner in ends_of_seam(seam))
    return xmin, ymin, xmax, ymax


def corner_keys(grid: TileGrid) -> list[Key]:
    """List the corners, column by column."""
    i, j = grid.first
    return [Key(i + a, j + b) for a in range(len(grid.lines[0])) for b in range(len(grid.lines[1]))]


def seam_keys(grid: TileGrid) -> list[SeamKey]:
    """List all seams that a tile has, those along the region's border included."""
    return [
        SeamKey(axis, i, j)
        for axis, there in enumerate(seams_present(grid))
        for i, j in (np.argwhere(there) + grid.first).tolist()
    ]


def seams_present(grid: TileGrid) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Tell which seams have a tile, by column and row of their first corner: (nx, ny + 1) and (nx + 1, ny)."""
    there = np.pad(tiles_present(grid), 1)
    return there[1:-1, 1:] | there[1:-1, :-1], there[1:, 1:-1] | there[:-1, 1:-1]


def tiles_of_seam(seam: SeamKey) -> tuple[Key, Key]:
    """Tiles on both sides of a seam: below or left of it, then above or right."""
    axis, i, j = seam
    return Key(i - axis, j - (1 - axis)), Key(i, j)


def tiles_of_corner(corner: Key) -> tuple[Key, Key, Key, Key]:
    """Tiles around a corner: upper right, upper left, lower left, lower right."""
    i, j = corner
    return Key(i, j), Key(i - 1, j), Key(i - 1, j - 1), Key(i, j - 1)


def seams_of_tile(tile: Key) -> tuple[SeamKey, SeamKey, SeamKey, SeamKey]:
    """Seams of a tile: south, east, north, west. Counter-clockwise, the last two are passed backwards."""
    i, j = tile
    return SeamKey(0, i, j), SeamKey(1, i + 1, j), SeamKey(0, i, j + 1), SeamKey(1, i, j)


def ends_of_seam(seam: SeamKey) -> tuple[Key, Key]:
    """Corners where a seam starts and ends."""
    axis, i, j = seam
    return Key(i, j), Key(i + (axis == 0), j + (axis == 1))


def nominal_corner(grid: TileGrid, corner: Key) -> tuple[float, float]:
    """Place where the lines of a corner cross (m)."""
    i, j = corner
    return float(grid.lines[0][i - grid.first.i]), float(grid.lines[1][j - grid.first.j])


def closest_line(grid: TileGrid, corner: Key) -> float:
    """Distance from a corner to the next one, a tile at most (m).

    Corners within the region do not look at it: they have a tile, so that no border matters to them, and
    only where outer tiles are narrow, those on the border have less.
    """
    at = corner.i - grid.first.i, corner.j - grid.first.j
    if all(0 < k < len(axis) - 1 for k, axis in zip(at, grid.lines, strict=True)):
        return grid.tile_size
    steps = [np.diff(axis)[max(k - 1, 0) : k + 1].min() for k, axis in zip(at, grid.lines, strict=True)]
    return float(min(*steps, grid.tile_size))


def is_pinched(grid: TileGrid, corner: Key) -> bool:
    """Tell whether two tiles meet in a corner alone, the other two around it being absent."""
    upper_right, upper_left, lower_left, lower_right = (has_tile(grid, tile) for tile in tiles_of_corner(corner))
    return upper_right == lower_left != upper_left == lower_right


def is_border(grid: TileGrid, seam: SeamKey) -> bool:
    """Tell whether a seam is a part of the region's border: a tile on one side only."""
    return not all(has_tile(grid, tile) for tile in tiles_of_seam(seam))


def seam_bounds(grid: TileGrid, seam: SeamKey) -> Bounds:
    """Box that the strip of a seam may not leave: the region's, at its border cut along the line (m)."""
    box = list(grid.bounds)
    line = seam_line(grid, seam)
    across = 1 - seam.axis
    before, after = (has_tile(grid, tile) for tile in tiles_of_seam(seam))
    if not before:
        box[across] = line[across]
    if not after:
        box[across + 2] = line[across]
    return box[0], box[1], box[2], box[3]


def corner_reach(tile_size: float) -> float:
    """How far a corner may be from its nominal place (m)."""
    return min(CORNER_REACH, CORNER_SHARE * tile_size)


def band_width(tile_size: float, open_size: float = 0.0) -> float:
    """How far a seam may be from its nominal line (m), see `TileGrid.open_size`."""
    return min(max(BAND, OPEN_BAND * open_size), BAND_SHARE * tile_size)


def _axis_lines(low: float, high: float, size: float) -> tuple[int, NDArray[np.float64]]:
    first, last = math.ceil(low / size + 0.5), math.floor(high / size - 0.5)
    if first > last:
        return math.floor((low + high) / 2 / size), np.array([low, high])
    inner = np.arange(first, last + 1) * size
    return first - 1, np.concatenate(([low], inner, [high]))
