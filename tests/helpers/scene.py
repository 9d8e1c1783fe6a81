"""A made-up city over hills, written as a run writes it: boundary and volume mesh, for the pictures."""

from pathlib import Path
from typing import Any

import numpy as np
import shapely
import triangle
from numpy.typing import NDArray
from shapely.affinity import rotate, translate

from pipeline.data.mesh import Boundary, TetMesh
from tests.helpers.vtk_writers import write_vtp, write_vtu
from tiler.mesh_files.vtk_files import write_pvtp, write_pvtu

# Far from zero, as in a national CRS: single precision has steps of 0.03 m here.
ORIGIN = np.array([121000.0, 487000.0, 0.0])
PIECES = ("0_0", "1_0")
Array = NDArray[Any]


def write_scene(directory: Path, *, side: float, n_buildings: int, mesh_size: float) -> None:
    """Write ``boundary.pvtp`` and ``mesh.pvtu`` in two pieces: a western and an eastern tile's boundary.

    Parameters
    ----------
    directory : Path
        Existing folder.
    side : float
        Edge of the square region (m).
    n_buildings : int
        Buildings to try; those too close to an earlier one are left out.
    mesh_size : float
        Bound on the edges of the plane mesh (m).
    """
    rng = np.random.default_rng(3)
    houses = place_houses(rng, side, n_buildings)
    roofs = np.array([height(np.array(house.exterior.coords)).max() for house in houses])
    roofs += rng.gamma(4.0, 2.5, len(houses)) + 4.0
    xy, corners, owner = plane_mesh(houses, side, mesh_size)
    top = float(roofs.max()) + 60.0
    write_boundary(directory, *boundary(xy, corners, owner, roofs, top))
    write_volume(directory, *volume(xy, corners, owner, roofs, top, dz=mesh_size))


def height(xy: Array) -> Array:
    x, y = xy[:, 0], xy[:, 1]
    hills: Array = 8 * np.sin(x / 110) * np.cos(y / 140) + 5 * np.sin((x + 2 * y) / 190) + 4
    return hills


def place_houses(rng: np.random.Generator, side: float, n: int) -> list[shapely.Polygon]:
    houses: list[shapely.Polygon] = []
    for x, y in rng.uniform(0, side, (n, 2)):
        half = rng.uniform(4, 14, 2)
        shape = shapely.box(-half[0], -half[1], half[0], half[1])
        if rng.random() < 0.4:
            shape = shapely.difference(shape, shapely.box(0, 0, half[0], half[1]))
        house = translate(rotate(shape, 25 * np.sin(x / 150) + rng.choice([0, 90])), x, y)
        inside = house.within(shapely.box(6, 6, side - 6, side - 6))
        if inside and (not houses or shapely.distance(house, houses).min() > 4):
            houses.append(house)
    return houses


def plane_mesh(houses: list[shapely.Polygon], side: float, size: float) -> tuple[Array, Array, Array]:
    rings = [np.array([(0, 0), (side, 0), (side, side), (0, side)])]
    rings += [np.array(house.exterior.coords)[:-1] for house in houses]
    starts = np.cumsum([0, *map(len, rings)])
    segments = np.concatenate(
        [
            a + np.column_stack([np.arange(len(r)), np.roll(np.arange(len(r)), -1)])
            for a, r in zip(starts, rings, strict=False)
        ]
    )
    mesh = triangle.triangulate(
        {"vertices": np.concatenate(rings), "segments": segments}, f"pq28a{size * size / 2}S200000"
    )
    xy, corners = mesh["vertices"], mesh["triangles"]
    tree = shapely.STRtree(houses)
    point, house = tree.query(shapely.points(xy[corners].mean(axis=1)), predicate="within")
    owner = np.full(len(corners), -1)
    owner[point] = house
    return xy, corners, owner


