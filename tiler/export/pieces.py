"""What writers ask of a mesh: its pieces, one at a time."""

from typing import Protocol

from tiler.mesh_files.mesh_pieces import MeshPiece


class Pieces(Protocol):
    """A mesh in pieces, as `tiler.mesh_files.mesh_pieces.MeshPieces` has them of a run."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the pieces, in their order."""

    @property
    def n_points(self) -> int:
        """Number of different points of the whole mesh."""

    def read(self, k: int) -> MeshPiece:
        """Read piece `k`."""
