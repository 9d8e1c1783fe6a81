"""The city model of a run on its terrain, with the roofs that it has, from the run's store, for a picture."""

from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.city_model.sloped_solids import ROOF, WALL
from pipeline.city_model.solids import Levels, Solids, build_solids
from pipeline.data.citymodel import CityModel, take_model
from pipeline.data.mesh import Marker
from tiler.citymodels.tables import ROOF_ARRAYS, unpack_polygons, unpack_roofs
from tiler.pictures.picture_data import City, sew
from tiler.store.out_folder import RUN_RECORD, STORE
from tiler.store.results import StoredTerrain
from tiler.store.run_folder import read_run_record
from tiler.store.store import Store

DEEP = 3.0  # m that walls reach below the ground, which is not level
TERRAIN_NODES = 450  # along the longer side of the terrain
MOST_BLOCKS = 60_000  # buildings of a picture: the largest; of more, the smaller ones would be smaller than pixels
GRID = 0.001  # m, of the corners of buildings

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


def load_blocks(directory: Path) -> tuple[City, int, int]:
    """Read the buildings of the city model and the terrain below them.

    Parameters
    ----------
    directory : Path
        Folder of a run.

    Returns
    -------
    city : City
        Terrain as ground, walls and roofs; buildings are counted from 0, `City.piece` is 0.
    n_buildings, n_shown : int
        Building parts of the city model, and those that are in `city`.

    Raises
    ------
    InputError
        If a result is missing or damaged.

    Notes
    -----
    Buildings are their solids of LoD2.2. The terrain has at most `TERRAIN_NODES` nodes along a side; of more than
    `MOST_BLOCKS` buildings the largest are read. Memory is that of these, whatever the region.
    """
    west, south, east, north = read_run_record(directory / RUN_RECORD).bounds
    store = Store(directory / STORE)
    step = max(east - west, north - south) / TERRAIN_NODES
    x, y = (
        np.linspace(low, high, max(2, round((high - low) / step) + 1))
        for low, high in ((west, east), (south, north))
    )
    ground = _find_terrain(x, y, _sample_terrain(StoredTerrain(directory / STORE), x, y))
    corners, marker, building = [ground], [np.full(len(ground), Marker.GROUND)], [np.full(len(ground), -1)]
    least, n_buildings = _find_least(store)
    n_shown = 0
    for model in _read_blocks(store, least):
        lowest = np.array([west, south, model.ground.min()])
        levels, _ = build_solids(model, np.floor(lowest), grid=GRID, blocks=np.empty((len(model), 0)))
        for kind, (triangles, owner) in (
            (Marker.ROOF, _find_roofs(levels)),
            (Marker.WALL, _find_walls(levels, round(DEEP / GRID))),
        ):
            corners.append(triangles * GRID + np.floor(lowest))
            marker.append(np.full(len(owner), kind))
            building.append(owner + n_shown)
        n_shown += len(model)
    points = np.concatenate(corners).reshape(-1, 3)
    xyz, facets = sew(points, np.arange(len(points)).reshape(-1, 3))
    origin = np.array([(west + east) / 2, (south + north) / 2, ground[..., 2].min(initial=np.inf)])
    if not len(ground):
        origin[2] = xyz[:, 2].min()
    city = City(
        points=xyz - origin,
        facets=facets.astype(np.int32),
        marker=np.concatenate(marker).astype(np.int32),
        building=np.concatenate(building),
        piece=np.zeros(len(facets), np.int32),
        names=(directory.name,),
        origin=origin,
    )
    return city, n_buildings, n_shown


def _sample_terrain(terrain: StoredTerrain, x: Floats, y: Floats) -> Floats:
    """Sample the terrain in squares of nodes, so that few of its tiles are in memory at a time."""
    z = np.empty((len(y), len(x)))
    for j in range(0, len(y), 64):
        for i in range(0, len(x), 64):
            mesh = np.meshgrid(x[i : i + 64], y[j : j + 64])
            z[j : j + 64, i : i + 64] = terrain.sample(np.column_stack([axis.ravel() for axis in mesh])).reshape(
                mesh[0].shape
            )
    return z


def _find_terrain(x: Floats, y: Floats, z: Floats) -> Floats:
    """Triangles (k, 3, 3) between nodes, where there is terrain."""
    mesh = np.stack([*np.meshgrid(x, y), z], axis=-1)
    a, b, c, d = mesh[:-1, :-1], mesh[:-1, 1:], mesh[1:, 1:], mesh[1:, :-1]
    corners = np.concatenate([np.stack(t, axis=2).reshape(-1, 3, 3) for t in ((a, b, c), (a, c, d))])
    found: Floats = corners[np.isfinite(corners).all(axis=(1, 2))]
    return found


