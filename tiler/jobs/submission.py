"""A run as jobs of a batch system: its scripts, what its folder remembers of it, and how to ask for and end it."""

import dataclasses
import json
import os
import re
import shlex
import shutil
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.errors import ConfigError, InputError
from tiler.config.config import Config, write_config
from tiler.jobs.jobqueue import JOB, NANNY, begin_words, python_words, read_worker_jobs, worker_script
from tiler.jobs.queues import QUEUES, STOP_SIGNAL, JobSize, Queue, QueueError
from tiler.jobs.table import Cluster, read_cluster
from tiler.objects.places import absolute
from tiler.store.atomic import replacing

RECORD, TABLE, PARAMETERS, SCRIPT = "job.json", "cluster.toml", "run.toml", "job.sh"
LOGS = "logs"
CANCELLED = "cancelled"  # an empty file: whoever writes the record at that moment does not undo it
NUMBER = re.compile(r"\d+(\[\])?(\.[\w.-]+)?")
LIVING = ("submitted", "running", "handed over")  # how a job may stand that is not over


@dataclass(frozen=True)
class JobRecord:
    """What the folder of a run remembers of its job.

    Attributes
    ----------
    type : str
        Batch system.
    job : str
        Number of the job that was submitted last.
    earlier : tuple of str
        Those before it.
    state : str
        ``"submitted"``, ``"running"``, ``"handed over"``, ``"cancelled"``, or how it ended.
    array : int
        Number of elements; 0 for a controller with workers.
    best : int
        Results that were there when a controller last began.
    idle : int
        Controllers in a row that added none.
    """

    type: str
    job: str
    earlier: tuple[str, ...] = ()
    state: str = "submitted"
    array: int = 0
    best: int = 0
    idle: int = 0

    def change(self, **values: Any) -> "JobRecord":
        """Return it with other values."""
        return dataclasses.replace(self, **values)


def submit(config: Config, *, array: int = 0, dry_run: bool = False) -> str:
    """Submit a run as a job, with workers as further jobs, or as an array of jobs without them.

    Parameters
    ----------
    config : Config
        Parameters of the run; ``cluster`` is the file that describes the cluster.
    array : int
        Number of elements of an array, each of which runs `citystitch join`; 0 for a controller with workers.
    dry_run : bool
        Write and submit nothing.

    Returns
    -------
    str
        What the user should read: the number of the job, or the scripts.

    Raises
    ------
    ConfigError
        If the description of the cluster is wrong, the folder has a job that is not over, or ``overwrite`` is
        asked for: every job goes on with what the one before has left.
    QueueError
        If the batch system refuses the job.
    """
    if not config.cluster:
        raise ConfigError("submit: no cluster is described; give --cluster FILE.toml, see deploy/slurm/slurm.toml")
    if config.overwrite:
        raise ConfigError("--overwrite: each job would begin anew; remove the folder, or give another --out")
    table = read_cluster(Path(config.cluster))
    out = Path(os.path.abspath(config.out))
    folder = out / JOB
    script = array_script(table, out, array) if array else controller_script(table, out)
    if dry_run:
        scripts = {f"# {folder / SCRIPT}": script}
        scripts |= {} if array else {"# a worker, as dask-jobqueue submits it": worker_script(table, folder)}
        return "\n".join(f"{title}\n{text}" for title, text in scripts.items()).rstrip()
    earlier = read_record(out)
    if earlier is not None and _is_alive(earlier):
        raise ConfigError(f"{out}: job {earlier.job} is not over; citystitch cancel {out}, or give another --out")
    _write_files(config, out, script)
    job = QUEUES[table.type].submit(folder / SCRIPT)
    write_record(out, JobRecord(table.type, job, array=array))
    return f"job {job}; citystitch status {job} tells how far it is"


def controller_script(table: Cluster, out: Path) -> str:
    """Script of the job that runs the driver; the signal is ignored until the driver listens to it."""
    size = JobSize(
        "citystitch",
        out / JOB / LOGS / "controller-{job}.log",
        table.controller.walltime,
        int(table.controller.memory * 2**30),
        table.controller.cores,
        table.controller.options,
        warn=table.controller.margin,
    )
    command = f"exec {python_words(table)} -m tiler.jobs.controller {shlex.quote(str(out))}"
    lines = [*QUEUES[table.type].header(table, size), "", f"trap '' {STOP_SIGNAL}", *begin_words(table), command]
    return "\n".join(lines) + "\n"


def array_script(table: Cluster, out: Path, n: int) -> str:
    """Script of an array of jobs that share the tiles of a run through its folder alone."""
    worker = table.worker
    size = JobSize(
        "citystitch",
        out / JOB / LOGS / "member-{job}-{member}.log",
        worker.walltime,
        worker.processes * int(worker.memory * 2**30) + NANNY,
        worker.processes,
        worker.options,
        warn=worker.margin,
        array=n,
    )
    words = ["join", str(out / JOB / PARAMETERS), "--out", str(out)]
    words += ["--workers", str(worker.processes), "--memory-limit", f"{worker.memory:g}"]
    command = f"exec {python_words(table)} -m tiler.cli.main {shlex.join(words)}"
    lines = [*QUEUES[table.type].header(table, size), "", *begin_words(table), command]
    return "\n".join(lines) + "\n"


