"""The city model of a run as blocks (LoD1) on its terrain, from the run's store, for a picture."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.data.mesh import Marker
from tiler.citymodels.tables import unpack_polygons
from tiler.pictures.picture_data import City, sew
from tiler.store.out_folder import RUN_RECORD, STORE
from tiler.store.results import StoredTerrain
from tiler.store.run_folder import read_run_record
from tiler.store.store import Store

DEEP = 3.0  # m that walls reach below the ground, which is not level
TERRAIN_NODES = 450  # along the longer side of the terrain
MOST_BLOCKS = 60_000  # buildings of a picture: the largest; of more, the smaller ones would be smaller than pixels

Floats = NDArray[np.float64]


def load_blocks(directory: Path) -> tuple[City, int, int]:
    """Read the blocks of the city model and the terrain below them.

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
    The terrain has at most `TERRAIN_NODES` nodes along a side; of more than `MOST_BLOCKS` buildings the largest
    are read. Memory is that of these, whatever the region.
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
    for polygons, foot, roof in _read_blocks(store, least):
        for kind, (triangles, owner) in (
            (Marker.ROOF, _find_roofs(polygons, roof)),
            (Marker.WALL, _find_walls(polygons, foot - DEEP, roof)),
        ):
            corners.append(triangles)
            marker.append(np.full(len(owner), kind))
            building.append(owner + n_shown)
        n_shown += len(polygons)
    points = np.concatenate(corners).reshape(-1, 3)
    xyz, facets = sew(points, np.arange(len(points)).reshape(-1, 3))
    origin = np.array([(west + east) / 2, (south + north) / 2, ground[..., 2].min(initial=np.inf)])
    if not len(ground):
        origin[2] = xyz[:, 2].min()
    city = City(
        points=xyz - origin,
        facets=facets,
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


def _read_blocks(store: Store, least: float) -> Iterator[tuple[NDArray[np.object_], Floats, Floats]]:
    for name in store.names("model"):
        arrays, _ = store.read("model", name, names=("polygon", "polygon_start", "ground", "roof"))
        polygons = unpack_polygons(arrays, "polygon")
        kept = shapely.area(polygons).astype(np.float32) >= least
        if kept.any():
            yield polygons[kept], arrays["ground"][kept], arrays["roof"][kept]


def _find_roofs(polygons: NDArray[np.object_], roof: Floats) -> tuple[Floats, NDArray[np.int64]]:
    """Triangles (k, 3, 3) of roofs, counter-clockwise from above, and the building of each."""
    triangles, owner = shapely.get_parts(shapely.constrained_delaunay_triangles(polygons), return_index=True)
    flat = shapely.get_coordinates(shapely.orient_polygons(triangles)).reshape(-1, 4, 2)[:, :3]
    return np.concatenate([flat, np.repeat(roof[owner], 3).reshape(-1, 3, 1)], axis=2), owner


def _find_walls(polygons: NDArray[np.object_], foot: Floats, roof: Floats) -> tuple[Floats, NDArray[np.int64]]:
    """Two triangles below each edge of outlines and courtyards, and the building of each."""
    parts, of_part = shapely.get_parts(shapely.orient_polygons(polygons), return_index=True)
    rings, of_ring = shapely.get_rings(parts, return_index=True)
    xy, ring = shapely.get_coordinates(rings, return_index=True)
    edge = np.flatnonzero(ring[1:] == ring[:-1])
    owner = of_part[of_ring[ring[edge]]]
    (a, b), (low_a, low_b) = (
        (np.column_stack([xy[edge], z[owner]]), np.column_stack([xy[edge + 1], z[owner]])) for z in (roof, foot)
    )
    walls = np.concatenate([np.stack([a, low_a, low_b], axis=1), np.stack([a, low_b, b], axis=1)])
    return walls, np.tile(owner, 2)
