"""The boundary of a finished run for surface formats: facets piece by piece, vertices numbered from 0 on."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from pipeline.data.errors import InputError
from pipeline.data.mesh import GROUND_PATCHES
from tiler.export.foam_patches import PATCHES, patch_keys
from tiler.export.pieces import blocks_of
from tiler.mesh_files.merged import VERTEX_ID, number_piece
from tiler.mesh_files.mesh_pieces import MeshPiece, MeshPieces, mark_facets, open_pieces
from tiler.mesh_files.run_files import RunSource
from tiler.mesh_files.vtk_files import read_vtp
from tiler.store.atomic import replacing

WORD = 64  # points in a word of `VertexSet`


@dataclass(frozen=True, eq=False)
class BoundaryPart:
    """The part of the boundary that one tile holds; arrays as of `MeshPiece`, which will do too."""

    points: NDArray[np.float64]
    facets: NDArray[np.int32]
    marker: NDArray[np.int32]
    building: NDArray[np.int64]
    ids: NDArray[np.int64]


SurfacePiece = MeshPiece | BoundaryPart
# Given a piece, the key of each of its facets' sets, (f,), 0 or more: patches, say.
KeysOf = Callable[[SurfacePiece], NDArray[np.int64]]


class Surface(Protocol):
    """A boundary in pieces."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the pieces, in their order."""

    @property
    def n_points(self) -> int:
        """Number of different points of the whole mesh."""

    @property
    def ground(self) -> tuple[str, ...]:
        """Names of the patches of the ground, by number; none without land cover."""

    def read(self, k: int) -> SurfacePiece:
        """Read piece `k`."""


@dataclass(frozen=True, eq=False)
class RunSurface:
    """The boundary of a finished run; cells are not read."""

    pieces: MeshPieces

    @property
    def names(self) -> tuple[str, ...]:
        """Its tiles, sorted."""
        return self.pieces.names

    @property
    def n_points(self) -> int:
        """Number of different points of the whole mesh."""
        return self.pieces.n_points

    @property
    def ground(self) -> tuple[str, ...]:
        """Names of the patches of the ground, by number; none without land cover."""
        return self.pieces.ground

    def read(self, k: int) -> BoundaryPart:
        """Read piece `k`.

        Raises
        ------
        InputError
            If its file is missing or damaged, or has an unknown marker.
        """
        path = self.pieces.files.boundaries[k]
        piece = read_vtp(path)
        marks = mark_facets(self.pieces.files, path, piece)
        if not np.isin(marks[marks <= GROUND_PATCHES], [int(marker) for marker in PATCHES]).all():
            raise InputError(
                f"{path}: markers {marks.min()}..{marks.max()}, known are 1..{max(PATCHES)}; run the tile again"
            )
        ids = number_piece(path, piece.point_data.get(VERTEX_ID), self.pieces.numbering)
        points = piece.points - self.pieces.files.origin
        return BoundaryPart(points, piece.boundary.facets, marks, piece.boundary.building, ids)


def open_surface(source: RunSource) -> RunSurface:
    """Open the boundary of a finished run.

    Raises
    ------
    InputError
        If the folder holds no finished run, or a file of it is missing or damaged.
    """
    return RunSurface(open_pieces(source))


def write_surface(write: Callable[..., None]) -> Callable[..., None]:
    """Make of a function that writes a `Surface` one that writes that of a finished run.

    Parameters
    ----------
    write : callable
        ``write(path, surface, **options)``.

    Returns
    -------
    callable
        ``export(output, source, **options)``: the file appears whole or not at all. InputError if the run is not
        finished, or a file of it is missing or damaged.
    """

    def export(output: Path, source: RunSource, **options: Any) -> None:
        surface = open_surface(source)
        with replacing(output) as part:
            write(part, surface, **options)

    return export


