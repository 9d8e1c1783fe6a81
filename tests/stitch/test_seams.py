"""Seams: tiles meshed alone are one mesh when glued, and depend on their halo alone."""

from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
import shapely
from numpy.typing import NDArray
from shapely import affinity

from pipeline.city_model.heights import highest_wall_ground
from pipeline.columns.adaptive import mesh_adaptive
from pipeline.columns.columns import expand_cells
from pipeline.columns.layered import LayeredOptions, mesh_layers
from pipeline.data.errors import GeometryError
from pipeline.data.roofs import flat_roofs
from pipeline.plane_mesh.plane import mesh_plane
from pipeline.quality.quality import measure_cells
from stitch.seams.seams import find_vertices, trace_seam
from stitch.seams.tiles import areas_within
from stitch.tiling import paths
from stitch.tiling.corners import place_corner
from stitch.tiling.grid import Key, SeamKey, has_tile, is_border, make_grid, seam_keys, tile_keys
from stitch.tiling.strips import CORRIDOR, Strip, improve_around, mesh_strip
from stitch.tiling.walls import cut_walls, split_walls
from tests.helpers.campaigns import rounds
from tests.helpers.cities import Bounds, crowded_blocks, hilly_dtm, tilted_dtm
from tests.helpers.stitching import (
    BOTH,
    LAYERED,
    NINE,
    OPTIONS,
    SQUARE,
    Options,
    Scene,
    amsterdam_scene,
    glue,
    mesh_all,
    mesh_alone,
    mesh_bytes,
    prove_tiles,
    random_scene,
    same_houses,
    scene_of,
    select_houses,
)
from tests.helpers.terraces import terrace_town

# A domain so low that tiles in the middle of a small region are out of reach of its border.
LOW = replace(LAYERED, domain_height=30.0)
RANDOM: list[tuple[Options, int, int, float]] = [
    *((OPTIONS, 40 + 20 * seed, seed, 20.0 * (seed % 3)) for seed in rounds([0, 7], [1, 2, 3, 4, 5, 6])),
    (LAYERED, 135, 3, 0.0),
]


def test_open_ground_is_cut_straight_and_glued() -> None:
    grid = make_grid(SQUARE, tile_size=210.0, mesh_size=10.0)
    prove_tiles(scene_of([], [], tilted_dtm(SQUARE, height=5.0)), grid, level=True)


@pytest.mark.parametrize(("options", "n", "seed", "relief"), RANDOM)
def test_random_cities_are_one_mesh(options: Options, n: int, seed: int, relief: float) -> None:
    prove_tiles(random_scene(SQUARE, n, seed=seed, relief=relief), NINE, options, level=not relief)


@pytest.mark.parametrize(
    ("options", "side", "margin", "n", "keys"),
    [(OPTIONS, 560.0, 70.0, 220, [Key(1, 1), Key(2, 2)]), (LOW, 700.0, 140.0, 300, [Key(2, 2)])],
    ids=BOTH,
)
def test_a_tile_is_the_same_alone_and_in_a_larger_region(
    options: Options, side: float, margin: float, n: int, keys: list[Key]
) -> None:
    """The small region's outer tiles may be half as wide; those within touch its border nowhere."""
    bounds, inner = (0.0, 0.0, side, side), (margin, margin, side - margin, side - margin)
    scene = random_scene(bounds, n, seed=3, relief=15.0)
    if options is LOW:
        scene = replace(scene, model=replace(scene.model, roofs=flat_roofs(np.minimum(scene.model.roof, 14.0))))
    crossing = shapely.intersects(scene.model.polygons, shapely.box(*inner).exterior)
    scene = select_houses(scene, np.flatnonzero(~crossing))
    within = np.flatnonzero(shapely.within(scene.model.polygons, shapely.box(*inner)))
    assert len(within) < len(scene.model)
    large, small = (make_grid(box, tile_size=140.0, mesh_size=10.0) for box in (bounds, inner))
    for tile in keys:
        alone = mesh_bytes(mesh_alone(scene, large, tile, options).mesh)
        assert mesh_bytes(mesh_alone(scene, large, tile, options, clip=False).mesh) == alone
        assert same_houses(mesh_alone(select_houses(scene, within), small, tile, options).mesh, within) == alone


