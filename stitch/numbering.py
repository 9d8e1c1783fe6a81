"""Region-wide numbers of points: a point has one number, whichever tile writes it (step 3.6).

Points are numbered by parts: the column of each corner, the columns of each seam between its corners, what is left
of each tile. A part's numbers follow each other, column by column from below; the parts follow each other in one
order for the whole region. So a tile needs to know where its parts begin, and nothing else of the others.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.mesh import ColumnMesh
from pipeline.nodes import Levels
from stitch.grid import Key, SeamKey, TileGrid


@dataclass(frozen=True, eq=False)
class SeamNumbers:
    """Where the points of a seam begin.

    Attributes
    ----------
    vertex : int32, (k,)
        The seam's vertices in the tile's plane mesh, from its first corner to its last.
    first : (int, int, int)
        Numbers of the lowest points of its first corner, of its second vertex, of its last corner.
    """

    vertex: NDArray[np.int32]
    first: tuple[int, int, int]


def count_parts(grid: TileGrid) -> int:
    """Count the parts of a region, absent ones and borders included, which have no points of their own."""
    nx, ny = _size(grid)
    return (nx + 1) * (ny + 1) + nx * (ny + 1) + (nx + 1) * ny + nx * ny


def corner_part(grid: TileGrid, key: Key) -> int:
    """Place of a corner among the parts: corners first, then seams, then tiles; it follows from the key alone."""
    _, ny = _size(grid)
    return (key.i - grid.first.i) * (ny + 1) + key.j - grid.first.j


def seam_part(grid: TileGrid, key: SeamKey) -> int:
    """Place of a seam among the parts."""
    nx, ny = _size(grid)
    i, j = key.i - grid.first.i, key.j - grid.first.j
    before = (nx + 1) * (ny + 1)
    return before + i * (ny + 1) + j if key.axis == 0 else before + nx * (ny + 1) + i * ny + j


def tile_part(grid: TileGrid, key: Key) -> int:
    """Place of a tile among the parts."""
    nx, ny = _size(grid)
    return count_parts(grid) - nx * ny + (key.i - grid.first.i) * ny + key.j - grid.first.j


def count_points(levels: Levels) -> tuple[int, int, int]:
    """Count the points of a seam's columns: of its first corner, between its corners, of its last corner."""
    start = levels.start
    return int(start[1] - start[0]), int(start[-2] - start[1]), int(start[-1] - start[-2])


def count_inner_points(mesh: ColumnMesh, seams: Sequence[NDArray[np.int32]]) -> int:
    """Count the points of a tile that no seam within the region has; `seams` are their vertices in its mesh."""
    vertex = np.unique(np.concatenate([np.empty(0, np.int32), *seams]))
    return int(len(mesh.z) - np.diff(mesh.z_start)[vertex].sum())


def make_offsets(counts: Sequence[int]) -> NDArray[np.int64]:
    """Find where each part begins, and at last how many points there are.

    Parameters
    ----------
    counts : sequence of p int
        Points of each part, by its place. A tile that is missing has 0.

    Returns
    -------
    int64, (p + 1,)
        The lowest number of each part, and the number of all points.

    Examples
    --------
    >>> make_offsets([2, 5, 0, 3])
    array([ 0,  2,  7,  7, 10])
    """
    return np.concatenate(([0], np.cumsum(counts))).astype(np.int64)


def number_points(mesh: ColumnMesh, seams: Sequence[SeamNumbers], first: int) -> NDArray[np.int64]:
    """Give the points of a tile their region-wide numbers.

    Parameters
    ----------
    mesh : ColumnMesh
        The tile's mesh.
    seams : sequence of SeamNumbers
        Its seams within the region.
    first : int
        Where the tile's own points begin.

    Returns
    -------
    int64, (n_points,)
        Number of each point, in the order of `expand_cells`.

    Raises
    ------
    ValueError
        If two seams number a corner differently.

    Notes
    -----
    Numbers are without gaps over all tiles where every level of a seam has a cell on it, and none is missing.
    """
    count = np.diff(mesh.z_start)
    begin = np.full(len(count), -1, np.int64)
    for seam in seams:
        inner = count[seam.vertex[1:-1]]
        starts = np.concatenate(([seam.first[0]], seam.first[1] + np.cumsum(inner) - inner, [seam.first[2]]))
        old = begin[seam.vertex]
        if ((old >= 0) & (old != starts)).any():
            raise ValueError("two seams of a tile number a corner differently")
        begin[seam.vertex] = starts
    own = begin < 0
    begin[own] = first + np.cumsum(count[own]) - count[own]
    numbers: NDArray[np.int64] = np.arange(len(mesh.z)) - np.repeat(mesh.z_start[:-1] - begin, count)
    return numbers


def _size(grid: TileGrid) -> tuple[int, int]:
    return len(grid.lines[0]) - 1, len(grid.lines[1]) - 1
