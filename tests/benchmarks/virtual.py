"""Executors and a store for simulated runs: virtual workers whose tasks take recorded time, on their own clock."""

import hashlib
import heapq
import tempfile
import time
from collections import deque
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.data.errors import CityError
from tests.benchmarks.recorded import choose, draw, make_facts
from tiler.engine.executor import LEAST_TASKS, TASKS_PER_WORKER, Function
from tiler.engine.stage import Box, Facts, Layout, Scope
from tiler.engine.task import Failure, Record, Task, run_task
from tiler.store.store import Store

VERIFIED = 1e9  # bytes/s; how fast an earlier result is held against its checksums
LATENCY = 1e-3  # s; for an earlier result besides
STORED = 64  # numbers that a simulated task puts into a real store


def simulate(task: Task) -> Facts:
    """Stand for any stage's function: a few numbers into the store, and the facts that were recorded."""
    task.put(numbers=np.full(STORED, draw(task.stage, task.name)))
    return make_facts(choose(task.context.tile_size, task.stage, task.name), task.scope, task.name, task.box)


class StandInStore(Store):
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
        """Go to a worker as a plain store, which nobody there looks into."""
        return Store, (self.path,)

    def commit(self, task: Task) -> tuple[str, bool]:
        """Take a result; gives its digest, and whether it was there before."""
        number = int(task.key[:16], 16) | 1
        place = number & self._mask
        while (found := int(self._keys[place])) not in (0, number):
            place = (place + 1) & self._mask
        self._keys[place] = number
        digest = hashlib.blake2b(f"{task.stage} {task.name}".encode(), digest_size=16).hexdigest()
        return digest, found == number

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
    done, reused : int
        Number of tasks, and of those whose result was there.
    flying : float
        Tasks in flight, integrated over the virtual time (s).
    stored, written, files : int
        Bytes in the store and beside it, and number of all these files, as recorded.
    """

    def __init__(self, workers: int, store: StandInStore | None = None, fail: float = 0.0) -> None:
        self.workers, self.window = workers, max(TASKS_PER_WORKER * workers, LEAST_TASKS)
        self.clock = self.busy = self.own = 0.0
        self.done = self.reused = self.in_flight = 0
        self.flying = 0.0  # integral of the number of tasks in flight over virtual time
        self.stored = self.written = self.files = 0
        self._store, self._fail = store, fail
        self._queue: deque[tuple[int, Task]] = deque()
        self._running: list[tuple[float, int, int, Record | Failure]] = []
        self._serial = 0

    def submit(self, ticket: int, function: Function, task: Task, rank: int = 0) -> None:
        """Take a task; they begin as they come."""
        begin = time.perf_counter()
        self.in_flight += 1
        self._queue.append((ticket, task))
        self._fill()
        self.own += time.perf_counter() - begin

    def wait(self) -> tuple[int, Record | Failure]:
        """Go on to the time at which the next task is done."""
        begin = time.perf_counter()
        end, _, ticket, outcome = heapq.heappop(self._running)
        self.busy += (len(self._running) + 1) * (end - self.clock)
        self.flying += self.in_flight * (end - self.clock)
        self.clock = end
        self.in_flight -= 1
        self.done += 1
        self._fill()
        self.own += time.perf_counter() - begin
        return ticket, outcome

    def drop_waiting(self) -> set[int]:
        """Forget what has not begun."""
        dropped = {ticket for ticket, _ in self._queue}
        self._queue.clear()
        self.in_flight -= len(dropped)
        return dropped

    def _fill(self) -> None:
        while self._queue and len(self._running) < self.workers:
            ticket, task = self._queue.popleft()
            seconds, outcome = self._run(task)
            self._serial += 1
            heapq.heappush(self._running, (self.clock + seconds, self._serial, ticket, outcome))

    def _run(self, task: Task) -> tuple[float, Record | Failure]:
        chosen = choose(task.context.tile_size, task.stage, task.name)
        if task.scope is not Scope.REGION and draw("fails", task.stage, task.name) < self._fail * 2**32:
            return chosen.seconds, Failure(CityError("simulated failure"), "Traceback: simulated\n" * 10)
        if self._store is None:
            outcome = run_task(simulate, task)
            if isinstance(outcome, Failure):
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
    digest = hashlib.blake2b(f"{task.stage} {task.name}".encode(), digest_size=16).hexdigest()
    return Record(task.stage, task.name, task.key, digest, facts, notes, {"all": chosen.seconds}, 2**20)
