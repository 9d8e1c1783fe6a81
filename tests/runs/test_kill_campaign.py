"""Kills at random moments: workers, the driver, all, the scheduler; every run ends with the same bytes.

The moments are numbers of committed results, drawn from seeds, spread evenly over a run and its stages. The same
run is killed and gone on with several times before it may end. `make reliability` kills twelve runs, CI two; what
was killed when is kept as ``kills.json`` (`tests.helpers.campaigns`).
"""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

from tests.helpers.campaigns import keep_outcome, rounds
from tests.helpers.sparse_city import (
    SparseCity,
    children,
    front,
    make_city,
    start,
    wait_for_results,
    wait_until_gone,
    workers,
)
from tests.runs.test_run import hashes

KILLS = 5  # of one run
END = 240.0  # s that a run, or what is left of a killed one, may take
LOST = "the connection to the Dask scheduler is lost; all that was done is kept"
CLUSTER = "scheduler"
KINDS = ("worker", "driver", "group", "mixed", CLUSTER)
# Of workers, drivers and groups one each is killed in the small city below, and any of them in a mixed round.
ROUNDS = rounds(
    [("mixed", 0), (CLUSTER, 0)],
    [
        *((kind, 0) for kind in KINDS[:3]),
        *((kind, 1) for kind in KINDS),
        *((kind, 2) for kind in ("driver", "group")),
    ],
)


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> SparseCity:
    return make_city(tmp_path_factory.mktemp("small"), 2, buildings=12)


@pytest.fixture(scope="module")
def large(tmp_path_factory: pytest.TempPathFactory) -> SparseCity:
    return make_city(tmp_path_factory.mktemp("large"), 5, buildings=60)


