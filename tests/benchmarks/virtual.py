"""Executors and a store for simulated runs: virtual workers whose tasks take recorded time, on their own clock."""

import hashlib
import heapq
import tempfile
import time
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.data.errors import CityError
from tests.benchmarks.recorded import choose, draw, make_facts
from tiler.engine.executor import LEAST, PER_WORKER
from tiler.engine.stage import Box, Facts, Layout, Scope
from tiler.engine.submission import Function, Outcome, Part, run_parts
from tiler.engine.task import Failure, Record, Task, run_task
from tiler.store.store import Store

VERIFIED = 1e9  # bytes/s; how fast an earlier result is held against its checksums
LATENCY = 1e-3  # s; for an earlier result besides
STORED = 64  # numbers that a simulated task puts into a real store


def simulate(task: Task) -> Facts:
    """Stand for any stage's function: a few numbers into the store, and the facts that were recorded."""
    task.put(numbers=np.full(STORED, draw(task.stage, task.name)))
    return make_facts(choose(task.context.tile_size, task.stage, task.name), task.scope, task.name, task.box)


def digest_of(stage: str, name: str) -> str:
    """Digest of a result that is not there: always the same one."""
    return hashlib.blake2b(f"{stage} {name}".encode(), digest_size=16).hexdigest()


class NoStore(Store):
    """A store that holds nothing, for workers whose tasks are done at once: it knows the digests alone."""

    def describe(self, stage: str, name: str) -> tuple[dict[str, Any], str]:
        """Digest of a result, without attributes."""
        return {}, digest_of(stage, name)


class StandInStore(NoStore):
    """What would be in a store, made anew when asked for; of commits it keeps a hash of the key each, in a file.

    Parameters
    ----------
    layout : Layout
        The items.
    tile_size : float
        Side of a tile (m).
    slots : int
        Room for hashes, a power of 2; some half of it may be used.
    """

    def __init__(self, path: Path, layout: Layout, tile_size: float, slots: int = 2**25) -> None:
        super().__init__(path)
        self.layout, self.tile_size = layout, tile_size
        self._mask = slots - 1
        with tempfile.TemporaryFile() as file:
            self._keys = np.memmap(file, np.uint64, shape=(slots,))

    def __reduce__(self) -> tuple[Any, ...]:
        """Go to a worker as a store that holds nothing."""
        return NoStore, (self.path,)

    def commit(self, task: Task) -> tuple[str, bool]:
        """Take a result; gives its digest, and whether it was there before."""
        number = int(task.key[:16], 16) | 1
        place = number & self._mask
        while (found := int(self._keys[place])) not in (0, number):
            place = (place + 1) & self._mask
        self._keys[place] = number
        return digest_of(task.stage, task.name), found == number

    def facts(self, stage: str, name: str) -> Facts:
        """Facts of a result."""
        scope, box = self._place(name)
        return make_facts(choose(self.tile_size, stage, name), scope, name, box)

    def attributes(self, stage: str, name: str) -> dict[str, Any]:
        """Attributes of a result, always as if it were there."""
        notes = [["simulated", name, 0.0, 0.0, ""] for _ in range(choose(self.tile_size, stage, name).notes)]
        return {"facts": self.facts(stage, name), "notes": notes}

    def sweep(self, stage: str) -> None:
        """Nothing is left behind."""

    def stages(self) -> list[str]:
        """No folder is there to be pruned."""
        return []

    def _place(self, name: str) -> tuple[Scope, Box]:
        layout = self.layout
        if name in layout.tiles:
            return Scope.TILE, layout.tiles[name]
        if name in layout.seams:
            return Scope.SEAM, layout.seams[name]
        if name in layout.files:
            return Scope.FILE, layout.files[name].box
        return Scope.REGION, layout.bounds


