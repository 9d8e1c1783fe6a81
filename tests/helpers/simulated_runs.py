"""The events of a run that never was: `python -m tests.helpers.simulated_runs DIR --tiles 100000`."""

import argparse
import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from stitch.tiling.grid import Key, SeamKey
from tiler.engine.run_context import seam_name, tile_name

TILE_STAGES = ("ground", "terrain", "houses", "model", "columns", "pieces")
SIDE = 500.0  # m
BEGAN = 1.7e9  # s since 1970
NASTY = "<img src=x onerror=alert(1)>"
Event = dict[str, Any]


def simulate(
    n: int,
    *,
    done: float = 1.0,
    failed: int = 0,
    running: int = 0,
    reused: float = 0.0,
    status: str = "done",
    began: float = BEGAN,
    seed: int = 1,
) -> Iterator[Event]:
    """Tell a run of `n` tiles, in rows of a nearly square region.

    Parameters
    ----------
    n : int
        Tiles.
    done : float
        Share of the tiles that have all stages done; a tenth as many again have one.
    failed : int
        Tiles, the first ones, that fail in ``columns``.
    running : int
        Tiles whose first open stage is at work.
    reused : float
        Share of the done ones that an earlier run had done.
    status : str
        How the run ended; ``"running"`` if it has not.
    began : float
        When (s since 1970).
    seed : int
        Same seed, same events.
    """
    rng = np.random.default_rng(seed)
    width = math.ceil(math.sqrt(n))
    keys = [Key(k % width, k // width) for k in range(n)]
    there = set(keys)
    seams = [SeamKey(0, i, j) for i, j in keys if (i, j - 1) in there]
    seams += [SeamKey(1, i, j) for i, j in keys if (i - 1, j) in there]
    t = began
    head = {"command": "citystitch run city --out out", "crs": "EPSG:28992", "tile_size": SIDE, "workers": 8}
    bounds = [0.0, 0.0, width * SIDE, math.ceil(n / width) * SIDE]
    yield {"t": t, "event": "run", "status": "running", "error": "", "bounds": bounds, **head}
    boxes = [[tile_name(key), key.i * SIDE, key.j * SIDE, (key.i + 1) * SIDE, (key.j + 1) * SIDE] for key in keys]
    for k in range(0, n, 1000):
        yield {"t": t, "event": "tiles", "tiles": boxes[k : k + 1000]}
    lines = [
        [seam_name(key), key.i * SIDE, key.j * SIDE, (key.i + (key.axis == 0)) * SIDE, (key.j + key.axis) * SIDE]
        for key in seams
    ]
    for k in range(0, len(lines), 1000):
        yield {"t": t, "event": "seams", "seams": lines[k : k + 1000]}
    totals = {"points": 4, **dict.fromkeys(TILE_STAGES, n), "seams": len(seams)}
    for stage, total in totals.items():
        scope = {"points": "file", "seams": "seam"}.get(stage, "tile")
        yield {"t": t, "event": "planned", "stage": stage, "scope": scope, "total": total}
    n_done = round(done * n)
    order = np.argsort(np.arange(n) + rng.normal(0.0, 1.5 * width, n))[:n_done] if done < 1 else np.arange(n)
    whole = set(order.tolist()) - set(range(failed))
    begun = [k for k in range(failed, n) if k not in whole][: n // 10 if done < 1 else 0]
    used = set(list(whole)[: round(reused * len(whole))])
    for k in [*range(failed), *sorted(whole), *begun]:
        stages = TILE_STAGES[:4] if k < failed else TILE_STAGES if k in whole else TILE_STAGES[:1]
        for stage in stages:
            t += 0.02
            yield _done(stage, boxes[k][0], t, rng, reused=k in used)
        if k < failed:
            command = f"citystitch run out/config.toml --only {boxes[k][0]} --traceback"
            told = {"reason": f"a column does not ascend {NASTY}", "command": command}
            yield {"t": t, "event": "failed", "stage": "columns", "name": boxes[k][0], **told}
    for line in lines[: round(done * len(lines))]:
        t += 0.01
        yield _done("seams", str(line[0]), t, rng, reused=False)
    busy = whole | set(begun)
    left = [k for k in range(failed, n) if k not in busy][:running]
    for k in left:
        yield {"t": t, "event": "submitted", "stage": "ground", "name": boxes[k][0]}
    yield {"t": t, "event": "message", "text": f"left out so far: {NASTY}"}
    if status != "running":
        yield {"t": t, "event": "run", "status": status, "error": "", **head}


def write_events(folder: Path, events: Iterator[Event]) -> Path:
    """Write events as the driver does; returns the file."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "events.jsonl"
    with path.open("w") as file:
        file.writelines(json.dumps(event, separators=(",", ":")) + "\n" for event in events)
    return path


def _done(stage: str, name: str, t: float, rng: np.random.Generator, *, reused: bool) -> Event:
    facts: dict[str, float] = {}
    if stage == "columns":
        facts = {"worst_ratio": round(float(rng.uniform(0.2, 0.5)), 4), "triangles": int(rng.integers(900, 5000))}
    if stage == "pieces":
        facts = {"cells": int(rng.integers(10_000, 90_000)), "bytes": int(rng.integers(10**6, 10**7))}
    notes = {"footprint-too-small": 1} if stage == "houses" and rng.random() < 0.2 else {}
    seconds = 0.0 if reused else round(float(rng.gamma(2.0, 1.5)), 3)
    memory = int(3e8 + 2e8 * rng.random())
    event = {"t": round(t, 3), "event": "done", "stage": stage, "name": name, "seconds": seconds}
    return event | {"memory": memory, "reused": reused, "notes": notes, "facts": facts}


def main() -> None:
    """Write the events of a run into a folder."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("directory", type=Path)
    parser.add_argument("--tiles", type=int, default=100_000)
    parser.add_argument("--done", type=float, default=0.6)
    parser.add_argument("--failed", type=int, default=12)
    parser.add_argument("--running", type=int, default=8)
    parser.add_argument("--reused", type=float, default=0.0)
    parser.add_argument("--status", default="stopped")
    given = parser.parse_args()
    words = {name: getattr(given, name) for name in ("done", "failed", "running", "reused", "status")}
    print(write_events(given.directory, simulate(given.tiles, **words)))


if __name__ == "__main__":
    main()
