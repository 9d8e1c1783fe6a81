"""A tileset that follows the edits of its run: the bytes of a whole export, and few cells made anew."""

import shutil
from pathlib import Path

import pytest
from shapely import affinity

import tiler
from tests.tiler.editing.test_edit import read_input, write
from tiler.export.export import export_run
from tiler.mesh_files.run_files import find_files
from tiler.tiles3d import cells
from tiler.tiles3d.update import MADE, TILES, update_tileset


def read_all(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_an_updated_tileset_has_the_bytes_of_a_whole_one(
    sloped_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cells, "STEP", cells.STEP / 4)  # 76 m: some cells are far from the edit
    city, view = shutil.copytree(sloped_run, tmp_path / "city"), tmp_path / "view"
    n_cells = update_tileset(view, find_files(city))
    export_run(city, tmp_path / "first", name="3dtiles")
    before = read_all(view / TILES)
    assert before == read_all(tmp_path / "first")
    assert len([path for path in before if path.endswith(".glb")]) == n_cells > 3
    assert update_tileset(view, find_files(city)) == 0

    houses = read_input(sloped_run)
    (gone, _), (moved, shape), *_ = sorted(houses.items(), key=lambda one: sum(one[1].bounds))  # in one corner
    new = write(tmp_path / "new.gpkg", affinity.scale(shape, 0.7, 0.9), ids=["x"])
    tiler.open(city).remove(gone).replace(moved, new)
    files = find_files(city)
    n_few = update_tileset(view, files, merging_level=1.1)  # nothing goes up from the smallest cells
    held = read_all(view / TILES)
    differing = {path for path in held if path.endswith("glb") and held[path] != before.get(path)}
    depth = max(int(path.split("/")[1]) for path in held if path.endswith("glb"))
    assert {int(path.split("/")[1]) for path in differing} == {depth}
    assert update_tileset(view, files, merging_level=0.03) == 0  # of no new edit
    n_made = n_few + update_tileset(view, files)
    export_run(city, tmp_path / "second", name="3dtiles")
    after = read_all(view / TILES)
    assert after == read_all(tmp_path / "second")
    assert len([path for path in after if after[path] != before.get(path)]) > 0
    assert n_few < n_made < n_cells
    assert not list((view / MADE).glob("late/*/*/*"))
    again = shutil.copytree(view, tmp_path / "again")
    shutil.rmtree(again)
    update_tileset(again, find_files(city))
    assert read_all(again / MADE) == read_all(view / MADE)

    (view / MADE / "state.json").unlink()  # as a kill leaves it
    assert update_tileset(view, find_files(city)) == n_cells
