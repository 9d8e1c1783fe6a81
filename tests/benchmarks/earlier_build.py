"""``python -m tests.benchmarks.earlier_build PYTHON [ROUNDS]``: this build beside an earlier one, in turn.

PYTHON is the interpreter of an environment that has the earlier build. Both mesh the synthetic city of 5 km with
flat roofs, which all builds have, with two workers and with none. The medians go into docs/benchmarks.md
between markers.
"""

import json
import sys
import tempfile
import time
from pathlib import Path
from statistics import median

from tests.benchmarks.bench_report import REPORT
from tests.benchmarks.beside_the_mesh import measure
from tests.benchmarks.reliability import replace_between

CITY = ("--size", "5000", "--buildings", "12000")
Row = tuple[
    float, float, float, float
]  # wall time (s), processor time (s), memory (MiB), time to the first task (s)


def measure_run(python: str, city: Path, out: Path, *options: str) -> Row:
    """Mesh the city into a new folder with one of both builds."""
    start = time.time()
    run = ("run", "tiles", "--footprints", "footprints.shp", "--out", str(out), "--overwrite")
    wall, processor, _ = measure(*run, *options, command=(str(Path(python).parent / "citystitch"),), folder=city)
    with (out / "events.jsonl").open() as file:
        first = next(event["t"] for event in map(json.loads, file) if event["event"] == "done")
    peak = json.loads((out / "run.json").read_text())["peak_memory_bytes"]
    return wall, processor, peak / 2**20, first - start


def table(rows: dict[str, list[Row]], rounds: int) -> list[str]:
    """Write the medians as Markdown, with the ratio of both processor times."""
    lines = [
        "Written by `python -m tests.benchmarks.earlier_build PYTHON` on",
        f"{time.strftime('%Y-%m-%d')}, do not edit.",
        f"Flat roofs, `citystitch synth CITY {' '.join(CITY)}`, medians of {rounds} in turn.",
        "",
        "| run | wall (s) | processor (s) | of the earlier | largest worker | first task (s) |",
        "|---|---|---|---|---|---|",
    ]
    earlier = 1.0
    for title, found in rows.items():
        wall, processor, memory, first = (median(row[k] for row in found) for k in range(4))
        if title.startswith("earlier"):
            earlier = processor
        ratio = f"{processor / earlier:.2f}"
        lines.append(f"| {title} | {wall:.1f} | {processor:.1f} | {ratio} | {memory:.0f} MiB | {first:.1f} |")
    return lines


def main(words: list[str]) -> None:
    """Measure, and write the table."""
    rounds = int(words[1]) if words[1:] else 5
    builds = {"earlier build": (words[0], ()), "this build": (sys.executable, ("--roofs", "flat"))}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        measure("synth", str(folder / "city"), *CITY)
        rows: dict[str, list[Row]] = {}
        for turn in range(rounds + 1):
            for workers in ("2", "0"):
                for build, (python, options) in builds.items():
                    row = measure_run(python, folder / "city", folder / "out", "--workers", workers, *options)
                    print(build, workers, *(f"{value:.2f}" for value in row), flush=True)
                    if turn:  # kernels are compiled in the first
                        rows.setdefault(f"{build}, `--workers {workers}`", []).append(row)
        REPORT.write_text(replace_between(REPORT.read_text(), "earlier", table(rows, rounds)))


if __name__ == "__main__":
    main(sys.argv[1:])