@pytest.mark.parametrize("options", BOTH.values(), ids=BOTH)
def test_a_tile_does_not_depend_on_the_order_of_houses(options: Options) -> None:
    scene = random_scene(SQUARE, 110, seed=5, relief=10.0)
    order = np.random.default_rng(0).permutation(len(scene.model))
    one, two = (mesh_alone(city, NINE, Key(1, 1), options).mesh for city in (scene, select_houses(scene, order)))
    assert same_houses(two, order) == mesh_bytes(one)


COURT = shapely.box(60, 60, 360, 360).difference(shapely.box(75, 75, 345, 345))
CITIES = {
    "a hall larger than a tile": [affinity.rotate(shapely.box(100, 90, 330, 320), 12.0)],
    "a courtyard around a tile": [COURT, shapely.box(130, 130, 150, 150), shapely.box(270, 270, 290, 300)],
    "towers on the corners": [shapely.Point(140 * i, 140 * j).buffer(9) for i in (1, 2) for j in (1, 2)],
    "a tower beside the border": [shapely.Point(140, 16).buffer(10)],
    "walls along the lines": [shapely.box(3, 138, 417, 142), shapely.box(3, 278, 417, 281)],
    "rows across all seams": [shapely.box(3, 110 + 6 * k, 417, 112 + 6 * k) for k in range(10)],
}
ON_SEAMS: list[tuple[Options, str]] = [(OPTIONS, name) for name in CITIES]
ON_SEAMS += [(LAYERED, "a courtyard around a tile"), (LAYERED, "towers on the corners")]


@pytest.mark.parametrize(("options", "name"), ON_SEAMS)
def test_houses_on_seams_and_corners(options: Options, name: str) -> None:
    roofs = [8.0 + 3 * k for k in range(len(CITIES[name]))]
    prove_tiles(scene_of(CITIES[name], roofs, tilted_dtm(SQUARE, height=2.0)), NINE, options, level=True)


@pytest.mark.parametrize(
    ("options", "bounds"),
    [
        (OPTIONS, (70.0, 70.0, 490.0, 350.0)),
        (OPTIONS, (0.0, 0.0, 600.0, 30.0)),
        (OPTIONS, (-300.0, -600.0, -180.0, -300.0)),
        (LAYERED, (70.0, 70.0, 420.0, 210.0)),
        (LAYERED, (0.0, 0.0, 600.0, 30.0)),
    ],
)
def test_narrow_outer_tiles_single_rows_and_negative_coordinates(options: Options, bounds: Bounds) -> None:
    area = (bounds[2] - bounds[0]) * (bounds[3] - bounds[1])
    grid = make_grid(bounds, tile_size=140.0, mesh_size=10.0)
    tiles = prove_tiles(random_scene(bounds, int(area * 5e-4), seed=1, relief=10.0), grid, options)
    assert len(tiles) > 1


@pytest.mark.parametrize(
    ("options", "relief"),
    [(OPTIONS, 0.0), (replace(LAYERED, layer_height=2.5), 1.0), (replace(LAYERED, layer_height=6.0), 1.0)],
)
def test_terraces_keep_their_party_walls_across_seams(options: Options, relief: float) -> None:
    town = terrace_town()
    grid = make_grid(town.bounds, tile_size=49.0, mesh_size=3.5)
    scene = Scene(town.model, town.group, hilly_dtm(town.bounds, relief=relief, length=20.0))
    tiles = prove_tiles(scene, grid, replace(options, mesh_size=3.5), level=not relief)
    assert len(tiles) == 4
    assert any(len(seam.wall_nodes) for tile in tiles.values() for seam in tile.seams.values())


