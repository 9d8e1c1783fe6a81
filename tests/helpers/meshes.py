"""Catalogue of tiny valid meshes made in code, and run folders of them on disk."""

import json
from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.data.citymodel import CityModel, number_ids
from pipeline.data.mesh import Boundary, Marker, TetMesh
from pipeline.data.roofs import flat_roofs
from tests.helpers.vtk_writers import NO_ARRAYS, write_vtp, write_vtu
from tiler.citymodels.cityjson import write_city_model
from tiler.mesh_files.vtk_files import write_pvtp, write_pvtu

Square = tuple[int, int]
# Squares of the grid that each building stands on, and the level of its roof.
HOUSES: Mapping[str, tuple[tuple[Square, ...], int]] = {
    "0363100012078463": (((1, 1), (2, 1), (1, 2), (2, 2)), 3),
    "lower-neighbour": (((3, 1), (3, 2)), 2),
    "courtyard": (tuple((i, j) for i in (5, 6, 7) for j in (1, 2, 3) if (i, j) != (6, 2)), 2),
    "on-the-border": (((9, 5), (9, 6)), 1),
    "corner-a": (((2, 5),), 2),
    "corner-b": (((3, 6),), 3),
}
LEVELS = (4.0, 7.5, 11.0, 18.0)  # absolute heights above the ground level (m)
SIZE = 10.0  # m, side of a square
CORNER = (121000.125, 487000.75)  # south-west corner of the region (m)


@dataclass(frozen=True)
class PlaneDtm:
    """Terrain ``a + b x + c y`` seen from the region's corner (m)."""

    a: float = 1.0
    b: float = 0.01
    c: float = -0.008

    def sample(self, xy: NDArray[np.float64], /) -> NDArray[np.float64]:
        """Return the height (m) at points (n, 2)."""
        east, north = xy[:, 0] - CORNER[0], xy[:, 1] - CORNER[1]
        z: NDArray[np.float64] = self.a + self.b * east + self.c * north
        return z


def load_plane(path: Path) -> PlaneDtm:
    """Give the terrain of a folder of `write_run` without looking at it, also to a worker."""
    return PlaneDtm()


@dataclass(frozen=True, eq=False)
class TinyCity:
    """A city model, its terrain and its mesh: ``owner`` is the cell behind each boundary facet."""

    mesh: TetMesh
    boundary: Boundary
    owner: NDArray[np.int64]
    model: CityModel
    dtm: PlaneDtm
    bounds: tuple[float, float, float, float]


def make_city(
    *,
    houses: Mapping[str, tuple[tuple[Square, ...], int]] = HOUSES,
    shape: tuple[int, int] = (10, 8),
    dtm: PlaneDtm = PlaneDtm(),
) -> TinyCity:
    """Build a box of prisms over a grid of squares and take out those under the roofs.

    The default has a house with a lower neighbour on a party wall, a courtyard, a house on the region's
    border, and two houses that touch in a corner.
    """
    nx, ny = shape
    model = _make_model(houses, dtm)
    x, y = (CORNER[axis] + SIZE * np.arange(n + 1) for axis, n in enumerate(shape))
    xy = np.array([(a, b) for a in x for b in y])
    levels = np.column_stack([dtm.sample(xy), *np.broadcast_to(np.array([LEVELS]).T, (len(LEVELS), len(xy)))])
    points = np.column_stack([np.repeat(xy, levels.shape[1], axis=0), levels.ravel()])
    first_level = {square: roof for squares, roof in houses.values() for square in squares}
    cells = [
        cell
        for i in range(nx)
        for j in range(ny)
        for triangle in _split_square(i, j, ny)
        for level in range(first_level.get((i, j), 0), len(LEVELS))
        for cell in _split_prism([corner * levels.shape[1] + level for corner in triangle])
    ]
    mesh = compact(TetMesh(points, _turn_positive(points, np.array(cells, np.int32))))
    bounds = (float(x[0]), float(y[0]), float(x[-1]), float(y[-1]))
    boundary, owner = mark_boundary(mesh, model, bounds)
    return TinyCity(mesh, boundary, owner, model, dtm, bounds)


def compact(mesh: TetMesh) -> TetMesh:
    """Drop the points that no cell uses."""
    used, cells = np.unique(mesh.cells, return_inverse=True)
    return TetMesh(mesh.points[used], cells.reshape(-1, 4).astype(np.int32))


def mark_boundary(
    mesh: TetMesh, model: CityModel, bounds: tuple[float, float, float, float]
) -> tuple[Boundary, NDArray[np.int64]]:
    """Collect the faces that one cell alone has, cell by cell, and mark them by where they lie."""
    cells_of: dict[tuple[int, ...], list[tuple[int, tuple[int, ...]]]] = defaultdict(list)
    for cell, (a, b, c, d) in enumerate(mesh.cells.tolist()):
        for face in ((a, c, b), (a, b, d), (a, d, c), (b, c, d)):
            cells_of[tuple(sorted(face))].append((cell, face))
    single = [entries[0] for entries in cells_of.values() if len(entries) == 1]
    marks = [_mark(mesh.points[list(face)], model, bounds) for _, face in single]
    facets = np.array([face for _, face in single], np.int32)
    marker = np.array([marker for marker, _ in marks], np.int32)
    building = np.array([number for _, number in marks], np.int64)
    return Boundary(facets, marker, building), np.array([cell for cell, _ in single])


