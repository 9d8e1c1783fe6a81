"""The engine: runs stages over the items of a layout, each result once, and skips what is there already.

A task is submitted together with those of its item that wait for nothing else, so that one worker runs them one
after the other; each has its own result, key and record.

The driver decides what may run and keeps small records; functions, arrays and files are the workers'. Nothing here
knows Dask: see `tiler.engine.executor`.
"""

from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from tiler.config.declared import Declared
from tiler.engine.executor import Executor
from tiler.engine.failures import Policy, SetAside
from tiler.engine.keys import declared_values, stage_digest
from tiler.engine.records import Records
from tiler.engine.schedule import Planned, Schedule
from tiler.engine.stage import Box, Layout, Scope, Stage
from tiler.engine.submission import Item
from tiler.engine.task_graph import (
    Gaps,
    Items,
    Refs,
    extents,
    find_refs,
    list_all,
    list_items,
    list_refs,
    order_stages,
    own_refs,
    readers,
)
from tiler.engine.watcher import Watcher
from tiler.store.remembered import remembered_results
from tiler.store.store import Store


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
        Called for what is planned, submitted, done and failed.
    policy : Policy
        What becomes of items that fail; the first ends the run by default.

    Attributes
    ----------
    layout, context : Layout, object
        Of what is run next.
    parameters : object
        As given, and what `add_parameters` added.
    records : Records
        What came of each stage and item so far.
    set_aside : dict of (str, str) to SetAside
        Items that failed.
    blocked : dict of (str, str) to (str, str)
        Items that were not run, by the item that they need and that is not there.
    items : dict of str to (Scope, Items)
        What stages were run over, by their names.
    stopped : bool
        Whether `stop` was called.
    changes : dict of (str, str) to (str, list of box)
        Results that differ from the store that this one was copied from: their digest there, and boxes of what
        differs.
    known : dict or None
        Records that this process keeps from one run to the next, see `tiler.store.remembered`.
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
        self.changes: dict[Item, tuple[str, list[Box]]] = {}
        self.known = remembered_results()
        self.policy = policy or Policy()
        self.stopped = False
        self._gaps = Gaps(layout.absent)
        self.parameters, self.context = parameters, context
        self.executor, self.watcher = executor, watcher or Watcher()
        self.items: dict[str, tuple[Scope, Items]] = {}
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
        order = order_stages(stages, self.items.keys())
        self._laid_out |= {stage.name: (self.layout, self.context) for stage in order}
        plan = self._plan(order, items or {})
        for planned in plan:
            self.items[planned.stage.name] = (planned.stage.scope, planned.items)
            self.store.sweep(planned.stage.name)
            for name in (items or {}).get(planned.stage.name, planned.items.names):
                self._forget((planned.stage.name, name))
        started = Schedule(self, plan)
        try:
            started.drive()
        finally:
            for planned in plan:
                self.items[planned.stage.name] = (planned.stage.scope, self._recorded(planned))
        if misled := started.find_misled():
            self.run(*(planned.stage for planned in plan if planned.stage.name in misled), items=misled)

    def add_parameters(self, **values: Any) -> None:
        """Give values to parameters that only what was run so far decides; those of the same name are replaced."""
        self.parameters = SimpleNamespace(**(vars(self.parameters) | values))

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

    def laid_out(self, stage: str) -> tuple[Layout, Any]:
        """Layout and context that a stage was run with, for `lay_out`."""
        return self._laid_out[stage]

    def stop(self) -> None:
        """Let what runs end, start nothing more, and end `run` with `StoppedError`."""
        self.stopped = True

    def failed(self) -> list[SetAside]:
        """List what was set aside, in the order of stages and names."""
        rank = {stage: k for k, stage in enumerate(self.items)}
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

    def settled(self, item: Item) -> bool:
        """Whether an item has a record, was set aside, or cannot be run."""
        return item in self.records or item in self.set_aside or item in self.blocked

    def _recorded(self, planned: Planned) -> Items:
        """Keep of the items those of which something came, which are all unless the run ended early."""
        names = planned.items.names
        rows = [k for k, name in enumerate(names) if self.settled((planned.stage.name, name))]
        if len(rows) == len(names):
            return planned.items
        return Items(tuple(names[k] for k in rows), planned.items.boxes[rows])

    def _plan(self, order: list[Stage], only: Mapping[str, Collection[str]]) -> list[Planned]:
        known = dict(self.items)
        plan: list[Planned] = []
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
                for source in sorted({read.stage for read in stage.reads})
            )
            values = declared_values(stage, self.parameters)
            digest = stage_digest(stage, values, self.layout)
            plan.append(Planned(stage, here, refs, first, digest, Declared(stage.name, values), named_by))
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
        return set(only).union(self.items[stage.name][1].names if stage.name in self.items else ())

    def _extents(self, items: Items, stage: str) -> Items:
        """Take extents for boxes; what has no result keeps its box."""
        boxes = items.boxes.copy()
        known = [k for k, name in enumerate(items.names) if (stage, name) in self.records]
        some = Items(tuple(items.names[k] for k in known), items.boxes[known])
        facts = {name: self.records.kept_facts(stage, name) for name in some.names}
        boxes[known] = extents(some, facts, stage).boxes
        return Items(items.names, boxes)

    def listed(self, stage: str, item: str) -> Iterable[str]:
        """Names that the result of an item lists; none without a result."""
        there = (stage, item) in self.records
        names: Iterable[str] = self.records.kept_facts(stage, item)["names"] if there else ()
        return names

    def find_gaps(self, scope: Scope, box: Box, refs: Mapping[str, Iterable[str]]) -> list[Box]:
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
        everything = Scope.REGION in (stage.scope, scope)  # whose items read, or are read by, all
        (first, *_) = (read for read in stage.reads if read.stage == source)
        if first.own:
            if first.optional:
                return own_refs(here, source, run)
            return list_refs(here, source, run, {name: (name,) for name in here.names})
        if first.named_by:
            listed = {name: tuple(self.listed(first.named_by, name)) for name in here.names}
            return list_refs(here, source, run, listed)
        if first.around:
            here = self._extents(here, first.around)
        if True in by_extent:
            return find_refs(stage, here, source, self._extents(run, source), everything=everything)
        whole = self._all(self._laid_out[source][0], scope)
        reach = run if len(whole.names) == len(run.names) else whole
        found = find_refs(stage, here, source, reach, everything=everything)
        return found if reach is run else _among(found, reach, run, stage)


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
