"""Columns of cells as prisms: three tetrahedra that fill a prism between two levels become one cell (step 3.6).

Columns of the layered mesher have as many levels on all sides of a cell, and their tetrahedra stand by threes: all
of such a mesh may be prisms. In other columns levels merge, and a hybrid mesh has prisms near ground and roofs and
tetrahedra elsewhere (`tiler.mesh_files.transitions`).
"""

from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from pipeline.data.errors import ConfigError, InputError
from pipeline.data.mesh import find_inside
from pipeline.data.regions import Region
from stitch.pieces.conformity import group_rows
from stitch.pieces.face_mates import FACES
from tiler.mesh_files.mesh_pieces import MeshPiece, MeshPieces
from tiler.mesh_files.transitions import NO_CORNER, SIDES, Rows, find_cut_sides, split_prisms

Ints = NDArray[np.int64]
Number = TypeVar("Number", bound=np.generic)
LAYERS = 10  # of prisms in a hybrid mesh, where nothing else is asked for
# Faces of cells by their corners, counter-clockwise seen from outside; -1 stands for no fourth corner.
ENDS = np.array([[0, 2, 1, NO_CORNER], [3, 4, 5, NO_CORNER]])
PYRAMID = np.array([[0, 3, 2, 1], *([k, (k + 1) % 4, 4, NO_CORNER] for k in range(4))])
FACES_OF = {
    4: np.column_stack((FACES.astype(np.int64), np.full(4, NO_CORNER))),
    5: PYRAMID,
    6: np.concatenate((ENDS, SIDES)),
}


@dataclass(frozen=True, eq=False)
class PrismMesh:
    """The mesh of a run as ``m`` prisms and other cells on ``n`` points, and its faces; all of it is in memory."""

    #: (n, 3): points (m), by their numbers over the region; then the middles of prisms that are cut
    points: NDArray[np.float64]
    #: (m, 6): prism: a triangle, counter-clockwise seen from above, and the corners over it. Pyramid: a
    #: quadrilateral, counter-clockwise seen from the fifth corner, and that. Tetrahedron: four corners, of
    #: positive volume. The places left are `NO_CORNER`
    cells: Ints
    tile: NDArray[np.int32]  #: (m,): which tile each is of, counted from 0 by name
    #: (i, 4): faces between two cells, out of the lower one; `NO_CORNER` in the last place of a triangle
    inner: Ints
    #: (i,): the two cells of each, ascending pairs
    owner: Ints
    neighbour: Ints
    outer: Ints  #: (f, 4): faces of the boundary, counter-clockwise seen from outside; as `inner`
    outer_cell: Ints  #: (f,): their cells, ascending
    marker: NDArray[np.int32]  #: (f,): `pipeline.data.mesh.Marker` of each of them
    building: Ints  #: (f,): number of its building, -1 where there is none
    ground: tuple[str, ...] = ()  #: names of the patches of the ground, by number; none without land cover
    #: (m,): leaf area density of each cell (m2/m3), of a prism that of the middle one of its three tetrahedra;
    #: None without trees
    leaves: NDArray[np.float32] | None = None
    #: (m,): `pipeline.data.regions.Region` of each cell; None where all is air
    region: NDArray[np.int8] | None = None
    #: (g, 3): facets between two regions, out of the first (`pipeline.data.mesh.INTERFACES`); these are among
    #: `inner`
    between: Ints = field(default_factory=lambda: np.empty((0, 3), np.int64))
    #: of each of them, as `marker` and `building`
    between_marker: NDArray[np.int32] = field(default_factory=lambda: np.empty(0, np.int32))
    between_building: Ints = field(default_factory=lambda: np.empty(0, np.int64))

    @property
    def widths(self) -> Ints:
        """Number of corners of each cell, (m,): 4, 5 or 6."""
        found: Ints = (self.cells != NO_CORNER).sum(axis=1)
        return found

    def by_width(self) -> list[tuple[int, Ints]]:
        """Give the kinds of cells that there are, most corners first: their number, and the rows of the cells."""
        kinds = ((n, np.flatnonzero(self.widths == n)) for n in sorted(FACES_OF, reverse=True))
        return [(n, rows) for n, rows in kinds if len(rows)]

    def facets(self, width: int) -> tuple[Ints, NDArray[np.int32], Ints]:
        """Give the triangles (3) or quadrilaterals (4) of the boundary: corners, marker and building of each.

        Triangles between two regions are behind those of the boundary.
        """
        chosen = (self.outer[:, 3] != NO_CORNER) == (width == 4)
        found = self.outer[chosen, :width], self.marker[chosen], self.building[chosen]
        if width == 4:
            return found
        corners, marker, building = found
        return (
            np.concatenate((corners, self.between)),
            np.concatenate((marker, self.between_marker)),
            np.concatenate((building, self.between_building)),
        )


