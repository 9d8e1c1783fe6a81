"""A run: from a configuration to a folder with the mesh, its city model and its record."""

import dataclasses
import json
import platform
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.data.errors import CityError, OutputError
from tiler.config.config import ANYWHERE, Config, with_absolute_inputs
from tiler.dashboard.server import read_address, watched
from tiler.engine.executor import Executor, OnDemand, Serial
from tiler.engine.keys import code_versions
from tiler.engine.schedule import StoppedError
from tiler.engine.stage import Stage
from tiler.engine.stopping import stops
from tiler.engine.task import peak_memory
from tiler.engine.task_limits import limit_workers, machine_memory
from tiler.engine.watcher import Watcher
from tiler.executors.kernels import prepare
from tiler.jobs.cluster import read_cluster
from tiler.jobs.submission import JOB
from tiler.mesh_files.vtk_files import write_pvtp, write_pvtu
from tiler.monitoring.run_log import RunLog
from tiler.monitoring.watchers import Watchers
from tiler.objects.places import absolute, in_bucket, place
from tiler.planning.forecast import warn_of_memory
from tiler.planning.model_shift import resolve_shift
from tiler.planning.own_stages import OwnStages, check_own, run_own_stages
from tiler.planning.plan import Plan, check_sources, make_plan
from tiler.planning.region import Pad
from tiler.store.atomic import replacing, sync_meanwhile
from tiler.store.checksums import seal, state_files
from tiler.store.edit_journal import JOURNAL, Edits, add_up, read_journal
from tiler.store.folder_lock import only_run
from tiler.store.kept import IN_STORE, remove_dropped
from tiler.store.out_folder import (
    INDEXES,
    MANIFEST_PATH,
    RUN_RECORD,
    STORE,
    TASKS,
    check_folder,
    clear_folder,
    give_back_report,
    refuse_inputs_within,
    remove_strangers,
)
from tiler.words.plain_text import replace_surrogates
from tiler.workflow.audit import Audit, find_remade, write_manifest
from tiler.workflow.empty_run import EmptyMeshError, is_empty
from tiler.workflow.failed_tiles import (
    HolesError,
    Missing,
    find_missing,
    leave_holes,
    save_config,
)
from tiler.workflow.other_region import (
    find_missing_folders,
    refuse_other_region,
    remove_folders,
    remove_if_useless,
)
from tiler.workflow.resolved_domain import pad_plan
from tiler.workflow.run_watchers import LeaseWatch, begin_watching
from tiler.workflow.stage_sequence import make_engine, run_stages
from tiler.workflow.summary import describe_tasks, summarise_run

SCHEMA = 1  # version of run.json's layout


@dataclass(frozen=True)
class _Means:
    """What a run is done with."""

    dashboard: str | None  #: where its page is shown, ``HOST:PORT``
    shown: Path  #: folder of the events that the page is made of
    cluster: Executor | None  #: of the scheduler that was asked for, or what the caller gave
    city_files: bool  #: whether the files of the city models are written


def run(
    config: Config,
    *,
    stages: Sequence[Stage] = (),
    parameters: Mapping[str, Any] | None = None,
    watchers: Sequence[Watcher] = (),
    dashboard: str | None = None,
    within: Path | None = None,
    executor: Executor | None = None,
    city_files: bool = True,
) -> dict[str, Any]:
    """Mesh a region as configured.

    Parameters
    ----------
    config : Config
        Parameters of the run.
    stages : sequence of Stage, optional
        Further stages, run after ours; they may read these and each other.
    parameters : mapping, optional
        Parameters that further stages declare, besides those of `config`.
    watchers : sequence of Watcher
        Called for what is planned, begun, done and said; at the end too, if the run fails before it has begun.
    dashboard : str, optional
        Where the page of the run is shown while it is at work, ``HOST:PORT``; port 0 is a free one. Nowhere by
        default. Watchers get its URL.
    within : Path, optional
        Folder of a disk to work in, whose files are moved to ``out`` of `config` later; ``out`` itself by default.
    executor : Executor, optional
        Runs the tasks; by default one is made as `config` says, for this run alone.
    city_files : bool
        Whether the files of the city models are written; the next run that does brings them up to date.

    Returns
    -------
    dict
        What ``run.json`` holds. ``exit_code`` is 0, or 3 if parts were left out.

    Raises
    ------
    CityError
        If nothing could be made of the input; once the run has begun, ``run.json`` says so. EmptyMeshError where
        footprints were given and no building was meshed, unless ``allow_empty``: what was meshed stays.
    ValueError
        If a further stage has the name of one of ours, or a further parameter that of one of `config`.

    Notes
    -----
    A folder that holds an earlier run, finished or not, is brought up to date: what is in its store, and has the
    same key, is not computed again. Results are those of a run into an empty folder, byte for byte. Every byte
    that is used again is held against its checksum first; what is damaged is computed anew and noted
    (``damaged-artefact``).

    What happens is logged, too: see `tiler.monitoring.run_log`.
    """
    told = Watchers([RunLog(), *watchers])
    config = use_absolute_paths(config)
    made: list[Path] = []
    try:
        check_sources(config)
        if config.cluster:
            read_cluster(Path(config.cluster))
        if dashboard is not None:
            read_address(dashboard)
        out = within or place(config.out, config.store_patience)
        own = check_own(config, stages, parameters)
        made = find_missing_folders(out)
        check_folder(out, overwrite=config.overwrite)
        with only_run(out, told.say) as check, _beside(out, check, told) as shown:
            earlier = check_folder(out, overwrite=config.overwrite)
            damage = _find_damage(out) if earlier and not config.overwrite else {}
            with _connect(config) as cluster:
                means = _Means(dashboard, shown, executor or cluster, city_files)
                try:
                    return _run(config, out, earlier, damage, own, told, means)
                except StoppedError:
                    raise
                except Exception:
                    remove_if_useless(made)
                    raise
    except BaseException as error:
        with suppress(OutputError):  # told already where the run has begun; else what it failed by counts
            told.end("failed", describe_error(error))
        remove_folders(made)
        raise


