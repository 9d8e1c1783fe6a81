"""The engine: runs stages over the items of a layout, each result once, and skips what is there already.

A task is submitted together with those of its item that wait for nothing else, so that one worker runs them one
after the other; each has its own result, key and record.

The driver decides what may run and keeps small records; functions, arrays and files are the workers'. Nothing here
knows Dask: see `tiler.engine.executor`.
"""

import heapq
from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.data.errors import CityError
from tiler.config.declared import Declared
from tiler.engine.executor import Executor
from tiler.engine.failures import Policy, SetAside, describe_reason, ends_the_run, tries
from tiler.engine.keys import OpenKey, declared_values, file_identity, stage_digest
from tiler.engine.records import Records
from tiler.engine.stage import Box, Layout, Scope, Stage
from tiler.engine.submission import Item, Outcome, Part
from tiler.engine.task import Failure, Later, Record, Task
from tiler.engine.task_graph import (
    Gaps,
    Items,
    Refs,
    chain_seams,
    extents,
    find_refs,
    invert,
    joined_reads,
    list_all,
    list_items,
    list_refs,
    order_stages,
    own_refs,
    readers,
    reads_everything,
)
from tiler.engine.watcher import Watcher
from tiler.store.store import Store
from tiler.words.stage_groups import place_of_item

SMALL_ONES = 8  # small tasks of a stage that are submitted together, at most


@dataclass(frozen=True, eq=False)
class _Planned:
    """A stage of this call: its items are the tasks ``first`` to ``first + len(items.names)``.

    ``named_by`` has the stages that it reads and the stage of this call that names what of them.
    """

    stage: Stage
    items: Items
    refs: tuple[Refs, ...]
    first: int
    digest: bytes
    parameters: Declared
    named_by: dict[str, str]

    @cached_property
    def by_name(self) -> set[str]:
        """Stages of which it counts by its content only the item of the reader's own name."""
        return {read.stage for read in self.stage.reads if read.others_by_name}


class StoppedError(CityError):
    """The run was asked to stop: what ran was let end, and is kept."""

    exit_code = 130