def find_centres(points: NDArray[np.float64], cells: NDArray[np.integer[Any]]) -> NDArray[np.float64]:
    """Give the mean of the corners of cells, (k, 4) or as of `PrismMesh`: float64 (k, d), of points (n, d)."""
    width = (cells != NO_CORNER).sum(axis=1)
    centres = np.empty((len(cells), points.shape[1]))
    for n in FACES_OF:
        rows = np.flatnonzero(width == n)
        centres[rows] = points[cells[rows, :n]].mean(axis=1)
    return centres


def check_cells(pieces: MeshPieces, kind: str, layers: int | None) -> int:
    """Check what cells are asked for, as of `read_prisms`; gives the number of layers."""
    if layers is not None and (kind != "hybrid" or layers < 1):
        raise ConfigError(f"--prism-layers {layers}: is for --cells hybrid, and 1 or more")
    if len(pieces.files.regions) > 1 and kind == "prism":
        what = "in buildings" if Region.BUILDING in pieces.files.regions else "in soil"
        option = "--solids" if Region.BUILDING in pieces.files.regions else "--underground"
        raise ConfigError(f"--cells {kind}: not with cells {what}; take --cells hybrid, or mesh without {option}")
    return LAYERS if layers is None else layers


def read_prisms(pieces: MeshPieces, kind: str = "prism", layers: int | None = None) -> PrismMesh:
    """Read the mesh of a run as prisms; soil and buildings stay tetrahedra.

    Parameters
    ----------
    pieces : MeshPieces
        The mesh.
    kind : {"prism", "hybrid"}
        Prisms alone; or prisms, and tetrahedra where columns have none, with a ring of cut prisms between them.
    layers : int, optional
        Of a hybrid mesh, how many prisms at most stand over each triangle of the ground and roofs; `LAYERS` by
        default.

    Raises
    ------
    ConfigError
        If buildings or soil have cells and all are to be prisms, or there are less than one layer, or layers
        without a hybrid mesh.
    InputError
        If some of its cells are no thirds of prisms, or a piece is damaged.

    Notes
    -----
    Memory is some 700 bytes for each prism.
    """
    layers = check_cells(pieces, kind, layers)
    points = np.empty((pieces.n_points, 3))
    cells, turned, facets, marker, building = [], [], [], [], []
    leaves: list[NDArray[np.float32]] = []
    regions: list[NDArray[np.int8]] = []
    for k in range(len(pieces.names)):
        piece = pieces.read(k)
        points[piece.ids] = piece.points
        rows, first, second_turned = combine_piece(piece, kind, layers)
        cells.append(np.where(rows == NO_CORNER, NO_CORNER, piece.ids[rows]))
        turned.append(second_turned)
        facets.append(piece.ids[piece.facets])
        marker.append(piece.marker)
        building.append(piece.building)
        leaves += [] if piece.leaves is None else [leaves_of(piece.leaves, rows, first)]
        regions += [] if piece.region is None else [piece.region[first]]
    tile = np.repeat(np.arange(len(cells), dtype=np.int32), [len(part) for part in cells])
    prisms, triangles = np.concatenate(cells), np.concatenate(facets)
    marks, houses = np.concatenate(marker), np.concatenate(building)
    density, region = _join(leaves), _join(regions)
    inside = find_inside(marks, pieces.files.regions) if region is not None else np.zeros(len(marks), np.bool_)
    between = triangles[inside], marks[inside], houses[inside]
    triangles, marks, houses = triangles[~inside], marks[~inside], houses[~inside]
    if kind == "hybrid":
        second = np.concatenate(turned)
        cut = find_cut_sides(prisms, second, triangles, np.column_stack((marks, houses)))
        prisms, parent, middle = split_prisms(prisms, second, cut, len(points))
        points = np.concatenate((points, points[middle].mean(axis=1)))
        tile, density = tile[parent], None if density is None else density[parent]
        region = None if region is None else region[parent]
    faces = pair_faces(*list_faces(prisms))
    first_half = find_facets(faces[3], triangles, marks)
    if (first_half < 0).any():
        raise InputError(
            f"{len(triangles)} facets do not cover the {len(faces[3])} faces of the boundary; run again"
        )
    found = marks[first_half], houses[first_half]
    mesh = PrismMesh(points, prisms, tile, *faces, *found, pieces.ground, density, region)
    return replace(mesh, between=between[0], between_marker=between[1], between_building=between[2])


