"""The engine: what runs, what each item reads, what is skipped, and the same bytes from any executor."""

import os
import random
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.data.errors import CityError, GeometryError, InputError
from pipeline.data.notes import Note
from tests.helpers.told import Told
from tiler.engine.engine import Engine
from tiler.engine.executor import Executor, Serial
from tiler.engine.keys import item_key, stage_digest
from tiler.engine.stage import Box, Facts, FileItem, Layout, Read, Scope, Stage
from tiler.engine.submission import Outcome
from tiler.engine.task import Record, Task
from tiler.engine.watcher import Watcher
from tiler.executors.local_cluster import local
from tiler.executors.remote_cluster import connect
from tiler.store.checksums import state_files
from tiler.store.remembered import remembering
from tiler.store.store import Store

ROOT = Path(__file__).resolve().parents[3]


def names_scale(task: Task) -> Facts:
    scale = task.parameters.scale
    return {"scale": scale.get(task.name, 2.0) if isinstance(scale, dict) else scale}


@dataclass(frozen=True)
class Toy:
    """Parameters of the toy stages."""

    scale: float = 2.0
    offset: float = 1.0
    unused: str = ""


def ingest(task: Task) -> Facts:
    points = np.random.default_rng(int(task.file)).uniform(task.box[:2], task.box[2:], (2000, 2))
    with task.step("append"):
        for part in np.split(points, [100, 1500]):
            task.append(points=part)
    task.note(Note("read", task.name, detail="toy"))
    return {"extent": [*points.min(axis=0), *points.max(axis=0)] if task.name != "f9" else None}


def terrain(task: Task) -> Facts:
    (xmin, ymin, xmax, ymax), count = task.box, 0
    for result in task.read("ingest", names=["points"]):
        x, y = result.arrays["points"].T
        count += int(((x >= xmin) & (x < xmax) & (y >= ymin) & (y < ymax)).sum())
    task.put(z=np.full(20_000, count * task.parameters.scale))
    return {"count": count}


def seam(task: Task) -> Facts:
    task.put(z=np.array([result.arrays["z"][0] for result in task.read("terrain")]))
    return {"read": list(task.refs["terrain"])}


def plane(task: Task) -> Facts:
    total = sum(float(result.arrays["z"].sum()) for result in task.read("seam"))
    task.put(z=np.array([total + task.parameters.offset]))
    task.notes([Note("plane", x=1.0, y=2.0), Note("plane")])
    return {"read": list(task.refs["seam"])}


def index(task: Task) -> Facts:
    kinds = [note.kind for result in task.read("plane", names=()) for note in result.notes]
    return {"notes": len(kinds), "sum": sum(float(result.arrays["z"][0]) for result in task.read("plane"))}


INGEST = Stage("ingest", Scope.FILE, ingest)
TERRAIN = Stage("terrain", Scope.TILE, terrain, (Read("ingest", by_extent=True),), ("scale",))
SEAM = Stage("seam", Scope.SEAM, seam, (Read("terrain"),))
PLANE = Stage("plane", Scope.TILE, plane, (Read("seam"),), ("offset",))
INDEX = Stage("index", Scope.REGION, index, (Read("plane"),))
LATE = (INDEX, TERRAIN, PLANE, SEAM)


def grid_layout(n: int = 3) -> Layout:
    """Tiles of 10 m, the seams between them, and files of two tiles each."""
    cells = [(i, j) for i in range(n) for j in range(n)]
    tiles: dict[str, Box] = {f"{i}.{j}": (10.0 * i, 10.0 * j, 10.0 * i + 10, 10.0 * j + 10) for i, j in cells}
    seams: dict[str, Box] = {}
    for i in range(1, n):
        for j in range(n):
            seams[f"x{i}.{j}"] = (10.0 * i, 10.0 * j, 10.0 * i, 10.0 * j + 10)
            seams[f"y{j}.{i}"] = (10.0 * j, 10.0 * i, 10.0 * j + 10, 10.0 * i)
    files = {f"f{k}": FileItem(str(k), (0.0, 10.0 * k, 10.0 * n, 10.0 * k + 10), f"id{k}") for k in range(n)}
    return Layout(files, tiles, seams, (0.0, 0.0, 10.0 * n, 10.0 * n))


def make(path: Path, executor: Executor | None = None, *, parameters: Any = None, **options: Any) -> Engine:
    layout = options.pop("layout", grid_layout())
    parameters, executor = parameters or Toy(), executor or Serial()
    return Engine(path / "store.zarr", layout, parameters=parameters, executor=executor, **options)


def one_at_a_time() -> Serial:
    """An executor that wants one submission in flight."""
    executor = Serial()
    executor.window = 1
    return executor


def run_all(engine: Engine) -> Engine:
    engine.run(INGEST)
    engine.run(*LATE)
    return engine


def contents(path: Path) -> dict[str, bytes]:
    return {str(p.relative_to(path)): p.read_bytes() for p in sorted(path.rglob("*")) if p.is_file()}


