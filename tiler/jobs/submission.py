"""A run as a job of a batch system: `citystitch submit | cancel | logs`, and what `status` shows of jobs."""

import argparse
import dataclasses
import json
import os
import shlex
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.data.errors import ConfigError, InputError
from tiler.config.config import Config, make_config, with_absolute_inputs
from tiler.config.config_file import write_config
from tiler.jobs.cluster import LOGS, SYSTEMS, WORKER_JOBS, WORKER_NAME, Cluster, QueueError, read_cluster
from tiler.objects.places import in_bucket, place
from tiler.store.atomic import replacing
from tiler.words.plain_text import printable

JOB = "job"  # folder in that of a run, with all that its jobs need and print
RECORD, DESCRIPTION, PARAMETERS, SCRIPT = "job.json", "cluster.toml", "run.toml", "job.sh"
CANCELLED = "cancelled"  # an empty file: whoever writes the record at that moment does not undo it
NAME = "citystitch"  # of jobs
EVERY = 1.0  # s between two looks at logs that are followed
JOB_HELP = "number of a job, or folder of its run"

Command = Callable[[str, Callable[[argparse.Namespace], int], str], argparse.ArgumentParser]


@dataclass(frozen=True)
class JobRecord:
    """What the folder of a run remembers of its job."""

    type: str  # batch system
    jobs: tuple[str, ...]  # numbers of the jobs, one after the other
    state: str = "submitted"  # "running", "handed over", "cancelled", or how it ended
    results: tuple[int, ...] = ()  # how many there were when each of the jobs that have begun did so

    @property
    def job(self) -> str:
        """Number of the job that began last, or waits as the first one."""
        return self.jobs[max(len(self.results) - 1, 0)]

    @property
    def following(self) -> str:
        """Number of the job that begins when that one has ended; empty for none."""
        return "".join(self.jobs[max(len(self.results), 1) :])


def add_job_commands(command: Command, add_parameters: Callable[[argparse.ArgumentParser], None]) -> None:
    """Add the commands; `add_parameters` adds point clouds and parameters of a run."""
    submit = command("submit", _submit, "submit a run to a cluster's batch system: SLURM, PBS, SGE or LSF")
    submit.add_argument("--dry-run", action="store_true", help="print the scripts without submitting")
    add_parameters(submit)
    cancel = command("cancel", _cancel, "cancel the job of a run and its workers; results are kept")
    cancel.add_argument("job", metavar="JOB", help=JOB_HELP)
    logs = command("logs", _logs, "print the output of the jobs of a run")
    logs.add_argument("job", metavar="JOB", help=JOB_HELP)
    logs.add_argument("--workers", action="store_true", help="also of the workers")
    logs.add_argument("-f", "--follow", action="store_true", help="follow the output, until Ctrl-C")


def find_run(job: str) -> Path:
    """Folder of a run, by itself or by the number of its job; InputError for an unknown number."""
    number = job.partition(".")[0]
    if Path(job).is_dir() or not number.isdigit():
        return place(job)
    try:
        return Path((_folders() / number).read_text().strip())
    except OSError as error:
        raise InputError(
            f"{job}: no job of yours that was submitted from this account; give the folder of its run"
        ) from error


def submit(config: Config, *, dry_run: bool = False) -> str:
    """Submit a run as a job; returns what the user should read. A dry run writes nothing and returns the scripts.

    Raises
    ------
    ConfigError
        If the cluster's description is wrong, the folder has a job that is not over, or it is to be overwritten.
    QueueError
        If the batch system refuses the job.
    """
    if not config.cluster:
        raise ConfigError("submit: no cluster is described; give --cluster FILE.toml, see deploy/slurm/slurm.toml")
    if config.overwrite:
        raise ConfigError("--overwrite: each job would begin anew; remove the folder, or give another --out")
    cluster, out = read_cluster(Path(config.cluster)), Path(config.out).absolute()
    script = controller_script(cluster, out)
    if dry_run:
        from tiler.jobs.workers import worker_script

        worker = worker_script(cluster, out / JOB)
        return f"# {out / JOB / SCRIPT}\n{script}\n# a worker, as dask-jobqueue submits it\n{worker}".rstrip()
    if (out / JOB / RECORD).exists() and (living := living_jobs(read_record(out))):
        raise ConfigError(f"{out}: job {living[0]} is not over; citystitch cancel {out}, or give another --out")
    _write_files(config, out, script)
    job = cluster.system.submit(out / JOB / SCRIPT)
    write_record(out, JobRecord(cluster.type, (job,)))
    return f"job {job}; citystitch status {job} tells how far it is"


def controller_script(cluster: Cluster, out: Path) -> str:
    """Script of the job that runs the driver."""
    options = cluster.job_options(NAME, cluster.controller, out / JOB / LOGS)
    job = cluster.system.cluster_class().job_cls(name=NAME, **options)
    command = f"exec {cluster.command} -m tiler.jobs.controller {shlex.quote(str(out))}"
    return "\n".join([job.shebang, "", job.job_header, *cluster.prologue, command]) + "\n"


def read_record(out: Path) -> JobRecord:
    """What a folder remembers of its job; InputError where it has none, or a damaged file."""
    path = out / JOB / RECORD
    try:
        values = json.loads(path.read_bytes())
        record = JobRecord(**values | {name: tuple(values[name]) for name in ("jobs", "results")})
        if record.type not in SYSTEMS or not record.job:
            raise ValueError(record.type)
    except FileNotFoundError as error:
        raise InputError(
            f"{out}: has no job; give the number of a job, or the folder of a run that was submitted"
        ) from error
    except (OSError, ValueError, TypeError, LookupError) as error:
        raise InputError(f"{path}: is damaged ({error!r}); remove it, and submit again") from error
    return dataclasses.replace(record, state="cancelled") if is_cancelled(out) else record


