"""Vertical spacing that grows from the ground, and flat tops, in both meshers."""

import dataclasses

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from pipeline.city_model.heights import highest_wall_ground, raise_low_roofs
from pipeline.columns.adaptive import mesh_adaptive
from pipeline.columns.columns import lowest_gap
from pipeline.columns.growth import Growth, count_steps, full_height, height_of_steps, layer_levels, movable_height
from pipeline.columns.layered import count_layers, mesh_layers
from pipeline.columns.levels import fill_levels
from pipeline.columns.nodes import no_seam, place_nodes, take_columns
from pipeline.columns.spacing import mean_edges, vertical_spacing
from pipeline.columns.trim_layers import count_removed_layers
from pipeline.data.citymodel import CityModel
from pipeline.data.mesh import ColumnMesh, PlaneMesh
from pipeline.data.roofs import flat_roofs
from pipeline.plane_mesh.plane import mesh_plane
from pipeline.points_terrain.terrain import Dtm, sample_dtm
from stitch.tiling.grid import make_grid, tile_keys
from tests.helpers.cities import city_of, crowded_blocks, hilly_dtm
from tests.helpers.stitching import LAYERED, OPTIONS, mesh_all, prove_seams, random_scene
from tests.helpers.terraces import prove_conforming

BOUNDS = (0.0, 0.0, 200.0, 200.0)
GROWTH = Growth(0.5, 1.2)
FAR = 15.0  # m; farther from walls, these no longer bend layers
heights = st.floats(0.0, 300.0)
growths = st.builds(Growth, st.floats(0.05, 5.0), st.floats(1.0, 2.0))
spacings = st.floats(0.5, 12.0)


@settings(deadline=None)  # the first call compiles
@given(heights, spacings, growths)
def test_steps_and_heights_are_each_others_inverse(height: float, spacing: float, growth: Growth) -> None:
    law = (spacing, growth.first, growth.ratio)
    assert height_of_steps(count_steps(height, *law), *law) == pytest.approx(height, rel=1e-9, abs=1e-9)


@settings(deadline=None)  # the first call compiles
@given(st.integers(0, 40), spacings, growths)
def test_a_step_is_that_of_its_height(number: int, spacing: float, growth: Growth) -> None:
    """From the height h upwards it is min(s, M + (G - 1) h)."""
    law = (spacing, growth.first, growth.ratio)
    low, high = height_of_steps(number, *law), height_of_steps(number + 1, *law)
    assert high - low == pytest.approx(min(spacing, growth.first + (growth.ratio - 1) * low), rel=1e-9)


def test_full_height_is_where_steps_are_full() -> None:
    spacing = np.array([8.0, 0.5, 4.0])
    height = full_height(spacing, Growth(1.0, 1.25))
    assert height.tolist() == [28.0, 0.0, 12.0]
    assert np.isinf(full_height(8.0, Growth(1.0, 1.0)))
    assert full_height(8.0, Growth(8.0, 1.0)) == 0
    assert movable_height(spacing, Growth(1.0, 1.25)).tolist() == [12.0, 0.0, 4.0]


@pytest.mark.parametrize(("first", "ratio"), [(0.0, 1.2), (-1.0, 1.2), (1.0, 0.9), (np.nan, 1.2), (1.0, np.inf)])
def test_growth_that_is_none_is_refused(first: float, ratio: float) -> None:
    with pytest.raises(ValueError, match="expected above 0, and 1 or more"):
        Growth(first, ratio)


def test_layers_by_hand() -> None:
    assert layer_levels(15.0, 4.0, Growth(1.0, 2.0)).tolist() == [0.0, 1.0, 3.0, 7.0, 11.0, 15.0]
    assert layer_levels(6.0, 2.0, Growth(2.0, 1.5)).tolist() == [0.0, 2.0, 4.0, 6.0]
    assert layer_levels(1.0, 2.0, Growth(2.0, 1.5)).tolist() == [0.0, 0.5, 1.0]


