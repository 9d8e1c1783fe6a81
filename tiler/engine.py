"""The engine: runs stages over the items of a layout, each result once, and skips what is there already.

The driver decides what may run and keeps small records; functions, arrays and files are the workers'. Nothing here
knows Dask: see `tiler.executors`.
"""

import heapq
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import CityError
from tiler.executors import Executor
from tiler.keys import declared_values, file_identity, item_key, stage_digest
from tiler.plan import (
    Items,
    Refs,
    extents,
    find_refs,
    invert,
    joined_reads,
    list_items,
    list_refs,
    order_stages,
    reads_everything,
)
from tiler.stage import Facts, Layout, Scope, Stage
from tiler.store import Store
from tiler.task import Declared, Failure, Record, Task, reuse

Progress = Callable[[str, int, int, Record], None]
PER_WORKER, LEAST_WINDOW = 4, 8  # tasks in flight


@dataclass(frozen=True, eq=False)
class _Planned:
    """A stage of this call: its items are the tasks ``first`` to ``first + len(items.names)``."""

    stage: Stage
    items: Items
    refs: tuple[Refs, ...]
    first: int
    digest: bytes
    parameters: Declared


class Engine:
    """Runs stages and keeps their records.

    Parameters
    ----------
    store_path : Path
        Folder of the store; one engine at a time may write to it.
    layout : Layout
        The items of every scope.
    parameters : object
        Anything with the declared parameters as attributes.
    context : object, optional
        Given to every task as it is; small and picklable.
    executor : Executor
        Where tasks run, see `tiler.executors`.
    window : int, optional
        Largest number of tasks in flight; 4 a worker and at least 8 by default.
    folder : Path, optional
        Where the files are that results state as the fact ``"files"``, sizes by path; beside the store by default.
    progress : callable, optional
        Called with stage, number of items done, number of items in all, and the record of each item.

    Attributes
    ----------
    records : dict of (str, str) to Record
        What came of each stage and item so far.
    """

    def __init__(
        self,
        store_path: Path,
        layout: Layout,
        *,
        parameters: Any,
        context: Any = None,
        executor: Executor,
        window: int | None = None,
        folder: Path | None = None,
        progress: Progress | None = None,
    ) -> None:
        self.store = Store(store_path)
        self.layout = layout
        self.records: dict[tuple[str, str], Record] = {}
        self._parameters, self._context = parameters, context
        self._executor, self._progress = executor, progress
        self._folder = store_path.parent if folder is None else folder
        self._window = max(PER_WORKER * executor.workers, LEAST_WINDOW) if window is None else window
        if self._window < 1:
            raise ValueError(f"window {self._window}, expected 1 or more")
        self._items: dict[str, tuple[Scope, Items]] = {}

    def run(self, *stages: Stage, items: Mapping[str, Collection[str]] | None = None) -> None:
        """Run stages whose reads are among them or were run before.

        A task is submitted when all that it reads is done; of those that may run, those of later stages go first,
        then in the order of names.

        Parameters
        ----------
        *stages : Stage
            In any order.
        items : mapping, optional
            Restricts stages, by name, to some of their items.

        Raises
        ------
        CityError
            The first that an item raises, its stage and name in the message. Nothing is submitted after it, and
            what runs is waited for; all that was committed is kept and skipped next time.
        Exception
            Any other error of a stage's function likewise, its type kept; stage, name and traceback are its notes.
        ValueError
            For unknown stages, cycles, reads of items that are not run, and parameters that are not there.
        """
        unknown = sorted(set(items or ()) - {stage.name for stage in stages})
        if unknown:
            raise ValueError(f"items are given for stages that are not: {', '.join(unknown)}")
        order = order_stages(stages, self._items.keys())
        plan = self._plan(order, items or {})
        for planned in plan:
            self._items[planned.stage.name] = (planned.stage.scope, planned.items)
            self.store.sweep(planned.stage.name)
            for name in (items or {}).get(planned.stage.name, planned.items.names):
                self.records.pop((planned.stage.name, name), None)
        try:
            _Run(self, plan).drive()
        finally:
            for planned in plan:
                self._items[planned.stage.name] = (planned.stage.scope, self._recorded(planned))

    def prune(self) -> None:
        """Remove from the store what this engine has no record of: results of stages and items of another run."""
        kept = {stage for stage, _ in self.records}
        for stage in self.store.stages():
            if stage not in kept:
                self.store.remove(stage)
            for name in self.store.names(stage):
                if (stage, name) not in self.records:
                    self.store.remove(stage, name)

    def _recorded(self, planned: "_Planned") -> Items:
        """Keep of the items those that have a record, which are all unless the run failed."""
        names = planned.items.names
        rows = [k for k, name in enumerate(names) if (planned.stage.name, name) in self.records]
        return Items(tuple(names[k] for k in rows), planned.items.boxes[rows])

    def _plan(self, order: list[Stage], only: Mapping[str, Collection[str]]) -> list[_Planned]:
        known = dict(self._items)
        plan: list[_Planned] = []
        first = 0
        for stage in order:
            here = list_items(stage, self.layout, self._wanted(stage, only.get(stage.name)))
            refs = tuple(self._refs(stage, here, source, known) for source, _ in joined_reads(stage))
            values = declared_values(stage, self._parameters)
            digest = stage_digest(stage, values, self.layout)
            plan.append(_Planned(stage, here, refs, first, digest, Declared(stage.name, values)))
            known[stage.name] = (stage.scope, here)
            first += len(here.names)
        return plan

    def _wanted(self, stage: Stage, only: Collection[str] | None) -> Collection[str] | None:
        """Add what ran in earlier calls: it stays an item, and its records stay."""
        earlier = set(self._items[stage.name][1].names) if stage.name in self._items else set()
        return None if only is None else earlier.union(only)

    def _facts(self, stage: str, names: Iterable[str]) -> dict[str, Facts]:
        return {name: self.records[stage, name].facts for name in names}

    def _refs(self, stage: Stage, here: Items, source: str, known: Mapping[str, tuple[Scope, Items]]) -> Refs:
        """Find refs among all items of the layout first: one that is read but not run is an error, not a gap."""
        scope, run = known[source]
        by_extent = {read.by_extent for read in stage.reads if read.stage == source}
        if len(by_extent) > 1:
            raise ValueError(f"stage {stage.name} reads {source} both by box and by extent")
        everything = reads_everything(stage.scope, scope)
        (first, *_) = (read for read in stage.reads if read.stage == source)
        if first.own or first.named_by:
            listed = {
                name: (name,) if first.own else self.records[first.named_by, name].facts["names"]
                for name in here.names
            }
            return list_refs(here, source, run, listed)
        if first.around:
            here = extents(here, self._facts(first.around, here.names), first.around)
        if True in by_extent:
            reached = extents(run, self._facts(source, run.names), source)
            return find_refs(stage, here, source, reached, everything=everything)
        boxes = self.layout.boxes(scope)
        names = tuple(sorted(boxes))
        reach = run
        if len(names) != len(run.names):
            reach = Items(names, np.array([boxes[name] for name in names]).reshape(-1, 4))
        found = find_refs(stage, here, source, reach, everything=everything)
        return found if reach is run else _among(found, reach, run, stage)