def _find_least(store: Store) -> tuple[float, int]:
    """Find the area from which on buildings are drawn (m2), and how many there are."""
    areas = [np.empty(0, np.float32)]
    for name in store.names("model"):
        arrays, _ = store.read("model", name, names=("polygon", "polygon_start"))
        areas.append(shapely.area(unpack_polygons(arrays, "polygon")).astype(np.float32))
    area = np.concatenate(areas)
    if len(area) <= MOST_BLOCKS:
        return 0.0, len(area)
    return float(np.partition(area, len(area) - MOST_BLOCKS)[len(area) - MOST_BLOCKS]), len(area)


def _read_blocks(store: Store, least: float) -> Iterator[CityModel]:
    """Read the buildings of each tile that are drawn, without their members."""
    wanted = ("polygon", "polygon_start", "id", "number", "house", "ground", *ROOF_ARRAYS)
    for name in store.names("model"):
        arrays, _ = store.read("model", name, names=wanted)
        polygons = unpack_polygons(arrays, "polygon")
        model = CityModel(
            polygons,
            arrays["id"],
            arrays["number"],
            arrays["ground"],
            unpack_roofs(arrays),
            ((),) * len(polygons),
            arrays["house"],
        )
        kept = np.flatnonzero(shapely.area(polygons).astype(np.float32) >= least)
        if len(kept):
            yield take_model(model, kept)


def _find_roofs(levels: Levels) -> tuple[Ints, Ints]:
    """Triangles (k, 3, 3) of roofs on the grid, counter-clockwise from above, and the building of each."""
    faces = list(_list_roofs(levels.solids[0]))
    owner = np.array([building for building, _ in faces], np.int64)
    rings = [ring for _, face in faces for ring in face]
    of_ring = np.repeat(np.arange(len(faces)), [len(face) for _, face in faces])
    size = [len(ring) for ring in rings]
    corners = levels.vertices[np.concatenate([np.empty(0, np.int64), *rings])]
    outlines = shapely.linearrings(
        corners[:, :2].astype(np.float64), indices=np.repeat(np.arange(len(rings)), size)
    )
    triangles, face = shapely.get_parts(
        shapely.constrained_delaunay_triangles(shapely.polygons(outlines, indices=of_ring)), return_index=True
    )
    xy = shapely.get_coordinates(shapely.orient_polygons(triangles)).reshape(-1, 4, 2)[:, :3].reshape(-1, 2)
    # Each corner of a triangle is one of its face's, whose height it has.
    known = np.column_stack([np.repeat(of_ring, size), corners[:, :2]])
    wanted = np.column_stack([np.repeat(face, 3), np.rint(xy).astype(np.int64)])
    places, row = np.unique(np.concatenate([known, wanted]), axis=0, return_inverse=True)
    row = row.reshape(-1)
    height = np.empty(len(places), np.int64)
    height[row[: len(known)]] = corners[:, 2]
    found = np.column_stack([wanted[:, 1:], height[row[len(known) :]]])
    return found.reshape(-1, 3, 3), owner[face]


def _list_roofs(solids: Solids) -> Iterator[tuple[int, tuple[Ints, ...]]]:
    """Give each face of a roof: its building, and the vertices of its rings."""
    start = solids.ring_start.tolist()
    for row, (first, last) in enumerate(pairwise(solids.building_start.tolist())):
        if row in solids.others:
            yield from ((row, rings) for kind, rings in solids.others[row] if kind == ROOF)
        elif first < last and solids.has_solid[row]:
            yield row, tuple(solids.high[a:b] for a, b in pairwise(start[first : last + 1]))


def _find_walls(levels: Levels, deep: int) -> tuple[Ints, Ints]:
    """Two triangles of each wall, which reaches below the ground, and the building of each."""
    (solids,) = levels.solids
    n_corners = np.diff(solids.ring_start[solids.building_start])
    of_prism = np.repeat(np.arange(len(n_corners)), n_corners)
    raised = solids.high >= 0
    others = [(row, rings[0]) for row, faces in solids.others.items() for kind, rings in faces if kind == WALL]
    owner = np.concatenate([of_prism[raised], np.array([row for row, _ in others], np.int64)])
    walls = np.concatenate([solids.walls[raised], np.array([wall for _, wall in others], np.int64).reshape(-1, 4)])
    corners = levels.vertices[walls]
    corners[:, :2, 2] -= deep  # the first two corners of a wall are at its foot
    return np.concatenate([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]]), np.tile(owner, 2)