def _join(parts: list[NDArray[Number]]) -> NDArray[Number] | None:
    return np.concatenate(parts) if parts else None


def combine_cells(cells: NDArray[np.int32]) -> tuple[NDArray[np.int32], NDArray[np.bool_]]:
    """Combine each three tetrahedra to a prism.

    Parameters
    ----------
    cells : int32, (3 m, 4)
        Tetrahedra as `pipeline.columns.columns.merge_columns` writes them.

    Returns
    -------
    int32, (m, 6)
        As `PrismMesh.cells`.
    bool, (m,)
        Whether the three fill a prism; the row means nothing where not.

    Examples
    --------
    >>> combine_cells(np.array([[0, 2, 4, 1], [4, 1, 2, 5], [2, 5, 1, 3]], np.int32))
    (array([[0, 2, 4, 1, 3, 5]], dtype=int32), array([ True]))
    """
    three = cells.reshape(-1, 3, 4)
    low, high = three[:, :, 0], three[:, :, 3]
    second, third = three[:, 0, 1], three[:, 0, 2]
    turned = second == low[:, 2]
    whole = np.where(turned, third, second) == low[:, 1]
    whole &= np.where(turned, second, third) == low[:, 2]
    wanted = np.stack(
        (
            np.column_stack((low[:, 1], low[:, 2], high[:, 0], high[:, 1])),
            np.column_stack((low[:, 2], high[:, 0], high[:, 1], high[:, 2])),
        ),
        axis=1,
    )
    whole &= (np.sort(wanted, axis=2) == np.sort(three[:, 1:], axis=2)).all(axis=(1, 2))
    over_second = np.where(turned, high[:, 2], high[:, 1])
    over_third = np.where(turned, high[:, 1], high[:, 2])
    return np.column_stack((low[:, 0], second, third, high[:, 0], over_second, over_third)), whole


Combined = tuple[NDArray[np.int32], NDArray[np.int64], NDArray[np.bool_]]


def combine_piece(piece: MeshPiece, kind: str, layers: int) -> Combined:
    """Give the cells of a piece, rows of its points as of `PrismMesh`.

    Returns
    -------
    int32, (m, 6)
        The cells.
    int64, (m,)
        The first tetrahedron of each.
    bool, (m,)
        Of prisms, whether the third column rises second.
    """
    return _prisms_of(piece) if kind == "prism" else _hybrid_of(piece, layers)


def leaves_of(density: NDArray[np.float32], cells: NDArray[np.int32], first: Ints) -> NDArray[np.float32]:
    """Give the leaf area density of cells of `combine_piece`: of a prism that of its middle tetrahedron."""
    found: NDArray[np.float32] = density[first + (cells[:, 4] != NO_CORNER)]
    return found


def _prisms_of(piece: MeshPiece) -> Combined:
    """Give the prisms of a piece, the first tetrahedron of each, and whether its third column rises second."""
    n = len(piece.cells) // 3
    prisms, whole = combine_cells(piece.cells[: 3 * n])
    if whole.all() and 3 * n == len(piece.cells):
        return prisms, np.arange(0, 3 * n, 3), _turns(piece.cells[::3], piece.cells[1::3])
    first = 3 * int(np.argmin(whole)) if not whole.all() else 3 * n
    x, y, z = piece.points[piece.cells[first]].mean(axis=0)
    raise InputError(
        f"tile {piece.name}: its cells are not all thirds of prisms, first at ({x:.1f}, {y:.1f}, {z:.1f}): levels "
        "of its columns merge; take --cells hybrid, or mesh with --mesher layered and without --underground"
    )


def _turns(first: NDArray[np.int32], second: NDArray[np.int32]) -> NDArray[np.bool_]:
    """Tell whether the upright edge of the second of three tetrahedra is over the third corner of the first."""
    turned: NDArray[np.bool_] = second[:, 0] == first[:, 2]
    return turned


