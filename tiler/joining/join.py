"""`citystitch join`: one of several processes, on any machines, that work at one run through its folder alone.

All are started with the same command. One of them has the lease of the driver (`tiler.joining.lease`) and runs
what `citystitch run` does; the others are members and do tasks for it (`tiler.joining.spool`). Where the driver
dies, or is asked to stop, another one takes its place.
"""

import dataclasses
import json
import os
import platform
import re
import socket
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.errors import CityError, ConfigError, OutputError
from tiler.config.config import Config
from tiler.engine.engine import StoppedError
from tiler.engine.keys import code_versions
from tiler.engine.task_limits import limit_workers
from tiler.executors.executor import Executor
from tiler.executors.kernels import prepare
from tiler.executors.worker_processes import Crew
from tiler.joining.lease import (
    LOOK,
    PREFIX,
    Holder,
    Lease,
    LostFolderError,
    Pulse,
    fresh_names,
    is_over,
    newest_lease,
    read_holder,
    remove_folder,
    take_lease,
    this_holder,
)
from tiler.joining.member import Ended, Left, serve
from tiler.joining.spool import HOLDER, SPOOL, Spool
from tiler.monitoring.watchers import Watcher
from tiler.objects.places import is_url
from tiler.planning.plan import check_sources
from tiler.store.folder_lock import is_held
from tiler.words.plain_text import say_nothing, shorten
from tiler.workflow.out_folder import RUN_RECORD, check_folder
from tiler.workflow.run import run, tell_error

MAX_IDLE = 600.0  # s that a member waits for a folder that another run holds
MEMBERS = "members."
ARRAY_INDEX = ("SLURM_ARRAY_TASK_ID", "PBS_ARRAY_INDEX", "PBS_ARRAYID", "SGE_TASK_ID", "LSB_JOBINDEX")
NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,63}")
Say = Callable[[str], None]


@dataclass(frozen=True)
class Joined:
    """How a run ended for one of those that worked at it.

    Attributes
    ----------
    exit_code : int
        Of the run, the same for all; 130 for one that was asked to stop.
    error : str
        Why it failed; empty if it did not.
    record : dict or None
        What ``run.json`` holds, where this process drove the run at its end.
    """

    exit_code: int
    error: str = ""
    record: dict[str, Any] | None = None


def join(
    config: Config,
    *,
    member: str = "",
    max_idle: float = MAX_IDLE,
    views: Callable[[], Sequence[Watcher]] = tuple,
    say: Say | None = None,
) -> Joined:
    """Work at a run together with all other processes that join it, until it ends.

    Parameters
    ----------
    config : Config
        Parameters of the run, the same for all. ``workers`` is the number of worker processes of each member; 0
        is one.
    member : str
        Name of this process for people, see `name_member`.
    max_idle : float
        How long (s) to wait for a folder in which another run is at work that is not to be joined.
    views : callable
        Makes the watchers of a run, should this process drive it.
    say : callable, optional
        Called with sentences that the user should read.

    Raises
    ------
    ConfigError
        If members differ in a parameter or in a version of code, or one is not to be used here.
    CityError
        What `tiler.workflow.run.run` raises, in the process that drives; and if the folder is not free in time.
    """
    refused = [what for what in ("overwrite", "scheduler", "cluster", "dask") if getattr(config, what)]
    if refused:
        raise ConfigError(
            f"{refused[0]}: members of a run work with what is in its folder, without a scheduler; leave it out"
        )
    if not max_idle > 0:
        raise ConfigError(f"--max-idle {max_idle:g} s: must be above 0 s")
    if "://" in config.out:
        raise ConfigError(f"{config.out}: members of a run share a folder; give one that all of them see as --out")
    name = name_member(member)
    check_sources(config)
    check_folder(Path(config.out), overwrite=False)
    spool = Path(config.out) / SPOOL
    if spool.is_symlink():
        raise ConfigError(f"{spool}: is a symbolic link; remove it")
    workers = max(config.workers, 1)
    prepare(config.mesher, workers, say or say_nothing)
    with closing(Crew(workers, limit_workers(config))) as crew:
        me = this_holder(name, crew.workers, describe_member(config))
        return _Joining(config, me, crew, max_idle, views, say or say_nothing).go()


