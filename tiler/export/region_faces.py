"""Faces of a whole region, numbered piece by piece: what OpenFOAM's order of faces rests on.

Cells are numbered piece by piece. A face inside the region belongs to the lower of its two cells, so the faces
of one piece are those inside it and those to later pieces; sorted by owner and neighbour they are the region's
upper triangular order. A face that two pieces share is found by the numbers of its vertices and waits from the
first of them to the second; what is known of it then stands in files.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.data.errors import InputError
from pipeline.data.kernel import kernel
from pipeline.data.mesh import find_inside, is_ground
from pipeline.data.regions import Region
from stitch.pieces.cell_faces import CellFaces, find_cell_faces
from stitch.pieces.conformity import group_rows
from tiler.export.pieces import Pieces
from tiler.mesh_files.mesh_pieces import MeshPiece
from tiler.mesh_files.threads import map_threads
from tiler.mesh_files.transitions import NO_CORNER

Ints = NDArray[np.int64]
# Given a piece, the key of a set of facets, or of cells, for each of them; several sets may have one.
SetsOf = Callable[[MeshPiece], Ints]
# Given owners and neighbours of faces, by their numbers over the region, which faces are wanted.
Wanted = Callable[[Ints, Ints], NDArray[np.bool_]]
BLOCK_CELLS = 2**17  # whose faces are put in order together


@dataclass(frozen=True, eq=False)
class FacetSets:
    """Sets of facets, patches say, and how many facets of each every piece has."""

    keys: Ints  #: (p,): keys of the sets, ascending
    #: for each piece that has any, how many of its facets a set has, by row in `keys`
    counts: Mapping[int, dict[int, int]]

    def first(self, pieces: Sequence[int]) -> tuple[dict[int, dict[int, int]], Ints]:
        """Put the facets of some pieces, in their order, set by set.

        Returns
        -------
        first : dict of int to dict of int to int
            For each of the pieces, where its facets of a set begin within that set.
        n : int64, (p,)
            Facets of each set.
        """
        n, first = np.zeros(len(self.keys), np.int64), {}
        for k in pieces:
            counts = self.counts.get(k, {})
            first[k] = {row: int(n[row]) for row in counts}
            for row, count in counts.items():
                n[row] += count
        return first, n


@dataclass(frozen=True, eq=False)
class RegionFaces:
    """How the faces of a region are numbered: ``k`` pieces, ``s`` faces shared by two of them, each twice."""

    #: (k + 1,): where the cells, the faces and the shared faces of each piece begin. The last is their number
    cell_start: Ints
    face_start: Ints
    shared_start: Ints
    cell: Ints  #: (s,): cell of each shared face, in the order of `CellFaces.shared`, piece by piece; a file
    mate: Ints  #: (s,): the same face as the other piece has it, as a row of these arrays; a file
    face: Ints  #: (s,): its number among the faces of the region; a file
    centre: NDArray[np.float64]  #: (k, 2): middle of each piece's box (m)
    between: Counter[tuple[int, int]]  #: number of faces that two pieces share, by their numbers, the lower first

    @property
    def n_inner(self) -> int:
        """Number of faces with two cells."""
        return int(self.face_start[-1])


@dataclass(frozen=True, eq=False)
class OwnFaces:
    """Faces with two cells, whose lower cell is in a piece: some of its, in the region's order."""

    #: (n,): cells by their numbers over the region, ascending pairs
    owner: Ints
    neighbour: Ints
    #: (n, 3) or (n, 4): vertices as rows of the piece's points, that of the lowest number over the region first;
    #: the normal points out of the owner
    corners: NDArray[np.int32]
    number: Ints  #: (n,): number of each among the faces of the region


@dataclass(frozen=True, eq=False)
class Waiting:
    """Shared faces of pieces that came before: vertices and row of each."""

    corners: Ints
    row: Ints


NOTHING = Waiting(np.empty((0, 0), np.int64), np.empty(0, np.int64))


