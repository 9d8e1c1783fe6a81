"""The air of a mesh that has soil, or cells in buildings, as a mesh of its own: what the wind blows through."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipeline.data.regions import Region
from stitch.pieces.conformity import group_rows
from stitch.pieces.face_mates import NO_MATE, find_mates, take_faces
from stitch.pieces.numbering import collect_ids, number_without_gaps
from tiler.mesh_files.mesh_pieces import MeshPiece, MeshPieces


@dataclass(frozen=True, eq=False)
class AirPieces(MeshPieces):
    """The air of the pieces of a run, its points numbered from 0 on."""

    whole: MeshPieces  #: all regions

    def read(self, k: int) -> MeshPiece:
        """Read the air of piece `k`; ground, walls and roofs bound it."""
        piece = self.whole.read(k)
        cells = _air_of(piece)
        outer = take_faces(cells, np.flatnonzero(find_mates(cells, len(piece.points)) == NO_MATE))
        group, n = group_rows(np.sort(np.concatenate((outer, piece.facets)), axis=1))
        known = np.zeros(n, np.bool_)
        known[group[: len(outer)]] = True
        chosen = known[group[len(outer) :]]
        used, rows = np.unique(cells, return_inverse=True)
        place = np.zeros(len(piece.points), np.int32)
        place[used] = np.arange(len(used))
        return replace(
            piece,
            points=piece.points[used],
            cells=rows.reshape(cells.shape).astype(np.int32),
            facets=place[piece.facets[chosen]],
            marker=piece.marker[chosen],
            building=piece.building[chosen],
            ids=number_without_gaps(self.numbering, piece.ids[used]),
            region=None,
            leaves=None if piece.leaves is None else piece.leaves[_find_air(piece)],
            regions=(Region.AIR,),
        )


def open_air(pieces: MeshPieces) -> MeshPieces:
    """Take the air of a mesh; reads all pieces once if it has other regions, else gives the mesh itself."""
    if len(pieces.files.regions) == 1:
        return pieces
    read = map(pieces.read, range(len(pieces.names)))
    numbering = collect_ids(np.unique(piece.ids[_air_of(piece)]) for piece in read)
    return AirPieces(pieces.names, replace(pieces.files, regions=(Region.AIR,), depth=0.0), numbering, pieces)


def _find_air(piece: MeshPiece) -> NDArray[np.bool_]:
    return np.ones(len(piece.cells), np.bool_) if piece.region is None else piece.region == Region.AIR


def _air_of(piece: MeshPiece) -> NDArray[np.int32]:
    return np.ascontiguousarray(piece.cells[_find_air(piece)])