def rerun(engine: Engine) -> set[tuple[str, str]]:
    return {item for item, record in engine.records.items() if not record.reused}


class Shuffled(Serial):
    """Runs what was submitted in an order that chance decides, and watches how much waits."""

    def __init__(self, seed: int) -> None:
        super().__init__()
        self.random = random.Random(seed)
        self.most = 0

    def wait(self) -> tuple[int, list[Outcome | None]]:
        self.most = max(self.most, len(self._queue))
        self.random.shuffle(self._queue)
        return super().wait()


class Planned(Watcher):
    """Tells which stages have how many items."""

    def __init__(self) -> None:
        self.told: list[str] = []

    def planned(self, stage: str, scope: Scope, total: int) -> None:
        self.told.append(f"{stage} {total}")


@pytest.fixture(scope="module")
def one_worker() -> Iterator[Executor]:
    with local(1) as executor:
        yield executor


@pytest.fixture(scope="module")
def two_workers() -> Iterator[Executor]:
    with local(2) as executor:
        yield executor


@pytest.fixture(scope="module")
def serial_run(tmp_path_factory: pytest.TempPathFactory) -> Engine:
    return run_all(make(tmp_path_factory.mktemp("serial")))


def test_any_executor_and_any_order_give_the_same_bytes(
    serial_run: Engine, one_worker: Executor, two_workers: Executor, tmp_path: Path
) -> None:
    expected = contents(serial_run.store.path)
    assert len(expected) == 3 + 9 + 12 + 9 + 1  # a file a result
    executors = {"one": one_worker, "two": two_workers}
    executors |= {f"shuffled{k}": Shuffled(k) for k in range(3)}
    for name, executor in executors.items():
        engine = run_all(make(tmp_path / name, executor))
        assert contents(engine.store.path) == expected, name
        assert {k: r.facts for k, r in engine.records.items()} == {
            k: r.facts for k, r in serial_run.records.items()
        }


def test_every_scope_reads_what_meets_it(serial_run: Engine) -> None:
    facts = {item: record.facts for item, record in serial_run.records.items()}
    # Boxes are closed: a seam also touches the tiles at its ends, and a tile the seams that end at its corners.
    assert facts["seam", "x1.1"]["read"] == ["0.0", "0.1", "0.2", "1.0", "1.1", "1.2"]
    assert facts["seam", "x1.0"]["read"] == ["0.0", "0.1", "1.0", "1.1"]
    assert facts["plane", "0.0"]["read"] == ["x1.0", "x1.1", "y0.1", "y1.1"]
    assert facts["index", "region"]["notes"] == 18
    assert sum(facts["terrain", f"{i}.{j}"]["count"] for i in range(3) for j in range(3)) == 6000


@pytest.mark.parametrize(
    ("halo", "count"), [(0.0, 9), (9.999, 9), (10.0, 25), (10.001, 25), (20.0, 25), (1e9, 25)]
)
def test_halo_is_met_exactly(tmp_path: Path, halo: float, count: int) -> None:
    source = Stage("source", Scope.TILE, nothing)
    reader = Stage("reader", Scope.TILE, seen, (Read("source", halo),))
    engine = make(tmp_path, layout=grid_layout(5))
    engine.run(source, reader, items={"reader": ["2.2"]})
    assert len(engine.records["reader", "2.2"].facts["source"]) == count


def test_what_meets_in_a_corner_only_is_not_beside(tmp_path: Path) -> None:
    beside = (Read("tile", beside=True), Read("seam", beside=True))
    engine = make(tmp_path)
    engine.run(
        Stage("tile", Scope.TILE, nothing),
        Stage("seam", Scope.SEAM, nothing),
        Stage("of tile", Scope.TILE, seen, beside),
        Stage("of seam", Scope.SEAM, seen, (Read("tile", beside=True),)),
        Stage("around", Scope.TILE, seen, (Read("tile", 1.0, beside=True),)),
    )
    assert engine.records["of tile", "1.1"].facts == {
        "tile": ["0.1", "1.0", "1.1", "1.2", "2.1"],
        "seam": ["x1.1", "x2.1", "y1.1", "y1.2"],
    }
    assert engine.records["of tile", "0.0"].facts["seam"] == ["x1.0", "y0.1"]
    assert engine.records["of seam", "x1.1"].facts["tile"] == ["0.1", "1.1"]
    # Grown by a halo a box has more than a corner in common with what lies across its corners.
    assert len(engine.records["around", "1.1"].facts["tile"]) == 9


