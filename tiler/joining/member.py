"""A member of a run: does the tasks that its driver sends to its mailbox, see `tiler.joining.spool`."""

import pickle
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any

from tiler.engine.stopping import stops
from tiler.executors.worker_processes import Crew, Given
from tiler.joining.lease import LOOK, SILENCE, Heart, Holder, Pulse, is_over, remove_folder, write_holder
from tiler.joining.mailbox import GoneError, MailReader, MailWriter
from tiler.joining.spool import HOLDER, INBOX, OUTBOX, Pause

STOPPED = 130  # exit code


@dataclass(frozen=True)
class Ended:
    """How a member's work ended.

    Attributes
    ----------
    exit_code : int
        Of the run, or 130 if the member was asked to stop.
    error : str
        Why the run failed; empty if it did not.
    """

    exit_code: int
    error: str = ""


class Left(Enum):
    """Why a member works for a driver no longer, though the run goes on."""

    DRIVER_GONE = "the driver is dead, or has ended its lease"
    GIVEN_UP = "the driver has given this member up, or must have, as it could not be heard"


def serve(
    folder: Path, me: Holder, lease: Path, driver: Holder, crew: Crew, say: Callable[[str], None]
) -> Ended | Left:
    """Work for a driver until the run ends.

    Parameters
    ----------
    folder : Path
        Folder of the driver's members.
    me : Holder
        This process.
    lease : Path
        The driver's lease.
    driver : Holder
        The driver.
    crew : Crew
        The workers.
    say : callable
        Called with sentences that the user should read.

    Returns
    -------
    Ended or Left
        How it ended; where it was left, what was in hand is not done.

    Raises
    ------
    OutputError
        If the disk refuses.
    """
    place = folder / f"{me.member}.{me.owner.token[:8]}"
    try:
        _make_place(place, me)
        service = _Service(place, lease, driver, crew)
    except FileNotFoundError:  # the spool was taken away
        return Left.GIVEN_UP
    try:
        with stops(service.stop, say):
            return service.work()
    finally:
        service.close()


class _Service:
    """The work for one driver."""

    def __init__(self, place: Path, lease: Path, driver: Holder, crew: Crew) -> None:
        self._place, self._lease, self._crew = place, lease, crew
        self._inbox, self._outbox = MailReader(place / INBOX), MailWriter(place / OUTBOX)
        self._heart, self._pulse = Heart(place / HOLDER), Pulse(lease, driver.owner)
        self._waiting: deque[Given] = deque()
        self._contexts: list[Any] = []
        self._ended: Ended | None = None
        self._stop = False
        self._looked = time.monotonic()

    def stop(self) -> None:
        """Give back what has not begun, and end when the rest is done."""
        self._stop = True

    def close(self) -> None:
        """Leave nothing behind."""
        self._heart.stop()
        remove_folder(self._place)

    def work(self) -> Ended | Left:
        pause = Pause()
        left: Left | None = None
        try:
            while self._ended is None:
                left = self._look()
                if left is not None:
                    break
                messages = self._inbox.read()
                for message in messages:
                    self._take(*pickle.loads(message))
                if self._stop:
                    self._give_back()
                    if not self._crew.n_busy:
                        break
                while self._waiting and self._crew.n_free:
                    self._crew.give(self._waiting.popleft())
                done = self._crew.collect(pause.seconds)
                self._outbox.write(pickle.dumps(("done", given.ticket, outcome)) for given, outcome in done)
                pause.after(messages or done)
        except GoneError:
            left = Left.GIVEN_UP
        if self._crew.n_busy:
            self._crew.kill()
        if self._ended is None and self._stop:
            return Ended(STOPPED, "stopped as asked; the other members go on")
        return self._ended or left or Left.GIVEN_UP

    def _take(self, kind: str, *content: Any) -> None:
        """Take a message of the driver."""
        if kind == "task":
            ticket, function, task, context = content
            task.context = self._contexts[context]
            self._waiting.append(Given(ticket, function, task))
        elif kind == "context":
            self._contexts.append(content[0])
        elif kind == "recall":
            self._give_back()
        elif kind == "end":
            self._ended = Ended(*content)

    def _give_back(self) -> None:
        if self._waiting:
            self._outbox.write([pickle.dumps(("back", [given.ticket for given in self._waiting]))])
            self._waiting.clear()

    def _look(self) -> Left | None:
        """See whether the driver is gone, or may have given this member up."""
        if self._heart.missed:
            return Left.GIVEN_UP
        if time.monotonic() - self._looked < LOOK:
            return None
        self._looked = time.monotonic()
        if is_over(self._lease) or self._pulse.is_dead():
            return Left.DRIVER_GONE
        return Left.GIVEN_UP if self._inbox.waits() > SILENCE else None


def _make_place(place: Path, me: Holder) -> None:
    """Make a member's folder, whole or not at all."""
    part = place.with_name(f".{place.name}")
    place.parent.mkdir(exist_ok=True)
    part.mkdir()
    write_holder(part / HOLDER, me)
    for name in (INBOX, OUTBOX):
        MailWriter(part / name)
    part.replace(place)
