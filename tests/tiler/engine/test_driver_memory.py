"""What the driver keeps of results stays small, and finds what it looks for without looking at everything."""

import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from tiler.engine.records import Records
from tiler.engine.stage import Facts
from tiler.engine.task import Record
from tiler.engine.task_graph import Gaps
from tiler.store.store import Store

BYTES = 250  # that a record with an extent and names may take, dictionaries included


def make_record(stage: str, name: str, facts: Facts, *, number: int = 0) -> Record:
    return Record(stage, name, f"{number:032x}", f"{number + 1:032x}", facts, {})


@pytest.mark.parametrize(
    "extent",
    [[0.1, -2.5, 3e300, 4.0], None, [0, 1, 2, 3], [1.0, 2.0], "no box"],
    ids=["box", "none", "ints", "short", "text"],
)
def test_facts_that_reads_go_by_come_back_as_they_were(extent: object, tmp_path: Path) -> None:
    records = Records(Store(tmp_path))
    records.add(make_record("houses", "1_2", {"extent": extent, "names": ["1_2", "1_3"], "n": 7}, number=5))
    kept = records.kept_facts("houses", "1_2")
    assert (kept["extent"], list(kept["names"])) == (extent, ["1_2", "1_3"])
    assert type(kept["extent"]) is type(extent)
    assert records.digest("houses", "1_2") == f"{6:032x}"
    assert records.made("houses", "1_2") == (f"{5:032x}", True)
    records.add(make_record("houses", "1_2", {}))
    assert records.kept_facts("houses", "1_2") == {}


def test_a_record_takes_little_memory(tmp_path: Path) -> None:
    records, n = Records(Store(tmp_path)), 5_000
    for stage in ("houses", "shapes-0"):  # names are kept once, for all stages
        tracemalloc.start()
        for k in range(n):
            facts = {"extent": [float(k), 1.0, k + 2.0, 3.0], "names": [f"{k}_0"], "counts": {"houses": k}}
            records.add(make_record(stage, f"{k}_0", facts, number=k))
        size, _ = tracemalloc.get_traced_memory()
        tracemalloc.stop()
    assert size / n < BYTES


@pytest.mark.parametrize("seed", range(5))
def test_absent_tiles_are_found_as_by_looking_at_all(seed: int) -> None:
    random = np.random.default_rng(seed)
    lines = np.concatenate(([0.1], np.arange(1, 30) * 0.7, [21.4]))
    there = np.argwhere(random.random((30, 30)) < 0.3)
    boxes = [
        (float(lines[i]), float(lines[j]), float(lines[i + 1]), float(lines[j + 1])) for i, j in there.tolist()
    ]
    random.shuffle(boxes)
    gaps, sides = Gaps(boxes), np.array(boxes)
    for _ in range(200):
        low = random.choice(lines, 2) - random.choice([0.0, 0.2, 0.7])
        high = low + random.choice([0.0, 0.7, 2.1, 40.0], 2)
        close = (sides[:, :2] <= high).all(axis=1) & (sides[:, 2:] >= low).all(axis=1)
        assert gaps.near(low, high) == [boxes[k] for k in np.flatnonzero(close)]


def test_without_absent_tiles_none_is_near() -> None:
    assert Gaps([]).near(np.zeros(2), np.ones(2)) == []