def boundary(
    xy: Array, corners: Array, owner: Array, roofs: Array, top: float
) -> tuple[Array, Array, Array, Array]:
    """Facets seen from outside the air, as loose triangles."""
    ground = height(xy)
    low = np.where(owner[:, None] >= 0, roofs[owner][:, None], ground[corners])
    floor = np.dstack([xy[corners], low])[:, ::-1]
    ceiling = np.dstack([xy[corners], np.full(corners.shape, top)])
    edges = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]])
    side = np.tile(owner, 3)
    key = np.sort(edges, axis=1)
    order = np.lexsort((side, key[:, 1], key[:, 0]))
    paired = np.flatnonzero(np.all(key[order][1:] == key[order][:-1], axis=1))
    first, second = order[paired], order[paired + 1]
    wall = (side[first] < 0) & (side[second] >= 0)
    a, b = edges[second[wall]].T
    house = side[second[wall]]
    low_a, low_b = (np.column_stack([xy[i], ground[i]]) for i in (a, b))
    high_a, high_b = (np.column_stack([xy[i], roofs[house]]) for i in (a, b))
    walls = np.concatenate([np.stack([low_b, low_a, high_a], 1), np.stack([low_b, high_a, high_b], 1)])
    facets = np.concatenate([floor, walls, ceiling])
    marker = np.concatenate([np.where(owner < 0, 1, 3), np.full(len(walls), 2), np.full(len(ceiling), 4)])
    number = np.concatenate([owner, house, house, np.full(len(ceiling), -1)])
    east = facets[..., 0].mean(axis=1) > np.ptp(xy[:, 0]) / 2
    return facets, marker, number, east.astype(np.int64)


def write_boundary(directory: Path, facets: Array, marker: Array, number: Array, piece: Array) -> None:
    (directory / "boundary").mkdir()
    paths = [directory / "boundary" / f"{name}.vtp" for name in PIECES]
    for i, path in enumerate(paths):
        mine = facets[piece == i].reshape(-1, 3) + ORIGIN
        points, index = np.unique(mine, axis=0, return_inverse=True)
        marks = marker[piece == i].astype(np.int32), number[piece == i].astype(np.int64)
        write_vtp(path, points, Boundary(index.reshape(-1, 3).astype(np.int32), *marks))
    write_pvtp(directory / "boundary.pvtp", paths)


def volume(xy: Array, corners: Array, owner: Array, roofs: Array, top: float, *, dz: float) -> tuple[Array, Array]:
    """Tetrahedra from the ground up; cells that meet a house are left out."""
    ground = height(xy)
    n_layers = int(np.ceil((top - ground.min()) / dz))
    share = np.linspace(0, 1, n_layers + 1)[:, None]
    z = ground + (top - ground) * share
    points = np.concatenate([np.column_stack([xy, level]) for level in z])
    a, b, c = np.sort(corners, axis=1).T
    n = len(xy)
    cells = np.concatenate(
        [
            np.concatenate(
                [
                    np.column_stack(cell) + k * n
                    for cell in ((a, b, c, c + n), (a, b, b + n, c + n), (a, a + n, b + n, c + n))
                ]
            )
            for k in range(n_layers)
        ]
    )
    house = np.tile(owner, 3 * n_layers)
    keep = (house < 0) | (points[cells, 2].min(axis=1) >= roofs[house] - dz / 2)
    cells = cells[keep]
    used, index = np.unique(cells, return_inverse=True)
    points, cells = points[used], index.reshape(-1, 4)
    flip = np.linalg.det(points[cells[:, 1:]] - points[cells[:, :1]]) < 0
    cells[flip, 2:] = cells[flip, :1:-1]
    return points, cells


def write_volume(directory: Path, points: Array, cells: Array) -> None:
    """Write two pieces, cells alternately in one and the other: almost every face is one of both."""
    (directory / "mesh").mkdir()
    paths = [directory / "mesh" / f"{name}.vtu" for name in PIECES]
    for i, path in enumerate(paths):
        used, index = np.unique(cells[i::2], return_inverse=True)
        write_vtu(path, TetMesh(points[used] + ORIGIN, index.reshape(-1, 4).astype(np.int32)))
    write_pvtu(directory / "mesh.pvtu", paths)
