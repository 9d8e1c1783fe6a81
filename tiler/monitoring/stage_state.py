"""How far a stage is, and the work and time that are left, as measured."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field

from tiler.monitoring.items import State

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
class StageState:
    """How far a stage is, or a group of stages."""

    scope: str = ""  #: ``"file"``, ``"tile"``, ``"seam"`` or ``"region"``; empty if it was not told
    #: its items as planned last; those done, used again or not, and those that workers have
    total: int = 0
    done: int = 0
    in_hand: int = 0
    lost: set[str] = field(default_factory=set)  #: items that failed or are not run, of a group with their stages
    seconds: float = 0.0  #: wall time of all items done (s)
    began: float = 0.0  #: when its first item was given to a worker (s since 1970); 0 before that
    finished: float = 0.0  #: when the last item was done (s after the start of the run); 0 before that
    #: state of its items by name, where its scope has no boxes; those of tiles and seams are in `Items`
    codes: dict[str, int] = field(default_factory=dict)
    #: number of items in each state but `State.WAITING`, those that are planned no more among them
    counts: Counter[int] = field(default_factory=Counter)

    @property
    def failed(self) -> int:
        """Items that failed, or are not run for want of one that did."""
        return len(self.lost)

    @property
    def reused(self) -> int:
        """Items done that were there."""
        return min(self.counts[State.REUSED], self.done)

    @property
    def left(self) -> int:
        """Items that are not done and may be."""
        return max(self.total - self.done - self.failed, 0)

    @property
    def work(self) -> float:
        """Time spent on it so far (s)."""
        return self.seconds + REUSE * self.reused

    def rate(self, now: float) -> float:
        """Items that are done in a second, in the mean since the first; 0 as long as there is none."""
        spent = now - self.began
        return self.done / spent if self.began and spent > 0 else 0.0


def add_up(stages: Mapping[str, StageState]) -> StageState:
    """Add up the stages of a group, given by name."""
    whole = StageState()
    for stage, one in stages.items():
        whole.total += one.total
        whole.done += one.done
        whole.lost.update(f"{stage} {name}" for name in list(one.lost))
        whole.in_hand += one.in_hand
        whole.seconds += one.seconds
        whole.began = min(filter(None, (whole.began, one.began)), default=0.0)
        whole.counts += one.counts
    return whole


def estimate_work(stages: Mapping[str, StageState]) -> dict[str, float]:
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


def estimate_time(stages: Mapping[str, StageState], spent: float) -> float | None:
    """Estimate the time to the end (s), `spent` seconds after the first item was given to a worker.

    None as long as too little is measured.
    """
    done = sum(state.work for state in stages.values())
    share = sum(share_of(stage) for stage, state in stages.items() if state.done)
    if spent < LEAST_TIME or share < LEAST_SHARE or not done:
        return None
    return sum(estimate_work(stages).values()) * spent / done


def estimate_share(stages: Mapping[str, StageState], spent: float) -> float:
    """How much of all work is done, as far as known: 0 to 1."""
    done = sum(state.work for state in stages.values())
    left = sum(estimate_work(stages).values())
    if estimate_time(stages, spent) is None or not done + left:
        items = sum(state.total for state in stages.values())
        return sum(state.done for state in stages.values()) / items if items else 0.0
    return done / (done + left)


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