@pytest.mark.parametrize(
    ("options", "side", "n", "bounds_of_ratio"),
    [(OPTIONS, 600.0, 270, (0.5, 0.93, 0.97, 1.03)), (LAYERED, 420.0, 130, (0.5, 0.85, 0.95, 1.04))],
    ids=BOTH,
)
def test_seams_cost_little_quality(
    options: Options, side: float, n: int, bounds_of_ratio: tuple[float, ...]
) -> None:
    bounds = (0.0, 0.0, side, side)
    scene = random_scene(bounds, n, seed=8, relief=20.0)
    grid = make_grid(bounds, tile_size=side / 3, mesh_size=10.0)
    tiled = measure_cells(glue([tile.mesh for tile in mesh_all(scene, grid, options).values()])).radius_ratio
    model = scene.model
    plane, _ = mesh_plane(bounds, model.polygons, mesh_size=10.0, min_angle=28, refinements=1, passes=4)
    if isinstance(options, LayeredOptions):
        wall_ground = highest_wall_ground(model.polygons, scene.dtm)
        whole = mesh_layers(plane, scene.dtm, model, wall_ground, bounds, options)[0]
    else:
        whole = mesh_adaptive(plane, scene.dtm, model.roofs, model.ids, options)[0]
    untiled = measure_cells(expand_cells(whole)).radius_ratio
    ratio = np.percentile(tiled, (0, 0.1, 1, 5, 50)) / np.percentile(untiled, (0, 0.1, 1, 5, 50))
    worst, few, most, cells = bounds_of_ratio
    assert ratio[0] > worst
    assert ratio[1] > few
    assert (ratio[2:] > most).all()
    assert len(tiled) < cells * len(untiled)


@pytest.mark.long
@pytest.mark.shared
@pytest.mark.parametrize(
    ("options", "simplify"), [(OPTIONS, "clearance"), (OPTIONS, "paper"), (LAYERED, "clearance")]
)
def test_amsterdam_in_four_tiles_is_one_mesh(
    options: Options, simplify: Literal["clearance", "paper"], shared_data: Path
) -> None:
    bounds, key = (120900.0, 486150.0, 121200.0, 486450.0), Key(807, 3242)
    scene = amsterdam_scene(shared_data / "amsterdam", bounds, simplify)
    grid = make_grid(bounds, tile_size=150.0, mesh_size=10.0)
    options = replace(options, domain_height=100.0)
    tiles = prove_tiles(scene, grid, options)
    assert mesh_bytes(mesh_alone(scene, grid, key, options, clip=False).mesh) == mesh_bytes(tiles[key].mesh)


def test_the_clearest_place_is_the_middle_of_the_street() -> None:
    none = np.empty(0, object)
    lone = place_corner(NINE, Key(1, 1), none, cut_walls(none, mesh_size=10.0), mesh_size=10.0)
    assert lone.xy.tolist() == [140, 140]
    assert lone.tips.tolist() == [[148, 140], [140, 148], [132, 140], [140, 132]]
    street = np.array([shapely.box(120, 100, 136, 180), shapely.box(148, 100, 170, 180)])
    corner = place_corner(NINE, Key(1, 1), street, cut_walls(street, mesh_size=10.0), mesh_size=10.0)
    assert corner.xy.tolist() == [142, 140]
    np.testing.assert_allclose(corner.tips[0], [142 + 0.6 * 6, 140])
    # In a house, half the distance counts: 18 m to the walls on both sides against 6 m in the street.
    wide = np.array([shapely.box(100, 100, 136, 180), shapely.box(148, 100, 170, 180)])
    corner = place_corner(NINE, Key(1, 1), wide, cut_walls(wide, mesh_size=10.0), mesh_size=10.0)
    assert corner.building == 0
    assert corner.xy.tolist() == [118, 140]
    border = place_corner(NINE, Key(1, 0), street, cut_walls(street, mesh_size=10.0), mesh_size=10.0)
    assert border.xy.tolist() == [140, 0]
    assert np.isnan(border.tips[3]).all()