def is_cancelled(out: Path) -> bool:
    """Return whether `cancel` was asked for."""
    return (out / JOB / CANCELLED).exists()


def write_record(out: Path, record: JobRecord) -> None:
    """Remember a job in its folder, and where that is by its number."""
    with replacing(out / JOB / RECORD, durable=True) as part:
        part.write_text(json.dumps(dataclasses.asdict(record), indent=1) + "\n")
    _folders().mkdir(parents=True, exist_ok=True)
    (_folders() / record.jobs[-1]).write_text(f"{out}\n")


def change_record(out: Path, **values: Any) -> None:
    """Change what a folder remembers of its job."""
    write_record(out, dataclasses.replace(read_record(out), **values))


def living_jobs(record: JobRecord) -> list[str]:
    """Those jobs of a record that wait or run, the last one first."""
    states = SYSTEMS[record.type].states()
    return [job for job in reversed(record.jobs) if job in states]


def describe_job(out: Path) -> dict[str, Any] | None:
    """Describe the job of a run: its record, its state in the ``queue``, ``workers``; None without one."""
    if in_bucket(out) or not (out / JOB / RECORD).exists():
        return None
    record = read_record(out)
    described = dataclasses.asdict(record) | {"job": record.job}
    try:
        states = SYSTEMS[record.type].states()
    except QueueError as error:
        return described | {"queue": "", "workers": None, "error": str(error)}
    return described | {"queue": states.get(record.job, ""), "workers": len(read_worker_jobs(out) & states.keys())}


def job_line(job: dict[str, Any]) -> str:
    """Write one line on a job, as `describe_job` describes it."""
    error = job.get("error")
    queue = f"its queue does not answer: {error}" if error else f"in the queue {job['queue'] or 'no more'}"
    words = [f"job {job['job']} ({job['type']}): {job['state']}", queue]
    words += [f"{job['workers']} worker jobs"] if job["workers"] else []
    words += [f"of jobs {', '.join(job['jobs'])}"] if len(job["jobs"]) > 1 else []
    return ", ".join(words)


def cancel(out: Path) -> str:
    """Cancel the job of a run, its workers, and the job that would follow it; returns what was done."""
    record = read_record(out)
    jobs, system = living_jobs(record), SYSTEMS[record.type]
    if not jobs:
        return f"job {record.job} is over already ({record.state})"
    (out / JOB / CANCELLED).touch()  # first: nothing is submitted any more
    system.cancel(jobs)
    system.cancel(sorted(read_worker_jobs(out) & system.states().keys()))
    return f"job {record.job} is cancelled; what it has done is kept"


def read_worker_jobs(out: Path) -> set[str]:
    """Numbers of the worker jobs that were last known to wait or run."""
    try:
        return set(map(str, json.loads((out / JOB / WORKER_JOBS).read_bytes())))
    except (OSError, ValueError, TypeError):
        return set()


def _write_files(config: Config, out: Path, script: str) -> None:
    """Keep what the jobs run: nothing that is changed afterwards changes them."""
    folder = out / JOB
    kept = dataclasses.replace(with_absolute_inputs(config), cluster="", out="out")
    text = write_config(kept, "the parameters of a submitted run")
    try:
        (folder / LOGS).mkdir(parents=True, exist_ok=True)
        (folder / CANCELLED).unlink(missing_ok=True)
        shutil.copyfile(config.cluster, folder / DESCRIPTION)
        (folder / PARAMETERS).write_text(text, encoding="utf-8", errors="surrogateescape")
        (folder / SCRIPT).write_text(script)
    except OSError as error:
        raise ConfigError(f"{folder}: cannot be written ({error.strerror}); give another --out") from error


def _folders() -> Path:
    """Folder that knows the folders of runs by the numbers of their jobs."""
    state = os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"
    return Path(state) / NAME / "jobs"


def _submit(options: argparse.Namespace) -> int:
    from tiler.config.config_file import with_file
    from tiler.planning.plan import check_sources

    config = make_config(with_file(vars(options)))
    if not options.dry_run:
        check_sources(config)
    print(submit(config, dry_run=options.dry_run))
    return 0


def _cancel(options: argparse.Namespace) -> int:
    print(printable(cancel(find_run(options.job))))
    return 0


def _logs(options: argparse.Namespace) -> int:
    """Print the files into which the jobs of a run print, the oldest first, then what is added to them."""
    out = find_run(options.job)
    folder, printed = out / JOB / LOGS, dict[Path, int]()
    while True:
        paths = [path for path in folder.glob("*") if options.workers or not path.name.startswith(WORKER_NAME)]
        if not paths:
            raise InputError(f"{folder}: nothing is printed yet; citystitch status {out} tells where the job is")
        for path in sorted(paths, key=lambda path: (path.stat().st_mtime_ns, path.name)):
            if path not in printed:
                print(f"== {printable(str(path))}")
            try:
                text = path.read_text(errors="replace")
            except OSError as error:
                raise InputError(f"{path}: cannot be read ({error.strerror}); check its permissions") from error
            for line in text[printed.get(path, 0) :].splitlines():
                print(printable(line), flush=True)
            printed[path] = len(text)
        if not options.follow:
            return 0
        time.sleep(EVERY)