def test_levels_by_hand() -> None:
    """A wall from 1 m to a roof at 8 m, below a top at 16 m: steps of 1, 2, 4 and then 4 m above the ground."""
    angle = 2 * np.pi * np.arange(2) / 2
    xy = np.concatenate(([[-9.0, 0.0]], np.column_stack((np.cos(angle), np.sin(angle) + angle))))
    plane = PlaneMesh(xy, np.array([[0, 1, 2], [0, 1, 2]], np.int32), np.array([-1, 0], np.int32))
    ground, spacing = np.ones(3), np.full(3, 4.0)
    roofs = flat_roofs(np.array([8.0]))
    nodes, _ = place_nodes(plane, roofs, ground, no_seam(), spacing=spacing, least_gap=np.full(3, 0.5))
    shift = np.array([0.25, 0.0, 0.0])
    levels, _ = fill_levels(
        nodes, np.full(3, 16.0), spacing, shift, no_seam(), ground=ground, growth=Growth(1.0, 2.0)
    )
    shifted, plain = (take_columns(levels, np.array([k], np.int32)).z for k in (0, 1))
    assert plain.tolist() == [1.0, 2.0, 4.0, 8.0, 12.0, 16.0]
    # The first layer stays; the second level moves by a part of its shift, those with full steps by all of it.
    assert shifted[[0, 1, 3, 4, 5]].tolist() == [1.0, 2.0, 8.0, 13.0, 16.0]
    assert 4.0 < shifted[2] < 5.0


def town_on(dtm: Dtm, *, seed: int = 3) -> CityModel:
    city = city_of(crowded_blocks(BOUNDS, 16, seed=seed), [0.0] * 16)
    wall_ground = highest_wall_ground(city.polygons, dtm)
    roof = wall_ground + np.random.default_rng(seed).uniform(4, 30, 16)
    return dataclasses.replace(city, roofs=flat_roofs(raise_low_roofs(roof, wall_ground, clearance=2.0)[0]))


def first_layers(mesh: ColumnMesh, city: CityModel, *, beyond: float) -> NDArray[np.float64]:
    """Heights of the first layer (m) in columns over open ground farther from walls than that."""
    free = shapely.distance(shapely.union_all(city.polygons), shapely.points(mesh.plane.xy)) > beyond
    assert free.sum() > 20
    height: NDArray[np.float64] = (mesh.z[mesh.z_start[:-1] + 1] - mesh.z[mesh.z_start[:-1]])[free]
    return height


@pytest.mark.parametrize("growth", [GROWTH, Growth(1.0, 1.3), Growth(2.0, 1.0)])
def test_adaptive_columns_begin_with_the_first_layer_and_grow(growth: Growth) -> None:
    dtm = hilly_dtm(BOUNDS, relief=25.0, noise=0.3)
    city = town_on(dtm)
    plane, _ = mesh_plane(BOUNDS, city.polygons, mesh_size=10.0, min_angle=28, refinements=1, passes=4)
    options = dataclasses.replace(OPTIONS, growth=growth, passes=3)
    mesh, report = mesh_adaptive(plane, dtm, city.roofs, city.ids, options)
    prove_conforming(mesh, city.numbers)
    first = first_layers(mesh, city, beyond=1e-6)
    assert np.abs(first / growth.first - 1).max() < 0.1
    ground = sample_dtm(dtm, plane.xy)
    spacing = vertical_spacing(mean_edges(plane), 10.0, options.limits)
    most = 0.0
    for i in np.flatnonzero(mesh.z[mesh.z_start[:-1]] == ground):
        z = mesh.z[mesh.z_start[i] : mesh.z_start[i + 1]] - ground[i]
        wanted = np.minimum(spacing[i], growth.first + (growth.ratio - 1) * z[:-1])
        most = max(most, float((np.diff(z) / wanted).max()))
    assert 1 < most < 2  # steps between two nodes are a whole number, shifts are less than a third
    still, _ = mesh_adaptive(plane, dtm, city.roofs, city.ids, dataclasses.replace(options, passes=0))
    height = mesh.z - np.repeat(ground, np.diff(mesh.z_start))
    low = height < np.repeat(movable_height(spacing, growth), np.diff(mesh.z_start))
    assert mesh.z[low].tobytes() == still.z[low].tobytes()
    if growth.ratio > 1:
        assert report.improved_levels > 0
        assert mesh.z.tobytes() != still.z.tobytes()