@pytest.mark.parametrize("seed", range(4))
def test_no_place_is_given_up_that_could_be_the_clearest(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    houses = crowded_blocks(SQUARE, 12, seed=seed)
    polygons = np.array([*houses, shapely.box(100, 100, 136, 180)] if seed == 3 else houses)
    walls = cut_walls(polygons, mesh_size=10.0)
    keys = [Key(i, j) for i in range(4) for j in range(4)]
    quick = [place_corner(NINE, key, polygons, walls, mesh_size=10.0) for key in keys]
    monkeypatch.setattr("stitch.tiling.corners._find_best", lambda walls, xy, *_: np.arange(len(xy)))
    for key, corner in zip(keys, quick, strict=True):
        thorough = place_corner(NINE, key, polygons, walls, mesh_size=10.0)
        assert corner.xy.tobytes() == thorough.xy.tobytes()
        assert corner.tips.tobytes() == thorough.tips.tobytes()
        assert corner.building == thorough.building


def test_buildings_count_with_their_part_in_a_tile() -> None:
    tile = shapely.box(0, 0, 100, 100)
    houses = [shapely.box(10, 10, 20, 20), shapely.box(95, 0, 110, 10), shapely.box(100, 0, 120, 9)]
    assert areas_within(np.array(houses), tile).tolist() == [100, 50, 0]


def test_pieces_of_a_wall_are_the_same_in_both_directions_and_split_where_told() -> None:
    ring = np.array([(1.1, 2.3), (41.7, 9.9), (30.1, 33.3)])
    forth, back = (cut_walls(np.array([shapely.Polygon(xy)]), mesh_size=10.0) for xy in (ring, ring[::-1]))
    assert forth.tobytes() == back.tobytes()
    length = np.linalg.norm(forth[:, 1] - forth[:, 0], axis=1)
    assert length.max() <= 15
    assert len(forth) == 3 + 2 + 3
    node = forth[2].mean(axis=0)
    parts = split_walls(forth, np.array([node, forth[0, 0], [100.0, 100.0]]), reach=1e-6)
    assert len(parts) == len(forth) + 1
    assert (parts[2, 1] == node).all()
    assert (parts[3, 0] == node).all()


def test_lines_are_multiples_of_the_tile_size_and_stay_clear_of_the_sides() -> None:
    grid = make_grid((-10.0, 215.0, 500.0, 285.0), tile_size=140.0, mesh_size=10.0)
    assert grid.lines[0].tolist() == [-10, 140, 280, 420, 500]
    assert grid.lines[1].tolist() == [215, 285]
    assert tile_keys(grid) == [Key(i, 1) for i in range(4)]
    assert [key for key in seam_keys(grid) if not is_border(grid, key)] == [SeamKey(1, i, 1) for i in (1, 2, 3)]
    with pytest.raises(ValueError, match="below 14 mesh sizes"):
        make_grid(SQUARE, tile_size=130.0, mesh_size=10.0)
    with pytest.raises(ValueError, match="empty"):
        make_grid((0.0, 0.0, 0.0, 9.0), tile_size=140.0, mesh_size=10.0)


def test_what_the_grid_says_of_absent_tiles() -> None:
    """Runs of regions with absent tiles are proved in `tests.runs.test_tiled_runs`."""
    present = np.ones((3, 3), np.bool_)
    present[2, 2] = False
    grid = replace(NINE, present=present)
    assert not has_tile(grid, Key(2, 2))
    assert not has_tile(grid, Key(-1, 0))
    assert not has_tile(grid, Key(3, 0))
    assert len(tile_keys(grid)) == 8
    assert is_border(grid, SeamKey(1, 2, 2))
    assert not is_border(grid, SeamKey(1, 2, 1))
    assert SeamKey(1, 3, 2) not in seam_keys(grid)
    assert len(seam_keys(grid)) == 24 - 2


def test_a_seam_goes_round_houses_where_it_can_and_never_leaves_its_wedges() -> None:
    house = np.array([shapely.box(190, 130, 230, 148)])
    walls = cut_walls(house, mesh_size=10.0)
    ends = tuple(place_corner(NINE, key, house, walls, mesh_size=10.0) for key in (Key(1, 1), Key(2, 1)))
    seam = trace_seam(
        NINE, SeamKey(0, 1, 1), (ends[0], ends[1]), house, walls, mesh_size=10.0, min_angle=28.0, passes=4
    )
    assert (seam.xy[0] == ends[0].xy).all()
    assert (seam.xy[-1] == ends[1].xy).all()
    assert any((seam.xy == ends[0].tips[0]).all(axis=1))
    assert not shapely.intersects(shapely.LineString(seam.xy), house[0])
    for end in ends:
        across, along = np.abs(seam.xy - end.xy).T[::-1]
        assert (across <= 0.7 * along).all()


def test_no_way_through_is_an_error_with_its_place(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(paths, "SLOPES", (0.0,))
    scene = scene_of([], [], tilted_dtm(SQUARE))
    with pytest.raises(GeometryError, match=r"seam from \(140\.0, 140\.0\).*--tile-size"):
        mesh_alone(scene, NINE, Key(1, 1))


def test_what_a_seam_lacks_is_refused() -> None:
    with pytest.raises(ValueError, match=r"no vertex at \(1\.0, 5\.0\)"):
        find_vertices(np.zeros((1, 2)), np.array([[1.0, 5.0]]))


def test_corners_on_the_border_of_a_narrow_region_stay_close() -> None:
    bounds = (0.0, 0.0, 600.0, 24.0)
    grid = make_grid(bounds, tile_size=140.0, mesh_size=10.0)
    house = np.array([shapely.box(130, 2, 150, 22)])
    corner = place_corner(grid, Key(1, 0), house, cut_walls(house, mesh_size=10.0), mesh_size=10.0)
    # A sixth of the 24 m to the corner across, and a quarter of them for the first edges.
    assert abs(corner.xy[0] - 140) <= 4
    none = np.empty(0, object)
    lone = place_corner(grid, Key(1, 0), none, cut_walls(none, mesh_size=10.0), mesh_size=10.0)
    assert lone.tips[:3].tolist() == [[146, 0], [140, 6], [134, 0]]


def test_a_seam_takes_a_detour_before_it_cuts_a_house() -> None:
    house = np.array([shapely.box(208, 95, 212, 168)])
    walls = cut_walls(house, mesh_size=10.0)
    ends = tuple(place_corner(NINE, key, house, walls, mesh_size=10.0) for key in (Key(1, 1), Key(2, 1)))
    seam = trace_seam(
        NINE, SeamKey(0, 1, 1), (ends[0], ends[1]), house, walls, mesh_size=10.0, min_angle=28.0, passes=4
    )
    assert not shapely.intersects(shapely.LineString(seam.xy), house[0])


def test_a_strip_is_improved_around_its_path_or_whole_where_that_touches_a_house() -> None:
    key, corners = SeamKey(0, 1, 1), (Key(1, 1), Key(2, 1))

    def improve(houses: list[shapely.Polygon]) -> tuple[Strip, Strip, NDArray[np.float64], NDArray[np.float64]]:
        polygons = np.array(houses, object)
        walls = cut_walls(polygons, mesh_size=4.0)
        start, end = (place_corner(NINE, corner, polygons, walls, mesh_size=4.0) for corner in corners)
        strip = mesh_strip(NINE, key, (start, end), polygons, walls, mesh_size=4.0, min_angle=28.0)
        path = paths.find_path(NINE, key, (start, end), strip)
        better = improve_around(strip, path, (start, end), mesh_size=4.0, passes=4)
        away = shapely.distance(shapely.LineString(strip.xy[path]), shapely.points(strip.xy))
        again = better.xy[paths.find_path(NINE, key, (start, end), better)]
        for tip in (start.xy, start.tips[0], end.tips[2], end.xy):
            assert (again == tip).all(axis=1).any()
        return strip, better, away, again

    strip, better, away, again = improve([])
    moved = (strip.xy != better.xy).any(axis=1)
    assert moved[away < 4].mean() > 0.8
    assert not moved[away > 4 * CORRIDOR].any()
    assert shapely.LineString(again).length < 1.06 * 140
    for some in (strip, better):
        u, v = some.xy[some.triangles[:, 1]], some.xy[some.triangles[:, 2]]
        u, v = u - some.xy[some.triangles[:, 0]], v - some.xy[some.triangles[:, 0]]
        area = (u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]) / 2
        assert area.min() > 0
        assert np.isclose(area.sum(), np.prod(np.ptp(some.xy, axis=0)))
    strip, better, away, _ = improve([shapely.box(195, 100, 225, 176)])
    moved = (strip.xy != better.xy).any(axis=1)
    assert moved[away > 4 * CORRIDOR].mean() > 0.5


def test_only_layers_need_more_of_a_strip_than_the_triangles_at_a_seam() -> None:
    none = np.empty(0, object)
    walls = cut_walls(none, mesh_size=10.0)
    start, end = (place_corner(NINE, key, none, walls, mesh_size=10.0) for key in (Key(1, 1), Key(2, 1)))
    seams = [
        trace_seam(
            NINE,
            SeamKey(0, 1, 1),
            (start, end),
            none,
            walls,
            mesh_size=10.0,
            min_angle=28.0,
            passes=4,
            surroundings=reach,
        )
        for reach in (0.0, 2.0)
    ]
    assert seams[0].xy.tobytes() == seams[1].xy.tobytes()
    assert seams[0].surroundings is seams[0].ring
    assert len(seams[1].surroundings.triangles) > 1.5 * len(seams[1].ring.triangles)
