"""The plan of a run, held against runs; and regions as large as a country."""

import base64
import json
import subprocess
import sys
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pyproj
import pytest
import shapely
from PIL import Image
from rich.console import Console

from pipeline.data.errors import ConfigError
from stitch.tiling.grid import has_tile, make_grid, seam_keys, seam_line, tile_box, tile_keys, tiles_of_seam
from tests.helpers.told import Listener
from tiler.cli import main as cli
from tiler.config.config import Config, make_config
from tiler.engine.run_context import absent_tiles, choose_tiles, make_layout, seam_name, tile_name
from tiler.georeference.frame import AS_IT_IS
from tiler.interface.synth import write_city
from tiler.planning.establish_georeference import Georeference
from tiler.planning.footprint_sample import FootprintSample, measure_detail, sample_footprints
from tiler.planning.forecast import Forecast, forecast_run, spread_points, warn_of_memory
from tiler.planning.plan import Survey, survey_inputs
from tiler.planning.region import Region, check_region
from tiler.pointclouds.clouds import CloudHeader
from tiler.report.plan_map import draw_plan
from tiler.report.plan_report import describe_plan, plan_run
from tiler.report.svg_map import FootprintRaster
from tiler.workflow.run import run

CRS = "EPSG:3006"


@pytest.fixture(scope="module")
def city(tmp_path_factory: pytest.TempPathFactory) -> Config:
    folder = tmp_path_factory.mktemp("city")
    files = write_city(folder, size=300, buildings=45)
    clouds = tuple(str(path) for path in files.clouds)
    return Config(clouds, str(files.footprints), mesh_size=10.0, tile_size=150.0, out=str(folder / "out"))


@pytest.fixture(scope="module")
def record(city: Config) -> dict[str, Any]:
    """What a run of the city really took, in a process of its own."""
    words = [*city.pointcloud, "--footprints", city.footprints, "--tile-size", "150", "--out", city.out]
    subprocess.run([sys.executable, "-m", "tiler.cli.main", "run", *words], check=True, capture_output=True)
    found: dict[str, Any] = json.loads((Path(city.out) / "run.json").read_text())
    return found


def forecast_of(config: Config, **words: Any) -> Forecast:
    survey = survey_inputs(config, ignore)
    return forecast_run(survey, sample_footprints(config, survey.region), config, **words)


ESTABLISHED = Georeference(pyproj.CRS(CRS), [], AS_IT_IS, {}, [], [], {})


def ignore(_: str) -> None:
    """Say nothing."""


def quiet() -> Console:
    return Console(width=80, quiet=True)


