"""`make simulate`: countries through planner, engine, records and store, with tasks that take recorded time."""

import argparse
import gc
import json
import resource
import shutil
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any
from unittest.mock import patch

from distributed import WorkerPlugin, default_client

from tests.benchmarks.countries import COUNTRIES, sheets, write_sheets
from tests.benchmarks.recorded import PATH as RECORDED
from tests.benchmarks.recorded import record
from tests.benchmarks.virtual import StandInStore, VirtualWorkers, instant
from tiler.config.config import Config, make_config
from tiler.engine.engine import Engine
from tiler.engine.executor import Executor
from tiler.engine.records import Records
from tiler.engine.schedule import StoppedError
from tiler.engine.task import Record
from tiler.executors.local_cluster import local
from tiler.monitoring.progress import ProgressFile
from tiler.monitoring.watchers import Watchers
from tiler.planning.own_stages import OwnStages, list_stages
from tiler.planning.plan import Plan, make_plan
from tiler.store.out_folder import MANIFEST_PATH, STORE
from tiler.workflow.audit import find_remade, write_manifest
from tiler.workflow.failed_tiles import HolesError, Missing, find_missing, leave_holes
from tiler.workflow.stage_sequence import make_engine, run_stages
from tiler.workflow.summary import summarise_run

SAMPLED = 10_000  # tasks between two looks at memory
SETTLE = 3.0  # s after which a cluster is quiet


class AtOnce(WorkerPlugin):  # type: ignore[misc]  # distributed has no types
    """Lets a worker process have tasks done at once."""

    def setup(self, worker: Any) -> None:
        """Take `instant` for what runs a task."""
        patch("tiler.executors.dask_executor.run_guarded", instant).start()


def memory() -> float:
    """Private resident memory of this process (MB): files that are mapped do not count."""
    return int(Path("/proc/self/status").read_text().split("RssAnon:")[1].split()[0]) / 1000


class Meter(Watchers):
    """The state of a run and its file; looks at the memory of the driver, and ends a run when it is asked to."""

    def __init__(self, out: Path, config: Config, *, stop_after: int = 0) -> None:
        super().__init__([ProgressFile(out, config)])
        self.peak, self.n_done, self.stop_after = memory(), 0, stop_after
        self.samples: list[tuple[int, float]] = []  # tasks done, and memory (MB)
        self.stop: Callable[[], None] = lambda: None

    def done(self, stage: str, n_done: int, total: int, record: Record) -> None:
        """Take note of an item that is done."""
        super().done(stage, n_done, total, record)
        self.n_done += 1
        if self.n_done % SAMPLED == 0:
            self.samples.append((self.n_done, memory()))
            self.peak = max(self.peak, self.samples[-1][1])
            print(f"{stage}: {self.n_done} tasks, {self.samples[-1][1]:.1f} MB", file=sys.stderr, flush=True)
        if self.n_done == self.stop_after:
            self.stop()


def survey(country: str, n_tiles: int, folder: Path) -> tuple[Config, Plan, dict[str, Any]]:
    """Write the headers of a country's point clouds, and plan it from them."""
    chosen = COUNTRIES[country]
    place = folder / f"{country}-{n_tiles}"
    if not place.is_dir():
        write_sheets(sheets(chosen, n_tiles), chosen.crs, place)
    config = make_config({"pointcloud": [str(place)], "out": str(folder / "out"), "tile_size": chosen.tile_size})
    before, begin = memory(), time.perf_counter()
    plan = make_plan(config, lambda _: None)
    told = {
        "tiles": len(plan.layout.tiles),
        "seams": len(plan.layout.seams),
        "files": len(plan.layout.files),
        "absent": len(plan.layout.absent),
        "plan_seconds": time.perf_counter() - begin,
        "plan_memory": memory() - before,
        "memory_before": before,
    }
    return config, plan, told


def drive(
    config: Config, plan: Plan, executor: Executor, *, stand_in: StandInStore | None = None, stop_after: int = 0
) -> dict[str, Any]:
    """Run all stages of a region and what follows them, as `tiler.workflow.run` does, but for the index files."""
    out = Path(config.out)
    out.mkdir(parents=True, exist_ok=True)
    meter = Meter(out, config, stop_after=stop_after)
    missing, again = Missing(), 0
    begin = time.perf_counter()
    while True:
        engine = make_engine(config, out, plan, executor, OwnStages(), meter)
        _take_store(engine, stand_in, plan)
        meter.stop = engine.stop
        try:
            rounds = run_stages(engine, config)
        except HolesError:
            plan, missing = leave_holes(plan, missing, engine)
            again += 1
            continue
        except StoppedError:
            return _told(meter, engine, begin)
        break
    told = _told(meter, engine, begin) | {"planned_again": again}
    begin = time.perf_counter()
    missing = find_missing(plan, missing, engine)
    find_remade(out / MANIFEST_PATH, engine.records)
    engine.prune()
    engine.store.remove_strays()
    told["settle_seconds"] = time.perf_counter() - begin
    begin = time.perf_counter()
    (out / MANIFEST_PATH).parent.mkdir(exist_ok=True)
    write_manifest(out / MANIFEST_PATH, engine.records, {})
    told["manifest_seconds"] = time.perf_counter() - begin
    begin = time.perf_counter()
    summary = summarise_run(engine, plan, config, rounds, missing, {})
    (out / "run.json").write_text(json.dumps(summary))
    told["summary_seconds"] = time.perf_counter() - begin
    told["memory_summary"] = memory()
    told["peak"] = max(meter.peak, memory())
    told["missing"] = len(missing.tiles)
    return told


