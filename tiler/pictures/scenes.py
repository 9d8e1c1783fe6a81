"""What painted pictures show: the city by height or by quality, its LoD1 blocks, and the mesh cut open."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.columns import expand_cells
from pipeline.errors import InputError
from pipeline.mesh import ColumnMesh, Marker, PlaneMesh
from pipeline.quality import measure_cells
from tiler.citymodels.tables import unpack_polygons
from tiler.pictures.paint import Scene, join_scenes
from tiler.pictures.picture_data import City
from tiler.pictures.picture_parts import (
    AIR_COLOURS,
    GROUND_COLOURS,
    ROOF_COLOURS,
    SKIRT_COLOUR,
    TALL,
    THICKNESS,
    WALL_COLOURS,
    blend,
    heights_above_ground,
)
from tiler.store.results import StoredTerrain, read_columns
from tiler.store.store import Store
from tiler.workflow.out_folder import STORE

# From bad to good; lightness rises all the way, so that grey prints tell the same.
QUALITY_COLOURS = ("#3b0f47", "#8c2369", "#d0504f", "#f3a25a", "#f7e3a1", "#f4f6ea")
QUALITY_LIMITS = (0.2, 0.8)  # radius ratios of the first and the last colour
LID = 0.6  # colour of the top of the air, from 0 to 1
DEEP = 3.0  # m that walls reach below the ground, which is not level
TERRAIN_NODES = 450  # along the longer side of the terrain under the blocks
MOST_BLOCKS = 60_000  # buildings of a picture: the largest; of more, the smaller ones would be smaller than pixels

Floats = NDArray[np.float64]


def city_scene(city: City, *, quality: bool = False) -> Scene:
    """Show ground, walls and roofs, and the block that they stand on.

    Parameters
    ----------
    city : City
        The boundary.
    quality : bool
        Colour facets by the radius ratio of the cell behind them; else the ground by its height and roofs by
        theirs above the ground.
    """
    corners = city.points[city.facets]
    if quality:
        rgb = quality_colours(city.quality.astype(np.float64))
    else:
        ground = city.marker == Marker.GROUND
        rgb = blend(heights_above_ground(city) / TALL, ROOF_COLOURS)
        rgb[city.marker == Marker.WALL] = blend(np.zeros(1), WALL_COLOURS)
        z = corners[ground, :, 2].mean(axis=1)
        rgb[ground] = blend(z / max(float(np.percentile(z, 98)), 1e-9), GROUND_COLOURS)
    return join_scenes([Scene(corners, rgb, np.ones(len(corners), np.bool_)), skirt_scene(city)])


def quality_colours(ratio: Floats) -> NDArray[np.uint8]:
    """Colour radius ratios; grey where one is not known."""
    low, high = QUALITY_LIMITS
    rgb = blend((np.nan_to_num(ratio, nan=low) - low) / (high - low), QUALITY_COLOURS)
    rgb[np.isnan(ratio)] = (128, 128, 128)
    return rgb


def skirt_scene(city: City) -> Scene:
    """Sides of the block under the city: from the rim of its surface down."""
    edges = np.concatenate([city.facets[:, [0, 1]], city.facets[:, [1, 2]], city.facets[:, [2, 0]]])
    key = np.sort(edges, axis=1) @ np.array([len(city.points), 1])
    _, first, count = np.unique(key, return_index=True, return_counts=True)
    a, b = city.points[edges[first[count == 1]].T]
    depth = THICKNESS * float(np.ptp(city.points[:, :2], axis=0).max())
    return _plain(_walls(a, b, min(0.0, float(city.points[:, 2].min())) - depth), SKIRT_COLOUR)


def cut_scene(directory: Path, city: City, *, quality: bool = False) -> Scene:
    """Show the mesh cut open along a line from west to east: the cells behind it, and the sides of the air.

    Parameters
    ----------
    directory : Path
        Folder of a run; columns are read from its store.
    city : City
        Boundary of the tiles to show, for their names and the origin; the cut is there.
    quality : bool
        Colour cells by radius ratio; else by height.

    Raises
    ------
    InputError
        If a result is missing or damaged, or no cell is behind the cut.
    """
    store, parts = Store(directory / STORE), []
    for name in city.names:
        columns, _ = read_columns(store, name)
        parts += _cut_columns(columns, city.origin, quality)
    if not parts:
        raise InputError(f"{directory}: has no cell north of y = {city.origin[1]:.1f} m; run again")
    return join_scenes(parts)


def _cut_columns(mesh: ColumnMesh, origin: Floats, quality: bool) -> list[Scene]:
    """Cells of the triangles north of the cut that touch one south of it, top and sides of all north of it."""
    plane = mesh.plane
    centre = plane.xy[plane.triangles].mean(axis=1)
    north = centre[:, 1] > origin[1]
    if not north.any():
        return []
    south = np.zeros(len(plane.xy), np.bool_)
    south[plane.triangles[~north]] = True
    at_cut = np.flatnonzero(north & (south[plane.triangles].sum(axis=1) >= 2))
    part = ColumnMesh(
        PlaneMesh(plane.xy, plane.triangles[at_cut], plane.building[at_cut]),
        mesh.z_start,
        mesh.z,
        mesh.bottom[at_cut],
        mesh.order,
    )
    cells = expand_cells(part)
    corners = cells.points[cells.cells] - origin
    faces = np.concatenate([corners[:, face] for face in ((1, 2, 3), (0, 2, 3), (0, 1, 3), (0, 1, 2))])
    if quality:
        rgb = np.tile(quality_colours(measure_cells(cells).radius_ratio.astype(np.float64)), (4, 1))
    else:
        z = corners[..., 2].mean(axis=1)
        rgb = np.tile(blend(z / max(float(z.max(initial=0.0)), 1e-9), AIR_COLOURS), (4, 1))
    shell = Scene(faces, rgb, np.ones(len(faces), np.bool_))
    return [shell, *_hull(mesh, plane.triangles[north], south, origin)]


def _hull(mesh: ColumnMesh, triangles: NDArray[np.int32], south: NDArray[np.bool_], origin: Floats) -> list[Scene]:
    """Top of the air over triangles, and its sides where these end, but for those that face the cut."""
    low, top = (
        np.column_stack([mesh.plane.xy, mesh.z[level]]) - origin
        for level in (mesh.z_start[:-1], mesh.z_start[1:] - 1)
    )
    lid = Scene(
        top[triangles], blend(np.full(len(triangles), LID), AIR_COLOURS), np.ones(len(triangles), np.bool_)
    )
    edges = np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [0, 2]]]), axis=1)
    edges, count = np.unique(edges, axis=0, return_counts=True)
    a, b = edges[(count == 1) & ~south[edges].all(axis=1)].T
    sides = np.concatenate([np.stack(t, axis=1) for t in ((top[a], top[b], low[b]), (top[a], low[b], low[a]))])
    return [lid, _plain(sides, AIR_COLOURS[1])]


@dataclass(frozen=True, eq=False)
class Blocks:
    """The city model as blocks on its terrain.

    Attributes
    ----------
    scene : Scene
        What to paint.
    origin : float64, (3,)
        Middle of the region, at the height of the lowest ground (m).
    n_buildings, n_shown : int
        Buildings of the city model, and those that are drawn.
    """

    scene: Scene
    origin: Floats
    n_buildings: int
    n_shown: int


def block_scene(directory: Path, bounds: tuple[float, float, float, float]) -> Blocks:
    """Show the LoD1 blocks of the city model on the terrain, from the store of a run.

    Parameters
    ----------
    directory : Path
        Folder of a run.
    bounds : (xmin, ymin, xmax, ymax)
        Its region (m).

    Raises
    ------
    InputError
        If a result is missing or damaged.

    Notes
    -----
    The terrain has at most `TERRAIN_NODES` nodes along a side; of more than `MOST_BLOCKS` buildings the largest
    are drawn. Memory is that of these, whatever the region.
    """
    store = Store(directory / STORE)
    step = max(bounds[2] - bounds[0], bounds[3] - bounds[1]) / TERRAIN_NODES
    x, y = (
        np.linspace(low, high, max(2, round((high - low) / step) + 1))
        for low, high in ((bounds[0], bounds[2]), (bounds[1], bounds[3]))
    )
    z = _sample_terrain(StoredTerrain(directory / STORE), x, y)
    known = np.isfinite(z)
    origin = np.array([(bounds[0] + bounds[2]) / 2, (bounds[1] + bounds[3]) / 2, float(z[known].min(initial=0.0))])
    least, n_buildings = _find_least(store)
    parts = [_terrain(x - origin[0], y - origin[1], z - origin[2])]
    n_shown = 0
    for polygons, ground, roof in _read_blocks(store, least):
        parts.append(_blocks(polygons, ground, roof, origin))
        n_shown += len(polygons)
    return Blocks(join_scenes(parts), origin, n_buildings, n_shown)


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


def _terrain(x: Floats, y: Floats, z: Floats) -> Scene:
    mesh = np.stack([*np.meshgrid(x, y), z], axis=-1)
    a, b, c, d = mesh[:-1, :-1], mesh[:-1, 1:], mesh[1:, 1:], mesh[1:, :-1]
    corners = np.concatenate([np.stack(t, axis=2).reshape(-1, 3, 3) for t in ((a, b, c), (a, c, d))])
    corners = corners[np.isfinite(corners).all(axis=(1, 2))]
    height = corners[..., 2].mean(axis=1)
    tall = max(float(np.percentile(height, 98)), 1e-9) if len(height) else 1.0
    ground = Scene(corners, blend(height / tall, GROUND_COLOURS), np.zeros(len(corners), np.bool_))
    rims = [mesh[0], mesh[-1], mesh[:, 0], mesh[:, -1]]
    depth = float(np.nanmin(z)) - THICKNESS * max(np.ptp(x), np.ptp(y))
    sides = np.concatenate([_walls(rim[:-1], rim[1:], depth) for rim in rims])
    return join_scenes([ground, _plain(sides, SKIRT_COLOUR)])


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


def _blocks(polygons: NDArray[np.object_], ground: Floats, roof: Floats, origin: Floats) -> Scene:
    """Roofs and walls of buildings; walls begin a little below the ground, which is not level."""
    triangles, owner = shapely.get_parts(shapely.constrained_delaunay_triangles(polygons), return_index=True)
    flat = shapely.get_coordinates(shapely.get_exterior_ring(triangles)).reshape(-1, 4, 2)[:, :3] - origin[:2]
    tops = np.concatenate([flat, np.repeat((roof - origin[2])[owner], 3).reshape(-1, 3, 1)], axis=2)
    colours = blend((roof - ground) / TALL, ROOF_COLOURS)
    parts, of_part = shapely.get_parts(polygons, return_index=True)
    rings, of_ring = shapely.get_rings(parts, return_index=True)
    xy, ring = shapely.get_coordinates(rings, return_index=True)
    edge = np.flatnonzero(ring[1:] == ring[:-1])
    house = of_part[of_ring[ring[edge]]]
    a, b = (np.column_stack([xy[rows] - origin[:2], (roof - origin[2])[house]]) for rows in (edge, edge + 1))
    walls = _walls(a, b, ground[house] - origin[2] - DEEP)
    return join_scenes(
        [Scene(tops, colours[owner], np.zeros(len(tops), np.bool_)), _plain(walls, WALL_COLOURS[0])]
    )


def _walls(a: Floats, b: Floats, foot: float | Floats) -> Floats:
    """Two triangles below each edge from `a` to `b` (n, 3), down to a height."""
    down_a, down_b = a.copy(), b.copy()
    down_a[:, 2] = down_b[:, 2] = foot
    return np.concatenate([np.stack([a, b, down_b], axis=1), np.stack([a, down_b, down_a], axis=1)])


def _plain(corners: Floats, colour: str) -> Scene:
    rgb = np.tile(np.array(list(bytes.fromhex(colour[1:])), np.uint8), (len(corners), 1))
    return Scene(corners, rgb, np.zeros(len(corners), np.bool_))