def country(n: int, size: float = 1000.0) -> Survey:
    """A square of n x n tiles, a file over each 5 x 5 of them, but none in one of nine parts."""
    bounds = (0.0, 0.0, n * size, n * size)
    side = 5 * size
    clouds = [
        CloudHeader(
            Path(f"{i}_{j}.laz"), 1000, (i * side, j * side, (i + 1) * side, (j + 1) * side, 0.0, 9.0), None
        )
        for i in range(n // 5)
        for j in range(n // 5)
        if not n // 3 <= 5 * i < 2 * n // 3 or not n // 3 <= 5 * j < 2 * n // 3
    ]
    grid = choose_tiles(make_grid(bounds, tile_size=size, mesh_size=5.0), [cloud.bounds[:4] for cloud in clouds])
    return Survey(Region(bounds, CRS, size), clouds, clouds, [], {}, grid, ESTABLISHED, grid, ())


def test_cells_points_disk_and_memory_are_as_a_run_has_them(city: Config, record: dict[str, Any]) -> None:
    forecast, counts = forecast_of(city), record["counts"]
    survey = survey_inputs(city, ignore)
    plan = describe_plan(survey, None, forecast, city, None)
    covered = describe_plan(survey, None, forecast, replace(city, land_cover=("cover.gpkg",)), None)
    assert "cells_with_land_cover" not in plan["mesh"]
    assert covered["mesh"]["cells_with_land_cover"] == pytest.approx(2.2 * plan["mesh"]["cells"], rel=0.1)
    assert forecast.loads.cells.sum() == pytest.approx(counts["cells"], rel=0.2)
    assert plan["mesh"]["points"] == pytest.approx(counts["points"], rel=0.3)
    assert forecast.loads.lidar_points.sum() == pytest.approx(counts["points read"], rel=0.02)
    assert forecast.loads.footprints.sum() == counts["footprints read"]
    written = sum(path.stat().st_size for path in Path(city.out).rglob("*") if path.is_file())
    assert written / 2 < forecast.disk < 2 * written
    assert record["peak_memory_bytes"] / 2 < forecast.tile_memory.max() < 2 * record["peak_memory_bytes"]
    tiles = {name: tile["counts"]["cells"] for name, tile in record["tiles"].items()}
    for (i, j), cells in zip(forecast.loads.index.tolist(), forecast.loads.cells, strict=True):
        assert tiles[f"{i}_{j}"] / 1.5 < cells < 1.5 * tiles[f"{i}_{j}"]


@pytest.mark.usefixtures("record")
def test_tasks_of_each_stage_are_those_of_a_run(city: Config) -> None:
    store = Path(city.out) / "store.zarr"
    done = {
        stage.name: sum(item.suffix == ".zip" and item.name[0] != "." for item in stage.iterdir())
        for stage in store.iterdir()
        if stage.is_dir()
    }
    tasks = {entry.stage: entry.number for entry in forecast_of(city).tasks}
    further = {name for name in done if name[-1] > "1" and name[-1].isdigit()} | {"members-1", "shapes-1"}
    assert {name: n for name, n in done.items() if name not in further} == tasks
    assert ("members-1" in done) == ("shapes-1" in done)  # asked for where clusters were joined
    assert "join-1" in tasks


def amsterdam(shared_data: Path, **given: Any) -> Config:
    folder = shared_data / "amsterdam"
    return Config((str(folder / "tiles"),), str(folder / "footprints.shp"), **given)


@pytest.mark.parametrize(
    ("mesher", "mesh_size", "height", "cells"),
    [
        # Measured: Amsterdam in tiles of 300 m.
        ("adaptive", 5.0, 100.0, 5889610),
        ("adaptive", 10.0, 100.0, 4046880),
        ("adaptive", 20.0, 100.0, 3679798),
        ("layered", 10.0, 100.0, 841188),
    ],
)
def test_cells_of_a_dense_city(
    shared_data: Path, mesher: str, mesh_size: float, height: float, cells: int
) -> None:
    given = {
        "tile_size": 300.0,
        "mesh_size": mesh_size,
        "mesher": mesher,
        "domain_height": height,
        "roofs": "flat",
    }
    config = amsterdam(shared_data, **given)
    assert cells / 1.25 < forecast_of(config).loads.cells.sum() < 1.25 * cells


@pytest.mark.parametrize(
    ("mesher", "mesh_size", "tile_size", "seconds"),
    [
        # Measured: time of all tasks of Amsterdam, see docs/plan.md.
        ("adaptive", 10.0, 0.0, 4.6),
        ("adaptive", 10.0, 300.0, 4.8),
        ("adaptive", 5.0, 0.0, 4.8),
        ("adaptive", 20.0, 0.0, 4.5),
        ("layered", 10.0, 0.0, 3.4),
    ],
)
def test_time_of_a_dense_city(
    shared_data: Path, mesher: str, mesh_size: float, tile_size: float, seconds: float
) -> None:
    config = amsterdam(shared_data, tile_size=tile_size, mesh_size=mesh_size, mesher=mesher)
    assert seconds / 2 < forecast_of(config).work < 2 * seconds


@pytest.mark.parametrize("seed", range(12))
def test_tiles_and_seams_are_those_found_one_by_one(seed: int) -> None:
    rng = np.random.default_rng(seed)
    low, extent = rng.uniform(-500, 500, 2), rng.uniform(100, 2000, 2)
    whole = make_grid((*low, *(low + extent)), tile_size=200.0, mesh_size=10.0)
    corner = np.round(rng.uniform(-800, 2000, (4, 2)), -2 if seed % 2 else 3)
    boxes = np.hstack((corner, corner + np.round(rng.uniform(0, 500, (4, 2)), -2 if seed % 2 else 3)))
    grid = choose_tiles(whole, [tuple(box) for box in boxes.tolist()])
    clouds = [shapely.box(*box) for box in boxes]
    there = []
    for key in tile_keys(whole):
        xmin, ymin, xmax, ymax = tile_box(whole, key)
        tile = shapely.box(xmin + 1e-6, ymin + 1e-6, xmax - 1e-6, ymax - 1e-6)
        there += [key] if any(tile.intersects(cloud) for cloud in clouds) else []
    assert tile_keys(grid) == there
    assert sorted(absent_tiles(grid) + there) == sorted(tile_keys(whole))
    seams = [seam for seam in seam_keys(whole) if any(has_tile(grid, tile) for tile in tiles_of_seam(seam))]
    assert seam_keys(grid) == seams
    layout = make_layout(grid, {}, identity="")
    assert dict(layout.tiles) == {tile_name(key): tile_box(grid, key) for key in there}
    assert dict(layout.seams) == {seam_name(key): seam_line(grid, key) for key in seams}


@pytest.mark.timeout(30)
def test_a_country_of_half_a_million_tiles(tmp_path: Path) -> None:
    survey, config = country(700), Config(tile_size=1000.0)
    forecast = forecast_run(survey, None, config, memory=64e9)
    assert len(forecast.loads) == len(forecast.loads.index) == 490_000 - 235 * 235
    assert sum(entry.number for entry in forecast.tasks) > 6_900_000
    assert forecast.loads.lidar_points.sum() == pytest.approx(1000 * len(survey.clouds))
    assert not forecast.warnings
    plan = describe_plan(survey, None, forecast, config, 64e9)
    assert plan["tiles"]["absent"] == 235 * 235
    draw_plan(survey, None, tmp_path / "plan.svg")
    assert (tmp_path / "plan.svg").stat().st_size > 1000


def test_more_tiles_to_a_side_than_ids_can_tell_are_refused() -> None:
    """Columns and rows of tiles have 15 bits in the ids of points."""
    wide = Region((0.0, 0.0, 200.0 * 32_766, 500.0), CRS, 200.0)
    check_region(wide, 10.0, [])
    with pytest.raises(ConfigError, match="more than 32766 tiles of 199 m to a side; give --tile-size 200"):
        check_region(replace(wide, tile_size=199.0), 10.0, [])


def test_points_of_files_are_dealt_out_by_area() -> None:
    grid = make_grid((0.0, 0.0, 400.0, 400.0), tile_size=200.0, mesh_size=10.0)
    headers = [
        CloudHeader(Path("a"), 900, (100.0, 100.0, 400.0, 200.0, 0.0, 1.0), None),
        CloudHeader(Path("b"), 100, (-200.0, 0.0, 200.0, 200.0, 0.0, 1.0), None),
        CloudHeader(Path("c"), 7, (300.0, 300.0, 300.0, 300.0, 0.0, 1.0), None),
    ]
    np.testing.assert_allclose(spread_points(grid, headers, grid.bounds), [[300 + 50, 0], [600, 7]])


def test_walls_shorter_than_the_mesh_count() -> None:
    detail, octaves = measure_detail(
        np.array([shapely.box(0, 0, 20, 40), shapely.box(0, 0, 5, 0.5), shapely.Polygon()]),
        clearance=1.0,
        mesh_size=10.0,
    )
    np.testing.assert_allclose(detail, [0, 2 * 0.1 + 2 * 0.9, 0])
    np.testing.assert_allclose(octaves, [0, 2 * 1 + 2 * np.log2(10), 0])


def test_the_first_footprints_stand_for_those_of_a_large_file(city: Config) -> None:
    region = survey_inputs(city, ignore).region
    part = sample_footprints(city, region, limit=15)
    assert part is not None
    assert not part.complete
    assert len(part) == 15
    assert part.total == 45
    forecast = forecast_run(survey_inputs(city, ignore), part, city)
    assert forecast.loads.footprints.sum() == pytest.approx(45)


def test_tiles_that_do_not_fit_into_memory_are_told_with_a_size_that_does(city: Config) -> None:
    large = replace(city, tile_size=300.0, mesh_size=4.0, workers=2)
    assert not forecast_of(large, memory=4e9).warnings
    (warning,) = forecast_of(large, memory=8.0e8).warnings
    assert "--tile-size" in warning
    size = float(warning.split("--tile-size ")[1].split(",")[0])
    assert not forecast_of(replace(large, tile_size=size), memory=8.0e8).warnings
    (warning,) = forecast_of(large, memory=5e8).warnings
    assert "--tile-size" not in warning
    assert "fewer --workers" in warning


def test_the_output_folder_is_not_touched(city: Config, tmp_path: Path) -> None:
    out = tmp_path / "new" / "out"
    plan = plan_run(replace(city, out=str(out)), json_file=tmp_path / "plan.json", console=quiet())
    assert json.loads((tmp_path / "plan.json").read_text()) == plan
    assert [path.name for path in tmp_path.iterdir()] == ["plan.json"]


def test_what_is_printed_fits_into_80_columns(
    city: Config, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "150")
    words = [*city.pointcloud, "--footprints", city.footprints, "--tile-size", "150"]
    assert cli.main(["plan", *words]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 80
    labels = {line[:12].strip() for line in lines} - {""}
    assert labels >= {"region", "tiles", "files", "footprints", "mesh", "tasks", "memory", "disk", "time"}
    text = " ".join(" ".join(line.split()) for line in lines)
    assert "45 in the region" in text
    assert "factor of 2" in text


@pytest.mark.parametrize(
    ("words", "code"),
    [
        ([], 2),
        (["missing.laz"], 1),
        (["CITY", "--footprints", "missing.shp"], 1),
        (["CITY", "--land-cover", "missing.gpkg"], 1),
        (["CITY", "--trees", "missing.gpkg"], 1),
        (["CITY", "--generalised", "missing.gpkg"], 1),
        (["CITY", "--tile-size", "100"], 2),
        (["CITY", "--bounds", "0", "0", "10", "10"], 1),
        (["CITY", "--footprints", "SHAPES", "--id-attribute", "none"], 2),
    ],
)
def test_bad_input_is_told_as_a_run_does(
    city: Config,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    words: list[str],
    code: int,
) -> None:
    monkeypatch.chdir(tmp_path)
    names = {"CITY": city.pointcloud[0], "SHAPES": city.footprints}
    words = [names.get(word, word) for word in words]
    said = []
    for command in ("plan", "run"):
        if command == "run" and "--id-attribute" in words:  # a run finds it when it reads footprints
            continue
        assert cli.main([command, *words]) == code
        said.append(capsys.readouterr().err)
    assert len(set(said)) == 1
    assert said[0].startswith("citystitch: ")


def test_a_file_in_a_missing_folder_is_refused_at_once(city: Config, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no folder"):
        plan_run(city, picture=tmp_path / "gone" / "plan.svg", console=quiet())


def test_the_picture_of_a_plan_is_svg_and_other_names_are_refused(city: Config, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"plan.png: the picture of a plan is SVG; name it plan.svg"):
        plan_run(city, picture=tmp_path / "plan.png", console=quiet())
    assert not list(tmp_path.iterdir())


def boxes_of(root: ElementTree.Element, style: str) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Left, top, right and bottom of the rectangles of a class on the map, without the legend's."""
    found = [each.attrib for each in root.iterfind(f".//{{*}}rect[@class='{style}']")]
    sides = [[float(each.get(name, 0)) for name in ("x", "y", "width", "height")] for each in found]
    return np.array([(x, y, x + width, y + height) for x, y, width, height in sides]).reshape(-1, 4)


def test_the_picture_shows_tiles_absent_ones_and_houses_where_they_are(tmp_path: Path) -> None:
    survey = country(15, 100.0)
    yard = shapely.Polygon(shapely.box(50, 50, 450, 450).exterior, [shapely.box(150, 150, 350, 350).exterior])
    polygons = np.array([shapely.box(230, 230, 270, 270), yard])  # a house in the courtyard of another
    zero = np.zeros(2)
    sample = FootprintSample(2, True, polygons, shapely.bounds(polygons), shapely.area(polygons), zero, zero)
    draw_plan(survey, sample, tmp_path / "a.svg")
    root = ElementTree.parse(tmp_path / "a.svg").getroot()
    scale = 1400 / 1500
    tiles, files = boxes_of(root, "tile"), boxes_of(root, "file")

    def is_tile(x: float, y: float) -> bool:
        at = x * scale, 1400 - y * scale
        return bool(((tiles[:, :2] < at) & (at < tiles[:, 2:])).all(axis=1).any())

    assert (is_tile(630, 630), is_tile(630, 130), is_tile(120, 120)) == (False, True, True)
    covered = (tiles[:, 2] - tiles[:, 0]) * (tiles[:, 3] - tiles[:, 1])
    assert covered.sum() == pytest.approx(200 * (100 * scale) ** 2, rel=1e-3)
    assert len(files) == len(survey.clouds)
    assert np.abs(files[0] - np.array([0, 1000, 500, 1500]) * scale).max() < 0.1
    words = [each.text for each in root.iterfind(".//{*}text")]
    assert {"200 tiles of 100 m, 25 absent; 8 files; 2 footprints", "0_0", "14_14", "200 m"} <= set(words)
    (image,) = root.iterfind(".//{*}image")
    png = base64.b64decode(image.attrib["href"].split(",")[1])
    alpha = np.asarray(Image.open(BytesIO(png)).convert("RGBA"))
    assert alpha.shape == (1400, 1400, 4)

    def at(x: float, y: float) -> list[int]:
        return list(alpha[int(1400 - y * scale), int(x * scale)].tolist())

    assert at(120, 120) == at(265, 235) == [0xCD, 0x94, 0x80, 255]
    assert at(180, 180)[3] == at(630, 130)[3] == 0
    draw_plan(survey, sample, tmp_path / "b.svg")
    assert (tmp_path / "a.svg").read_bytes() == (tmp_path / "b.svg").read_bytes()


def test_a_raster_has_the_area_of_small_footprints_and_leaves_holes_open() -> None:
    ring = shapely.difference(shapely.box(5, 5, 30, 35), shapely.box(10, 10, 20, 20))
    both = shapely.MultiPolygon([ring, shapely.box(33, 1, 39, 9)])
    raster = FootprintRaster((0, 0, 40, 40), 40)
    raster.add(np.array([both, shapely.box(-50, -50, 2, 2)]))
    raster.add(np.array([], np.object_))
    raster.add(np.array([shapely.Polygon(), shapely.box(36, 20, 36.5, 20.5), shapely.box(1, 1, 2, 2)]))
    shares = raster.shares()[::-1]
    x, y = np.meshgrid(np.arange(40) + 0.5, np.arange(40) + 0.5)
    wanted = 255 * (shapely.contains_xy(both, x, y) | ((x < 2) & (y < 2)))
    wanted[20, 36] = 64
    assert np.array_equal(shares, wanted)


def test_a_run_says_before_it_starts_which_tiles_may_not_fit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_city(tmp_path / "city", size=200.0, buildings=4, density=0.5, relief=2, seed=1)
    for memory in (4.0, 0.3):
        monkeypatch.setattr("tiler.workflow.run.machine_memory", lambda memory=memory: memory * 2**30)
        said: list[str] = []
        values = {"pointcloud": [str(tmp_path / "city" / "tiles")], "out": str(tmp_path / str(memory))}
        config = make_config(values | {"tile_size": 100.0, "mesh_size": 5.0})
        record = run(config, watchers=[Listener(said.append)])
        warned = [message for message in record["messages"] if "may not fit into memory" in message]
        assert bool(warned) is (memory < 1)
        assert set(warned) <= set(said)
    assert "4 of 4 tiles may not fit into memory: up to 0." in warned[0]
    assert "a worker > 0.2 GiB, 80 % of the 0.3 GiB that it has" in warned[0]


def test_the_memory_limit_counts(tmp_path: Path) -> None:
    write_city(tmp_path / "city", size=200.0, buildings=4, density=0.5, relief=2, seed=1)
    values = {"pointcloud": [str(tmp_path / "city" / "tiles")], "tile_size": 100.0, "mesh_size": 5.0}
    for limit, warns in ((0.0, False), (4.0, False), (0.3, True)):
        config = make_config(values | {"workers": 1, "memory_limit": limit})
        assert bool(warn_of_memory(survey_inputs(config, print), config, memory=2.0**33)) is warns
