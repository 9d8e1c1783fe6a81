"""A run: from a configuration to a folder with the mesh, its city model and its record."""

import dataclasses
import json
import os
import platform
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from pipeline.errors import CityError, OutputError
from stitch.grid import seams_of_tile
from tiler.addresses import ANYWHERE
from tiler.atomic import replacing
from tiler.audit import Audit
from tiler.cluster_table import read_cluster
from tiler.config import Config
from tiler.context import RunContext, pack_tiles, seam_name, tile_key
from tiler.dashboard.server import read_address, watched
from tiler.engine import Engine, Progress, StoppedError
from tiler.executors import Executor, connect, local, serial, share_memory
from tiler.failures import Policy
from tiler.folder_lock import only_run
from tiler.forecast import warn_of_memory
from tiler.keys import code_versions
from tiler.lease import LostFolderError
from tiler.limits import TASKS, Limits, machine_memory
from tiler.manifest import find_remade, write_manifest
from tiler.options import derived_parameters
from tiler.out_folder import (
    INDEXES,
    MANIFEST_PATH,
    PIECES,
    RUN_RECORD,
    STORE,
    check_folder,
    clear_folder,
    refuse_inputs_within,
    remove_strangers,
)
from tiler.own_stages import OwnStages, check_own, run_own_stages
from tiler.pad import Pad
from tiler.padding import CORE_STAGE, pad_plan, plan_alone
from tiler.places import in_bucket, place, refuse_bucket
from tiler.planning import Plan, check_sources, identify, make_plan
from tiler.progress import Announce
from tiler.quarantine import (
    HolesError,
    Missing,
    config_alone,
    find_missing,
    leave_holes,
    save_config,
    stop_at_holes,
)
from tiler.run_watchers import begin_watching
from tiler.seal import seal
from tiler.settling import domain_of_run, settle_domain, take_domain
from tiler.spool import SPOOL
from tiler.stage import REGION_ITEM, Stage
from tiler.stages.city import first_round, house_stage, later_round, model_stage, shape_stage
from tiler.stages.citymodel import city_model_stages
from tiler.stages.inputs import input_stages
from tiler.stages.mesh import mesh_stages
from tiler.stages.pieces import fit_stage, piece_stages
from tiler.stopping import stops
from tiler.summary import describe_tasks, summarise_run
from tiler.task import peak_memory
from tiler.vtk_files import write_pvtp, write_pvtu
from tiler.watching import LOST, Listener, Watcher, Watchers
from tiler.written import state_files

SCHEMA = 1  # version of run.json's layout
OwnExecutor = Callable[[Callable[[str], None]], AbstractContextManager[Executor]]


