"""Edits of several clients, done by one writer in their order: what waits together is one transaction."""

import gc
import threading
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import AbstractContextManager, nullcontext

from pipeline.data.errors import CityError, ConfigError, OutputError
from tiler.editing.edit import City, Outcome, edit_together, write_city_files
from tiler.editing.requests import Asked
from tiler.engine.executor import Executor
from tiler.store.edit_journal import Edit, read_journal
from tiler.store.remembered import remembering
from tiler.words.plain_text import say_nothing

MOST_WAITING = 100  # edits
CALM = 2.0  # s without an edit, after which the files of the city models are written
REST, MESHING, TILES, FILES = "at rest", "meshing", "writing tiles", "writing city models"  # what the writer does


class BusyError(OutputError):
    """So many edits wait that no more are taken: try again later."""


class EditQueue:
    """The edits of a run folder that this process holds.

    Parameters
    ----------
    city : City
        What is edited.
    after : callable
        Called with the number of the last edit when some were done: it brings the tiles up to date.
    open_executor : callable
        Gives what runs the tasks of all edits, or None; it is opened and closed by the thread that edits, as the
        client of Dask must be.
    say : callable
        Called with sentences that the user should read.
    at_rest : callable
        Called when no edit has come for a while: it makes the tiles that were left as they were.

    Attributes
    ----------
    journal : list of Edit
        All edits that are done.
    state : str
        `REST`, `MESHING`, `TILES` or `FILES`.
    trouble : str
        Why tiles or city models are not up to date.
    """

    def __init__(
        self,
        city: City,
        after: Callable[[int], None],
        open_executor: Callable[[], AbstractContextManager[Executor | None]] = nullcontext,
        say: Callable[[str], None] = say_nothing,
        at_rest: Callable[[], None] = lambda: None,
    ) -> None:
        self._city, self._after, self._open_executor, self._say = city, after, open_executor, say
        self._at_rest = at_rest
        self._changed = threading.Condition()
        self._waiting: list[tuple[Asked, Future[Outcome]]] = []
        self._at_work: list[tuple[Asked, Future[Outcome]]] = []
        self._ended = False
        self.journal = read_journal(city.directory)
        self.state, self.trouble = REST, ""
        self._thread = threading.Thread(target=self._work, name="edits")

    def __enter__(self) -> "EditQueue":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Let the edits at work end; those that wait are refused."""
        with self._changed:
            self._ended = True
            dropped, self._waiting = self._waiting, []
            self._changed.notify()
        for waiting in dropped:
            waiting[1].set_exception(BusyError("the server ends; send the edit again when it is back"))
        self._thread.join()

    @property
    def revision(self) -> int:
        """Number of the last edit that is done."""
        return self.journal[-1].number if self.journal else 0

    @property
    def n_waiting(self) -> int:
        """Edits that are not done."""
        return len(self._waiting) + len(self._at_work)

    def put(self, asked: Asked) -> "Future[Outcome] | Edit":
        """Let an edit wait for its turn.

        Returns
        -------
        Future of Outcome, or Edit
            What will come of it; the edit where one of that name is done already.

        Raises
        ------
        ConfigError
            If another edit has that name.
        BusyError
            If too many wait.
        """
        with self._changed:
            known = {edit.request: edit.digest for edit in self.journal}
            known |= {one.request: one.digest for one, _ in (*self._at_work, *self._waiting)}
            if asked.request and known.get(asked.request, asked.digest) != asked.digest:
                raise ConfigError(f"id {asked.request!r}: is that of another edit; give each its own")
            if (found := self.find(asked.request)) is not None:
                return found
            if self._ended or len(self._waiting) >= MOST_WAITING:
                raise BusyError(f"{len(self._waiting)} edits wait, bound {MOST_WAITING}; try again later")
            self._waiting.append((asked, Future()))
            self._changed.notify()
            return self._waiting[-1][1]

    def find(self, request: str) -> "Future[Outcome] | Edit | None":
        """Find the edit that a client gave a name: done, or what will come of it; None if there is none."""
        with self._changed:
            done: dict[str, Edit | Future[Outcome]] = {edit.request: edit for edit in self.journal}
            waiting = {one.request: future for one, future in (*self._at_work, *self._waiting)}
            return (waiting | done).get(request) if request else None

    def _work(self) -> None:
        with remembering(), self._open_executor() as executor:
            self._edit_until_ended(executor)

    def _edit_until_ended(self, executor: Executor | None) -> None:
        calm = True
        while not (self._ended and calm):
            with self._changed:
                self._changed.wait_for(lambda: bool(self._waiting) or self._ended, None if calm else CALM)
                self._at_work, self._waiting = self._waiting, []
            if self._at_work:
                self.state, calm = MESHING, False
                self._edit(executor)
                self.state = TILES
                self._follow(lambda: self._after(self.revision))
                self.state = FILES
            elif not calm:
                calm = True
                self._follow(lambda: write_city_files(self._city, executor))
                if not self.trouble:  # of these files tiles are made that could not be followed
                    self._follow(self._at_rest)
                gc.collect()
                gc.freeze()  # what is remembered stays: the next edits need not look through it
                self.state = REST

    def _follow(self, work: Callable[[], None]) -> None:
        """Bring something up to date that follows the mesh; if that fails, the next edit tries again."""
        try:
            work()
            self.trouble = ""
        except Exception as error:
            self.trouble = f"{type(error).__name__}: {error}"
            self._say(f"3D Tiles or city models are not up to date: {self.trouble}")

    def _edit(self, executor: Executor | None) -> None:
        """Do all edits at work, and tell each client what came of its own."""
        outcomes: list[Outcome | CityError] | list[Exception]
        try:
            asked = [one for one, _ in self._at_work]
            outcomes = edit_together(self._city, asked, executor=executor, city_files=False, say=self._say)
        except Exception as error:  # whatever it is: clients are told, and the next edit has its turn
            outcomes = [error for _ in self._at_work]
        with self._changed:
            done, self._at_work = self._at_work, []
            self.journal += sorted((one.edit for one in outcomes if isinstance(one, Outcome)), key=number_of)
        for (_, future), outcome in zip(done, outcomes, strict=True):
            if isinstance(outcome, Exception):
                future.set_exception(outcome)
            else:
                future.set_result(outcome)


def number_of(edit: Edit) -> int:
    """Give the number of an edit."""
    return edit.number
