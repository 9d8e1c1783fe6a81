"""Time of single kernels, by pytest-benchmark: what a change of one of them gains or loses.

``python -m pytest -o addopts= tests/benchmarks`` measures; with ``--benchmark-autosave`` before a change and
``--benchmark-compare`` after it, the two are set side by side. Nothing is asserted about time.
"""

import zlib
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray
from pytest_benchmark.fixture import BenchmarkFixture

from pipeline.columns.adaptive import AdaptiveOptions, mesh_adaptive
from pipeline.columns.columns import expand_cells
from pipeline.columns.layered import LayeredOptions, mesh_layers
from pipeline.columns.spacing import SpacingLimits
from pipeline.data.citymodel import CityModel
from pipeline.data.mesh import PlaneMesh
from pipeline.geometry.inside import find_inside
from pipeline.plane_mesh.plane import mesh_plane
from pipeline.points_terrain.terrain import Dtm
from pipeline.quality.quality import measure_cells
from pipeline.smoothing.ground_smoothing import lift_places, smooth_slab
from tests.helpers.cities import Bounds, random_city
from tiler.mesh_files.vtk_xml import compress_block

BOUNDS: Bounds = (0.0, 0.0, 600.0, 600.0)
BUILDINGS, MESH_SIZE, HEIGHT, POINTS = 170, 5.0, 100.0, 1_000_000
ADAPTIVE = AdaptiveOptions(
    mesh_size=MESH_SIZE, domain_height=HEIGHT, limits=SpacingLimits(least=0.1, most=0.8), stagger=0.8, passes=1
)
LAYERED = LayeredOptions(
    mesh_size=MESH_SIZE,
    layer_height=MESH_SIZE,
    domain_height=HEIGHT,
    smoother="columns",
    tolerance=0.003,
    fem_tolerance=1e-8,
)


@dataclass(frozen=True, eq=False)
class Scene:
    """A town on hills and its plane mesh."""

    city: CityModel
    dtm: Dtm
    wall_ground: NDArray[np.float64]
    plane: PlaneMesh


@pytest.fixture(scope="module")
def scene() -> Scene:
    city, dtm, wall_ground = random_city(BOUNDS, BUILDINGS, seed=1, relief=20.0)
    return Scene(city, dtm, wall_ground, plane_of(city))


def plane_of(city: CityModel) -> PlaneMesh:
    return mesh_plane(BOUNDS, city.polygons, mesh_size=MESH_SIZE, min_angle=28, refinements=1, passes=4)[0]


def test_plane_mesh(benchmark: BenchmarkFixture, scene: Scene) -> None:
    plane = benchmark(plane_of, scene.city)
    assert len(plane.triangles) == len(scene.plane.triangles)


def test_adaptive_columns(benchmark: BenchmarkFixture, scene: Scene) -> None:
    city = scene.city
    mesh, _ = benchmark(mesh_adaptive, scene.plane, scene.dtm, city.roofs, city.ids, ADAPTIVE)
    benchmark.extra_info["cells"] = n_cells = len(expand_cells(mesh).cells)
    assert n_cells > len(scene.plane.triangles)


def test_layered_columns(benchmark: BenchmarkFixture, scene: Scene) -> None:
    mesh, _ = benchmark(mesh_layers, scene.plane, scene.dtm, scene.city, scene.wall_ground, BOUNDS, LAYERED)
    benchmark.extra_info["cells"] = n_cells = len(expand_cells(mesh).cells)
    assert n_cells > len(scene.plane.triangles)


@pytest.mark.parametrize("lifts", ["mesh", "places"])
def test_levels_over_terrain(benchmark: BenchmarkFixture, scene: Scene, lifts: str) -> None:
    way = smooth_slab if lifts == "mesh" else lift_places
    z = benchmark(way, scene.dtm, scene.plane.xy, BOUNDS, domain_height=HEIGHT, n_layers=20, grid_spacing=10.0)
    assert z.shape == (len(scene.plane.xy), 21)


def test_points_in_footprints(benchmark: BenchmarkFixture, scene: Scene) -> None:
    xy = np.random.default_rng(0).uniform(BOUNDS[:2], BOUNDS[2:], (POINTS, 2))
    _, point = benchmark(find_inside, xy, scene.city.polygons)
    assert 0 < len(point) < POINTS


def test_quality_of_cells(benchmark: BenchmarkFixture, scene: Scene) -> None:
    mesh, _ = mesh_layers(scene.plane, scene.dtm, scene.city, scene.wall_ground, BOUNDS, LAYERED)
    cells = expand_cells(mesh)
    assert len(benchmark(measure_cells, cells).radius_ratio) == len(cells.cells)


def test_compression_of_a_block(benchmark: BenchmarkFixture, scene: Scene) -> None:
    block = np.repeat(scene.plane.triangles, 20, axis=0)
    packed = benchmark(compress_block, block, np.dtype(np.int64))
    benchmark.extra_info["share"] = len(packed) / (8 * block.size)
    assert zlib.decompress(packed) == block.astype("<i8").tobytes()