def test_of_others_by_name_only_presence_counts(tmp_path: Path) -> None:
    reader = Stage("reader", Scope.TILE, told, (Read("source", beside=True, others_by_name=True),))
    source = Stage("source", Scope.TILE, names_scale, parameters=("scale",))
    first = make(tmp_path)
    first.run(source, reader)
    other = {"2.2": 7.0}
    again = make(tmp_path, parameters=Toy(scale=other))  # type: ignore[arg-type]
    again.run(source, reader)
    changed = {name for stage, name in rerun(again) if stage == "source" and name in other}
    assert changed == {"2.2"}
    assert {name for stage, name in rerun(again) if stage == "reader"} == {"2.2"}
    layout = grid_layout()
    fewer = replace(layout, tiles={name: box for name, box in layout.tiles.items() if name != "2.2"})
    without = make(tmp_path, layout=fewer, parameters=Toy(scale=other))  # type: ignore[arg-type]
    without.run(source, reader)
    assert {name for stage, name in rerun(without) if stage == "reader"} == {"1.2", "2.1"}


def test_two_reads_of_one_stage_join_and_region_is_read_by_all(tmp_path: Path) -> None:
    reader = Stage("reader", Scope.TILE, seen, (Read("source"), Read("source", 10.0), Read("whole")))
    engine = make(tmp_path, layout=replace(grid_layout(5), bounds=(0.0, 0.0, 1.0, 1.0)))
    engine.run(Stage("source", Scope.TILE, nothing), Stage("whole", Scope.REGION, nothing), reader)
    assert len(engine.records["reader", "2.2"].facts["source"]) == 25
    assert len(engine.records["reader", "0.0"].facts["source"]) == 9
    assert all(r.facts["whole"] == ["region"] for (stage, _), r in engine.records.items() if stage == "reader")


def test_extents_decide_what_is_read(tmp_path: Path) -> None:
    files = {
        "f1": FileItem("1", (0.0, 0.0, 4.0, 4.0), ""),
        "f2": FileItem("2", (5.0, 5.0, 9.0, 9.0), ""),
        "f9": FileItem("9", (0.0, 0.0, 9.0, 9.0), ""),
    }
    layout = Layout(files, {"a": (0.0, 0.0, 5.0, 5.0), "b": (4.5, 4.5, 9.0, 9.0)}, {}, (0.0, 0.0, 9.0, 9.0))
    engine = make(tmp_path, layout=layout)
    engine.run(INGEST)
    for by_extent, expected in [(True, [["f1"], ["f2"]]), (False, [["f1", "f2", "f9"], ["f2", "f9"]])]:
        engine.run(Stage(f"reader{by_extent}", Scope.TILE, seen, (Read("ingest", by_extent=by_extent),)))
        assert [engine.records[f"reader{by_extent}", t].facts["ingest"] for t in "ab"] == expected
    engine.run(Stage("all", Scope.REGION, seen, (Read("ingest", by_extent=True),)))
    assert engine.records["all", "region"].facts["ingest"] == ["f1", "f2"]
    engine.run(Stage("far", Scope.TILE, seen, (Read("ingest", 1.0, by_extent=True),)))
    assert [engine.records["far", t].facts["ingest"] for t in "ab"] == [["f1", "f2"], ["f1", "f2"]]


def test_resume_skips_and_keeps_facts_and_notes(serial_run: Engine, tmp_path: Path) -> None:
    shutil.copytree(serial_run.store.path, tmp_path / "store.zarr")
    again = run_all(make(tmp_path))
    assert rerun(again) == set()
    for item, record in serial_run.records.items():
        other = again.records[item]
        assert (record.key, record.facts, record.notes) == (other.key, other.facts, other.notes)
    assert again.records["plane", "0.0"].notes == {"plane": 2}
    assert contents(again.store.path) == contents(serial_run.store.path)


def test_a_run_that_was_cut_short_resumes_to_the_same_bytes(serial_run: Engine, tmp_path: Path) -> None:
    def stop(stage: str, done: int, total: int, record: Record) -> None:
        if (stage, done) == ("seam", 5):
            raise KeyboardInterrupt

    engine = make(tmp_path, watcher=Told(stop))
    with pytest.raises(KeyboardInterrupt):
        run_all(engine)
    n_done = len(engine.records)
    again = run_all(make(tmp_path))
    assert len(again.records) - len(rerun(again)) == n_done
    assert contents(again.store.path) == contents(serial_run.store.path)


@pytest.mark.parametrize(
    ("change", "stages"),
    [
        ({"unused": "x"}, set()),
        ({"offset": 5.0}, {"plane", "index"}),
        ({"scale": 3.0}, {"terrain", "seam", "plane", "index"}),
    ],
)
def test_a_parameter_reruns_what_declares_it_and_what_reads_that(
    serial_run: Engine, tmp_path: Path, change: dict[str, Any], stages: set[str]
) -> None:
    shutil.copytree(serial_run.store.path, tmp_path / "a" / "store.zarr")
    partial = run_all(make(tmp_path / "a", parameters=replace(Toy(), **change)))
    assert {stage for stage, _ in rerun(partial)} == stages
    assert len(rerun(partial)) == sum(stage in stages for stage, _ in partial.records)
    whole = run_all(make(tmp_path / "b", parameters=replace(Toy(), **change)))
    assert contents(partial.store.path) == contents(whole.store.path)


