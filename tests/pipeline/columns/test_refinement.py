"""Cells that are finer at walls and in areas: followed by triangles, alike on both sides of seams, foreseen."""

from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyogrio
import pyproj
import pytest
import shapely
from numpy.typing import NDArray

from pipeline.columns.spacing import TALLEST, SpacingLimits, column_spacing, mean_edges
from pipeline.data.errors import CityError, ConfigError, InputError
from pipeline.plane_mesh.plane import mesh_plane
from pipeline.plane_mesh.sizes import Finer, SizeRule, local_sizes, size_field
from stitch.seams.tiles import sizes_halo
from stitch.tiling.grid import Key, make_grid
from stitch.tiling.walls import LONGEST_PIECE, cut_walls
from tests.helpers.cities import city_of, crowded_blocks
from tests.helpers.stitching import (
    BOTH,
    Options,
    glue,
    mesh_all,
    mesh_alone,
    mesh_bytes,
    prove_tiles,
    random_scene,
)
from tests.helpers.tiles import CRS, hash_files, make_town, prove, run_of, write_town
from tiler.cli.negative_values import mark_values
from tiler.cli.parser import build_parser
from tiler.config.config import Config, idle_parameters, make_config, read_refinement
from tiler.config.step_options import size_rule
from tiler.planning.footprint_sample import sample_footprints
from tiler.planning.forecast import forecast_run
from tiler.planning.plan import survey_inputs
from tiler.planning.refinements import MOST_PLACES, read_refinements
from tiler.planning.region import Region
from tiler.stages.mesh import mesh_stages

SIDE = 160.0  # m; of a tile
BOUNDS = (0.0, 0.0, 2 * SIDE, 2 * SIDE)
WALLS = SizeRule(10.0, 10.0, 0.2, wall_size=3.0, wall_grading=0.2)
EVEN = SizeRule(10.0, 10.0, 0.2)
BOX = (130.0, 140.0, 190.0, 175.0)  # across the corner in which four tiles meet


def finer_box() -> list[Finer]:
    return [Finer(4.0, 0.2, shapely.STRtree([shapely.box(*BOX)]))]


def lengths(pieces: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.hypot(*(pieces[:, 1] - pieces[:, 0]).T))


def test_walls_are_halved_where_areas_are_finer_whoever_sees_them() -> None:
    long = shapely.box(0, 150, 320, 158)
    finer = finer_box()
    pieces = cut_walls(np.array([long]), mesh_size=10.0, finer=finer)
    size = local_sizes(size_field(np.empty((0, 2, 2)), EVEN, finer), pieces.mean(axis=1), mesh_size=10.0)
    assert (lengths(pieces) <= LONGEST_PIECE * size).all()
    assert lengths(pieces).max() > 10
    assert lengths(pieces).min() < 6
    assert (pieces[1:21, 0] == pieces[:20, 1]).all(axis=1).sum() >= 19  # in their order along the wall
    other = cut_walls(np.array([shapely.box(0, 158, 320, 170), long]), mesh_size=10.0, finer=finer)
    assert {piece.tobytes() for piece in pieces} <= {piece.tobytes() for piece in other}


def test_triangles_are_thin_at_walls_and_cells_as_high_as_without() -> None:
    house = city_of([shapely.box(60, 60, 100, 100)], [0.0]).polygons
    field = size_field(cut_walls(house, mesh_size=WALLS.at_walls), WALLS)
    plane, complete = mesh_plane(
        (0.0, 0.0, 160.0, 160.0), house, mesh_size=10.0, min_angle=28, refinements=1, passes=4, sizes=field
    )
    assert complete
    edge, size = mean_edges(plane), local_sizes(field, plane.xy, mesh_size=10.0)
    on_wall = shapely.distance(house[0].boundary, shapely.points(plane.xy)) < 1e-9
    assert 2.0 < edge[on_wall].mean() < 4.0
    assert 0.7 < (edge / size)[~on_wall].mean() < 1.0
    assert edge[size == 10].mean() > 8
    limits = SpacingLimits(0.1, 0.8)
    spacing = column_spacing(plane, field, limits, mesh_size=10.0)
    assert spacing[on_wall].mean() > 0.9 * TALLEST * edge[on_wall].mean() * 0.8
    assert spacing.max() <= 8
    finer = size_field(np.empty((0, 2, 2)), EVEN, [Finer(3.0, 0.2, field.walls)])
    assert column_spacing(plane, finer, limits, mesh_size=10.0)[on_wall].max() <= 0.8 * 3.0


