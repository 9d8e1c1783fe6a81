"""What an administrator states of a cluster, once, as TOML: queue, software, and the size of jobs."""

import dataclasses
import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, get_type_hints

from pipeline.errors import ConfigError

TYPES = ("slurm", "pbs", "sge", "lsf")
WALLTIME = re.compile(r"(?:(\d+)-)?(\d{1,3}):([0-5]\d):([0-5]\d)")
MAX_BYTES = 100_000
LEAST_LIFE = 30.0  # s that a job must have between its start and the time at which it ends by itself


@dataclass(frozen=True)
class ControllerJob:
    """The job that runs the driver.

    Attributes
    ----------
    walltime : float
        Its time limit (s), ``"1-00:00:00"`` in the file.
    margin : float
        Before its time limit it stops and hands over to a new job (s).
    memory : float
        Memory (GiB).
    cores : int
        Cores.
    resubmissions : int
        How many jobs in a row may end without any new result before none follows.
    options : tuple of str
        Further directives, as the batch system writes them behind its prefix.
    """

    walltime: float = 86400.0
    margin: float = 300.0
    memory: float = 4.0
    cores: int = 1
    resubmissions: int = 3
    options: tuple[str, ...] = ()


@dataclass(frozen=True)
class WorkerJob:
    """A job of worker processes, of one thread each.

    Attributes
    ----------
    min_workers, max_workers : int
        Bounds of the number of worker processes; within them it follows the work.
    processes : int
        Worker processes of a job.
    walltime : float
        Time limit of a job (s).
    margin : float
        Workers take their last task at the latest so long before that (s).
    stagger : float
        They retire spread over twice this time before (s).
    idle : float
        A worker without work for so long is given back (s).
    memory : float
        Memory of a worker process (GiB).
    scratch : str
        Folder on the node for what a worker writes for itself; the shell sees it in double quotes.
    options : tuple of str
        Further directives.
    """

    min_workers: int = 0
    max_workers: int = 16
    processes: int = 1
    walltime: float = 14400.0
    margin: float = 300.0
    stagger: float = 300.0
    idle: float = 120.0
    memory: float = 4.0
    scratch: str = "${TMPDIR:-/tmp}"
    options: tuple[str, ...] = ()

    @property
    def lifetime(self) -> float:
        """Mean time after which a worker retires (s); `stagger` is added or taken away at most."""
        return self.walltime - self.margin - self.stagger


@dataclass(frozen=True)
class Cluster:
    """A cluster and the jobs of a run on it.

    Attributes
    ----------
    type : str
        Batch system, one of `TYPES`.
    partition, account : str
        Partition or queue, and account or project; empty for the default ones.
    setup : tuple of str
        Lines of shell that each job begins with.
    modules : tuple of str
        Modules that are loaded after them.
    container : str
        Command that is put before the interpreter.
    python : str
        Interpreter on the nodes; empty for the one that reads this.
    interface : str
        Network interface on which nodes reach each other; empty for that of the default route.
    tls : bool
        Encrypt what is sent, with certificates made for the run, and let nobody else in.
    controller : ControllerJob
        The job of the driver.
    worker : WorkerJob
        The jobs of workers; elements of an array have their walltime and the memory of one process.
    """

    type: str = "slurm"
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


def read_cluster(path: Path) -> Cluster:
    """Read the description of a cluster.

    Raises
    ------
    ConfigError
        If it cannot be read, is no TOML, or has an unknown key or a value that cannot be.
    """
    try:
        with path.open("rb") as file:
            content = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror}); see deploy/slurm/slurm.toml") from error
    if len(content) > MAX_BYTES:
        raise ConfigError(f"{path}: more than {MAX_BYTES} bytes; see deploy/slurm/slurm.toml for a template")
    try:
        table = tomllib.loads(content.decode())
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: not valid TOML ({error}); see deploy/slurm/slurm.toml") from error
    values: dict[str, Any] = dict(table)
    for name, kind in (("controller", ControllerJob), ("worker", WorkerJob)):
        given = values.pop(name, {})
        if not isinstance(given, dict):
            raise ConfigError(f"{path}: {name}: a section [{name}] expected")
        values[name] = kind(**_check(path, f"{name}.", kind, given))
    jobs = {name: values.pop(name) for name in ("controller", "worker")}
    cluster = Cluster(**_check(path, "", Cluster, values), **jobs)
    _check_together(path, cluster)
    return cluster


