"""Batch systems: how each writes a job's size, submits, orders and cancels jobs, and tells their states."""

import re
import shlex
import subprocess
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from pipeline.errors import CityError
from tiler.jobs.table import Cluster

PATIENCE = 60.0  # s that a command of a batch system may take
STOP_SIGNAL = "USR1"  # sent to a controller before its time limit, where the batch system can


class QueueError(CityError):
    """A command of the batch system failed: look at what it says."""


@dataclass(frozen=True)
class JobSize:
    """What a job asks for.

    Attributes
    ----------
    name : str
        Its name in the queue.
    log : Path
        File for what it prints; ``{job}`` becomes its number, ``{member}`` that of an element of an array.
    walltime : float
        Time limit (s).
    memory : int
        Bytes.
    cores : int
        Cores.
    options : tuple of str
        Further directives.
    warn : float
        A signal is wished so long before the time limit (s), to elements of an array SIGTERM; 0 for none.
    array : int
        Number of elements of an array; 0 for a single job.
    """

    name: str
    log: Path
    walltime: float
    memory: int
    cores: int = 1
    options: tuple[str, ...] = ()
    warn: float = 0.0
    array: int = 0

    @property
    def mebibytes(self) -> int:
        """Memory, rounded up (MiB)."""
        return -(-self.memory // 2**20)


class Queue(ABC):
    """One batch system."""

    prefix: ClassVar[str]  # of a directive in a script
    scheduler: ClassVar[str]  # class of dask-jobqueue
    living: ClassVar[frozenset[str]]  # states of jobs that wait or run
    submit_words: ClassVar[tuple[str, ...]]
    cancel_words: ClassVar[tuple[str, ...]]

    @abstractmethod
    def directives(self, cluster: Cluster, size: JobSize) -> list[str]:
        """Directives of a job, without prefix."""

    @abstractmethod
    def worker_words(self, cluster: Cluster, size: JobSize) -> dict[str, Any]:
        """What this system's class of dask-jobqueue takes besides what all of them do."""

    @abstractmethod
    def after(self, job: str) -> list[str]:
        """Words that let a submission wait for the end of another job."""

    @abstractmethod
    def ask_words(self, jobs: Sequence[str]) -> list[str]:
        """Command that tells the states of jobs."""

    @abstractmethod
    def read_states(self, text: str) -> dict[str, str]:
        """States by job out of what that command prints."""

    def header(self, cluster: Cluster, size: JobSize) -> list[str]:
        """First lines of a script."""
        given = [*self.directives(cluster, size), *size.options]
        return ["#!/usr/bin/env bash", *(f"{self.prefix} {line}" for line in given)]

    def submit(self, script: Path, *, after: str = "") -> str:
        """Submit a script; returns the job's number. It waits for the end of the job `after`, if given.

        Raises
        ------
        QueueError
            If the command fails or prints no number.
        """
        words = [*self.submit_words, *(self.after(after) if after else [])]
        text = self._submit(words, script)
        found = re.search(r"\d+(?:\[\])?(?:\.[A-Za-z][\w.-]*)?", text)
        if found is None:
            raise QueueError(f"{words[0]} printed no number of a job: {text.strip()!r}")
        return found[0]

    def cancel(self, jobs: Sequence[str]) -> None:
        """Cancel jobs; those that are gone already do not matter."""
        for job in jobs:
            _call([*self.cancel_words, job], check=False)

    def states(self, jobs: Sequence[str]) -> dict[str, str]:
        """States, in the system's own words, of those jobs that it still knows.

        Raises
        ------
        QueueError
            If the batch system does not answer.
        """
        known = self.read_states(_call(self.ask_words(jobs)))
        return {job: known[_bare(job)] for job in jobs if _bare(job) in known}

    def is_alive(self, state: str | None) -> bool:
        """Tell whether a job in that state waits or runs."""
        return state in self.living

    def _submit(self, words: list[str], script: Path) -> str:
        return _call([*words, str(script)])


class Slurm(Queue):
    """SLURM 20.11 or later."""

    prefix, scheduler = "#SBATCH", "SLURMCluster"
    submit_words, cancel_words = ("sbatch", "--parsable"), ("scancel",)
    living = frozenset(
        ("PENDING", "CONFIGURING", "RUNNING", "COMPLETING", "SUSPENDED", "REQUEUED", "REQUEUE_HOLD", "RESIZING",
         "REQUEUE_FED", "SIGNALING", "STAGE_OUT", "STOPPED")
    )  # fmt: skip

    def directives(self, cluster: Cluster, size: JobSize) -> list[str]:
        """Directives of a job, without prefix."""
        log = str(size.log).format(job="%A" if size.array else "%j", member="%a")
        lines = [f"--job-name={size.name}", f"--output={log}", "--open-mode=append", "--ntasks=1"]
        lines += [f"--cpus-per-task={size.cores}", f"--mem={size.mebibytes}M", f"--time={_clock(size.walltime)}"]
        lines += [f"--partition={cluster.partition}"] if cluster.partition else []
        lines += [f"--account={cluster.account}"] if cluster.account else []
        number = "TERM" if size.array else STOP_SIGNAL
        lines += [f"--signal=B:{number}@{size.warn:.0f}", "--requeue"] if size.warn else []
        lines += [f"--array=0-{size.array - 1}"] if size.array else []
        return lines

    def worker_words(self, cluster: Cluster, size: JobSize) -> dict[str, Any]:
        """What SLURMCluster takes: a worker job that lost its node is not begun again under its old name."""
        log = str(size.log).format(job="%j", member="")
        return {
            "queue": cluster.partition or None,
            "account": cluster.account or None,
            "walltime": _clock(size.walltime),
            "job_mem": f"{size.mebibytes}M",
            "job_extra_directives": [f"--output={log}", "--no-requeue", *size.options],
        }

    def after(self, job: str) -> list[str]:
        """Words that let a submission wait for the end of another job."""
        return [f"--dependency=afterany:{job}"]

    def ask_words(self, jobs: Sequence[str]) -> list[str]:
        """Command that tells the states of jobs."""
        return ["squeue", "--noheader", "--me", "--states=all", "--array", "--format=%i %A %F %T"]

    def read_states(self, text: str) -> dict[str, str]:
        """States by job; an array is told by a living element, if there is one."""
        states: dict[str, str] = {}
        for line in text.splitlines():
            element, number, array, state = line.split()
            states[element] = state
            if "_" in element:
                states |= {number: state} if number != array else {}
                states[array] = state if state in self.living else states.get(array, state)
        return states


class Pbs(Queue):
    """PBS Professional and OpenPBS."""

    prefix, scheduler = "#PBS", "PBSCluster"
    submit_words, cancel_words = ("qsub",), ("qdel",)
    living = frozenset("BEHQRSTUWM")

    def directives(self, cluster: Cluster, size: JobSize) -> list[str]:
        """Directives of a job, without prefix."""
        lines = [f"-N {size.name}", "-j oe", f"-o {size.log.parent}/", f"-l {_select(size)}"]
        lines += [f"-l walltime={_clock(size.walltime)}"]
        lines += [f"-q {cluster.partition}"] if cluster.partition else []
        lines += [f"-A {cluster.account}"] if cluster.account else []
        return lines + ([f"-J 0-{size.array - 1}"] if size.array else [])

    def worker_words(self, cluster: Cluster, size: JobSize) -> dict[str, Any]:
        """What PBSCluster takes."""
        return {
            "queue": cluster.partition or None,
            "account": cluster.account or None,
            "walltime": _clock(size.walltime),
            "resource_spec": _select(size),
            "job_extra_directives": ["-j oe", f"-o {size.log.parent}/", *size.options],
        }

    def after(self, job: str) -> list[str]:
        """Words that let a submission wait for the end of another job."""
        return ["-W", f"depend=afterany:{job}"]

    def ask_words(self, jobs: Sequence[str]) -> list[str]:
        """Command that tells the states of jobs."""
        return ["qstat", "-x", *jobs]

    def read_states(self, text: str) -> dict[str, str]:
        """States by job: the last column but one of a table."""
        rows = (line.split() for line in text.splitlines())
        return {_bare(row[0]): row[-2] for row in rows if len(row) >= 5 and row[0][0].isdigit()}


class Sge(Queue):
    """Grid Engine."""

    prefix, scheduler = "#$", "SGECluster"
    submit_words, cancel_words = ("qsub", "-terse"), ("qdel",)
    living = frozenset(("qw", "hqw", "r", "t", "s", "S", "T", "Rr", "Rt", "hr", "Rq"))

    def directives(self, cluster: Cluster, size: JobSize) -> list[str]:
        """Directives of a job, without prefix."""
        lines = [f"-N {size.name}", "-S /bin/bash", "-j y", f"-o {size.log.parent}/"]
        lines += [f"-l h_rt={_clock(size.walltime)}"]
        lines += [f"-q {cluster.partition}"] if cluster.partition else []
        lines += [f"-P {cluster.account}"] if cluster.account else []
        return lines + ([f"-t 1-{size.array}"] if size.array else [])

    def worker_words(self, cluster: Cluster, size: JobSize) -> dict[str, Any]:
        """What SGECluster takes; how memory is asked for is a matter of the site: `options` say it."""
        return {
            "queue": cluster.partition or None,
            "project": cluster.account or None,
            "walltime": _clock(size.walltime),
            "job_extra_directives": ["-S /bin/bash", f"-o {size.log.parent}/", *size.options],
        }

    def after(self, job: str) -> list[str]:
        """Words that let a submission wait for the end of another job."""
        return ["-hold_jid", job]

    def ask_words(self, jobs: Sequence[str]) -> list[str]:
        """Command that tells the states of jobs."""
        return ["qstat"]

    def read_states(self, text: str) -> dict[str, str]:
        """States by job: the fifth column."""
        rows = (line.split() for line in text.splitlines())
        return {row[0]: row[4] for row in rows if len(row) >= 5 and row[0].isdigit()}


class Lsf(Queue):
    """LSF."""

    prefix, scheduler = "#BSUB", "LSFCluster"
    submit_words, cancel_words = ("bsub",), ("bkill",)
    living = frozenset(("PEND", "PROV", "RUN", "WAIT", "PSUSP", "USUSP", "SSUSP", "UNKWN"))

    def directives(self, cluster: Cluster, size: JobSize) -> list[str]:
        """Directives of a job, without prefix."""
        log = str(size.log).format(job="%J", member="%I")
        name = f'"{size.name}[1-{size.array}]"' if size.array else size.name
        lines = [f"-J {name}", f"-o {log}", f"-n {size.cores}", f"-M {size.mebibytes}MB"]
        lines += [f"-W {_clock(size.walltime).rpartition(':')[0]}"]
        lines += [f"-q {cluster.partition}"] if cluster.partition else []
        return lines + ([f"-P {cluster.account}"] if cluster.account else [])

    def worker_words(self, cluster: Cluster, size: JobSize) -> dict[str, Any]:
        """What LSFCluster takes."""
        return {
            "queue": cluster.partition or None,
            "project": cluster.account or None,
            "walltime": _clock(size.walltime).rpartition(":")[0],
            "mem": size.memory,
            "ncpus": size.cores,
            "use_stdin": True,
            "job_extra_directives": [f"-o {str(size.log).format(job='%J', member='')}", *size.options],
        }

    def after(self, job: str) -> list[str]:
        """Words that let a submission wait for the end of another job."""
        return ["-w", f"ended({job})"]

    def ask_words(self, jobs: Sequence[str]) -> list[str]:
        """Command that tells the states of jobs."""
        return ["bjobs", "-a", "-noheader", "-o", "jobid stat", *jobs]

    def read_states(self, text: str) -> dict[str, str]:
        """States by job; an array is told by a living element, if there is one."""
        states: dict[str, str] = {}
        for job, state, *_ in (line.split() for line in text.splitlines() if line[:1].isdigit()):
            states[job] = state if state in self.living else states.get(job, state)
        return states

    def _submit(self, words: list[str], script: Path) -> str:
        with script.open() as file:
            return _call(words, stdin=file)


QUEUES: dict[str, Queue] = {"slurm": Slurm(), "pbs": Pbs(), "sge": Sge(), "lsf": Lsf()}


def _call(words: Sequence[str], *, check: bool = True, stdin: Any = subprocess.DEVNULL) -> str:
    try:
        done = subprocess.run(words, stdin=stdin, capture_output=True, text=True, timeout=PATIENCE, check=False)
    except FileNotFoundError as error:
        raise QueueError(f"{words[0]}: no such command here; log in where jobs are submitted") from error
    except subprocess.TimeoutExpired as error:
        raise QueueError(f"{words[0]}: no answer after {PATIENCE:g} s; is the batch system at work?") from error
    if check and done.returncode:
        said = " ".join((done.stderr or done.stdout).split())
        raise QueueError(f"{shlex.join(words)}: failed with {done.returncode}: {said}")
    return done.stdout


def _clock(seconds: float) -> str:
    """Write a time as HH:MM:SS, rounded down to seconds."""
    minutes, rest = divmod(int(seconds), 60)
    return f"{minutes // 60:02d}:{minutes % 60:02d}:{rest:02d}"


def _select(size: JobSize) -> str:
    return f"select=1:ncpus={size.cores}:mem={size.mebibytes}mb"


def _bare(job: str) -> str:
    """Cut what PBS puts behind the number of a job."""
    return job.partition(".")[0]