@pytest.mark.parametrize("options", BOTH.values(), ids=BOTH)
@pytest.mark.parametrize("what", ["walls", "box"])
def test_four_tiles_are_one_mesh(options: Options, what: str) -> None:
    scene = random_scene((90.0, 90.0, 240.0, 230.0), 12, seed=3)
    grid = make_grid(BOUNDS, tile_size=SIDE, mesh_size=10.0)
    rule, finer = (WALLS, []) if what == "walls" else (EVEN, finer_box())
    scene = type(scene)(scene.model, scene.group, random_scene(BOUNDS, 1, seed=0, relief=8.0).dtm)
    tiles = prove_tiles(scene, grid, options, rule=rule, finer=finer)
    even = mesh_all(scene, grid, options)
    assert len(glue([tile.mesh for tile in tiles.values()]).cells) > 1.3 * sum(
        len(tile.mesh.plane.triangles) for tile in even.values()
    )
    alone = mesh_alone(scene, grid, Key(0, 0), options, clip=False, rule=rule, finer=finer)
    assert mesh_bytes(alone.mesh) == mesh_bytes(tiles[Key(0, 0)].mesh)


# Runs.

Town = Callable[..., dict[str, Any]]


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Town:
    """Parameters of a small town of four tiles."""
    west, south = 318_080.0, 6_399_120.0
    region = (west, south, west + 2 * SIDE, south + 2 * SIDE)
    blocks = crowded_blocks((west + 90, south + 90, west + 240, south + 230), 10, seed=2)
    values = write_town(tmp_path_factory.mktemp("town"), make_town(region, blocks, relief=8), spacing=1.5)
    values |= {"tile_size": SIDE, "bounds": region, "dtm_spacing": 2.0, "domain_height": 50.0}
    corner = region[0] + SIDE, region[1] + SIDE
    box = f"{corner[0] - 30:.1f},{corner[1] + 25:.1f},{corner[0] + 40:.1f},{corner[1] - 20:.1f},4"
    return lambda **more: values | {"refine": [box]} | more


@pytest.mark.parametrize("mesher", ["adaptive", pytest.param("layered", marks=pytest.mark.long)])
def test_a_refined_run_is_proved_and_foreseen(town: Town, mesher: str, tmp_path: Path) -> None:
    values = town(mesher=mesher, wall_size=4.0)
    record = run_of(values, tmp_path / "out")
    prove(tmp_path / "out")
    config = make_config(values)
    survey = survey_inputs(config, lambda _: None)
    cells = forecast_run(survey, sample_footprints(config, survey.region), config).loads.cells.sum()
    assert 0.6 < cells / record["counts"]["cells"] < 1.6


@pytest.mark.long
def test_workers_leave_the_same_files_as_one_process(town: Town, tmp_path: Path) -> None:
    for workers in (0, 2):
        run_of(town(wall_size=4.0), tmp_path / str(workers), workers=workers)
    assert hash_files(tmp_path / "0") == hash_files(tmp_path / "2")


def test_only_a_refined_mesh_depends_on_what_is_refined() -> None:
    names = {"wall_size", "wall_growth", "refinements", "refine_growth"}
    plain, finer = mesh_stages(Config()), mesh_stages(make_config({"wall_size": 2.0}))
    assert all(names.isdisjoint(stage.parameters) for stage in plain)
    assert all(names <= set(stage.parameters) for stage in finer)
    halos = [{read.stage: read.halo for read in stages[0].reads} for stages in (plain, finer)]
    # Walls count (10 - 2) / 0.2 m beyond the places whose sizes are asked for.
    assert halos[1]["model"] >= halos[0]["model"] + 40
    # Boxes, areas and zones count as far as those of tasks, which know no other halo than that of their rule.
    for values in ({"refine": ["0,0,9,9,2"]}, {"refine_areas": "a.gpkg"}, {"focus": "0,0,9"}):
        config = make_config(values)
        (halo,) = (read.halo for read in mesh_stages(config)[0].reads if read.stage == "model")
        assert halo == sizes_halo(config.tile_size_or_default, size_rule(config, 0.0)) > halos[0]["model"]
    assert idle_parameters(make_config({"wall_growth": 1.3, "refine_growth": 1.3, "refine_attribute": "a"})) == [
        "wall_growth = 1.3 has no effect: it counts with wall_size above 0",
        "refine_growth = 1.3 has no effect: it counts with refine, refine_areas, focus, lod_zones",
        "refine_attribute = a has no effect: it counts with refine_areas",
    ]


# What is refined.

REGION = Region((318_000.0, 6_399_000.0, 318_320.0, 6_399_320.0), CRS, SIDE)


