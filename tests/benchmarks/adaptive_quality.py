"""Quality and speed of the adaptive mesher on synthetic cities: ``python -m tests.benchmarks.adaptive_quality``.

A line is: relief, mesh size, seed, cells, radius ratio at 0, 0.1, 1, 5 and 50 %, least dihedral angle, cells a
second from footprints to columns on one core.
"""

import time

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.city_model.heights import highest_wall_ground, raise_low_roofs
from pipeline.columns.adaptive import AdaptiveOptions, mesh_adaptive
from pipeline.columns.columns import expand_cells
from pipeline.columns.spacing import SpacingLimits
from pipeline.data.roofs import flat_roofs
from pipeline.plane_mesh.plane import mesh_plane
from pipeline.points_terrain.terrain import Dtm, sample_dtm
from pipeline.quality.quality import measure_cells
from tests.helpers.cities import city_of, crowded_blocks

SIZE, BUILDINGS = 1000.0, 500  # m, number
PERCENTILES = (0, 0.1, 1, 5, 50)
RUNS = (
    *((20.0, 10.0, seed) for seed in range(1, 7)),
    *((20.0, 5.0, seed) for seed in (1, 2)),
    *((relief, 10.0, 1) for relief in (38.0, 76.0, 152.0)),
)


def rolling_terrain(size: float, relief: float) -> Dtm:
    """Terrain of wave lengths from 40 to 730 m with a total height of about `relief` (m)."""
    x, y = np.arange(size + 1)[None, :], np.arange(size + 1)[:, None]
    turn = 2 * np.pi
    waves = 0.55 * np.sin(turn * x / 731 + 0.3) * np.cos(turn * y / 613 + 1.1)
    waves = waves + 0.30 * np.sin(turn * (0.8 * x + 0.6 * y) / 317 + 2)
    waves = waves + 0.12 * np.sin(turn * (0.3 * x - 0.95 * y) / 97 + 0.7)
    waves = waves + 0.05 * np.sin(turn * (x + 0.4 * y) / 41)
    return Dtm(relief / 2 * (waves + 1), 0, 0, 1.0)


def roofs_on(polygons: NDArray[np.object_], dtm: Dtm, seed: int) -> NDArray[np.float64]:
    """Roofs of 5 to 40 m over the terrain, and 2 m above the highest of it at their walls."""
    centres = shapely.get_coordinates(shapely.centroid(polygons))
    rng = np.random.default_rng(seed + 100)
    height = np.clip(rng.uniform(5, 40, len(polygons)) * rng.uniform(0.4, 1, len(polygons)), 5, 40)
    wall_ground = highest_wall_ground(polygons, dtm)
    return raise_low_roofs(sample_dtm(dtm, centres) + height, wall_ground, clearance=2.0)[0]


def run(relief: float, mesh_size: float, seed: int, *, size: float = SIZE, buildings: int = BUILDINGS) -> str:
    """Mesh one city and measure it."""
    bounds = (0.0, 0.0, size, size)
    dtm = rolling_terrain(size, relief)
    city = city_of(crowded_blocks(bounds, buildings, seed=seed), [0.0] * buildings)
    roof = roofs_on(city.polygons, dtm, seed)
    options = AdaptiveOptions(
        mesh_size=mesh_size,
        domain_height=200.0 if relief > 100 else 100.0,
        limits=SpacingLimits(least=0.1, most=0.8),
        stagger=0.8,
        passes=1,
    )
    begin = time.perf_counter()
    plane, _ = mesh_plane(bounds, city.polygons, mesh_size=mesh_size, min_angle=28, refinements=1, passes=4)
    mesh, _ = mesh_adaptive(plane, dtm, flat_roofs(roof), city.ids, options)
    seconds = time.perf_counter() - begin
    quality = measure_cells(expand_cells(mesh))
    n = len(quality.radius_ratio)
    ratios = " / ".join(f"{value:.3f}" for value in np.percentile(quality.radius_ratio, PERCENTILES))
    angle = quality.min_dihedral.min()
    return (
        f"{relief:5.0f} m {mesh_size:4.0f} m {seed:3d} {n / 1e6:7.3f} M   {ratios}   {angle:4.1f}°"
        f" {n / seconds / 1e6:5.2f} M/s"
    )


if __name__ == "__main__":
    run(20.0, 10.0, 1, size=200.0, buildings=20)  # compiles
    for case in RUNS:
        print(run(*case), flush=True)