def name_member(given: str) -> str:
    """Name a process for people: as given, else by its element of a job array, else by host and number.

    Raises
    ------
    ConfigError
        If it is not 1 to 64 letters, digits, ``_``, ``.`` and ``-``, the last two not first.
    """
    if given and not NAME.fullmatch(given):
        raise ConfigError(f"--member {given!r}: 1 to 64 letters, digits, '_', '.' and '-', '.' and '-' not first")
    element = next((index for name in ARRAY_INDEX if (index := os.environ.get(name, "")).isdecimal()), "")
    if given or element:
        return given or f"element-{element}"
    return f"{re.sub('[^A-Za-z0-9_.-]', '-', socket.gethostname()).strip('.-')[:50] or 'host'}-{os.getpid()}"


class _Joining:
    """One process that joins: member of one driver after the other, or driver itself."""

    def __init__(
        self,
        config: Config,
        me: Holder,
        crew: Crew,
        max_idle: float,
        views: Callable[[], Sequence[Watcher]],
        say: Say,
    ) -> None:
        self._config, self._me, self._crew = config, me, crew
        self._max_idle, self._views, self._say = max_idle, views, say
        self._out = Path(config.out)
        self._spool = self._out / SPOOL
        self._pulses: dict[Path, Pulse] = {}
        self._gone = 0  # number of the last driver that is known to be gone

    def go(self) -> Joined:
        while True:
            self._spool.mkdir(exist_ok=True)
            number = newest_lease(self._spool)
            self._gone = min(self._gone, number)  # smaller in a new spool
            if number > self._gone:
                joined = self._serve(number)
                if isinstance(joined, Joined):
                    return joined
                if joined is Left.DRIVER_GONE:
                    self._gone = number
            elif number and self._differs(number) and self._left(number):
                time.sleep(LOOK / 2)  # one of them drives next, and tells what is wrong with this one
            elif lease := take_lease(self._spool, number + 1, self._me):
                driven = self._drive(lease)
                if driven is not None:
                    return driven
            else:
                time.sleep(LOOK / 10)

    def _serve(self, number: int) -> Joined | Left:
        """Work for a driver."""
        lease = self._lease(number)
        pulse = Pulse(lease, None)
        while (holder := read_holder(lease)) is None:
            if is_over(lease) or pulse.is_dead():
                return Left.DRIVER_GONE
            time.sleep(LOOK / 10)
        if not self._agrees(lease, holder):
            return Left.DRIVER_GONE
        self._say(f"{self._out}: works as {self._me.member} for {holder.tell()}, which drives the run")
        ended = serve(self._members(number), self._me, lease, holder, self._crew, self._say)
        if isinstance(ended, Ended):
            return Joined(ended.exit_code, ended.error)
        if not lease.exists():
            return self._missed_end() or ended
        self._say(f"{self._out}: {ended.value}: {holder.tell()}")
        return ended

    def _agrees(self, lease: Path, holder: Holder) -> bool:
        """Hold our configuration against a driver's: False if it is gone, ConfigError if it lives and differs."""
        difference = _find_difference(self._me, holder)
        pulse = Pulse(lease, holder.owner)
        while difference:
            if is_over(lease) or pulse.is_dead():
                return False
            if pulse.heard:
                raise ConfigError(
                    f"{self._out}: {difference}; all members of a run must be started alike, on equal "
                    f"installations ({holder.tell()} drives it)"
                )
            time.sleep(LOOK / 5)
        return True

    def _missed_end(self) -> Joined | None:
        """Tell from the record how the run ended, where this member was given up before it heard of the end."""
        try:
            record = json.loads((self._out / RUN_RECORD).read_bytes())
        except (OSError, ValueError):
            return None
        if record.get("status") == "done":
            return Joined(int(record["exit_code"]))
        return Joined(1, str(record.get("error"))) if record.get("status") == "failed" else None

    def _drive(self, lease: Lease) -> Joined | None:
        """Drive the run; None if another process does by now."""
        folder = self._members(lease.number)
        spool = Spool(folder, self._crew, lease.check, self._say)
        try:
            folder.mkdir(exist_ok=True)
            self._wait_for_folder(lease)
            record = run(self._config, watchers=self._views(), executor=lambda say: _driving(spool, lease, say))
        except LostFolderError as error:
            self._crew.kill()
            self._say(str(error))
            return None
        except (StoppedError, KeyboardInterrupt):
            lease.close()  # another one goes on
            if not fresh_names(folder):
                remove_folder(self._spool)
            raise
        except Exception as error:
            code = error.exit_code if isinstance(error, CityError) else 1
            with suppress(OutputError):  # what the run failed by counts
                self._end(spool, lease, code, tell_error(error))
            raise
        self._end(spool, lease, record["exit_code"], "")
        return Joined(record["exit_code"], "", record)

    def _wait_for_folder(self, lease: Lease) -> None:
        """Wait until nobody works for the driver before, or runs something else in the folder."""
        while self._left(lease.number - 1):
            lease.check()
            time.sleep(LOOK / 10)
        remove_folder(self._members(lease.number - 1))
        begin = time.monotonic()
        while is_held(self._out):
            lease.check()
            if time.monotonic() - begin > self._max_idle:
                raise CityError(
                    f"{self._out}: another run, not one to join, has been at work there for {self._max_idle:g} s "
                    "(--max-idle); wait for its end, and start the members again"
                )
            time.sleep(LOOK / 2)

    def _end(self, spool: Spool, lease: Lease, code: int, text: str) -> None:
        """Tell all how the run ended, and leave nothing of it."""
        spool.end(code, text)
        lease.close()
        remove_folder(self._spool)

    def _left(self, number: int) -> list[str]:
        """List the members of a driver that are not known to be dead or gone."""
        folder = self._members(number)
        left = []
        for name in fresh_names(folder):
            path = folder / name / HOLDER
            if path not in self._pulses:
                holder = read_holder(path)
                self._pulses[path] = Pulse(path, holder.owner if holder is not None else None)
            if not self._pulses[path].is_dead():
                left.append(name)
        return left

    def _differs(self, number: int) -> bool:
        holder = read_holder(self._lease(number))
        return holder is not None and bool(_find_difference(self._me, holder))

    def _lease(self, number: int) -> Path:
        return self._spool / f"{PREFIX}{number}"

    def _members(self, number: int) -> Path:
        return self._spool / f"{MEMBERS}{number}"


