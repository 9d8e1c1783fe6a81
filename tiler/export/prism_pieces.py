"""The mesh of a run as prisms and other cells, piece by piece: polyhedra, of which OpenFOAM takes any.

A prism beside tetrahedra keeps its shape, and has two triangles for such a side. Whether a side on a seam stays
whole depends on the tile beyond, so sides wait for it once, and what they are then stands in a file.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from stitch.pieces.cell_faces import CellFaces
from tiler.export.region_faces import NOTHING, faces_of_piece, find_outer, meet
from tiler.mesh_files.mesh_pieces import MeshPiece, MeshPieces
from tiler.mesh_files.prisms import check_cells, combine_piece, find_facets, leaves_of, list_faces, pair_faces
from tiler.mesh_files.transitions import NO_CORNER, find_cut_sides, find_seam_sides, halve_sides


@dataclass(frozen=True, eq=False)
class PrismPieces:
    """The pieces of a run as prisms and tetrahedra."""

    source: MeshPieces  #: the tetrahedra
    kind: str  #: see `tiler.mesh_files.prisms.read_prisms`
    layers: int  #: of a hybrid mesh
    cut: Path  #: of a hybrid mesh, the file of which sides of cells are two triangles, bool (m, 3)
    start: list[int]  #: where each piece begins in it

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the pieces, in their order."""
        return self.source.names

    @property
    def n_points(self) -> int:
        """Number of different points of the whole mesh."""
        return self.source.n_points

    @property
    def ground(self) -> tuple[str, ...]:
        """Names of the patches of the ground, by number; none without land cover."""
        return self.source.ground

    def read(self, k: int) -> MeshPiece:
        """Read piece `k`; facets between two regions are behind those of the boundary."""
        piece = self.source.read(k)
        cells, first, turned = combine_piece(piece, self.kind, self.layers)
        faces, of = list_faces(cells)
        if self.kind == "hybrid":
            cut = np.fromfile(self.cut, np.bool_, 3 * len(cells), offset=self.start[k]).reshape(-1, 3)
            faces, of = halve_sides(faces, of, cells, turned, cut)
        inner, owner, neighbour, outer, outer_cell = pair_faces(faces, of)
        bounding = find_outer(piece)
        row = find_facets(outer, piece.facets[bounding], piece.marker[bounding])
        on = row >= 0
        rows = np.concatenate((np.flatnonzero(bounding)[row[on]], np.flatnonzero(~bounding)))
        between = np.pad(piece.facets[~bounding], ((0, 0), (0, 1)), constant_values=NO_CORNER)
        return replace(
            piece,
            cells=cells,
            facets=np.concatenate((outer[on], between)),
            marker=piece.marker[rows],
            building=piece.building[rows],
            region=None if piece.region is None else piece.region[first],
            leaves=None if piece.leaves is None else leaves_of(piece.leaves, cells, first),
            faces=CellFaces(
                owner.astype(np.int32),
                neighbour.astype(np.int32),
                inner,
                outer_cell[on].astype(np.int32),
                outer_cell[~on].astype(np.int32),
                outer[~on],
            ),
        )


def open_prisms(pieces: MeshPieces, kind: str, layers: int | None, folder: Path) -> PrismPieces:
    """Open the mesh of a run as prisms and tetrahedra.

    Parameters
    ----------
    pieces : MeshPieces
        The tetrahedra; read once if they are not all prisms.
    kind, layers
        See `tiler.mesh_files.prisms.read_prisms`, also for errors.
    folder : Path
        An existing folder for files; they must stay as long as the result is used.

    Notes
    -----
    Memory: one piece with its faces, some 700 bytes a prism, and the sides on seams that wait for another piece,
    40 bytes each. Files: 3 bytes a cell of a hybrid mesh.
    """
    found = PrismPieces(pieces, kind, check_cells(pieces, kind, layers), folder / "cut", [0])
    waiting = NOTHING
    for k in range(len(pieces.names) if kind == "hybrid" else 0):
        piece = pieces.read(k)
        cells, _, turned = combine_piece(piece, kind, found.layers)
        outer = find_outer(piece)
        label = np.column_stack((piece.marker, piece.building))[outer]
        cut = find_cut_sides(cells, turned, piece.facets[outer], label.astype(np.int64))
        place, corners = find_seam_sides(cells, turned, cut, faces_of_piece(piece).shared)
        with found.cut.open("ab") as file:
            cut.tofile(file)
        waiting, whole = meet(waiting, piece.ids[corners], found.start[k] + place, piece.name)
        np.memmap(found.cut, np.bool_, "r+")[whole.ravel()] = False
        found.start.append(found.start[k] + cut.size)
    return found