def split_city(city: TinyCity, east_of: float) -> dict[str, tuple[TetMesh, Boundary]]:
    """Cut the mesh into two pieces by the x of the cells' centres (m from the region's corner)."""
    right = city.mesh.points[city.mesh.cells].mean(axis=1)[:, 0] > CORNER[0] + east_of
    pieces = {}
    for name, inside in (("0_0", ~right), ("1_0", right)):
        used, cells = np.unique(city.mesh.cells[inside], return_inverse=True)
        of_piece = inside[city.owner]
        facets = np.searchsorted(used, city.boundary.facets[of_piece]).astype(np.int32)
        boundary = Boundary(facets, city.boundary.marker[of_piece], city.boundary.building[of_piece])
        pieces[name] = (TetMesh(city.mesh.points[used], cells.reshape(-1, 4).astype(np.int32)), boundary)
    return pieces


def write_run(
    directory: Path,
    city: TinyCity,
    *,
    pieces: Mapping[str, tuple[TetMesh, Boundary]] | None = None,
    boundary_data: Mapping[str, NDArray[Any]] = NO_ARRAYS,
) -> None:
    """Write the run folder of a tiny city: record, city model, volume and boundary with arrays of its points."""
    pieces = pieces or {"0_0": (city.mesh, city.boundary)}
    for folder in ("mesh", "boundary"):
        (directory / folder).mkdir(parents=True)
    for name, (mesh, boundary) in pieces.items():
        write_vtu(directory / "mesh" / f"{name}.vtu", mesh)
        write_vtp(directory / "boundary" / f"{name}.vtp", mesh.points, boundary, point_data=boundary_data)
    write_pvtu(directory / "mesh.pvtu", [directory / "mesh" / f"{name}.vtu" for name in pieces])
    write_pvtp(directory / "boundary.pvtp", [directory / "boundary" / f"{name}.vtp" for name in pieces])
    counts = {
        "cells": len(city.mesh.cells),
        "points": len(city.mesh.points),
        "facets": len(city.boundary.facets),
        "buildings": len(city.model),
    }
    region = {"bounds": list(city.bounds), "crs": "EPSG:28992"}
    record = {"schema": 1, "status": "done", "region": region, "counts": counts, "quality": {}}
    (directory / "run.json").write_text(json.dumps(record))
    (x0, y0, x1, y1), z = city.bounds, city.mesh.points[:, 2]
    box = (x0, y0, z.min(), x1, y1, z.max())
    for file in ("citymodel.city.json", "citymodel-full.city.json"):
        write_city_model(directory / file, city.model, crs="EPSG:28992", bounds=box)


def edit_json(path: Path, change: Callable[[dict[str, Any]], None]) -> None:
    """Change a JSON file in place."""
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def with_mesh(city: TinyCity, points: NDArray[np.float64], cells: NDArray[np.int32]) -> TinyCity:
    """Give the city other points and cells, and leave its boundary."""
    return replace(city, mesh=TetMesh(points, cells))


def with_boundary(city: TinyCity, **arrays: NDArray[Any]) -> TinyCity:
    """Give the city's boundary other arrays, and leave its mesh."""
    return replace(city, boundary=replace(city.boundary, **arrays))


def _make_model(houses: Mapping[str, tuple[tuple[Square, ...], int]], dtm: PlaneDtm) -> CityModel:
    polygons = np.empty(len(houses), np.object_)
    polygons[:] = [shapely.union_all([_box_of(square) for square in squares]) for squares, _ in houses.values()]
    polygons = shapely.orient_polygons(polygons) if len(houses) else polygons
    ids = np.array(list(houses), np.str_)
    ground = np.array([dtm.sample(shapely.get_coordinates(polygon)).min() for polygon in polygons])
    roof = np.array([LEVELS[level - 1] for _, level in houses.values()])
    return CityModel(
        polygons, ids, number_ids(ids), ground, flat_roofs(roof), tuple((str(name),) for name in ids), ids
    )


def _box_of(square: Square) -> Any:
    west, south = (CORNER[axis] + SIZE * square[axis] for axis in (0, 1))
    return shapely.box(west, south, west + SIZE, south + SIZE)


def _split_square(i: int, j: int, ny: int) -> list[list[int]]:
    a, b, c, d = (column * (ny + 1) + row for column, row in ((i, j), (i, j + 1), (i + 1, j), (i + 1, j + 1)))
    return [[a, b, d], [a, c, d]]


def _split_prism(corners: list[int]) -> list[list[int]]:
    """Split the prism over one level: from below, the last column's segment first."""
    a, b, c = corners
    return [[a, b, c, c + 1], [a, b, b + 1, c + 1], [a, a + 1, b + 1, c + 1]]


def _turn_positive(points: NDArray[np.float64], cells: NDArray[np.int32]) -> NDArray[np.int32]:
    negative = np.linalg.det(points[cells[:, 1:]] - points[cells[:, :1]]) < 0
    return np.where(negative[:, None], cells[:, [0, 2, 1, 3]], cells)


def _mark(
    corners: NDArray[np.float64], model: CityModel, bounds: tuple[float, float, float, float]
) -> tuple[Marker, int]:
    west, south, east, north = bounds
    sides = {Marker.WEST: (0, west), Marker.EAST: (0, east), Marker.SOUTH: (1, south), Marker.NORTH: (1, north)}
    for marker, (axis, value) in sides.items():
        if np.all(corners[:, axis] == value):
            return marker, -1
    up = np.cross(corners[1] - corners[0], corners[2] - corners[0])[2]
    if up > 0:
        return Marker.TOP, -1
    near = shapely.dwithin(model.polygons, shapely.Point(corners.mean(axis=0)), 1e-6)
    near &= model.roof >= corners[:, 2].max()
    if not near.any():
        return Marker.GROUND, -1
    return Marker.ROOF if up < 0 else Marker.WALL, int(model.numbers[near.argmax()])