class VertexSet:
    """Which points of a mesh are vertices of its boundary, and the place of each among these.

    Parameters
    ----------
    n_points : int
        Points of the mesh.

    Notes
    -----
    A quarter of a byte a point: a bit each, and how many come before each word of bits.

    Examples
    --------
    >>> vertices = VertexSet(200)
    >>> vertices.add(np.array([3, 130, 70, 3]))
    >>> vertices.count()
    3
    >>> vertices.places(np.array([130, 3, 70])).tolist()
    [2, 0, 1]
    """

    def __init__(self, n_points: int) -> None:
        self._words = np.zeros(-(-n_points // WORD), np.uint64)
        self._before = np.zeros(len(self._words), np.int64)

    def add(self, ids: NDArray[np.int64]) -> None:
        """Add points, (k,); places of those known before may change."""
        np.bitwise_or.at(self._words, ids // WORD, _bit(ids))

    def count(self) -> int:
        """Count them, and settle their places."""
        counts = np.bitwise_count(self._words).astype(np.int64)
        self._before = np.cumsum(counts) - counts
        return int(counts.sum())

    def places(self, ids: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the places of points that are in the set, (k,) to (k,), in the order of their ids."""
        word = ids // WORD
        lower = self._words[word] & (_bit(ids) - np.uint64(1))
        return self._before[word] + np.bitwise_count(lower)


@dataclass(frozen=True, eq=False)
class SurfaceSurvey:
    """What is known after reading a boundary once."""

    vertices: VertexSet  #: places of its vertices
    n_vertices: int  #: how many there are
    facets: dict[int, int]  #: facets by key, ascending; keys without facets are not there
    #: (3,): box of its vertices (m); infinite where there is none
    low: NDArray[np.float64]
    high: NDArray[np.float64]

    @property
    def n_facets(self) -> int:
        """Number of all facets."""
        return sum(self.facets.values())


def by_marker(piece: SurfacePiece) -> NDArray[np.int64]:
    """Give the marker of each facet as the key of its patch."""
    return patch_keys(piece.marker, piece.building, by_building=False)


def by_building(piece: SurfacePiece) -> NDArray[np.int64]:
    """Give the key of each facet's patch where buildings have their own; see `patch_keys`."""
    return patch_keys(piece.marker, piece.building, by_building=True)


def keys_asked(buildings: str | None) -> KeysOf:
    """Choose the keys of patches by the option ``buildings``."""
    return by_marker if buildings is None else by_building


def survey_surface(surface: Surface, keys_of: KeysOf = by_marker) -> SurfaceSurvey:
    """Read a boundary once, a piece at a time, and count facets by the keys that `keys_of` gives them."""
    vertices = VertexSet(surface.n_points)
    facets: dict[int, int] = {}
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for k in range(len(surface.names)):
        piece = surface.read(k)
        used = np.unique(piece.facets)
        vertices.add(piece.ids[used])
        if len(used):
            points = piece.points[used]
            low, high = np.minimum(low, points.min(axis=0)), np.maximum(high, points.max(axis=0))
        for key, n in zip(*np.unique(keys_of(piece), return_counts=True), strict=True):
            facets[int(key)] = facets.get(int(key), 0) + int(n)
    return SurfaceSurvey(vertices, vertices.count(), dict(sorted(facets.items())), low, high)


def place_vertices(
    piece: SurfacePiece, vertices: VertexSet
) -> tuple[list[tuple[int, NDArray[np.float64]]], NDArray[np.int64]]:
    """Give what a piece adds to the region's vertices and facets.

    Returns
    -------
    list of (int, float64 (k, 3))
        Runs of vertices (m), each with the place of its first.
    int64, (f, 3)
        The facets, by places.
    """
    used, local = np.unique(piece.facets, return_inverse=True)
    places = vertices.places(piece.ids[used])
    runs = [(start, piece.points[used[rows]]) for start, rows in blocks_of(places)]
    return runs, places[local.reshape(-1, 3)]


def _bit(ids: NDArray[np.int64]) -> NDArray[np.uint64]:
    return np.left_shift(np.uint64(1), (ids % WORD).astype(np.uint64))
