"""Tasks on processes that share a folder and nothing else: the driver writes them to mailboxes there.

Every driver has a folder of its own, with one folder for each member that works for it::

    .spool/driver.2              the lease of the second driver
    .spool/members.2/NAME/       a member: made whole by it, removed by it, or by a driver that has given it up
        holder                   who it is; its heartbeat
        inbox.0, outbox.0        from the driver, and to it
"""

import copy
import math
import pickle
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tiler.engine.task import Failure, Record, Task
from tiler.engine.task_limits import tell_death
from tiler.executors.executor import LEAST_WINDOW, WINDOW
from tiler.executors.worker_processes import Crew, Function, Given, Outcome
from tiler.joining.lease import (
    LOOK,
    SILENCE,
    Holder,
    LostFolderError,
    Pulse,
    fresh_names,
    read_holder,
    remove_folder,
)
from tiler.joining.mailbox import GoneError, MailReader, MailWriter

SPOOL = ".spool"  # in the folder of a run, as long as members are at work
HOLDER, INBOX, OUTBOX = "holder", "inbox", "outbox"
SHORTEST, LONGEST = 0.01, 1.0  # s between two looks into mailboxes: while something comes, and after a while
LAG = 0.25  # s that a task may be on its way: so much work waits at a member's side
AHEAD = 4  # tasks at most that wait there for each of its workers
LONG = 5.0  # s; where tasks take longer, none waits there


class Pause:
    """How long to wait between two looks: short while something comes, longer and longer after."""

    def __init__(self) -> None:
        self.seconds = SHORTEST

    def after(self, something: object) -> None:
        """Take note of whether a look found something."""
        self.seconds = SHORTEST if something else min(1.5 * self.seconds, LONGEST)


@dataclass(eq=False)
class _Member:
    """A member as its driver knows it."""

    name: str
    folder: Path
    holder: Holder
    inbox: MailWriter
    outbox: MailReader
    pulse: Pulse
    given: dict[int, Given] = field(default_factory=dict)
    contexts: int = 0  # so many of the driver's are known there
    mean: float = 0.0  # s a task, of late

    @property
    def load(self) -> float:
        return len(self.given) / self.holder.workers

    @property
    def most(self) -> float:
        """Tasks that each of its workers may have: one in hand, and some at its side if they are short."""
        if self.mean > LONG:
            return 1.0
        return 1.0 + (1 if not self.mean else min(math.ceil(LAG / self.mean), AHEAD))