def _run(
    config: Config,
    out: Path,
    earlier: list[str],
    damage: Mapping[str, str],
    own: OwnStages,
    watchers: Watchers,
    means: _Means,
) -> dict[str, Any]:
    say = watchers.say
    start, untouched = time.perf_counter(), True
    record: dict[str, Any] = {
        "schema": SCHEMA,
        "checksum": "0" * 8,
        "status": "running",
        **_describe(config),
    }
    failed = True
    try:
        # Nothing of an earlier run is touched before the inputs are known to be there; then, before anything else
        # changes, its record no longer says that it is done, whatever happens to the power.
        journal = read_journal(out)
        plan = _plan(config, out, say, fresh=config.overwrite or not earlier)
        given, (config, plan) = config, resolve_shift(config, plan, say)
        untouched = False
        _write_record(out, record, durable=bool(earlier))
        clear_folder(out, earlier, overwrite=config.overwrite)
        if not in_bucket(out):
            if not earlier:  # after a loss of power there is nothing yet that the record could lie about
                sync_meanwhile(out / RUN_RECORD)
            shutil.rmtree(out / TASKS, ignore_errors=True)  # of workers that were killed
        save_config(given, out)
        # Where the files of city models are left out, the folder is that of an edit, which has no page.
        begin_watching(config, out, plan, own, watchers, shown=means.shown if means.city_files else None)
        record |= _mesh_region(config, out, plan, own, watchers, damage, means, add_up(journal))
        record |= {"edits": [edit.number for edit in journal]} if journal else {}
        stages = watchers.state.stages.items()
        record["finished"] = {name: stage.finished for name, stage in stages if stage.finished}
        for message in record["messages"][len(plan.messages) :]:
            say(message)
        _refuse_empty(config, record)
        give_back_report(out, changed=bool(record["tasks"]["ran"]))
        record["status"] = "done"
        say(describe_tasks(record["tasks"]))
        failed = False
    except StoppedError as error:
        record |= {"status": "stopped", "error": str(error)}
        raise
    except BaseException as error:
        record |= {"status": "failed", "error": describe_error(error)}
        raise
    finally:
        record["seconds_total"] = round(time.perf_counter() - start, 3)
        # A failure to write the record must not hide the error that ended the run.
        with suppress(OutputError) if failed else nullcontext():
            if not untouched:
                _write_record(out, record)
            watchers.end(record["status"], record.get("error", ""))
    return record


def _plan(config: Config, out: Path, say: Callable[[str], None], *, fresh: bool) -> Plan:
    """Plan a run; refuse inputs among its results and, unless it begins anew, the folder of another region."""
    plan = make_plan(config, say)
    for warning in _foresee(plan, config):
        plan.messages.append(warning)
        say(warning)
    refuse_inputs_within(out, [*(header.path for header in plan.headers), *map(place, config.inputs)])
    if not fresh:
        refuse_other_region(out, plan.region, config.inputs)
    return plan


def _refuse_empty(config: Config, record: dict[str, Any]) -> None:
    """Raise EmptyMeshError if footprints were given and no building was meshed, unless that is allowed."""
    if is_empty(config, record["counts"]) and not config.allow_empty:
        record["exit_code"] = EmptyMeshError.exit_code
        raise EmptyMeshError(record["empty"])


