"""Tiles meshed one by one, each from what its halo holds, then glued: what the tests of seams have in common."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import pyproj
import shapely
from numpy.typing import NDArray

from pipeline.city_model.city_steps import build_city
from pipeline.city_model.groups import adjacent_houses
from pipeline.city_model.heights import highest_wall_ground, raise_low_roofs
from pipeline.columns.adaptive import AdaptiveOptions, mesh_adaptive
from pipeline.columns.columns import expand_cells
from pipeline.columns.layered import LayeredOptions, choose_layers, mesh_layers, terrain_reach
from pipeline.columns.nodes import Levels
from pipeline.columns.spacing import SpacingLimits, domain_top, top_reach
from pipeline.data.citymodel import CityModel, take_model
from pipeline.data.mesh import ColumnMesh, TetMesh
from pipeline.data.pointcloud import PointCloud
from pipeline.data.roofs import flat_roofs
from pipeline.plane_mesh.plane import signed_areas
from pipeline.plane_mesh.sizes import Finer, SizeField, SizeRule, size_field
from pipeline.points_terrain.terrain import Dtm, compute_dtm, sample_dtm
from stitch.pieces.conformity import compute_cell_volumes, pair_cell_faces, pair_edges
from stitch.seams.layered_seams import fill_corner_layers, fill_seam_layers
from stitch.seams.seam_columns import fill_corner, fill_seam, tile_columns
from stitch.seams.seams import Seam, trace_seam
from stitch.seams.tiles import mesh_tile, sizes_halo, tile_halo
from stitch.tiling.corners import Corner, place_corner
from stitch.tiling.grid import (
    Key,
    SeamKey,
    TileGrid,
    ends_of_seam,
    is_border,
    make_grid,
    seam_keys,
    seams_of_tile,
    tile_keys,
)
from stitch.tiling.patches import mesh_patch
from stitch.tiling.walls import cut_walls
from tests.helpers.cities import CITY_OPTIONS, Bounds, city_of, crowded_blocks, hilly_dtm
from tests.helpers.footprint_reading import read_footprints
from tests.helpers.whole_city import simplify_city
from tests.helpers.whole_clouds import read_points
from tiler.pointclouds.clouds import find_clouds

MIN_ANGLE = 28.0
REFINEMENTS = 1
PASSES = 4
LIMITS = SpacingLimits(least=0.1, most=0.8)
OPTIONS = AdaptiveOptions(mesh_size=10.0, domain_height=60.0, limits=LIMITS, stagger=0.8, passes=1)
LAYERED = LayeredOptions(
    mesh_size=10.0, layer_height=5.0, domain_height=60.0, smoother="columns", tolerance=0.003, fem_tolerance=1e-8
)

Options = AdaptiveOptions | LayeredOptions
BOTH = {"adaptive": OPTIONS, "layered": LAYERED}
SQUARE: Bounds = (0.0, 0.0, 420.0, 420.0)
NINE = make_grid(SQUARE, tile_size=140.0, mesh_size=10.0)


@dataclass(frozen=True, eq=False)
class Scene:
    """A city to mesh: model, groups of equal roofs, terrain."""

    model: CityModel
    group: NDArray[np.int32]
    dtm: Dtm


@dataclass(frozen=True, eq=False)
class Tile:
    """A tile meshed alone, with the seams that it made for itself."""

    mesh: ColumnMesh
    seams: dict[SeamKey, Seam]
    columns: dict[SeamKey, Levels]


def scene_of(polygons: Sequence[shapely.Polygon], roofs: Sequence[float], dtm: Dtm) -> Scene:
    """Set houses on a terrain: roofs in metres above the highest ground at their walls, no groups."""
    model = city_of(list(polygons), [0.0] * len(polygons))
    wall_ground = highest_wall_ground(model.polygons, dtm)
    roof, _ = raise_low_roofs(wall_ground + np.array(roofs), wall_ground, clearance=2.0)
    return Scene(replace(model, roofs=flat_roofs(roof)), np.arange(len(model), dtype=np.int32), dtm)


def random_scene(bounds: Bounds, n: int, *, seed: int, relief: float = 0.0) -> Scene:
    """Crowded blocks on hills."""
    roofs = np.random.default_rng(seed).uniform(5, 30, n)
    return scene_of(crowded_blocks(bounds, n, seed=seed), roofs.tolist(), hilly_dtm(bounds, relief=relief))


def amsterdam_scene(folder: Path, bounds: Bounds, simplify: Literal["clearance", "paper"]) -> Scene:
    """Central Amsterdam between bounds (m), its city model made by the one way or the other."""
    clouds = [read_points(path, bounds)[0] for path in find_clouds([folder / "tiles"])]
    cloud = PointCloud(
        np.concatenate([part.xyz for part in clouds]), np.concatenate([part.classification for part in clouds])
    )
    footprints, _ = read_footprints(folder / "footprints.shp", crs=pyproj.CRS("EPSG:28992"), bounds=bounds)
    dtm = compute_dtm(cloud, bounds)
    options = replace(CITY_OPTIONS, roof_percentile=50.0, simplify=simplify, split_levels=True, roof_group=2.5)
    city = simplify_city(build_city(cloud, footprints, dtm, bounds, options), cloud, dtm, options)
    return Scene(city.model, city.group, dtm)


def select_houses(scene: Scene, chosen: NDArray[np.integer]) -> Scene:
    """Take some houses, in any order."""
    model = scene.model
    return Scene(take_model(model, chosen), scene.group[chosen], scene.dtm)


def reach_of(options: Options) -> float:
    """How far beyond a mesh terrain counts (m)."""
    return terrain_reach(options) if isinstance(options, LayeredOptions) else top_reach(options.domain_height)


def layers_of(scene: Scene, bounds: Bounds, options: LayeredOptions) -> NDArray[np.int32]:
    """Choose the layers of all houses at once."""
    model = scene.model
    wall_ground = highest_wall_ground(model.polygons, scene.dtm)
    pairs = adjacent_houses(model.polygons)
    return choose_layers(model.polygons, model.roof, wall_ground, scene.group, pairs, scene.dtm, bounds, options)[
        0
    ]


def clip_scene(scene: Scene, grid: TileGrid, tile: Key, options: Options, rule: SizeRule | None = None) -> Scene:
    """Take what a tile may look at, and nothing else."""
    i, j = tile.i - grid.first.i, tile.j - grid.first.j
    (xmin, xmax), (ymin, ymax) = grid.lines[0][i : i + 2], grid.lines[1][j : j + 2]
    halo = tile_halo(grid.tile_size, options.mesh_size, rule)
    see = halo if rule is None else sizes_halo(grid.tile_size, rule)
    box = shapely.box(xmin - see, ymin - see, xmax + see, ymax + see)
    near = select_houses(scene, np.flatnonzero(shapely.intersects(scene.model.polygons, box)))
    dtm, far = scene.dtm, halo + reach_of(options) + 2 * scene.dtm.spacing
    west, east, south, north = (
        int(np.clip(round(value / dtm.spacing) - first, 0, size))
        for value, first, size in (
            (xmin - far, dtm.i0, dtm.z.shape[1]),
            (xmax + far, dtm.i0 - 1, dtm.z.shape[1]),
            (ymin - far, dtm.j0, dtm.z.shape[0]),
            (ymax + far, dtm.j0 - 1, dtm.z.shape[0]),
        )
    )
    clipped = Dtm(dtm.z[south:north, west:east].copy(), dtm.i0 + west, dtm.j0 + south, dtm.spacing)
    return replace(near, dtm=clipped)


def mesh_alone(
    scene: Scene,
    grid: TileGrid,
    tile: Key,
    options: Options = OPTIONS,
    *,
    clip: bool = True,
    removed: NDArray[np.int32] | None = None,
    rule: SizeRule | None = None,
    finer: Sequence[Finer] = (),
) -> Tile:
    """Mesh one tile: its corners and seams first, from what its halo holds, or from the whole scene.

    With layers, those removed in each house are given, or chosen from the whole scene.
    """
    near = clip_scene(scene, grid, tile, options, rule) if clip else scene
    model, size = near.model, options.mesh_size
    # Rows of the whole city, so that meshes from halos of any extent compare.
    order = np.argsort(scene.model.numbers)
    rows = order[np.searchsorted(scene.model.numbers, model.numbers, sorter=order)]
    if isinstance(options, LayeredOptions):
        removed = (layers_of(scene, grid.bounds, options) if removed is None else removed)[rows]
    walls = cut_walls(model.polygons, mesh_size=rule.at_walls if rule else size, finer=finer)
    sizes = size_field(walls, rule, finer) if rule else None
    corners: dict[Key, Corner] = {}
    seams: dict[SeamKey, Seam] = {}
    columns: dict[SeamKey, Levels] = {}
    for key in seams_of_tile(tile):
        start, end = (
            corners.setdefault(at, place_corner(grid, at, model.polygons, walls, mesh_size=size, sizes=sizes))
            for at in ends_of_seam(key)
        )
        seams[key] = seam = trace_seam(
            grid,
            key,
            (start, end),
            model.polygons,
            walls,
            mesh_size=size,
            min_angle=MIN_ANGLE,
            passes=PASSES,
            sizes=sizes,
        )
        if not seam.border:
            columns[key] = _seam_levels(seam, (start, end), near, walls, removed, grid, options, sizes)
    south, east, north, west = (seams[key] for key in seams_of_tile(tile))
    plane, complete = mesh_tile(
        (south, east, north, west),
        model.polygons,
        walls,
        mesh_size=size,
        min_angle=MIN_ANGLE,
        refinements=REFINEMENTS,
        passes=PASSES,
        sizes=sizes,
    )
    assert complete
    given = tile_columns(plane, [(seams[key], columns[key]) for key in columns])
    if isinstance(options, AdaptiveOptions):
        mesh, _ = mesh_adaptive(plane, near.dtm, model.roofs, model.ids, options, seam=given, sizes=sizes)
    else:
        none = np.empty(0)
        mesh, _ = mesh_layers(plane, near.dtm, model, none, grid.bounds, options, removed=removed, seam=given)
    building = np.append(rows, -1).astype(np.int32)[plane.building]
    return Tile(replace(mesh, plane=replace(plane, building=building)), seams, columns)


def mesh_all(
    scene: Scene,
    grid: TileGrid,
    options: Options = OPTIONS,
    *,
    rule: SizeRule | None = None,
    finer: Sequence[Finer] = (),
) -> dict[Key, Tile]:
    """Mesh every tile alone."""
    removed = layers_of(scene, grid.bounds, options) if isinstance(options, LayeredOptions) else None
    return {
        tile: mesh_alone(scene, grid, tile, options, removed=removed, rule=rule, finer=finer)
        for tile in tile_keys(grid)
    }


def _seam_levels(
    seam: Seam,
    ends: tuple[Corner, Corner],
    near: Scene,
    walls: NDArray[np.float64],
    removed: NDArray[np.int32] | None,
    grid: TileGrid,
    options: Options,
    sizes: SizeField | None,
) -> Levels:
    """Columns of a seam, those of its corners first."""
    dtm, roof, ids = near.dtm, near.model.roof, near.model.ids
    if isinstance(options, AdaptiveOptions):
        roofs = near.model.roofs
        start, end = (fill_corner(corner, dtm, roofs, ids, options, sizes=sizes) for corner in ends)
        return fill_seam(seam, (start, end), dtm, roofs, ids, options, sizes=sizes)
    assert removed is not None
    start, end = (
        fill_corner_layers(
            corner,
            mesh_patch(
                corner,
                near.model.polygons,
                walls,
                grid.bounds,
                mesh_size=options.mesh_size,
                min_angle=MIN_ANGLE,
                sizes=sizes,
            ),
            dtm,
            roof,
            ids,
            removed,
            grid.bounds,
            options,
        )
        for corner in ends
    )
    return fill_seam_layers(seam, (start, end), dtm, roof, ids, removed, grid.bounds, options)


def mesh_bytes(mesh: ColumnMesh) -> bytes:
    """All of a mesh as bytes."""
    plane = mesh.plane
    arrays = (plane.xy, plane.triangles, plane.building, mesh.z_start, mesh.z, mesh.bottom)
    return b"".join(array.tobytes() for array in arrays)


def glue(meshes: Sequence[ColumnMesh]) -> TetMesh:
    """Make one mesh of many: points with the same coordinates, bit for bit, are one."""
    parts = [expand_cells(mesh) for mesh in meshes]
    first = np.cumsum([0] + [len(part.points) for part in parts])
    points, index = np.unique(np.concatenate([part.points for part in parts]), axis=0, return_inverse=True)
    cells = np.concatenate([part.cells + offset for part, offset in zip(parts, first[:-1], strict=True)])
    return TetMesh(points, index.reshape(-1)[cells].astype(np.int32))


def prove_tiles(
    scene: Scene,
    grid: TileGrid,
    options: Options = OPTIONS,
    *,
    level: bool = False,
    rule: SizeRule | None = None,
    finer: Sequence[Finer] = (),
) -> dict[Key, Tile]:
    """Mesh every tile alone, and prove that glued they are one mesh, which on level ground fills the box."""
    tiles = mesh_all(scene, grid, options, rule=rule, finer=finer)
    assert prove_seams(tiles) == sum(not is_border(grid, key) for key in seam_keys(grid))
    prove_glued(glue([tile.mesh for tile in tiles.values()]), scene, grid.bounds, options)
    if level:
        prove_volume(tiles, scene, grid.bounds, options)
    return tiles


def same_houses(mesh: ColumnMesh, rows: NDArray[np.integer]) -> bytes:
    """All of a mesh as bytes, its houses by their rows elsewhere."""
    building = np.append(rows, -1).astype(np.int32)[mesh.plane.building]
    return mesh_bytes(replace(mesh, plane=replace(mesh.plane, building=building)))


def prove_glued(mesh: TetMesh, scene: Scene, bounds: Bounds, options: Options = OPTIONS) -> None:
    """Prove that glued tiles are one mesh with no boundary but ground, roofs, walls, top and sides."""
    volume, flat = compute_cell_volumes(mesh.points, mesh.cells)
    assert volume.min() > 0
    assert not flat.any()
    faces = pair_cell_faces(mesh.cells, len(mesh.points))
    assert len(faces.same_side) == 0
    assert len(faces.shared) == 0
    assert len(pair_edges(faces.exterior).open) == 0
    corners = mesh.points[faces.exterior]
    # Twice the plan area; a face over an edge of the plane mesh has none but for rounding.
    u, v = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    plan = u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]
    upright = np.abs(plan) < 1e-4
    prove_upright(corners[upright], scene, bounds)
    prove_level(corners[~upright], plan[~upright] > 0, scene, options)


def prove_upright(corners: NDArray[np.float64], scene: Scene, bounds: Bounds) -> None:
    """Prove that upright faces are on the region's sides, or on walls and not above the roofs there."""
    low, high = np.array(bounds[:2]), np.array(bounds[2:])
    side = ((corners[..., :2] == low) | (corners[..., :2] == high)).all(axis=1).any(axis=1)
    inner = corners[~side]
    middle = shapely.points(inner[..., :2].mean(axis=1))
    ends = [shapely.points(inner[:, k, :2]) for k in range(3)]
    highest = np.full(len(inner), -np.inf)
    walls = shapely.STRtree(shapely.boundary(scene.model.polygons))
    face, house = walls.query(middle, predicate="dwithin", distance=1e-6)
    for points in ends:
        assert (shapely.distance(points[face], walls.geometries[house]) < 1e-6).all()
    np.maximum.at(highest, face, scene.model.roof[house])
    assert (inner[..., 2].max(axis=1) <= highest).all()


