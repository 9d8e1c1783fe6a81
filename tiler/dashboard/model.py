"""The state of a run, folded from the events of its driver (`tiler.monitoring.events`) one after the other."""

import math
from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from tiler.dashboard.items import Items, State
from tiler.words.note_words import is_drop

MOST = 200  # intervals; when there are more, two become one
TILE, SEAM = "tile", "seam"
KEPT_FAILURES, KEPT_MESSAGES = 1000, 50
FINISHED = (State.DONE, State.REUSED)


@dataclass
class Interval:
    """What happened in an interval.

    Attributes
    ----------
    done : int
        Items that were finished, those taken from an earlier run left out.
    seconds : float
        Their wall time (s).
    memory : int
        Largest memory of a process that any of them told (bytes); 0 if none.
    running : int
        Items at work at its end; -1 if nothing was told.
    """

    done: int = 0
    seconds: float = 0.0
    memory: int = 0
    running: int = -1


class Series:
    """Intervals of equal length since the start; their length doubles when there are too many.

    Examples
    --------
    >>> series = Series()
    >>> for t in (100.0, 100.5, 350.0):
    ...     series.add(t, seconds=2.0, memory=10, running=1)
    >>> series.width, series.rows()[0]
    (2.0, [2, 4.0, 10, 1])
    """

    def __init__(self) -> None:
        self.width = 1.0
        self._begin: float | None = None
        self._intervals: list[Interval] = []

    def add(self, t: float, *, seconds: float, memory: int, running: int, done: int = 1) -> None:
        """Add an item that was finished at `t` (s); a time before the start counts as the start."""
        self._begin = t if self._begin is None else self._begin
        since = max(t - self._begin, 0.0)
        while since >= MOST * self.width:
            self._halve()
        k = int(since / self.width)
        self._intervals += [Interval() for _ in range(k + 1 - len(self._intervals))]
        one = self._intervals[k]
        one.done += done
        one.seconds += seconds
        one.memory, one.running = max(one.memory, memory), running

    def rows(self) -> list[list[float]]:
        """Give done, seconds, memory and running of each interval; what was not told is that of the one before."""
        rows, running, memory = [], 0, 0
        for one in self._intervals:
            running = one.running if one.running >= 0 else running
            memory = one.memory or memory
            rows.append([one.done, round(one.seconds, 2), memory, running])
        return rows

    def _halve(self) -> None:
        self.width *= 2
        pairs = [self._intervals[k : k + 2] for k in range(0, len(self._intervals), 2)]
        self._intervals = [
            Interval(
                sum(one.done for one in pair),
                sum(one.seconds for one in pair),
                max(one.memory for one in pair),
                next((one.running for one in reversed(pair) if one.running >= 0), -1),
            )
            for pair in pairs
        ]


@dataclass
class StageState:
    """How far a stage is.

    Attributes
    ----------
    scope : str
        ``"file"``, ``"tile"``, ``"seam"`` or ``"region"``; empty if it was not told.
    total : int
        Its items, as planned last.
    codes : dict of str to int
        State of its items by name, where its scope has no boxes; those of tiles and seams are in `Items`.
    counts : Counter
        Number of its items in each state but `State.WAITING`.
    seconds : float
        Wall time of what was computed (s).
    last : float
        When an item was last done (s since 1970).
    """

    scope: str = ""
    total: int = 0
    codes: dict[str, int] = field(default_factory=dict)
    counts: Counter[int] = field(default_factory=Counter)
    seconds: float = 0.0
    last: float = 0.0

    @property
    def done(self) -> int:
        """Items done, used again or not."""
        return self.counts[State.DONE] + self.counts[State.REUSED]


@dataclass(frozen=True)
class FailedItem:
    """An item that failed: its reason, and the command that reproduces it, empty if there is none."""

    stage: str
    name: str
    reason: str
    command: str
    t: float
    version: int