def read_walltime(text: str) -> float:
    """Seconds of ``[DAYS-]HH:MM:SS``; ValueError if it is not that.

    Examples
    --------
    >>> read_walltime("1-02:00:30")
    93630.0
    """
    found = WALLTIME.fullmatch(text)
    if found is None:
        raise ValueError(text)
    days, hours, minutes, seconds = (int(part or 0) for part in found.groups())
    return float(((days * 24 + hours) * 60 + minutes) * 60 + seconds)


def _check(path: Path, place: str, kind: type, given: Mapping[str, Any]) -> dict[str, Any]:
    hints = get_type_hints(kind)
    known = [entry.name for entry in dataclasses.fields(kind)]
    values = {}
    for name, value in given.items():
        if name not in known:
            raise ConfigError(f"{path}: unknown key {place}{name}; one of {', '.join(known)} expected")
        values[name] = _convert(f"{path}: {place}{name}", name, value, hints[name])
    return values


def _convert(place: str, name: str, value: Any, wanted: Any) -> Any:
    if name == "walltime":
        try:
            return read_walltime(value)
        except (TypeError, ValueError):
            raise ConfigError(f'{place} = {value!r}: a text like "04:00:00" or "1-00:00:00" expected') from None
    if wanted == tuple[str, ...]:
        if not isinstance(value, list) or not all(isinstance(item, str) for item in value):
            raise ConfigError(f"{place}: a list of texts expected")
        return tuple(_check_line(place, item) for item in value)
    if wanted is float and type(value) is int:
        value = float(value)
    if type(value) is not wanted:
        raise ConfigError(f"{place} = {value!r}: {wanted.__name__} expected")
    if wanted is str:
        return _check_line(place, value)
    if wanted is not bool and not 0 <= value < 1e9:
        raise ConfigError(f"{place} = {value:g}: must be at least 0 and below 1e9")
    return value


def _check_line(place: str, text: str) -> str:
    if not text.isprintable():
        raise ConfigError(f"{place}: one line without control characters expected")
    return text


def _check_together(path: Path, cluster: Cluster) -> None:
    controller, worker = cluster.controller, cluster.worker
    if cluster.type not in TYPES:
        raise ConfigError(f"{path}: type = {cluster.type!r}: must be one of {', '.join(TYPES)}")
    for name, count in (("worker.max_workers", worker.max_workers), ("worker.processes", worker.processes)):
        if count < 1:
            raise ConfigError(f"{path}: {name} = {count}: must be at least 1")
    if controller.cores < 1:
        raise ConfigError(f"{path}: controller.cores = {controller.cores}: must be at least 1")
    if worker.min_workers > worker.max_workers:
        raise ConfigError(
            f"{path}: worker.min_workers = {worker.min_workers}: must be at most max_workers = "
            f"{worker.max_workers}"
        )
    for name, memory in (("controller", controller.memory), ("worker", worker.memory)):
        if memory < 0.5:
            raise ConfigError(f"{path}: {name}.memory = {memory:g} GiB: must be at least 0.5 GiB")
    shortest = {
        "controller": controller.walltime - controller.margin,
        "worker": worker.lifetime - worker.stagger,
    }
    for name, life in shortest.items():
        if life < LEAST_LIFE:
            less = "margin" if name == "controller" else "margin and twice stagger"
            raise ConfigError(
                f"{path}: {name}.walltime less {less} leaves {life:g} s: must be at least {LEAST_LIFE:g} s; "
                "raise the walltime"
            )
