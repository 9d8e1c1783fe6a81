"""`make bench-exports`: time and memory of `citystitch export`, each format in a process of its own.

``python -m tests.benchmarks.exports FOLDER`` exports a finished run; without a folder, the synthetic city of
2.5 km of `make bench` is meshed first. The table goes into docs/benchmarks.md between markers; what is there
besides stays.
"""

import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tests.benchmarks.bench_report import REPORT
from tests.benchmarks.reliability import replace_between
from tests.benchmarks.runs import citystitch, record_of
from tiler.export.export import export_run, list_formats, load_format

BOUND = 2**30  # bytes of memory that no export may exceed: all of them stream
ALONE = "--alone"  # the process that exports once, and says what it took
PARTS = 4
BY_BUILDING = ("openfoam", "cgns", "msh", "glb")


def cases(n_tiles: int) -> list[tuple[str, dict[str, Any]]]:
    """Formats and options to measure: each format as it is, and what else changes its memory."""
    found: list[tuple[str, dict[str, Any]]] = [(name, {}) for name in list_formats()]
    found.append(("vtu", {"scalars": True}))
    found += [(name, {"buildings": "patches"}) for name in BY_BUILDING]
    if n_tiles >= PARTS:
        found.append(("openfoam", {"parts": PARTS}))
    return found


def export_alone(directory: Path, output: Path, name: str, options: Mapping[str, Any]) -> None:
    """Export in this process, and print seconds, peak memory and written bytes as JSON."""
    start = time.perf_counter()
    export_run(directory, output, name=name, options=options)
    seconds = time.perf_counter() - start
    files = [path for path in output.parent.rglob("*") if path.is_file()]
    # Linux counts in kilobytes, macOS in bytes.
    unit = 1 if sys.platform == "darwin" else 1024
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit
    print(json.dumps({"seconds": seconds, "peak": peak, "bytes": sum(path.stat().st_size for path in files)}))


def measure(directory: Path, name: str, options: Mapping[str, Any]) -> dict[str, Any]:
    """Export in a fresh process to a folder that is gone afterwards."""
    with tempfile.TemporaryDirectory() as folder:
        output = str(Path(folder) / f"city{load_format(name).suffix}")
        words = [ALONE, str(directory), output, name, json.dumps(options)]
        done = subprocess.run(
            [sys.executable, "-m", "tests.benchmarks.exports", *words], check=True, capture_output=True, text=True
        )
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


def title(name: str, options: Mapping[str, Any]) -> str:
    """Write a case as on the command line."""
    words = [f"--{key}" if value is True else f"--{key} {value}" for key, value in options.items()]
    return f"`{' '.join([name, *words])}`"


def table(record: Mapping[str, Any], rows: Sequence[tuple[str, Mapping[str, Any]]]) -> list[str]:
    """Write the measurements as Markdown."""
    counts, cells = record["counts"], record["counts"]["cells"]
    lines = [
        "## Exports",
        "",
        "Written by `make bench-exports`; do not edit. `citystitch export` of a run of",
        f"{cells / 1e6:.2f} M cells in {len(record['tiles'])} tiles, {counts['facets'] / 1e6:.2f} M facets,",
        f"{counts['buildings']:,} buildings and parts. One process a format, once; its imports are in the",
        "seconds, its memory is the most that was resident. Formats of the surface are held against the cells",
        f"too. Bound on memory: {BOUND / 2**20:.0f} MiB.",
        "",
        "| format | seconds | seconds a million cells | peak memory | written |",
        "|---|---|---|---|---|",
    ]
    for name, row in rows:
        seconds, peak, written = row["seconds"], row["peak"] / 2**20, row["bytes"] / 2**20
        lines.append(
            f"| {name} | {seconds:.1f} | {seconds / cells * 1e6:.1f} | {peak:.0f} MiB | {written:.0f} MiB |"
        )
    over = [name for name, row in rows if row["peak"] > BOUND]
    return [*lines, "", f"Above the bound: {', '.join(over) or 'none'}."]


def measure_all(directory: Path) -> int:
    """Measure all cases and write the table; 1 if one exceeds the bound."""
    record = json.loads((directory / "run.json").read_text())
    rows = []
    for name, options in cases(len(record["tiles"])):
        rows.append((title(name, options), measure(directory, name, options)))
        print(*rows[-1], flush=True)
    REPORT.write_text(replace_between(REPORT.read_text(), "exports", table(record, rows)))
    return int(any(row["peak"] > BOUND for _, row in rows))


def main(words: Sequence[str]) -> int:
    """Measure the run in a folder, or one that is made here."""
    if words and words[0] == ALONE:
        directory, output, name, options = words[1:]
        export_alone(Path(directory), Path(output), name, json.loads(options))
        return 0
    if words:
        return measure_all(Path(words[0]))
    with tempfile.TemporaryDirectory() as folder:
        city, out = Path(folder) / "city", Path(folder) / "out"
        citystitch("synth", str(city), "--size", "2500", "--buildings", "3000")
        record_of(city, out, "--workers", "2")
        return measure_all(out)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
