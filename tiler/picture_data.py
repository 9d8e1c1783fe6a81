"""What a picture of a run is made from: its boundary and its volume cut open, gathered piece by piece."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import InputError
from pipeline.mesh import Marker, Region, TetMesh
from tiler.run_folder import REGION
from tiler.vtk_files import TETRA, BoundaryPiece, VolumePiece, read_piece_paths, read_vtp, read_vtu

BOUNDARY_INDEX, VOLUME_INDEX = "boundary.pvtp", "mesh.pvtu"
SHOWN = (Marker.GROUND, Marker.WALL, Marker.ROOF)
# Facets that a picture may have. Two million took 0.9 GB, and each further million takes about 0.2.
MOST_FACETS = 20_000_000


@dataclass(frozen=True, eq=False)
class City:
    """The boundary, moved to the origin.

    Attributes
    ----------
    points : float64, (n, 3)
        Vertices (m) from `origin`, each once.
    facets : int64, (k, 3)
        Ground, walls and roofs, counter-clockwise seen from the air.
    marker : int32, (k,)
        `Marker` of each facet.
    building : int64, (k,)
        Number of the building of each facet, -1 on the ground.
    piece : int32, (k,)
        Row of `names` for each facet.
    names : tuple of str
        Names of the pieces, which are those of tiles.
    origin : float64, (3,)
        Middle of the region, at the height of the lowest ground.
    """

    points: NDArray[np.float64]
    facets: NDArray[np.int64]
    marker: NDArray[np.int32]
    building: NDArray[np.int64]
    piece: NDArray[np.int32]
    names: tuple[str, ...]
    origin: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Air:
    """The surface of the cells behind a cut.

    Attributes
    ----------
    points : float64, (n, 3)
        Vertices (m) from the city's origin, each once.
    facets : int64, (k, 3)
        Triangles, all of them between the cells and what is not among them.
    """

    points: NDArray[np.float64]
    facets: NDArray[np.int64]


def load_city(directory: Path, *, most: int = MOST_FACETS) -> City:
    """Read ground, walls and roofs of all pieces of ``boundary.pvtp``, and sew them together.

    Parameters
    ----------
    directory : Path
        Folder of a run.
    most : int
        Facets that there may be.

    Raises
    ------
    InputError
        If the file or a piece of it is missing or damaged, if there is no ground, or more facets than `most`.

    Notes
    -----
    Vertices on seams have the same bytes in both pieces, so that sewing needs no tolerance, and the picture
    has no lines between tiles. Memory holds one whole piece, and of all of them what is shown.
    """
    paths = _find_pieces(directory / BOUNDARY_INDEX)
    points, facets, marker, building, piece = [], [], [], [], []
    n_points = n_facets = n_read = 0
    for row, path in enumerate(paths):
        part = read_vtp(path)
        n_read += len(part.boundary.facets)
        shown = np.isin(part.boundary.marker, SHOWN)
        n_facets += int(shown.sum())
        if n_facets > most:
            raise InputError(
                f"{directory}: after {row + 1} of {len(paths)} pieces there are {n_facets} facets to draw, more "
                f"than {most}; open {BOUNDARY_INDEX} in ParaView, or run a part of the region (--bounds)"
            )
        used, corners = _keep_used(part, shown)
        points.append(used)
        facets.append(corners + n_points)
        marker.append(part.boundary.marker[shown])
        building.append(part.boundary.building[shown])
        piece.append(np.full(len(corners), row, np.int32))
        n_points += len(used)
    marks = np.concatenate(marker)
    if not np.any(marks == Marker.GROUND):
        raise InputError(f"{directory / BOUNDARY_INDEX}: none of {n_read} facets is marked as ground; run again")
    xyz, corners = sew(np.concatenate(points), np.concatenate(facets))
    low, high = xyz.min(axis=0), xyz.max(axis=0)
    origin = np.array([*(low + high)[:2] / 2, low[2]])
    return City(
        points=xyz - origin,
        facets=corners[:, ::-1],  # the file's look out of the air, which is where the camera is
        marker=marks,
        building=np.concatenate(building),
        piece=np.concatenate(piece),
        names=tuple(path.stem for path in paths),
        origin=origin,
    )


def load_air(directory: Path, origin: NDArray[np.float64]) -> Air:
    """Read the surface of the whole tetrahedra in the northern half, from ``mesh.pvtu``.

    Parameters
    ----------
    directory : Path
        Folder of a run.
    origin : float64, (3,)
        Where the city was moved from (m); the cut is there.

    Raises
    ------
    InputError
        If the file or a piece of it is missing or damaged, or has no cell there.

    Notes
    -----
    Memory holds one whole piece, and of all of them the surface: faces that two pieces share are not on it.
    """
    points, facets, n_points = [], [], 0
    for path in _find_pieces(directory / VOLUME_INDEX):
        shell = _find_shell(_take_air(read_vtu(path)), float(origin[1]))
        points.append(shell.points)
        facets.append(shell.facets + n_points)
        n_points += len(shell.points)
    if not n_points:
        raise InputError(f"{directory / VOLUME_INDEX}: has no cell north of y = {origin[1]:.1f} m; run again")
    xyz, corners = sew(np.concatenate(points), np.concatenate(facets))
    return Air(xyz - origin, corners[_find_single(corners)])


def sew(points: NDArray[np.float64], facets: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Keep the points that facets use, equal ones once.

    Examples
    --------
    >>> points, facets = sew(np.array([[0.0, 1, 0], [7, 7, 7], [0, 1, 0], [0, 0, 0]]), np.array([[0, 3, 2]]))
    >>> points.tolist(), facets.tolist()
    ([[0.0, 0.0, 0.0], [0.0, 1.0, 0.0]], [[1, 0, 1]])
    """
    used = np.unique(facets)
    order = used[np.lexsort(points[used].T)]
    new = np.ones(len(order), dtype=np.bool_)
    new[1:] = np.any(points[order[1:]] != points[order[:-1]], axis=1)
    index = np.empty(len(points), dtype=np.int64)
    index[order] = np.cumsum(new) - 1
    return points[order[new]], index[facets]