def survey_faces(
    pieces: Pieces,
    folder: Path,
    *,
    kinds: tuple[SetsOf, ...],
    look: Callable[[MeshPiece], None] | None = None,
    threads: int = 0,
) -> tuple[RegionFaces, list[FacetSets]]:
    """Read all pieces once, and number cells, faces and facets.

    Parameters
    ----------
    pieces : Pieces
        The mesh.
    folder : Path
        An existing folder for files; they must stay as long as the result is used.
    kinds : tuple of callable
        Each gives a key for every facet of a piece, or for every cell, or -1 for none.
    look : callable, optional
        Is given each piece too, in their order: this thread alone then reads them.
    threads : int
        How many read pieces and find their faces; with less than 2 this one does.

    Returns
    -------
    RegionFaces
        Numbers of cells and faces.
    list of FacetSets
        What each of `kinds` gave.

    Raises
    ------
    InputError
        If cells of a piece, or pieces, do not fit together.

    Notes
    -----
    Memory: one piece a thread, the shared faces of the pieces that wait for a later one (32 bytes each) and the
    number of facets that each piece has of each set. Files: 40 bytes a shared face.
    """
    n = len(pieces.names)
    n_cells, n_faces, n_shared = (np.zeros(n, np.int64) for _ in range(3))
    centre = np.empty((n, 2))
    counts: list[list[dict[int, int]]] = [[{} for _ in range(n)] for _ in kinds]
    waiting = NOTHING
    paths = [folder / name for name in ("cells", "before", "mates")]

    def find_shared(k: int) -> tuple[NDArray[np.int32], Ints, Ints]:
        """Count what piece `k` has; gives of its shared faces cells, how many faces come before, and corners."""
        piece = pieces.read(k)
        if look is not None:
            look(piece)
        faces = faces_of_piece(piece)
        n_cells[k], n_faces[k], n_shared[k] = len(piece.cells), len(faces.owner), len(faces.shared)
        centre[k] = (piece.points[:, :2].min(axis=0) + piece.points[:, :2].max(axis=0)) / 2
        for of_kind, sets_of in zip(counts, kinds, strict=True):
            keys, count = np.unique(sets_of(piece), return_counts=True)
            of_kind[k] = {key: c for key, c in zip(keys.tolist(), count.tolist(), strict=True) if key >= 0}
        before = np.searchsorted(faces.owner, faces.shared_cell, side="right")
        return faces.shared_cell, before, number_corners(piece.ids, faces.shared)

    with paths[0].open("wb") as cells_file, paths[1].open("wb") as before_file, paths[2].open("wb") as mates_file:
        found = map_threads(find_shared, range(n), threads if look is None else 0)
        for k, (cell, before, corners) in enumerate(found):
            (cell + n_cells[:k].sum()).astype(np.int64).tofile(cells_file)
            before.astype(np.int64).tofile(before_file)
            rows = n_shared[:k].sum() + np.arange(n_shared[k])
            waiting, mates = meet(waiting, corners, rows, pieces.names[k])
            mates.tofile(mates_file)
    if len(waiting.row):
        k = int(np.searchsorted(np.cumsum(n_shared), waiting.row[0], side="right"))
        raise InputError(
            f"tile {pieces.names[k]}: {len(waiting.row)} faces at seams have no other cell; run citystitch check"
        )
    region = _number_faces(paths, n_cells, n_faces, n_shared, centre)
    return region, [_collect(found) for found in counts]


def faces_of_piece(piece: MeshPiece) -> CellFaces:
    """Find the faces of a piece.

    Raises
    ------
    InputError
        If its cells and facets do not fit together.
    """
    if piece.faces is not None:
        return piece.faces
    try:
        return find_cell_faces(piece.cells, piece.facets[find_outer(piece)], len(piece.points))
    except ValueError as error:
        raise InputError(f"tile {piece.name}: {error}; run citystitch check") from None


def find_outer(piece: MeshPiece) -> NDArray[np.bool_]:
    """Return which facets of a piece bound its cells, bool (f,): all, but for those with cells on both sides."""
    if len(piece.regions) == 1:
        return np.ones(len(piece.facets), np.bool_)
    outer: NDArray[np.bool_] = ~find_inside(piece.marker, piece.regions)
    return outer