def test_a_changed_file_reruns_its_readers_only(serial_run: Engine, tmp_path: Path) -> None:
    layout = grid_layout()
    files = dict(layout.files) | {"f2": replace(layout.files["f2"], path="7", identity="other")}
    shutil.copytree(serial_run.store.path, tmp_path / "a" / "store.zarr")
    partial = run_all(make(tmp_path / "a", layout=replace(layout, files=files)))
    tiles = {name for stage, name in rerun(partial) if stage == "terrain"}
    assert tiles == {"0.2", "1.2", "2.2"}  # points lie strictly within the file's box
    whole = run_all(make(tmp_path / "b", layout=replace(layout, files=files)))
    assert contents(partial.store.path) == contents(whole.store.path)


@pytest.fixture(params=[nullcontext, remembering], ids=["forgets", "remembers"])
def memory(request: pytest.FixtureRequest) -> Iterator[None]:
    """A process that knows nothing of earlier runs, and one that keeps their records."""
    with request.param():
        yield


@pytest.mark.usefixtures("memory")
def test_what_comes_out_the_same_makes_nothing_else_run(serial_run: Engine, tmp_path: Path) -> None:
    """Another file with the same points: it is read, its tiles do not run."""
    layout = grid_layout()
    files = dict(layout.files) | {"f2": replace(layout.files["f2"], identity="touched")}
    shutil.copytree(serial_run.store.path, tmp_path / "store.zarr")
    assert rerun(run_all(make(tmp_path))) == set()
    again = run_all(make(tmp_path, layout=replace(layout, files=files)))
    assert rerun(again) == {("ingest", "f2")}
    assert again.records["ingest", "f2"].key != serial_run.records["ingest", "f2"].key
    assert again.records["ingest", "f2"].digest == serial_run.records["ingest", "f2"].digest


@pytest.mark.usefixtures("memory")
def test_files_beside_the_store_must_be_as_stated(tmp_path: Path) -> None:
    stages = [Stage("note", Scope.TILE, writes_file), Stage("count", Scope.REGION, seen, (Read("note"),))]
    engine = make(tmp_path, context=tmp_path)
    engine.run(*stages)
    again = make(tmp_path, context=tmp_path)
    again.run(*stages)
    assert rerun(again) == set()
    (tmp_path / "0.0.txt").unlink()
    (tmp_path / "1.0.txt").write_text("longer than it was")
    (tmp_path / "1.1.txt").write_text("1,1")
    mended = make(tmp_path, context=tmp_path)
    mended.run(*stages)
    assert rerun(mended) == {("note", "0.0"), ("note", "1.0"), ("note", "1.1")}
    assert [mended.records["note", name].damage for name in ("0.0", "0.1", "1.0", "1.1")] == [
        "0.0.txt is not there",
        "",
        "1.0.txt has 18 bytes instead of 3",
        "1.1.txt its checksum differs",
    ]
    assert (tmp_path / "1.0.txt").read_text() == "1.0"


def test_a_result_goes_before_its_files_are_written_anew(tmp_path: Path) -> None:
    """Killed between the files and the commit, a run leaves no result that states files of another one."""
    engine = make(tmp_path, context=tmp_path)
    engine.run(Stage("note", Scope.TILE, writes_file))
    half = make(tmp_path, context=tmp_path)
    with pytest.raises(KeyboardInterrupt):
        half.run(Stage("note", Scope.TILE, writes_other_file, version=2))
    assert (tmp_path / "0.0.txt").read_text() == "0,0"
    again = make(tmp_path, context=tmp_path)
    again.run(Stage("note", Scope.TILE, writes_file))
    assert rerun(again) == {("note", "0.0")}
    assert (tmp_path / "0.0.txt").read_text() == "0.0"


def test_results_of_another_run_are_pruned(serial_run: Engine, tmp_path: Path) -> None:
    shutil.copytree(serial_run.store.path, tmp_path / "store.zarr")
    store = Store(tmp_path / "store.zarr")
    store.write("gone", "0.0", {"z": np.arange(3)})
    store.write("plane", "9.9", {"z": np.arange(3)})
    engine = run_all(make(tmp_path))
    engine.prune()
    assert rerun(engine) == set()
    assert contents(store.path) == contents(serial_run.store.path)


def test_a_moved_file_is_the_same_file(serial_run: Engine, tmp_path: Path) -> None:
    layout = grid_layout()
    files = {name: replace(item, path=f"0{item.path}") for name, item in layout.files.items()}
    shutil.copytree(serial_run.store.path, tmp_path / "store.zarr")
    assert rerun(run_all(make(tmp_path, layout=replace(layout, files=files)))) == set()


