"""A cluster, as its administrator describes it in a TOML file, and the commands of its batch system."""

import dataclasses
import getpass
import re
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, get_type_hints

from pipeline.data.errors import CityError, ConfigError

LOGS, WORKER_JOBS = "logs", "workers.json"  # in the folder of a job; the numbers of worker jobs that wait or run
WORKER_NAME = "citystitch-worker"  # of jobs
WALLTIME = re.compile(r"(?:(\d+)-)?(\d{1,3}):([0-5]\d):([0-5]\d)")
TEMPLATE = "see deploy/slurm/slurm.toml"
LEAST_TIME = 30.0  # s that a job must have between its start and the time at which it ends by itself
PATIENCE = 60.0  # s that a command of a batch system may take


class QueueError(CityError):
    """A command of the batch system failed: look at what it says."""


@dataclass(frozen=True)
class ControllerJob:
    """The job that runs the driver; its values are explained in ``deploy/slurm/slurm.toml``."""

    processes: ClassVar[int] = 1

    walltime: float = 86400.0  # s
    margin: float = 300.0  # s
    memory: float = 4.0  # GiB
    cores: int = 1
    resubmissions: int = 3
    options: tuple[str, ...] = ()


@dataclass(frozen=True)
class WorkerJob:
    """A job of worker processes, of one thread each; its values are explained in ``deploy/slurm/slurm.toml``."""

    min_workers: int = 0
    max_workers: int = 16
    processes: int = 1
    walltime: float = 14400.0  # s
    margin: float = 300.0  # s
    stagger: float = 300.0  # s
    idle: float = 120.0  # s
    memory: float = 4.0  # GiB of a worker process
    scratch: str = "${TMPDIR:-/tmp}"  # the shell sees it in double quotes
    options: tuple[str, ...] = ()

    @property
    def cores(self) -> int:
        """Cores of a job: one for each process."""
        return self.processes

    @property
    def lifetime(self) -> float:
        """Mean time after which a worker retires (s); `stagger` is added or taken away at most."""
        return self.walltime - self.margin - self.stagger


@dataclass(frozen=True)
class Cluster:
    """A cluster and the jobs of a run on it; its values are explained in ``deploy/slurm/slurm.toml``."""

    type: str = "slurm"  # one of `SYSTEMS`
    partition: str = ""
    account: str = ""
    setup: tuple[str, ...] = ()
    modules: tuple[str, ...] = ()
    container: str = ""
    python: str = ""
    interface: str = ""
    tls: bool = True
    controller: ControllerJob = field(default_factory=ControllerJob)
    worker: WorkerJob = field(default_factory=WorkerJob)

    @property
    def system(self) -> "BatchSystem":
        """Its batch system."""
        return SYSTEMS[self.type]

    @property
    def command(self) -> str:
        """Command of the shell that runs Python on a node."""
        return f"{self.container} {self.python or shlex.quote(sys.executable)}".strip()

    @property
    def prologue(self) -> list[str]:
        """Lines of shell that every job begins with."""
        return [*self.setup, *(f"module load {module}" for module in self.modules)]

    def job_options(self, name: str, job: ControllerJob | WorkerJob, logs: Path) -> dict[str, Any]:
        """What a class of dask-jobqueue takes for a job that prints into the folder `logs`."""
        minutes, seconds = divmod(int(job.walltime), 60)
        clock = f"{minutes // 60:02d}:{minutes % 60:02d}"
        lines = [line.format(log=logs / name, logs=logs) for line in self.system.directives]
        return {
            "job_name": name,
            "cores": job.cores,
            "processes": job.processes,
            "memory": f"{job.processes * job.memory:g} GiB",
            "queue": self.partition or None,
            self.system.account: self.account or None,
            "walltime": f"{clock}:{seconds:02d}" if self.system.seconds else clock,
            "job_extra_directives": [*lines, *job.options],
            "job_script_prologue": self.prologue,
        }


@dataclass(frozen=True)
class BatchSystem:
    """What dask-jobqueue does not know of a batch system, and its commands."""

    library: str  # class of dask-jobqueue
    account: str  # what that class calls the account
    directives: tuple[str, ...]  # further ones; ``{log}`` is the path of a log without its end
    after: tuple[str, ...]  # words of a submission that waits for the end of ``{job}``, however that ends
    ask: str  # command that lists the jobs of ``{user}`` that wait or run
    row: str  # a line of this list, with the groups ``job`` and ``state``
    seconds: bool = True  # whether a walltime has seconds

    def cluster_class(self) -> Any:
        """Class of dask-jobqueue, whose ``job_cls`` has directives and commands; ConfigError without it."""
        try:
            import dask_jobqueue
        except ImportError as error:
            raise ConfigError(f'jobs need dask-jobqueue ({error}); pip install "citystitch[cluster]"') from error
        return getattr(dask_jobqueue, self.library)

    def submit(self, script: Path, *, after: str = "") -> str:
        """Submit a script, to wait for the end of the job `after`, if given; returns its number, or QueueError."""
        job = self.cluster_class().job_cls
        words = [*shlex.split(job.submit_command), *(word.format(job=after) for word in self.after if after)]
        text = _call(words, script.read_text())
        found = re.search(job.job_id_regexp, text)
        if found is None:
            raise QueueError(f"{words[0]} printed no number of a job: {text.strip()!r}")
        return str(found["job_id"])

    def cancel(self, jobs: Sequence[str]) -> None:
        """Cancel jobs; those that are gone already do not matter."""
        for job in jobs:
            _call([*shlex.split(self.cluster_class().job_cls.cancel_command), job], check=False)

    def states(self) -> dict[str, str]:
        """States of this user's jobs that wait or run, in the system's words, by their numbers; or QueueError."""
        text = _call(shlex.split(self.ask.format(user=getpass.getuser())))
        return {found["job"]: found["state"] for found in re.finditer(self.row, text, re.MULTILINE)}


