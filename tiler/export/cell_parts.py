"""Which part of a decomposed mesh has each cell, each face and each facet: what parts are written from."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.data.errors import ConfigError
from stitch.pieces.cell_faces import CellFaces
from tiler.export.bisection import Cuts, bisect_columns, column_centres, count_columns
from tiler.export.pieces import Pieces, slices
from tiler.export.region_faces import (
    BLOCK_CELLS,
    FacetSets,
    Ints,
    RegionFaces,
    SetsOf,
    faces_of_piece,
    find_ground,
    find_outer,
    own_faces,
    wrong_ground,
)
from tiler.mesh_files.mesh_pieces import MeshPiece
from tiler.mesh_files.transitions import fill_corners

Ids = NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class CellParts:
    """The parts of a region's cells."""

    #: (cells,): part of each cell, by its number over the region; a file. None where there is one part, the whole
    #: mesh
    part: Ids | None
    #: (cells,): its number within the part, ascending with its number over the region; a file. None as before
    place: Ints | None
    #: (p,): cells of each part, and faces between two of them
    n_cells: Ints
    n_inner: Ints
    between: Counter[tuple[int, int]]  #: faces between two parts, the lower first
    pieces: Sequence[Sequence[int]]  #: the pieces that have cells of each part, ascending
    #: for each kind of sets, its facets within each part; the last is of cells
    sets: Sequence[Sequence[FacetSets]]

    def part_of(self, cell: Ints) -> Ids:
        """Return the part of cells, by their numbers over the region."""
        return np.zeros(len(cell), np.int32) if self.part is None else np.asarray(self.part[cell])

    def place_of(self, cell: Ints) -> Ints:
        """Return the numbers of cells within their parts."""
        return cell if self.place is None else np.asarray(self.place[cell])


