"""Tiles that fail in a run: the hole, what is said of it, and the same bytes once it is mended."""

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyogrio
import pytest

from pipeline.data.errors import CityError, ConfigError
from pipeline.data.mesh import Marker
from tests.helpers.faults import Faults, injected, raises, segfaults
from tests.helpers.towns import Town, make_town
from tests.runs.test_run import hashes
from tiler.check.check import check_run
from tiler.cli.main import main
from tiler.config.config import make_config
from tiler.engine.task import Task
from tiler.interface.synth import write_city
from tiler.mesh_files.vtk_files import read_vtp, read_vtu
from tiler.store.results import StoredTerrain
from tiler.workflow.run import run
from tiler.workflow.single_tile import run_alone

SIZE = 420.0  # m: 9 tiles


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Town:
    return make_town(tmp_path_factory.mktemp("town"), size=SIZE, buildings=40)


def named(town: Town, i: int, j: int) -> str:
    """Name of the tile in column i and row j."""
    columns, rows = (sorted({int(name.split("_")[k]) for name in town.record["tiles"]}) for k in (0, 1))
    return f"{columns[i]}_{rows[j]}"


def run_with(faults: Faults, town: Town, out: Path, **others: Any) -> dict[str, Any]:
    with injected(faults):
        return run(town.config(out, **others))


def finished_but(town: Town, out: Path, stage: str, name: str) -> Path:
    """Copy the finished run without one result, so that little but that is computed again."""
    shutil.copytree(town.out, out)
    (out / "store.zarr" / stage / f"{name}.zip").unlink()
    return out


def missing_facets(out: Path, tile: str) -> int:
    return int((read_vtp(out / "boundary" / f"{tile}.vtp").boundary.marker == Marker.MISSING).sum())


def prove_hole(town: Town, out: Path, record: dict[str, Any], *tiles: str) -> None:
    """The rest is there, conforming, and says what is missing; mended, it is as if nothing had been."""
    assert record["exit_code"] == 3
    assert set(record["missing"]) == set(tiles)
    assert record["counts"]["tiles missing"] == len(tiles)
    assert set(record["tiles"]) == set(town.record["tiles"]) - set(tiles)
    assert {path.stem for path in (out / "mesh").iterdir()} == set(record["tiles"])
    report = check_run(out, StoredTerrain)
    assert report.ok, "\n".join(report.lines())
    assert report.facts["missing_facets"] > 0
    healed = run(town.config(out))
    assert healed["exit_code"] == 0
    assert healed["missing"] == {}
    assert hashes(out) == hashes(town.out)


def test_a_tile_that_cannot_be_meshed_leaves_a_hole(town: Town, tmp_path: Path) -> None:
    tile, out = named(town, 1, 1), tmp_path / "out"
    record = run_with({"columns": {tile: raises}}, town, out)
    found = record["missing"][tile]
    assert found["reason"] == "ZeroDivisionError: a fault on purpose"
    assert "in raises" in found["trace"]
    assert (found["stage"], found["name"], found["attempts"]) == ("columns", tile, 2)
    assert found["inputs"]["terrain"]
    beside = named(town, 0, 1)
    assert missing_facets(out, beside) > 0 == missing_facets(town.out, beside)
    # Seams are as they were: the cells beside the hole are those of the whole mesh.
    volume, whole = (read_vtu(folder / "mesh" / f"{beside}.vtu") for folder in (out, town.out))
    np.testing.assert_array_equal(volume.mesh.points, whole.mesh.points)
    np.testing.assert_array_equal(volume.mesh.cells, whole.mesh.cells)
    prove_hole(town, out, record, tile)


def test_a_seam_that_fails_takes_its_two_tiles(town: Town, tmp_path: Path) -> None:
    seam = f"y{named(town, 1, 2)}"
    out = finished_but(town, tmp_path / "out", "seams", seam)
    record = run_with({"seams": {seam: raises}}, town, out)
    one, other = named(town, 0, 2), named(town, 1, 2)
    assert {(found["stage"], found["name"]) for found in record["missing"].values()} == {("seams", seam)}
    prove_hole(town, out, record, one, other)


@pytest.mark.parametrize("stage", [pytest.param("ground", marks=pytest.mark.long), "shapes-0"])
def test_a_tile_that_fails_before_there_is_a_city_model_is_as_absent(
    stage: str, town: Town, tmp_path: Path
) -> None:
    tile = named(town, 1, 1)
    out = finished_but(town, tmp_path / "out", stage, tile)
    record = run_with({stage: {tile: raises}}, town, out)
    assert record["region"]["absent"] == []
    prove_hole(town, out, record, tile)