@contextmanager
def _driving(spool: Spool, lease: Lease, say: Say) -> Iterator[Executor]:
    """Run tasks on all members; LostFolderError at the end, before the run says that it is done, likewise."""
    spool.say = say
    yield spool
    lease.check_now()


def describe_member(config: Config) -> dict[str, Any]:
    """What all members must have in common: parameters, with the paths that they mean, and versions."""
    paths = {
        "pointcloud": list(map(_spell_path, config.pointcloud)),
        "footprints": _spell_path(config.footprints),
        "out": _spell_path(config.out),
    }
    versions = {"python": platform.python_version()} | dict(code_versions())
    plain = dataclasses.asdict(config) | paths | {f"version of {name}": text for name, text in versions.items()}
    described: dict[str, Any] = json.loads(json.dumps(plain))
    return described


def _spell_path(text: str) -> str:
    """Give one text for one place, whatever the current folder; the same for none and for URLs."""
    return text if not text or is_url(text) else os.path.abspath(text)


def _find_difference(me: Holder, driver: Holder) -> str:
    """Say in what this process differs from the driver; empty if in nothing."""
    for name in sorted(me.parameters.keys() | driver.parameters.keys()):
        ours, theirs = (holder.parameters.get(name) for holder in (me, driver))
        if ours != theirs:
            return f"{name} = {shorten(str(ours), 200)} here, {shorten(str(theirs), 200)} in the run at work there"
    return ""