def prove_level(corners: NDArray[np.float64], up: NDArray[np.bool_], scene: Scene, options: Options) -> None:
    """Prove that faces upwards are the top, and faces downwards ground and roofs, bit for bit.

    The top of layers gives way to high roofs, so of these only that it is whole and far above the ground.
    """
    ceiling = corners[up].reshape(-1, 3)
    if isinstance(options, AdaptiveOptions):
        top = domain_top(scene.dtm, ceiling[:, :2], domain_height=options.domain_height)
        assert ceiling[:, 2].tobytes() == top.tobytes()
    else:
        air = ceiling[:, 2] - sample_dtm(scene.dtm, ceiling[:, :2])
        assert air.min() > options.domain_height / 2
        whole = np.prod(ceiling[:, :2].max(axis=0) - ceiling[:, :2].min(axis=0))
        np.testing.assert_allclose(_areas(corners[up]).sum(), whole, rtol=1e-9)
    floor = corners[~up]
    house = np.full(len(floor), -1)
    centre = shapely.points(floor[..., :2].mean(axis=1))
    face, inside = shapely.STRtree(scene.model.polygons).query(centre, predicate="within")
    house[face] = inside
    ground = sample_dtm(scene.dtm, floor.reshape(-1, 3)[:, :2]).reshape(-1, 3)
    wanted = np.where(house[:, None] >= 0, np.append(scene.model.roof, 0)[house][:, None], ground)
    assert floor[..., 2].tobytes() == wanted.tobytes()
    built = np.bincount(house[house >= 0], _areas(floor[house >= 0]), len(scene.model))
    np.testing.assert_allclose(built, shapely.area(scene.model.polygons), rtol=1e-6)


