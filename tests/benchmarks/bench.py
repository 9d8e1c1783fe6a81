"""`make bench`: how cost grows with cells, buildings, area, workers and tile size, and where the time goes.

The first two are the paper's studies (its section 2.2): (a) cost against the number of cells, (b) against that of
buildings. What is measured is kept in docs/benchmarks.json, a study each, and docs/benchmarks.md and its pictures
are written from that: `python -m tests.benchmarks.bench cells` measures one study anew and leaves the others.
"""

import argparse
import json
import os
import re
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from tests.benchmarks.bench_report import CHOICE, DOCS, MEASURED, step_seconds, write_report
from tests.benchmarks.runs import COMMAND, citystitch, record_of, set_aside
from tiler.monitoring.events import read_events

KEPT = DOCS / "benchmarks.json"
MESH_SIZES = (20.0, 14.0, 10.0, 7.0, 5.0, 3.5, 2.5)
BUILDINGS = (100, 300, 1000, 3000, 10_000, 20_000, 50_000)
SIDES = (1000, 2000, 3000)  # m
TILES_A_SIDE = (8, 16, 32)
TILES = (250, 500, 850, 1250, 2500)  # m, on 2.5 km
PACKAGES = ("pipeline", "stitch", "tiler")
WAYS = (
    "",
    "--mesher layered",
    "--simplify paper --mesher layered",
    "--simplify paper --mesher layered --smoother fem",
)


def measure(city: Path, out: Path, *options: str, cores: int = 1, command: str = "run") -> dict[str, Any]:
    """Mesh a city; what a study keeps of run.json."""
    record = record_of(city, out, *options, cores=cores, command=command)
    return {
        "cells": record["counts"]["cells"],
        "total": record["seconds_total"],
        "command": record["seconds_of_command"],
        "steps": step_seconds(record),
        "peak": record["peak_memory_bytes"],
        "driver": record["driver_memory_bytes"],
        "tiles": record["tiles"] if isinstance(record["tiles"], int) else len(record["tiles"]),
        "ran": sum(record["ran"].values()),
        "points": record["counts"]["points read"],
        "seams": record["seconds"]["seams"],
        "columns": record["seconds"]["columns"],
        "layers": record["seconds"].get(CHOICE, 0.0),
        "seams computed": computed_seconds(record, "seams"),
        "columns computed": computed_seconds(record, "columns"),
        "written": record["seconds"]["pieces: 3.6 write pieces"] - record["seconds"]["pieces: 3.6 measure cells"],
    }


def computed_seconds(record: Mapping[str, Any], stage: str) -> float:
    """Seconds that a stage computes, without those in which it reads and writes results."""
    return float(sum(value for name, value in record["seconds"].items() if name.startswith(f"{stage}: ")))


class Cities:
    """Synthetic cities, made when they are asked for."""

    def __init__(self, home: Path) -> None:
        self.home = home

    def make(self, size: int, buildings: int, density: float = 1.5) -> Path:
        """Folder of a city of `size` metres with so many buildings, and points a square metre."""
        folder = self.home / f"city-{size}-{buildings}-{density:g}"
        if not folder.exists():
            words = ("--size", str(size), "--buildings", str(buildings), "--density", f"{density:g}")
            citystitch("synth", str(folder), *words)
        return folder


def study_cells(cities: Cities, out: Path) -> list[dict[str, Any]]:
    """(a) One kilometre with 480 buildings, in one process on one core, by mesh size."""
    city = cities.make(1000, 480)
    return [
        measure(city, out, "--mesh-size", str(size), "--workers", "0") | {"mesh size": size} for size in MESH_SIZES
    ]


def study_buildings(cities: Cities, out: Path) -> list[dict[str, Any]]:
    """(b) 6.25 km2 with more and more buildings, in one process on one core."""
    return [
        measure(cities.make(2500, n), out, "--tile-size", "625", "--workers", "0") | {"buildings": n}
        for n in BUILDINGS
    ]


