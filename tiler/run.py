"""A run: from a configuration to a folder with the mesh, its city model and its record."""

import dataclasses
import json
import platform
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from pipeline.errors import CityError
from tiler.atomic import replacing
from tiler.config import Config
from tiler.context import RunContext, pack_tiles
from tiler.engine import Engine
from tiler.executors import Executor, connect, local, serial
from tiler.out_folder import check_folder, clear_folder, only_run, remove_strangers
from tiler.own_stages import OwnStages, check_own, run_own_stages
from tiler.planning import Plan, check_sources, identify, make_plan
from tiler.stage import REGION_ITEM, Stage
from tiler.stages.city import first_round, house_stage, later_round, model_stage, shape_stage
from tiler.stages.citymodel import city_model_stages
from tiler.stages.inputs import input_stages
from tiler.stages.mesh import mesh_stages
from tiler.stages.pieces import piece_stages
from tiler.summary import summarise_run
from tiler.task import Record, peak_memory
from tiler.vtk_files import write_pvtp, write_pvtu

SCHEMA = 1  # version of run.json's layout
LIBRARIES = ("citystitch", "numpy", "scipy", "shapely", "numba", "triangle", "laspy", "lazrs", "pyogrio", "pyproj")
Announce = Callable[[str, float], None]


def run(
    config: Config,
    *,
    announce: Announce | None = None,
    say: Callable[[str], None] | None = None,
    stages: Sequence[Stage] = (),
    parameters: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Mesh a region as configured.

    Parameters
    ----------
    config : Config
        Parameters of the run.
    announce : callable, optional
        Called with the name of each stage and the seconds of all its items when it is done.
    say : callable, optional
        Called with sentences that the user should read.
    stages : sequence of Stage, optional
        Further stages, run after ours; they may read these and each other.
    parameters : mapping, optional
        Parameters that further stages declare, besides those of `config`.

    Returns
    -------
    dict
        What ``run.json`` holds. ``exit_code`` is 0, or 3 if parts were left out.

    Raises
    ------
    CityError
        If nothing could be made of the input; ``run.json`` then says so.
    ValueError
        If a further stage has the name of one of ours, or a further parameter that of one of `config`.

    Notes
    -----
    A folder that holds an unfinished run is gone on with: what is in its store already, and has the same key, is
    not computed again. Results are the same as without the interruption, byte for byte.
    """
    check_sources(config)
    out = Path(config.out)
    own = check_own(config, stages, parameters)
    check_folder(out, overwrite=config.overwrite)
    with only_run(out):
        earlier = check_folder(out, overwrite=config.overwrite)
        return _run(config, out, earlier, own, announce, say or _silent)


def _run(
    config: Config,
    out: Path,
    earlier: list[str],
    own: OwnStages,
    announce: Announce | None,
    say: Callable[[str], None],
) -> dict[str, Any]:
    start = time.perf_counter()
    record: dict[str, Any] = {
        "schema": SCHEMA,
        "status": "running",
        "parameters": dataclasses.asdict(config),
        "versions": {"python": platform.python_version()} | {name: _version(name) for name in LIBRARIES},
    }
    try:
        # Nothing of an earlier run is touched before the inputs are known to be there.
        plan = make_plan(config, say)
        clear_folder(out, earlier, overwrite=config.overwrite)
        earlier = []
        _write_record(out, record)
        record |= _mesh_region(config, out, plan, own, announce)
        record["status"] = "done"
    except CityError as error:
        record |= {"status": "failed", "error": str(error)}
        raise
    except BaseException as error:
        record |= {"status": "failed", "error": f"{type(error).__name__}: {error}"}
        raise
    finally:
        record["seconds_total"] = round(time.perf_counter() - start, 3)
        if not earlier:
            _write_record(out, record)
    return record


def _mesh_region(
    config: Config, out: Path, plan: Plan, own: OwnStages, announce: Announce | None
) -> dict[str, Any]:
    """Run all stages, and write the indexes of their pieces."""
    context = RunContext(
        plan.region.bounds, plan.region.crs, config.tile_size, config.mesh_size, pack_tiles(plan.grid), str(out)
    )
    footprints = Path(config.footprints) if config.footprints else None
    parameters = SimpleNamespace(
        **dataclasses.asdict(config),
        **own.parameters,
        layer_height_or_default=config.layer_height_or_default,
        footprints_identity=identify(footprints) if footprints else "",
    )
    steps = _Steps(announce)
    with _executor(config) as executor:
        engine = Engine(
            out / "store.zarr",
            plan.layout,
            parameters=parameters,
            context=context,
            executor=executor,
            progress=steps,
        )
        rounds = run_stages(engine, config)
        run_own_stages(engine, own)
    engine.prune()
    remove_strangers(out, plan.layout.tiles)
    tiles = sorted(plan.layout.tiles)
    write_pvtu(out / "mesh.pvtu", [out / "mesh" / f"{tile}.vtu" for tile in tiles])
    write_pvtp(out / "boundary.pvtp", [out / "boundary" / f"{tile}.vtp" for tile in tiles])
    summary = summarise_run(engine, plan, config, rounds)
    return summary | {"finished": steps.finished, "driver_memory_bytes": peak_memory()}


def run_stages(engine: Engine, config: Config) -> int:
    """Run all stages in their order; returns how often clusters of houses were simplified.

    Parameters
    ----------
    engine : Engine
        Engine over the region's items.
    config : Config
        Parameters of the run.
    """
    rounds = run_city_stages(engine, config)
    engine.run(*city_model_stages(), *mesh_stages(config))
    engine.run(*piece_stages(config))
    return rounds


def run_city_stages(engine: Engine, config: Config) -> int:
    """Run the stages up to the simplified city model; parameters and result as for `run_stages`."""
    engine.run(*input_stages(config))
    largest = engine.records["footprints", REGION_ITEM].facts["largest"]
    engine.run(house_stage(config, largest))
    engine.run(*first_round(config))
    engine.run(shape_stage(0))
    last = 0
    while True:
        engine.run(*later_round(config, last + 1))
        if not engine.records[f"join-{last + 1}", REGION_ITEM].facts["joined"]:
            break
        last += 1
        engine.run(shape_stage(last))
    engine.run(model_stage(config, last))
    return last + 1


@contextmanager
def _executor(config: Config) -> Iterator[Executor]:
    if config.scheduler:
        with connect(config.scheduler) as executor:
            yield executor
    elif config.workers:
        with local(config.workers) as executor:
            yield executor
    else:
        with serial() as executor:
            yield executor


class _Steps:
    """Announces each stage when its last item is done, with the seconds of all."""

    def __init__(self, announce: Announce | None) -> None:
        self._announce = announce
        self._seconds: defaultdict[str, float] = defaultdict(float)
        self._begin = time.perf_counter()
        self.finished: dict[str, float] = {}

    def __call__(self, stage: str, done: int, total: int, record: Record) -> None:
        self._seconds[stage] += record.seconds.get("all", 0.0)
        if done == total:
            self.finished[stage] = round(time.perf_counter() - self._begin, 3)
            if self._announce is not None:
                self._announce(f"{stage} ({total})", self._seconds[stage])


def _write_record(out: Path, record: dict[str, Any]) -> None:
    with replacing(out / "run.json") as part:
        part.write_text(json.dumps(record, indent=1, default=str) + "\n")


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "not installed"


def _silent(_: str) -> None:
    """Say nothing."""
