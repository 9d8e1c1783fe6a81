"""A catalogue of tiny cities made in code, with the answers worked out by hand where tests need them."""

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import affinity

from pipeline.city_model.city import CityOptions
from pipeline.city_model.heights import highest_wall_ground
from pipeline.data.citymodel import CityModel, number_ids
from pipeline.data.classes import BUILDING, GROUND
from pipeline.data.pointcloud import PointCloud
from pipeline.data.roofs import flat_roofs
from pipeline.points_terrain.terrain import Dtm

Bounds = tuple[float, float, float, float]


# The parameters of a city model as the paper has it; `dataclasses.replace` gives others.
CITY_OPTIONS = CityOptions(
    min_building_area=5.0,
    vertex_tolerance=0.01,
    ground_margin=1.0,
    ground_percentile=10.0,
    roof_percentile=90.0,
    default_height=6.0,
    roof_clearance=2.0,
    border="drop",
    simplify="paper",
    clearance=1.0,
    finer_clearance=0.0,
    clearance_floor=0.1,
    min_courtyard_area=10.0,
    roofs="flat",
    roof_price=4.0,
    split_levels=False,
    roof_group=2.0,
    manifold=False,
)


def tilted_dtm(bounds: Bounds, *, slope_x: float = 0.0, slope_y: float = 0.0, height: float = 0.0) -> Dtm:
    """Terrain ``height + slope_x x + slope_y y`` on a 1 m grid over whole-metre bounds."""
    i0, j0 = int(bounds[0]), int(bounds[1])
    x = np.arange(i0, int(bounds[2]) + 1, dtype=float)
    y = np.arange(j0, int(bounds[3]) + 1, dtype=float)[:, None]
    return Dtm(height + slope_x * x + slope_y * y, i0, j0, 1.0)


def hilly_dtm(bounds: Bounds, *, relief: float, length: float = 150.0, noise: float = 0.0, seed: int = 0) -> Dtm:
    """Smooth hills with a total height of about `relief` (m)."""
    flat = tilted_dtm(bounds)
    ny, nx = flat.z.shape
    x, y = np.arange(nx)[None, :], np.arange(ny)[:, None]
    hills = relief / 2 * np.sin(x / length) * np.cos(y / (0.9 * length))
    rough = np.random.default_rng(seed).normal(0, noise, flat.z.shape) if noise else 0.0
    return Dtm(hills + rough, flat.i0, flat.j0, 1.0)


def city_of(polygons: list[shapely.Polygon], roofs: list[float], *, ground: float = 0.0) -> CityModel:
    """City model with ids "1", "2", ..."""
    ids = np.array([str(k + 1) for k in range(len(polygons))], dtype=np.str_)
    shapes = np.empty(len(polygons), object)
    shapes[:] = polygons
    return CityModel(
        shapes,
        ids,
        number_ids(ids),
        np.full(len(polygons), ground),
        flat_roofs(np.array(roofs, dtype=np.float64)),
        tuple((str(name),) for name in ids),
        ids,
    )


def random_blocks(
    bounds: Bounds, n: int, *, seed: int, clearance: float = 1.5, margin: float = 5.0
) -> list[shapely.Polygon]:
    """Randomly placed and rotated rectangles, farther apart than `clearance` (m)."""
    rng = np.random.default_rng(seed)
    blocks: list[shapely.Polygon] = []
    while len(blocks) < n:
        width, depth = rng.uniform(8, 25, 2)
        x = rng.uniform(bounds[0] + 20 + margin, bounds[2] - 20 - margin)
        y = rng.uniform(bounds[1] + 20 + margin, bounds[3] - 20 - margin)
        block = affinity.rotate(shapely.box(-width / 2, -depth / 2, width / 2, depth / 2), rng.uniform(0, 90))
        block = affinity.translate(block, x, y)
        if all(block.distance(other) > clearance for other in blocks):
            blocks.append(block)
    return blocks


def crowded_blocks(bounds: Bounds, n: int, *, seed: int, clearance: float = 1.0) -> list[shapely.Polygon]:
    """Rectangles and L-shapes of 8 to 32 m, a third of them set close beside another one.

    Farther apart than `clearance` (m) from each other, 5 m from the border.
    """
    rng = np.random.default_rng(seed)
    inner = shapely.box(*bounds).buffer(-5)
    shapely.prepare(inner)
    blocks: list[shapely.Polygon] = []
    while len(blocks) < n:
        block = _random_block(rng)
        x, y = rng.uniform(bounds[:2], bounds[2:])
        if blocks and rng.random() < 1 / 3:
            other = blocks[rng.integers(len(blocks))]
            gap = (np.sqrt(other.area) + np.sqrt(block.area)) / 2 * rng.uniform(1.0, 1.4)
            angle = rng.uniform(0, 2 * np.pi)
            x, y = other.centroid.x + gap * np.cos(angle), other.centroid.y + gap * np.sin(angle)
        block = affinity.translate(block, x, y)
        if inner.contains(block) and not (shapely.distance(np.array(blocks, object), block) < clearance).any():
            blocks.append(block)
    return blocks


def _random_block(rng: np.random.Generator) -> shapely.Polygon:
    """Block around the origin, turned by any angle."""
    width, depth = rng.uniform(8, 32, 2)
    block = shapely.box(-width / 2, -depth / 2, width / 2, depth / 2)
    if rng.random() < 0.4:
        cut = rng.uniform(0.35, 0.65, 2) * (width, depth)
        block = block.difference(shapely.box(width / 2 - cut[0], depth / 2 - cut[1], width, depth))
    return affinity.rotate(block, rng.uniform(0, 360), origin=(0, 0))


def random_city(
    bounds: Bounds, n: int, *, seed: int, relief: float = 10.0
) -> tuple[CityModel, Dtm, NDArray[np.float64]]:
    """City of random blocks on hills: model, terrain, highest terrain at each building's walls."""
    dtm = hilly_dtm(bounds, relief=relief)
    blocks = random_blocks(bounds, n, seed=seed)
    shapes = np.empty(n, object)
    shapes[:] = blocks
    wall_ground = highest_wall_ground(shapes, dtm)
    roofs = wall_ground + np.random.default_rng(seed + 1).uniform(3, 40, n)
    return city_of(blocks, roofs.tolist()), dtm, wall_ground


def cloud_over(
    bounds: Bounds, buildings: list[tuple[shapely.Polygon, float]], *, ground: float = 0.0, spacing: float = 0.5
) -> PointCloud:
    """Points on a regular grid: class 6 at the roof height inside buildings, class 2 at the ground outside."""
    x, y = np.meshgrid(
        np.arange(bounds[0] + spacing / 2, bounds[2], spacing),
        np.arange(bounds[1] + spacing / 2, bounds[3], spacing),
    )
    x, y = x.ravel(), y.ravel()
    z = np.full(len(x), ground)
    classes = np.full(len(x), GROUND, np.uint8)
    for polygon, roof in buildings:
        inside = shapely.contains_xy(polygon, x, y)
        z[inside] = roof
        classes[inside] = BUILDING
    return PointCloud(np.column_stack((x, y, z)), classes)