def find_inner_ground(piece: MeshPiece) -> NDArray[np.bool_]:
    """Return which facets of a piece are ground with soil below it, bool (f,)."""
    return is_ground(piece.marker) & ~find_outer(piece)


def own_faces(
    region: RegionFaces, k: int, piece: MeshPiece, faces: CellFaces, wanted: Wanted | None = None
) -> Iterator[OwnFaces]:
    """Take the faces that piece `k` has of the region's list: rows ``face_start[k]`` to ``face_start[k + 1]``.

    Parameters
    ----------
    region : RegionFaces
        Numbers of cells and faces.
    k : int
        Which piece.
    piece : MeshPiece
        The piece.
    faces : CellFaces
        Its faces.
    wanted : callable, optional
        Which of them to give; all if it is left out.

    Yields
    ------
    OwnFaces
        Those of `BLOCK_CELLS` cells after the other: memory does not go with the piece.
    """
    rows = slice(int(region.shared_start[k]), int(region.shared_start[k + 1]))
    start = int(region.cell_start[k])
    other = np.asarray(region.cell[np.asarray(region.mate[rows])])
    later = np.flatnonzero(other > np.asarray(region.cell[rows]))
    cell, other = faces.shared_cell[later], other[later]
    for first in range(0, len(piece.cells), BLOCK_CELLS):
        ends = np.array([first, first + BLOCK_CELLS], np.int32)  # as in the faces, which are so searched in place
        inner, beyond = (slice(*np.searchsorted(some, ends).tolist()) for some in (faces.owner, cell))
        owner = np.concatenate([faces.owner[inner], cell[beyond]]).astype(np.int64) + start
        neighbour = np.concatenate([faces.neighbour[inner].astype(np.int64) + start, other[beyond]])
        # Faces inside and those to later pieces are counted together, by owner: see `_number_faces`.
        before = np.arange(inner.start, inner.stop) + np.searchsorted(cell, faces.owner[inner])
        number = np.concatenate([region.face_start[k] + before, region.face[rows.start + later[beyond]]])
        chosen = np.arange(len(owner)) if wanted is None else np.flatnonzero(wanted(owner, neighbour))
        order = chosen[np.argsort(number[chosen])]
        corners = np.concatenate([faces.inner[inner], faces.shared[later[beyond]]])[order]
        yield OwnFaces(owner[order], neighbour[order], lowest_first(corners, piece.ids), number[order])


def find_ground(region: RegionFaces, k: int, piece: MeshPiece, own: OwnFaces) -> NDArray[np.bool_]:
    """Return which faces of a block of piece `k` are the ground between air and soil.

    Raises
    ------
    InputError
        If the normal of one points up.
    """
    ground = np.zeros(len(own.owner), np.bool_)
    if piece.region is None:
        return ground
    owner, neighbour = own.owner - region.cell_start[k], own.neighbour - region.cell_start[k]
    within = np.flatnonzero(neighbour < len(piece.cells))
    pair = piece.region[owner[within]], piece.region[neighbour[within]]
    if (pair[0] > pair[1]).any():
        raise wrong_ground(piece)
    ground[within] = (pair[0] == Region.AIR) & (pair[1] == Region.SOIL)
    return ground


def wrong_ground(piece: MeshPiece) -> InputError:
    """Make the error of a piece whose ground is not where it marks it."""
    return InputError(
        f"tile {piece.name}: its ground is not what air and soil share, the air's cells first; run "
        "citystitch check"
    )


def lowest_first(corners: NDArray[np.int32], ids: Ints) -> NDArray[np.int32]:
    """Turn each row so that the vertex with the lowest of `ids` stands first; the orientation stays.

    Rows are (n, 3), or (n, 4) with `NO_CORNER` in the last place of triangles.

    Two pieces so begin a face with the same vertex, as OpenFOAM asks of both sides of a processor patch.

    Examples
    --------
    >>> lowest_first(np.array([[0, 1, 2], [2, 1, 0]], np.int32), np.array([70, 30, 50]))
    array([[1, 2, 0],
           [1, 0, 2]], dtype=int32)
    """
    return _turn(np.ascontiguousarray(corners), ids)  # type: ignore[no-any-return]


