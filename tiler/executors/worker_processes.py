"""Worker processes of this machine: one task each at a time, with the limits of any worker.

They are forked from the process that is there for it, see `tiler.executors.fork_server`.
"""

import os
import pickle
import queue
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing import connection
from pathlib import Path
from typing import Any

import cloudpickle

from tiler.engine.stage import Facts
from tiler.engine.task import Failure, Record, Task
from tiler.engine.task_limits import (
    KILL_AT,
    REFUSE_AT,
    Limits,
    WorkerError,
    limit_memory,
    run_guarded,
    tell_death,
    tell_memory,
)
from tiler.executors import fork_server
from tiler.executors.kept_memory import keep_memory

Function = Callable[[Task], Facts]
Outcome = Record | Failure
WEIGH = 0.5  # s between two looks at the memory of the processes
BYSTANDER = 20  # how often a task may be given to a process that dies before it begins, before it is an error


@dataclass(frozen=True, eq=False)
class Given:
    """A task as it is given to a worker.

    Attributes
    ----------
    ticket : int
        Number of the engine's.
    function : callable
        Function of its stage.
    task : Task
        The task.
    rank : int
        Of those that wait, the one of the lowest goes first.
    """

    ticket: int
    function: Function
    task: Task
    rank: int = 0


@dataclass(eq=False)
class _Hand:
    """A worker process, and what it has in hand."""

    process: Any
    pipe: Any
    given: Given | None = None
    deaths: int = 0  # of processes that had this task, before it began


class Crew:
    """Worker processes of one thread each on this machine; what dies is replaced. `close` ends them.

    Each is started when there is a task for it.

    Parameters
    ----------
    workers : int
        Number of processes.
    limits : Limits
        What a task may take.
    """

    def __init__(self, workers: int, limits: Limits) -> None:
        self.workers, self.limits = workers, limits
        self._weighed = time.monotonic()
        self._hands: list[_Hand] = []
        fork_server.begin()

    @property
    def n_free(self) -> int:
        """Number of processes without a task."""
        return self.workers - self.n_busy

    @property
    def n_busy(self) -> int:
        """Number of processes with a task."""
        return sum(hand.given is not None for hand in self._hands)

    def give(self, given: Given) -> None:
        """Give a task to a process that has none; ValueError if all have one, pickle's if it cannot go."""
        if not self.n_free:
            raise ValueError(f"all {self.workers} workers have a task")
        hand = next((one for one in self._hands if one.given is None), None)
        if hand is None:
            hand = self._start()
            self._hands.append(hand)
        self._send(hand, given, 0)

    def collect(self, seconds: float) -> list[tuple[Given, Outcome]]:
        """Take what is done, after so many seconds (s) at most; a process that died tells why by its file."""
        pipes = {hand.pipe: hand for hand in self._hands}
        found = []
        for pipe in connection.wait(list(pipes), seconds):
            hand = pipes[pipe]
            outcome = self._receive(hand)
            if outcome is not None and hand.given is not None:
                found.append((hand.given, outcome))
                hand.given = None
        if time.monotonic() - self._weighed >= WEIGH:
            self._weigh()
        return found

    def kill(self) -> list[Given]:
        """End all processes at once; gives what they had in hand. Others are started for what comes next."""
        had = [hand.given for hand in self._hands if hand.given is not None]
        self.close()
        return had

    def close(self) -> None:
        """End all processes at once."""
        for hand in self._hands:
            hand.process.kill()
        for hand in self._hands:
            hand.process.join()
            hand.pipe.close()
        self._hands = []

    def _start(self) -> _Hand:
        memory = int(REFUSE_AT * self.limits.memory)
        process, pipe = fork_server.start(_work, memory, self.limits.seconds)
        return _Hand(process, pipe)

    def _send(self, hand: _Hand, given: Given, deaths: int) -> None:
        sent = _pack((given.function, given.task))
        hand.given, hand.deaths = given, deaths
        with suppress(OSError):  # it has died: seen when it is asked
            hand.pipe.send_bytes(sent)

    def _receive(self, hand: _Hand) -> Outcome | None:
        """Take the outcome of a process; replace it if it has died."""
        try:
            outcome: Outcome = hand.pipe.recv()
        except (EOFError, OSError):
            return self._replace(hand)
        if isinstance(outcome, Failure) and outcome.kind == "memory":
            return tell_memory(outcome, self.limits)
        return outcome

    def _replace(self, hand: _Hand) -> Outcome | None:
        """Replace a dead process; gives how its task ended, or gives it to the new process if it had not begun."""
        hand.process.join()
        hand.pipe.close()
        given, deaths = hand.given, hand.deaths + 1
        fresh = self._start()
        hand.process, hand.pipe = fresh.process, fresh.pipe
        if given is None:
            return None
        outcome = tell_death(given.task, self.limits)
        if outcome is None and deaths >= BYSTANDER:
            outcome = Failure(WorkerError(f"{deaths} workers died before they began it; look at their logs"))
        if outcome is None:
            self._send(hand, given, deaths)
        return outcome

    def _weigh(self) -> None:
        """End the processes whose memory went past the limit without being asked for, as that of mapped files."""
        self._weighed = time.monotonic()
        if not self.limits.memory:
            return
        for hand in self._hands:
            if _resident(hand.process.pid) > KILL_AT * self.limits.memory:
                hand.process.kill()


def _resident(pid: int) -> int:
    """Resident memory of a process (bytes); 0 where nobody tells."""
    try:
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, IndexError, ValueError):
        return 0


def _work(pipe: Any, memory: int, seconds: float) -> None:
    """Run tasks until the other end is gone."""
    keep_memory()
    if memory:
        limit_memory(memory)
    tasks: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    threading.Thread(target=_listen, args=(pipe, tasks), daemon=True).start()
    while True:
        pipe.send(_run(tasks.get(), seconds))


def _pack(content: tuple[Function, Task]) -> bytes:
    """Pickle what goes to a worker; what a notebook or a script defines goes whole, which takes longer."""
    with suppress(Exception):
        sent = pickle.dumps(content)
        if b"__main__" not in sent:
            return sent
    packed: bytes = cloudpickle.dumps(content)
    return packed


def _run(sent: bytes, seconds: float) -> Outcome:
    """Run a task as it was sent; an error of its own reading is its outcome."""
    try:
        function, task = pickle.loads(sent)
    except Exception as error:
        return Failure(RuntimeError(f"cannot be read by a worker: {type(error).__name__}: {error}"))
    return run_guarded(function, task, seconds)


def _listen(pipe: Any, tasks: "queue.SimpleQueue[bytes]") -> None:
    """Take tasks; whose driver has died ends at once."""
    while True:
        try:
            tasks.put(pipe.recv_bytes())
        except Exception:
            os._exit(1)
