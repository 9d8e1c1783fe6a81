"""The tally of a run at work: items done by stage, failures, warnings, and the time that is left, as measured."""

import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from tiler.engine.stage import Scope
from tiler.engine.submission import Item
from tiler.engine.task import Record
from tiler.engine.watcher import RunStart, Watcher
from tiler.words.stage_groups import group_stages

# Parts of a run's work by stage, means over cities of 4 to 210 tiles; a round's number is left out. They count for
# stages of which nothing is measured yet, and for nothing else.
SHARES = {
    "points": 0.10,
    "ground": 0.06,
    "flooded": 0.04,
    "terrain": 0.02,
    "outlines": 0.02,
    "houses": 0.13,
    "shapes-": 0.04,
    "model": 0.07,
    "seams": 0.16,
    "columns": 0.13,
    "fit": 0.08,
    "pieces": 0.10,
}
SMALL_SHARE = 0.003  # of every other stage
LEAST_SHARE = 0.1  # of all work that must be measured before the time left is shown
LEAST_TIME = 3.0  # s, likewise
REUSE = 0.005  # s to look at a result that is taken as it is


@dataclass
class StageTally:
    """How far a stage is.

    Attributes
    ----------
    total, done, reused, failed, running : int
        Its items; those done, those of them that were there, those that failed or are not run, and those in the
        workers' hands.
    seconds : float
        Time of all items done (s).
    began : float
        When its first item was given to a worker, by the tally's clock (s); 0 before that.
    """

    total: int
    done: int = 0
    reused: int = 0
    failed: int = 0
    running: int = 0
    seconds: float = 0.0
    began: float = 0.0

    @property
    def left(self) -> int:
        """Items that are not done and may be."""
        return max(self.total - self.done - self.failed, 0)

    @property
    def work(self) -> float:
        """Time spent on it so far (s)."""
        return self.seconds + REUSE * self.reused


