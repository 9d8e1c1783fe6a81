"""The plan of a run: which items there are, what each reads, and who waits for whom; arrays, few objects."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from tiler.engine.stage import Box, Layout, Read, Stage, check_box


@dataclass(frozen=True, eq=False)
class Refs:
    """What the items of a stage read of one other stage."""

    stage: str  #: stage that is read
    start: NDArray[np.int64]  #: (n_items + 1,): where the refs of each item begin in ``index``
    index: NDArray[np.int32]  #: (n_refs,): positions among the read stage's items, ascending for each reader

    def of(self, item: int) -> NDArray[np.int32]:
        """Give the positions that one item reads."""
        return self.index[self.start[item] : self.start[item + 1]]


@dataclass(frozen=True, eq=False)
class Items:
    """The items of a stage, sorted by name."""

    names: tuple[str, ...]  #: their names
    boxes: NDArray[np.float64]  #: (n, 4): their boxes (m)


def order_stages(stages: Sequence[Stage], earlier: Collection[str]) -> list[Stage]:
    """Sort stages so that each comes after those it reads; otherwise as given.

    Raises
    ------
    ValueError
        If a name comes twice, a stage is unknown, the reads form a cycle, an extent is read of a stage of the
        same call, or the stage that one goes after has another scope.
    """
    names = [stage.name for stage in stages]
    if len(set(names)) < len(names):
        raise ValueError(f"a stage is given twice: {', '.join(names)}")
    for stage in stages:
        for read in stage.reads:
            if read.stage not in names and read.stage not in earlier:
                raise ValueError(
                    f"stage {stage.name} reads stage {read.stage}, which was not run and is not given"
                )
            for name in _known_before(stage, read, names):
                if name in names or name not in earlier:
                    raise ValueError(
                        f"stage {stage.name} reads {read.stage} by facts of others: run {name} in an earlier call"
                    )
    scope = {stage.name: stage.scope for stage in stages}
    for stage in stages:
        if scope.get(stage.after, stage.scope) is not stage.scope:
            raise ValueError(f"stage {stage.name} goes after {stage.after}, which has another scope")
    done: list[Stage] = []
    left = list(stages)
    while left:
        waiting = {stage.name for stage in left}
        ready = [s for s in left if waiting.isdisjoint([s.after, *(read.stage for read in s.reads)])]
        if not ready:
            raise ValueError(f"stages read each other in a cycle: {', '.join(sorted(waiting))}")
        done.append(ready[0])
        left.remove(ready[0])
    return done


def _known_before(stage: Stage, read: Read, names: Collection[str]) -> list[str]:
    """List the stages that must have run in an earlier call, as their facts decide what is read."""
    found = [read.stage] * read.by_extent + [read.around] * bool(read.around)
    if read.named_by in names and any(r.stage == read.named_by and r.own and not r.optional for r in stage.reads):
        return [*found, read.stage]  # named when the reader begins
    return found + [read.named_by] * bool(read.named_by)


def list_items(stage: Stage, layout: Layout, only: Collection[str] | None) -> Items:
    """List the items of a stage, all or some; ValueError for a name that is not in the layout."""
    boxes = layout.boxes(stage.scope)
    unknown = sorted(set(only or ()) - set(boxes))
    if unknown:
        raise ValueError(f"stage {stage.name}: no {stage.scope.value} {', '.join(unknown)} in the layout")
    return list_all(boxes if only is None else {name: boxes[name] for name in set(only)})


def list_all(boxes: Mapping[str, Box]) -> Items:
    """List items by their boxes."""
    names = tuple(sorted(boxes))
    return Items(names, np.array([boxes[name] for name in names], dtype=np.float64).reshape(-1, 4))


def find_refs(stage: Stage, items: Items, source: str, reach: Items, *, everything: bool) -> Refs:
    """Find what each item of a stage reads of another stage.

    Parameters
    ----------
    stage : Stage
        The reading stage; all its reads of the source are joined.
    items : Items
        Its items.
    source : str
        The stage that is read.
    reach : Items
        Items of the source; a box of NaN is never read.
    everything : bool
        True if one of the two is of the whole region.

    Notes
    -----
    A tree of the boxes: O((n + m) log m). Boxes are compared as they are, so a box that touches is found exactly.
    """
    n_items, n_source = len(items.names), len(reach.names)
    there = np.flatnonzero(~np.isnan(reach.boxes[:, 0]))
    if everything:
        pairs = np.stack([np.repeat(np.arange(n_items), len(there)), np.tile(there, n_items)])
    else:
        tree = shapely.STRtree(shapely.box(*reach.boxes[there].T))
        found = [
            _query(tree, items.boxes, reach.boxes[there], read) for read in stage.reads if read.stage == source
        ]
        pairs = np.concatenate([np.empty((2, 0), np.int64), *found], axis=1)
        pairs[1] = there[pairs[1]] if len(there) else pairs[1]
    return _make_refs(source, pairs, n_items, n_source)


def list_refs(items: Items, source: str, reach: Items, listed: Mapping[str, Sequence[str]]) -> Refs:
    """Make the refs of items that name what they read; ValueError for a name that is not among `reach`."""
    place = {name: k for k, name in enumerate(reach.names)}
    unknown = sorted({name for names in listed.values() for name in names} - set(place))
    if unknown:
        raise ValueError(f"stage {source} has no item {', '.join(unknown)}")
    pairs = [(row, place[name]) for row, item in enumerate(items.names) for name in listed[item]]
    return _make_refs(source, np.array(pairs, np.int64).reshape(-1, 2).T, len(items.names), len(reach.names))


def own_refs(items: Items, source: str, reach: Items) -> Refs:
    """Make the refs of items that read, or go after, what has their own name among `reach`."""
    there = set(reach.names)
    return list_refs(items, source, reach, {name: (name,) if name in there else () for name in items.names})


def chain_seams(items: Items, source: str, owners: Mapping[str, str]) -> Refs:
    """Make the refs of seams that go after the one before of the same owner."""
    last: dict[str, str] = {}
    listed: dict[str, Sequence[str]] = {}
    for name in items.names:
        owner = owners.get(name, name)
        listed[name] = (last[owner],) if owner in last else ()
        last[owner] = name
    return list_refs(items, source, items, listed)


def _make_refs(source: str, pairs: NDArray[np.int64], n_items: int, n_source: int) -> Refs:
    flat = np.sort(pairs[0] * max(n_source, 1) + pairs[1])
    flat = flat[np.diff(flat, prepend=-1) > 0]  # np.unique imports masked arrays: 0.03 s before the first task
    reader, index = flat // max(n_source, 1), flat % max(n_source, 1)
    start = np.searchsorted(reader, np.arange(n_items + 1)).astype(np.int64)
    return Refs(source, start, index.astype(np.int32))


def extents(items: Items, facts: Mapping[str, Mapping[str, Any]], stage: str) -> Items:
    """Replace the boxes of items by the extents that their results state; NaN where there is nothing.

    Raises
    ------
    ValueError
        If a result states no extent, or one that is no box.
    """
    boxes = np.full((len(items.names), 4), np.nan)
    for row, name in enumerate(items.names):
        if "extent" not in facts[name]:
            raise ValueError(f"stage {stage}, {name}: its facts have no extent")
        extent: Box | None = facts[name]["extent"]
        if extent is not None:
            check_box(f"extent of stage {stage}, {name}", extent)
            boxes[row] = extent
    return Items(items.names, boxes)


def invert(refs: Sequence[tuple[int, Refs, int]], n_tasks: int) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """Turn refs around: which tasks wait for each task.

    Parameters
    ----------
    refs : sequence of (int, Refs, int)
        Number of the reading stage's first task, its refs, and number of the read stage's first task.
    n_tasks : int
        Number of all tasks.

    Returns
    -------
    start : int64, (n_tasks + 1,)
        Where the waiting tasks of each begin.
    waiting : int32, (n_refs,)
        Their numbers.
    """
    none = np.empty(0, np.int32)
    reading = [none, *(readers(r) + np.int32(first) for first, r, _ in refs)]
    sources = [none, *(r.index + np.int32(base) for _, r, base in refs)]
    reader, source = np.concatenate(reading), np.concatenate(sources)
    order = np.argsort(source, kind="stable")
    start = np.searchsorted(source[order], np.arange(n_tasks + 1)).astype(np.int64)
    return start, reader[order].astype(np.int32)


def readers(refs: Refs) -> NDArray[np.int32]:
    """Give the reading item of each ref."""
    counts = np.diff(refs.start)
    return np.repeat(np.arange(len(counts), dtype=np.int32), counts)


def _query(
    tree: shapely.STRtree, boxes: NDArray[np.float64], reached: NDArray[np.float64], read: Read
) -> NDArray[np.int64]:
    """Find the pairs (2, k) of rows of `boxes` and of `reached`, which are the tree's, that a read joins."""
    some = np.flatnonzero(~np.isnan(boxes[:, 0]))
    grown = boxes[some] + read.halo * np.array([-1, -1, 1, 1])
    pairs: NDArray[np.int64] = np.asarray(tree.query(shapely.box(*grown.T)), dtype=np.int64)
    if read.beside:
        one, other = grown[pairs[0]], reached[pairs[1]]
        common = np.minimum(one[:, 2:], other[:, 2:]) - np.maximum(one[:, :2], other[:, :2])
        pairs = pairs[:, (common > 0).any(axis=1)]
    pairs[0] = some[pairs[0]] if len(some) else pairs[0]
    return pairs


