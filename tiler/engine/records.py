"""What the driver remembers of results: a digest each in memory, all else in the store.

A country has some ten million results. Facts are kept in memory where the engine itself asks for them, and read
from the store otherwise.
"""

import struct
import sys
from collections import defaultdict
from collections.abc import Iterator, Mapping
from typing import Any

from pipeline.data.notes import count_notes
from tiler.engine.stage import Facts
from tiler.engine.task import Record, notes_from_json
from tiler.store.checksums import FILES
from tiler.store.store import Store

# Facts that reads go by, see `tiler.engine.stage.Read`.
KEPT = ("extent", "names")
REUSED, NOTED, FILED, EXTENT, NO_EXTENT = 1, 2, 4, 8, 16
BOX = struct.Struct("<4d")


def _pack(record: Record) -> bytes:
    """Key, digest and what else must be known, in one object: there are some 30 results a tile."""
    flags = REUSED * record.reused | NOTED * bool(record.notes) | FILED * (FILES in record.facts)
    extent = b""
    if "extent" in record.facts:
        found = record.facts["extent"]
        if found is None:
            flags |= NO_EXTENT
        elif _is_box(found):
            flags |= EXTENT
            extent = BOX.pack(*found)
    key = bytes.fromhex(record.key)
    return bytes((flags, len(key), len(extent))) + key + extent + bytes.fromhex(record.digest)


def _key(packed: bytes) -> str:
    return packed[3 : 3 + packed[1]].hex()


def _digest(packed: bytes) -> str:
    return packed[3 + packed[1] + packed[2] :].hex()


def _extent(packed: bytes) -> Facts:
    """Facts on the extent, as they were."""
    if packed[0] & EXTENT:
        return {"extent": list(BOX.unpack_from(packed, 3 + packed[1]))}
    return {"extent": None} if packed[0] & NO_EXTENT else {}


def _is_box(value: Any) -> bool:
    """Whether an extent can be packed; any other one stays as it is, and is refused where it is read."""
    return isinstance(value, list) and [type(v) for v in value] == 4 * [float]


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
        self._stages: dict[str, dict[str, bytes]] = {}
        self._facts: dict[str, dict[str, Facts]] = {}
        self._shared: dict[tuple[str, ...], Facts] = {}
        self.seconds: defaultdict[str, float] = defaultdict(float)
        self.peak_memory = 0
        self.damage: dict[tuple[str, str], str] = {}

    def add(self, record: Record) -> None:
        """Keep a record, in place of an earlier one of that item."""
        self.forget(record.stage, record.name)
        packed = _pack(record)
        name = sys.intern(record.name)
        self._stages.setdefault(record.stage, {})[name] = packed
        apart = KEPT[1:] if packed[0] & (EXTENT | NO_EXTENT) else KEPT
        if facts := {fact: record.facts[fact] for fact in apart if fact in record.facts}:
            self._facts.setdefault(record.stage, {})[name] = self._share(facts)
        if record.damage:
            self.damage[record.stage, record.name] = record.damage
        self.peak_memory = max(self.peak_memory, record.peak_memory)
        for step, seconds in record.seconds.items():
            self.seconds[record.stage if step == "all" else f"{record.stage}: {step}"] += seconds

    def forget(self, stage: str, name: str) -> None:
        """Forget a record; nothing happens if it is not there."""
        self._stages.get(stage, {}).pop(name, None)
        self._facts.get(stage, {}).pop(name, None)

    def digest(self, stage: str, name: str) -> str:
        """Digest of a result's content, 32 hexadecimal digits; KeyError if there is no record."""
        return _digest(self._stages[stage][name])

    def made(self, stage: str, name: str) -> tuple[str, bool]:
        """Key of a result, and whether it was computed; KeyError if there is no record."""
        packed = self._stages[stage][name]
        return _key(packed), not packed[0] & REUSED

    def kept_facts(self, stage: str, name: str) -> Facts:
        """Those facts of a result that reads go by; KeyError if there is no record."""
        return _extent(self._stages[stage][name]) | self._facts.get(stage, {}).get(name, {})

    def files(self, stage: str, name: str) -> dict[str, Any]:
        """Files beside the store that a result states: read from the store; KeyError if there is no record."""
        stated: dict[str, Any] = {}
        if self._stages[stage][name][0] & FILED:
            stated = self._store.attributes(stage, name)["facts"][FILES]
        return stated

    def of(self, stage: str) -> Iterator[Record]:
        """Read the records of one stage, one at a time, by name."""
        return (self[stage, name] for name in sorted(self._stages.get(stage, {})))

    def stages(self) -> list[str]:
        """List the stages that have records, sorted."""
        return sorted(stage for stage, items in self._stages.items() if items)

    def noted(self) -> list[tuple[str, str]]:
        """List the items whose results have notes, sorted."""
        items = ((stage, name) for stage, kept in self._stages.items() for name in kept if kept[name][0] & NOTED)
        return sorted(items)

    def count_reused(self) -> dict[str, int]:
        """Count by stage the results that were there before."""
        return self._count(reused=True)

    def count_ran(self) -> dict[str, int]:
        """Count by stage the results that were made."""
        return self._count(reused=False)

    def _share(self, facts: Facts) -> Facts:
        """Lists of names are many, and mostly the same few from stage to stage: keep each once."""
        names = facts.get("names")
        if set(facts) != {"names"} or not all(type(name) is str for name in names or ()):
            return facts
        key = tuple(map(sys.intern, names or ()))
        return self._shared.setdefault(key, {"names": key})

    def _count(self, *, reused: bool) -> dict[str, int]:
        counts = {
            s: sum(bool(packed[0] & REUSED) is reused for packed in items.values())
            for s, items in self._stages.items()
        }
        return {stage: n for stage, n in sorted(counts.items()) if n}

    def __getitem__(self, item: tuple[str, str]) -> Record:
        stage, name = item
        packed = self._stages[stage][name]
        attributes: dict[str, Any] = self._store.attributes(stage, name)
        notes = count_notes(notes_from_json(attributes["notes"]))
        return Record(
            stage,
            name,
            _key(packed),
            _digest(packed),
            attributes["facts"],
            notes,
            reused=bool(packed[0] & REUSED),
            damage=self.damage.get(item, ""),
        )

    def __contains__(self, item: object) -> bool:
        return isinstance(item, tuple) and item[1] in self._stages.get(item[0], {})

    def __iter__(self) -> Iterator[tuple[str, str]]:
        return ((stage, name) for stage, items in self._stages.items() for name in items)

    def __len__(self) -> int:
        return sum(map(len, self._stages.values()))
