"""`make bench`: time and memory of whole runs on synthetic cities, medians, written to docs/benchmarks.md.

Every figure is of a fresh process, after one run that fills numba's cache.
"""

import json
import os
import platform
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

RUNS = 3
REPORT = Path(__file__).resolve().parents[2] / "docs" / "benchmarks.md"
INGEST = ("points", "footprints")
COMMAND = [sys.executable, "-m", "tiler.cli"]


def citystitch(*arguments: str, cores: int = 2) -> None:
    """Run a command on some cores, without further threads of the numerical libraries; modules compiled once."""
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
    fixed = threads | {"PYTHONDONTWRITEBYTECODE": ""}
    pin: Callable[[], None] | None = None
    if hasattr(os, "sched_setaffinity"):
        chosen = sorted(os.sched_getaffinity(0))[:cores]
        pin = lambda: os.sched_setaffinity(0, chosen)  # noqa: E731
    subprocess.run(
        [*COMMAND, *arguments], check=True, env=os.environ | fixed, preexec_fn=pin, stdout=subprocess.DEVNULL
    )


def record_of(city: Path, out: Path, *options: str, cores: int = 2) -> dict[str, Any]:
    """Mesh the city and return what run.json says."""
    footprints = ("--footprints", str(city / "footprints.shp"))
    citystitch("run", str(city / "tiles"), *footprints, "--out", str(out), "--overwrite", *options, cores=cores)
    record: dict[str, Any] = json.loads((out / "run.json").read_text())
    return record


def stage_seconds(record: dict[str, Any]) -> dict[str, float]:
    """Seconds of each stage, all items together."""
    return {name: seconds for name, seconds in record["seconds"].items() if ": " not in name}


def after_ingest(record: dict[str, Any]) -> float:
    """Wall time of the stages after those that read the input (s)."""
    begin = max(record["finished"][stage] for stage in INGEST)
    return float(max(record["finished"].values()) - begin)


def summarise(records: list[dict[str, Any]]) -> dict[str, Any]:
    """Medians over runs that differ in nothing."""
    total = [record["seconds_total"] for record in records]
    return {
        "cells": records[0]["counts"]["cells"],
        "total": median(total),
        "spread": (min(total), max(total)),
        "after": median(after_ingest(record) for record in records),
        "peak": median(record["peak_memory_bytes"] for record in records),
        "driver": median(record["driver_memory_bytes"] for record in records),
        "stages": {
            name: median(stage_seconds(record)[name] for record in records) for name in stage_seconds(records[0])
        },
    }


def main() -> None:
    """Measure and write the report."""
    with tempfile.TemporaryDirectory() as folder:
        home = Path(folder)
        out = home / "out"
        cities = {size: home / f"city{size}" for size in (1000, 2000, 2500, 4000)}
        for size, buildings in ((1000, 480), (2000, 1920), (2500, 3000), (4000, 7680)):
            citystitch("synth", str(cities[size]), "--size", str(size), "--buildings", str(buildings))
        record_of(cities[1000], out)
        # Runs to compare take turns, so that what else the machine does falls on all of them.
        by_workers: dict[str, list[dict[str, Any]]] = {"0": [], "1": [], "2": []}
        for _ in range(RUNS):
            for workers, records in by_workers.items():
                records.append(record_of(cities[2500], out, "--workers", workers))
        by_area = {
            size: summarise([record_of(cities[size], out, "--tile-size", "500", "--workers", "1")])
            for size in (1000, 2000, 4000)
        }
        by_mesh = {
            title: summarise([record_of(cities[1000], out, *options, cores=1) for _ in range(RUNS)])
            for title, options in (
                ("`--mesh-size 10`", ()),
                ("the paper's way, 10 m", ("--simplify", "paper", "--mesher", "layered")),
                ("`--mesh-size 5`", ("--mesh-size", "5")),
            )
        }
    text = report({name: summarise(records) for name, records in by_workers.items()}, by_area, by_mesh)
    # What other benchmarks have written stands behind, between their markers.
    _, marker, others = REPORT.read_text().partition("\n<!-- ")
    REPORT.write_text(text + marker + others)
    print(text)


def report(
    by_workers: dict[str, dict[str, Any]], by_area: dict[int, dict[str, Any]], by_mesh: dict[str, dict[str, Any]]
) -> str:
    """Write the measurements as Markdown."""
    lines = [
        "# Benchmarks",
        "",
        "Written by `make bench`; do not edit. Synthetic cities (`citystitch synth`), `citystitch run CITY/tiles",
        "--footprints CITY/footprints.shp`, LAZ to written pieces, numba's cache warm. The machine is shared:",
        "compare within a table.",
        "",
        f"Machine: {os.cpu_count()} cores, {platform.machine()}, Python {platform.python_version()}.",
        "",
        "## A city of 2.5 km with 3,000 buildings at 10 m",
        "",
        f"Medians of {RUNS} runs that take turns. *After ingest* is the wall time of all stages but those that",
        "read LAZ and SHP; the ratio is that of 1 worker to this row. Peak memory is of the largest process that",
        "runs tasks.",
        "",
        "| workers | cells | whole run (min-max) | after ingest | ratio | peak memory | driver |",
        "|---|---|---|---|---|---|---|",
    ]
    one = by_workers["1"]["after"]
    for name, row in by_workers.items():
        spread = f"{row['spread'][0]:.1f}-{row['spread'][1]:.1f}"
        lines.append(
            f"| {name} | {row['cells'] / 1e6:.2f} M | {row['total']:.1f} s ({spread}) | {row['after']:.1f} s "
            f"| {one / row['after']:.2f} | {row['peak'] / 2**20:.0f} MiB | {row['driver'] / 2**20:.0f} MiB |"
        )
    lines += [
        "",
        "## Area",
        "",
        "480 buildings a km², tiles of 500 m, one worker, one run each.",
        "",
        "| area | tiles | cells | whole run | worker's peak | driver and scheduler |",
        "|---|---|---|---|---|---|",
    ]
    for size, row in by_area.items():
        n_tiles = (size // 500) ** 2
        lines.append(
            f"| {size**2 / 1e6:.0f} km² | {n_tiles} | {row['cells'] / 1e6:.2f} M | {row['total']:.1f} s "
            f"| {row['peak'] / 2**20:.0f} MiB | {row['driver'] / 2**20:.0f} MiB |"
        )
    lines += [
        "",
        "## One kilometre with 480 buildings, one process on one core",
        "",
        f"Medians of {RUNS} runs.",
        "",
        "| run | cells | whole run (min-max) | seams and columns | cells/s in these | peak memory |",
        "|---|---|---|---|---|---|",
    ]
    for title, row in by_mesh.items():
        spread = f"{row['spread'][0]:.1f}-{row['spread'][1]:.1f}"
        meshing = row["stages"]["seams"] + row["stages"]["columns"]
        lines.append(
            f"| {title} | {row['cells'] / 1e6:.2f} M | {row['total']:.1f} s ({spread}) | {meshing:.2f} s "
            f"| {row['cells'] / meshing / 1e6:.1f} M | {row['peak'] / 2**20:.0f} MiB |"
        )
    lines += ["", "| stage | 10 m, seconds | 5 m, seconds |", "|---|---|---|"]
    fine, coarse = by_mesh["`--mesh-size 5`"]["stages"], by_mesh["`--mesh-size 10`"]["stages"]
    lines += [f"| `{name}` | {seconds:.2f} | {fine[name]:.2f} |" for name, seconds in coarse.items()]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
