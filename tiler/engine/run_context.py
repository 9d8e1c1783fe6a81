"""What every task of a run knows besides its own item: region, CRS, tile grid; and the names of items."""

import zlib
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import starmap

import numpy as np
import shapely
from numpy.typing import NDArray

from stitch.tiling.grid import (
    Bounds,
    Key,
    SeamKey,
    TileGrid,
    has_tile,
    make_grid,
    seams_present,
    tile_box,
    tiles_present,
)
from tiler.engine.stage import Box, FileItem, Layout

SHARED = 1e-6  # m that a point cloud must reach into a tile
NEAR = 2.0  # tile sizes; how far from its extent a tile or seam looks for other tiles, see `region_around`
AXES = "xy"  # first letter of a seam's name: along which axis it runs


@dataclass(frozen=True)
class RunContext:
    """The region of a run: small, and the same for all tasks."""

    bounds: Bounds  #: (xmin, ymin, xmax, ymax): the region (m)
    crs: str  #: its CRS as ``EPSG:NNNN`` where it has a code, else as WKT
    #: side of a tile and target edge length (m)
    tile_size: float
    mesh_size: float
    present: bytes  #: which tiles there are, see `pack_tiles`
    open_size: float = 0.0  #: largest target edge length (m) where sizes are graded, else 0

    @property
    def grid(self) -> TileGrid:
        """The tile grid."""
        return _grid(self.bounds, self.tile_size, self.mesh_size, self.open_size, self.present)


def choose_tiles(grid: TileGrid, boxes: list[Box]) -> TileGrid:
    """Leave out the tiles that share no area with any of the boxes of point clouds.

    Notes
    -----
    The tiles that a box meets are a rectangle of columns and rows; rectangles are laid over each other as the sums
    of their four corners: O(boxes + tiles).
    """
    low, high = np.array(boxes, np.float64).reshape(-1, 2, 2).transpose(1, 2, 0)
    ends = []
    for axis, lines in enumerate(grid.lines):
        first = np.searchsorted(lines[1:] - SHARED, low[axis], side="left")
        last = np.searchsorted(lines[:-1] + SHARED, high[axis], side="right")
        ends.append((first, np.maximum(first, last)))
    corners = np.zeros([len(axis) for axis in grid.lines], np.int64)
    for a in (0, 1):
        for b in (0, 1):
            np.add.at(corners, (ends[0][a], ends[1][b]), 1 if a == b else -1)
    present = (corners.cumsum(axis=0).cumsum(axis=1) > 0)[:-1, :-1]
    return replace(grid, present=None if present.all() else present)


def absent_tiles(grid: TileGrid) -> list[Key]:
    """List the tiles of the region's box that are absent."""
    return list(starmap(Key, (np.argwhere(~tiles_present(grid)) + grid.first).tolist()))


def pack_tiles(grid: TileGrid) -> bytes:
    """Write which tiles are present in few bytes; none where all are."""
    return b"" if grid.present is None else zlib.compress(np.packbits(grid.present).tobytes())


def make_layout(grid: TileGrid, files: dict[str, FileItem], *, identity: str) -> Layout:
    """List the items of a run: files, tiles, and seams with the box of their nominal line."""
    tiles = np.argwhere(tiles_present(grid))
    own = _named_boxes(grid, "", tiles, tiles + 1)
    names = {name: name for name in own}
    seams: dict[str, Box] = {}
    owners: dict[str, str] = {}
    for axis, there in enumerate(seams_present(grid)):
        at = np.argwhere(there)
        along = np.eye(2, dtype=np.int64)[axis]
        here = _named_boxes(grid, AXES[axis], at, at + along)
        # A tile owns its southern and its western seam, and one towards no tile.
        before = (at - along[::-1] + grid.first).tolist()
        for name, (i, j) in zip(here, before, strict=True):
            owners[name] = names.get(name[1:]) or names[f"{i}_{j}"]
        seams |= here
    return Layout(
        files=files,
        tiles=own,
        seams=seams,
        owners=owners,
        bounds=grid.bounds,
        identity=identity,
        absent=tuple(tile_box(grid, key) for key in absent_tiles(grid)),
        near=NEAR * grid.tile_size,
    )