@pytest.mark.parametrize("top", [None, 90.0])
def test_layers_begin_with_the_first_one_and_grow(top: float | None) -> None:
    dtm = hilly_dtm(BOUNDS, relief=20.0)
    city = town_on(dtm)
    plane, _ = mesh_plane(BOUNDS, city.polygons, mesh_size=10.0)
    options = dataclasses.replace(LAYERED, layer_height=8.0, growth=GROWTH, top=top)
    wall_ground = highest_wall_ground(city.polygons, dtm)
    mesh, report = mesh_layers(plane, dtm, city, wall_ground, BOUNDS, options)
    prove_conforming(mesh, city.numbers)
    assert lowest_gap(mesh)[0] > 0.2
    assert report.n_layers == count_layers(options) == 18
    first = first_layers(mesh, city, beyond=FAR)
    assert np.abs(first / GROWTH.first - 1).max() < 0.1
    ends = mesh.z[mesh.z_start[1:] - 1]
    if top is None:
        assert np.ptp(ends) > 1
    else:
        assert (ends == top).all()


def test_flat_tops_are_bit_for_bit_flat_and_columns_reach_them() -> None:
    dtm = hilly_dtm(BOUNDS, relief=25.0)
    city = town_on(dtm)
    plane, _ = mesh_plane(BOUNDS, city.polygons, mesh_size=10.0, min_angle=28, refinements=1, passes=4)
    top = float(dtm.z.max()) + 60.0
    adaptive, _ = mesh_adaptive(
        plane, dtm, city.roofs, city.ids, dataclasses.replace(OPTIONS, top=top, domain_height=60.0)
    )
    wall_ground = highest_wall_ground(city.polygons, dtm)
    layered, _ = mesh_layers(plane, dtm, city, wall_ground, BOUNDS, dataclasses.replace(LAYERED, top=top))
    for mesh in (adaptive, layered):
        assert (mesh.z[mesh.z_start[1:] - 1] == top).all()
        prove_conforming(mesh, city.numbers)


@pytest.mark.parametrize("mesher", ["adaptive", "layered"])
def test_seams_share_columns_that_grow_below_a_flat_top(mesher: str) -> None:
    bounds = (0.0, 0.0, 280.0, 280.0)
    grid = make_grid(bounds, tile_size=140.0, mesh_size=10.0)
    scene = random_scene(bounds, 20, seed=8, relief=12.0)
    top = float(scene.dtm.z.max()) + 60.0
    options = dataclasses.replace(OPTIONS if mesher == "adaptive" else LAYERED, growth=GROWTH, top=top)
    tiles = mesh_all(scene, grid, options)
    assert list(tiles) == list(tile_keys(grid))
    assert prove_seams(tiles) == 4
    beyond = 1e-6 if mesher == "adaptive" else FAR
    for tile in tiles.values():
        first = first_layers(tile.mesh, scene.model, beyond=beyond)
        assert np.abs(first / GROWTH.first - 1).max() < 0.1
        assert lowest_gap(tile.mesh)[1] == 0
        assert (tile.mesh.z[tile.mesh.z_start[1:] - 1] == top).all()


def test_roofs_take_as_many_thin_layers_as_are_not_squeezed() -> None:
    """0.4 of the levels below a roof must fit between the highest ground at a wall and the roof."""
    flat = np.array([0.0, 1.0, 3.0, 7.0, 15.0])
    for ground, layers in ((1.9, 2), (2.1, 1), (-9.0, 2)):
        removed = count_removed_layers(
            flat[None],
            np.zeros(1, np.int64),
            np.array([3.2]),
            np.array([ground]),
            np.zeros(1, np.int32),
            layer_height=3.75,
            flat_levels=flat,
        )
        assert removed.tolist() == [layers]
