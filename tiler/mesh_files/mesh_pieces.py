"""The mesh of a finished run, piece by piece, with its points numbered from 0 on over the whole region (step 3.6).

What exporters are written on: one piece is in memory at a time, and the store is not read.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.data.errors import InputError
from pipeline.data.mesh import GROUND_PATCHES, Marker
from pipeline.data.regions import Region, Regions
from stitch.pieces.cell_faces import CellFaces
from stitch.pieces.numbering import Numbering
from tiler.mesh_files.merged import VERTEX_ID, number_piece, read_numbering
from tiler.mesh_files.run_files import RUN_RECORD, RunFiles, RunSource, find_files
from tiler.mesh_files.vtk_files import BoundaryPiece, VolumePiece, read_vtp, read_vtu
from tiler.store.run_folder import LEAVES, PATCH_OF_GROUND, REGION, read_run_record

SIDE = 1e-6  # m; how far from a side of the region a facet on it may be


@dataclass(frozen=True, eq=False)
class MeshPiece:
    """The part of the mesh that one tile holds: ``n`` points, ``m`` cells, ``f`` facets."""

    name: str  #: the tile, ``"60_-3"``: its column and row in the CRS
    points: NDArray[np.float64]  #: (n, 3): points that its cells use (m), from the origin of `RunFiles` on
    cells: NDArray[np.int32]  #: (m, 4): tetrahedra of positive volume, as rows of `points`
    #: (f, 3): facets of the region's boundary, as rows of `points`, counter-clockwise seen from outside; faces
    #: that it shares with another tile are not among them. Ground above soil, and walls and roofs of buildings
    #: with cells, are there although they are inside
    facets: NDArray[np.int32]
    #: (f,): `pipeline.data.mesh.Marker` of each facet; with land cover, `GROUND_PATCHES` and the number of its
    #: patch on ground that has one
    marker: NDArray[np.int32]
    building: NDArray[np.int64]  #: (f,): number of each facet's building, -1 where there is none
    #: (n,): number of each point over the whole region, 0 to ``n_points - 1`` of `MeshPieces`. A point that
    #: several tiles have is bitwise the same in all of them, and has one number
    ids: NDArray[np.int64]
    #: (m,): `pipeline.data.mesh.Region` of each cell; None where all is air
    region: NDArray[np.int8] | None = None
    #: (m,): leaf area density of each cell (m2/m3), 0 in open air; None in a run without trees
    leaves: NDArray[np.float32] | None = None
    regions: Regions = (Region.AIR,)  #: what cells of the whole mesh are filled with
    #: faces of cells that are no tetrahedra (`tiler.export.prism_pieces`): then rows of `cells` have six places,
    #: those of faces and `facets` four, with `tiler.mesh_files.transitions.NO_CORNER` in those that are left
    faces: CellFaces | None = None


@dataclass(frozen=True, eq=False)
class MeshPieces:
    """The pieces of a finished run."""

    names: tuple[str, ...]  #: its tiles, sorted
    files: RunFiles  #: the files that hold them, in the same order
    numbering: Numbering  #: from the ids in the pieces to numbers without gaps

    @property
    def n_points(self) -> int:
        """Number of different points of the whole mesh."""
        return self.numbering.n_points

    @property
    def ground(self) -> tuple[str, ...]:
        """Names of the patches of the ground, by number; none without land cover."""
        return self.files.ground_names

    def read(self, k: int) -> MeshPiece:
        """Read piece `k`.

        Raises
        ------
        InputError
            If a file of it is missing or damaged, or the two do not fit together.
        """
        path = self.files.volumes[k]
        volume, boundary = read_vtu(path), read_vtp(self.files.boundaries[k])
        return MeshPiece(
            self.names[k],
            volume.mesh.points - self.files.origin,
            volume.mesh.cells,
            _facets_in_volume(self.files.boundaries[k], volume, boundary),
            mark_facets(self.files, self.files.boundaries[k], boundary),
            boundary.boundary.building,
            number_piece(path, volume.point_data.get(VERTEX_ID), self.numbering),
            read_regions(path, volume, self.files.regions) if len(self.files.regions) > 1 else None,
            read_leaves(path, volume) if self.files.leaves else None,
            self.files.regions,
        )


def mark_facets(files: RunFiles, path: Path, piece: BoundaryPiece) -> NDArray[np.int32]:
    """Give the markers of a boundary piece as `MeshPiece` has them.

    Raises
    ------
    InputError
        If the run has land cover, and the piece does not tell the patch of all ground.
    """
    marker = _mark_sides(files, piece)
    if not files.ground:
        return marker
    patch = piece.cell_data.get(PATCH_OF_GROUND)
    on_ground = marker == Marker.GROUND
    if (
        patch is None
        or patch.shape != marker.shape
        or not np.isin(patch[on_ground], range(len(files.ground))).all()
    ):
        raise InputError(
            f"{path}: has no cell array {PATCH_OF_GROUND!r} of 0 to {len(files.ground) - 1}; run the tile again"
        )
    of_patch = on_ground & (patch > 0)
    return np.where(of_patch, GROUND_PATCHES + patch.astype(np.int32), marker)


def _mark_sides(files: RunFiles, piece: BoundaryPiece) -> NDArray[np.int32]:
    """Give the markers of a boundary piece; the outer sides of a part of a mesh are those of its region.

    A side of the whole mesh that lies towards a tile that is not there is ``missing``; where it is the westernmost
    of the part that is taken alone, it is its west side, and so on.
    """
    marker = piece.boundary.marker
    if files.sides is None:
        return marker
    marker = marker.copy()
    rows = np.flatnonzero(marker == Marker.MISSING)
    corners = piece.points[piece.boundary.facets[rows], :2]
    west, south, east, north = files.sides
    for axis, side, name in (
        (0, west, Marker.WEST),
        (0, east, Marker.EAST),
        (1, south, Marker.SOUTH),
        (1, north, Marker.NORTH),
    ):
        marker[rows[(np.abs(corners[:, :, axis] - side) <= SIDE).all(axis=1)]] = name
    return marker


def open_pieces(source: RunSource) -> MeshPieces:
    """Open the mesh of a finished run.

    Parameters
    ----------
    source : Path or RunFiles
        Folder of the run, or the files of it that are wanted.

    Raises
    ------
    InputError
        If the folder holds no finished run, or a file of it is missing or damaged.

    Notes
    -----
    The ids of all points are read once, a piece at a time; memory holds some 100 bytes for each tile's parts.
    """
    files = source if isinstance(source, RunFiles) else find_files(source)
    directory = files.directory
    names = tuple(path.stem for path in files.volumes)
    if names != tuple(path.stem for path in files.boundaries) or list(names) != sorted(set(names)):
        raise InputError(f"{directory}: the indexes of mesh and boundary name other tiles; run again")
    numbering = read_numbering(files.volumes)
    counted = read_run_record(directory / RUN_RECORD).counts["points"]
    if files.whole and numbering.n_points != counted:
        raise InputError(
            f"{directory}: its pieces have {numbering.n_points} different {VERTEX_ID}, {RUN_RECORD} says "
            f"{counted} points; run again"
        )
    return MeshPieces(names, files, numbering)


def read_leaves(path: Path, volume: VolumePiece) -> NDArray[np.float32]:
    """Take the leaf area density of the cells of a piece (m2/m3); InputError where it has none."""
    leaves = volume.cell_data.get(LEAVES)
    if (
        leaves is None
        or leaves.dtype != np.float32
        or leaves.ndim != 1
        or not ((leaves >= 0) & (leaves < 1e3)).all()
    ):
        raise InputError(f"{path}: has no cell array {LEAVES!r} of leaf area densities; run the tile again")
    return leaves


def read_regions(path: Path, volume: VolumePiece, regions: Regions) -> NDArray[np.int8]:
    """Take the `pipeline.data.mesh.Region` of each cell of a piece; InputError where it has none, or others."""
    region = volume.cell_data.get(REGION)
    if region is None or region.dtype != np.int8 or not np.isin(region, regions).all():
        known = " and ".join(f"{value:d} ({value.name.lower()})" for value in regions)
        raise InputError(f"{path}: has no cell array {REGION!r} of {known} alone; run the tile again")
    return region


def _facets_in_volume(path: Path, volume: VolumePiece, boundary: BoundaryPiece) -> NDArray[np.int32]:
    """Give facets as rows of the volume's points."""
    vertex, points = boundary.vertex, volume.mesh.points
    if vertex.size and (vertex.min() < 0 or vertex.max() >= len(points)):
        raise InputError(
            f"{path}: vertex {vertex.min()}..{vertex.max()} of the volume's {len(points)}; run the tile again"
        )
    if points[vertex].tobytes() != boundary.points.tobytes():
        raise InputError(f"{path}: its points are not those of the volume; run the tile again")
    return vertex.astype(np.int32)[boundary.boundary.facets]
