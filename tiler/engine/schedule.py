"""The tasks of one call of the engine: which may run, in which order, together with which others."""

import heapq
from collections import Counter, defaultdict
from collections.abc import Collection
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pipeline.data.errors import CityError
from tiler.config.declared import Declared
from tiler.engine.failures import SetAside, describe_reason, ends_the_run, tries
from tiler.engine.keys import OpenKey, file_identity
from tiler.engine.stage import Scope, Stage, boxes_touch
from tiler.engine.submission import Item, Outcome, Part
from tiler.engine.task import Failure, Later, Record, Task
from tiler.engine.task_graph import Items, Refs, chain_seams, invert, own_refs, readers
from tiler.objects.places import in_bucket
from tiler.store.checksums import FILES, find_changed_files
from tiler.store.remembered import file_state
from tiler.words.stage_groups import place_of_item

if TYPE_CHECKING:
    from tiler.engine.engine import Engine

MOST_KNOWN = 2**16  # results that a process knows from one run to the next
SMALL_ONES = 8  # small tasks of a stage that are submitted together, at most


@dataclass(frozen=True, eq=False)
class Planned:
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


class Schedule:
    """One call of `Engine.run`: the heap of ready tasks, and what is in flight.

    A task is begun from its submission to its end; one that was not run, or failed and is tried again, is not.
    """

    def __init__(self, engine: "Engine", plan: list[Planned]) -> None:
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
        earlier = [engine.settled((p.stage.name, name)) for p in plan for name in p.items.names]
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
                engine.watcher.planned(planned.stage.name, planned.stage.scope, len(planned.items.names))

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
        executor = self.engine.executor
        try:
            while self.ready or self.in_flight:
                if self.engine.stopped:
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
            n = min(SMALL_ONES, len(ready) // (2 * self.engine.executor.workers))
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
            known = None if lacking else self._find_known(ticket, refs)
            if known is not None:
                self.begun[ticket] = True
                self._keep(ticket, known)
            elif lacking:
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
        engine.executor.submit(tickets[0], list(parts.values()), int(self.order[tickets[0]]))
        self.in_flight[tickets[0]] = tickets
        self.begun[tickets] = True
        for item in parts:
            engine.watcher.submitted(*item)

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
        """Make a task; what it reads, from `_find_reads`, counts by its content.

        That of items `before` it in its submission is not known yet. The worker looks for an earlier result.
        """
        engine, planned = self.engine, self.plan[self.rank[ticket]]
        scope, (stage, name) = planned.stage.scope, self._item(ticket)
        path, _, frame, share = file_identity(engine.layout, scope, name)
        made = self._make_key(ticket, refs, before)
        key = None if made.awaited() else made.close({}, engine.store)[0]
        task = Task(
            *(stage, name, scope, made.box, planned.parameters, engine.context, path, engine.store),
            *(refs, key or "", engine.store.path.parent, frame, share),
            former="" if key is None else self._former_key(planned.stage, made),
        )
        return Part(planned.stage.function, task, made if key is None else None)

    def _make_key(self, ticket: int, refs: dict[str, tuple[str, ...]], before: Collection[Item]) -> OpenKey:
        """Collect what the key of a task is made of; parameters as of `_make_part`."""
        engine, planned = self.engine, self.plan[self.rank[ticket]]
        scope, (_, name) = planned.stage.scope, self._item(ticket)
        _, identity, _, _ = file_identity(engine.layout, scope, name)
        xmin, ymin, xmax, ymax = planned.items.boxes[ticket - planned.first].tolist()
        box = (xmin, ymin, xmax, ymax)

        def digest(source: str, n: str) -> str | None:
            if source in planned.by_name and n != name:
                return ""
            return None if (source, n) in before else engine.records.digest(source, n)

        silent = {read.stage for read in planned.stage.reads if read.silent}
        heard = ((source, names) for source, names in refs.items() if names or source not in silent)
        digests = {source: {n: digest(source, n) for n in names} for source, names in heard}
        held = {source: [n for n, found in names.items() if found] for source, names in digests.items()}
        gaps = engine.find_gaps(scope, box, held)
        named_by = {source: by for source, by in planned.named_by.items() if (by, name) in before}
        return OpenKey(planned.digest, name, box, identity, digests, gaps, named_by)

    def _find_known(self, ticket: int, refs: dict[str, tuple[str, ...]]) -> Record | None:
        """Find the record of a result that this process knows from an earlier run; None if a byte may differ."""
        engine, (stage, name) = self.engine, self._item(ticket)
        known = engine.known and engine.known.get((stage, name))
        if not known:
            return None
        record, made, state = known
        same = self._make_key(ticket, refs, {}) == made and file_state(engine.store.file(stage, name)) == state
        if not same or find_changed_files(engine.store.path.parent, record.facts.get(FILES, {})):
            return None
        found: Record = record
        return found

    def _remember(self, ticket: int, record: Record) -> None:
        """Keep a record for the next run of this process."""
        engine, item = self.engine, self._item(ticket)
        if engine.known is None or in_bucket(engine.store.path):
            return
        state = file_state(engine.store.file(*item))
        if state and (item in engine.known or len(engine.known) < MOST_KNOWN):
            made = self._make_key(ticket, self._find_reads(ticket, {})[0], {})
            reused = replace(record, seconds={}, peak_memory=0, reused=True, damage="", ago=0.0)
            engine.known[item] = (reused, made, state)

    def _former_key(self, stage: Stage, key: OpenKey) -> str:
        """Key of the same result before changes that do not reach it; nothing where there is none."""
        former = {source: dict(found) for source, found in key.refs.items()}
        for read in stage.reads if self.engine.changes else ():
            xmin, ymin, xmax, ymax = key.box
            reach = (xmin - read.halo, ymin - read.halo, xmax + read.halo, ymax + read.halo)
            for name in former[read.stage] if read.within else ():
                digest, boxes = self.engine.changes.get((read.stage, name), ("", []))
                if digest and not any(boxes_touch(reach, box) for box in boxes):
                    former[read.stage][name] = digest
        return "" if former == key.refs else replace(key, refs=former).close({}, self.engine.store)[0]

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
                names = tuple(sorted(set(engine.listed(planned.named_by[r.stage], name))))
            else:
                names = self._names(r, ticket - planned.first)
            ahead = {n for n in names if r.stage in planned.by_name and not engine.settled((r.stage, n))}
            refs[r.stage] = tuple(
                n for n in names if n in ahead or (r.stage, n) in engine.records or (r.stage, n) in before
            )
            same = engine.items[r.stage][0] is stage.scope
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
                    names = self.engine.items[refs.stage][1].names
                    is_bad = np.array([name in bad for name in names], np.bool_)
                    hit[readers(refs)[is_bad[refs.index]]] = True
            if hit.any():
                misled[planned.stage.name] = {planned.items.names[k] for k in np.flatnonzero(hit).tolist()}
        return misled

    def _names(self, refs: Refs, item: int) -> tuple[str, ...]:
        names = self.engine.items[refs.stage][1].names
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
                        self._remember(ticket, outcome)
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
        self.engine.watcher.done(planned.stage.name, self.n_done[rank], len(planned.items.names), record)
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
        if self.tried[ticket] < tries(failure, engine.policy):
            self._put_back(ticket)
            return
        reason = describe_reason(failure.error)
        if ends_the_run(failure, stage.scope, engine.policy):
            engine.watcher.failed(stage.name, name, reason, ends_run=True)
            raise _named(failure.error, stage, name)
        refs, _ = self._find_reads(ticket, {})
        path, *_ = file_identity(engine.layout, stage.scope, name)
        engine.set_aside[stage.name, name] = SetAside(
            stage.name, name, stage.scope, failure.kind, reason, failure.trace, self.tried[ticket], refs, path
        )
        self._lose(ticket, reason)

    def _lose(self, ticket: int, reason: str, needs: Item | None = None) -> None:
        """Go on without an item."""
        stage, name = self._item(ticket)
        self.lost[stage].add(name)
        self.engine.watcher.failed(stage, name, reason, needs)
        self._settle_one(ticket)

    def _settle_one(self, ticket: int) -> None:
        """Make ready what waited for this item and for nothing else."""
        for task in self.waiting[self.start[ticket] : self.start[ticket + 1]].tolist():
            self.n_missing[task] -= 1
            if self.n_missing[task] == 0 and not self.begun[task]:
                heapq.heappush(self.ready, (int(self.order[task]), task))

    def _settle(self) -> None:
        """After an error: give up what has not begun, wait for the rest, and keep no record of either."""
        for ticket in self.engine.executor.drop_waiting():
            self.in_flight.pop(ticket, None)
        while self.in_flight:
            ticket, _ = self.engine.executor.wait()
            self.in_flight.pop(ticket, None)


def _contents(planned: Planned, refs: Refs, source: Items) -> Refs:
    """Leave out the refs that count by name alone: a reader does not wait for these."""
    if refs.stage not in planned.by_name:
        return refs
    place = {name: k for k, name in enumerate(source.names)}
    same = np.array([place.get(name, -1) for name in planned.items.names], np.int64)
    reader = readers(refs)
    own = same[reader] == refs.index
    return Refs(refs.stage, np.searchsorted(reader[own], np.arange(len(refs.start))), refs.index[own])


def _named(error: Exception, stage: Stage, name: str) -> Exception:
    """Name stage and item in an error: in the message where it is ours, in a note otherwise."""
    place = place_of_item(stage.name, stage.scope.value, name)
    if isinstance(error, CityError):
        return type(error)(f"{place}: {error}")
    error.add_note(place)
    return error