def _find_pieces(path: Path) -> list[Path]:
    if not path.is_file():
        raise InputError(f"{path}: no such file; run citystitch first, or name its output folder")
    return read_piece_paths(path)


def _keep_used(part: BoundaryPiece, shown: NDArray[np.bool_]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    facets = part.boundary.facets[shown]
    used, corners = np.unique(facets, return_inverse=True)
    return part.points[used], corners.reshape(-1, 3).astype(np.int64, copy=False)


def _take_air(piece: VolumePiece) -> TetMesh:
    """Leave out the soil, if there is some."""
    region = piece.cell_data.get(REGION)
    return piece.mesh if region is None else TetMesh(piece.mesh.points, piece.mesh.cells[region == Region.AIR])


def _find_shell(mesh: TetMesh, south: float) -> Air:
    """Surface of the cells whose middle is north of a line."""
    import pyvista

    cells = mesh.cells[mesh.points[mesh.cells, 1].mean(axis=1) > south]
    if len(cells) == 0:
        return Air(np.empty((0, 3)), np.empty((0, 3), np.int64))
    shell = pyvista.UnstructuredGrid({TETRA: cells}, mesh.points).extract_surface(algorithm=None)
    return Air(np.asarray(shell.points, np.float64), np.asarray(shell.regular_faces, np.int64))


def _find_single(facets: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Tell which triangles there are once, whatever the order of their corners."""
    corners = np.sort(facets, axis=1)
    order = np.lexsort(corners.T)
    same = np.all(corners[order[1:]] == corners[order[:-1]], axis=1)
    single = np.ones(len(facets), np.bool_)
    single[order[1:][same]] = single[order[:-1][same]] = False
    return single