def run_words(out: Path) -> list[str]:
    """Words behind ``citystitch`` that run what was submitted."""
    folder = out / JOB
    return ["run", str(folder / PARAMETERS), "--out", str(out), "--cluster", str(folder / TABLE)]


def find_folder(job: str) -> Path:
    """Folder of a run, by itself or by the number of its job.

    Raises
    ------
    InputError
        If it is neither.
    """
    if Path(job).is_dir() or not NUMBER.fullmatch(job):
        return Path(job)
    try:
        return Path((_places() / job).read_text().strip())
    except OSError as error:
        raise InputError(
            f"{job}: no job of yours that was submitted from this account; give the folder of its run"
        ) from error


def read_record(out: Path) -> JobRecord | None:
    """What a folder remembers of its job; None where there was none.

    Raises
    ------
    InputError
        If the file is damaged.
    """
    path = out / JOB / RECORD
    try:
        values = json.loads(path.read_bytes())
        values["earlier"] = tuple(values["earlier"])
        record = JobRecord(**values)
        if record.type not in QUEUES:
            raise ValueError(record.type)
        if (path.parent / CANCELLED).exists():
            record = record.change(state="cancelled")
    except FileNotFoundError:
        return None
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise InputError(f"{path}: is damaged ({error!r}); remove it, and submit again") from error
    return record


def write_record(out: Path, record: JobRecord) -> None:
    """Remember a job in its folder, and where that is by its number."""
    with replacing(out / JOB / RECORD, durable=True) as part:
        part.write_text(json.dumps(dataclasses.asdict(record), indent=1) + "\n")
    places = _places()
    places.mkdir(parents=True, exist_ok=True)
    (places / record.job).write_text(f"{out}\n")


def tell_job(out: Path) -> dict[str, Any] | None:
    """Tell how the job of a run stands: its record, and ``queue``, the batch system's own word for its state."""
    record = read_record(out)
    if record is None:
        return None
    try:
        queue = QUEUES[record.type].states([record.job]).get(record.job, "")
        workers = _living(QUEUES[record.type], read_worker_jobs(out / JOB))
    except QueueError as error:
        return dataclasses.asdict(record) | {"queue": "", "workers": None, "error": str(error)}
    return dataclasses.asdict(record) | {"queue": queue, "workers": len(workers)}


def cancel(out: Path) -> str:
    """Cancel the job of a run, its workers, and the job that would follow it; returns what was done.

    Raises
    ------
    InputError
        If the run has no job.
    """
    record = read_record(out)
    if record is None:
        raise InputError(f"{out}: has no job; give the number of a job, or the folder of a run that was submitted")
    if not _is_alive(record):
        return f"job {record.job} is over already ({record.state})"
    queue = QUEUES[record.type]
    (out / JOB / CANCELLED).touch()  # first: nothing is submitted any more
    before = record.earlier[-1:] if record.state == "handed over" else ()
    queue.cancel([record.job, *before])
    queue.cancel(_living(queue, read_worker_jobs(out / JOB)))
    return f"job {record.job} is cancelled; what it has done is kept"


def list_logs(out: Path, *, workers: bool = False) -> list[Path]:
    """Files into which the jobs of a run print, the oldest first; those of workers too, if asked for.

    Raises
    ------
    InputError
        If there are none.
    """
    folder = out / JOB / LOGS
    found = [path for path in folder.glob("*") if workers or not path.name.startswith("worker-")]
    if not found:
        raise InputError(f"{folder}: no job has printed anything yet; citystitch status {out} tells where it is")
    return sorted(found, key=lambda path: (path.stat().st_mtime_ns, path.name))


def _write_files(config: Config, out: Path, script: str) -> None:
    """Keep what the jobs run: nothing that is changed afterwards changes them."""
    folder = out / JOB
    try:
        (folder / LOGS).mkdir(parents=True, exist_ok=True)
        (folder / CANCELLED).unlink(missing_ok=True)
        shutil.copyfile(config.cluster, folder / TABLE)
        given = dataclasses.replace(
            config,
            pointcloud=tuple(map(absolute, config.pointcloud)),
            footprints=absolute(config.footprints) if config.footprints else "",
            cluster="",
            scheduler="",
            out="out",
        )
        (folder / PARAMETERS).write_text(
            write_config(given, "the parameters of a submitted run"), encoding="utf-8", errors="surrogateescape"
        )
        (folder / SCRIPT).write_text(script)
        (folder / SCRIPT).chmod(0o755)
    except OSError as error:
        raise ConfigError(f"{folder}: cannot be written ({error.strerror}); give another --out") from error


def _is_alive(record: JobRecord) -> bool:
    if record.state not in LIVING:
        return False
    queue = QUEUES[record.type]
    return queue.is_alive(queue.states([record.job]).get(record.job))


def _living(queue: Queue, jobs: list[str]) -> list[str]:
    states = queue.states(jobs) if jobs else {}
    return [job for job in jobs if queue.is_alive(states.get(job))]


def _places() -> Path:
    """Folder that knows the folders of jobs by their numbers."""
    state = os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"
    return Path(state) / "citystitch" / "jobs"


def count_results(out: Path) -> int:
    """Number of results that the run in a folder has told of; 0 where it has told of none."""
    try:
        stages = json.loads((out / "progress.json").read_bytes())["stages"].values()
        return sum(int(stage["done"]) for stage in stages)
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return 0


def now() -> str:
    """Tell the time of day for a log."""
    return time.strftime("%Y-%m-%d %H:%M:%S")