class ColumnsFile:
    """The columns of all pieces in a file, 24 bytes each, filled piece by piece."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._n = 0

    def add(self, piece: MeshPiece) -> None:
        """Add the columns of a piece."""
        with self._path.open("ab") as file:
            for first in range(0, len(piece.cells), BLOCK_CELLS):
                cells = fill_corners(piece.cells[first : first + BLOCK_CELLS])
                columns = count_columns(piece.points, cells)
                columns.tofile(file)
                self._n += len(columns)

    def rows(self) -> NDArray[np.float64]:
        """Return the rows of `tiler.export.bisection.count_columns`; they stay in the file."""
        if not self._n:
            return np.empty((0, 3))
        return np.memmap(self._path, np.float64, "r", shape=(self._n, 3))


def take_whole(region: RegionFaces, sets: Sequence[FacetSets]) -> CellParts:
    """Return the one part that is the whole mesh."""
    n = len(region.cell_start) - 1
    n_cells, n_inner = np.array([region.cell_start[-1]]), np.array([region.n_inner])
    return CellParts(None, None, n_cells, n_inner, Counter(), [range(n)], [[found] for found in sets])


def divide_cells(
    pieces: Pieces,
    region: RegionFaces,
    columns: ColumnsFile,
    folder: Path,
    *,
    n_parts: int,
    kinds: Sequence[tuple[SetsOf, FacetSets]],
    volumes: tuple[SetsOf, FacetSets],
) -> CellParts:
    """Divide the cells of a region among processes, whole columns each, about as many cells to each.

    Parameters
    ----------
    pieces : Pieces
        The mesh; read once.
    region : RegionFaces
        Numbers of cells and faces.
    columns : ColumnsFile
        Its columns.
    folder : Path
        An existing folder for files; they must stay as long as the result is used.
    n_parts : int
        Number of parts, at least one.
    kinds, volumes : (callable, FacetSets)
        Keys of facets, or of cells, as `survey_faces` got them, and what it found; several for facets.

    Raises
    ------
    ConfigError
        If there are too few columns, so that a part would have no cell.
    InputError
        If a piece is damaged.

    Notes
    -----
    Memory: a piece with its faces, and a few numbers for each part that a piece has cells of. Files: 12 bytes a
    cell.
    """
    n = int(region.cell_start[-1])
    too_few = ConfigError(
        f"--parts {n_parts}: the {n:,} cells stand in columns, which are not divided, and these are too few; "
        "give fewer parts"
    )
    if len(columns.rows()) < n_parts:
        raise too_few
    cuts = bisect_columns(columns.rows(), n_parts)
    part = np.memmap(folder / "part", np.int32, "w+", shape=(max(n, 1),))
    place = np.memmap(folder / "place", np.int64, "w+", shape=(max(n, 1),))
    n_cells, n_inner = np.zeros(n_parts, np.int64), np.zeros(n_parts, np.int64)
    between: Counter[tuple[int, int]] = Counter()
    of_part: list[list[int]] = [[] for _ in range(n_parts)]
    counts: list[list[dict[int, dict[int, int]]]] = [[{} for _ in range(n_parts)] for _ in (*kinds, volumes)]
    for k in range(len(pieces.names)):
        piece = pieces.read(k)
        start = int(region.cell_start[k])
        for first in range(0, len(piece.cells), BLOCK_CELLS):
            block = slice(start + first, start + min(first + BLOCK_CELLS, len(piece.cells)))
            mine = _assign(cuts, piece, block.start - start, block.stop - start)
            part[block] = mine
            place[block] = n_cells[mine] + _ranks(mine, n_parts)
            n_cells += np.bincount(mine, minlength=n_parts)
        own, faces = np.asarray(part[start : start + len(piece.cells)]), faces_of_piece(piece)
        for number in np.unique(own).tolist():
            of_part[number].append(k)
        _count_piece(region, k, piece, faces, own, n_inner=n_inner, between=between)
        of_facets = _part_of_facets(cuts, piece, faces, own)
        for found, (keys_of, sets) in zip(counts, kinds, strict=False):
            _count_sets(found, k, of_facets, keys_of(piece), sets.keys)
        if len(keys := volumes[0](piece)):
            _count_sets(counts[-1], k, own, keys, volumes[1].keys)
    if n_cells.min() == 0:
        raise too_few
    _count_shared(region, part, n_inner, between)
    divided = [
        [FacetSets(sets.keys, rows) for rows in found]
        for found, (_, sets) in zip(counts, (*kinds, volumes), strict=True)
    ]
    return CellParts(part, place, n_cells, n_inner, between, of_part, divided)


def _assign(cuts: Cuts, piece: MeshPiece, first: int, end: int) -> Ints:
    return cuts.part_of(column_centres(piece.points, fill_corners(piece.cells[first:end])))


def _ranks(part: Ints, n_parts: int) -> Ints:
    """Number the cells of each part in their order."""
    order = np.argsort(part, kind="stable")
    count = np.bincount(part, minlength=n_parts)
    ranks = np.empty(len(part), np.int64)
    ranks[order] = np.arange(len(part)) - np.repeat(np.cumsum(count) - count, count)
    return ranks


def _part_of_facets(cuts: Cuts, piece: MeshPiece, faces: CellFaces, own: Ids) -> Ids:
    """Return the part of each facet: where its cell is."""
    part = np.empty(len(piece.facets), np.int32)
    outer = find_outer(piece)
    part[outer] = own[faces.facet_cell]
    # The ground between air and soil is as wide as its column.
    part[~outer] = cuts.part_of(column_centres(piece.points, fill_corners(piece.facets[~outer])))
    return part


def _count_piece(
    region: RegionFaces,
    k: int,
    piece: MeshPiece,
    faces: CellFaces,
    own: Ids,
    *,
    n_inner: Ints,
    between: Counter[tuple[int, int]],
) -> None:
    """Count the faces within a piece: inside parts and between them."""
    start, end = region.cell_start[k : k + 2]
    for block in own_faces(region, k, piece, faces, lambda _, neighbour: neighbour < end):
        low, high = own[block.owner - start], own[block.neighbour - start]
        if (find_ground(region, k, piece, block) & (low != high)).any():
            raise wrong_ground(piece)
        _count_pairs(low, high, n_inner, between)


def _count_shared(region: RegionFaces, part: Ids, n_inner: Ints, between: Counter[tuple[int, int]]) -> None:
    """Count the faces that two pieces share."""
    for rows in slices(len(region.cell)):
        cell, other = np.asarray(region.cell[rows]), np.asarray(region.cell[np.asarray(region.mate[rows])])
        once = other > cell
        _count_pairs(np.asarray(part[cell[once]]), np.asarray(part[other[once]]), n_inner, between)


def _count_pairs(one: Ids, two: Ids, n_inner: Ints, between: Counter[tuple[int, int]]) -> None:
    same = one == two
    n_inner += np.bincount(one[same], minlength=len(n_inner))
    pairs = np.sort(np.column_stack([one[~same], two[~same]]), axis=1).astype(np.int64)
    number, count = np.unique(pairs[:, 0] * len(n_inner) + pairs[:, 1], return_counts=True)
    for key, n in zip(number.tolist(), count.tolist(), strict=True):
        between[divmod(key, len(n_inner))] += n


def _count_sets(found: list[dict[int, dict[int, int]]], k: int, part: Ids, keys: Ints, known: Ints) -> None:
    """Count the facets that piece `k` has of each part and set."""
    chosen = keys >= 0
    rows = np.searchsorted(known, keys[chosen])
    pairs, count = np.unique(part[chosen].astype(np.int64) * max(len(known), 1) + rows, return_counts=True)
    for key, n in zip(pairs.tolist(), count.tolist(), strict=True):
        number, row = divmod(key, max(len(known), 1))
        found[number].setdefault(k, {})[row] = n