class RunModel:
    """The state of a run.

    Attributes
    ----------
    version : int
        Number of events folded so far: a cursor for readers.
    head : dict
        What the event ``"run"`` says: command, bounds, CRS, tile size, workers, status, error.
    began, last : float
        Time of the first and of the last event (s since 1970); 0 before any.
    items : dict of str to Items
        Tiles and seams, by scope.
    stages : dict of str to StageState
        In the order in which they were told.
    failures : deque of FailedItem
        The last `KEPT_FAILURES`; `n_failures` counts all.
    at_work : dict of (str, str) to float
        Stage and name of what workers have in hand, and since when (s since 1970).
    queued : dict of (str, str) to None
        What of that waits at the workers' side: they have several items in hand, and run as many as they are.
    first : float
        When the first item was given to a worker (s since 1970); 0 before any.
    notes : Counter
        Notes by kind.
    memory : int
        Largest memory of a process that was told (bytes).
    ignored : int
        Events that were not understood.
    """

    def __init__(self) -> None:
        self.version = 0
        self.head: dict[str, Any] = {}
        self.began = self.last = self.first = 0.0
        self.items = {TILE: Items(), SEAM: Items()}
        self.stages: dict[str, StageState] = {}
        self.failures: deque[FailedItem] = deque(maxlen=KEPT_FAILURES)
        self.n_failures = 0
        self.messages: deque[tuple[float, str, int]] = deque(maxlen=KEPT_MESSAGES)
        self.at_work: dict[tuple[str, str], float] = {}
        self.queued: dict[tuple[str, str], None] = {}
        self.notes: Counter[str] = Counter()
        self.series = Series()
        self.memory = 0
        self.ignored = 0

    @property
    def status(self) -> str:
        """What the run said of itself last."""
        return str(self.head.get("status", ""))

    def standing(self, *, alive: bool) -> str:
        """What the run is, by what it said and whether it is at work: ``"dead"`` if it ended without a word."""
        if alive:
            return "running" if self.status in {"", "running"} else self.status
        return "dead" if self.status == "running" else self.status or "unknown"

    def fold(self, event: object) -> None:
        """Take note of an event; one that is not of the known form is counted in `ignored`."""
        self.version += 1
        try:
            if not isinstance(event, dict):
                raise TypeError
            t = float(event.get("t", self.last))
            if not math.isfinite(t):
                raise ValueError
            fold = _FOLDS[event["event"]]
            self.began = self.began or t
            self.last = max(self.last, t)
            fold(self, event, t)
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError):
            self.ignored += 1

    def _run(self, event: Mapping[str, Any], _: float) -> None:
        self.head |= {name: value for name, value in event.items() if name not in {"t", "event"}}
        if self.status not in {"", "running"}:
            for stage, name in self.at_work:  # what a run that ends has in hand is given up
                place = self._find(stage, name)
                if self._code(place) == State.RUNNING:
                    self._set(place, State.WAITING)
            self.at_work.clear()
            self.queued.clear()

    def _tiles(self, event: Mapping[str, Any], _: float) -> None:
        self.items[TILE].add(event["tiles"], self.version)

    def _seams(self, event: Mapping[str, Any], _: float) -> None:
        self.items[SEAM].add(event["seams"], self.version)

    def _planned(self, event: Mapping[str, Any], _: float) -> None:
        name = str(event["stage"])
        stage = self._stage(name)
        stage.scope, stage.total = str(event.get("scope", stage.scope)), int(event["total"])
        if stage.scope in self.items:
            self.items[stage.scope].stage(name)

    def _submitted(self, event: Mapping[str, Any], t: float) -> None:
        place = self._find(str(event["stage"]), str(event["name"]))
        self.at_work[place.key] = t
        self.first = self.first or t
        workers = int(self.head.get("workers") or 0)
        if workers and len(self.at_work) - len(self.queued) > workers:
            self.queued[place.key] = None
        elif self._code(place) not in FINISHED:
            self._set(place, State.RUNNING)

    def _take_back(self, key: tuple[str, str], t: float) -> None:
        """Take note that workers have an item no more; the one that waits longest runs now."""
        if self.at_work.pop(key, None) is None:
            return
        if key in self.queued:
            del self.queued[key]
        elif self.queued:
            following = next(iter(self.queued))
            del self.queued[following]
            self.at_work[following] = t
            place = self._find(*following)
            if self._code(place) not in FINISHED:
                self._set(place, State.RUNNING)

    def _done(self, event: Mapping[str, Any], t: float) -> None:
        place = self._find(str(event["stage"]), str(event["name"]))
        self._take_back(place.key, t)
        if self._code(place) in FINISHED:
            return  # planned again around a hole, and taken as it was
        reused, seconds, memory = bool(event.get("reused")), _number(event, "seconds"), _number(event, "memory")
        notes = {str(kind): int(n) for kind, n in (event.get("notes") or {}).items()}
        self._set(place, State.REUSED if reused else State.DONE)
        stage = place.stage
        stage.last, stage.total = t, int(event.get("total", stage.total))
        self.notes.update(notes)
        self.memory = max(self.memory, int(memory))
        if not reused:
            stage.seconds += seconds
        self.series.add(
            t,
            seconds=seconds,
            memory=int(memory),
            running=len(self.at_work) - len(self.queued),
            done=0 if reused else 1,
        )
        if place.items is not None:
            self._keep(place.items, place, seconds, notes, event.get("facts") or {})

    def _failed(self, event: Mapping[str, Any], t: float) -> None:
        place = self._find(str(event["stage"]), str(event["name"]))
        self._take_back(place.key, t)
        self._set(place, State.FAILED)
        reason, command = str(event.get("reason", "")), str(event.get("command", ""))
        self.failures.append(FailedItem(*place.key, reason, command, t, self.version))
        self.n_failures += 1

    def _message(self, event: Mapping[str, Any], t: float) -> None:
        self.messages.append((t, str(event["text"]), self.version))

    def _stage(self, name: str) -> StageState:
        if name not in self.stages:
            self.stages[name] = StageState()
        return self.stages[name]

    def _find(self, stage: str, name: str) -> "_Place":
        """Find where an item's numbers are; they are in its stage where it has no box."""
        found = self._stage(stage)
        items = self.items.get(found.scope)
        k = items.find(name) if items is not None else None
        if items is None or k is None:
            return _Place((stage, name), found, None, -1)
        return _Place((stage, name), found, items, k)

    @staticmethod
    def _code(place: "_Place") -> int:
        if place.items is None:
            return place.stage.codes.get(place.key[1], State.WAITING)
        return place.items.code(place.k, place.key[0])

    def _set(self, place: "_Place", code: State) -> None:
        counts, old = place.stage.counts, self._code(place)
        if place.items is None:
            place.stage.codes[place.key[1]] = code
        else:
            place.items.set_code(place.k, place.key[0], code, self.version)
        counts[old] -= old != State.WAITING
        counts[code] += code != State.WAITING

    @staticmethod
    def _keep(
        items: Items, place: "_Place", seconds: float, notes: Mapping[str, int], facts: Mapping[str, Any]
    ) -> None:
        """Keep the numbers of a tile or a seam."""
        columns, k = items.stage(place.key[0]), place.k
        columns.seconds[k] = seconds
        if notes:
            columns.notes[k] = sum(notes.values())
            columns.dropped[k] = sum(n for kind, n in notes.items() if is_drop(kind))
        for fact, value in facts.items():
            if isinstance(value, (int, float)) and math.isfinite(value):
                items.tell(k, str(fact), float(value))


class _Place(NamedTuple):
    """Where the numbers of an item are: ``k`` of `items`, or its stage alone where these are None."""

    key: tuple[str, str]
    stage: StageState
    items: Items | None
    k: int


_FOLDS = {
    "run": RunModel._run,
    "tiles": RunModel._tiles,
    "seams": RunModel._seams,
    "planned": RunModel._planned,
    "submitted": RunModel._submitted,
    "done": RunModel._done,
    "failed": RunModel._failed,
    "message": RunModel._message,
}


def _number(event: Mapping[str, Any], name: str) -> float:
    value = float(event.get(name) or 0.0)
    if not math.isfinite(value):
        raise ValueError(name)
    return value