def _mesh_region(
    config: Config,
    out: Path,
    plan: Plan,
    own: OwnStages,
    watchers: Watchers,
    damage: Mapping[str, str],
    means: _Means,
    edits: Edits,
) -> dict[str, Any]:
    """Run all stages, and write the indexes of their pieces and the manifest.

    Where a file or a tile fails on the way to the city model, the region is planned again without it: what that
    does not touch has its result already. Where one fails later, its neighbours keep the seam with it.
    """
    missing = Missing()
    former = None if out == place(config.out) else Path(config.out) / STORE
    if not config.on_cluster:
        _prepare(config, watchers.say)
    with _executor(config, means, watchers.say) as executor:
        while True:
            engine = make_engine(config, out, plan, executor, own, watchers)
            with stops(engine.stop, watchers.say):
                try:
                    rounds = run_stages(engine, config, edits, former=former, city_files=means.city_files)
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
    indexes = {} if config.keep == IN_STORE else state_files(out, [out / name for name in INDEXES])
    write_manifest(out / MANIFEST_PATH, engine.records, indexes, config.keep)
    summary = summarise_run(engine, plan, config, rounds, missing, dict(damage) | remade)
    remove_dropped(out, {stage for stage, _ in engine.records}, config.keep)
    return summary | {"driver_memory_bytes": peak_memory()}


def _describe(config: Config) -> dict[str, Any]:
    """What a record says of the parameters of a run, and of the code."""
    versions = {"python": platform.python_version()} | dict(code_versions())
    return {"parameters": dataclasses.asdict(config), "versions": versions}


def _prepare(config: Config, say: Callable[[str], None]) -> None:
    try:
        prepare("planes" if config.has_sloped_roofs else config.mesher, config.workers, say)
    except KeyboardInterrupt:
        raise StoppedError("stopped before the first task; the same command begins again") from None


def use_absolute_paths(config: Config) -> Config:
    """Make the paths of a run absolute where it is on a cluster: a worker has another current folder."""
    if not config.on_cluster:
        return config
    return dataclasses.replace(
        with_absolute_inputs(config),
        out=absolute(config.out),
    )


def _connect(config: Config) -> AbstractContextManager[Executor | None]:
    """Connect to the scheduler of a run; None where there is none."""
    if not config.scheduler:
        return nullcontext()
    from tiler.executors.remote_cluster import connect_run

    return connect_run(config)


@contextmanager
def _executor(config: Config, means: _Means, say: Callable[[str], None]) -> Iterator[Executor]:
    """Give the executor of a run, and show its page; workers of this machine start with the first task."""
    with ExitStack() as stack:

        def show(executor: Executor) -> Executor:
            scheduler = getattr(executor, "scheduler", None)
            stack.enter_context(watched(means.shown, means.dashboard, scheduler, say))
            return executor

        if config.workers and means.cluster is None and not config.cluster:

            def start() -> Executor:
                from tiler.executors.local_cluster import local

                limits, where = limit_workers(config), means.dashboard or ANYWHERE
                return show(stack.enter_context(local(config.workers, limits, dashboard=where)))

            yield OnDemand(config.workers, start)
        else:
            yield show(stack.enter_context(_eager_executor(config, means, say)))


@contextmanager
def _eager_executor(config: Config, means: _Means, say: Callable[[str], None]) -> Iterator[Executor]:
    if means.cluster is not None:
        yield means.cluster
    elif config.cluster:
        from tiler.jobs.workers import worker_jobs

        cluster, folder = read_cluster(Path(config.cluster)), Path(config.out).absolute() / JOB
        with worker_jobs(
            cluster, folder, config.time_limit, dashboard=means.dashboard or ANYWHERE, say=say
        ) as executor:
            yield executor
    else:
        yield Serial()


@contextmanager
def _beside(out: Path, check: Callable[[], None], watchers: Watchers) -> Iterator[Path]:
    """Give the folder of the events that the page of a run is made of; of one in a bucket, watch its lease."""
    if not in_bucket(out):
        yield out
        return
    watchers.add(LeaseWatch(check))
    with tempfile.TemporaryDirectory(prefix="citystitch-") as name:
        yield Path(name)


def _find_damage(out: Path) -> dict[str, str]:
    """Describe what is wrong with the files of a finished run that belong to no result.

    Damaged results and their files are reported where they are made anew. Edits that came since are input.
    """
    found = Audit(out, deep=False).check_top()
    return {one.path: one.what for one in found if one.path != JOURNAL}


def _foresee(plan: Plan, config: Config) -> list[str]:
    """Name the roofs that stay flat against what was asked, and the tiles that may not fit into memory."""
    stay_flat = config.roofs != "flat" and not config.has_sloped_roofs
    flat = [warn_of_flat_roofs(config)] if stay_flat else []
    return flat + ([] if config.on_cluster else warn_of_memory(plan, config, memory=machine_memory()))


def warn_of_flat_roofs(config: Config) -> str:
    """Explain why roofs are flat although sloped ones were asked for."""
    why = f"mesher = {config.mesher}" if config.mesher != "adaptive" else f"simplify = {config.simplify}"
    return f"roofs are flat, not {config.roofs}: {why} has no sloped ones"


def describe_error(error: BaseException) -> str:
    """What an error that ends a run is, for its record."""
    return str(error) if isinstance(error, CityError) else f"{type(error).__name__}: {error}"


def _write_record(out: Path, record: dict[str, Any], *, durable: bool = True) -> None:
    with replacing(out / RUN_RECORD, durable=durable) as part:
        text = json.dumps(replace_surrogates(record), indent=1, default=str)
        part.write_bytes(seal(text.encode() + b"\n"))
