"""Sizes in the plane that grow away from walls: followed by triangles, alike on both sides of seams, local."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from numpy.typing import NDArray

from pipeline.columns.spacing import mean_edges
from pipeline.data.errors import ConfigError
from pipeline.data.mesh import Marker, PlaneMesh
from pipeline.plane_mesh.plane import mesh_plane
from pipeline.plane_mesh.sizes import SizeField, SizeRule, local_sizes, size_field, wall_distances
from pipeline.quality.quality import measure_cells
from stitch.tiling.corners import place_corner
from stitch.tiling.grid import Key, TileGrid, make_grid
from stitch.tiling.walls import cut_walls
from tests.helpers.cities import Bounds, city_of, crowded_blocks, hilly_dtm
from tests.helpers.stitching import (
    BOTH,
    Options,
    Scene,
    Tile,
    glue,
    mesh_all,
    mesh_alone,
    mesh_bytes,
    prove_glued,
    prove_seams,
    prove_tiles,
    scene_of,
    select_houses,
)
from tests.helpers.tiles import column_arrays, make_town, prove, run_of, write_town
from tiler.config.config import Config, idle_parameters, make_config
from tiler.pictures.picture_data import City
from tiler.pictures.picture_parts import plan_edges
from tiler.pictures.render import LEGEND, draw_sizes
from tiler.planning.footprint_sample import sample_footprints
from tiler.planning.forecast import forecast_run
from tiler.planning.plan import survey_inputs
from tiler.stages.mesh import mesh_stages

RULE = SizeRule(mesh_size=10.0, open_size=25.0, grading=0.2)
SIZE = 350.0  # m; side of a tile, 14 open sizes


def town_scene(bounds: Bounds, built: Bounds, n: int, *, seed: int, relief: float = 15.0) -> Scene:
    """Crowded blocks in one part of a region, open ground around."""
    roofs = np.random.default_rng(seed).uniform(5, 25, n)
    return scene_of(crowded_blocks(built, n, seed=seed), roofs.tolist(), hilly_dtm(bounds, relief=relief))


def field_of(scene: Scene, rule: SizeRule = RULE) -> SizeField:
    return size_field(cut_walls(scene.model.polygons, mesh_size=rule.mesh_size), rule)


def relative_edges(plane: PlaneMesh, field: SizeField) -> NDArray[np.float64]:
    """Mean edge at each vertex over the size there."""
    return mean_edges(plane) / local_sizes(field, plane.xy, mesh_size=field.rule.mesh_size)


def grid_of(bounds: Bounds) -> TileGrid:
    return make_grid(bounds, tile_size=SIZE, mesh_size=RULE.mesh_size, open_size=RULE.open_size)


@pytest.fixture(scope="module")
def nine() -> tuple[Scene, dict[Key, Tile]]:
    """Nine tiles, with houses on both sides of the seams in the middle."""
    bounds = (0.0, 0.0, 3 * SIZE, 3 * SIZE)
    scene = town_scene(bounds, (250.0, 300.0, 780.0, 760.0), 120, seed=4)
    return scene, mesh_all(scene, grid_of(bounds), rule=RULE)


def test_sizes_grow_from_walls_to_the_largest() -> None:
    field = size_field(np.array([[[0.0, 0.0], [0.0, 10.0]]]), RULE)
    places = np.array([[0.0, 5.0], [5.0, 5.0], [3.0, 14.0], [75.0, 5.0], [400.0, 5.0]])
    assert local_sizes(field, places, mesh_size=10.0).tolist() == [10, 11, 11, 25, 25]
    assert local_sizes(None, places, mesh_size=10.0).tolist() == [10] * 5
    assert RULE.reach == 75
    empty = size_field(np.empty((0, 2, 2)), RULE)
    assert local_sizes(empty, places, mesh_size=10.0).tolist() == [25] * 5


@pytest.mark.parametrize("grading", [0.1, 0.2, 0.4])
def test_triangles_have_the_sizes_near_and_far_from_walls(grading: float) -> None:
    rule = SizeRule(10.0, 40.0, grading)
    house = city_of([shapely.box(480, 480, 520, 520)], [0.0]).polygons
    field = size_field(cut_walls(house, mesh_size=10.0), rule)
    plane, complete = mesh_plane(
        (0.0, 0.0, 1000.0, 1000.0), house, mesh_size=10.0, min_angle=28, refinements=1, passes=4, sizes=field
    )
    assert complete
    relative, distance = relative_edges(plane, field), wall_distances(field, plane.xy)
    # Triangles of at most h^2/2 have edges of 0.86 h in the mean, graded or not.
    for low, high in ((0, 30), (30, 60), (60, rule.reach - 1), (rule.reach - 1, np.inf)):
        there = relative[(distance >= low) & (distance < high)]
        if len(there) > 20:
            assert 0.75 < there.mean() < 0.95
    assert relative.max() < 1.4
    assert relative[distance > 0].min() > 0.4


def test_no_seam_is_visible_in_the_sizes(nine: tuple[Scene, dict[Key, Tile]]) -> None:
    scene, tiles = nine
    field = field_of(scene)
    near, away = [], []
    for tile in tiles.values():
        plane = tile.mesh.plane
        lines = shapely.union_all([shapely.LineString(seam.xy) for seam in tile.seams.values() if not seam.border])
        size = local_sizes(field, plane.xy, mesh_size=10.0)
        steps = shapely.distance(lines, shapely.points(plane.xy)) / size
        far = wall_distances(field, plane.xy)
        for low, high in ((15, 45), (45, 74), (74, 76)):
            there = (far >= low) & (far < high) & (plane.xy > 30).all(axis=1) & (plane.xy < 1020).all(axis=1)
            relative = mean_edges(plane) / size
            near.append(relative[there & (steps < 1.5) & (steps > 0)])
            away.append(relative[there & (steps > 3)])
    for k in range(3):
        beside, elsewhere = np.concatenate(near[k::3]), np.concatenate(away[k::3])
        assert min(len(beside), len(elsewhere)) > 20
        assert 0.9 < beside.mean() / elsewhere.mean() < 1.1


def test_nine_tiles_are_one_mesh_of_fewer_cells_as_good_in_the_same_places(
    nine: tuple[Scene, dict[Key, Tile]],
) -> None:
    scene, tiles = nine
    bounds = (0.0, 0.0, 3 * SIZE, 3 * SIZE)
    assert prove_seams(tiles) == 12
    graded = glue([tile.mesh for tile in tiles.values()])
    prove_glued(graded, scene, bounds)
    even = glue([tile.mesh for tile in mesh_all(scene, grid_of(bounds)).values()])
    assert len(graded.cells) < 0.3 * len(even.cells)
    field = field_of(scene)
    ratios = []
    for mesh in (graded, even):
        far = wall_distances(field, mesh.points[mesh.cells][:, :, :2].mean(axis=1))
        ratio = measure_cells(mesh).radius_ratio
        ratios.append([np.percentile(ratio[where], (1, 5, 50)) for where in (far < 15, far >= 15)])
    # The share of cells at walls is larger, and these are the poor ones: so like is compared with like.
    assert (np.array(ratios[0]) > 0.95 * np.array(ratios[1])).all()


@pytest.mark.parametrize("options", BOTH.values(), ids=BOTH)
@pytest.mark.parametrize("seed", [0, 1])
def test_four_tiles_are_one_mesh(options: Options, seed: int) -> None:
    bounds = (0.0, 0.0, 2 * SIZE, 2 * SIZE)
    # The first stands on corner and seams, the second in a corner of the region.
    built = ((220.0, 250.0, 520.0, 500.0), (0.0, 0.0, 250.0, 200.0))[seed]
    scene = town_scene(bounds, built, 30, seed=seed, relief=15.0 * (1 - seed))
    prove_tiles(scene, grid_of(bounds), options, level=seed > 0, rule=RULE)


def test_a_tile_is_the_same_alone_and_in_a_larger_region() -> None:
    bounds, inner = (0.0, 0.0, 5 * SIZE, 5 * SIZE), (SIZE, SIZE, 4 * SIZE, 4 * SIZE)
    scene = town_scene(bounds, (600.0, 900.0, 1500.0, 1350.0), 60, seed=3)
    within = select_houses(scene, np.flatnonzero(shapely.within(scene.model.polygons, shapely.box(*inner))))
    assert len(within.model) < len(scene.model)
    alone = mesh_alone(scene, grid_of(bounds), Key(2, 2), rule=RULE)
    assert mesh_bytes(mesh_alone(scene, grid_of(bounds), Key(2, 2), clip=False, rule=RULE).mesh) == mesh_bytes(
        alone.mesh
    )
    small = mesh_alone(within, grid_of(inner), Key(2, 2), rule=RULE).mesh
    assert replace(small.plane, building=alone.mesh.plane.building).xy.tobytes() == alone.mesh.plane.xy.tobytes()
    assert small.z.tobytes() == alone.mesh.z.tobytes()
    assert small.bottom.tobytes() == alone.mesh.bottom.tobytes()


def test_first_edges_of_seams_have_the_local_size() -> None:
    grid = grid_of((0.0, 0.0, 2 * SIZE, 2 * SIZE))
    house = np.array([shapely.box(SIZE + 60, SIZE - 10, SIZE + 80, SIZE + 10)])
    walls = cut_walls(house, mesh_size=10.0)
    corner = place_corner(grid, Key(1, 1), house, walls, mesh_size=10.0, sizes=size_field(walls, RULE))
    distance = float(shapely.distance(house[0], shapely.Point(corner.xy)))
    assert distance >= 60
    np.testing.assert_allclose(corner.tips[0] - corner.xy, [0.8 * min(10 + 0.2 * distance, 25), 0])


# Runs.


def open_town(folder: Path) -> dict[str, Any]:
    """Four tiles, built where they meet."""
    west, south = 40 * SIZE, 50 * SIZE
    region = (west, south, west + 2 * SIZE, south + 2 * SIZE)
    blocks = crowded_blocks((west + 280, south + 260, west + 470, south + 440), 16, seed=2)
    values = write_town(folder, make_town(region, blocks, relief=8), spacing=2.0)
    return values | {"tile_size": SIZE, "bounds": region, "open_size": 25.0, "dtm_spacing": 2.0}


TownRun = tuple[dict[str, Any], Path, dict[str, Any]]  # parameters, folder and record


@pytest.fixture(scope="module")
def town_runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, TownRun]:
    """The open town meshed by either mesher."""
    folder, found = tmp_path_factory.mktemp("town"), {}
    city = open_town(folder / "city")
    for mesher in ("adaptive", "layered"):
        values = city | {"mesher": mesher, "domain_height": 60.0}
        found[mesher] = values, folder / mesher, run_of(values, folder / mesher)
    return found


@pytest.mark.parametrize("mesher", ["adaptive", "layered"])
def test_a_graded_run_is_proved(town_runs: dict[str, TownRun], mesher: str) -> None:
    prove(town_runs[mesher][1])


def test_a_tile_of_a_graded_run_is_the_same_in_a_smaller_region(tmp_path: Path) -> None:
    region = (0.0, 0.0, 5 * SIZE, 3 * SIZE)
    blocks = crowded_blocks((60.0, 350.0, 1200.0, 650.0), 60, seed=7)
    values = write_town(tmp_path / "city", make_town(region, blocks, relief=8), spacing=4.0)
    values |= {"tile_size": SIZE, "open_size": 25.0, "dtm_spacing": 4.0, "domain_height": 50.0}
    narrow = (SIZE, 0.0, 4 * SIZE, 3 * SIZE)
    found = [
        column_arrays(values | {"bounds": box}, tmp_path / str(k), "2_1") for k, box in enumerate((region, narrow))
    ]
    assert all(found[0][0][name].tobytes() == array.tobytes() for name, array in found[1][0].items())


def test_tiles_that_are_too_small_for_the_open_size_are_refused(tmp_path: Path) -> None:
    values = open_town(tmp_path / "city") | {"tile_size": 349.0}
    with pytest.raises(
        ConfigError, match=r"349 m is below 14 open sizes of 25 m; give --tile-size 350 .*--open-size"
    ):
        survey_inputs(make_config(values), lambda _: None)


def test_the_plan_counts_the_cells_of_graded_sizes(town_runs: dict[str, TownRun]) -> None:
    for values, _, record in town_runs.values():
        config = make_config(values)
        survey = survey_inputs(config, lambda _: None)
        cells = forecast_run(survey, sample_footprints(config, survey.region), config).loads.cells.sum()
        assert 0.7 < cells / record["counts"]["cells"] < 1.4
        even = replace(config, open_size=0.0)
        assert cells < 0.4 * forecast_run(survey, sample_footprints(even, survey.region), even).loads.cells.sum()


def test_the_picture_shows_edges_from_above_by_length_and_tile(tmp_path: Path) -> None:
    """A western tile of short edges, an eastern one of long ones, and a wall between them."""
    side = 8
    x, y = np.meshgrid(np.arange(side + 1.0), np.arange(side + 1.0))
    xy = np.column_stack((x.ravel(), y.ravel()))
    corner = np.array([k for k in range(side * (side + 1)) if k % (side + 1) < side])
    west = np.concatenate([corner[:, None] + [0, 1, side + 2], corner[:, None] + [0, side + 2, side + 1]])
    n = len(xy)
    points = np.concatenate([xy, [[8.0, 0.0], [16.0, 0.0], [16.0, 8.0], [8.0, 8.0]]])
    facets = np.concatenate([west, [[n, n + 1, n + 2], [n, n + 2, n + 3], [n, n + 3, n + 3]]])
    marker = np.full(len(facets), Marker.GROUND)
    marker[-1] = Marker.WALL
    piece = np.repeat([0, 1], [len(west), 3])
    height = np.zeros((len(points), 1))
    city = City(np.hstack((points, height)), facets, marker, piece * 0 - 1, piece, ("4_7", "5_7"), np.zeros(3))
    np.testing.assert_allclose(plan_edges(city)[[0, -2]], np.array([1, 8]) * (2 + np.sqrt(2)) / 3)
    assert LEGEND == 0.1
    image = draw_sizes(city, (320, 178)).astype(int)
    assert image.shape == (178, 320, 3)
    # Odd and even column and row: the warm ramp's dark end, then the cool one's light end; the wall is black.
    west_colour, east_colour = (
        np.median(image[:150, 5:150], axis=(0, 1)),
        np.median(image[:150, 170:310], axis=(0, 1)),
    )
    assert west_colour[0] > west_colour[2]
    assert west_colour.max() < 120
    assert east_colour[2] > east_colour[0] > 200
    assert image[20:140, 159:161].max(axis=2).min(axis=1).max() < 60


def test_only_a_graded_mesh_depends_on_the_grading() -> None:
    plain, graded = mesh_stages(Config()), mesh_stages(make_config({"open_size": 20.0}))
    assert all({"open_size", "grading"}.isdisjoint(stage.parameters) for stage in plain)
    assert all({"open_size", "grading"} <= set(stage.parameters) for stage in graded)
    halos = [{read.stage: read.halo for read in stages[0].reads} for stages in (plain, graded)]
    # Walls count (20 - 10) / 0.2 m beyond the places whose sizes are asked for.
    assert halos[1]["model"] >= halos[0]["model"] + 50
    assert idle_parameters(make_config({"grading": 0.3})) == [
        "grading = 0.3 has no effect: it counts with open_size above 0"
    ]