@dataclass
class Victim:
    """A run that is killed and gone on with."""

    city: SparseCity
    folder: Path
    rng: np.random.Generator
    options: list[str] = field(default_factory=lambda: ["--workers", "2"])
    process: "subprocess.Popen[bytes] | None" = None
    kills: list[dict[str, Any]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        self.out = self.folder / "out"
        self.expected = self.city.stages()
        self.n = sum(self.expected.values())

    def alive(self) -> "subprocess.Popen[bytes]":
        """Start the run, or go on with it, if it is not at work."""
        if self.process is None or self.process.poll() is not None:
            self.process = start(self.city.command(self.out, *self.options), self.folder / "log.txt")
        return self.process

    def words(self) -> str:
        return (self.folder / "log.txt").read_text(errors="replace")

    def targets(self, n: int) -> list[int]:
        """Numbers of results to kill at: one in each nth of the run, every other last one when all are there."""
        steps = (np.arange(n) + self.rng.random(n)) / n
        if self.rng.random() < n / 10:
            steps[-1] = 1.0
        return [int(step * self.n) for step in steps]

    def kill(self, kind: str, target: int) -> bool:
        """Kill at a number of results; False if the run ended first."""
        process = self.alive()
        counts = wait_for_results(process, self.out, target, END)
        if process.poll() is not None:
            return False
        below = children(process)
        if kind == "worker":
            found = workers(process)
            if not found:
                return False
            with suppress(psutil.NoSuchProcess):
                found[self.rng.integers(len(found))].kill()
        else:
            with suppress(ProcessLookupError):
                os.kill(process.pid, signal.SIGKILL) if kind == "driver" else os.killpg(
                    process.pid, signal.SIGKILL
                )
            process.wait(END)
            living = wait_until_gone(below, 30.0)
            assert not living, f"{living} outlive their driver"
        self.kills.append({"kind": kind, "results": sum(counts.values()), "stage": front(self.expected, counts)})
        return True

    def finish(self) -> None:
        """Go on to the end: the bytes of the reference, and nothing else."""
        code = self.alive().wait(END)
        if code == 0 and not self.kills:
            raise AssertionError("the run ended before it was killed")
        assert code == 0, self.words()
        assert "Traceback" not in self.words()
        record = json.loads((self.out / "run.json").read_text())
        assert (record["status"], record["exit_code"], record["missing"]) == ("done", 0, {})
        assert hashes(self.out) == self.city.hashes

    def end(self) -> None:
        """Leave no process behind."""
        if self.process is not None:
            end_group(self.process)


def end_group(process: "subprocess.Popen[bytes]") -> None:
    below = children(process)
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    for child in below:
        with suppress(psutil.NoSuchProcess):
            child.kill()


@contextmanager
def cluster(folder: Path) -> Iterator[tuple[str, "subprocess.Popen[bytes]", "subprocess.Popen[bytes]"]]:
    """Start a Dask scheduler and two workers of one thread, without nannies; gives its address and both."""
    folder.mkdir(parents=True)
    place = folder / "scheduler.json"
    dask = [sys.executable, "-m", "dask"]
    local = ["--host", "127.0.0.1", "--no-dashboard"]
    running = [
        start([*dask, "scheduler", *local, "--port", "0", "--scheduler-file", str(place)], folder / "s.txt")
    ]
    try:
        end = time.monotonic() + 60
        while not place.exists() or not place.read_text():
            assert time.monotonic() < end, (folder / "s.txt").read_text()
            time.sleep(0.05)
        address = str(json.loads(place.read_text())["address"])
        for k in range(2):
            options = ["--nthreads", "1", "--no-nanny", "--memory-limit", "0"]
            running.append(start([*dask, "worker", address, *local, *options], folder / f"w{k}.txt"))
        end = time.monotonic() + 60
        while not all("Registered to" in (folder / f"w{k}.txt").read_text() for k in range(2)):
            assert time.monotonic() < end, (folder / "w0.txt").read_text()
            time.sleep(0.05)
        yield address, running[0], running[1]
    finally:
        for process in running:
            end_group(process)


def kill_scheduler(victim: Victim, target: int, folder: Path) -> None:
    """Lose the scheduler: one clear line, nothing lost."""
    with cluster(folder) as (address, scheduler, _):
        victim.options = ["--scheduler", address]
        process = victim.alive()
        counts = wait_for_results(process, victim.out, target, END)
        if process.poll() is not None:
            return
        scheduler.kill()
        assert process.wait(60) == 1, victim.words()
    assert victim.words().count(LOST) == 1
    assert "Traceback" not in victim.words()
    assert victim.words().splitlines()[-1].startswith("citystitch: ")
    assert json.loads((victim.out / "run.json").read_text())["status"] == "failed"
    victim.kills.append(
        {"kind": "scheduler", "results": sum(counts.values()), "stage": front(victim.expected, counts)}
    )


def finish_with_one_worker(victim: Victim, target: int, folder: Path) -> None:
    """Kill a worker of a cluster that is not ours: the other one takes over."""
    with cluster(folder) as (address, _, worker):
        victim.options = ["--scheduler", address]
        process = victim.alive()
        counts = wait_for_results(process, victim.out, target, END)
        worker.kill()
        victim.kills.append(
            {
                "kind": "worker of a cluster",
                "results": sum(counts.values()),
                "stage": front(victim.expected, counts),
            }
        )
        victim.finish()


@pytest.mark.long
def test_killed_processes_lose_nothing(small: SparseCity, tmp_path: Path) -> None:
    victim = Victim(small, tmp_path, np.random.default_rng(1))
    try:
        for kind, target in zip(("worker", "driver", "group"), victim.targets(4), strict=False):
            assert victim.kill(kind, target)
        victim.finish()
    finally:
        victim.end()


def test_a_lost_scheduler_is_one_clear_error(small: SparseCity, tmp_path: Path) -> None:
    victim = Victim(small, tmp_path / "run", np.random.default_rng(1))
    try:
        kill_scheduler(victim, victim.n // 3, tmp_path / "cluster")
        victim.options = []
        victim.finish()
    finally:
        victim.end()


@pytest.mark.long
@pytest.mark.timeout(1800)
@pytest.mark.parametrize(("kind", "seed"), ROUNDS)
def test_kills_at_random_moments(large: SparseCity, tmp_path: Path, kind: str, seed: int) -> None:
    victim = Victim(large, tmp_path / "run", np.random.default_rng([seed, len(kind)]))
    try:
        if kind == CLUSTER:
            *targets, last = victim.targets(KILLS)
            for k, target in enumerate(targets):
                kill_scheduler(victim, target, tmp_path / f"cluster{k}")
            finish_with_one_worker(victim, min(last, victim.n - 40), tmp_path / "last")
        else:
            for target in victim.targets(KILLS):
                drawn = ("worker", "driver", "group")[victim.rng.integers(3)] if kind == "mixed" else kind
                if not victim.kill(drawn, target):
                    break
            victim.finish()
        keep_outcome("kills", round=kind, seed=seed, results=victim.n, kills=victim.kills)
    finally:
        victim.end()