def tile_name(key: Key) -> str:
    """Name of a tile: its column and row in the CRS.

    Examples
    --------
    >>> tile_name(Key(60, -3)), tile_key("60_-3")
    ('60_-3', Key(i=60, j=-3))
    """
    return f"{key.i}_{key.j}"


def tile_key(name: str) -> Key:
    """Key of a tile's name."""
    i, j = name.split("_")
    return Key(int(i), int(j))


def seam_name(key: SeamKey) -> str:
    """Name of a seam: the axis along which it runs, and its first corner.

    Examples
    --------
    >>> seam_name(SeamKey(1, 3, 4)), seam_key("y3_4")
    ('y3_4', SeamKey(axis=1, i=3, j=4))
    """
    return f"{AXES[key.axis]}{key.i}_{key.j}"


def seam_key(name: str) -> SeamKey:
    """Key of a seam's name."""
    i, j = name[1:].split("_")
    return SeamKey(AXES.index(name[0]), int(i), int(j))


def find_owned(box: Box, bounds: Bounds, xy: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which places are a tile's own: in its half-open box, places beyond the region taken to its border.

    Parameters
    ----------
    box, bounds : (xmin, ymin, xmax, ymax)
        The tile and the region (m).
    xy : float64, (n, 2)
        Places (m); one that is NaN is nobody's.

    Examples
    --------
    >>> find_owned((1.0, 0.0, 2.0, 1.0), (0.0, 0.0, 2.0, 1.0), np.array([[0.9, 0.5], [1.0, 0.5], [7.0, 1.0]]))
    array([False,  True,  True])
    """
    own = np.ones(len(xy), np.bool_)
    for k in range(2):
        place = np.clip(xy[:, k], bounds[k], bounds[k + 2])
        own &= place >= box[k]
        own &= place <= box[k + 2] if box[k + 2] >= bounds[k + 2] else place < box[k + 2]
    return own


def region_around(grid: TileGrid, box: Box) -> shapely.Geometry:
    """Polygon of the tiles that are present in a box, and a tile beyond it (m)."""
    far = 1.5 * grid.tile_size
    x, y = grid.lines
    columns = np.flatnonzero((x[1:] >= box[0] - far) & (x[:-1] <= box[2] + far))
    rows = np.flatnonzero((y[1:] >= box[1] - far) & (y[:-1] <= box[3] + far))
    keys = [Key(grid.first.i + int(i), grid.first.j + int(j)) for i in columns for j in rows]
    return shapely.union_all([shapely.box(*tile_box(grid, key)) for key in keys if has_tile(grid, key)])


def _named_boxes(grid: TileGrid, prefix: str, low: NDArray[np.int64], high: NDArray[np.int64]) -> dict[str, Box]:
    """Name the boxes between lines by column and row of their first corner."""
    x, y = grid.lines
    names = [f"{prefix}{i}_{j}" for i, j in (low + grid.first).tolist()]
    sides = (x[low[:, 0]].tolist(), y[low[:, 1]].tolist(), x[high[:, 0]].tolist(), y[high[:, 1]].tolist())
    return dict(zip(names, zip(*sides, strict=True), strict=True))


@lru_cache(maxsize=8)
def _grid(bounds: Bounds, tile_size: float, mesh_size: float, open_size: float, present: bytes) -> TileGrid:
    grid = make_grid(bounds, tile_size=tile_size, mesh_size=mesh_size, open_size=open_size)
    if not present:
        return grid
    shape = tuple(len(axis) - 1 for axis in grid.lines)
    bits = np.unpackbits(np.frombuffer(zlib.decompress(present), np.uint8), count=shape[0] * shape[1])
    return replace(grid, present=bits.astype(np.bool_).reshape(shape))