class VirtualWorkers:
    """Workers that take as long as was recorded, on a clock of their own.

    Parameters
    ----------
    workers : int
        Number of workers.
    store : StandInStore, optional
        Takes the results; without it the tasks' own store does, on disk.
    fail : float
        Share of the items of tiles, seams and files that fail for good.

    Attributes
    ----------
    clock : float
        Virtual time (s).
    busy : float
        Seconds of all workers in which they had a task.
    own : float
        Wall time that this process spent in here (s), which is not the driver's.
    submitted, done, reused : int
        Number of submissions, of those that are done, and of tasks whose result was there.
    flying : float
        Submissions in flight, integrated over the virtual time (s).
    stored, written, files : int
        Bytes in the store and beside it, and number of all these files, as recorded.
    """

    def __init__(self, workers: int, store: StandInStore | None = None, fail: float = 0.0) -> None:
        self.workers, self.window = workers, max(PER_WORKER * workers, LEAST)
        self.clock = self.busy = self.own = 0.0
        self.submitted = self.done = self.reused = self.in_flight = 0
        self.flying = 0.0  # integral of the number in flight over virtual time
        self.stored = self.written = self.files = 0
        self._store, self._fail = store, fail
        self._queue: deque[tuple[int, Sequence[Part]]] = deque()
        self._running: list[tuple[float, int, int, list[Outcome | None]]] = []
        self._serial = 0

    def submit(self, ticket: int, parts: Sequence[Part], rank: int = 0) -> None:
        """Take tasks; they begin as they come."""
        begin = time.perf_counter()
        self.submitted += 1
        self.in_flight += 1
        self._queue.append((ticket, parts))
        self._fill()
        self.own += time.perf_counter() - begin

    def wait(self) -> tuple[int, list[Outcome | None]]:
        """Go on to the time at which the next submission is done."""
        begin = time.perf_counter()
        end, _, ticket, outcomes = heapq.heappop(self._running)
        self.busy += (len(self._running) + 1) * (end - self.clock)
        self.flying += self.in_flight * (end - self.clock)
        self.clock = end
        self.in_flight -= 1
        self.done += 1
        self._fill()
        self.own += time.perf_counter() - begin
        return ticket, outcomes

    def drop_waiting(self) -> set[int]:
        """Forget what has not begun."""
        dropped = {ticket for ticket, _ in self._queue}
        self._queue.clear()
        self.in_flight -= len(dropped)
        return dropped

    def _fill(self) -> None:
        while self._queue and len(self._running) < self.workers:
            ticket, parts = self._queue.popleft()
            taken: list[float] = []

            def run(_: Function, task: Task, taken: list[float] = taken) -> Outcome:
                seconds, outcome = self._run(task)
                taken.append(seconds)
                return outcome

            outcomes = run_parts(parts, run)
            self._serial += 1
            heapq.heappush(self._running, (self.clock + sum(taken), self._serial, ticket, outcomes))

    def _run(self, task: Task) -> tuple[float, Outcome]:
        chosen = choose(task.context.tile_size, task.stage, task.name)
        if task.scope is not Scope.REGION and draw("fails", task.stage, task.name) < self._fail * 2**32:
            return chosen.seconds, Failure(CityError("simulated failure"), "Traceback: simulated\n" * 10)
        if self._store is None:
            outcome = run_task(simulate, task)
            if not isinstance(outcome, Record):
                return chosen.seconds, outcome
        else:
            digest, there = self._store.commit(task)
            facts = make_facts(chosen, task.scope, task.name, task.box)
            notes = {"simulated": chosen.notes} if chosen.notes else {}
            seconds = {} if there else {"all": chosen.seconds}
            outcome = Record(task.stage, task.name, task.key, digest, facts, notes, seconds, reused=there)
        if outcome.reused:
            self.reused += 1
            return LATENCY + (chosen.stored + chosen.written) / VERIFIED, outcome
        self.stored += chosen.stored
        self.written += chosen.written
        self.files += chosen.stored_files + chosen.written_files
        return chosen.seconds, outcome


def instant(function: Function, task: Task, seconds: float) -> Record:
    """Stand for `tiler.engine.task_limits.run_guarded`: the record of a task at once, and nothing in the store."""
    chosen = choose(task.context.tile_size, task.stage, task.name)
    facts = make_facts(chosen, task.scope, task.name, task.box)
    notes = {"simulated": chosen.notes} if chosen.notes else {}
    digest = digest_of(task.stage, task.name)
    return Record(task.stage, task.name, task.key, digest, facts, notes, {"all": chosen.seconds}, 2**20)
