"""The state of a run: its events (`tiler.monitoring.events`), folded one after the other.

Terminal, log, ``progress.json``, page, metrics and report all take their numbers from here.
"""

import math
from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

from tiler.monitoring.items import Items, State
from tiler.monitoring.stage_state import StageState, add_up, estimate_share, estimate_time
from tiler.words.note_words import is_drop
from tiler.words.stage_groups import group_stages

MOST = 200  # intervals; when there are more, two become one
TILE, SEAM = "tile", "seam"
KEPT_FAILURES, KEPT_MESSAGES = 1000, 50
FINISHED = (State.DONE, State.REUSED)


@dataclass
class Interval:
    """What happened in an interval."""

    done: int = 0  #: items that were finished, those taken from an earlier run left out
    seconds: float = 0.0  #: their wall time (s)
    memory: int = 0  #: largest memory of a process that any of them told (bytes); 0 if none
    running: int = -1  #: items at work at its end; -1 if nothing was told


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


@dataclass(frozen=True)
class FailedItem:
    """An item that failed: its reason, and the command that reproduces it, empty if there is none."""

    stage: str
    name: str
    reason: str
    command: str
    t: float
    version: int


class RunState:
    """The state of a run.

    Parameters
    ----------
    mapped : bool
        Keep what a map shows of each tile and seam: seconds, notes and facts.

    Attributes
    ----------
    version : int
        Number of events folded so far: a cursor for readers.
    head : dict
        What the event ``"run"`` says: command, bounds, CRS, tile size, workers, status, error.
    began, last : float
        When the run began, and time of the last event (s since 1970); 0 before any.
    items : dict of str to Items
        Tiles and seams, by scope.
    stages : dict of str to StageState
        In the order in which they were told.
    failures : deque of FailedItem
        The last `KEPT_FAILURES`; `n_failures` counts all, and `n_own` those that do not fail for want of another.
    at_work : dict of (str, str) to float
        Stage and name of what workers have in hand, or had when the run ended, and since when (s since 1970).
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

    def __init__(self, *, mapped: bool = True) -> None:
        self._mapped = mapped
        self.version = 0
        self.head: dict[str, Any] = {}
        self.began = self.last = self.first = 0.0
        self.items = {TILE: Items(), SEAM: Items()}
        self.stages: dict[str, StageState] = {}
        self.failures: deque[FailedItem] = deque(maxlen=KEPT_FAILURES)
        self.n_failures = self.n_own = 0
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

    @property
    def ended(self) -> bool:
        """Whether the run has said that it is over."""
        return self.status not in {"", "running"}

    @property
    def workers(self) -> int:
        """Number of workers, 0 where a cluster decides."""
        return int(self.head.get("workers") or 0)

    def groups(self) -> dict[str, StageState]:
        """How far the groups of stages are that a user sees, in their order (`tiler.words.stage_groups`)."""
        known = dict(list(self.stages.items()))  # a thread that draws may ask while another folds
        return {
            group: add_up({name: known[name] for name in names}) for group, names in group_stages(known).items()
        }

    def time_left(self, now: float) -> float | None:
        """Estimate the time to the end (s), see `estimate_time`; `now` in s since 1970."""
        return estimate_time(dict(list(self.stages.items())), self._spent(now))

    def share_done(self, now: float) -> float:
        """How much of all work is done, see `estimate_share`."""
        return estimate_share(dict(list(self.stages.items())), self._spent(now))

    def _spent(self, now: float) -> float:
        return now - self.first if self.first else 0.0

    def fold(self, event: object) -> bool:
        """Take note of an event; one that is not of the known form is counted in `ignored`, and gives False."""
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
            return False
        return True

    def _run(self, event: Mapping[str, Any], t: float) -> None:
        self.began = self.began if self.head else t
        self.head |= {name: value for name, value in event.items() if name not in {"t", "event"}}
        if self.ended:
            for stage, name in self.at_work:  # what a run that ends has in hand is given up
                place = self._find(stage, name)
                if self._code(place) == State.RUNNING:
                    self._set(place, State.WAITING)
            self.queued.clear()

    def _tiles(self, event: Mapping[str, Any], _: float) -> None:
        self.items[TILE].add(event["tiles"], self.version)

    def _seams(self, event: Mapping[str, Any], _: float) -> None:
        self.items[SEAM].add(event["seams"], self.version)

    def _planned(self, event: Mapping[str, Any], _: float) -> None:
        name = str(event["stage"])
        stage, total = self._stage(name), int(event["total"])
        if total < stage.total:  # planned without some, the stage begins anew
            stage.done = 0
            stage.lost.clear()
        stage.scope, stage.total = str(event.get("scope", stage.scope)), total
        if stage.scope in self.items:
            self.items[stage.scope].stage(name)

    def _submitted(self, event: Mapping[str, Any], t: float) -> None:
        place = self._find(str(event["stage"]), str(event["name"]))
        place.stage.in_hand += place.key not in self.at_work
        place.stage.began = place.stage.began or t
        self.at_work[place.key] = t
        self.first = self.first or t
        if self.workers and len(self.at_work) - len(self.queued) > self.workers:
            self.queued[place.key] = None
        elif self._code(place) not in FINISHED:
            self._set(place, State.RUNNING)

    def _take_back(self, place: "_Place", t: float) -> None:
        """Take note that workers have an item no more; the one that waits longest runs now."""
        if self.at_work.pop(place.key, None) is None:
            return
        place.stage.in_hand -= 1
        if place.key in self.queued:
            del self.queued[place.key]
        elif self.queued:
            following = next(iter(self.queued))
            del self.queued[following]
            self.at_work[following] = t
            next_one = self._find(*following)
            if self._code(next_one) not in FINISHED:
                self._set(next_one, State.RUNNING)

    def _done(self, event: Mapping[str, Any], t: float) -> None:
        place = self._find(str(event["stage"]), str(event["name"]))
        stage, before = place.stage, self._code(place)
        reused, seconds, memory = bool(event.get("reused")), _number(event, "seconds"), _number(event, "memory")
        notes = {str(kind): int(n) for kind, n in (event.get("notes") or {}).items()}
        done = int(event.get("done", stage.done + (before not in FINISHED)))
        total = int(event.get("total", stage.total))
        self._take_back(place, t)
        stage.done, stage.total = done, total
        stage.lost.discard(place.key[1])
        if done == total:
            stage.finished = round(t - self.began, 3)
        if before in FINISHED:
            return  # planned again around a hole, and taken as it was
        self._set(place, State.REUSED if reused else State.DONE)
        self.notes.update(notes)
        self.memory = max(self.memory, int(memory))
        stage.seconds += seconds
        self.series.add(
            t,
            seconds=seconds,
            memory=int(memory),
            running=len(self.at_work) - len(self.queued),
            done=0 if reused else 1,
        )
        if place.items is not None and self._mapped:
            self._keep(place.items, place, seconds, notes, event.get("facts") or {})

    def _failed(self, event: Mapping[str, Any], t: float) -> None:
        place = self._find(str(event["stage"]), str(event["name"]))
        self._take_back(place, t)
        self._set(place, State.FAILED)
        reason, command = str(event.get("reason", "")), str(event.get("command", ""))
        self.failures.append(FailedItem(*place.key, reason, command, t, self.version))
        self.n_failures += 1
        self.n_own += not event.get("needs")
        place.stage.lost.add(place.key[1])

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
    "run": RunState._run,
    "tiles": RunState._tiles,
    "seams": RunState._seams,
    "planned": RunState._planned,
    "submitted": RunState._submitted,
    "done": RunState._done,
    "failed": RunState._failed,
    "message": RunState._message,
}


def _number(event: Mapping[str, Any], name: str) -> float:
    value = float(event.get(name) or 0.0)
    if not math.isfinite(value):
        raise ValueError(name)
    return value