def prove_seams(tiles: dict[Key, Tile]) -> int:
    """Prove that both tiles of a seam have it bit for bit, columns included; count these seams."""
    found: dict[SeamKey, bytes] = {}
    for tile in tiles.values():
        position = {xy.tobytes(): k for k, xy in enumerate(tile.mesh.plane.xy)}
        for key, levels in tile.columns.items():
            seam = tile.seams[key]
            start = tile.mesh.z_start
            rows = [position[xy.tobytes()] for xy in seam.xy]
            in_mesh = [tile.mesh.z[start[row] : start[row + 1]].tobytes() for row in rows]
            assert b"".join(in_mesh) == levels.z.tobytes()
            bits = b"|".join([seam.xy.tobytes(), *in_mesh])
            assert found.setdefault(key, bits) == bits
    return len(found)


def prove_volume(tiles: dict[Key, Tile], scene: Scene, bounds: Bounds, options: Options = OPTIONS) -> None:
    """Prove on level ground that the cells of all tiles fill the box less the buildings."""
    area = sum(np.abs(signed_areas(tile.mesh.plane)).sum() for tile in tiles.values())
    whole = (bounds[2] - bounds[0]) * (bounds[3] - bounds[1])
    np.testing.assert_allclose(area, whole, rtol=1e-12)
    cells = [expand_cells(tile.mesh) for tile in tiles.values()]
    volume = sum(compute_cell_volumes(part.points, part.cells)[0].sum() for part in cells)
    ground = float(scene.dtm.z[0, 0])
    built = (shapely.area(scene.model.polygons) * (scene.model.roof - ground)).sum()
    box = whole * options.domain_height
    if isinstance(options, LayeredOptions):
        box = sum(_volume_to_top(tile.mesh, ground) for tile in tiles.values())
    np.testing.assert_allclose(volume, box - built, rtol=1e-10)


def _volume_to_top(mesh: ColumnMesh, ground: float) -> float:
    """Volume between level ground and the tops of the columns (m3)."""
    top = mesh.z[mesh.z_start[1:] - 1][mesh.plane.triangles].mean(axis=1)
    return float((np.abs(signed_areas(mesh.plane)) * (top - ground)).sum())


def _areas(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    u, v = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area: NDArray[np.float64] = np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]) / 2
    return area
