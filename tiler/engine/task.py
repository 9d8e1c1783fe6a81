"""A task: what a stage's function gets, what becomes of its result, and the record that goes back."""

import math
import pickle
import resource
import sys
import time
import traceback
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from numpy.typing import ArrayLike, NDArray

from pipeline.data.errors import CityError
from pipeline.data.notes import Note, count_notes
from tiler.engine.stage import WHOLE, Box, Facts, Scope, Share
from tiler.georeference.frame import AS_IT_IS, Frame
from tiler.objects.requests import trust_addresses
from tiler.objects.results import files_for
from tiler.store.checksums import FILES, check_files, find_changed_files
from tiler.store.result_writer import Writer, plain_json
from tiler.store.store import Store

APART = ("key",)  # attributes of a result that are no content


@dataclass(frozen=True, eq=False)
class Result:
    """One result of a stage, as a reader gets it."""

    name: str  #: item that it belongs to
    arrays: dict[str, NDArray[Any]]  #: the arrays that were asked for
    facts: Facts  #: what the stage's function gave back
    notes: tuple[Note, ...] = ()  #: what it noted


@dataclass(frozen=True)
class Record:
    """What the driver keeps of a result: small, no arrays."""

    #: which result, and the key of all that it depends on
    stage: str
    name: str
    key: str
    digest: str  #: digest of its content: arrays, facts and notes
    facts: Facts  #: what the stage's function gave back
    notes: dict[str, int]  #: number of notes by kind
    #: wall time by step (s), and ``"all"``; empty where an earlier result was taken
    seconds: dict[str, float] = field(default_factory=dict)
    peak_memory: int = 0  #: largest resident memory of the process so far (bytes)
    reused: bool = False  #: true if an earlier result with the same key was taken
    #: what was wrong with an earlier result that was there and computed again for that; else empty
    damage: str = ""
    #: how long the submission went on with its other tasks (s), before this record was given back
    ago: float = 0.0


@dataclass(frozen=True, eq=False)
class Failure:
    """An error that came back as a value: raised in a worker, Dask would print where in the code it arose."""

    error: Exception  #: the error
    trace: str = ""  #: where in the code it arose, as text; empty where nobody knows
    #: ``"error"``; or ``"memory"``, ``"time"``, ``"crash"`` or ``"killed"`` of a process that ended
    kind: str = "error"


@dataclass(frozen=True)
class Later:
    """A function gave nothing back: its item is left to a later call of the engine."""


