"""What the driver remembers of results: a digest each in memory, all else in the store.

A country has some ten million results. Facts are kept in memory where the engine itself asks for them, and read
from the store otherwise.
"""

import sys
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from pipeline.notes import count_notes
from tiler.stage import Facts
from tiler.store import Store
from tiler.task import Record, notes_from_json
from tiler.written import FILES

# Facts that reads go by, see `tiler.stage.Read`, and the files that the manifest lists.
KEPT = ("extent", "names", FILES)


@dataclass(frozen=True, eq=False, slots=True)
class _Kept:
    key: bytes
    digest: bytes
    reused: bool
    noted: bool
    facts: Facts | None


class Records(Mapping[tuple[str, str], Record]):
    """The records of all results that a run has made or taken, by stage and item.

    A record that is looked up is read from the store: it has key, facts and notes, but neither seconds nor memory,
    which are known as sums only.

    Parameters
    ----------
    store : Store
        Where the results are.

    Attributes
    ----------
    seconds : dict of str to float
        Wall time of all tasks (s), by stage, and by ``"stage: step"``.
    peak_memory : int
        Largest resident memory of a process that ran a task (bytes).
    damage : dict of (str, str) to str
        What was wrong with earlier results that were computed again for that.
    """

    def __init__(self, store: Store) -> None:
        self._store = store
        self._stages: dict[str, dict[str, _Kept]] = {}
        self.seconds: defaultdict[str, float] = defaultdict(float)
        self.peak_memory = 0
        self.damage: dict[tuple[str, str], str] = {}

    def add(self, record: Record) -> None:
        """Keep a record, in place of an earlier one of that item."""
        facts = {name: _intern(record.facts[name]) for name in KEPT if name in record.facts}
        key, digest = bytes.fromhex(record.key), bytes.fromhex(record.digest)
        kept = _Kept(key, digest, record.reused, bool(record.notes), facts or None)
        self._stages.setdefault(record.stage, {})[sys.intern(record.name)] = kept
        if record.damage:
            self.damage[record.stage, record.name] = record.damage
        self.peak_memory = max(self.peak_memory, record.peak_memory)
        for step, seconds in record.seconds.items():
            self.seconds[record.stage if step == "all" else f"{record.stage}: {step}"] += seconds

    def forget(self, stage: str, name: str) -> None:
        """Forget a record; nothing happens if it is not there."""
        self._stages.get(stage, {}).pop(name, None)

    def digest(self, stage: str, name: str) -> str:
        """Digest of a result's content, 32 hexadecimal digits; KeyError if there is no record."""
        return self._stages[stage][name].digest.hex()

    def made(self, stage: str, name: str) -> tuple[str, bool]:
        """Key of a result, and whether it was computed; KeyError if there is no record."""
        kept = self._stages[stage][name]
        return kept.key.hex(), not kept.reused

    def kept_facts(self, stage: str, name: str) -> Facts:
        """Those facts of a result that reads go by; KeyError if there is no record."""
        return self._stages[stage][name].facts or {}

    def of(self, stage: str) -> Iterator[Record]:
        """Read the records of one stage, one at a time, by name."""
        return (self[stage, name] for name in sorted(self._stages.get(stage, {})))

    def stages(self) -> list[str]:
        """List the stages that have records, sorted."""
        return sorted(stage for stage, items in self._stages.items() if items)

    def noted(self) -> list[tuple[str, str]]:
        """List the items whose results have notes, sorted."""
        items = ((stage, name) for stage, kept in self._stages.items() for name in kept if kept[name].noted)
        return sorted(items)

    def count_reused(self) -> dict[str, int]:
        """Count by stage the results that were there before."""
        return self._count(reused=True)

    def count_ran(self) -> dict[str, int]:
        """Count by stage the results that were made."""
        return self._count(reused=False)

    def _count(self, *, reused: bool) -> dict[str, int]:
        counts = {s: sum(kept.reused is reused for kept in items.values()) for s, items in self._stages.items()}
        return {stage: n for stage, n in sorted(counts.items()) if n}

    def __getitem__(self, item: tuple[str, str]) -> Record:
        stage, name = item
        kept = self._stages[stage][name]
        attributes: dict[str, Any] = self._store.attributes(stage, name)
        notes = count_notes(notes_from_json(attributes["notes"]))
        return Record(
            stage,
            name,
            kept.key.hex(),
            kept.digest.hex(),
            attributes["facts"],
            notes,
            reused=kept.reused,
            damage=self.damage.get(item, ""),
        )

    def __contains__(self, item: object) -> bool:
        return isinstance(item, tuple) and item[1] in self._stages.get(item[0], {})

    def __iter__(self) -> Iterator[tuple[str, str]]:
        return ((stage, name) for stage, items in self._stages.items() for name in items)

    def __len__(self) -> int:
        return sum(map(len, self._stages.values()))


def _intern(value: Any) -> Any:
    """Names of items are many, and mostly the same few: keep each once."""
    if isinstance(value, dict):
        return value
    return tuple(map(sys.intern, value)) if value and all(type(v) is str for v in value) else value