# fmt: off
SYSTEMS: Mapping[str, BatchSystem] = {
    "slurm": BatchSystem(
        "SLURMCluster", "account", ("--output={log}-%j.log", "--no-requeue"), ("--dependency=afterany:{job}",),
        "squeue --noheader --me --format=%A=%T", r"^(?P<job>\d+)=(?P<state>\w+)$",
    ),
    "pbs": BatchSystem(
        "PBSCluster", "account", ("-j oe", "-o {logs}/", "-r n"), ("-W", "depend=afterany:{job}"),
        "qstat -u {user}", r"^(?P<job>\d+)\S* .* (?P<state>[A-Z]) +\S+ *$",
    ),
    "sge": BatchSystem(  # a job with an E in its state waits for its administrator
        "SGECluster", "project", ("-S /bin/bash", "-o {logs}/", "-r n"), ("-hold_jid", "{job}"),
        "qstat -u {user}", r"^ *(?P<job>\d+) +\S+ +\S+ +\S+ +(?P<state>[^E\s]+) ",
    ),
    "lsf": BatchSystem(
        "LSFCluster", "project", ("-o {log}-%J.log", "-rn"), ("-w", "ended({job})"),
        'bjobs -noheader -o "jobid stat"', r"^(?P<job>\d+) +(?P<state>\w+)", seconds=False,
    ),
}
# fmt: on


def read_cluster(path: Path) -> Cluster:
    """Read the description of a cluster; ConfigError for an unknown key, or a value that cannot be."""
    try:
        values: dict[str, Any] = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror}); {TEMPLATE}") from error
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: not valid TOML ({error}); {TEMPLATE}") from error
    cluster: Cluster = _make(f"{path}: ", Cluster, values)
    _check_together(path, cluster)
    return cluster


def _make(place: str, kind: Any, given: Mapping[str, Any]) -> Any:
    hints = {entry.name: get_type_hints(kind)[entry.name] for entry in dataclasses.fields(kind)}
    for name in given.keys() - hints:
        raise ConfigError(f"{place}unknown key {name}; one of {', '.join(hints)} expected")
    return kind(**{name: _convert(f"{place}{name}", value, hints[name]) for name, value in given.items()})


def _convert(place: str, value: Any, wanted: Any) -> Any:
    if dataclasses.is_dataclass(wanted):
        if not isinstance(value, dict):
            raise ConfigError(f"{place}: a section expected")
        return _make(f"{place}.", wanted, value)
    if place.endswith(".walltime"):
        if not isinstance(value, str) or (found := WALLTIME.fullmatch(value)) is None:
            raise ConfigError(f'{place} = {value!r}: a text like "04:00:00" or "1-00:00:00" expected')
        days, hours, minutes, seconds = (int(part or 0) for part in found.groups())
        return float(((days * 24 + hours) * 60 + minutes) * 60 + seconds)
    if wanted == tuple[str, ...]:
        if not isinstance(value, list):
            raise ConfigError(f"{place}: a list of texts expected")
        return tuple(_convert(place, item, str) for item in value)
    if wanted is float and type(value) is int:
        value = float(value)
    if type(value) is not wanted:
        raise ConfigError(f"{place} = {value!r}: {wanted.__name__} expected")
    if wanted in (int, float) and not 0 <= value < 1e9:
        raise ConfigError(f"{place} = {value:g}: must be at least 0 and below 1e9")
    return value


def _check_together(path: Path, cluster: Cluster) -> None:
    controller, worker = cluster.controller, cluster.worker
    if cluster.type not in SYSTEMS:
        raise ConfigError(f"{path}: type = {cluster.type!r}: must be one of {', '.join(SYSTEMS)}")
    for place, value, bound, unit in (
        ("worker.processes", worker.processes, 1, ""),
        ("worker.max_workers", worker.max_workers, max(1, worker.min_workers), ""),
        ("controller.cores", controller.cores, 1, ""),
        ("controller.memory", controller.memory, 0.5, " GiB"),
        ("worker.memory", worker.memory, 0.5, " GiB"),
        ("controller.walltime less margin", controller.walltime - controller.margin, LEAST_TIME, " s"),
        ("worker.walltime less margin and twice stagger", worker.lifetime - worker.stagger, LEAST_TIME, " s"),
    ):
        if value < bound:
            raise ConfigError(f"{path}: {place} = {value:g}{unit}: must be at least {bound:g}{unit}; raise it")


def _call(words: Sequence[str], text: str = "", *, check: bool = True) -> str:
    """Run a command of the batch system, which reads `text`; returns what it prints."""
    try:
        done = subprocess.run(words, input=text, capture_output=True, text=True, timeout=PATIENCE, check=False)
    except FileNotFoundError as error:
        raise QueueError(f"{words[0]}: no such command here; log in where jobs are submitted") from error
    except subprocess.TimeoutExpired as error:
        raise QueueError(f"{words[0]}: no answer after {PATIENCE:g} s; is the batch system at work?") from error
    said = " ".join((done.stderr or done.stdout).split())
    if check and done.returncode and "No unfinished job" not in said:  # what LSF calls an empty list
        raise QueueError(f"{shlex.join(words)}: failed with {done.returncode}: {said}")
    return done.stdout