@kernel
def _turn(corners, ids):  # type: ignore[no-untyped-def]  # pragma: no cover
    turned = corners.copy()
    for i in range(len(corners)):
        first, n = 0, corners.shape[1]
        if corners[i, n - 1] < 0:
            n -= 1
        for k in range(1, n):
            if ids[corners[i, k]] < ids[corners[i, first]]:
                first = k
        for k in range(n):
            turned[i, k] = corners[i, (first + k) % n]
    return turned


def number_corners(numbers: Ints, corners: NDArray[np.int32]) -> Ints:
    """Give the numbers of the corners of faces; `NO_CORNER` stays."""
    found: Ints = numbers[corners]
    return found if corners.shape[1] == 3 else np.where(corners == NO_CORNER, NO_CORNER, found)


def meet(waiting: Waiting, corners: Ints, rows: Ints, name: str) -> tuple[Waiting, Ints]:
    """Find which shared faces of a piece an earlier one has, as pairs (earlier, own) of rows (p, 2)."""
    own = np.sort(corners, axis=1)
    both = np.concatenate([waiting.corners, own]) if len(waiting.row) else own
    row = np.concatenate([waiting.row, rows])
    group, n_groups = group_rows(both)
    count = np.bincount(group, minlength=n_groups)
    if (count > 2).any():
        raise InputError(f"tile {name}: a face at a seam has more than two cells; run citystitch check")
    order = np.argsort(group, kind="stable")
    is_pair = count[group[order]] == 2
    left = np.sort(order[~is_pair])
    return Waiting(both[left], row[left]), row[order[is_pair]].reshape(-1, 2)


def _number_faces(
    paths: list[Path], n_cells: Ints, n_faces: Ints, n_shared: Ints, centre: NDArray[np.float64]
) -> RegionFaces:
    """Number the shared faces among those of the piece that has their lower cell."""
    cell_start, shared_start = _starts(n_cells), _starts(n_shared)
    n = int(shared_start[-1])
    cell, before = (_open(path, n) for path in paths[:2])
    mate, face = (_make(paths[0].with_name(name), n) for name in ("mate", "face"))
    pairs = _open(paths[2], n)
    if n:
        first, second = pairs[::2], pairs[1::2]
        mate[first], mate[second] = second, first
    face_start = np.zeros(len(n_cells) + 1, np.int64)
    between: Counter[tuple[int, int]] = Counter()
    for k in range(len(n_cells)):
        rows = slice(int(shared_start[k]), int(shared_start[k + 1]))
        own, mates = np.asarray(cell[rows]), np.asarray(mate[rows])
        other = np.asarray(cell[mates])
        later = np.flatnonzero(other > own)
        later = later[np.lexsort((other[later], own[later]))]
        number = face_start[k] + np.asarray(before[rows])[later] + np.arange(len(later))
        face[rows.start + later], face[mates[later]] = number, number
        face_start[k + 1] = face_start[k] + n_faces[k] + len(later)
        beyond, count = np.unique(np.searchsorted(cell_start, other[later], "right") - 1, return_counts=True)
        between.update({(k, b): c for b, c in zip(beyond.tolist(), count.tolist(), strict=True)})
    return RegionFaces(cell_start, face_start, shared_start, cell, mate, face, centre, between)


def _collect(counts: list[dict[int, int]]) -> FacetSets:
    keys = sorted(set().union(*counts))
    row = {key: i for i, key in enumerate(keys)}
    return FacetSets(
        np.array(keys, np.int64), {k: {row[key]: n for key, n in found.items()} for k, found in enumerate(counts)}
    )


def _starts(counts: Ints) -> Ints:
    return np.concatenate(([0], np.cumsum(counts))).astype(np.int64)


def _open(path: Path, n: int) -> Ints:
    return np.memmap(path, np.int64, "r", shape=(n,)) if n else np.empty(0, np.int64)


def _make(path: Path, n: int) -> Ints:
    return np.memmap(path, np.int64, "w+", shape=(n,)) if n else np.empty(0, np.int64)
