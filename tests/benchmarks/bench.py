"""`make bench`: time and memory of whole runs on the synthetic city, medians, written to docs/benchmarks.md.

Every figure is of a fresh process on one core, after one run that fills numba's cache.
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

RUNS = 5
REPORT = Path(__file__).resolve().parents[2] / "docs" / "benchmarks.md"
MESHING = ("3.1 plane mesh", "3.2-3.5 columns")
COMMAND = [sys.executable, "-m", "tiler.cli"]


def citystitch(*arguments: str) -> None:
    """Run a command on one core, without further threads of the numerical libraries."""
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
    pin: Callable[[], None] | None = None
    if hasattr(os, "sched_setaffinity"):
        core = min(os.sched_getaffinity(0))
        pin = lambda: os.sched_setaffinity(0, {core})  # noqa: E731
    subprocess.run(
        [*COMMAND, *arguments], check=True, env=os.environ | threads, preexec_fn=pin, stdout=subprocess.DEVNULL
    )


def record_of(city: Path, out: Path, *options: str) -> dict[str, Any]:
    """Mesh the city and return what run.json says."""
    footprints = str(city / "footprints.shp")
    citystitch("run", str(city / "tiles"), "--footprints", footprints, "--out", str(out), "--overwrite", *options)
    record: dict[str, Any] = json.loads((out / "run.json").read_text())
    return record


def measure(city: Path, out: Path, *options: str) -> dict[str, Any]:
    """Medians over fresh runs."""
    records = [record_of(city, out, *options) for _ in range(RUNS)]
    steps = records[0]["seconds"]
    meshing = median(sum(record["seconds"][step] for step in MESHING) for record in records)
    return {
        "cells": records[0]["counts"]["cells"],
        "total": median(record["seconds_total"] for record in records),
        "spread": [min(r["seconds_total"] for r in records), max(r["seconds_total"] for r in records)],
        "steps": {step: median(record["seconds"][step] for record in records) for step in steps},
        "meshing": meshing,
        "peak": median(record["peak_memory_bytes"] for record in records),
    }


def main() -> None:
    """Measure and write the report."""
    with tempfile.TemporaryDirectory() as folder:
        city, out = Path(folder) / "city", Path(folder) / "out"
        citystitch("synth", str(city), "--size", "1000", "--buildings", "500")
        record_of(city, out)
        coarse = measure(city, out)
        fine = measure(city, out, "--mesh-size", "5")
        layers = measure(city, out, "--simplify", "paper", "--mesher", "layered")
    text = report(coarse, fine, layers)
    REPORT.write_text(text)
    print(text)


def report(coarse: dict[str, Any], fine: dict[str, Any], layers: dict[str, Any]) -> str:
    """Write the measurements as Markdown."""
    slope = (fine["peak"] - coarse["peak"]) / (fine["cells"] - coarse["cells"])
    lines = [
        "# Benchmarks",
        "",
        "Written by `make bench`; do not edit. Synthetic city of 1 km, 500 buildings (`citystitch synth CITY`);",
        "`citystitch run CITY/tiles --footprints CITY/footprints.shp`, LAZ to written mesh, in one process on one",
        f"core with numba's cache warm; medians of {RUNS} runs. The machine is shared: compare within a table.",
        "",
        f"Machine: {os.cpu_count()} cores, {platform.machine()}, Python {platform.python_version()}.",
        "",
        "| run | cells | whole run (min-max) | steps 3.1-3.5 | cells/s in 3.1-3.5 | peak memory | bytes/cell |",
        "|---|---|---|---|---|---|---|",
    ]
    for title, row in (
        ("`--mesh-size 10`", coarse),
        ("the paper's way, 10 m", layers),
        ("`--mesh-size 5`", fine),
    ):
        spread = f"{row['spread'][0]:.1f}-{row['spread'][1]:.1f}"
        lines.append(
            f"| {title} | {row['cells'] / 1e6:.2f} M | {row['total']:.1f} s ({spread}) | {row['meshing']:.2f} s "
            f"| {row['cells'] / row['meshing'] / 1e6:.1f} M | {row['peak'] / 2**20:.0f} MiB "
            f"| {row['peak'] / row['cells']:.0f} |"
        )
    lines += [
        "",
        f"Memory grows by {slope:.0f} bytes for each further cell (from mesh size 10 to 5 m); the rest is Python",
        "with its libraries, and the point cloud.",
        "",
        "| step | 10 m, seconds | 5 m, seconds |",
        "|---|---|---|",
    ]
    lines += [
        f"| {step} | {seconds:.2f} | {fine['steps'][step]:.2f} |" for step, seconds in coarse["steps"].items()
    ]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