def areas_file(path: Path, sizes: list[Any], *, crs: str = CRS, shapes: list[Any] | None = None) -> str:
    shapes = [shapely.box(318_100 + k, 6_399_100, 318_110, 6_399_120) for k in range(len(sizes))] + (shapes or [])
    there = pyproj.Transformer.from_crs(CRS, crs, always_xy=True)
    moved = shapely.transform(shapes[-len(sizes) :], there.transform, interleaved=False)
    values = np.array(sizes, np.float64)
    blobs = np.array([shapely.to_wkb(shape) for shape in moved], object)
    pyogrio.raw.write(path, blobs, [values], ["size"], geometry_type="Polygon", crs=crs)
    return str(path)


def test_areas_of_a_file_in_another_crs_come_to_their_places(tmp_path: Path) -> None:
    areas = areas_file(tmp_path / "areas.gpkg", [2.0, 2.5], crs="EPSG:4326")
    found = read_refinements(make_config({"refine_areas": areas, "refine": ["318000,0,318001,9,3"]}), REGION)
    assert [size for size, _ in found] == [2.0, 2.5, 3.0]
    box = shapely.from_wkb(found[0][1]).bounds
    np.testing.assert_allclose(box, (318_100, 6_399_100, 318_110, 6_399_120), atol=0.01)
    assert read_refinements(Config(), REGION) == ()


def test_areas_that_cannot_be_meant_are_refused(tmp_path: Path) -> None:
    many = shapely.Point(318_100, 6_399_100).buffer(20, quad_segs=MOST_PLACES)
    cases: list[tuple[str, type[CityError], str]] = [
        (areas_file(tmp_path / "coarse.gpkg", [12.0]), ConfigError, "size of 12 m.*below that of the rest, 10 m"),
        (areas_file(tmp_path / "none.gpkg", [None, 2.0]), InputError, "has no size"),
        (areas_file(tmp_path / "large.gpkg", [2.0], shapes=[many]), InputError, "vertices.*simplify"),
        (str(tmp_path / "absent.gpkg"), InputError, "no such file; check the path of refine_areas"),
    ]
    for path, kind, words in cases:
        with pytest.raises(kind, match=words):
            read_refinements(make_config({"refine_areas": path}), REGION)
    with pytest.raises(ConfigError, match="no attribute 'h'"):
        read_refinements(make_config({"refine_areas": cases[0][0], "refine_attribute": "h"}), REGION)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"refine": ["1,2,3"]}, "five numbers x0,y0,x1,y1,SIZE"),
        ({"refine": ["0,0,-9,3"]}, "radius of -9 m; must be above 0"),
        ({"refine": ["0,0,0,9,2"]}, "no area"),
        ({"refine": ["0,0,9,9,10"]}, "size of 10 m"),
        ({"wall_size": 10.0}, "below mesh_size = 10 m"),
        ({"wall_size": 0.05}, "at least 0.1 m"),
        ({"wall_growth": 1.0}, "must be above 1"),
    ],
)
def test_wrong_sizes_are_refused(values: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        make_config(values)


def test_boxes_come_from_the_command_line_repeated_and_west_of_the_origin() -> None:
    words = mark_values(["run", "a.laz", "--refine", "-5,-2e1,7,8,2", "--refine", "1,2,3,4,3"])
    given = build_parser(defaultdict(lambda: len)).parse_args(words)
    assert given.refine == ["-5,-2e1,7,8,2", "1,2,3,4,3"]
    assert read_refinement(given.refine[0], 10.0) == (2.0, (-5.0, -20.0, 7.0, 8.0))


def test_a_circle_is_a_place_and_a_radius() -> None:
    ((size, shape),) = read_refinements(make_config({"refine": ["318010,6399020.5,50,3"]}), REGION)
    circle = shapely.from_wkb(shape)
    assert size == 3.0
    away = shapely.distance(shapely.points(shapely.get_coordinates(circle)), shapely.Point(318_010, 6_399_020.5))
    np.testing.assert_allclose(away, 50.0, atol=0.001)
    assert len(away) == 65
    assert circle.area > 0.995 * np.pi * 50**2


def test_edges_of_areas_are_seen_in_the_plane_mesh() -> None:
    field = size_field(np.empty((0, 2, 2)), EVEN, finer_box())
    plane, _ = mesh_plane(
        BOUNDS, np.empty(0, np.object_), mesh_size=10.0, min_angle=28, refinements=1, passes=4, sizes=field
    )
    inside = shapely.contains_xy(shapely.box(*BOX).buffer(-5), plane.xy)
    far = ~shapely.contains_xy(shapely.box(*BOX).buffer(35), plane.xy)
    edge = mean_edges(plane)
    assert 3.0 < edge[inside].mean() < 4.2
    assert 8.0 < edge[far].mean() < 9.5
