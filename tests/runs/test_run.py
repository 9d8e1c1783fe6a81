"""Whole runs from files to files: results, record, reruns, exit codes, bad input."""

import hashlib
import json
import os
import stat
from collections.abc import Callable
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest
import shapely

from pipeline.columns.columns import expand_cells
from pipeline.data.classes import BUILDING, GROUND
from pipeline.data.errors import CityError
from tests.helpers.bad_input import write_cloud, write_houses
from tests.helpers.campaigns import keep_outcome, rounds
from tests.helpers.cities import Bounds, cloud_over
from tests.helpers.columns import read_columns
from tests.helpers.synthetic import city_files
from tests.helpers.vtk_readers import read_vtk
from tiler.check.check import check_run
from tiler.cli.main import main
from tiler.config.config import make_config
from tiler.store.results import StoredTerrain
from tiler.store.store import Store
from tiler.workflow.run import run

BOUNDS: Bounds = (318000.0, 6399000.0, 318100.0, 6399100.0)
HOUSE = shapely.box(318020, 6399020, 318040, 6399045)
TOWER = shapely.box(318060, 6399060, 318075, 6399075)


@pytest.fixture
def city(tmp_path: Path) -> Path:
    """Two houses on flat ground in two LAZ files, as files."""
    folder = tmp_path / "city"
    folder.mkdir()
    cloud = cloud_over(BOUNDS, [(HOUSE, 10.0), (TOWER, 30.0)], ground=2.0)
    west = cloud.xyz[:, 0] < 318050
    write_cloud(folder / "west.laz", cloud.xyz[west], cloud.classification[west])
    write_cloud(folder / "east.laz", cloud.xyz[~west], cloud.classification[~west])
    write_houses(folder / "footprints.gpkg", [HOUSE, TOWER])
    return folder


def values(city: Path, out: Path, **others: Any) -> dict[str, Any]:
    return {"pointcloud": [str(city)], "footprints": str(city / "footprints.gpkg"), "out": str(out)} | others


def arguments(city: Path, out: Path, *others: str) -> list[str]:
    """A run without its report, which takes as long as these runs; `test_report` has it."""
    words = ["run", str(city), "--footprints", str(city / "footprints.gpkg"), "--out", str(out)]
    return [*words, *others]


TIMED = ("run.json", "progress.json", "events.jsonl", "config.toml", "report.html")