class Tally(Watcher):
    """Counts what happens in a run.

    Parameters
    ----------
    clock : callable
        Gives seconds since any moment.

    Attributes
    ----------
    stages : dict of str to StageTally
        In their order.
    warnings : Counter
        Notes by kind.
    failures : int
        Items that failed, without those that are not run for want of one that did.
    peak_memory : int
        Largest resident memory of a process that ran a task (bytes).
    workers : int
        Number of workers, 0 where a cluster decides.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self.stages: dict[str, StageTally] = {}
        self.warnings: Counter[str] = Counter()
        self.failures = self.peak_memory = self.workers = 0
        self._clock = clock
        self._made = clock()
        self._first = 0.0

    def begin(self, start: RunStart) -> None:
        """Take the stages that are known from the start."""
        self.workers = start.workers
        self.stages = {stage: StageTally(total) for stage, (_, total) in start.expected.items()}

    def planned(self, stage: str, scope: Scope, total: int) -> None:
        """Take note of how many items a stage has; one that is planned anew without some begins anew."""
        state = self._stage(stage)
        if total < state.total:
            state.done = state.failed = 0
        state.total = total

    def submitted(self, stage: str, name: str) -> None:
        """Count an item that was given to a worker."""
        now, state = self._clock(), self._stage(stage)
        self._first = self._first or now
        state.began = state.began or now
        state.running += 1

    def done(self, stage: str, n_done: int, total: int, record: Record) -> None:
        """Count an item that is done."""
        state = self._stage(stage)
        state.done, state.total = n_done, total
        state.running = max(state.running - 1, 0)
        state.reused += record.reused
        state.seconds += record.seconds.get("all", 0.0)
        self.warnings.update(record.notes)
        self.peak_memory = max(self.peak_memory, record.peak_memory)

    def failed(
        self, stage: str, name: str, reason: str, needs: Item | None = None, *, ends_run: bool = False
    ) -> None:
        """Count an item that failed, or is not run."""
        state = self._stage(stage)
        state.failed += 1
        if needs is None:
            state.running = max(state.running - 1, 0)
            self.failures += 1

    @property
    def elapsed(self) -> float:
        """Seconds since the tally was made."""
        return self._clock() - self._made

    @property
    def began(self) -> bool:
        """Whether a worker has had an item."""
        return bool(self._first)

    @property
    def in_hand(self) -> int:
        """Items that workers have, or that wait at their side."""
        return sum(state.running for state in list(self.stages.values()))

    def groups(self) -> dict[str, StageTally]:
        """How far the groups of stages are that a user sees, in their order (`tiler.words.stage_groups`)."""
        known = dict(list(self.stages.items()))
        return {group: _add_up([known[name] for name in names]) for group, names in group_stages(known).items()}

    def rate(self, state: StageTally) -> float:
        """Items that are done in a second, in the mean since the first; 0 as long as there is none."""
        spent = self._clock() - state.began
        return state.done / spent if state.began and spent > 0 else 0.0

    @property
    def spent(self) -> float:
        """Seconds since a worker was given the first item; 0 before that."""
        return self._clock() - self._first if self._first else 0.0

    def work_left(self) -> dict[str, float]:
        """Estimate the work that is left, see `estimate_work`."""
        return estimate_work(dict(list(self.stages.items())))

    def time_left(self) -> float | None:
        """Estimate the time to the end, see `estimate_time`."""
        return estimate_time(dict(list(self.stages.items())), self.spent)

    def share_done(self) -> float:
        """How much of all work is done, see `estimate_share`."""
        return estimate_share(dict(list(self.stages.items())), self.spent)

    def _stage(self, name: str) -> StageTally:
        return self.stages.setdefault(name, StageTally(0))


def estimate_work(stages: Mapping[str, StageTally]) -> dict[str, float]:
    """Estimate the work that is left, by stage (s of one worker).

    Notes
    -----
    An item that is left takes as long as those done took in the mean. Of a stage that has none yet, all of it
    is taken in proportion to `SHARES`.
    """
    known = {stage: state.work / state.done for stage, state in stages.items() if state.done and state.work > 0}
    share = sum(share_of(stage) for stage in known)
    whole = sum(mean * stages[stage].total for stage, mean in known.items())
    unit = whole / share if share >= LEAST_SHARE else 0.0
    return {
        stage: known[stage] * state.left if stage in known else unit * share_of(stage)
        for stage, state in stages.items()
        if state.left
    }


def estimate_time(stages: Mapping[str, StageTally], spent: float) -> float | None:
    """Estimate the time to the end (s), `spent` seconds after the first item was given to a worker.

    None as long as too little is measured.
    """
    done = sum(state.work for state in stages.values())
    share = sum(share_of(stage) for stage, state in stages.items() if state.done)
    if spent < LEAST_TIME or share < LEAST_SHARE or not done:
        return None
    return sum(estimate_work(stages).values()) * spent / done


def estimate_share(stages: Mapping[str, StageTally], spent: float) -> float:
    """How much of all work is done, as far as known: 0 to 1."""
    done = sum(state.work for state in stages.values())
    left = sum(estimate_work(stages).values())
    if estimate_time(stages, spent) is None or not done + left:
        items = sum(state.total for state in stages.values())
        return sum(state.done for state in stages.values()) / items if items else 0.0
    return done / (done + left)


def _add_up(stages: Sequence[StageTally]) -> StageTally:
    """Add up the stages of a group."""
    names = ("total", "done", "reused", "failed", "running", "seconds")
    began = [state.began for state in stages if state.began]
    return StageTally(
        **{name: sum(getattr(state, name) for state in stages) for name in names}, began=min(began, default=0.0)
    )


def share_of(stage: str) -> float:
    """How much of a run's work is a stage's, typically.

    Examples
    --------
    >>> share_of("shapes-1"), share_of("mine")
    (0.04, 0.003)
    """
    return SHARES.get(stage.rstrip("0123456789"), SMALL_SHARE)


def format_duration(seconds: float) -> str:
    """Write a time in the words of an estimate.

    Examples
    --------
    >>> [format_duration(seconds) for seconds in (0.2, 42.0, 100.0, 4000.0, 200000.0)]
    ['1 s', '42 s', '2 min', '1 h 7 min', '2 d 7 h']
    """
    minutes = round(seconds / 60)
    if seconds < 60:
        return f"{max(round(seconds), 1)} s"
    if minutes < 60:
        return f"{minutes} min"
    if minutes < 24 * 60:
        return f"{minutes // 60} h {minutes % 60} min"
    return f"{minutes // 1440} d {minutes % 1440 // 60} h"