class _Run:
    """One call of `Engine.run`: the heap of ready tasks, and what is in flight."""

    def __init__(self, engine: Engine, plan: list[_Planned]) -> None:
        self.engine, self.plan = engine, plan
        place = {planned.stage.name: planned for planned in plan}
        n_tasks = sum(len(planned.items.names) for planned in plan)
        links = [(p.first, refs, place[refs.stage].first) for p in plan for refs in p.refs if refs.stage in place]
        self.start, self.waiting = invert(links, n_tasks)
        self.rank = np.repeat(np.arange(len(plan)), [len(planned.items.names) for planned in plan])
        earlier = [(p.stage.name, name) in engine.records for p in plan for name in p.items.names]
        done = np.array(earlier, dtype=np.bool_)
        self.n_done = [int(done[self.rank == k].sum()) for k in range(len(plan))]
        unfinished = self.waiting[np.repeat(~done, np.diff(self.start))]
        self.n_missing: NDArray[np.int64] = np.bincount(unfinished, minlength=n_tasks)
        ready = np.flatnonzero((self.n_missing == 0) & ~done)
        self.ready = [(-int(self.rank[task]), task) for task in ready.tolist()]
        heapq.heapify(self.ready)
        self.in_flight: set[int] = set()

    def drive(self) -> None:
        executor = self.engine._executor
        try:
            while self.ready or self.in_flight:
                while self.ready and len(self.in_flight) < self.engine._window:
                    self._begin(heapq.heappop(self.ready)[1])
                if self.in_flight:
                    ticket, outcome = executor.wait()
                    self.in_flight.remove(ticket)
                    self._end(ticket, outcome)
        except Exception:
            self._settle()
            raise

    def _begin(self, ticket: int) -> None:
        """Take an earlier result with the same key, or submit the task; what it reads counts by its content."""
        engine, planned = self.engine, self.plan[self.rank[ticket]]
        stage, item = planned.stage, ticket - planned.first
        name = planned.items.names[item]
        refs = {r.stage: self._names(r, item) for r in planned.refs}
        path, identity = file_identity(engine.layout, stage.scope, name)
        xmin, ymin, xmax, ymax = planned.items.boxes[item].tolist()
        box = (xmin, ymin, xmax, ymax)
        found = (
            (source, [(n, engine.records[source, n].digest) for n in names]) for source, names in refs.items()
        )
        key = item_key(planned.digest, name, box, identity, found)
        record = reuse(engine.store, stage.name, name, key, folder=engine._folder)
        if record is not None:
            self._end(ticket, record)
            return
        task = Task(
            stage.name, name, stage.scope, box, planned.parameters, engine._context, path, engine.store, refs, key
        )
        engine._executor.submit(ticket, stage.function, task)
        self.in_flight.add(ticket)

    def _names(self, refs: Refs, item: int) -> tuple[str, ...]:
        names = self.engine._items[refs.stage][1].names
        return tuple(names[k] for k in refs.of(item).tolist())

    def _end(self, ticket: int, outcome: Record | Failure) -> None:
        """Keep the record and make ready what waited for nothing else."""
        rank = int(self.rank[ticket])
        planned = self.plan[rank]
        name = planned.items.names[ticket - planned.first]
        if isinstance(outcome, Failure):
            raise _named(outcome.error, planned.stage, name)
        self.engine.records[planned.stage.name, name] = outcome
        self.n_done[rank] += 1
        if self.engine._progress is not None:
            self.engine._progress(planned.stage.name, self.n_done[rank], len(planned.items.names), outcome)
        for task in self.waiting[self.start[ticket] : self.start[ticket + 1]].tolist():
            self.n_missing[task] -= 1
            if self.n_missing[task] == 0:
                heapq.heappush(self.ready, (-int(self.rank[task]), task))

    def _settle(self) -> None:
        """After an error: give up what has not begun, wait for the rest, and keep no record of either."""
        self.in_flight -= self.engine._executor.drop_waiting()
        while self.in_flight:
            ticket, _ = self.engine._executor.wait()
            self.in_flight.discard(ticket)


def _among(found: Refs, reach: Items, run: Items, stage: Stage) -> Refs:
    """Number refs among the items that are run; ValueError if one is not."""
    position = {name: k for k, name in enumerate(run.names)}
    renumbered = np.array([position.get(name, -1) for name in reach.names], dtype=np.int32)
    index = renumbered[found.index]
    if (index < 0).any():
        missing = sorted({reach.names[k] for k in found.index[index < 0].tolist()})
        raise ValueError(
            f"stage {stage.name} reads {len(missing)} items of {found.stage} that are not run, first "
            f"{missing[0]}; run {found.stage} on them too"
        )
    return Refs(found.stage, found.start, index)


def _named(error: Exception, stage: Stage, name: str) -> Exception:
    """Say stage and item in an error: in the message where it is ours, in a note otherwise."""
    place = f"stage {stage.name}, {stage.scope.value} {name}"
    if isinstance(error, CityError):
        return type(error)(f"{place}: {error}")
    error.add_note(place)
    return error