class Spool:
    """Executor of a driver: its own worker processes, and those of all members.

    Parameters
    ----------
    folder : Path
        Where members make their folders.
    crew : Crew
        The driver's own workers.
    check : callable
        Raises LostFolderError if another process drives the run by now.
    say : callable
        Called with a sentence where a member comes, goes or dies.

    Attributes
    ----------
    workers : int
        Number of workers by now; more as members come.
    say : callable
        As given.
    sent : Counter of str
        Number of tasks done by each member; the driver's own are ``""``.
    """

    def __init__(self, folder: Path, crew: Crew, check: Callable[[], None], say: Callable[[str], None]) -> None:
        self.workers = crew.workers
        self._folder, self._crew, self._check, self.say = folder, crew, check, say
        self._members: dict[str, _Member] = {}
        self._queue: deque[Given] = deque()
        self._done: deque[tuple[int, Outcome]] = deque()
        self._contexts: list[Any] = []
        self._looked = -math.inf
        self._pause = Pause()
        self.sent: Counter[str] = Counter()

    @property
    def window(self) -> int:
        """Some a worker."""
        return max(WINDOW * self.workers, LEAST_WINDOW)

    def submit(self, ticket: int, function: Function, task: Task, rank: int = 0) -> None:
        """Take a task; they are given out as they come."""
        self._queue.append(Given(ticket, function, task))

    def wait(self) -> tuple[int, Record | Failure]:
        """Wait until any task is done, and give it.

        Raises
        ------
        LostFolderError
            If another process drives the run by now.
        """
        while not self._done:
            self._turn()
        return self._done.popleft()

    def drop_waiting(self) -> set[int]:
        """Take back what has not begun, and wait for the rest; give up all if another process drives the run."""
        dropped = {given.ticket for given in self._queue}
        self._queue.clear()
        try:
            for member in list(self._members.values()):
                self._write(member, [("recall",)])
            while self._crew.n_busy or any(member.given for member in self._members.values()):
                self._turn(assign=False)
        except LostFolderError:
            dropped |= {given.ticket for given in self._crew.kill()}
            dropped |= {ticket for member in self._members.values() for ticket in member.given}
            self._members.clear()
        dropped |= {given.ticket for given in self._queue}  # given back
        self._queue.clear()
        return dropped

    def end(self, code: int, text: str) -> None:
        """Tell all members how the run ended, and wait until they have gone: `SILENCE` seconds at most."""
        told = set[str]()
        until = time.monotonic() + SILENCE
        while True:
            self._look()
            for name in self._members.keys() - told:
                self._write(self._members[name], [("end", code, text)])
                told.add(name)
            if not self._members or time.monotonic() > until:
                return
            time.sleep(10 * SHORTEST)

    def _turn(self, *, assign: bool = True) -> None:
        """Look once for everything that may have happened."""
        self._check()
        if time.monotonic() - self._looked >= LOOK:
            self._look()
        if assign:
            self._assign()
        n_before = len(self._done)
        for member in list(self._members.values()):
            self._read(member)
        came = len(self._done) > n_before
        for given, outcome in self._crew.collect(0.0 if came else self._pause.seconds):
            self._done.append((given.ticket, outcome))
            self.sent[""] += 1
            came = True
        self._pause.after(came)

    def _look(self) -> None:
        """See who has come, who has gone, and who is dead."""
        self._looked = time.monotonic()
        for name in fresh_names(self._folder):
            if name not in self._members:
                self._meet(name)
        for member in list(self._members.values()):
            if not member.folder.exists():
                self._part_from(member, "has gone")
            elif member.pulse.is_dead() or member.outbox.waits() > SILENCE:
                self._part_from(member, "is dead")

    def _meet(self, name: str) -> None:
        folder = self._folder / name
        holder = read_holder(folder / HOLDER)
        if holder is None:
            return
        try:
            inbox = MailWriter(folder / INBOX)
        except OSError:  # gone again
            return
        pulse = Pulse(folder / HOLDER, holder.owner)
        self._members[name] = _Member(name, folder, holder, inbox, MailReader(folder / OUTBOX), pulse)
        self.workers += holder.workers
        self.say(f"{holder.tell()} works too, with {holder.workers} workers")

    def _part_from(self, member: _Member, why: str) -> None:
        """Do without a member: what it had begun failed if it died of it, the rest is for others."""
        if member.name not in self._members:
            return
        self._take_mail(member)
        del self._members[member.name]
        self.workers -= member.holder.workers
        remove_folder(member.folder)
        for given in reversed(member.given.values()):
            failure = tell_death(given.task, self._crew.limits) if why == "is dead" else None
            if failure is None:
                self._queue.appendleft(given)
            else:
                self._done.append((given.ticket, failure))
        words = f"; {len(member.given)} tasks of it are done again by others" if member.given else ""
        self.say(f"{member.holder.tell()} {why}{words}")

    def _assign(self) -> None:
        """Give tasks to whoever has the least to do."""
        while self._queue and self._crew.n_free:
            self._crew.give(self._queue.popleft())
        mail: dict[str, list[Given]] = {}
        while self._queue:
            free = [member for member in self._members.values() if member.load < member.most]
            if not free:
                break
            member = min(free, key=lambda one: one.load)
            given = self._queue.popleft()
            member.given[given.ticket] = given
            mail.setdefault(member.name, []).append(given)
        for name, tasks in mail.items():
            member = self._members[name]
            self._write(member, [message for given in tasks for message in self._put(member, given)])

    def _put(self, member: _Member, given: Given) -> list[tuple[Any, ...]]:
        """Put a task into messages: its context, which is the same for many, goes once."""
        task = given.task
        known = next((k for k, context in enumerate(self._contexts) if context is task.context), -1)
        if known < 0:
            self._contexts.append(task.context)
            known = len(self._contexts) - 1
        new = [("context", context) for context in self._contexts[member.contexts :]]
        member.contexts = len(self._contexts)
        return [*new, ("task", given.ticket, given.function, strip_context(task), known)]

    def _write(self, member: _Member, messages: Sequence[tuple[Any, ...]]) -> None:
        try:
            member.inbox.write(map(pickle.dumps, messages))
        except GoneError:
            self._part_from(member, "has gone")

    def _read(self, member: _Member) -> None:
        if not self._take_mail(member):
            self._part_from(member, "has gone")

    def _take_mail(self, member: _Member) -> bool:
        """Take what a member has written; False if its mailbox is gone."""
        try:
            messages = member.outbox.read()
        except GoneError:
            return False
        for message in messages:
            kind, *content = pickle.loads(message)
            if kind == "back":
                (tickets,) = content
                self._queue.extendleft(member.given.pop(k) for k in reversed(tickets) if k in member.given)
                continue
            ticket, outcome = content  # of "done"
            if member.given.pop(ticket, None) is None:
                continue
            self._done.append((ticket, outcome))
            self.sent[member.name] += 1
            if isinstance(outcome, Record):
                seconds = outcome.seconds.get("all", 0.0)
                member.mean = seconds if not member.mean else 0.9 * member.mean + 0.1 * seconds
        return True


def strip_context(task: Task) -> Task:
    """Copy a task without its context."""
    bare = copy.copy(task)
    bare.context = None
    return bare