@dataclass(eq=False)
class Task:
    """One item of one stage: what its function reads through, and writes through."""

    #: stage and item
    stage: str
    name: str
    scope: Scope  #: scope of the stage
    box: Box  #: box of the item (m)
    parameters: Any  #: the declared parameters as attributes
    #: what the engine was given, the same for all; not in the key, so it must follow from the layout and the
    #: declared parameters
    context: Any
    file: str  #: path of the file, for the scope FILE; else empty
    store: Store  #: the store
    refs: dict[str, tuple[str, ...]]  #: items to read by stage, sorted
    key: str  #: key of all that the result depends on
    folder: Path  #: where the files are that results state as the fact ``"files"``
    frame: Frame = AS_IT_IS  #: how coordinates of the file become those of the region, for the scope FILE
    share: Share = WHOLE  #: (int, int): which of the equal shares of the file's points it is for, and of how many
    #: key that the same result has in a copied store, before changes that do not reach it; empty for none
    former: str = ""
    _writer: Writer | None = None
    _notes: list[Note] = field(default_factory=list)
    _seconds: dict[str, float] = field(default_factory=dict)

    def read(self, stage: str, names: Collection[str] | None = None) -> Iterator[Result]:
        """Read the results of a stage one at a time, in the order of their items' names.

        Parameters
        ----------
        stage : str
            A stage that is declared in ``reads``.
        names : collection of str, optional
            Arrays to read; all by default, an empty collection reads facts and notes alone.

        Raises
        ------
        ValueError
            If the stage was not declared.
        InputError
            If a result is damaged.
        """
        return (self._result(stage, name, names) for name in self._declared(stage))

    def read_rows(self, stage: str, name: str, array: str, start: int, stop: int) -> NDArray[Any]:
        """Read some rows of one array of one result that is among ``refs``; errors as for `read`."""
        self._check_reach(stage, name)
        return self.store.read_rows(stage, name, array, start, stop)

    def read_ranges(
        self, stage: str, name: str, names: Collection[str], ranges: Sequence[tuple[int, int]]
    ) -> dict[str, NDArray[Any]]:
        """Read ranges of rows of some arrays, ascending, put one after the other; errors as for `read`."""
        self._check_reach(stage, name)
        return self.store.read_ranges(stage, name, names, ranges)

    def read_window(
        self, stage: str, name: str, array: str, rows: tuple[int, int], columns: tuple[int, int]
    ) -> NDArray[Any]:
        """Read a window of an array that was put by `put_rasters`; errors as for `read`."""
        self._check_reach(stage, name)
        return self.store.read_window(stage, name, array, rows, columns)

    def put(self, **arrays: ArrayLike) -> None:
        """Write whole arrays of the result, each name once."""
        self._open_writer().put(**arrays)

    def put_rasters(self, **rasters: ArrayLike) -> None:
        """Write whole arrays of rows and columns, each name once, in chunks that suit `read_window`."""
        self._open_writer().put_rasters(**rasters)

    def append(self, **arrays: ArrayLike) -> None:
        """Append rows to arrays of the result, which may become larger than memory."""
        self._open_writer().append(**arrays)

    def discard(self) -> None:
        """Forget all arrays that were written so far."""
        self._open_writer().discard()

    def note(self, note: Note) -> None:
        """Keep a note with the result."""
        self._notes.append(note)

    def notes(self, notes: Iterable[Note]) -> None:
        """Keep notes with the result."""
        self._notes.extend(notes)

    @contextmanager
    def step(self, name: str) -> Iterator[None]:
        """Add the wall time of what is done inside to the record, under a name."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self._seconds[name] = self._seconds.get(name, 0.0) + time.perf_counter() - start

    @contextmanager
    def output(self) -> Iterator[Path]:
        """Give the folder for files that the result states; in a bucket they are put when all are written."""
        with files_for(self.folder) as folder:
            yield folder

    def _check_reach(self, stage: str, name: str) -> None:
        if name not in self._declared(stage):
            raise ValueError(f"stage {self.stage}, {self.name}: {name} of {stage} is beyond its reach")

    def _declared(self, stage: str) -> tuple[str, ...]:
        if stage not in self.refs:
            raise ValueError(f"stage {self.stage} reads stage {stage}, which it does not declare in reads")
        return self.refs[stage]

    def _result(self, stage: str, name: str, names: Collection[str] | None) -> Result:
        arrays, attributes = self.store.read(stage, name, names=names)
        return Result(name, arrays, attributes["facts"], tuple(notes_from_json(attributes["notes"])))

    def _open_writer(self) -> Writer:
        if self._writer is None:
            raise ValueError(f"stage {self.stage}, {self.name}: written to outside of its run")
        return self._writer


def run_task(function: Callable[[Task], Facts | None], task: Task) -> Record | Failure | Later:
    """Take an earlier result of a task, or run its stage's function and commit what comes of it.

    An earlier result is taken if it has the task's key, and every byte of it and of the files that it states is as
    it was written; a damaged one is computed again. An error leaves nothing behind. Errors come back as values; a
    RuntimeError with the text stands for one that cannot be pickled.
    """
    start = time.perf_counter()
    trust_addresses(True)
    try:
        earlier = _take_earlier(task)
        if isinstance(earlier, Record):
            return earlier
        _drop_stale(task)
        with task.store.writer(task.stage, task.name) as task._writer:
            found = function(task)
            if found is None:
                return Later()
            facts = _plain_facts(task, found)
            notes = [_note_to_json(note) for note in task._notes]
            digest = task._writer.commit({"key": task.key, "facts": facts, "notes": notes}, apart=APART)
    except CityError as error:
        return Failure(error, describe_trace(error))
    except Exception as error:
        kind = "memory" if isinstance(error, MemoryError) else "error"
        return Failure(_portable(error), describe_trace(error), kind)
    finally:
        task._writer = None
    seconds = {step: round(value, 4) for step, value in task._seconds.items()}
    seconds["all"] = round(time.perf_counter() - start, 4)
    return Record(
        task.stage,
        task.name,
        task.key,
        digest,
        facts,
        count_notes(task._notes),
        seconds,
        peak_memory=peak_memory(),
        damage=earlier,
    )


def find_earlier(task: Task) -> Record | Later:
    """Take an earlier result of a task as `run_task` does; `Later` if it has to be run."""
    trust_addresses(True)
    try:
        earlier = _take_earlier(task)
    except CityError:
        return Later()
    return earlier if isinstance(earlier, Record) else Later()


def _take_earlier(task: Task) -> Record | str:
    """Give the record of the committed result, or say what is wrong with it: nothing if it is of another key."""
    stage, name, store = task.stage, task.name, task.store
    if not store.has(stage, name):
        return ""
    file = store.file(stage, name).name
    try:
        attributes, digest = store.describe(stage, name)
    except CityError as error:
        return f"{file} {store.find_damage(stage, name) or error}"
    if attributes.get("key") not in (task.key, task.former or task.key):
        return ""
    facts = attributes["facts"]
    damage = {file: store.find_damage(stage, name)} | find_changed_files(task.folder, facts.get(FILES, {}))
    if found := [f"{path} {what}" for path, what in damage.items() if what]:
        return found[0] + (f", and {len(found) - 1} more" if found[1:] else "")
    if attributes["key"] != task.key:
        store.change_key(stage, name, task.key)
    notes = count_notes(notes_from_json(attributes["notes"]))
    return Record(stage, name, task.key, digest, facts, notes, reused=True)


def read_notes(store: Store, stage: str, name: str) -> list[Note]:
    """Read the notes of a result."""
    return notes_from_json(store.attributes(stage, name)["notes"])


def notes_from_json(rows: Iterable[list[Any]]) -> list[Note]:
    """Read notes as the store has them."""
    return [_note_from_json(values) for values in rows]


def peak_memory() -> int:
    """Return the peak resident memory of this process (bytes)."""
    try:  # VmHWM where the system tells it, as ru_maxrss survives a fork.
        status = Path("/proc/self/status").read_text()
        return int(status.split("VmHWM:")[1].split()[0]) * 1024
    except (OSError, IndexError, ValueError):
        peak: Any = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return int(peak) if sys.platform == "darwin" else int(peak) * 1024


def _drop_stale(task: Task) -> None:
    """Remove an earlier result that states files before others are written in their place.

    Killed between the files and the commit, a run would otherwise leave a result that states files of another one.
    """
    if not task.store.has(task.stage, task.name):
        return
    try:
        stale = FILES in task.store.attributes(task.stage, task.name)["facts"]
    except CityError:
        stale = True
    if stale:
        task.store.remove(task.stage, task.name)


def _plain_facts(task: Task, facts: Facts) -> Facts:
    try:
        plain: Facts = plain_json(dict(facts))
    except (TypeError, ValueError) as error:
        raise ValueError(f"facts of stage {task.stage}: {error}") from error
    check_files(task.stage, plain)
    return plain


def _note_to_json(note: Note) -> list[Any]:
    place = (float(v) if math.isfinite(v) else None for v in (note.x, note.y))
    return [note.kind, note.subject, *place, note.detail]


def _note_from_json(values: list[Any]) -> Note:
    kind, subject, x, y, detail = values
    nan = float("nan")
    return Note(kind, subject, nan if x is None else x, nan if y is None else y, detail)


def describe_trace(error: Exception) -> str:
    """Describe where in the code an error arose."""
    return "".join(traceback.format_exception(error))


def _portable(error: Exception) -> Exception:
    """Make an error survive the way back, with the traceback as a note."""
    text = describe_trace(error)
    try:
        error.add_note(f"where it arose:\n{text}")
        pickle.loads(pickle.dumps(error))
        return error
    except Exception:
        return RuntimeError(text)
