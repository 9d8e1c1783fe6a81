"""What a picture of a run is made from: its boundary and its volume cut open, gathered piece by piece."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.data.errors import InputError
from pipeline.data.mesh import Marker
from pipeline.data.regions import Region
from stitch.tiling.grid import Key
from tiler.config.zone_levels import find_levels
from tiler.engine.run_context import tile_key
from tiler.mesh_files.facet_quality import measure_facets, name_facets
from tiler.mesh_files.vtk_files import TETRA, BoundaryPiece, read_piece_paths, read_vtp, read_vtu
from tiler.store.out_folder import RUN_RECORD, STORE
from tiler.store.run_folder import REGION, read_run_record
from tiler.store.store import Store

BOUNDARY_INDEX, VOLUME_INDEX = "boundary.pvtp", "mesh.pvtu"
SHOWN = (Marker.GROUND, Marker.WALL, Marker.ROOF)
MOST_BYTES = 80_000_000  # of the files of cells that are shown one by one: some 10 million cells
STRIP_CELLS = 500_000  # whose faces are found together
MOST_FACETS = 600_000  # of a picture of 1.6 million pixels; those of larger regions are made coarser
FIRST_STEP = 1.0  # m, between vertices that are made one; doubled until there are few enough


@dataclass(frozen=True, eq=False)
class Facets:
    """Marked triangles."""

    points: NDArray[np.float64]  #: (n, 3): vertices in the CRS (m)
    corners: NDArray[np.int64]  #: (k, 3): rows of `points`
    #: (k,): `pipeline.data.mesh.Marker`, and row of the piece that each is of
    marker: NDArray[np.int32]
    piece: NDArray[np.int32]
    building: NDArray[np.int64]  #: (k,): number of the building, -1 on the ground
    quality: NDArray[np.float32]  #: (k,): radius ratio of the cell behind each; NaN where nobody asked

    def __len__(self) -> int:
        return len(self.corners)


def join_facets(parts: list[Facets]) -> Facets:
    """Put parts together, at least one; equal points stay apart."""
    first = np.cumsum([0, *(len(part.points) for part in parts)])
    return Facets(
        np.concatenate([part.points for part in parts]),
        np.concatenate([part.corners + begin for part, begin in zip(parts, first, strict=False)]),
        *(
            np.concatenate([getattr(part, name) for part in parts])
            for name in ("marker", "piece", "building", "quality")
        ),
    )


def coarsen(facets: Facets, size: float) -> Facets:
    """Make the vertices in each cell of a grid one, and drop triangles that lose their area or are there already.

    Parameters
    ----------
    facets : Facets
        Triangles.
    size : float
        Side of a cell (m). The grid is that of the CRS, so that tiles agree, and a grid twice as wide contains it.

    Returns
    -------
    Facets
        Vertices stand in the middle of their cell, as high as the mean of those in it. Of equal triangles the one
        with the worst quality stays.

    Examples
    --------
    >>> points = np.array([[0.0, 0, 0], [4, 0, 0], [4, 4, 0], [4.5, 4.5, 0]])
    >>> mark = np.ones(2, np.int32)
    >>> part = Facets(points, np.array([[0, 1, 2], [0, 2, 3]]), mark, mark, np.arange(2), np.zeros(2, np.float32))
    >>> coarse = coarsen(part, 2.0)
    >>> coarse.points.tolist(), coarse.building.tolist()
    ([[1.0, 1.0, 0.0], [5.0, 1.0, 0.0], [5.0, 5.0, 0.0]], [0])
    """
    cell = np.floor(facets.points / size).astype(np.int64)
    low = cell.min(axis=0)
    extent = cell.max(axis=0) - low + 1
    key = ((cell - low) * (1, extent[0], extent[0] * extent[1])).sum(axis=1)
    _, first, row = np.unique(key, return_index=True, return_inverse=True)
    row = row.reshape(-1)
    points: NDArray[np.float64] = ((cell[first] + 0.5) * size).astype(np.float64)
    points[:, 2] = np.bincount(row, facets.points[:, 2]) / np.bincount(row)
    corners = row[facets.corners]
    a, b, c = corners.T
    kept = np.flatnonzero((a != b) & (b != c) & (c != a))
    name = name_facets(corners[kept], len(points))
    order = np.lexsort((facets.quality[kept], facets.marker[kept], name))
    same = (np.diff(name[order]) == 0) & (np.diff(facets.marker[kept][order]) == 0)
    kept = np.sort(kept[order[np.concatenate([[True], ~same])[: len(order)]]])
    used, corners = np.unique(corners[kept], return_inverse=True)
    return Facets(
        points[used],
        corners.reshape(-1, 3),
        facets.marker[kept],
        facets.piece[kept],
        facets.building[kept],
        facets.quality[kept],
    )


@dataclass(frozen=True, eq=False)
class City:
    """The boundary, moved to the origin."""

    points: NDArray[np.float64]  #: (n, 3): vertices (m) from `origin`, each once
    facets: NDArray[np.int32]  #: (k, 3): ground, walls and roofs, counter-clockwise seen from the air
    marker: NDArray[np.int32]  #: (k,): `Marker` of each facet
    building: NDArray[np.int64]  #: (k,): number of the building of each facet, -1 on the ground
    piece: NDArray[np.int32]  #: (k,): row of `names` for each facet
    names: tuple[str, ...]  #: names of the pieces, which are those of tiles
    origin: NDArray[np.float64]  #: (3,): middle of the region, at the height of the lowest ground
    #: (k,): radius ratio of the cell behind each facet; none where nobody asked
    quality: NDArray[np.float32] = field(default_factory=lambda: np.empty(0, np.float32))
    step: float = 0.0  #: vertices closer than some of this are one (m); 0 where all are shown
    #: (k,): level of detail of each facet, see `load_levels`; none where nobody asked
    level: NDArray[np.int8] = field(default_factory=lambda: np.empty(0, np.int8))


def find_middle(directory: Path, *, most: int = MOST_BYTES) -> frozenset[str] | None:
    """Find the tiles around the middle of a region whose volume is small enough to be shown cell by cell.

    Parameters
    ----------
    directory : Path
        Folder of a run.
    most : int
        Size that the files of their cells may have (bytes).

    Returns
    -------
    frozenset of str or None
        Names of at least one tile; None where all are few enough.

    Raises
    ------
    InputError
        If a file is missing, or a piece is not named after a tile.
    """
    paths = _find_pieces(directory / VOLUME_INDEX)
    try:
        sizes = [path.stat().st_size for path in paths]
    except OSError as error:
        raise InputError(f"{error.filename}: cannot be read ({error.strerror}); run again") from error
    if sum(sizes) <= most:
        return None
    keys = np.array([read_key(path.stem) for path in paths])
    ring = np.abs(keys - (keys.min(axis=0) + keys.max(axis=0)) // 2).max(axis=1)
    ring -= ring.min()
    total = np.cumsum(np.bincount(ring, sizes))
    last = max(0, int(np.searchsorted(total, most, side="right")) - 1)
    return frozenset(path.stem for path, k in zip(paths, ring.tolist(), strict=True) if k <= last)


def load_city(
    directory: Path,
    *,
    most: int = MOST_FACETS,
    quality: bool = False,
    only: frozenset[str] | None = None,
) -> City:
    """Read ground, walls and roofs of all pieces of ``boundary.pvtp``, and sew them together.

    Parameters
    ----------
    directory : Path
        Folder of a run.
    most : int
        Facets from which on they are made coarser (`tiler.pictures.picture_data`).
    quality : bool
        Read ``mesh.pvtu`` too, for the radius ratio of the cell behind each facet.
    only : frozenset of str, optional
        Names of the pieces to read, all by default.

    Raises
    ------
    InputError
        If a file or a piece of it is missing or damaged, or if there is no ground.

    Notes
    -----
    Vertices on seams have the same bytes in both pieces, so that sewing needs no tolerance, and the picture
    has no lines between tiles. Memory holds one whole piece, and of all of them what is shown: at most two times
    `most` facets.
    """
    paths = _find_pieces(directory / BOUNDARY_INDEX, only)
    volumes = _find_volumes(directory, paths) if quality else []
    parts: list[Facets] = []
    n_facets, n_read, step = 0, 0, 0.0
    for row, path in enumerate(paths):
        piece = read_vtp(path)
        n_read += len(piece.boundary.facets)
        part = _take_shown(piece, row, volumes[row] if quality else None)
        part = coarsen(part, step) if step and len(part) else part
        parts.append(part)
        n_facets += len(part)
        while n_facets > most:
            step = 2 * step if step else FIRST_STEP
            parts = [coarsen(join_facets(parts), step)]
            n_facets = len(parts[0])
    found = join_facets(parts)
    if not np.any(found.marker == Marker.GROUND):
        raise InputError(f"{directory / BOUNDARY_INDEX}: none of {n_read} facets is marked as ground; run again")
    found = coarsen(found, step) if step else found
    xyz, corners = sew(found.points, found.corners)
    low, high = xyz.min(axis=0), xyz.max(axis=0)
    origin = np.array([*(low + high)[:2] / 2, low[2]])
    return City(
        points=xyz - origin,
        facets=corners[:, ::-1].astype(np.int32),  # the file's look out of the air, which is where the camera is
        marker=found.marker,
        building=found.building,
        piece=found.piece,
        names=tuple(path.stem for path in paths),
        origin=origin,
        quality=found.quality if quality else np.empty(0, np.float32),
        step=step,
    )


def take_near(city: City, within: float) -> City:
    """Take the facets in a square around the origin, half a side given (m); all of them where it has none."""
    near = (np.abs(city.points[city.facets, :2]) < within).all(axis=(1, 2))
    if not near.any():
        return city
    points, facets = sew(city.points, city.facets[near])
    rows = {name: getattr(city, name)[near] for name in ("marker", "building", "piece")}
    return replace(city, points=points, facets=facets.astype(np.int32), **rows)


def load_levels(directory: Path, city: City) -> NDArray[np.int8]:
    """Find the level of detail of each facet: that of its building, and of the zone on the ground.

    Parameters
    ----------
    directory : Path
        Folder of a run with zones of detail.
    city : City
        Its boundary.

    Returns
    -------
    int8, (k,)
        Index into `zones.LEVELS`.

    Raises
    ------
    InputError
        If the run has no zones, or a result is missing or damaged.
    """
    zones = read_run_record(directory / RUN_RECORD).zones
    if not zones:
        raise InputError(f"{directory}: the run has no zones of detail; run with --focus or --lod-zones")
    store = Store(directory / STORE)
    found = [store.read("model", name, names=("number", "level"))[0] for name in store.names("model")]
    number, level = (np.concatenate([part[name] for part in found]) for name in ("number", "level"))
    order = np.argsort(number, kind="stable")
    row = np.searchsorted(number[order], city.building).clip(max=max(len(order) - 1, 0))
    centre = city.points[city.facets].mean(axis=1) + city.origin
    levels = find_levels(zones, centre[:, :2])
    built = city.building >= 0
    levels[built] = level[order][row[built]]
    return levels


def load_air(
    directory: Path,
    origin: NDArray[np.float64],
    *,
    only: frozenset[str] | None = None,
    within: float = np.inf,
) -> Any:
    """Read the surface of the whole tetrahedra in the northern half, but for ground, walls and roofs.

    Parameters
    ----------
    directory : Path
        Folder of a run.
    origin : float64, (3,)
        Where the city was moved from (m); the cut is there.
    only : frozenset of str, optional
        Names of the pieces to read, all by default.
    within : float
        Half the side of a square around the origin whose cells are taken (m), all where it has none.

    Returns
    -------
    pyvista.PolyData
        Triangles (m) from `origin`, of each piece those that are not between two of its cells.

    Raises
    ------
    InputError
        If a file or a piece of it is missing or damaged, or has no cell there.

    Notes
    -----
    Memory holds one whole piece, and of all of them the surface.
    """
    import pyvista

    points, corners, n_points = [], [], 0
    paths = _find_pieces(directory / BOUNDARY_INDEX, only)
    for path, volume in zip(paths, _find_volumes(directory, paths), strict=True):
        rim = read_vtp(path)
        low, high = ((end(rim.points[:, :2], axis=0) - origin[:2]) for end in (np.min, np.max))
        if high[1] <= 0 or (low >= within).any() or (high <= -within).any():
            continue
        piece = read_vtu(volume)
        x, y = (_average(piece.mesh.points[:, k], piece.mesh.cells) for k in range(2))
        north = (y > origin[1]) & (y < origin[1] + within) & (np.abs(x - origin[0]) < within)
        if REGION in piece.cell_data:
            north &= piece.cell_data[REGION] == Region.AIR
        if not north.any():
            continue
        city = rim.vertex[rim.boundary.facets[np.isin(rim.boundary.marker, SHOWN)]]
        faces = find_outer_faces(piece.mesh.points, piece.mesh.cells, north, city)
        used, rows = number_used(faces, len(piece.mesh.points))
        points.append(piece.mesh.points[used] - origin)
        corners.append(rows + n_points)
        n_points += len(used)
    if not n_points and within < np.inf:
        return load_air(directory, origin, only=only)
    if not n_points:
        raise InputError(f"{directory / VOLUME_INDEX}: has no cell north of y = {origin[1]:.1f} m; run again")
    return pyvista.PolyData.from_regular_faces(
        np.concatenate(points).astype(np.float32), np.concatenate(corners).astype(np.int32)
    )


def _average(values: NDArray[np.float64], cells: NDArray[np.int32]) -> NDArray[np.float64]:
    """Mean over the four corners of cells."""
    total: NDArray[np.float64] = values[cells[:, 0]]
    for k in range(1, 4):
        total += values[cells[:, k]]
    return total / 4


def find_outer_faces(
    points: NDArray[np.float64], cells: NDArray[np.int32], chosen: NDArray[np.bool_], hidden: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Find the faces of some cells that no two of them have.

    Parameters
    ----------
    points : float64, (n, 3)
        Vertices.
    cells : int32, (m, 4)
        Rows of `points`.
    chosen : bool, (m,)
        Which cells.
    hidden : int64, (h, 3)
        Faces that are left out.

    Returns
    -------
    int64, (k, 3)
        Rows of `points`, counter-clockwise seen from outside.

    Notes
    -----
    VTK finds them, for a strip of cells at a time, as it takes some 150 bytes a cell.
    """
    import pyvista

    rows = np.flatnonzero(chosen).astype(np.int32)
    rows = rows[np.argsort(points[cells[rows, 0], 0])]
    strips = np.array_split(rows, max(1, len(rows) // STRIP_CELLS))
    found = []
    for strip in strips:
        surface = pyvista.UnstructuredGrid({TETRA: cells[strip]}, points).extract_surface(
            algorithm=None, pass_cellid=False
        )
        found.append(surface.point_data["vtkOriginalPointIds"][surface.regular_faces])
    faces = np.concatenate(found)
    name = name_facets(np.concatenate([faces, hidden]), len(points))
    outer: NDArray[np.int64] = faces[(np.bincount(name) == 1)[name[: len(faces)]]]
    return outer


def sew(points: NDArray[np.float64], facets: NDArray[Any]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
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


def number_used(rows: NDArray[Any], n_points: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Points that rows (k, 3) use, in their order, and the rows in numbers of these."""
    used = np.zeros(n_points, np.bool_)
    used[rows] = True
    return np.flatnonzero(used), (np.cumsum(used) - 1)[rows]


def read_key(name: str) -> Key:
    """Take the tile of a piece from its name; InputError if it is not named after one."""
    try:
        return tile_key(name)
    except ValueError:
        raise InputError(f"the piece {name!r} is not named after a tile, as '60_243' is; run again") from None


def _find_pieces(path: Path, only: frozenset[str] | None = None) -> list[Path]:
    if not path.is_file():
        raise InputError(f"{path}: no such file; run citystitch first, or name its output folder")
    return [piece for piece in read_piece_paths(path) if only is None or piece.stem in only]


def _find_volumes(directory: Path, boundaries: list[Path]) -> list[Path]:
    """Find the cells of pieces of the boundary."""
    names = [path.stem for path in boundaries]
    volumes = _find_pieces(directory / VOLUME_INDEX, frozenset(names))
    if [path.stem for path in volumes] != names:
        raise InputError(f"{directory}: {VOLUME_INDEX} and {BOUNDARY_INDEX} have other pieces; run again")
    return volumes


def _take_shown(piece: BoundaryPiece, row: int, volume: Path | None) -> Facets:
    """Take ground, walls and roofs, with the quality of the cells of a volume piece behind them."""
    boundary = piece.boundary
    shown = np.isin(boundary.marker, SHOWN)
    used, corners = number_used(boundary.facets[shown], len(piece.points))
    ratio = np.full(len(shown), np.nan, np.float32)
    if volume is not None:
        ratio = measure_facets(read_vtu(volume).mesh, piece)
    return Facets(
        piece.points[used],
        corners,
        boundary.marker[shown],
        np.full(len(corners), row, np.int32),
        boundary.building[shown],
        ratio[shown],
    )