class Engine:
    """Runs stages and keeps their records.

    Parameters
    ----------
    store_path : Path
        Folder of the store; one engine at a time may write to it. Files that results state as the fact
        ``"files"`` are beside it.
    layout : Layout
        The items of every scope.
    parameters : object
        Anything with the declared parameters as attributes.
    context : object, optional
        Given to every task as it is; small and picklable.
    executor : Executor
        Where tasks run, see `tiler.engine.executor`.
    watcher : Watcher, optional
        Is told what is planned, submitted, done and failed.
    policy : Policy
        What becomes of items that fail; the first ends the run by default.

    Attributes
    ----------
    layout, context : Layout, object
        Of what is run next.
    records : Records
        What came of each stage and item so far.
    set_aside : dict of (str, str) to SetAside
        Items that failed.
    blocked : dict of (str, str) to (str, str)
        Items that were not run, by the item that they need and that is not there.
    """

    def __init__(
        self,
        store_path: Path,
        layout: Layout,
        *,
        parameters: Any,
        context: Any = None,
        executor: Executor,
        watcher: Watcher | None = None,
        policy: Policy | None = None,
    ) -> None:
        self.store = Store(store_path)
        self.layout = layout
        self.records = Records(self.store)
        self.set_aside: dict[Item, SetAside] = {}
        self.blocked: dict[Item, Item] = {}
        self._policy = policy or Policy()
        self._stop = False
        self._gaps = Gaps(layout.absent)
        self._parameters, self.context = parameters, context
        self._executor, self._watcher = executor, watcher or Watcher()
        self._items: dict[str, tuple[Scope, Items]] = {}
        self._laid_out: dict[str, tuple[Layout, Any]] = {}
        self._whole: dict[tuple[int, Scope], tuple[Layout, Items]] = {}

    def run(self, *stages: Stage, items: Mapping[str, Collection[str]] | None = None) -> None:
        """Run stages whose reads are among them or were run before.

        A task is submitted when all that it reads is done; of those that may run, those of later stages go first,
        then those of larger tiles and what these read, then in the order of names. With it go those of its item
        that wait for nothing but it and each other; of seams those of the same owner. Of what counts by its name
        alone it is taken for granted that it will be there; what was misled by that is run again in the end.

        Parameters
        ----------
        *stages : Stage
            In any order.
        items : mapping, optional
            Restricts stages, by name, to some of their items.

        Raises
        ------
        CityError
            The first that an item raises and that the policy does not set aside, its stage and name in the
            message. Nothing is submitted after it, and what runs is waited for; all that was committed is kept and
            skipped next time.
        StoppedError
            If `stop` was called; likewise.
        Exception
            Any other error of a stage's function likewise, its type kept; stage, name and traceback are its notes.
        ValueError
            For unknown stages, cycles, reads of items that are not run, and parameters that are not there.
        """
        unknown = sorted(set(items or ()) - {stage.name for stage in stages})
        if unknown:
            raise ValueError(f"items are given for stages that are not: {', '.join(unknown)}")
        order = order_stages(stages, self._items.keys())
        self._laid_out |= {stage.name: (self.layout, self.context) for stage in order}
        plan = self._plan(order, items or {})
        for planned in plan:
            self._items[planned.stage.name] = (planned.stage.scope, planned.items)
            self.store.sweep(planned.stage.name)
            for name in (items or {}).get(planned.stage.name, planned.items.names):
                self._forget((planned.stage.name, name))
        started = _Run(self, plan)
        try:
            started.drive()
        finally:
            for planned in plan:
                self._items[planned.stage.name] = (planned.stage.scope, self._recorded(planned))
        if misled := started.find_misled():
            self.run(*(planned.stage for planned in plan if planned.stage.name in misled), items=misled)

    def add_parameters(self, **values: Any) -> None:
        """Give values to parameters that only what was run so far decides; those of the same name are replaced."""
        self._parameters = SimpleNamespace(**(vars(self._parameters) | values))

    def lay_out(self, layout: Layout, context: Any) -> None:
        """Go on over another layout: what is run from now on has its items, what was run keeps its own.

        Parameters
        ----------
        layout : Layout
            Items of every scope; a stage reads those of another layout by their boxes there, as ever.
        context : object
            Given to every task from now on.
        """
        self.layout, self.context = layout, context
        self._gaps = Gaps(layout.absent)

    def describe_layout(self) -> None:
        """Hand the watcher the items of the layout, where they differ from those at the start of the run."""
        self._watcher.laid_out(self.layout)

    def laid_out(self, stage: str) -> tuple[Layout, Any]:
        """Layout and context that a stage was run with, for `lay_out`."""
        return self._laid_out[stage]

    def stop(self) -> None:
        """Let what runs end, start nothing more, and end `run` with `StoppedError`."""
        self._stop = True

    def failed(self) -> list[SetAside]:
        """List what was set aside, in the order of stages and names."""
        rank = {stage: k for k, stage in enumerate(self._items)}
        return sorted(self.set_aside.values(), key=lambda one: (rank[one.stage], one.name))

    def give_up(self, failed: Item, lost: Item) -> None:
        """Take an item that was set aside as the failure of one that it read: nothing reads that any more.

        Parameters
        ----------
        failed : (str, str)
            Stage and name of an item in `set_aside`.
        lost : (str, str)
            Stage and name of an item that has a record.
        """
        self.records.forget(*lost)
        self.set_aside[lost] = self.set_aside.pop(failed)

    def prune(self) -> None:
        """Remove from the store what this engine has no record of: results of stages and items of another run."""
        kept = set(self.records.stages())
        for stage in self.store.stages():
            if stage not in kept:
                self.store.remove(stage)
            for name in self.store.names(stage):
                if (stage, name) not in self.records:
                    self.store.remove(stage, name)

    def _forget(self, item: Item) -> None:
        self.records.forget(*item)
        self.set_aside.pop(item, None)
        self.blocked.pop(item, None)

    def _settled(self, item: Item) -> bool:
        return item in self.records or item in self.set_aside or item in self.blocked

    def _recorded(self, planned: "_Planned") -> Items:
        """Keep of the items those of which something came, which are all unless the run ended early."""
        names = planned.items.names
        rows = [k for k, name in enumerate(names) if self._settled((planned.stage.name, name))]
        if len(rows) == len(names):
            return planned.items
        return Items(tuple(names[k] for k in rows), planned.items.boxes[rows])

    def _plan(self, order: list[Stage], only: Mapping[str, Collection[str]]) -> list[_Planned]:
        known = dict(self._items)
        plan: list[_Planned] = []
        first = 0
        for stage in order:
            wanted = self._wanted(stage, only.get(stage.name))
            here = (
                self._all(self.layout, stage.scope) if wanted is None else list_items(stage, self.layout, wanted)
            )
            here_too = {other.name for other in order}
            named_by = {read.stage: read.named_by for read in stage.reads if read.named_by in here_too}
            refs = tuple(
                list_refs(here, source, here, dict.fromkeys(here.names, ()))
                if source in named_by
                else self._refs(stage, here, source, known)
                for source, _ in joined_reads(stage)
            )
            values = declared_values(stage, self._parameters)
            digest = stage_digest(stage, values, self.layout)
            plan.append(_Planned(stage, here, refs, first, digest, Declared(stage.name, values), named_by))
            known[stage.name] = (stage.scope, here)
            first += len(here.names)
        return plan

    def _all(self, layout: Layout, scope: Scope) -> Items:
        """All items of a scope in a layout: the same object for all stages, as a country has many."""
        place = id(layout), scope
        if place not in self._whole:
            self._whole[place] = layout, list_all(layout.boxes(scope))
        return self._whole[place][1]

    def _wanted(self, stage: Stage, only: Collection[str] | None) -> Collection[str] | None:
        """Add what ran in earlier calls: it stays an item, and its records stay."""
        if only is None:
            return None
        return set(only).union(self._items[stage.name][1].names if stage.name in self._items else ())

    def _extents(self, items: Items, stage: str) -> Items:
        """Take extents for boxes; what has no result keeps its box."""
        boxes = items.boxes.copy()
        known = [k for k, name in enumerate(items.names) if (stage, name) in self.records]
        some = Items(tuple(items.names[k] for k in known), items.boxes[known])
        facts = {name: self.records.kept_facts(stage, name) for name in some.names}
        boxes[known] = extents(some, facts, stage).boxes
        return Items(items.names, boxes)

    def _listed(self, stage: str, item: str) -> Iterable[str]:
        there = (stage, item) in self.records
        names: Iterable[str] = self.records.kept_facts(stage, item)["names"] if there else ()
        return names

    def _find_gaps(self, scope: Scope, box: Box, refs: Mapping[str, Iterable[str]]) -> list[Box]:
        """List the absent tiles near an item: near its box, and the extents of what it reads."""
        layout = self.layout
        if not layout.absent or scope not in (Scope.TILE, Scope.SEAM):
            return []
        facts = [self.records.kept_facts(stage, name) for stage, names in refs.items() for name in names]
        boxes = np.array([box, *(found["extent"] for found in facts if found.get("extent"))])
        return self._gaps.near(boxes[:, :2].min(axis=0) - layout.near, boxes[:, 2:].max(axis=0) + layout.near)

    def _refs(self, stage: Stage, here: Items, source: str, known: Mapping[str, tuple[Scope, Items]]) -> Refs:
        """Find refs among all items of the layout first: one that is read but not run is an error, not a gap."""
        scope, run = known[source]
        by_extent = {read.by_extent for read in stage.reads if read.stage == source}
        if len(by_extent) > 1:
            raise ValueError(f"stage {stage.name} reads {source} both by box and by extent")
        everything = reads_everything(stage.scope, scope)
        (first, *_) = (read for read in stage.reads if read.stage == source)
        if first.own:
            if first.optional:
                return own_refs(here, source, run)
            return list_refs(here, source, run, {name: (name,) for name in here.names})
        if first.named_by:
            listed = {name: tuple(self._listed(first.named_by, name)) for name in here.names}
            return list_refs(here, source, run, listed)
        if first.around:
            here = self._extents(here, first.around)
        if True in by_extent:
            return find_refs(stage, here, source, self._extents(run, source), everything=everything)
        whole = self._all(self._laid_out[source][0], scope)
        reach = run if len(whole.names) == len(run.names) else whole
        found = find_refs(stage, here, source, reach, everything=everything)
        return found if reach is run else _among(found, reach, run, stage)