def study_area(cities: Cities, out: Path) -> list[dict[str, Any]]:
    """(c) 480 buildings a km2 on more and more of them, one worker."""
    rows = []
    for side in SIDES:
        city = cities.make(side, round(480 * side**2 / 1e6))
        found = measure(city, out, "--tile-size", "500", "--workers", "1", cores=2)
        rows.append(found | {"area": side**2 / 1e6, "inner": inner_seconds(out)})
    return rows


def inner_seconds(out: Path) -> dict[str, float]:
    """Of each stage of files, tiles or seams what one that has others all around took: the median (s).

    A stage without such an item is left out. The region is a rectangle, and its items are named by where they are
    in it.
    """
    found: dict[tuple[str, str], dict[tuple[int, int], float]] = {}
    for event in read_events(out / "events.jsonl"):
        place = event["event"] == "done" and re.fullmatch(r"([xy]?)(\d+)_(\d+)", event["name"])
        if place:
            kind, x, y = place.groups()
            found.setdefault((event["stage"], kind), {})[int(x), int(y)] = event["seconds"]
    inner: dict[str, list[float]] = {}
    for (stage, _), seconds in found.items():
        columns, rows = zip(*seconds, strict=True)
        west, east, south, north = min(columns), max(columns), min(rows), max(rows)
        inner.setdefault(stage, []).extend(
            taken for (x, y), taken in seconds.items() if west < x < east and south < y < north
        )
    return {stage: median(some) for stage, some in inner.items() if some}


