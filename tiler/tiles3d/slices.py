"""Slices through the volume mesh for tiles: at a height above the ground, or upright along a line, by cells."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TypedDict

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pipeline.data.errors import ConfigError
from pipeline.data.mesh import TetMesh, is_ground
from pipeline.quality.quality import measure_cells
from tiler.mesh_files.mesh_pieces import MeshPiece, MeshPieces
from tiler.tiles3d.content import Surface
from tiler.tiles3d.globe import Array
from tiler.tiles3d.gltf import CELLS

ROW = 10  # numbers of a triangle of a slice as it waits: corners, quality of its cell


@dataclass(frozen=True)
class Slice:
    """Where the mesh is cut: ``height`` (m) above the ground, or upright from one place in the CRS to another."""

    option: str
    height: float = 0.0
    line: tuple[float, float, float, float] | None = None


class SliceWords(TypedDict, total=False):
    """Where the volume mesh is cut: parameters of `make_slices` by the names of their options."""

    slice_height: Sequence[float]
    slice_line: Sequence[str]


def make_slices(heights: list[float], lines: list[str]) -> list[Slice]:
    """Read slices of the command line; ConfigError if a height is not above the ground, or a line is none."""
    for height in heights:
        if not 0 < height < np.inf:
            raise ConfigError(f"--slice-height {height:g} m: more than 0 expected")
    found = [Slice(f"--slice-height {height:g}", height=height) for height in heights]
    for text in lines:
        try:
            x, y, u, v = (float(word) for word in text.split(","))
        except ValueError:
            raise ConfigError(f"--slice-line {text}: four numbers X0,Y0,X1,Y1 expected") from None
        if not 0 < np.hypot(u - x, v - y) < np.inf:
            raise ConfigError(f"--slice-line {text}: two different places expected")
        found.append(Slice(f"--slice-line {text}", line=(x, y, u, v)))
    return found


def cut_pieces(pieces: MeshPieces, slices: list[Slice]) -> Iterator[Array]:
    """Cut all pieces of a mesh, one after the other; gives rows (k, `ROW`) of triangles.

    Raises
    ------
    ConfigError
        In the end, if a slice meets no cell.
    """
    found = dict.fromkeys(slices, 0)
    for k in range(len(pieces.names) if slices else 0):
        piece = pieces.read(k)
        quality = measure_cells(TetMesh(piece.points, piece.cells)).radius_ratio
        for one in slices:
            if one.line is None:
                corners, cell = cut_cells(piece.points, piece.cells, _levels(one, piece))
            else:
                corners, cell = cut_along(one.line, piece.points, piece.cells)
            found[one] += len(cell)
            yield np.column_stack((corners.reshape(-1, ROW - 1), quality[cell]))
    for one, n in found.items():
        if not n:
            raise ConfigError(f"{one.option}: meets no cell of the mesh; give another, in metres of its CRS")


def cut_along(
    line: tuple[float, float, float, float], points: Array, cells: NDArray[np.int32]
) -> tuple[Array, NDArray[np.int64]]:
    """Cut tetrahedra upright from one place in the CRS to another; see `cut_cells`."""
    start, way = np.array(line[:2]), np.subtract(line[2:], line[:2])
    away = points[:, :2] - start
    corners, cell = cut_cells(points, cells, (away[:, 0] * way[1] - away[:, 1] * way[0]) / np.hypot(*way))
    along = ((corners.mean(axis=1)[:, :2] - start) * way).sum(axis=1) / (way**2).sum()
    kept = (along >= 0) & (along <= 1)
    return corners[kept], cell[kept]


def _levels(one: Slice, piece: MeshPiece) -> Array:
    """Give the height of each point (n,) above a slice that follows the ground (m)."""
    ground = piece.points[np.unique(piece.facets[is_ground(piece.marker)])]
    if not len(ground):
        return np.ones(len(piece.points))
    # Above roofs the ground is that of the nearest place that has some.
    below = ground[cKDTree(ground[:, :2]).query(piece.points[:, :2])[1], 2]
    above: Array = piece.points[:, 2] - below - one.height
    return above


def cut_cells(points: Array, cells: NDArray[np.int32], level: Array) -> tuple[Array, NDArray[np.int64]]:
    """Cut tetrahedra where a level, linear in each, is 0.

    Parameters
    ----------
    points : float64, (n, 3)
        Points.
    cells : int32, (m, 4)
        Tetrahedra.
    level : float64, (n,)
        Level at each point; 0 counts as above.

    Returns
    -------
    float64, (k, 3, 3)
        Corners of triangles; four corners make two.
    int64, (k,)
        The cell of each.

    Examples
    --------
    >>> points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    >>> corners, cell = cut_cells(points, np.array([[0, 1, 2, 3]]), points[:, 2] - 0.5)
    >>> corners.tolist(), cell.tolist()
    ([[[0.0, 0.0, 0.5], [0.5, 0.0, 0.5], [0.0, 0.5, 0.5]]], [0])
    """
    above = level[cells] >= 0
    n_above = above.sum(axis=1)
    found, of = [np.empty((0, 3, 3))], [np.empty(0, np.int64)]
    for n in (1, 2, 3):
        rows = np.flatnonzero(n_above == n)
        # Those below first, so that the edges that are cut have fixed places.
        order = np.argsort(above[rows], axis=1, kind="stable")
        corner = np.take_along_axis(cells[rows], order, axis=1)
        pairs = [(a, b) for a in range(4 - n) for b in range(4 - n, 4)]
        if n == 2:  # around the four-sided cut
            pairs = [pairs[0], pairs[1], pairs[3], pairs[2]]
        cut = np.stack([_between(points, level, corner[:, a], corner[:, b]) for a, b in pairs], axis=1)
        for triangle in ((0, 1, 2),) if n != 2 else ((0, 1, 2), (0, 2, 3)):
            found.append(cut[:, triangle])
            of.append(rows)
    return np.concatenate(found), np.concatenate(of)


def _between(points: Array, level: Array, a: NDArray[np.int32], b: NDArray[np.int32]) -> Array:
    """Give the places (n, 3) between points where the level is 0."""
    share = level[a] / (level[a] - level[b])
    return points[a] + share[:, np.newaxis] * (points[b] - points[a])


def slice_surface(rows: Array) -> tuple[Surface, NDArray[np.float32]]:
    """Make a surface of triangles of slices (k, `ROW`), each a feature with the quality of its cell."""
    n = len(rows)
    xyz = rows[:, : ROW - 1].reshape(-1, 3)
    surface = Surface(xyz, np.arange(3 * n).reshape(n, 3), np.full(n, CELLS), np.repeat(np.arange(n), 3))
    return surface, rows[:, -1].astype(np.float32)