@pytest.mark.usefixtures("memory")
def test_a_deleted_or_damaged_result_runs_again_alone(serial_run: Engine, tmp_path: Path) -> None:
    store = tmp_path / "store.zarr"
    shutil.copytree(serial_run.store.path, store)
    assert rerun(run_all(make(tmp_path))) == set()
    (store / "seam" / "x1.1.zip").unlink()
    plane = store / "plane" / "0.0.zip"
    plane.write_bytes(plane.read_bytes()[:-30])
    again = run_all(make(tmp_path))
    assert rerun(again) == {("seam", "x1.1"), ("plane", "0.0")}
    assert contents(store) == contents(serial_run.store.path)


@pytest.mark.parametrize("share", [0.0, 0.3, 0.999])
@pytest.mark.parametrize("item", [("terrain", "1.1"), ("plane", "0.0")])
def test_what_is_damaged_is_computed_again_and_told(
    serial_run: Engine, tmp_path: Path, item: tuple[str, str], share: float
) -> None:
    store = tmp_path / "store.zarr"
    shutil.copytree(serial_run.store.path, store)
    path = store / item[0] / f"{item[1]}.zip"
    data = bytearray(path.read_bytes())
    data[int(share * len(data))] ^= 4
    path.write_bytes(data)
    again = run_all(make(tmp_path))
    assert rerun(again) == {item}
    assert again.records[item].damage == f"{item[1]}.zip its checksum differs"
    assert contents(store) == contents(serial_run.store.path)
    assert not any(record.damage for record in run_all(make(tmp_path)).records.values())


def test_a_chunk_that_is_lost_while_a_run_is_at_work_is_an_error_with_the_way_out(tmp_path: Path) -> None:
    stages = [Stage("source", Scope.TILE, many), Stage("reader", Scope.REGION, loses, (Read("source"),))]
    with pytest.raises(
        InputError, match=r"stage reader, region region: stage source, 1\.1: z in .*damaged .*run again: it is"
    ):
        make(tmp_path).run(*stages)
    again = make(tmp_path)
    again.run(stages[0])
    assert rerun(again) == {("source", "1.1")}


def test_what_killed_runs_left_is_swept(tmp_path: Path) -> None:
    run_all(make(tmp_path))
    Store(tmp_path / "store.zarr").writer("plane", "0.0").__enter__()
    before = contents(tmp_path)
    run_all(make(tmp_path))
    assert contents(tmp_path) == before
    assert not list(tmp_path.rglob("*.partial"))


@pytest.mark.parametrize("where", ["serial", "dask"])
def test_the_first_error_names_stage_and_item_and_leaves_nothing(
    where: str, two_workers: Executor, tmp_path: Path
) -> None:
    executor = {"serial": Serial(), "dask": two_workers}[where]
    engine = make(tmp_path, executor, layout=grid_layout(6))
    with pytest.raises(GeometryError, match=r"^stage fails, tile 1\.1: no valid result$") as caught:
        engine.run(Stage("fails", Scope.TILE, fails, parameters=("scale",)))
    assert caught.value.exit_code == 1
    names = engine.store.names("fails")
    assert "1.1" not in names
    assert len(names) < 36
    assert not list(tmp_path.rglob("*.partial"))
    engine.run(Stage("after", Scope.TILE, nothing))
    assert len(engine.store.names("after")) == 36


def test_other_errors_keep_their_type_and_say_where(two_workers: Executor, tmp_path: Path) -> None:
    for executor in (Serial(), two_workers):
        with pytest.raises(ZeroDivisionError) as caught:
            make(tmp_path, executor).run(Stage("divides", Scope.REGION, divides))
        notes = "\n".join(caught.value.__notes__)
        assert "stage divides, region region" in notes
        assert "in divides" in notes
        with pytest.raises(RuntimeError, match="one that cannot be sent"):
            make(tmp_path, executor).run(Stage("odd", Scope.REGION, raises_unpicklable))