def study_driver(cities: Cities, out: Path) -> list[dict[str, Any]]:
    """Memory of the driver by the number of tiles, of 150 m with hardly a house, two workers."""
    rows = []
    for n in TILES_A_SIDE:
        city = cities.make(150 * n, n * n // 2, 0.5)
        found = measure(city, out, "--tile-size", "150", "--workers", "2", cores=2)
        rows.append(found | {"tiles a side": n})
    return rows


def find_waits(out: Path, workers: int, began: float) -> dict[str, float]:
    """Find how long a run took to its first task, all tasks together, and a worker without one (s).

    Parameters
    ----------
    out : Path
        Folder of the run.
    workers : int
        Number of workers.
    began : float
        When its command began (s since 1970).
    """
    done = [event for event in read_events(out / "events.jsonl") if event["event"] == "done"]
    first = min(event["t"] - event["seconds"] for event in done)
    tasks = sum(event["seconds"] for event in done)
    idle = done[-1]["t"] - first - tasks / workers
    return {"start": first - began, "tasks": tasks, "idle": idle}


def middle_ones(rows: Sequence[dict[str, Any]], *keys: str) -> list[dict[str, Any]]:
    """Of the rows with the same values of some keys the one whose run took neither longest nor shortest.

    Each with the ``totals`` of all of its kind, in their order.
    """
    kinds: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    for row in rows:
        kinds.setdefault(tuple(row[key] for key in keys), []).append(row)
    return [
        sorted(some, key=lambda row: float(row["total"]))[len(some) // 2]
        | {"totals": [row["total"] for row in some]}
        for some in kinds.values()
    ]


def study_tiles(cities: Cities, out: Path) -> list[dict[str, Any]]:
    """(d) The city of 2.5 km with tiles of several sizes, two workers."""
    city = cities.make(2500, 3000)
    return [
        measure(city, out, "--tile-size", str(size), "--workers", "2", cores=2) | {"tile size": size}
        for size in TILES
    ]


def study_fine(cities: Cities, out: Path) -> list[dict[str, Any]]:
    """The city of 2.5 km at 10, 5 and 2.5 m, in one process and with two workers, in turn; the command's time."""
    city = cities.make(2500, 3000)
    rows = []
    for size in (10.0, 5.0, 2.5):
        for n, told in ((0, "one process"), (2, "2 workers")) * (3 if size > 2.5 else 1):
            found = measure(city, out, "--mesh-size", str(size), "--workers", str(n), cores=2)
            rows.append(found | {"total": found["command"], "run as": told, "mesh size": size})
    return middle_ones(rows, "mesh size", "run as")


def study_rates(cities: Cities, out: Path) -> list[dict[str, Any]]:
    """Both meshers at 10 and 5 m, and a dense cloud; serially, tiles of the default size.

    Cities of 16 tiles at 10 m and some 30 at 5 m, and 36 million points: in less, compiled code that is read for
    the first time counts.
    """
    wide, city, dense = cities.make(5000, 12_000), cities.make(3000, 4320), cities.make(1500, 1080, 16.0)
    rows = []
    for mesher in ("adaptive", "layered"):
        for size, place in ((10.0, wide), (5.0, city)):
            found = measure(place, out, "--mesher", mesher, "--mesh-size", str(size), "--workers", "0")
            rows.append(found | {"mesher": f"{mesher}, {size:g} m"})
    rows.append(measure(dense, out, "--workers", "0") | {"mesher": "adaptive, 10 m, 1.5 km, 16 points a m2"})
    return rows


def study_ways(cities: Cities, out: Path) -> list[dict[str, Any]]:
    """The paper's own way beside ours on one kilometre, in one process on one core; the middle one of 3 runs."""
    city = cities.make(1000, 480)
    rows = [measure(city, out, "--workers", "0", *way.split()) | {"way": way} for way in WAYS * 3]
    return middle_ones(rows, "way")


def study_profile(cities: Cities, out: Path) -> list[dict[str, Any]]:
    """Samples of a serial run of the city of 2.5 km by our function that was at work, with py-spy.

    The main thread's alone, those in which it waits for zarr's threads among them.
    """
    if shutil.which("py-spy") is None:
        raise SystemExit("no py-spy; python -m pip install py-spy")
    city, raw = cities.make(2500, 3000), out.parent / "samples"
    words = [*COMMAND, "run", str(city / "tiles"), "--footprints", str(city / "footprints.shp")]
    words += ["--workers", "0", "--out", str(out)]
    set_aside(out)
    subprocess.run(
        ["py-spy", "record", "-r", "250", "-t", "-i", "-f", "raw", "-o", str(raw), "--", *words],
        check=True,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    counts = count_samples(raw.read_text().splitlines())
    total = sum(counts.values())
    rows = sorted(counts.items(), key=lambda item: -item[1])[:30]
    return [{"place": place, "share": round(n / total, 4)} for place, n in rows]


def count_samples(lines: Iterable[str]) -> dict[str, int]:
    """Count samples of the main thread by our function that was at work.

    Compiled code has no frame of its own: it counts for the function that calls it, not for what stands before it.

    Parameters
    ----------
    lines : iterable of str
        Stacks as py-spy writes them raw, from the outermost frame in, each with the number of its samples.
    """
    counts: dict[str, int] = {}
    for line in lines:
        stack, _, number = line.rpartition(" ")
        if "MainThread" not in stack:
            continue
        frames = [_frame(frame) for frame in stack.split(";")]
        ours = [frame for frame in frames if frame[0].split("/")[0] in PACKAGES]
        in_task = any(name == "run_task" for _, name in ours)
        place = ": ".join(ours[-1]) if in_task else "driver: outside of tasks"
        counts[place] = counts.get(place, 0) + int(number)
    return counts


def _frame(text: str) -> tuple[str, str]:
    """File, from its package on, and function of a sample's frame."""
    name, _, place = text.partition(" (")
    path = Path(place.rstrip(")").rpartition(":")[0])
    ours = [k for k, part in enumerate(path.parts) if part in PACKAGES]
    return "/".join(path.parts[ours[-1] :] if ours else path.parts[-2:]), name


def study_startup(cities: Cities, out: Path) -> list[dict[str, Any]]:
    """From the command to the end of its help, and to the begin of the first task of a run: medians of 7."""
    city = cities.make(1000, 480)
    found: dict[str, list[float]] = {}
    for _ in range(7):
        start = time.perf_counter()
        citystitch("--help")
        found.setdefault("the end of `citystitch --help`", []).append(time.perf_counter() - start)
        for workers in ("0", "2"):
            set_aside(out)
            began = time.time()
            record_of(city, out, "--workers", workers)
            first = find_waits(out, max(int(workers), 1), began)["start"]
            found.setdefault(f"the first task of a run with {workers} workers", []).append(first)
    return [{"until": until, "seconds": round(median(seconds), 3)} for until, seconds in found.items()]


def study_limits(cities: Cities, out: Path) -> list[dict[str, Any]]:
    """What the machine does at best: LAZ decompression alone, a copy in memory, a file written and flushed."""
    import laspy

    from tiler.pointclouds.las_chunks import FIELDS

    files = sorted((cities.make(2500, 3000) / "tiles").glob("*.laz"))
    start, n_points = time.perf_counter(), 0
    for path in files:
        with laspy.open(path, laz_backend=laspy.LazBackend.Lazrs, decompression_selection=FIELDS) as reader:
            n_points += len(reader.read().points)
    laz = n_points / (time.perf_counter() - start)
    block = np.ones(2**25)
    target = np.empty_like(block)
    start = time.perf_counter()
    for _ in range(8):
        np.copyto(target, block)
    copy = 8 * 2 * block.nbytes / (time.perf_counter() - start)
    path = out.parent / "block"
    start = time.perf_counter()
    with path.open("wb") as file:
        for _ in range(4):
            file.write(block.data)
        file.flush()
        os.fsync(file.fileno())
    disk = 4 * block.nbytes / (time.perf_counter() - start)
    path.unlink()
    return [
        {"limit": "LAZ decompression by lazrs, one core", "value": f"{laz / 1e6:.2f} M points/s"},
        {"limit": "copy in memory, read and written, one core", "value": f"{copy / 1e9:.1f} GB/s"},
        {"limit": "file written and flushed", "value": f"{disk / 1e6:.0f} MB/s"},
    ]


Study = Callable[[Cities, Path], list[dict[str, Any]]]
STUDIES: Mapping[str, Study] = {
    "cells": study_cells,
    "buildings": study_buildings,
    "area": study_area,
    "driver": study_driver,
    "tiles": study_tiles,
    "fine": study_fine,
    "rates": study_rates,
    "ways": study_ways,
    "profile": study_profile,
    "startup": study_startup,
    "limits": study_limits,
}


def main() -> None:
    """Measure the studies that are named, or all; write what is known."""
    told = "Measure studies anew, and write docs/benchmarks.md of all that is known."
    parser = argparse.ArgumentParser("python -m tests.benchmarks.bench", description=told, allow_abbrev=False)
    parser.add_argument("studies", nargs="*", metavar="STUDY", help=f"{', '.join(STUDIES)}; all by default")
    names = parser.parse_args().studies or list(STUDIES)
    if unknown := sorted(set(names) - STUDIES.keys()):
        parser.error(f"no study {unknown[0]!r}; there are {', '.join(STUDIES)}")
    kept: dict[str, Any] = json.loads(KEPT.read_text()) if KEPT.exists() else {}
    with tempfile.TemporaryDirectory() as folder:
        cities, out = Cities(Path(folder)), Path(folder) / "out"
        measure(cities.make(1000, 480), out)  # fills numba's cache
        for name in names:
            start = time.perf_counter()
            kept[name] = STUDIES[name](cities, out)
            kept.setdefault(MEASURED, {})[name] = datetime.now(UTC).date().isoformat()
            KEPT.write_text(json.dumps(kept, indent=1) + "\n")
            print(f"{name}: {time.perf_counter() - start:.0f} s", flush=True)
    write_report(kept)


if __name__ == "__main__":
    main()
