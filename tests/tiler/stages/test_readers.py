"""Points that stages read of each other: boxes, classes and files that mark no building, by hand."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import shapely

from pipeline.data.classes import BUILDING, GROUND, HIGH_VEGETATION, UNCLASSIFIED, WATER
from pipeline.geometry.inside import are_covered, cover_polygons
from tests.helpers.tiles import make_town, run_of, write_town
from tiler.stages.readers import read_bands, read_cloud
from tiler.store.store import Store

Rows = list[tuple[int, int, int, int]]  # x, y, z in centimetres, and class


def a_task(**files: tuple[Rows, bool]) -> Any:
    """Task that reads files of one cell each: rows, and whether the file marks buildings; none is unreadable."""
    facts = {
        name: {"unreadable": not file[0], "scale": (0.01,) * 3, "offset": (0.0,) * 3, "marks_buildings": file[1]}
        for name, file in files.items()
    }

    def read(stage: str, name: str, names: tuple[str, ...]) -> tuple[dict[str, Any], None]:
        end = np.array([len(files[name][0])])
        return {"cell": np.array([[0, 0]]), "cell_row": np.array([0]), "block": np.array([0, 1]), "end": end}, None

    def read_ranges(
        stage: str, name: str, names: tuple[str, ...], ranges: list[tuple[int, int]]
    ) -> dict[str, Any]:
        rows = np.concatenate([np.array(files[name][0])[first:stop] for first, stop in ranges])
        return {"units": rows[:, :3].astype(np.int32), "classification": rows[:, 3].astype(np.uint8)}

    store = SimpleNamespace(attributes=lambda stage, name: {"facts": facts[name]}, read=read)
    context = SimpleNamespace(bounds=(0.0, 0.0, 64.0, 64.0))
    return SimpleNamespace(refs={"points": tuple(files)}, store=store, context=context, read_ranges=read_ranges)


MARKED: Rows = [(100, 200, 300, BUILDING), (6300, 0, 5, GROUND), (400, 0, 6, UNCLASSIFIED), (0, 0, 7, WATER)]
UNMARKED: Rows = [(0, 300, 8, UNCLASSIFIED), (0, 400, 9, HIGH_VEGETATION), (0, 500, 10, GROUND), (0, 0, 11, 255)]
BOX = (0.0, 0.0, 10.0, 10.0)


def test_only_points_of_the_classes_in_the_box_are_read() -> None:
    task = a_task(a=(MARKED, True), b=([], True), c=(UNMARKED, False))
    cloud = read_cloud(task, BOX, classes=(BUILDING, WATER))
    expected = [[1, 2, 3], [0, 0, 0.07], [0, 3, 0.08], [0, 0, 0.11]]
    assert cloud.xyz.tolist() == [pytest.approx(place) for place in expected]
    assert cloud.classification.tolist() == [BUILDING, WATER, BUILDING, BUILDING]
    assert read_cloud(task, BOX, classes=(GROUND,)).xyz[:, 2] == pytest.approx([0.1])
    assert read_cloud(task, BOX).classification.tolist() == [
        *(BUILDING, UNCLASSIFIED, WATER),
        *(BUILDING, HIGH_VEGETATION, GROUND, BUILDING),
    ]
    assert len(read_cloud(a_task(b=([], True)), BOX, classes=(GROUND,)).xyz) == 0


def test_the_filter_finds_ground_before_classes_are_chosen() -> None:
    """Low points of any class are ground; what stands over them, and was ground, is not."""
    flat = [(100 * i, 100 * j, 0, HIGH_VEGETATION) for i in range(64) for j in range(64)]
    above = [(510, 510, 400, GROUND), (620, 620, 400, BUILDING), (6010, 6010, 400, GROUND)]
    for marked, roofs in ((True, [BUILDING]), (False, [BUILDING] * 2)):
        task = a_task(a=(flat + above, marked))
        assert len(read_cloud(task, BOX, classes=(GROUND,), ground_filter=True).xyz) == 11 * 11
        cloud = read_cloud(task, BOX, classes=(BUILDING,), ground_filter=True)
        assert cloud.classification.tolist() == roofs
        assert (cloud.xyz[:, 2] == 4.0).all()


@pytest.mark.parametrize("ground_filter", [False, True])
def test_bands_have_all_points_in_order_and_no_more_rows_than_they_may(
    monkeypatch: pytest.MonkeyPatch, ground_filter: bool
) -> None:
    rng = np.random.default_rng(3)
    low, high = [0, 0, 0, 1], [6300, 6300, 900, 7]
    files = [[tuple(row) for row in rng.integers(low, high, (n, 4)).tolist()] for n in (5, 61, 1, 40)]
    task = a_task(a=(files[0], True), b=(files[1], False), c=(files[2], True), d=([], True), e=(files[3], True))
    box = (0.0, 0.0, 50.0, 50.0)
    options: dict[str, Any] = {"classes": (BUILDING, GROUND), "ground_filter": ground_filter}
    (whole,) = read_bands(task, box, **options)
    read: list[list[tuple[int, int]]] = []
    inner = task.read_ranges

    def watch(stage: str, name: str, names: tuple[str, ...], ranges: list[tuple[int, int]]) -> dict[str, Any]:
        read.append(ranges)
        return dict(inner(stage, name, names, ranges))

    task.read_ranges = watch
    for chunk, most in ((4, 12), (7, 7), (3, 100), (1, 2)):
        monkeypatch.setattr("tiler.stages.readers.CHUNK_ROWS", chunk)
        monkeypatch.setattr("tiler.stages.readers.BAND", most)
        bands = list(read_bands(task, box, **options))
        assert len(bands) >= 107 / most
        assert np.concatenate([band.xyz for band in bands]).tobytes() == whole.xyz.tobytes()
        assert np.concatenate([band.classification for band in bands]).tobytes() == whole.classification.tobytes()
        assert read_cloud(task, box, **options).xyz.tobytes() == whole.xyz.tobytes()
        ends = [stop for ranges in read for _, stop in ranges]
        assert all(sum(stop - first for first, stop in ranges) <= most for ranges in read)
        assert all(stop % chunk == 0 or stop in {5, 61, 1, 40} for stop in ends)
        read.clear()


def test_points_may_be_cut_to_a_cover() -> None:
    cover = cover_polygons(np.array([shapely.box(0.5, 1.5, 1.5, 2.5)]))
    task = a_task(a=(MARKED, True), c=(UNMARKED, False))
    cloud = read_cloud(task, BOX, cover=cover)
    assert cloud.xyz[:, 2].tolist() == pytest.approx([3.0, 0.07, 0.08, 0.11])
    assert cloud.classification.tolist() == [BUILDING, WATER, BUILDING, BUILDING]
    filtered = read_cloud(task, BOX, ground_filter=True)
    near = are_covered(cover, filtered.xyz)
    assert 0 < np.count_nonzero(near) < len(near)
    cut = read_cloud(task, BOX, ground_filter=True, cover=cover)
    assert cut.xyz.tolist() == filtered.xyz[near].tolist()
    assert cut.classification.tolist() == filtered.classification[near].tolist()


def run_store(values: dict[str, Any], out: Path) -> Store:
    run_of(values, out, workers=0)
    return Store(out / "store.zarr")


def test_stages_give_the_same_whatever_the_bands(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    region = (318_000.0, 6_399_000.0, 318_100.0, 6_399_100.0)
    town = make_town(region, [shapely.box(318_030, 6_399_030, 318_050, 6_399_060)], relief=3)
    values = write_town(tmp_path / "city", town, files=(2, 1)) | {"domain_height": 40.0, "bounds": region}
    found = []
    for rows in (1 << 20, 100):
        monkeypatch.setattr("tiler.stages.readers.CHUNK_ROWS", rows)
        monkeypatch.setattr("tiler.stages.readers.BAND", 3 * rows)
        store = run_store(values, tmp_path / str(rows))
        stages = ("ground", "houses", "model", "fit")
        found.append([store.describe(stage, name) for stage in stages for name in store.names(stage)])
    assert found[0] == found[1]
    assert len(found[0]) == 4