def _take_store(engine: Engine, stand_in: StandInStore | None, plan: Plan) -> None:
    if stand_in is not None:
        stand_in.layout = plan.layout
        engine.store, engine.records = stand_in, Records(stand_in)


def _told(meter: Meter, engine: Engine, begin: float) -> dict[str, Any]:
    now = memory()
    gc.collect()
    return {
        "run_seconds": time.perf_counter() - begin,
        "tasks": meter.n_done,
        "records": len(engine.records),
        "memory_run": now,
        "peak": max(meter.peak, now),
        "samples": meter.samples[:: max(len(meter.samples) // 10, 1)],
    }


def run_virtual(country: str, n_tiles: int, workers: int, fail: float, folder: Path) -> dict[str, Any]:
    """Run a country in virtual time, with a stand-in for the store."""
    config, plan, told = survey(country, n_tiles, folder)
    store = StandInStore(Path(config.out) / STORE, plan.layout, config.tile_size)
    executor = VirtualWorkers(workers, store, fail)
    cpu, begin = time.process_time(), time.perf_counter()
    told |= drive(config, plan, executor, stand_in=store)
    cpu, wall = time.process_time() - cpu, time.perf_counter() - begin
    told |= {
        "workers": workers,
        "cpu_seconds": cpu * (1 - executor.own / wall),
        "virtual_hours": executor.clock / 3600,
        "busy": executor.busy / workers / executor.clock,
        "in_flight": executor.flying / executor.clock,
        "submitted": executor.submitted,
        "reused": executor.reused,
        "core_hours": executor.busy / 3600,
        "stored": executor.stored,
        "written": executor.written,
        "store_files": executor.files,
    }
    return told


def run_disk(country: str, n_tiles: int, folder: Path, *, half: bool = False) -> dict[str, Any]:
    """Run a country in virtual time, with a real store on disk; once to its half and on, if asked."""
    config, plan, told = survey(country, n_tiles, folder)
    shutil.rmtree(config.out, ignore_errors=True)
    if half:
        n_tasks = sum(len(plan.layout.boxes(stage.scope)) for stage in list_stages(config))
        told["first_half"] = drive(config, plan, VirtualWorkers(64), stop_after=n_tasks // 2)
    executor = VirtualWorkers(64)
    told |= drive(config, plan, executor)
    return told | {"reused": executor.reused}


def run_dask(country: str, n_tiles: int, workers: int, folder: Path) -> dict[str, Any]:
    """Run a country with a real scheduler in this process and worker processes, whose tasks are done at once."""
    config, plan, told = survey(country, n_tiles, folder)
    shutil.rmtree(config.out, ignore_errors=True)
    store = StandInStore(Path(config.out) / STORE, plan.layout, config.tile_size)
    with local(workers) as executor:
        default_client().register_plugin(AtOnce())
        time.sleep(SETTLE)
        gc.collect()
        told["memory_cluster"] = memory()
        cpu = time.process_time()
        told |= drive(config, plan, executor, stand_in=store)
        told["cpu_seconds"] = time.process_time() - cpu
    return told


def record_city(city: Path, tile_size: int, folder: Path) -> None:
    """Run a city of `citystitch synth`, and write what its tasks came to, beside those of other tile sizes."""
    out = folder / "recorded"
    shutil.rmtree(out, ignore_errors=True)
    footprints, clouds = str(city / "footprints.shp"), str(city / "tiles")
    given = {"pointcloud": [clouds], "footprints": footprints, "out": str(out), "tile_size": float(tile_size)}
    known = json.loads(RECORDED.read_text())
    known[f"{tile_size:g}"] = record(make_config(given))
    RECORDED.write_text(json.dumps(known, indent=1) + "\n")


def main() -> None:
    """Run one simulation and print what it tells as JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("virtual", "disk", "half", "dask", "record"))
    parser.add_argument("country", help=f"{' or '.join(COUNTRIES)}; for `record` the folder of a synthetic city")
    parser.add_argument("tiles", type=int, help="number of tiles; for `record` their side (m)")
    parser.add_argument("--workers", type=int, help="virtual ones, 64 by default; with dask processes, 2")
    parser.add_argument("--fail", type=float, default=0.0)
    parser.add_argument("--folder", type=Path, default=Path(tempfile.gettempdir()) / "citystitch-simulate")
    given = parser.parse_args()
    folder = given.folder
    match given.what:
        case "virtual":
            told = run_virtual(given.country, given.tiles, given.workers or 64, given.fail, folder)
        case "record":
            record_city(Path(given.country), given.tiles, folder)
            return
        case "dask":
            told = run_dask(given.country, given.tiles, given.workers or 2, folder)
        case _:
            told = run_disk(given.country, given.tiles, folder, half=given.what == "half")
    told["peak_rss"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1000
    print(json.dumps(told, indent=1))


if __name__ == "__main__":
    with suppress(KeyboardInterrupt):
        main()
