"""What a simulated task comes to: time, size and facts of tasks of real runs, ``recorded.json`` by tile size."""

import json
import zlib
from collections import defaultdict
from contextlib import nullcontext
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from stitch.tiling.grid import Key
from tests.helpers.told import Told
from tiler.config.config import Config
from tiler.engine.engine import Engine
from tiler.engine.executor import Serial
from tiler.engine.run_context import tile_key, tile_name
from tiler.engine.stage import Box, Facts, Scope
from tiler.engine.task import Record
from tiler.planning.own_stages import OwnStages
from tiler.planning.plan import make_plan
from tiler.store.store import Store
from tiler.workflow.stage_sequence import make_engine, run_stages

PATH = Path(__file__).with_name("recorded.json")
KEPT = 6  # tasks of each stage that are kept, evenly among all by their time
BORDERS = 4  # neighbours of a tile that is no border tile


@dataclass(frozen=True)
class Recorded:
    """A task of a real run."""

    seconds: float  #: its wall time (s)
    stored: int  #: bytes of its result in the store
    stored_files: int  #: number of files of these
    written: int  #: bytes of the files beside the store that it states
    written_files: int  #: number of these
    #: its facts; ``"extent"`` from the lower left of its box, ``"names"`` by columns and rows from its own
    facts: Facts
    notes: int  #: number of its notes


@cache
def recorded_stages(tile_size: float) -> dict[str, list[Recorded]]:
    """Read the recorded tasks of a tile size (m) by stage.

    Raises
    ------
    KeyError
        For a tile size that was not recorded, and later on for such a stage.
    """
    found = json.loads(PATH.read_text())[f"{tile_size:g}"]
    return {stage: [Recorded(**task) for task in tasks] for stage, tasks in found["stages"].items()}


def choose(tile_size: float, stage: str, name: str) -> Recorded:
    """Choose the recorded task that stands for an item, always the same one."""
    stages = recorded_stages(tile_size)
    tasks = stages[stage if stage in stages else f"{stage.rstrip('0123456789')}1"]
    return tasks[draw(stage, name) % len(tasks)]


def draw(*words: str) -> int:
    """Draw a number below 2**32 that follows from words alone."""
    return zlib.crc32("\0".join(words).encode())


def make_facts(task: Recorded, scope: Scope, name: str, box: Box) -> Facts:
    """Put the facts of a recorded task to another place."""
    facts = dict(task.facts)
    if facts.get("extent"):
        x, y = box[:2]
        low_x, low_y, high_x, high_y = facts["extent"]
        facts["extent"] = [x + low_x, y + low_y, x + high_x, y + high_y]
    if scope is Scope.TILE and "names" in facts:
        facts["names"] = [name] if facts["names"] else []
    return facts


def record(config: Config) -> dict[str, Any]:
    """Run a city in this process, and keep some tasks of each stage; ``out`` must be empty."""
    done: dict[str, list[tuple[float, Record]]] = defaultdict(list)

    def keep(stage: str, _: int, __: int, found: Record) -> None:
        done[stage].append((found.seconds["all"], found))

    plan = make_plan(config, print)
    out = Path(config.out)
    for folder in ("mesh", "boundary"):
        (out / folder).mkdir(parents=True)
    with nullcontext(Serial()) as executor:
        engine = make_engine(config, out, plan, executor, OwnStages(), Told(keep))
        rounds = run_stages(engine, config)
    stages = {}
    for stage, tasks in done.items():
        ordered = sorted((task for task in tasks if _is_inner(engine, task[1])), key=lambda one: one[0])
        chosen = ordered[:: max(len(ordered) // KEPT, 1)][:KEPT]
        stages[stage] = [vars(_describe(engine, seconds, found)) for seconds, found in chosen]
    counts = {stage: len(tasks) for stage, tasks in done.items()}
    return {"tile_size": config.tile_size, "rounds": rounds, "tasks": counts, "stages": stages}


def _is_inner(engine: Engine, found: Record) -> bool:
    """Whether a tile has all its neighbours; other items count as they are."""
    if found.name not in engine.layout.tiles:
        return True
    i, j = tile_key(found.name)
    around = [Key(i - 1, j), Key(i + 1, j), Key(i, j - 1), Key(i, j + 1)]
    return sum(tile_name(key) in engine.layout.tiles for key in around) == BORDERS


def _describe(engine: Engine, seconds: float, found: Record) -> Recorded:
    file = Store(engine.store.path).file(found.stage, found.name)
    written = found.facts.get("files", {})
    facts = dict(found.facts)
    if facts.get("extent") and found.name in engine.layout.tiles:
        x, y, _, _ = engine.layout.tiles[found.name]
        facts["extent"] = [value - low for value, low in zip(facts["extent"], (x, y, x, y), strict=True)]
    sizes = [entry[0] if isinstance(entry, list) else entry["size"] for entry in written.values()]
    return Recorded(seconds, file.stat().st_size, 1, sum(sizes), len(sizes), facts, sum(found.notes.values()))