class _Run:
    """One call of `Engine.run`: the heap of ready tasks, and what is in flight.

    A task is begun from its submission to its end; one that was not run, or failed and is tried again, is not.
    """

    def __init__(self, engine: Engine, plan: list[_Planned]) -> None:
        self.engine, self.plan = engine, plan
        place = {planned.stage.name: planned for planned in plan}
        n_tasks = sum(len(planned.items.names) for planned in plan)
        links = [
            (p.first, _contents(p, refs, place[refs.stage].items), place[refs.stage].first)
            for p in plan
            for refs in p.refs
            if refs.stage in place
        ]
        for p in plan:
            if p.stage.after in place:
                other = place[p.stage.after]
                links.append((p.first, own_refs(p.items, other.stage.name, other.items), other.first))
            if p.stage.scope is Scope.SEAM:
                chain = chain_seams(p.items, p.stage.name, engine.layout.owners)
                links.append((p.first, chain, p.first))
        self.start, self.waiting = invert(links, n_tasks)
        self.rank = np.repeat(np.arange(len(plan)), [len(planned.items.names) for planned in plan])
        earlier = [engine._settled((p.stage.name, name)) for p in plan for name in p.items.names]
        done = np.array(earlier, dtype=np.bool_)
        self.n_done = [int(done[self.rank == k].sum()) for k in range(len(plan))]
        unfinished = self.waiting[np.repeat(~done, np.diff(self.start))]
        self.n_missing: NDArray[np.int64] = np.bincount(unfinished, minlength=n_tasks)
        ready = np.flatnonzero((self.n_missing == 0) & ~done)
        self.order = self._order()
        self.ready = [(int(self.order[task]), task) for task in ready.tolist()]
        heapq.heapify(self.ready)
        self.in_flight: dict[int, list[int]] = {}  # tasks of a submission, by its first
        self.begun = done
        self.open: set[int] = set()  # of these, whose key a worker finds
        self.tried: Counter[int] = Counter()
        self.lost: defaultdict[str, set[str]] = defaultdict(set)  # names of what failed or was not run, by stage
        for planned in plan:
            if planned.items.names:
                engine._watcher.planned(planned.stage.name, planned.stage.scope, len(planned.items.names))

    def _order(self) -> NDArray[np.int32]:
        """Where each task stands among those that may run: later stages first, then larger tiles, then names.

        What takes longest begins first, so that no worker is left with it alone at the end of a stage; so does
        what it waits for: files and seams count by the largest of the tiles that read them.
        """
        area = np.zeros(len(self.rank))
        for planned in self.plan:
            if planned.stage.scope is Scope.TILE:
                xmin, ymin, xmax, ymax = planned.items.boxes.T
                area[planned.first : planned.first + len(xmin)] = np.rint((xmax - xmin) * (ymax - ymin))
        read = np.flatnonzero(np.diff(self.start))
        of_readers = np.zeros_like(area)
        of_readers[read] = np.maximum.reduceat(area[self.waiting], self.start[read])
        area = np.where(area > 0, area, of_readers)
        order = np.empty(len(area), np.int32)
        order[np.lexsort((-area, -self.rank))] = np.arange(len(area), dtype=np.int32)
        return order

    def drive(self) -> None:
        executor = self.engine._executor
        try:
            while self.ready or self.in_flight:
                if self.engine._stop:
                    raise StoppedError("stopped as asked, all that was done is kept; the same command goes on")
                while self.ready and len(self.in_flight) < executor.window:
                    self._begin(self._next())
                if self.in_flight:
                    ticket, outcomes = executor.wait()
                    self._end(self.in_flight.pop(ticket), outcomes)
        except Exception:
            self._settle()
            raise

    def _next(self) -> list[int]:
        """Take the next task that may run, and of small ones several, while enough are left for all workers."""
        rank, ready = self.rank, self.ready
        tickets = [heapq.heappop(ready)[1]]
        if self.plan[rank[tickets[0]]].stage.small:
            n = min(SMALL_ONES, len(ready) // (2 * self.engine._executor.workers))
            while ready and len(tickets) < n and rank[ready[0][1]] == rank[tickets[0]]:
                tickets.append(heapq.heappop(ready)[1])
        return tickets

    def _begin(self, ready: list[int]) -> None:
        """Submit tasks and those that go with them, unless they lack something that they read."""
        engine = self.engine
        parts: dict[Item, Part] = {}
        tickets: list[int] = []
        left: dict[int, int] = {}  # how many others each task waits for
        for ticket in ready:
            refs, lacking = self._find_reads(ticket, {})
            if lacking:
                self.begun[ticket] = True
                engine.blocked[self._item(ticket)] = lacking[0]
                self._lose(ticket, f"not run: {' '.join(lacking[0])} is not there", lacking[0])
            else:
                parts[self._item(ticket)] = self._make_part(ticket, refs, {})
                tickets.append(ticket)
        for one in tickets:  # which grows
            for other in self.waiting[self.start[one] : self.start[one + 1]].tolist():
                if self.begun[other] or not self._are_together(one, other):
                    continue
                left[other] = left.get(other, int(self.n_missing[other])) - 1
                if left[other] == 0:
                    refs, lacking = self._find_reads(other, parts)
                    if not lacking:
                        part = parts[self._item(other)] = self._make_part(other, refs, parts)
                        tickets.append(other)
                        if part.key is not None:
                            self.open.add(other)
        if not tickets:
            return
        engine._executor.submit(tickets[0], list(parts.values()), int(self.order[tickets[0]]))
        self.in_flight[tickets[0]] = tickets
        self.begun[tickets] = True
        for item in parts:
            engine._watcher.submitted(*item)

    def _item(self, ticket: int) -> Item:
        planned = self.plan[self.rank[ticket]]
        return planned.stage.name, planned.items.names[ticket - planned.first]

    def _are_together(self, one: int, other: int) -> bool:
        """Return whether two tasks are of the same item, or of seams of the same owner."""
        scope, owners = self.plan[self.rank[one]].stage.scope, self.engine.layout.owners
        if self.plan[self.rank[other]].stage.scope is not scope:
            return False
        (_, a), (_, b) = self._item(one), self._item(other)
        return a == b or (scope is Scope.SEAM and owners.get(a, a) == owners.get(b, b))

    def _make_part(self, ticket: int, refs: dict[str, tuple[str, ...]], before: Collection[Item]) -> Part:
        """Make a task; what it reads counts by its content. The worker looks for an earlier result.

        Parameters
        ----------
        ticket : int
            Number of the task.
        refs : dict of str to tuple of str
            What it reads, from `_find_reads`.
        before : collection of (str, str)
            Items before it in its submission, whose content is not known yet.
        """
        engine, planned = self.engine, self.plan[self.rank[ticket]]
        scope, (stage, name) = planned.stage.scope, self._item(ticket)
        path, identity, frame = file_identity(engine.layout, scope, name)
        xmin, ymin, xmax, ymax = planned.items.boxes[ticket - planned.first].tolist()
        box = (xmin, ymin, xmax, ymax)

        def digest(source: str, n: str) -> str | None:
            if source in planned.by_name and n != name:
                return ""
            return None if (source, n) in before else engine.records.digest(source, n)

        digests = {source: {n: digest(source, n) for n in names} for source, names in refs.items()}
        held = {source: [n for n, found in names.items() if found] for source, names in digests.items()}
        gaps = engine._find_gaps(scope, box, held)
        named_by = {source: by for source, by in planned.named_by.items() if (by, name) in before}
        made = OpenKey(planned.digest, name, box, identity, digests, gaps, named_by)
        key = None if made.awaited() else made.close({}, engine.store)[0]
        task = Task(
            *(stage, name, scope, box, planned.parameters, engine.context, path, engine.store, refs, key or ""),
            *(engine.store.path.parent, frame),
        )
        return Part(planned.stage.function, task, made if key is None else None)

    def _find_reads(self, ticket: int, before: Collection[Item]) -> tuple[dict[str, tuple[str, ...]], list[Item]]:
        """Find what a task reads and is there, by stage, and what it cannot do without and is not there.

        What comes before it in its submission is taken to be there.
        """
        engine, planned = self.engine, self.plan[self.rank[ticket]]
        stage, (_, name) = planned.stage, self._item(ticket)
        needed = {read.stage for read in stage.reads if not read.optional}
        wanted = [(by, name) for read in stage.reads for by in (read.around, read.named_by) if by]
        refs = {}
        for r in planned.refs:
            if r.stage in planned.named_by:
                names = tuple(sorted(set(engine._listed(planned.named_by[r.stage], name))))
            else:
                names = self._names(r, ticket - planned.first)
            ahead = {n for n in names if r.stage in planned.by_name and not engine._settled((r.stage, n))}
            refs[r.stage] = tuple(
                n for n in names if n in ahead or (r.stage, n) in engine.records or (r.stage, n) in before
            )
            same = engine._items[r.stage][0] is stage.scope
            wanted += [
                (r.stage, n) for n in names if n not in ahead and (r.stage in needed or (same and n == name))
            ]
        return refs, [one for one in wanted if one not in engine.records and one not in before]

    def find_misled(self) -> dict[str, set[str]]:
        """Find the items that were run as if something were there that failed later, by stage.

        Those that read by its name an item that failed, and those that read them.
        """
        misled: dict[str, set[str]] = {}
        for planned in self.plan if self.lost else ():
            hit = np.zeros(len(planned.items.names), np.bool_)
            for refs in planned.refs:
                bad = misled.get(refs.stage, set()) | (
                    self.lost[refs.stage] if refs.stage in planned.by_name else set()
                )
                if bad:
                    names = self.engine._items[refs.stage][1].names
                    is_bad = np.array([name in bad for name in names], np.bool_)
                    hit[readers(refs)[is_bad[refs.index]]] = True
            if hit.any():
                misled[planned.stage.name] = {planned.items.names[k] for k in np.flatnonzero(hit).tolist()}
        return misled

    def _names(self, refs: Refs, item: int) -> tuple[str, ...]:
        names = self.engine._items[refs.stage][1].names
        return tuple(names[k] for k in refs.of(item).tolist())

    def _end(self, tickets: list[int], outcomes: list[Outcome | None]) -> None:
        """Record the outcomes of a submission; tasks of it that did not run are submitted again when they may."""
        for ticket, outcome in zip(tickets, outcomes, strict=True):
            open_key = ticket in self.open
            self.open.discard(ticket)
            match outcome:
                case Record():
                    if open_key and not self._is_key(ticket, outcome):
                        self._put_back(ticket)
                    else:
                        self._keep(ticket, outcome)
                case Failure():
                    self._fail(ticket, outcome)
                case Later():
                    self._leave(ticket)
                case None:
                    self._put_back(ticket)

    def _is_key(self, ticket: int, record: Record) -> bool:
        """Whether a record has the key that follows now that all before it in its submission is known.

        It has not where that reaches farther than its item, and an absent tile is near there.
        """
        refs, lacking = self._find_reads(ticket, {})
        return not lacking and self._make_part(ticket, refs, {}).task.key == record.key

    def _keep(self, ticket: int, record: Record) -> None:
        """Keep the record of a task."""
        rank = int(self.rank[ticket])
        planned = self.plan[rank]
        self.engine.records.add(record)
        self.n_done[rank] += 1
        self.engine._watcher.done(planned.stage.name, self.n_done[rank], len(planned.items.names), record)
        self._settle_one(ticket)

    def _put_back(self, ticket: int) -> None:
        """Let a task begin once more."""
        self.begun[ticket] = False
        if self.n_missing[ticket] == 0:
            heapq.heappush(self.ready, (int(self.order[ticket]), ticket))

    def _leave(self, ticket: int) -> None:
        """Leave an item to a later call; ValueError if something waits for it."""
        stage, name = self._item(ticket)
        if self.start[ticket] < self.start[ticket + 1]:
            raise ValueError(f"stage {stage}, {name}: is left to a later call, and a stage of this one reads it")

    def _fail(self, ticket: int, failure: Failure) -> None:
        """Try again, set aside, or end the run."""
        engine, stage, (_, name) = self.engine, self.plan[self.rank[ticket]].stage, self._item(ticket)
        self.tried[ticket] += 1
        if self.tried[ticket] < tries(failure, engine._policy):
            self._put_back(ticket)
            return
        reason = describe_reason(failure.error)
        if ends_the_run(failure, stage.scope, engine._policy):
            engine._watcher.failed(stage.name, name, reason, ends_run=True)
            raise _named(failure.error, stage, name)
        refs, _ = self._find_reads(ticket, {})
        path, _, _ = file_identity(engine.layout, stage.scope, name)
        engine.set_aside[stage.name, name] = SetAside(
            stage.name, name, stage.scope, failure.kind, reason, failure.trace, self.tried[ticket], refs, path
        )
        self._lose(ticket, reason)

    def _lose(self, ticket: int, reason: str, needs: Item | None = None) -> None:
        """Go on without an item."""
        stage, name = self._item(ticket)
        self.lost[stage].add(name)
        self.engine._watcher.failed(stage, name, reason, needs)
        self._settle_one(ticket)

    def _settle_one(self, ticket: int) -> None:
        """Make ready what waited for this item and for nothing else."""
        for task in self.waiting[self.start[ticket] : self.start[ticket + 1]].tolist():
            self.n_missing[task] -= 1
            if self.n_missing[task] == 0 and not self.begun[task]:
                heapq.heappush(self.ready, (int(self.order[task]), task))

    def _settle(self) -> None:
        """After an error: give up what has not begun, wait for the rest, and keep no record of either."""
        for ticket in self.engine._executor.drop_waiting():
            self.in_flight.pop(ticket, None)
        while self.in_flight:
            ticket, _ = self.engine._executor.wait()
            self.in_flight.pop(ticket, None)


def _contents(planned: _Planned, refs: Refs, source: Items) -> Refs:
    """Leave out the refs that count by name alone: a reader does not wait for these."""
    if refs.stage not in planned.by_name:
        return refs
    place = {name: k for k, name in enumerate(source.names)}
    same = np.array([place.get(name, -1) for name in planned.items.names], np.int64)
    reader = readers(refs)
    own = same[reader] == refs.index
    return Refs(refs.stage, np.searchsorted(reader[own], np.arange(len(refs.start))), refs.index[own])


def _among(found: Refs, reach: Items, run: Items, stage: Stage) -> Refs:
    """Number refs among the items that are run; ValueError if one is not and the reader cannot do without."""
    position = {name: k for k, name in enumerate(run.names)}
    renumbered = np.array([position.get(name, -1) for name in reach.names], dtype=np.int32)
    index = renumbered[found.index]
    if all(read.optional for read in stage.reads if read.stage == found.stage):
        reader = readers(found)[index >= 0]
        return Refs(found.stage, np.searchsorted(reader, np.arange(len(found.start))), index[index >= 0])
    if (index < 0).any():
        missing = sorted({reach.names[k] for k in found.index[index < 0].tolist()})
        raise ValueError(
            f"stage {stage.name} reads {len(missing)} items of {found.stage} that are not run, first "
            f"{missing[0]}; run {found.stage} on them too"
        )
    return Refs(found.stage, found.start, index)


def _named(error: Exception, stage: Stage, name: str) -> Exception:
    """Name stage and item in an error: in the message where it is ours, in a note otherwise."""
    place = place_of_item(stage.name, stage.scope.value, name)
    if isinstance(error, CityError):
        return type(error)(f"{place}: {error}")
    error.add_note(place)
    return error