def test_what_a_hole_does_not_touch_has_its_result(tmp_path: Path) -> None:
    write_city(tmp_path / "city", size=SIZE, buildings=40, density=0.5, relief=5, seed=3)
    strip = Town(tmp_path / "city", tmp_path / "out")
    west, south, _, _ = pyogrio.read_info(tmp_path / "city" / "footprints.gpkg")["total_bounds"]
    small = {"tile_size": 70.0, "mesh_size": 5.0, "bounds": [west, south, west + 400, south + 100]}
    whole = run(strip.config(strip.out, **small))
    assert whole["exit_code"] == 0
    columns = sorted({int(name.split("_")[0]) for name in whole["tiles"]})
    rows = sorted({int(name.split("_")[1]) for name in whole["tiles"]})
    corner, far = f"{columns[0]}_{rows[0]}", f"{columns[-1]}_{rows[-1]}"
    redone: set[tuple[str, str]] = set()

    def watch(task: Task) -> None:
        redone.add((task.stage, task.name))

    watched: dict[str, dict[str, Callable[[Task], None]]] = {
        stage: dict.fromkeys(whole["tiles"], watch) for stage in ("terrain", "houses", "columns")
    }
    watched["flooded"] = {corner: raises}
    (strip.out / "store.zarr" / "flooded" / f"{corner}.zip").unlink()
    record = json.loads((strip.out / "run.json").read_text())
    (strip.out / "run.json").write_text(json.dumps(record | {"status": "running"}))
    record = run_with(watched, strip, strip.out, **small)
    assert set(record["missing"]) == {corner}, [found["reason"] for found in record["missing"].values()]
    assert ("houses", f"{columns[1]}_{rows[0]}") in redone
    assert not {(stage, far) for stage in watched} & redone


@pytest.mark.long
def test_a_file_that_cannot_be_read_takes_the_tiles_below_it(tmp_path: Path) -> None:
    write_city(tmp_path / "city", size=1000.0, buildings=20, density=0.3, relief=5, seed=3)
    town = Town(tmp_path / "city", tmp_path / "whole")
    values = {"tile_size": 500.0, "mesh_size": 30.0}
    whole = run(town.config(town.out, **values))
    clouds = sorted((town.folder / "tiles").iterdir())
    assert len(clouds) == 4
    content, state = clouds[0].read_bytes(), clouds[0].stat()
    middle = len(content) // 2
    clouds[0].write_bytes(content[:middle] + bytes(1000) + content[middle + 1000 :])
    out = tmp_path / "out"
    record = run(town.config(out, **values))
    assert record["exit_code"] == 3
    assert len(record["missing"]) == 1
    assert all(clouds[0].name in found["reason"] for found in record["missing"].values())
    assert check_run(out, StoredTerrain).ok
    clouds[0].write_bytes(content)
    os.utime(clouds[0], ns=(state.st_atime_ns, state.st_mtime_ns))
    assert run(town.config(out, **values))["exit_code"] == 0
    assert hashes(out) == hashes(town.out)
    assert set(record["missing"]) < set(whole["tiles"])


def test_where_nothing_is_left_the_run_has_failed(town: Town, tmp_path: Path) -> None:
    everywhere = dict.fromkeys(town.record["tiles"], raises)
    for stage, title in {"ground": "terrain: means of ground points", "columns": "mesh: columns of cells"}.items():
        with pytest.raises(CityError, match=rf"{title}, tile .*ZeroDivisionError: a fault on purpose"):
            run_with({stage: everywhere}, town, tmp_path / stage)
        assert json.loads((tmp_path / stage / "run.json").read_text())["status"] == "failed"


def test_crashes_of_workers_leave_a_hole(town: Town, tmp_path: Path) -> None:
    tile = named(town, 2, 0)
    out = finished_but(town, tmp_path / "out", "columns", tile)
    record = run_with({"columns": {tile: segfaults}}, town, out, workers=2)
    assert record["missing"][tile]["kind"] == "crash"
    assert "in segfaults" in record["missing"][tile]["trace"]
    prove_hole(town, out, record, tile)


def test_a_tile_alone_is_the_tile_of_the_whole(
    town: Town, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    tile = named(town, 0, 0)
    out = finished_but(town, tmp_path / "out", "columns", tile)
    record = run_with({"columns": {tile: raises}}, town, out)
    command = record["missing"][tile]["command"].split()
    assert command[:2] == ["citystitch", "run"]
    assert command[-3:] == ["--only", tile, "--traceback"]
    with injected({"columns": {tile: raises}}), pytest.raises(ZeroDivisionError):
        main(command[1:])
    assert main(command[1:]) == 0
    piece = Path(capsys.readouterr().out.splitlines()[-1])
    assert piece.parent.parent == out / "only" / tile
    alone, whole = (read_vtu(path) for path in (piece, town.out / "mesh" / f"{tile}.vtu"))
    np.testing.assert_array_equal(alone.mesh.points, whole.mesh.points)
    np.testing.assert_array_equal(alone.mesh.cells, whole.mesh.cells)


def test_a_tile_alone_must_be_one_of_the_region(town: Town, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"--only 7_7: the region has no such tile; its tiles are "):
        run_alone(town.config(tmp_path / "out"), "7_7")


def test_the_configuration_of_a_run_is_kept(town: Town) -> None:
    from tiler.config.config_file import load_config

    assert make_config(load_config(town.out / "config.toml")) == town.config(town.out)


def test_a_piece_that_cannot_be_written_leaves_a_hole(town: Town, tmp_path: Path) -> None:
    """The columns were there: what the tiles around have written by then is written again."""
    tile = named(town, 1, 1)
    out = finished_but(town, tmp_path / "out", "pieces", tile)
    record = run_with({"pieces": {tile: raises}}, town, out)
    assert (record["missing"][tile]["stage"], record["missing"][tile]["name"]) == ("pieces", tile)
    prove_hole(town, out, record, tile)
