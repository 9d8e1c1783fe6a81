"""A box of cubes in tiles, cut into tetrahedra by hand: pieces as a run has them, in memory."""

from dataclasses import dataclass
from itertools import permutations
from types import SimpleNamespace

import numpy as np
from numpy.typing import NDArray

from pipeline.data.mesh import Marker
from tiler.mesh_files.mesh_pieces import MeshPiece

FACES = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]


@dataclass(frozen=True, eq=False)
class HandPieces:
    """Pieces in memory: see `tiler.mesh_files.mesh_pieces.MeshPieces`."""

    names: tuple[str, ...]
    n_points: int
    pieces: list[MeshPiece]
    ground: tuple[str, ...] = ()

    @property
    def files(self) -> SimpleNamespace:
        """What writers ask of the files: coordinates are those of the CRS."""
        return SimpleNamespace(origin=np.zeros(3), origin_words="", depth=0.0)

    def read(self, k: int) -> MeshPiece:
        """Return piece `k`."""
        return self.pieces[k]


def box_pieces(tiles: tuple[int, int] = (3, 2), cubes: int = 2, seed: int = 1) -> HandPieces:
    """Cut a box of 1 m cubes, `cubes` each way a tile, into six tetrahedra a cube; all orders are random.

    The east side is marked as missing, and the ground of each tile but the first is a roof: tiles 1 and 2 have
    building 11, tiles 3 and 4 building 12, and so on.
    """
    rng = np.random.default_rng(seed)
    shape = np.array([tiles[0] * cubes, tiles[1] * cubes, cubes])
    lattice = np.stack(np.meshgrid(*(np.arange(n + 1) for n in shape), indexing="ij"), axis=-1).reshape(-1, 3)
    number = rng.permutation(len(lattice))  # of each lattice point over the region
    # Bent, so that no two cells have the same volume, and z is not that of the lattice.
    xyz = lattice + 0.03 * np.sin(3.0 * lattice[:, [1, 2, 0]] + 1.0) * _inside(lattice, shape)
    stride = np.array([(shape[1] + 1) * (shape[2] + 1), shape[2] + 1, 1])
    names, pieces = [], []
    for k, (i, j) in enumerate((i, j) for i in range(tiles[0]) for j in range(tiles[1])):
        corner = np.array([i * cubes, j * cubes, 0])
        low = np.stack(np.meshgrid(*(np.arange(cubes),) * 3, indexing="ij"), axis=-1).reshape(-1, 3) + corner
        cells = np.concatenate([_walk(low, axes) @ stride for axes in permutations(range(3))])
        a, b, c, d = (xyz[cells[:, m]] for m in range(4))
        turned = np.einsum("ij,ij->i", np.cross(b - a, c - a), d - a) < 0
        cells[turned] = cells[turned][:, [1, 0, 2, 3]]
        # Turned about their corners too: so a cell with two neighbours beyond has them in any order.
        cells = rng.permutation(cells)
        for turn in ([1, 2, 0, 3], [0, 2, 3, 1], [3, 1, 0, 2]):
            chosen = rng.random(len(cells)) < 0.5
            cells[chosen] = cells[chosen][:, turn]
        used = rng.permutation(np.unique(cells))
        local = np.full(len(lattice), -1)
        local[used] = np.arange(len(used))
        facets, marker = _facets(cells, lattice, shape)
        building = np.full(len(facets), -1, np.int64)
        if k:
            building[marker == Marker.GROUND] = 10 + (k + 1) // 2
            marker[marker == Marker.GROUND] = Marker.ROOF
        order = rng.permutation(len(facets))
        names.append(f"{i}_{j}")
        pieces.append(
            MeshPiece(
                names[-1],
                xyz[used],
                local[cells].astype(np.int32),
                local[facets[order]].astype(np.int32),
                marker[order],
                building[order],
                number[used],
            )
        )
    return HandPieces(tuple(names), len(lattice), pieces)


def _inside(lattice: NDArray[np.int64], shape: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Coordinates that may move: sides stay flat."""
    return (lattice > 0) & (lattice < shape)


def _walk(low: NDArray[np.int64], axes: tuple[int, ...]) -> NDArray[np.int64]:
    """Corners of the tetrahedron of each cube that walks along the axes in this order, from east to west."""
    step = np.diag([-1, 1, 1])
    corners = [low + np.array([1, 0, 0])]
    for axis in axes:
        corners.append(corners[-1] + step[axis])
    return np.stack(corners, axis=1)


def _facets(
    cells: NDArray[np.int64], lattice: NDArray[np.int64], shape: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """Take the faces that lie in a side of the box, with its marker."""
    faces = cells[:, FACES].reshape(-1, 3)
    corners = lattice[faces]
    sides = {
        Marker.GROUND: (2, 0),
        Marker.TOP: (2, shape[2]),
        Marker.WEST: (0, 0),
        Marker.MISSING: (0, shape[0]),
        Marker.SOUTH: (1, 0),
        Marker.NORTH: (1, shape[1]),
    }
    marker = np.zeros(len(faces), np.int32)
    for name, (axis, place) in sides.items():
        marker[(corners[:, :, axis] == place).all(axis=1)] = name
    return faces[marker > 0], marker[marker > 0]
