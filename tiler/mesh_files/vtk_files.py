"""VTK's XML files of a mesh and its boundary, written and read by hand (step 3.6).

Arrays are appended raw in zlib blocks, little-endian, so a file streams to disk and no array is ever held
twice. ParaView and vtk read all four kinds, meshio the volume.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache, partial
from pathlib import Path, PurePath
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from pipeline.data.errors import InputError
from pipeline.data.mesh import Boundary, TetMesh
from tiler.mesh_files.vtk_xml import (
    INDEX_BYTES,
    THOROUGH,
    Stream,
    compress_block,
    damaged,
    opened,
    parse_xml,
    read_data_file,
    stream_items,
    write_data_file,
    write_index,
)

TETRA = 10  # VTK_TETRA
KEPT_ROWS = 1 << 24  # whose offsets are kept once they are compressed: 20 MB where a piece has so many cells
Arrays = Mapping[str, NDArray[Any]]
NO_ARRAYS: Arrays = {}


@dataclass(frozen=True, eq=False)
class Rows:
    """An array on its way to a file, some rows of it at a time."""

    #: number of rows, and of numbers in each
    n_rows: int
    width: int
    dtype: np.dtype[Any]  #: their type
    #: ``make(i, j)`` makes the rows ``i`` to before ``j``: (j - i,) or (j - i, width). A row in which a block of
    #: the file ends is asked for twice: none, where the width is a power of two
    make: Callable[[int, int], NDArray[Any]]

    @classmethod
    def of(cls, array: NDArray[Any]) -> Self:
        """Take the rows of an array (n,) or (n, width)."""
        width = array.shape[1] if array.ndim == 2 else 1
        return cls(len(array), width, array.dtype, lambda i, j: array[i:j])


@dataclass(frozen=True, eq=False)
class Values:
    """What points have, made for those of them that are asked for."""

    width: int  #: numbers of each point
    dtype: np.dtype[Any]  #: their type
    take: Callable[[NDArray[Any]], NDArray[Any]]  #: ``take(index)`` makes those of some points: (k,) or (k, width)

    def rows(self, n_rows: int, index: Callable[[int, int], NDArray[Any]]) -> Rows:
        """Make rows of them: those of the points ``index(i, j)`` are rows ``i`` to before ``j``."""
        return Rows(n_rows, self.width, self.dtype, lambda i, j: self.take(index(i, j)))


RowArrays = Mapping[str, Rows]
ValueArrays = Mapping[str, Values]


@dataclass(frozen=True, eq=False)
class VolumePiece:
    """What a VTU file holds."""

    mesh: TetMesh  #: its points and cells
    #: its further arrays
    point_data: Arrays
    cell_data: Arrays


@dataclass(frozen=True, eq=False)
class BoundaryPiece:
    """What a VTP file holds."""

    points: NDArray[np.float64]  #: (n, 3): the vertices that facets use (m)
    boundary: Boundary  #: facets as indices of `points`, with their marks
    vertex: NDArray[np.int64]  #: (n,): index of each point among the points of the volume mesh
    point_data: Arrays  #: further arrays
    cell_data: Arrays = field(default_factory=dict)  #: further arrays of facets


def write_vtu_blocks(
    path: Path, points: Rows, cells: Rows, *, point_data: RowArrays, cell_data: RowArrays
) -> None:
    """Write a volume mesh as a VTU file, with points and cells that are made a block at a time.

    Parameters
    ----------
    path : Path
        The file; it appears whole or not at all.
    points : Rows
        Coordinates, float64 (n, 3) (m).
    cells : Rows
        Tetrahedra, int32 (m, 4), indices of the points. Each is asked for once, in their order, 16,384 at a time.
    point_data, cell_data : mapping of name to Rows
        Further arrays, of n and m rows.

    Raises
    ------
    OutputError
        If the file cannot be written.
    """
    sections = {
        "Points": [_stream("Points", points)],
        "Cells": [*_connectivity(cells, points.n_rows), stream_types(cells.n_rows)],
        "PointData": [_stream(name, rows) for name, rows in point_data.items()],
        "CellData": [_stream(name, rows) for name, rows in cell_data.items()],
    }
    counts = {"NumberOfPoints": points.n_rows, "NumberOfCells": cells.n_rows}
    write_data_file(path, "UnstructuredGrid", counts, sections)


def write_vtp_blocks(
    path: Path,
    n_points: int,
    boundary: Boundary,
    points: Values,
    *,
    point_data: ValueArrays,
    cell_data: Arrays = NO_ARRAYS,
) -> None:
    """Write the boundary of a volume mesh as a VTP file, with points that are made a block at a time.

    Parameters
    ----------
    path : Path
        The file; it appears whole or not at all.
    n_points : int
        Number of what facets may refer to.
    boundary : Boundary
        Marked facets; `marker` and `building` become cell arrays.
    points : Values
        Coordinates, float64, three of each point (m).
    point_data : mapping of name to Values
        All arrays of points; `read_vtp` wants ``vertex``, each point's index in the volume mesh.
    cell_data : mapping of name to array
        Further arrays of facets.

    Raises
    ------
    OutputError
        If the file cannot be written.
    """
    local = np.zeros(n_points, np.int32 if n_points < 2**31 else np.int64)
    local[boundary.facets.ravel()] = 1
    used = np.flatnonzero(local)
    np.cumsum(local, out=local)
    n_used, facets = len(used), boundary.facets
    polygons = Rows(len(facets), 3, local.dtype, lambda i, j: local[facets[i:j]] - 1)
    marks: Arrays = {
        "marker": boundary.marker.astype(np.int32, copy=False),
        "building": boundary.building.astype(np.int64, copy=False),
        **cell_data,
    }
    named = {"Points": points, **point_data}
    streams = [_stream(name, values.rows(n_used, lambda i, j: used[i:j])) for name, values in named.items()]
    sections = {
        "Points": streams[:1],
        "Polys": _connectivity(polygons, n_used),
        "PointData": streams[1:],
        "CellData": [_stream(name, Rows.of(array)) for name, array in marks.items()],
    }
    counts = {"NumberOfPoints": n_used, "NumberOfVerts": 0, "NumberOfLines": 0}
    counts |= {"NumberOfStrips": 0, "NumberOfPolys": len(facets)}
    write_data_file(path, "PolyData", counts, sections)


def write_pvtu(path: Path, pieces: Sequence[Path]) -> None:
    """Write the index file over VTU pieces; see `write_pvtp`."""
    write_index(path, pieces, "UnstructuredGrid")


def write_pvtp(path: Path, pieces: Sequence[Path]) -> None:
    """Write the index file over VTP pieces.

    Parameters
    ----------
    path : Path
        The index file; pieces are named relative to its folder, so the whole can be moved.
    pieces : sequence of at least one Path
        Existing pieces. Their declarations of arrays must agree: the index repeats them.

    Raises
    ------
    InputError
        If a piece cannot be read or declares other arrays than the first.
    ValueError
        If there is no piece.
    """
    write_index(path, pieces, "PolyData")


def read_vtu(path: Path) -> VolumePiece:
    """Read a VTU file that `write_vtu_blocks` wrote.

    Raises
    ------
    InputError
        If the file is missing or damaged, or holds something else than tetrahedra.
    """
    sections = read_data_file(path, "UnstructuredGrid")
    points, cells = sections["Points"]["Points"], sections["Cells"]
    rows = _read_rows(path, cells, 4, len(points))
    if "types" not in cells or np.any(cells["types"] != TETRA):
        raise damaged(path, "it holds cells that are no tetrahedra")
    return VolumePiece(TetMesh(points, rows), sections["PointData"], sections["CellData"])


def read_vtp(path: Path) -> BoundaryPiece:
    """Read a VTP file that `write_vtp_blocks` wrote.

    Raises
    ------
    InputError
        If the file is missing or damaged, lacks `marker`, `building` or `vertex`, or has a coordinate
        that is not finite.
    """
    sections = read_data_file(path, "PolyData")
    points, marks, point_data = sections["Points"]["Points"], sections["CellData"], sections["PointData"]
    facets = _read_rows(path, sections["Polys"], 3, len(points))
    if not np.isfinite(points).all():
        raise damaged(path, "a coordinate is not finite")
    for name, arrays in (("marker", marks), ("building", marks), ("vertex", point_data)):
        if name not in arrays or arrays[name].ndim != 1:
            raise damaged(path, f"the array {name!r} is missing")
    boundary = Boundary(
        facets,
        marks["marker"].astype(np.int32, copy=False),
        marks["building"].astype(np.int64, copy=False),
    )
    rest = {name: array for name, array in point_data.items() if name != "vertex"}
    more = {name: array for name, array in marks.items() if name not in ("marker", "building")}
    return BoundaryPiece(points, boundary, point_data["vertex"].astype(np.int64, copy=False), rest, more)


def read_piece_paths(path: Path) -> list[Path]:
    """Read which pieces an index file (PVTU or PVTP) names, in its order.

    Raises
    ------
    InputError
        If the index file is missing or damaged, or if a piece is missing.
    """
    with opened(path) as file:
        text = file.read(INDEX_BYTES)
    root = parse_xml(path, text)
    sources = [PurePath(element.get("Source", "")) for element in root.findall("./*/Piece")]
    if not sources:
        raise damaged(path, "it names no piece")
    for source in sources:
        if source.is_absolute() or ".." in source.parts:
            raise damaged(path, f"the piece {source} lies outside its folder")
    pieces = [path.parent / source for source in sources]
    for piece in pieces:
        if not piece.is_file():
            raise InputError(f"{path}: the piece {piece} is missing; run the tile again")
    return pieces


def _connectivity(rows: Rows, n_points: int) -> list[Stream]:
    index = np.dtype(np.int32 if n_points < 2**31 else np.int64)
    flat = stream_items("connectivity", index, 1, rows.n_rows * rows.width, _items(rows))
    return [flat, stream_offsets(rows.n_rows, rows.width)]


def _stream(name: str, rows: Rows) -> Stream:
    return stream_items(name, rows.dtype, rows.width, rows.n_rows * rows.width, _items(rows))


def _items(rows: Rows) -> Callable[[int, int], NDArray[Any]]:
    """Make numbers ``i`` to before ``j`` of all that rows have, whichever rows these are in."""

    def items(i: int, j: int) -> NDArray[Any]:
        first = i // rows.width
        made = rows.make(first, -(-j // rows.width)).reshape(-1)
        return made[i - first * rows.width : j - first * rows.width]

    return items


def stream_offsets(n_rows: int, width: int) -> Stream:
    """Make the stream of where rows of so many numbers end in the connectivity."""
    dtype = np.dtype(np.int32 if n_rows * width < 2**31 else np.int64)
    return Stream("offsets", dtype, 1, n_rows, partial(partial, _give_ends, width, dtype, n_rows))


def _give_ends(width: int, dtype: np.dtype[Any], n_rows: int, i: int, j: int) -> bytes:
    """Give a block of offsets: all but the last are the same in every piece, and the first of these are kept."""
    kept = j < n_rows and j <= KEPT_ROWS
    return _kept_ends(width, dtype, i, j) if kept else _compress_ends(width, dtype, i, j)


def _compress_ends(width: int, dtype: np.dtype[Any], i: int, j: int) -> bytes:
    return compress_block(np.arange(i + 1, j + 1, dtype=np.int64) * width, dtype, level=THOROUGH)


_kept_ends = lru_cache(maxsize=None)(_compress_ends)


def stream_types(n_cells: int) -> Stream:
    """Make the stream of the types of tetrahedra."""
    return Stream("types", np.dtype(np.uint8), 1, n_cells, lambda i, j: partial(_compress_types, j - i))


@lru_cache(maxsize=2)  # a full block, and the last one
def _compress_types(n_cells: int) -> bytes:
    return compress_block(np.full(n_cells, TETRA, np.uint8), np.dtype(np.uint8))


def _read_rows(path: Path, arrays: Arrays, width: int, n_points: int) -> NDArray[np.int32]:
    """Check that the rows have `width` indices each, all of them of points, and return them."""
    if not {"connectivity", "offsets"} <= arrays.keys():
        raise damaged(path, "no connectivity")
    flat, offsets = arrays["connectivity"], arrays["offsets"]
    if len(offsets) and not (offsets[0] == width and (np.diff(offsets) == width).all()):
        raise damaged(path, f"cells that have not {width} vertices")
    if flat.size and (flat.min() < 0 or flat.max() >= n_points):
        raise damaged(path, f"vertex {flat.min()}..{flat.max()} of {n_points} points")
    if n_points >= 2**31:
        raise damaged(path, f"{n_points} points; a piece has fewer than 2**31")
    return flat.astype(np.int32, copy=False).reshape(-1, width)