def hashes(folder: Path) -> dict[str, str]:
    """Hash of every file but those that have times."""
    files = sorted(path for path in folder.rglob("*") if path.is_file() and path.name not in TIMED)
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def test_a_run_leaves_a_mesh_that_its_check_proves(city: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    record = run(make_config(values(city, out)))
    assert record["exit_code"] == 0
    report = check_run(out, StoredTerrain)
    assert report.ok, report.lines()
    # Cloud-centred points: the region is the whole metres inside the points, 99 x 98 or so.
    xmin, ymin, xmax, ymax = record["region"]["bounds"]
    air = (xmax - xmin) * (ymax - ymin) * 100 - HOUSE.area * 8 - TOWER.area * 28
    assert report.facts["volume"] == pytest.approx(air, rel=0.02)
    written = json.loads((out / "run.json").read_text())
    assert written["status"] == "done"
    assert written["counts"]["buildings"] == 2
    assert written["region"]["crs"] == "EPSG:3006"
    assert written["quality"]["radius_ratio"]["0"] > 0
    for text in ("mesh.pvtu", "boundary.pvtp", "citymodel.city.json", "citymodel-full.city.json"):
        assert (out / text).is_file()


def test_the_files_hold_the_columns_of_the_store(city: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    record = run(make_config(values(city, out)))
    (tile,) = Store(out / "store.zarr").names("columns")
    columns, _ = read_columns(Store(out / "store.zarr"), tile)
    mesh = meshio.read(out / "mesh" / f"{tile}.vtu")
    assert len(mesh.points) == len(columns.z) == record["counts"]["points"]
    assert mesh.points[:, 2].tobytes() == columns.z.tobytes()
    assert len(mesh.cells_dict["tetra"]) == record["counts"]["cells"]
    assert np.array_equal(mesh.cells_dict["tetra"], expand_cells(columns).cells)


def test_a_run_says_how_many_tasks_ran_and_leaves_other_files_alone(
    city: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert main(arguments(city, out)) == 0
    tasks = json.loads((out / "run.json").read_text())["tasks"]["all"]
    assert f"{tasks} of {tasks} tasks ran, 0 results were there\n" in capsys.readouterr().out
    before = hashes(out)
    (out / "mine.txt").write_text("keep")
    assert main(arguments(city, out)) == 0
    assert f"0 of {tasks} tasks ran, {tasks} results were there\n" in capsys.readouterr().out
    assert hashes(out).items() >= before.items()
    assert main(arguments(city, out, "--overwrite")) == 0
    assert f"{tasks} of {tasks} tasks ran, 0 results were there\n" in capsys.readouterr().out
    assert {name: value for name, value in hashes(out).items() if name != "mine.txt"} == before
    assert main(arguments(city, out, "--overwrite", "--mesh-size", "20")) == 0
    assert f"{tasks} of {tasks} tasks ran, 0 results were there\n" in capsys.readouterr().out
    assert (out / "mine.txt").read_text() == "keep"
    assert not hashes(out).items() >= before.items()


def test_the_command_line_checks_and_tells_a_damaged_mesh(
    city: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert main(arguments(city, out)) == 0
    assert main(["check", str(out)]) == 0
    assert "everything is proved" in capsys.readouterr().out
    record = json.loads((out / "run.json").read_text())
    record["counts"]["cells"] += 1
    (out / "run.json").write_text(json.dumps(record))
    assert main(["check", str(out)]) == 1
    assert "FAULT" in capsys.readouterr().out
    assert main(["check", str(tmp_path / "none")]) == 1


def test_a_configuration_file_runs_the_same(city: Path, tmp_path: Path) -> None:
    file = city / "run.toml"
    file.write_text(
        '[input]\npointcloud = ["west.laz", "east.laz"]\nfootprints = "footprints.gpkg"\n[run]\nout = "o"\n'
    )
    assert main(["run", str(file)]) == 0
    run(make_config(values(city, tmp_path / "direct")))
    assert hashes(city / "o") == hashes(tmp_path / "direct")


def test_terrain_without_footprints_is_a_mesh(city: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    record = run(make_config(values(city, out, footprints="")))
    assert record["counts"]["buildings"] == 0
    assert any("terrain only" in message for message in record["messages"])
    assert check_run(out, StoredTerrain).ok


def test_a_cloud_without_building_class_is_told(city: Path, tmp_path: Path) -> None:
    cloud = cloud_over(BOUNDS, [(HOUSE, 10.0), (TOWER, 30.0)], ground=2.0)
    folder = tmp_path / "unclassified"
    folder.mkdir()
    write_cloud(folder / "all.laz", cloud.xyz, np.where(cloud.classification == BUILDING, 1, GROUND))
    out = tmp_path / "out"
    record = run(make_config(values(city, out, pointcloud=[str(folder)])))
    assert record["notes"]["no-building-class"]["count"] == 1
    model = json.loads((out / "citymodel.city.json").read_text())
    roofs = {thing["attributes"]["roof_height"] for thing in model["CityObjects"].values()}
    assert roofs == {10.0, 30.0}


def test_a_cloud_without_ground_class_needs_the_filter(
    city: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cloud = cloud_over(BOUNDS, [(HOUSE, 10.0)], ground=2.0)
    write_cloud(tmp_path / "raw.laz", cloud.xyz, 1)
    out = tmp_path / "out"
    command = ["run", str(tmp_path / "raw.laz"), "--footprints", str(city / "footprints.gpkg"), "--out", str(out)]
    assert main(command) == 1
    assert "--ground-filter" in capsys.readouterr().err
    assert json.loads((out / "run.json").read_text())["status"] == "failed"
    assert main(["check", str(out)]) == 1
    assert "the run failed (terrain: coarse grid" in capsys.readouterr().err
    assert main([*command, "--ground-filter", "--overwrite"]) == 0
    assert json.loads((out / "run.json").read_text())["notes"]["ground-filter"]["count"] == 1
    assert check_run(out, StoredTerrain).ok


def test_reprojected_footprints_give_the_same_buildings(city: Path, tmp_path: Path) -> None:
    import pyproj

    transform = pyproj.Transformer.from_crs("EPSG:3006", "EPSG:4326", always_xy=True).transform
    moved = [shapely.transform(house, transform, interleaved=False) for house in (HOUSE, TOWER)]
    degrees = write_houses(tmp_path / "degrees.geojson", moved, crs="EPSG:4326")
    out = tmp_path / "out"
    record = run(make_config(values(city, out, footprints=str(degrees))))
    assert record["counts"]["buildings"] == 2
    model = json.loads((out / "citymodel.city.json").read_text())
    roofs = {thing["attributes"]["roof_height"] for thing in model["CityObjects"].values()}
    assert roofs == {10.0, 30.0}


def test_parameters_without_effect_are_told(
    city: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments(city, tmp_path / "out", "--layer-height", "4")) == 0
    assert "layer_height = 4.0 has no effect: it counts with mesher = layered" in capsys.readouterr().out
    assert main(arguments(city, tmp_path / "two", "--layer-height", "4", "--mesher", "layered")) == 0
    assert "no effect" not in capsys.readouterr().out


def test_a_region_beyond_the_clouds_is_told(city: Path, tmp_path: Path) -> None:
    bounds = [318050.0, 6399000.5, 318150.0, 6399099.0]
    record = run(make_config(values(city, tmp_path / "out", bounds=bounds)))
    (message,) = [text for text in record["messages"] if "beyond" in text]
    # The easternmost points lie at 318099.75.
    assert "(50.2 m east)" in message or "(50.3 m east)" in message
    assert check_run(tmp_path / "out", StoredTerrain).ok


def test_a_mistyped_input_leaves_the_earlier_result(city: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert main(arguments(city, out)) == 0
    before = hashes(out)
    assert main(["run", str(city / "none.laz"), "--out", str(out), "--overwrite"]) == 1
    assert hashes(out) == before
    assert json.loads((out / "run.json").read_text())["status"] == "done"


def test_a_failed_run_may_be_repeated_and_foreign_folders_are_left_alone(city: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert main(["run", str(city / "none.laz"), "--out", str(out)]) == 1
    assert main(arguments(city, out)) == 0
    foreign = tmp_path / "foreign"
    (foreign / "mesh").mkdir(parents=True)
    (foreign / "mesh" / "mine.txt").write_text("keep")
    assert main(arguments(city, foreign, "--overwrite")) == 2
    assert (foreign / "mesh" / "mine.txt").read_text() == "keep"


def test_errors_in_workers_are_one_message_too(
    city: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    tall_tower(city)
    assert main(arguments(city, tmp_path / "out", "--workers", "1")) == 1
    captured = capfd.readouterr()
    assert "--domain-height" in captured.err
    assert "Traceback" not in captured.err + captured.out


def test_buildings_in_the_cloud_without_footprints_end_with_three(city: Path, tmp_path: Path) -> None:
    far = write_houses(tmp_path / "far.gpkg", [shapely.box(0, 0, 9, 9)])
    command = ["run", str(city), "--footprints", str(far), "--out", str(tmp_path / "out")]
    assert main(command) == 1
    assert main([*command, "--allow-empty"]) == 3
    record = json.loads((tmp_path / "out" / "run.json").read_text())
    assert record["notes"]["no-footprints-in-region"]["count"] == 1


@pytest.mark.parametrize("size", ["20", pytest.param("40", marks=pytest.mark.long)])
def test_coarse_meshes_keep_exact_roofs(tmp_path: Path, size: str) -> None:
    """A real block: roofs closer than the least spacing are grouped and raised before they are meshed."""
    block = Path(__file__).resolve().parents[2] / "tiler" / "demo_block"
    out = str(tmp_path / "out")
    command = ["run", str(block / "cloud.laz"), "--footprints", str(block / "footprints.geojson"), "--out", out]
    assert main([*command, "--mesh-size", size]) == 0
    assert main(["check", out]) == 0


def test_heights_by_attribute(city: Path, tmp_path: Path) -> None:
    cloud = cloud_over(BOUNDS, [], ground=2.0)
    write_cloud(tmp_path / "bare.laz", cloud.xyz, cloud.classification)
    tall = write_houses(tmp_path / "tall.gpkg", [HOUSE, TOWER], storeys=[7.5, np.nan])
    out = tmp_path / "out"
    config = values(
        city, out, pointcloud=[str(tmp_path / "bare.laz")], footprints=str(tall), height_attribute="storeys"
    )
    record = run(make_config(config))
    model = json.loads((out / "citymodel.city.json").read_text())["CityObjects"]
    assert model["b0"]["attributes"]["roof_height"] == 9.5
    assert model["b1"]["attributes"]["roof_height"] == 8.0
    assert record["notes"]["building-roof-from-attribute"]["count"] == 1
    assert record["notes"]["building-roof-from-default"]["items"][0]["subject"] == "b1"


def truncated(city: Path) -> None:
    data = (city / "west.laz").read_bytes()
    (city / "west.laz").write_bytes(data[: len(data) // 2])


def without_its_end(city: Path) -> None:
    """Damage in the table of chunks."""
    data = bytearray((city / "west.laz").read_bytes())
    data[-2000:-20] = bytes(1980)
    (city / "west.laz").write_bytes(bytes(data))


def with_a_gap(city: Path) -> None:
    """Damage that shows only when the points are decompressed, the table of chunks being whole."""
    data = bytearray((city / "west.laz").read_bytes())
    middle = len(data) // 2
    data[middle : middle + 5000] = bytes(5000)
    (city / "west.laz").write_bytes(bytes(data))


def absurd_header(city: Path) -> None:
    data = bytearray((city / "west.laz").read_bytes())
    data[131:139] = np.float64(np.nan).tobytes()
    (city / "west.laz").write_bytes(bytes(data))


def no_points(city: Path) -> None:
    for name in ("west.laz", "east.laz"):
        write_cloud(city / name, np.empty((0, 3)), 2)


def tall_tower(city: Path) -> None:
    cloud = cloud_over(BOUNDS, [(HOUSE, 10.0), (TOWER, 302.0)], ground=2.0)
    (city / "east.laz").unlink()
    write_cloud(city / "west.laz", cloud.xyz, cloud.classification)


def text_cloud(city: Path) -> None:
    (city / "west.laz").write_text("hello")


def text_footprints(city: Path) -> None:
    (city / "footprints.gpkg").write_text("hello")


def astray_point(city: Path) -> None:
    cloud = cloud_over(BOUNDS, [(HOUSE, 10.0)], ground=2.0)
    write_cloud(city / "west.laz", np.vstack((cloud.xyz, [[918000.0, 6399000.0, 3.0]])), 2)


def nothing(_: Path) -> None:
    """Leave the city as it is."""


CASES: list[tuple[str, Callable[[Path], None], list[str], int, str]] = [
    ("missing cloud", lambda city: (city / "west.laz").unlink(), ["{city}/west.laz"], 1, "west.laz"),
    ("truncated", truncated, [], 1, "west.laz"),
    ("damaged inside", without_its_end, [], 1, "west.laz"),
    ("NaN in header", absurd_header, [], 1, "west.laz"),
    ("a point astray", astray_point, [], 1, "west.laz: its header spans 600 km"),
    ("no points", no_points, [], 1, "hold no point"),
    ("text for a cloud", text_cloud, [], 1, "west.laz"),
    ("missing footprints", lambda city: (city / "footprints.gpkg").unlink(), [], 1, "footprints.gpkg"),
    ("text for footprints", text_footprints, [], 1, "footprints"),
    ("another CRS", nothing, ["--crs", "EPSG:28992"], 1, "28992"),
    ("geographic CRS", nothing, ["--crs", "EPSG:4326"], 1, "4326"),
    ("no CRS at all", nothing, ["--crs", "EPSG:99999999"], 2, "99999999"),
    ("bounds elsewhere", nothing, ["--bounds", "0", "0", "100", "100"], 1, "no point cloud there"),
    ("tiles of a few cells", nothing, ["--tile-size", "50"], 2, "--tile-size 140"),
    ("tower over the domain", tall_tower, [], 1, "--domain-height"),
    ("unknown attribute", nothing, ["--id-attribute", "nope"], 2, "nope"),
    ("mesh size 0", nothing, ["--mesh-size", "0"], 2, "must be at least"),
    ("clearance of a kilometre", nothing, ["--clearance", "1000", "--allow-empty"], 0, ""),
]


@pytest.mark.parametrize(
    ("mend", "options", "code", "text"), [case[1:] for case in CASES], ids=[c[0] for c in CASES]
)
def test_bad_input_ends_in_one_clear_message(
    city: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    mend: Callable[[Path], None],
    options: list[str],
    code: int,
    text: str,
) -> None:
    mend(city)
    clouds = [option.format(city=city) for option in options if option.startswith("{city}")]
    options = [option for option in options if not option.startswith("{city}")]
    command, *others = arguments(city, tmp_path / "out", *options)
    assert main([command, *clouds, *others]) == code
    captured = capsys.readouterr()
    assert "Traceback" not in captured.err
    if code:
        assert text in captured.err
        assert captured.err.startswith("citystitch: ")
        assert len(captured.err.strip().splitlines()) == 1
        assert not (tmp_path / "out" / "mesh.pvtu").exists()


@pytest.mark.parametrize("damage", [truncated, without_its_end, with_a_gap])
def test_skip_unreadable_leaves_a_file_out_and_ends_with_three(
    city: Path, tmp_path: Path, damage: Callable[[Path], None]
) -> None:
    damage(city)
    out = tmp_path / "out"
    assert main(arguments(city, out, "--skip-unreadable")) == 3
    record = json.loads((out / "run.json").read_text())
    assert list(record["unreadable"]) == [str(city / "west.laz")]
    assert check_run(out, StoredTerrain).ok


def test_an_unwritable_folder_is_wrong_usage(
    city: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("")
    assert main(arguments(city, tmp_path / "file")) == 2
    assert "is a file" in capsys.readouterr().err
    locked = tmp_path / "locked"
    locked.mkdir()
    locked.chmod(stat.S_IRUSR | stat.S_IXUSR)
    if not os.access(locked, os.W_OK):
        assert main(arguments(city, locked / "out")) == 2
        assert "cannot be written" in capsys.readouterr().err
    assert main(arguments(city, Path("/proc/citystitch"))) == 2
    assert "cannot be written" in capsys.readouterr().err


def test_errors_show_their_place_in_the_code_on_request(city: Path, tmp_path: Path) -> None:
    with pytest.raises(CityError):
        main(arguments(city, tmp_path / "out", "--traceback", "--bounds", "0", "0", "90", "90"))


def test_wrong_usage_ends_with_two(capsys: pytest.CaptureFixture[str]) -> None:
    for command in ([], ["run", "--no-such"], ["runn"]):
        with pytest.raises(SystemExit) as stop:
            main(command)
        assert stop.value.code == 2
    assert main(["run"]) == 2
    assert "no point cloud" in capsys.readouterr().err


def test_paraviews_readers_find_the_numbers_of_the_record(city: Path, tmp_path: Path) -> None:
    from vtkmodules.vtkIOXML import vtkXMLPPolyDataReader, vtkXMLPUnstructuredGridReader

    out = tmp_path / "out"
    counts = run(make_config(values(city, out)))["counts"]
    for reader, name, cells in (
        (vtkXMLPUnstructuredGridReader(), "mesh.pvtu", counts["cells"]),
        (vtkXMLPPolyDataReader(), "boundary.pvtp", counts["facets"]),
    ):
        grid = read_vtk(reader, out / name).GetOutput()
        assert grid.GetNumberOfCells() == cells
        if name == "mesh.pvtu":
            assert grid.GetNumberOfPoints() == counts["points"]
        else:
            arrays = grid.GetCellData()
            assert [arrays.GetArrayName(k) for k in range(arrays.GetNumberOfArrays())] == ["marker", "building"]


@pytest.mark.long
@pytest.mark.shared
def test_real_data_with_finite_elements_is_the_same_city(shared_data: Path, tmp_path: Path) -> None:
    """Amsterdam with `--smoother fem`: proved, and within centimetres of the fast path."""
    config = {
        "pointcloud": [str(shared_data / "amsterdam" / "tiles")],
        "footprints": str(shared_data / "amsterdam" / "footprints.shp"),
        "bounds": [120700.0, 486000.0, 121000.0, 486300.0],
    }
    columns = {}
    for smoother in ("columns", "fem"):
        out = tmp_path / smoother
        run(make_config(config | {"out": str(out), "smoother": smoother}))
        assert check_run(out, StoredTerrain).ok
        store = Store(out / "store.zarr")
        columns[smoother] = read_columns(store, store.names("columns")[0])[0]
    difference = np.abs(columns["columns"].z - columns["fem"].z)
    assert difference.mean() < 0.05


@pytest.mark.long
@pytest.mark.parametrize("seed", rounds(range(2), range(2, 20)))
def test_random_cities_are_meshed_and_proved(tmp_path: Path, seed: int) -> None:
    """Synthetic cities of any density and relief, from files to files."""
    rng = np.random.default_rng(seed)
    buildings, relief = int(rng.integers(20, 400)), float(rng.uniform(0, 60))
    city = city_files(tmp_path / "city", size=500, buildings=buildings, density=1.0, relief=relief, seed=seed)
    config = city | {
        "out": str(tmp_path / "out"),
        "domain_height": 160.0,
        "mesh_size": float(rng.choice([6.0, 10.0, 15.0])),
        "layer_height": float(rng.choice([4.0, 10.0])),
        "border": str(rng.choice(["drop", "clip"])),
        "simplify": str(rng.choice(["clearance", "paper"])),
        "mesher": str(rng.choice(["adaptive", "layered"])),
    }
    record = run(make_config(config))
    report = check_run(tmp_path / "out", StoredTerrain)
    assert report.ok, report.lines()
    counts, way = record["counts"], f"{config['mesher']}, {config['simplify']}"
    assert counts["buildings"] > 0
    keep_outcome("cities", seed=seed, way=way, **{what: counts[what] for what in ("tiles", "buildings", "cells")})


PAPER = {"simplify": "paper", "mesher": "layered", "roof_height": "percentile"}
QUARTER = {"bounds": [120_700.0, 486_000.0, 121_000.0, 486_300.0]}
LONG = pytest.mark.long
FLAT = {"roofs": "flat"}
REAL = [
    ("amsterdam_west_small", "amsterdam_west_small/footprints.gpkg", {}, 300),
    pytest.param("amsterdam_west_small", "amsterdam_west_small/footprints.gpkg", PAPER, 25, marks=LONG),
    pytest.param("amsterdam", "amsterdam/footprints.shp", {}, 1400, marks=LONG),
    pytest.param("amsterdam_no_building_class", "amsterdam/footprints.shp", QUARTER, 300, marks=LONG),
    pytest.param("amsterdam", "amsterdam/footprints.shp", {"manifold": True} | FLAT, 1400, marks=LONG),
    pytest.param(
        "amsterdam",
        "amsterdam/footprints.shp",
        QUARTER | {"mesher": "layered", "layer_height": 5.0},
        300,
        marks=LONG,
    ),
    pytest.param("amsterdam_no_building_class", "amsterdam/footprints.shp", PAPER, 40, marks=LONG),
]


@pytest.mark.shared
@pytest.mark.parametrize(("clouds", "footprints", "options", "buildings"), REAL)
def test_real_data_gives_a_mesh_that_its_check_proves(
    shared_data: Path, tmp_path: Path, clouds: str, footprints: str, options: dict[str, Any], buildings: int
) -> None:
    config = {
        "pointcloud": [str(shared_data / clouds / "tiles")],
        "footprints": str(shared_data / footprints),
        "out": str(tmp_path / "out"),
        "crs": "EPSG:28992",
    }
    record = run(make_config(config | options))
    report = check_run(tmp_path / "out", StoredTerrain)
    assert report.ok, report.lines()
    assert record["counts"]["building parts"] >= buildings
    assert record["counts"]["cells"] > 100_000
    if options.get("manifold"):
        # What is left are roofs that touch crosswise over lower ones: their houses share walls in the plan.
        assert record["counts"]["planar corner-touches"] == 0
        assert report.facts["non_manifold_edges"] < 50
    ratio, angle = record["quality"]["radius_ratio"], record["quality"]["min_dihedral"]
    if clouds == "amsterdam" and options in (FLAT, QUARTER | FLAT):
        # What the design asks of real blocks, with room for the machine's last digit.
        bounds = {"0": 0.22, "0.1": 0.42, "1": 0.50, "5": 0.58, "50": 0.78}
        assert all(ratio[p] >= bound for p, bound in bounds.items()), ratio
        assert angle["0"] >= 9.0
        assert record["fidelity"]["outline"]["min_clearance"] >= 1.0
        assert record["fidelity"]["outline"]["area_error"] <= 0.008
        assert record["fidelity"]["roof"]["rmse"] < 3.4
    if clouds == "amsterdam" and options in ({}, QUARTER):
        bounds = {"0": 0.15, "1": 0.53, "50": 0.78}
        assert all(ratio[p] >= bound for p, bound in bounds.items()), ratio
        assert record["fidelity"]["outline"]["min_clearance"] >= 1.0
        assert record["fidelity"]["outline"]["area_error"] <= 0.009
        assert record["fidelity"]["roof"]["p50"] < 0.13
        assert record["fidelity"]["roof"]["rmse"] < 3.1


@pytest.mark.long
@pytest.mark.usefixtures("small_pictures")
def test_the_demo_makes_two_meshes_and_three_pictures(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["demo", "--out", str(tmp_path), "--size", "300", "--buildings", "15"]) == 0
    assert capsys.readouterr().out.count("everything is proved") == 2
    record = json.loads((tmp_path / "result" / "run.json").read_text())
    assert (len(record["tiles"]), record["parameters"]["workers"]) == (4, 2)
    for picture in ("demo.png", "tiles.png", "block.png"):
        assert (tmp_path / picture).stat().st_size > 10_000
