"""What is known of the tiles or of the seams of a run: boxes, states by stage, and values to colour by."""

from array import array
from collections.abc import Iterable, Sequence
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tiler.words.stage_groups import group_of_stage

Codes = NDArray[np.uint8]
GROWTH = 1024  # items that are made room for at least
MOST_FACTS = 64  # kinds of values that are kept; a stage of the user's own may tell anything


class State(IntEnum):
    """What is known of an item; `BEGUN` is a tile of which some stages are done and none is at work."""

    WAITING = 0
    BEGUN = 1
    RUNNING = 2
    DONE = 3
    REUSED = 4
    FAILED = 5


STATES = tuple(state.name.lower() for state in State)


def tally(codes: Codes, group: NDArray[np.int64], n_groups: int) -> NDArray[np.int64]:
    """Count states in groups.

    Parameters
    ----------
    codes : uint8, (n,)
        A `State` each.
    group : int64, (n,)
        The group of each, from 0.
    n_groups : int
        Number of groups.

    Returns
    -------
    int64, (n_groups, 6)
        Number of items in each state.

    Examples
    --------
    >>> tally(np.array([3, 3, 5], np.uint8), np.array([0, 1, 1]), 2).tolist()
    [[0, 0, 0, 1, 0, 0], [0, 0, 0, 1, 0, 1]]
    """
    n = len(State)
    return np.bincount(group * n + codes, minlength=n_groups * n).reshape(n_groups, n)


def combine(counts: NDArray[np.int64]) -> Codes:
    """Bring the states of many to one: failed if any failed, at work if any is, done if all are.

    Parameters
    ----------
    counts : int64, (n, 6)
        Number of items in each state, from `tally`.

    Returns
    -------
    uint8, (n,)
        A `State` each; `State.WAITING` where there is no item.

    Examples
    --------
    >>> rows = [[0, 0, 0, 2, 0, 1], [1, 0, 1, 1, 0, 0], [1, 0, 0, 1, 0, 0], [0, 0, 0, 1, 1, 0], [0, 0, 0, 0, 2, 0]]
    >>> combine(np.array(rows)).tolist()
    [5, 2, 1, 3, 4]
    """
    total = counts.sum(axis=1)
    done = counts[:, State.DONE] + counts[:, State.REUSED]
    found = np.zeros(len(counts), np.uint8)
    found[(done > 0) | (counts[:, State.BEGUN] > 0)] = State.BEGUN
    found[(done == total) & (total > 0)] = State.DONE
    found[(counts[:, State.REUSED] == total) & (total > 0)] = State.REUSED
    found[counts[:, State.RUNNING] > 0] = State.RUNNING
    found[counts[:, State.FAILED] > 0] = State.FAILED
    return found


class Column:
    """One number an item, with room for more items.

    Parameters
    ----------
    dtype : dtype
        Its type.
    empty : float
        Value of an item of which nothing is known.
    """

    def __init__(self, dtype: Any, empty: float) -> None:
        self._empty = empty
        self._values: NDArray[Any] = np.empty(0, dtype)

    def __setitem__(self, k: int, value: float) -> None:
        if k >= len(self._values):
            more = np.full(max(GROWTH, k + 1), self._empty, self._values.dtype)
            self._values = np.concatenate([self._values, more])
        self._values[k] = value

    def get(self, k: int) -> Any:
        """Value of an item."""
        return self._values[k] if k < len(self._values) else self._empty

    def take(self, n: int) -> NDArray[Any]:
        """Values of the first `n` items, (n,)."""
        found = np.full(n, self._empty, self._values.dtype)
        m = min(n, len(self._values))
        found[:m] = self._values[:m]
        return found


class StageColumns:
    """What one stage has done for the items of its scope."""

    def __init__(self) -> None:
        self.codes = Column(np.uint8, State.WAITING)
        self.seconds = Column(np.float32, np.nan)
        self.notes = Column(np.int32, 0)
        self.dropped = Column(np.int32, 0)