def test_what_cannot_be_sent_or_read_is_an_error_and_what_waits_is_dropped(
    two_workers: Executor, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Functions of a notebook or a script are sent as they are."""
    engine = make(tmp_path, two_workers)
    lock = threading.Lock()
    with pytest.raises(TypeError, match=r"cannot pickle '_thread\.lock'"):
        engine.run(Stage("unsent", Scope.TILE, lambda task: {"locked": lock.locked()}))
    with pytest.raises(RuntimeError, match="cannot be read by a worker: ValueError"):
        engine.run(Stage("unread", Scope.REGION, Unreadable()))
    word = "local"
    engine.run(Stage("local", Scope.REGION, lambda task: {"stage": task.stage, "word": word}))
    assert engine.records["local", "region"].facts == {"stage": "local", "word": "local"}
    main: dict[str, Any] = {"__name__": "__main__"}
    exec("def in_notebook(task):\n    return {'stage': task.stage}", main)
    monkeypatch.setattr(sys.modules["__main__"], "in_notebook", main["in_notebook"], raising=False)
    engine.run(Stage("main", Scope.REGION, main["in_notebook"]))
    assert engine.records["main", "region"].facts == {"stage": "main"}


def test_a_killed_worker_is_an_error_that_names_the_item(tmp_path: Path) -> None:
    from dask import config

    with config.set({"distributed.scheduler.allowed-failures": 0}), local(1) as executor:
        engine = make(tmp_path, executor)
        with pytest.raises(CityError, match=r"stage dies, region region: the worker process died .*memory"):
            engine.run(Stage("dies", Scope.REGION, dies))


@pytest.mark.parametrize("window", [1, 3, None])
def test_the_window_holds(tmp_path: Path, window: int | None) -> None:
    executor = Shuffled(1)
    executor.window = window or executor.window
    run_all(make(tmp_path, executor))
    assert executor.most == (window or 8)


def test_later_stages_go_first_then_names(tmp_path: Path) -> None:
    order: list[str] = []

    def tell(stage: str, done: int, total: int, record: Record) -> None:
        order.append(f"{stage} {record.name}")

    engine = make(tmp_path, executor=one_at_a_time(), watcher=Told(tell))
    engine.run(Stage("b", Scope.TILE, nothing, (Read("a"),)), Stage("a", Scope.TILE, nothing))
    assert order[:7] == ["a 0.0", "a 0.1", "a 0.2", "a 1.0", "a 1.1", "b 0.0", "a 1.2"]


def test_of_a_stage_larger_tiles_go_first(tmp_path: Path) -> None:
    order: list[str] = []
    boxes = {
        "a": (0.0, 0.0, 1.0, 1.0),
        "b": (1.0, 0.0, 3.0, 1.0),
        "c": (0.0, 1.0, 3.0, 4.0),
        "d": (0.0, 4.0, 2.0, 5.0),
    }
    seams = {"small": (0.0, 0.0, 1.0, 0.0), "wide": (0.0, 0.0, 9.0, 9.0)}
    layout = Layout({}, boxes, seams, (0.0, 0.0, 3.0, 5.0))
    engine = make(tmp_path, one_at_a_time(), layout=layout, watcher=Told(lambda *told: order.append(told[3].name)))
    engine.run(Stage("tiles", Scope.TILE, nothing))
    assert order == ["c", "b", "d", "a"]
    engine.run(Stage("seams", Scope.SEAM, nothing))
    assert order[4:] == ["small", "wide"]


def test_of_files_and_seams_those_go_first_that_the_larger_tiles_read(tmp_path: Path) -> None:
    order: list[str] = []
    boxes = {"a": (0.0, 0.0, 1.0, 1.0), "b": (1.0, 0.0, 3.0, 1.0), "c": (3.0, 0.0, 6.0, 1.0)}
    seams = {"1": (0.5, 0.0, 0.5, 0.0), "2": (1.5, 0.0, 1.5, 0.0), "3": (3.5, 0.0, 3.5, 0.0)}
    layout = Layout({}, boxes, seams, (0.0, 0.0, 6.0, 1.0))
    engine = make(
        tmp_path,
        one_at_a_time(),
        layout=layout,
        watcher=Told(lambda *told: order.append(f"{told[0]} {told[3].name}")),
    )
    engine.run(Stage("seams", Scope.SEAM, nothing), Stage("tiles", Scope.TILE, nothing, (Read("seams", 0.0),)))
    assert order == ["seams 3", "tiles c", "seams 2", "tiles b", "seams 1", "tiles a"]


def test_progress_counts_to_the_end(tmp_path: Path) -> None:
    told: list[tuple[str, int, int]] = []
    engine = make(tmp_path, watcher=Told(lambda stage, done, total, record: told.append((stage, done, total))))
    engine.run(INGEST)
    assert told == [("ingest", 1, 3), ("ingest", 2, 3), ("ingest", 3, 3)]


def test_some_items_now_and_others_later(tmp_path: Path) -> None:
    engine = make(tmp_path)
    source, reader = Stage("source", Scope.TILE, nothing), Stage("reader", Scope.TILE, seen, (Read("source"),))
    engine.run(source, items={"source": ["0.0", "0.1", "1.0"]})
    with pytest.raises(ValueError, match=r"reader reads 1 items of source that are not run, first 1\.1"):
        engine.run(reader, items={"reader": ["0.0"]})
    told: list[str] = []
    engine.watcher = Told(lambda stage, done, total, record: told.append(f"{stage} {record.name} {done}/{total}"))
    engine.run(source, reader, items={"source": ["1.1"], "reader": ["0.0"]})
    assert told == ["source 1.1 4/4", "reader 0.0 1/1"]
    assert engine.records["reader", "0.0"].facts["source"] == ["0.0", "0.1", "1.0", "1.1"]


def test_of_its_own_a_reader_may_do_without_what_was_not_run(tmp_path: Path) -> None:
    watch = Planned()
    source, other = Stage("source", Scope.TILE, nothing), Stage("other", Scope.TILE, nothing)
    reads = (Read("source", own=True, optional=True), Read("other", own=True, optional=True))
    reader = Stage("reader", Scope.TILE, seen, reads)
    engine = make(tmp_path, watcher=watch)
    engine.run(source, other, reader, items={"source": ["0.1"], "other": []})
    assert sorted(watch.told) == ["reader 9", "source 1"]  # a stage without items is not at work
    for name in ("0.0", "0.1"):
        facts = engine.records["reader", name].facts
        assert (facts["source"], facts["other"]) == ([name] if name == "0.1" else [], [])
    strict = Stage("strict", Scope.TILE, seen, (Read("source", own=True),))
    with pytest.raises(ValueError, match=r"stage source has no item 0\.0, "):
        engine.run(strict)


def test_records_tell_time_and_memory_and_the_store_does_not(serial_run: Engine, tmp_path: Path) -> None:
    told: dict[str, Record] = {}
    engine = make(tmp_path, watcher=Told(lambda stage, done, total, record: told.update({record.name: record})))
    engine.run(INGEST)
    record = told["f0"]
    assert set(record.seconds) == {"append", "all"}
    assert 0 < record.seconds["append"] <= record.seconds["all"]
    assert record.notes == {"read": 1}
    assert engine.records.peak_memory >= record.peak_memory > 2**20
    assert set(engine.records.seconds) == {"ingest", "ingest: append"}
    assert engine.records.seconds["ingest"] == sum(each.seconds["all"] for each in told.values())
    assert engine.records["ingest", "f0"].notes == {"read": 1}
    assert set(serial_run.store.attributes("ingest", "f0")) == {"key", "facts", "notes"}


@pytest.mark.parametrize(
    ("stages", "message"),
    [
        ((replace(SEAM, reads=(Read("plane"),)), PLANE), "cycle: plane, seam"),
        ((replace(TERRAIN, reads=(Read("terrain"),)),), "cycle: terrain"),
        ((SEAM,), "seam reads stage terrain"),
        ((INGEST, INGEST), "given twice"),
        ((INGEST, TERRAIN), "run ingest in an earlier call"),
        ((replace(INGEST, parameters=("scale", "colour")),), "not there: colour"),
    ],
)
def test_wrong_stages(tmp_path: Path, stages: tuple[Stage, ...], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make(tmp_path).run(*stages)
    assert not (tmp_path / "store.zarr").exists()


def test_wrong_arguments(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="halo -1"):
        Read("a", -1.0)
    with pytest.raises(ValueError, match="tile a: box"):
        Layout(tiles={"a": (1.0, 0.0, 0.0, 1.0)})
    with pytest.raises(ValueError, match=r"no tile 9\.9"):
        make(tmp_path).run(Stage("a", Scope.TILE, nothing), items={"a": ["9.9"]})
    with pytest.raises(ValueError, match="stages that are not: b"):
        make(tmp_path).run(Stage("a", Scope.TILE, nothing), items={"b": []})


@pytest.mark.parametrize(
    ("function", "message"),
    [
        ("reads", "stage bad reads stage ingest, which it does not declare"),
        ("parameter", "stage bad uses parameter offset, which it does not declare"),
        ("facts", "facts of stage bad"),
        ("files", "facts of stage bad: 'files' states files that were written"),
        ("reach", "2.2 of source is beyond its reach"),
        ("window", "2.2 of source is beyond its reach"),
    ],
)
def test_a_function_is_held_to_what_its_stage_declares(tmp_path: Path, function: str, message: str) -> None:
    bad = Stage("bad", Scope.TILE, MISBEHAVED[function], (Read("source"),), ("scale",))
    engine = make(tmp_path)
    with pytest.raises(ValueError, match=message):
        engine.run(Stage("source", Scope.TILE, nothing), bad)
    assert engine.store.names("bad") == []


def test_keys_hash_each_of_their_inputs() -> None:
    layout, box = grid_layout(), (0.0, 0.0, 1.0, 1.0)
    digests = [
        stage_digest(TERRAIN, {"scale": 2.0}, layout),
        stage_digest(TERRAIN, {"scale": 2.1}, layout),
        stage_digest(replace(TERRAIN, version=2), {"scale": 2.0}, layout),
        stage_digest(replace(TERRAIN, name="x"), {"scale": 2.0}, layout),
        stage_digest(TERRAIN, {"scale": 2.0}, replace(layout, bounds=(0.0, 0.0, 30.0, 30.1))),
        stage_digest(TERRAIN, {"scale": 2.0}, replace(layout, identity="EPSG:28992")),
    ]
    assert len(set(digests)) == len(digests)
    assert stage_digest(TERRAIN, {"scale": 2.0}, grid_layout()) == digests[0]
    keys = [
        item_key(digests[0], "a", box, "", []),
        item_key(digests[1], "a", box, "", []),
        item_key(digests[0], "b", box, "", []),
        item_key(digests[0], "a", (0.0, 0.0, 1.0, 1.1), "", []),
        item_key(digests[0], "a", box, "file", []),
        item_key(digests[0], "a", box, "", [("s", [("n", "k")])]),
        item_key(digests[0], "a", box, "", [("s", [("n", "l")])]),
    ]
    assert len(set(keys)) == len(keys)
    with pytest.raises(ValueError, match="parameter scale of stage terrain"):
        stage_digest(TERRAIN, {"scale": object()}, layout)


def test_connect_runs_on_a_foreign_scheduler(serial_run: Engine, two_workers: Executor, tmp_path: Path) -> None:
    client: Any = getattr(two_workers, "_client")  # noqa: B009
    with connect(client.scheduler.address) as executor:
        assert executor.workers == 2
        engine = run_all(make(tmp_path, executor))
    assert contents(engine.store.path) == contents(serial_run.store.path)


def test_an_interrupt_leaves_no_processes(tmp_path: Path) -> None:
    code = (
        "from tests.tiler.engine.test_engine import *\n"
        "if __name__ == '__main__':\n"
        "    with local(1) as executor:\n"
        f"        make(Path({str(tmp_path)!r}), executor).run(Stage('sleeps', Scope.TILE, sleeps))\n"
    )
    script = tmp_path / "main.py"
    script.write_text(code)
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    process = subprocess.Popen(
        [sys.executable, str(script)], cwd=ROOT, env=environment, start_new_session=True, stderr=subprocess.PIPE
    )
    wait_until(lambda: len(list(tmp_path.glob("sleeping.*"))) == 1, seconds=60)
    os.killpg(process.pid, signal.SIGINT)
    process.communicate(timeout=60)
    assert process.returncode != 0
    for marker in tmp_path.glob("sleeping.*"):
        pid = int(marker.name.split(".")[1])
        wait_until(lambda pid=pid: not Path(f"/proc/{pid}").exists(), seconds=20)  # type: ignore[misc]


def wait_until(true: Callable[[], bool], *, seconds: float) -> None:
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.05)


# What the toy stages above run; top-level, as workers import them by name.


def nothing(task: Task) -> Facts:
    return {}


def told(task: Task) -> Facts:
    """What an item reads, by its names alone."""
    return {stage: list(names) for stage, names in task.refs.items()}


def seen(task: Task) -> Facts:
    for stage, names in task.refs.items():
        assert [result.name for result in task.read(stage, names=())] == list(names)
    return {stage: list(names) for stage, names in task.refs.items()}


def many(task: Task) -> Facts:
    task.put(z=np.arange(20_000.0))
    return {}


def loses(task: Task) -> Facts:
    file = task.store.file("source", "1.1")
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 1
    file.write_bytes(data)
    return {"n": len(list(task.read("source")))}


def writes_file(task: Task) -> Facts:
    path: Path = task.context / f"{task.name}.txt"
    path.write_text(task.name)
    return {"files": state_files(task.context, [path])}


def writes_other_file(task: Task) -> Facts:
    (task.context / f"{task.name}.txt").write_text(task.name.replace(".", ","))
    raise KeyboardInterrupt


def odd_files(task: Task) -> Facts:
    return {"files": 3}


def fails(task: Task) -> Facts:
    task.append(points=np.zeros((200_000, 3)))
    if task.name == "1.1":
        raise GeometryError("no valid result")
    time.sleep(0.05)
    return {}


def divides(task: Task) -> Facts:
    return {"x": 1 / int(task.scope is not Scope.REGION)}


class UnpicklableError(Exception):
    def __init__(self) -> None:
        super().__init__("one that cannot be sent")
        self.cause = lambda: None


def raises_unpicklable(task: Task) -> Facts:
    raise UnpicklableError


class Unreadable:
    """A function that fails where it arrives."""

    def __call__(self, task: Task) -> Facts:
        return {}

    def __reduce__(self) -> tuple[Any, ...]:
        return (int, ("x",))


def dies(task: Task) -> Facts:
    os.kill(os.getpid(), signal.SIGKILL)
    return {}


def sleeps(task: Task) -> Facts:
    (task.store.path.parent / f"sleeping.{os.getpid()}").touch()
    time.sleep(60)
    return {}


def undeclared_read(task: Task) -> Facts:
    return {"n": len(list(task.read("ingest")))}


def undeclared_parameter(task: Task) -> Facts:
    return {"x": task.parameters.scale + task.parameters.offset}


def odd_facts(task: Task) -> Facts:
    return {"x": float("nan")}


def beyond_reach(task: Task) -> Facts:
    return {"n": len(task.read_rows("source", "2.2", "z", 0, 1))}


def window_beyond_reach(task: Task) -> Facts:
    return {"n": len(task.read_window("source", "2.2", "z", (0, 1), (0, 1)))}


MISBEHAVED = {
    "reads": undeclared_read,
    "parameter": undeclared_parameter,
    "facts": odd_facts,
    "files": odd_files,
    "reach": beyond_reach,
    "window": window_beyond_reach,
}