def run(
    config: Config,
    *,
    announce: Announce | None = None,
    say: Callable[[str], None] | None = None,
    stages: Sequence[Stage] = (),
    parameters: Mapping[str, Any] | None = None,
    watchers: Sequence[Watcher] = (),
    dashboard: str | None = None,
    executor: OwnExecutor | None = None,
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
    watchers : sequence of Watcher
        Told what is planned, begun, done and said; of the end too, if the run fails before it has begun.
    dashboard : str, optional
        Where the page of the run is shown while it is at work, ``HOST:PORT``; port 0 is a free one. Nowhere by
        default. `say` is told its URL.
    executor : callable, optional
        Given what tells the run's watchers a sentence, makes the executor of all tasks, a context; by default
        that which `config` asks for.

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
    A folder that holds an earlier run, finished or not, is brought up to date: what is in its store, and has the
    same key, is not computed again. Results are those of a run into an empty folder, byte for byte. Every byte
    that is used again is held against its checksum first; what is damaged is computed anew and noted
    (``damaged-artefact``).
    """
    told = Watchers(watchers if say is None else [*watchers, Listener(say)])
    try:
        check_sources(config)
        if config.cluster:
            read_cluster(Path(config.cluster))
        if dashboard is not None:
            read_address(dashboard)
        out = place(config.out, config.store_patience)
        own = check_own(config, stages, parameters)
        check_folder(out, overwrite=config.overwrite)
        with only_run(out, told.say) as check, _beside(out, check, told) as shown:
            earlier = check_folder(out, overwrite=config.overwrite)
            damage = _find_damage(out) if earlier and not config.overwrite else {}
            return _run(config, out, earlier, damage, own, announce, told, dashboard, executor, shown)
    except BaseException as error:
        with suppress(OutputError):  # told already where the run has begun; else what it failed by counts
            told.end("failed", tell_error(error))
        raise


def _run(
    config: Config,
    out: Path,
    earlier: list[str],
    damage: Mapping[str, str],
    own: OwnStages,
    announce: Announce | None,
    watchers: Watchers,
    dashboard: str | None,
    executor: OwnExecutor | None,
    shown: Path,
) -> dict[str, Any]:
    say = watchers.say
    start, untouched = time.perf_counter(), bool(earlier)
    record: dict[str, Any] = {
        "schema": SCHEMA,
        "checksum": "0" * 8,
        "status": "running",
        "parameters": dataclasses.asdict(config),
        "versions": {"python": platform.python_version()} | dict(code_versions()),
    }
    failed = True
    try:
        # Nothing of an earlier run is touched before the inputs are known to be there; then, before anything else
        # changes, its record no longer says that it is done.
        plan = make_plan(config, say)
        vectors = [place(config.footprints)] if config.footprints else []
        for warning in _foresee(plan, config):
            plan.messages.append(warning)
            say(warning)
        refuse_inputs_within(out, [*(header.path for header in plan.headers), *vectors])
        untouched = False
        _write_record(out, record)
        clear_folder(out, earlier, overwrite=config.overwrite)
        if not in_bucket(out):
            shutil.rmtree(out / TASKS, ignore_errors=True)  # of workers that were killed
            if executor is None:
                shutil.rmtree(out / SPOOL, ignore_errors=True)  # of members that were killed
        save_config(config, out)
        progress = begin_watching(config, out, plan, own, watchers, announce=announce, shown=shown)
        record |= _mesh_region(config, out, plan, own, watchers, damage, dashboard, executor, shown)
        record["finished"] = progress.finished
        for message in record["messages"][len(plan.messages) :]:
            say(message)
        record["status"] = "done"
        say(describe_tasks(record["tasks"]))
        if in_bucket(out):
            from tiler.object_watch import describe_waits, tell_waits

            record["store_waits"] = describe_waits()
            if waits := tell_waits():
                say(waits)
        failed = False
    except LostFolderError as error:
        untouched = True  # the folder is another process's now
        watchers.end(LOST, str(error))
        raise
    except StoppedError as error:
        record |= {"status": "stopped", "error": str(error)}
        raise
    except BaseException as error:
        record |= {"status": "failed", "error": tell_error(error)}
        raise
    finally:
        record["seconds_total"] = round(time.perf_counter() - start, 3)
        # Where an error is told already, that its record cannot be written either would only hide it.
        with suppress(OutputError) if failed else nullcontext():
            if not untouched:
                _write_record(out, record)
            watchers.end(record["status"], record.get("error", ""))
    return record


def _mesh_region(
    config: Config,
    out: Path,
    plan: Plan,
    own: OwnStages,
    watchers: Watchers,
    damage: Mapping[str, str],
    dashboard: str | None,
    own_executor: OwnExecutor | None,
    shown: Path,
) -> dict[str, Any]:
    """Run all stages, and write the indexes of their pieces and the manifest.

    Where a file or a tile fails on the way to the city model, the region is planned again without it: what that
    does not touch has its result already. Where one fails later, its neighbours keep the seam with it.
    """
    missing = Missing()
    with (
        own_executor(watchers.say)
        if own_executor
        else _executor(config, dashboard or ANYWHERE, watchers.say) as executor,
        watched(shown, dashboard, getattr(executor, "scheduler", None), watchers.say),
    ):
        while True:
            engine = make_engine(config, out, plan, executor, own, watchers)
            with stops(engine.stop, watchers.say):
                try:
                    rounds = run_stages(engine, config)
                except HolesError:
                    plan, missing = leave_holes(plan, missing, engine)
                    watchers.say(f"left out so far: {', '.join(sorted(missing.tiles))}; going on with the rest")
                    continue
                run_own_stages(engine, own, config)
            break
    if config.padded:
        plan = pad_plan(plan, Pad(plan.region.bounds, engine.context.grid))
    missing = find_missing(plan, missing, engine)
    remade = {
        f"{STORE}/{stage}/{name}": what
        for (stage, name), what in find_remade(out / MANIFEST_PATH, engine.records).items()
    }
    engine.prune()
    engine.store.remove_strays()
    tiles = sorted(plan.layout.tiles.keys() - missing.tiles.keys())
    remove_strangers(out, tiles)
    write_pvtu(out / "mesh.pvtu", [out / "mesh" / f"{tile}.vtu" for tile in tiles])
    write_pvtp(out / "boundary.pvtp", [out / "boundary" / f"{tile}.vtp" for tile in tiles])
    indexes = state_files(out, [out / name for name in INDEXES])
    write_manifest(out / MANIFEST_PATH, engine.records, indexes)
    summary = summarise_run(engine, plan, config, rounds, missing, dict(damage) | remade)
    return summary | {"driver_memory_bytes": peak_memory()}


def make_engine(
    config: Config,
    out: Path,
    plan: Plan,
    executor: Executor,
    own: OwnStages,
    progress: Progress | None = None,
    *,
    set_aside: bool = True,
) -> Engine:
    """Make the engine of a run over the items of its plan; failures are set aside, or end it."""
    context = RunContext(
        plan.region.bounds,
        plan.region.crs,
        config.tile_size,
        config.mesh_size,
        pack_tiles(plan.grid),
        str(out),
        config.open_size,
    )
    footprints = place(config.footprints) if config.footprints else None
    parameters = SimpleNamespace(
        **dataclasses.asdict(config),
        **own.parameters,
        **derived_parameters(config),
        footprints_identity=identify(footprints) if footprints else "",
    )
    return Engine(
        out / STORE,
        plan.layout,
        parameters=parameters,
        context=context,
        executor=executor,
        progress=progress,
        policy=Policy(retries=config.retries, set_aside=set_aside),
    )


def run_alone(config: Config, tile: str, *, say: Callable[[str], None] | None = None) -> Path:
    """Mesh one tile alone, with those around it that its halo needs, in this process: to look into a failure.

    Parameters
    ----------
    config : Config
        Parameters of the whole run.
    tile : str
        Name of the tile.
    say : callable, optional
        Called with sentences that the user should read.

    Returns
    -------
    Path
        Its VTU piece, in a folder below that of the run. The cells are those of the whole run, bit for bit.

    Raises
    ------
    CityError
        What its stages raise; any other error likewise, its type kept.
    """
    check_sources(config)
    refuse_bucket(config.out, "--only")
    whole = make_plan(config, _silent)
    domain, tallest = domain_of_run(config)
    pad, store = None, None
    if config.padded:
        alone, pad, store = plan_alone(config, whole, tile, tallest)
    else:
        alone = config_alone(config, whole, tile)
    out = Path(alone.out)
    out.mkdir(parents=True, exist_ok=True)
    with only_run(out, say):
        plan = make_plan(alone, say or _silent)
        for folder in PIECES:
            (out / folder).mkdir(exist_ok=True)
        with serial() as executor:
            engine = make_engine(alone, out, plan, executor, OwnStages(), set_aside=False)
            run_city_stages(engine, alone)
            seams = [seam_name(key) for key in seams_of_tile(tile_key(tile))]
            take_domain(engine, alone, domain, pad, store)
            engine.run(*mesh_stages(alone, domain), items={"seams": seams, "columns": [tile]})
            (pieces,) = (stage for stage in piece_stages(alone) if stage.name == "pieces")
            engine.run(pieces, items={"pieces": [tile]})
    return out / "mesh" / f"{tile}.vtu"


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
    domain = settle_domain(engine, config)
    if config.padded:
        engine.tell_layout()
        both = engine.layout, engine.context
        engine.lay_out(*engine.laid_out(CORE_STAGE))
        engine.run(*city_model_stages(), fit_stage(config))
        engine.lay_out(*both)
        engine.run(*mesh_stages(config, domain))
    else:
        engine.run(*city_model_stages(), *mesh_stages(config, domain))
    engine.run(*piece_stages(config))
    # Beside a tile without a piece, others were written as if they had a neighbour.
    while lost := [name for stage, name in engine.set_aside if stage == "pieces"]:
        for tile in lost:
            engine.give_up(("pieces", tile), ("columns", tile))
        engine.run(*piece_stages(config))
    return rounds


def run_city_stages(engine: Engine, config: Config) -> int:
    """Run the stages up to the simplified city model; parameters and result as for `run_stages`.

    Raises
    ------
    HolesError
        If an item was set aside.
    """
    engine.run(*input_stages(config))
    stop_at_holes(engine)
    engine.run(house_stage(config))
    stop_at_holes(engine)
    engine.run(*first_round(config))
    stop_at_holes(engine)
    engine.run(shape_stage(0))
    stop_at_holes(engine)
    last = 0
    while True:
        engine.run(*later_round(config, last + 1))
        stop_at_holes(engine)
        if not engine.records[f"join-{last + 1}", REGION_ITEM].facts["joined"]:
            break
        last += 1
        engine.run(shape_stage(last))
        stop_at_holes(engine)
    engine.run(model_stage(config, last))
    stop_at_holes(engine)
    return last + 1


@contextmanager
def _executor(config: Config, dashboard: str, say: Callable[[str], None]) -> Iterator[Executor]:
    if config.scheduler:
        with connect(config.scheduler, Limits(config.time_limit)) as executor:
            yield executor
    elif config.cluster:
        from tiler.jobqueue import JOB, job_queue

        table, folder = read_cluster(Path(config.cluster)), Path(os.path.abspath(config.out)) / JOB
        with job_queue(table, folder, Limits(config.time_limit), dashboard=dashboard, say=say) as executor:
            yield executor
    elif config.workers:
        memory = int(config.memory_limit * 2**30) or share_memory(config.workers)
        with local(config.workers, Limits(config.time_limit, memory), dashboard=dashboard) as executor:
            yield executor
    else:
        with serial() as executor:
            yield executor


@contextmanager
def _beside(out: Path, check: Callable[[], None], watchers: Watchers) -> Iterator[Path]:
    """Give the folder of the events that the page of a run is made of; of one in a bucket, watch the store too."""
    if not in_bucket(out):
        yield out
        return
    from tiler.object_watch import WaitWatch, telling

    watchers.add(WaitWatch(check))
    with tempfile.TemporaryDirectory(prefix="citystitch-") as name, telling(watchers.say):
        yield Path(name)


def _find_damage(out: Path) -> dict[str, str]:
    """Say what is wrong with the files of a finished run that belong to no result.

    Of results and their files it is told by who makes them anew.
    """
    return {found.path: found.what for found in Audit(out, deep=False).check_top()}


def _foresee(plan: Plan, config: Config) -> list[str]:
    """Say which tiles may not fit into the memory of this machine."""
    return (
        [] if config.scheduler or config.cluster else warn_of_memory(plan.survey, config, memory=machine_memory())
    )


def tell_error(error: BaseException) -> str:
    """What an error that ends a run is, for its record."""
    return str(error) if isinstance(error, CityError) else f"{type(error).__name__}: {error}"


def _write_record(out: Path, record: dict[str, Any]) -> None:
    with replacing(out / RUN_RECORD, durable=True) as part:
        part.write_bytes(seal(json.dumps(record, indent=1, default=str).encode() + b"\n"))


def _silent(_: str) -> None:
    """Say nothing."""
