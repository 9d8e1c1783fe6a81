"""The clusters of a region as rows that lie by the tile that owns them, so that a tile reads its own alone."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stitch.tiling.grid import Key


def pack_clusters(
    house: NDArray[np.int64], cluster: NDArray[np.int64], changed: NDArray[np.bool_]
) -> dict[str, NDArray[np.int64]]:
    """Sort the houses of clusters by the tiles that own these: the tile of a cluster's first house.

    Parameters
    ----------
    house : int64, (n, 3)
        Column and row of each house's tile, and its place in it; ascending, places from 0 without gaps.
    cluster : int64, (n,)
        Row of the first house of each house's cluster.
    changed : bool, (n,)
        Whether the cluster is new.

    Returns
    -------
    dict
        ``owned``, int64, (n, 5): house as given, place of its cluster's first house in the owner, and ``changed``;
        those of one owner in the order in which they were given. ``grid``, int64, (4,): first column and row, and
        number of columns and rows, of a rectangle that has all tiles. ``start``, int64, (columns * rows + 1,):
        rows of the tile at place k of it, see `place_in_grid`, are ``start[k]:start[k + 1]``.
    """
    tile = house[:, :2]
    low = tile.min(axis=0) if len(tile) else np.zeros(2, np.int64)
    shape = tile.max(axis=0) - low + 1 if len(tile) else np.zeros(2, np.int64)
    grid = np.concatenate((low, shape))
    owner = _places(grid, tile[cluster])
    order = np.argsort(owner, kind="stable")
    owned = np.column_stack((house, house[cluster, 2], changed))[order].astype(np.int64)
    start = np.concatenate(([0], np.cumsum(np.bincount(owner, minlength=int(shape.prod())))))
    return {"owned": owned, "grid": grid, "start": start.astype(np.int64)}


def unpack_clusters(arrays: Mapping[str, NDArray[Any]]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Bring ``house`` and ``cluster`` back into the order in which `pack_clusters` was given them."""
    owned, grid = arrays["owned"], arrays["grid"]
    owner = np.repeat(np.arange(len(arrays["start"]) - 1), np.diff(arrays["start"]))
    order = np.lexsort((owned[:, 2], owned[:, 1], owned[:, 0]))
    house = owned[order, :3]
    first = np.searchsorted(_places(grid, house[:, :2]), owner)
    return house, (first + owned[:, 3])[order]


def place_in_grid(grid: NDArray[np.int64], tile: Key) -> int:
    """Place of a tile in the rectangle of `pack_clusters`; -1 if it lies outside.

    Examples
    --------
    >>> grid = np.array([10, -3, 2, 4])
    >>> place_in_grid(grid, Key(11, -2)), place_in_grid(grid, Key(12, -2))
    (5, -1)
    """
    i, j = tile.i - int(grid[0]), tile.j - int(grid[1])
    return i * int(grid[3]) + j if 0 <= i < grid[2] and 0 <= j < grid[3] else -1


def _places(grid: NDArray[np.int64], tiles: NDArray[np.int64]) -> NDArray[np.int64]:
    i, j = (tiles - grid[:2]).T
    places: NDArray[np.int64] = i * grid[3] + j
    return places
