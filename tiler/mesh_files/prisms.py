"""Columns of cells as prisms: three tetrahedra that fill a prism between two levels become one cell (step 3.6).

Columns of the layered mesher have as many levels on all sides of a cell, and their tetrahedra stand by threes. In
other columns levels merge, and cells of neighbours would not meet side by side: such a mesh is refused.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.data.errors import ConfigError, InputError
from pipeline.data.regions import Region
from stitch.pieces.conformity import group_rows
from tiler.mesh_files.mesh_pieces import MeshPiece, MeshPieces

Ints = NDArray[np.int64]
# Faces of a prism by its corners, counter-clockwise seen from outside: three or four of them.
ENDS = np.array([[0, 2, 1], [3, 4, 5]])
SIDES = np.array([[0, 1, 4, 3], [1, 2, 5, 4], [2, 0, 3, 5]])
NO_CORNER = -1  # in the place of a triangle's fourth corner


@dataclass(frozen=True, eq=False)
class PrismMesh:
    """The mesh of a run as ``m`` prisms on ``n`` points, and its faces; all of it is in memory.

    Attributes
    ----------
    points : float64, (n, 3)
        Points (m), by their numbers over the region.
    cells : int64, (m, 6)
        A triangle, counter-clockwise seen from above, and the corners over it.
    tile : int32, (m,)
        Which tile each is of, counted from 0 by name.
    inner : int64, (i, 4)
        Faces between two cells, out of the lower one; `NO_CORNER` in the last place of a triangle.
    owner, neighbour : int64, (i,)
        The two cells of each, ascending pairs.
    outer : int64, (f, 4)
        Faces of the boundary, counter-clockwise seen from outside; as `inner`.
    outer_cell : int64, (f,)
        Their cells, ascending.
    marker : int32, (f,)
        `pipeline.data.mesh.Marker` of each of them.
    building : int64, (f,)
        Number of its building, -1 where there is none.
    ground : tuple of str
        Names of the patches of the ground, by number; none without land cover.
    leaves : float32, (m,), or None
        Leaf area density of each cell (m2/m3), that of the middle one of its three tetrahedra; None without trees.
    """

    points: NDArray[np.float64]
    cells: Ints
    tile: NDArray[np.int32]
    inner: Ints
    owner: Ints
    neighbour: Ints
    outer: Ints
    outer_cell: Ints
    marker: NDArray[np.int32]
    building: Ints
    ground: tuple[str, ...] = ()
    leaves: NDArray[np.float32] | None = None

    def facets(self, width: int) -> tuple[Ints, NDArray[np.int32], Ints]:
        """Give the triangles (3) or quadrilaterals (4) of the boundary: corners, marker and building of each."""
        chosen = (self.outer[:, 3] != NO_CORNER) == (width == 4)
        return self.outer[chosen, :width], self.marker[chosen], self.building[chosen]


def read_prisms(pieces: MeshPieces) -> PrismMesh:
    """Read the mesh of a run as prisms.

    Parameters
    ----------
    pieces : MeshPieces
        The mesh.

    Raises
    ------
    ConfigError
        If buildings have cells.
    InputError
        If some of its cells are no thirds of prisms, or a piece is damaged.

    Notes
    -----
    Memory is some 700 bytes for each prism.
    """
    if Region.BUILDING in pieces.files.regions:
        raise ConfigError("--cells prism: not with cells in buildings; leave it out, or mesh without --solids")
    points = np.empty((pieces.n_points, 3))
    cells, facets, marker, building = [], [], [], []
    leaves: list[NDArray[np.float32]] = []
    for k in range(len(pieces.names)):
        piece = pieces.read(k)
        points[piece.ids] = piece.points
        cells.append(piece.ids[_prisms_of(piece)])
        facets.append(piece.ids[piece.facets])
        marker.append(piece.marker)
        building.append(piece.building)
        leaves += [] if piece.leaves is None else [piece.leaves[1::3]]
    tile = np.repeat(np.arange(len(cells), dtype=np.int32), [len(part) for part in cells])
    prisms = np.concatenate(cells)
    inner, owner, neighbour, outer, outer_cell = _pair_faces(prisms)
    row = _find_facets(outer, np.concatenate(facets))
    marks, houses = np.concatenate(marker), np.concatenate(building)
    if (np.append(marks, 0)[row] != marks[row[:, :1]]).any():
        raise InputError(f"{pieces.files.directory}: halves of a face have different markers; run again")
    first = row[:, 0]
    faces = inner, owner, neighbour, outer, outer_cell
    return PrismMesh(points, prisms, tile, *faces, marks[first], houses[first], pieces.ground, _join(leaves))


def _join(leaves: list[NDArray[np.float32]]) -> NDArray[np.float32] | None:
    return np.concatenate(leaves) if leaves else None


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


def _prisms_of(piece: MeshPiece) -> NDArray[np.int32]:
    n = len(piece.cells) // 3
    prisms, whole = combine_cells(piece.cells[: 3 * n])
    if whole.all() and 3 * n == len(piece.cells):
        return prisms
    first = 3 * int(np.argmin(whole)) if not whole.all() else 3 * n
    x, y, z = piece.points[piece.cells[first]].mean(axis=0)
    raise InputError(
        f"tile {piece.name}: its cells are not all thirds of prisms, first at ({x:.1f}, {y:.1f}, {z:.1f}): levels "
        "of its columns merge; mesh with --mesher layered and without --underground, or leave --cells prism out"
    )


def _pair_faces(cells: Ints) -> tuple[Ints, Ints, Ints, Ints, Ints]:
    """Find the faces between two cells and those of one, as `PrismMesh` has them."""
    ends = np.full((len(cells), 2, 4), NO_CORNER)
    ends[:, :, :3] = cells[:, ENDS]
    faces = np.concatenate((ends, cells[:, SIDES]), axis=1).reshape(-1, 4)
    group, n = group_rows(np.sort(faces, axis=1))
    order = np.argsort(group, kind="stable")
    last = np.cumsum(np.bincount(group, minlength=n)) - 1
    first = np.concatenate(([0], last[:-1] + 1))
    low, high = order[first], order[last]
    if (last - first > 1).any():
        raise InputError("a face of three cells; run again")
    alone, pair = low == high, np.flatnonzero(low != high)
    owner, neighbour = low[pair] // 5, high[pair] // 5
    sequence = np.lexsort((neighbour, owner))
    outer = np.sort(low[alone])
    return faces[low[pair]][sequence], owner[sequence], neighbour[sequence], faces[outer], outer // 5


def _find_facets(outer: Ints, facets: Ints) -> Ints:
    """Rows of the facets (triangles) that each face of the boundary is made of: int64 (f, 2), one twice or two."""
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
    if (pairs < 0).any() or has.sum() != len(facets):
        raise InputError(f"{len(facets)} facets do not cover the {len(outer)} faces of the boundary; run again")
    return pairs