class Items:
    """The items of a scope.

    Attributes
    ----------
    names : list of str
        Their names, in the order in which they were told.
    layout : int
        Rises when an item is added.
    stages : dict of str to StageColumns
        What each stage of this scope has done.
    facts : dict of str to Column
        What stages tell of items, by the name of the fact.
    views : dict
        What a map keeps of parts of the region, see `tiler.dashboard.map_view`; void when an item is added.
    """

    def __init__(self) -> None:
        self.names: list[str] = []
        self.layout = 0
        self.stages: dict[str, StageColumns] = {}
        self.facts: dict[str, Column] = {}
        self.views: dict[Any, Any] = {}
        self._tally: NDArray[np.int16] = np.zeros((0, len(State)), np.int16)  # stages of each item in each state
        self._boxes = array("d")  # four numbers an item
        self._index: dict[str, int] = {}
        self._changed = Column(np.int64, 0)
        self._known: tuple[int, NDArray[np.float64]] = (0, np.empty((0, 4)))

    def __len__(self) -> int:
        return len(self.names)

    def add(self, rows: Iterable[Sequence[Any]], version: int) -> None:
        """Add items as (name, xmin, ymin, xmax, ymax), boxes in metres; one that is there stays as it is."""
        for name, *box in rows:
            xmin, ymin, xmax, ymax = map(float, box)
            if str(name) in self._index:
                continue
            self._index[str(name)] = len(self.names)
            self._changed[len(self.names)] = version
            self.names.append(str(name))
            self._boxes.extend((xmin, ymin, xmax, ymax))
        if self.layout != len(self.names):
            self.layout = len(self.names)
            self.views.clear()
            more = np.zeros((max(self.layout, GROWTH), len(State)), np.int16)
            if self.layout > len(self._tally):
                self._tally = np.concatenate([self._tally, more])

    def find(self, name: str) -> int | None:
        """Place of an item in the order, or None."""
        return self._index.get(name)

    def code(self, k: int, stage: str) -> int:
        """State of an item in a stage."""
        return int(self.stage(stage).codes.get(k))

    def set_code(self, k: int, stage: str, code: int, version: int) -> None:
        """Change the state of an item in a stage."""
        codes = self.stage(stage).codes
        self._tally[k, codes.get(k)] -= 1
        self._tally[k, code] += 1
        codes[k] = code
        self._changed[k] = version

    def stage(self, name: str) -> StageColumns:
        """Columns of a stage."""
        if name not in self.stages:
            self.stages[name] = StageColumns()
        return self.stages[name]

    def tell(self, k: int, fact: str, value: float) -> None:
        """Keep a fact of an item."""
        if fact not in self.facts:
            if len(self.facts) >= MOST_FACTS:
                return
            self.facts[fact] = Column(np.float64, np.nan)
        self.facts[fact][k] = value

    def boxes(self) -> NDArray[np.float64]:
        """Boxes (m), (n, 4)."""
        if self._known[0] != len(self):
            self._known = len(self), np.array(self._boxes).reshape(-1, 4)
        return self._known[1]

    def changed(self) -> NDArray[np.int64]:
        """Version in which each item last changed, (n,)."""
        return self._changed.take(len(self))

    def codes(self, stage: str) -> Codes:
        """State of each item, (n,): in the stages of a step, in one stage, or in all where `stage` is empty."""
        if stage:
            names, n = self.members(stage), len(self)
            if len(names) == 1:
                return self.stages[names[0]].codes.take(n)
            several = np.zeros((n, len(State)), np.int64)
            for name in names:
                several[np.arange(n), self.stages[name].codes.take(n)] += 1
            return combine(several)
        counts = self._tally[: len(self)].astype(np.int64)
        counts[:, State.WAITING] += len(self.stages)  # of which those in another state were taken away
        return combine(counts)

    def members(self, stage: str) -> list[str]:
        """List the stages of this scope that a step has (`tiler.words.stage_groups`), or the one of that name."""
        return [name for name in self.stages if stage in (name, group_of_stage(name))]

    def values(self, value: str, stage: str) -> NDArray[np.float64]:
        """A value of each item, (n,), NaN where it is not known.

        Parameters
        ----------
        value : str
            ``"progress"``, the share of the stages that are done (%); ``"seconds"``, ``"notes"``, ``"dropped"``,
            or the name of a fact.
        stage : str
            Of this step or stage alone, or of all where it is empty; facts are of the item, whatever the stage.
        """
        n = len(self)
        if value in self.facts:
            return self.facts[value].take(n)
        if value == "progress":
            return self._progress(stage)
        total, known = np.zeros(n), np.zeros(n, np.bool_)
        if value in {"seconds", "notes", "dropped"}:
            for name, columns in self.stages.items():
                if stage in ("", name, group_of_stage(name)):
                    codes = columns.codes.take(n)
                    found = getattr(columns, value).take(n).astype(np.float64)
                    finished = codes == State.DONE
                    if value != "seconds":  # what an earlier run had done has no time in this one
                        finished |= codes == State.REUSED
                    known |= finished & np.isfinite(found)
                    total += np.nan_to_num(found)
        return np.where(known, total, np.nan)

    def _progress(self, stage: str) -> NDArray[np.float64]:
        if stage:
            names, n = self.members(stage), len(self)
            finished = np.zeros(n)
            for name in names:
                codes = self.stages[name].codes.take(n)
                finished += (codes == State.DONE) | (codes == State.REUSED)
            return 100.0 * finished / max(len(names), 1)
        done = self._tally[: len(self), [State.DONE, State.REUSED]].sum(axis=1)
        return np.asarray(100.0 * done / max(len(self.stages), 1))
