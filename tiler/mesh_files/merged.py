"""One file of all pieces: the volume mesh and its boundary of a whole region, streamed (step 3.6).

Pieces are files already. Each has a point array of region-wide ids, by which a vertex that several pieces have is
written once, as what it is when all ids are counted from 0 on.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.data.errors import InputError
from pipeline.data.mesh import TetMesh
from pipeline.quality.quality import measure_cells
from stitch.pieces.numbering import Numbering, collect_ids, number_without_gaps
from tiler.mesh_files.vtk_files import stream_offsets, stream_types
from tiler.mesh_files.vtk_xml import (
    Sections,
    Stream,
    read_data_file,
    read_point_array,
    stream_items,
    write_data_file,
)
from tiler.store.atomic import disk_errors

VERTEX_ID = "vertex_id"  # point array of a piece: its points' region-wide ids, see `stitch.pieces.numbering`
TILE = "tile"  # cell array on request: which tile a cell is of, counted from 0 by name
RADIUS_RATIO = "radius_ratio"  # cell array on request
INDEX = "index"  # cell array on request: a facet's building, counted from 0 by number, -1 for none
CHUNK = 1 << 20  # vertices that are moved at once
Place = tuple[float, float, float]
NO_PLACE = (0.0, 0.0, 0.0)
Reader = Callable[[int], dict[str, dict[str, NDArray[Any]]]]


@dataclass(frozen=True, eq=False)
class _Source:
    """The pieces, one at a time."""

    paths: Sequence[Path]
    read: Reader
    numbering: Numbering
    width: int
    n_rows: NDArray[np.int64]  # cells or facets of each
    n_points: int


def write_merged_volume(
    path: Path, pieces: Sequence[Path], *, scalars: bool = False, origin: Place = NO_PLACE, threads: int = 0
) -> None:
    """Write one VTU file of many.

    Parameters
    ----------
    path : Path
        The file; it appears whole or not at all. While it is written, coordinates wait in a file beside it.
    pieces : sequence of at least one Path
        VTU pieces (`tiler.mesh_files.vtk_files`) with the int64 point array `VERTEX_ID`: each id for one place.
    scalars : bool
        Add cell arrays to colour by: `TILE`, and `RADIUS_RATIO` as `pipeline.quality.quality` measures it.
    threads : int
        How many pack what is written; with less than 2 this one does.

    Raises
    ------
    InputError
        If a piece is missing or damaged, lacks the array or a cell array that the first has, or if an id stands
        for two places.
    OutputError
        If the file cannot be written.
    ValueError
        If there is no piece.

    Notes
    -----
    Vertices are in the order of their ids, cells piece by piece with their arrays. Memory holds one piece and
    9 bytes a vertex; coordinates are in a file that the system maps. Each piece is read twice, and again for each
    of its arrays.
    """
    _write(path, pieces, pieces, "UnstructuredGrid", scalars=scalars, origin=origin, threads=threads)


def write_merged_boundary(
    path: Path,
    pieces: Sequence[Path],
    volumes: Sequence[Path],
    *,
    scalars: bool = False,
    origin: Place = NO_PLACE,
) -> None:
    """Write one VTP file of many; see `write_merged_volume`.

    Parameters
    ----------
    path : Path
        The file.
    pieces : sequence of at least one Path
        VTP pieces.
    volumes : sequence of Path
        The VTU pieces of all tiles.
    scalars : bool
        Add the cell arrays `TILE`, and `INDEX` for readers that keep 32 bits of ``building``, as vtk.js does.
    origin : tuple of float
        Place (m) that coordinates are to count from.

    Notes
    -----
    Only the vertices of facets are written, in the order of their ids. The array ``vertex`` names which vertex of
    the merged volume each is.
    """
    _write(path, pieces, volumes, "PolyData", scalars=scalars, origin=origin)


def read_numbering(volumes: Iterable[Path]) -> Numbering:
    """Number the points of all volume pieces without gaps, by their ids.

    Parameters
    ----------
    volumes : iterable of Path
        The VTU pieces of all tiles.

    Raises
    ------
    InputError
        If a piece is missing or damaged, or has no ids.
    """
    return collect_ids(
        _checked_ids(path, read_point_array(path, "UnstructuredGrid", VERTEX_ID)) for path in volumes
    )


def number_piece(path: Path, ids: NDArray[Any] | None, numbering: Numbering) -> NDArray[np.int64]:
    """Turn the ids of a piece into numbers without gaps.

    Parameters
    ----------
    path : Path
        The piece, for messages.
    ids : int64, (n,)
        Its array `VERTEX_ID`.
    numbering : Numbering
        Of all pieces.

    Raises
    ------
    InputError
        If it has no ids, or one that no volume piece has.
    """
    try:
        return number_without_gaps(numbering, _checked_ids(path, ids))
    except ValueError:
        raise InputError(f"{path}: a {VERTEX_ID} of it is in no piece of the volume; run the tile again") from None


def _write(
    path: Path,
    pieces: Sequence[Path],
    volumes: Sequence[Path],
    kind: str,
    *,
    scalars: bool,
    origin: Place,
    threads: int = 0,
) -> None:
    if not pieces:
        raise ValueError("a merged file needs at least one piece")
    with disk_errors(path), TemporaryDirectory(dir=path.parent, prefix=f".{path.stem}.") as folder:
        gathered = _gather(pieces, read_numbering(volumes), kind, Path(folder), origin)
        _write_file(path, kind, *gathered, scalars=scalars, threads=threads)


def _write_file(
    path: Path,
    kind: str,
    source: _Source,
    numbers: NDArray[np.int64],
    xyz: NDArray[np.float64],
    *,
    scalars: bool,
    threads: int,
) -> None:
    rows = [_connectivity(source, kind, numbers), stream_offsets(int(source.n_rows.sum()), source.width)]
    arrays = source.read(0)["CellData"]
    of_cells = {name: _cell_array(source, name, array) for name, array in arrays.items()}
    if scalars:
        of_cells |= {stream.name: stream for stream in _scalars(source, kind)}
    n_rows = int(source.n_rows.sum())
    sections: Sections = {
        "Points": [_flat("Points", xyz.reshape(-1), 3)],
        "Cells" if kind == "UnstructuredGrid" else "Polys": rows,
        "PointData": [],
        "CellData": list(of_cells.values()),
    }
    if kind == "UnstructuredGrid":
        rows.append(stream_types(n_rows))
        counts = {"NumberOfPoints": len(xyz), "NumberOfCells": n_rows}
    else:
        sections["PointData"].append(_flat("vertex", numbers, 1))
        counts = {"NumberOfPoints": len(xyz), "NumberOfVerts": 0, "NumberOfLines": 0}
        counts |= {"NumberOfStrips": 0, "NumberOfPolys": n_rows}
    write_data_file(path, kind, counts, sections, threads=threads)


def _gather(
    pieces: Sequence[Path], numbering: Numbering, kind: str, folder: Path, origin: Place
) -> tuple[_Source, NDArray[np.int64], NDArray[np.float64]]:
    """Read all pieces once: how many rows each has, which vertices it has, and where these are."""
    read = _reader(pieces, kind)
    n_rows = np.empty(len(pieces), np.int64)
    section, width = ("Cells", 4) if kind == "UnstructuredGrid" else ("Polys", 3)
    xyz = np.memmap(folder / "points", np.float64, "w+", shape=(max(numbering.n_points, 1), 3))
    seen = np.zeros(numbering.n_points, np.bool_)
    for k, piece in enumerate(pieces):
        sections = read(k)
        n_rows[k] = len(sections[section]["connectivity"]) // width
        number, points = _numbers(piece, sections, numbering), sections["Points"]["Points"] - origin
        known = seen[number]
        if (xyz[number[known]] != points[known]).any():
            raise InputError(f"{piece}: a {VERTEX_ID} stands for two places; run the tile again")
        xyz[number], seen[number] = points, True
    numbers = np.flatnonzero(seen)
    if len(numbers) < len(seen):
        for i in range(0, len(numbers), CHUNK):
            chosen = numbers[i : i + CHUNK]
            xyz[i : i + len(chosen)] = xyz[chosen]
    return _Source(pieces, read, numbering, width, n_rows, len(numbers)), numbers, xyz[: len(numbers)]


def _reader(pieces: Sequence[Path], kind: str) -> Reader:
    @lru_cache(maxsize=1)
    def read(k: int) -> dict[str, dict[str, NDArray[Any]]]:
        return read_data_file(pieces[k], kind)

    return read


def _numbers(piece: Path, sections: dict[str, dict[str, NDArray[Any]]], numbering: Numbering) -> NDArray[np.int64]:
    return number_piece(piece, sections["PointData"].get(VERTEX_ID), numbering)


def _checked_ids(path: Path, ids: NDArray[Any] | None) -> NDArray[np.int64]:
    if ids is None or ids.dtype != np.int64 or ids.ndim != 1 or (ids < 0).any():
        raise InputError(f"{path}: has no point array {VERTEX_ID} of numbers from 0 on; run the tile again")
    return ids


def _flat(name: str, values: NDArray[Any], components: int) -> Stream:
    return stream_items(name, values.dtype, components, len(values), lambda i, j: np.asarray(values[i:j]))


def _connectivity(source: _Source, kind: str, numbers: NDArray[np.int64]) -> Stream:
    section = "Cells" if kind == "UnstructuredGrid" else "Polys"

    def of_piece(k: int) -> NDArray[Any]:
        sections = source.read(k)
        number = _numbers(source.paths[k], sections, source.numbering)
        place = number if len(numbers) == numbers[-1] + 1 else np.searchsorted(numbers, number)
        flat: NDArray[Any] = place[sections[section]["connectivity"]]
        return flat

    dtype = np.dtype(np.int32 if source.n_points < 2**31 else np.int64)
    return _joined("connectivity", dtype, source.n_rows * source.width, of_piece, components=1)


def _cell_array(source: _Source, name: str, first: NDArray[Any]) -> Stream:
    def of_piece(k: int) -> NDArray[Any]:
        array = source.read(k)["CellData"].get(name)
        if array is None or array.dtype != first.dtype or array.shape[1:] != first.shape[1:]:
            raise InputError(
                f"{source.paths[k]}: has no array {name!r} like the first piece's; run the tile again"
            )
        return array.reshape(-1)

    components = first.shape[1] if first.ndim == 2 else 1
    return _joined(name, first.dtype, source.n_rows * components, of_piece, components=components)


def _scalars(source: _Source, kind: str) -> list[Stream]:
    """Make the arrays that pieces do not have, but that one wants to colour cells by."""

    def quality(k: int) -> NDArray[Any]:
        sections = source.read(k)
        cells = sections["Cells"]["connectivity"].reshape(-1, source.width)
        return measure_cells(TetMesh(sections["Points"]["Points"], cells)).radius_ratio

    number = np.dtype(np.int32)
    tile = _joined(TILE, number, source.n_rows, lambda k: np.full(source.n_rows[k], k, number), components=1)
    if kind != "UnstructuredGrid":
        buildings = np.empty(0, np.int64)
        for k in range(len(source.paths)):
            buildings = np.union1d(buildings, source.read(k)["CellData"]["building"])
        buildings = buildings[buildings >= 0]

        def index(k: int) -> NDArray[Any]:
            found = source.read(k)["CellData"]["building"]
            return np.where(found < 0, -1, np.searchsorted(buildings, found)).astype(number)

        return [tile, _joined(INDEX, number, source.n_rows, index, components=1)]
    return [tile, _joined(RADIUS_RATIO, np.dtype(np.float32), source.n_rows, quality, components=1)]


def _joined(
    name: str,
    dtype: np.dtype[Any],
    n_items: NDArray[np.int64],
    of_piece: Callable[[int], NDArray[Any]],
    *,
    components: int,
) -> Stream:
    """Make a stream of the numbers of all pieces, one piece in memory."""
    start = np.concatenate(([0], np.cumsum(n_items)))
    cached = lru_cache(maxsize=1)(of_piece)

    def items(i: int, j: int) -> NDArray[Any]:
        low, high = np.searchsorted(start, i, "right") - 1, np.searchsorted(start, j, "left")
        parts = [cached(k)[max(i - start[k], 0) : j - start[k]] for k in range(int(low), int(high))]
        return np.concatenate(parts) if parts else np.empty(0, dtype)

    return stream_items(name, dtype, components, int(start[-1]), items)