def _hybrid_of(piece: MeshPiece, layers: int) -> Combined:
    """Give the cells of a piece as `_prisms_of` does: the lowest prisms over each triangle, and tetrahedra."""
    cells = piece.cells
    n = len(cells)
    prisms, whole = combine_cells(np.lib.stride_tricks.sliding_window_view(cells, 3, axis=0).swapaxes(1, 2))
    if piece.region is not None:  # cells of one region stand together
        whole &= (piece.region[:-2] == Region.AIR) & (piece.region[2:] == Region.AIR)
    # A cell stands on the one before it if that one's upper corners are its lower ones.
    stands = (np.sort(cells[1:, :3], axis=1) == np.sort(cells[:-1, 1:], axis=1)).all(axis=1)
    triangle = np.cumsum(np.concatenate(([0], ~stands)))
    chosen, free, last, count = [], 0, -1, 0
    for row, of in zip(np.flatnonzero(whole).tolist(), triangle[:-2][whole].tolist(), strict=True):
        count = count if of == last else 0
        last = of
        if row >= free and count < layers:
            chosen.append(row)
            free, count = row + 3, count + 1
    first = np.array(chosen, np.int64)
    alone = np.ones(n, np.bool_)
    for k in range(3):
        alone[first + k] = False
    tetrahedra = np.flatnonzero(alone)
    rows = np.full((len(first) + len(tetrahedra), 6), NO_CORNER, np.int32)
    rows[: len(first)], rows[len(first) :, :4] = prisms[first], cells[tetrahedra]
    turned = np.zeros(len(rows), np.bool_)
    turned[: len(first)] = _turns(cells[first], cells[first + 1])
    begin = np.concatenate((first, tetrahedra))
    order = np.argsort(begin)
    return rows[order], begin[order], turned[order]


def pair_faces(faces: NDArray[Number], cell: Ints) -> tuple[NDArray[Number], Ints, Ints, NDArray[Number], Ints]:
    """Find the faces between two cells and those of one, as `PrismMesh` has them."""
    group, n = group_rows(np.sort(faces, axis=1))
    order = np.argsort(group, kind="stable")
    last = np.cumsum(np.bincount(group, minlength=n)) - 1
    first = np.concatenate(([0], last[:-1] + 1))
    low, high = order[first], order[last]
    if (last - first > 1).any():
        raise InputError("a face of three cells; run again")
    alone, pair = low == high, np.flatnonzero(low != high)
    owner, neighbour = cell[low[pair]], cell[high[pair]]
    sequence = np.lexsort((neighbour, owner))
    outer = np.sort(low[alone])
    return faces[low[pair]][sequence], owner[sequence], neighbour[sequence], faces[outer], cell[outer]


def list_faces(cells: NDArray[Number]) -> tuple[NDArray[Number], Ints]:
    """List the faces of cells, (k, 4) as in `PrismMesh.outer`, and the cell of each, ascending."""
    width = (cells != NO_CORNER).sum(axis=1)
    padded = np.column_stack((cells, np.full(len(cells), NO_CORNER)))
    faces, of = [], []
    for corners, table in FACES_OF.items():
        rows = np.flatnonzero(width == corners)
        faces.append(padded[rows][:, table].reshape(-1, 4))
        of.append(np.repeat(rows, len(table)))
    cell = np.concatenate(of)
    order = np.argsort(cell, kind="stable")
    return np.concatenate(faces)[order], cell[order]


def find_facets(outer: Rows, facets: Rows, marker: NDArray[np.int32]) -> Ints:
    """Find the facets, triangles, that faces of one cell are made of.

    Parameters
    ----------
    outer : int32 or int64, (f, 4)
        The faces.
    facets, marker : int64 (k, 3) and int32 (k,)
        Facets of the boundary; both halves of a face must have one marker.

    Returns
    -------
    int64, (f,)
        Row of the first facet of each, -1 for a face that is none.

    Raises
    ------
    InputError
        If a facet is no face, or half of one.
    """
    quad = outer[:, 3] != NO_CORNER
    rows = np.concatenate((np.flatnonzero(~quad), np.repeat(np.flatnonzero(quad), 4)))
    halves = np.stack([np.delete(outer[quad], k, axis=1) for k in range(4)], axis=1).reshape(-1, 3)
    known = np.concatenate((outer[~quad, :3], halves))
    group, n = group_rows(np.sort(np.concatenate((known, facets)), axis=1))
    facet_of = np.full(n, -1)
    facet_of[group[len(known) :]] = np.arange(len(facets))
    found = facet_of[group[: len(known)]]
    has = found >= 0
    # Each face in turn: its first facet, and its last.
    pairs = np.full((len(outer), 2), -1)
    pairs[rows[has][::-1], 0] = found[has][::-1]
    pairs[rows[has], 1] = found[has]
    if has.sum() != len(facets) or (marker[pairs[:, 0]] != marker[pairs[:, 1]]).any():
        raise InputError(f"{len(facets)} facets are not the faces of cells, both halves of one marker; run again")
    first: Ints = pairs[:, 0]
    return first