class Gaps:
    """Boxes that no tile covers, sorted from west to east.

    Parameters
    ----------
    boxes : sequence of tuple of float
        Boxes (m).
    """

    def __init__(self, boxes: Sequence[Box]) -> None:
        self._boxes = boxes
        sides = np.array(boxes, np.float64).reshape(-1, 4)
        self._order = np.argsort(sides[:, 0], kind="stable")
        self._sides = sides[self._order]
        self._widest = float((sides[:, 2] - sides[:, 0]).max(initial=0.0))

    def near(self, low: NDArray[np.float64], high: NDArray[np.float64]) -> list[Box]:
        """List the boxes that meet a closed box, in the order in which they were given.

        Parameters
        ----------
        low, high : float64, (2,)
            Lower left and upper right of the box (m).

        Notes
        -----
        Only the columns that it spans are looked at: O(sqrt(n)) for the squares of a grid.
        """
        western = self._sides[:, 0]
        # Twice the widest, as the difference of two sides is rounded.
        first = int(np.searchsorted(western, low[0] - 2 * self._widest, side="left"))
        last = int(np.searchsorted(western, high[0], side="right"))
        some = self._sides[first:last]
        close = (some[:, 0] <= high[0]) & (some[:, 1] <= high[1]) & (some[:, 2] >= low[0]) & (some[:, 3] >= low[1])
        return [self._boxes[k] for k in np.sort(self._order[first:last][close]).tolist()]
