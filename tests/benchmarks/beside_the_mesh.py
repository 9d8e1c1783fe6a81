"""``python -m tests.benchmarks.beside_the_mesh [ROUNDS]``: what surrounds a run, as ratios to the run beside it.

The synthetic city of 2.5 km is meshed with two workers, and what comes after it is done in turn, round after
round, in fresh processes. Wall time and processor time (user and system, of all processes) are medians of the
rounds; on a busy machine the latter says more. The table goes into docs/benchmarks.md between markers.
"""

import ctypes
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from statistics import median

import psutil

from tests.benchmarks.bench_report import REPORT
from tests.benchmarks.reliability import replace_between
from tests.benchmarks.runs import COMMAND

SUBREAPER = 36  # PR_SET_CHILD_SUBREAPER of Linux: orphaned workers are ours to wait for, so that their time counts
LOOK = 0.03  # s between two looks at the memory of processes
Measured = tuple[float, float, int]  # wall time (s), processor time (s), largest resident process (bytes)


def measure(
    *words: str, look: float = LOOK, command: Sequence[str] = COMMAND, folder: Path | None = None
) -> Measured:
    """Run a command of ours, and measure all processes that it starts, by a look at them every `look` s."""
    ctypes.CDLL(None).prctl(SUBREAPER, 1, 0, 0, 0)
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    environment = os.environ | dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    environment["PYTHONDONTWRITEBYTECODE"] = ""  # modules are compiled once, as where they are installed
    process = subprocess.Popen([*command, *words], stdout=subprocess.DEVNULL, env=environment, cwd=folder)
    peak, ended = [0], threading.Event()

    def watch() -> None:
        while not ended.wait(look):
            for child in psutil.Process().children(recursive=True):
                try:
                    peak[0] = max(peak[0], child.memory_info().rss)
                except psutil.Error:  # it has just ended
                    continue

    watching = threading.Thread(target=watch)
    watching.start()
    code = process.wait()
    wall = time.perf_counter() - start
    try:
        while True:
            os.wait()
    except ChildProcessError:
        ended.set()
        watching.join()
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    if code not in (0, 3):
        raise RuntimeError(f"{' '.join(words)}: exit code {code}")
    return wall, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, peak[0]


def list_commands(folder: Path) -> dict[str, tuple[str, ...]]:
    """Commands by their line in the table; the run is the first."""
    city, out = str(folder / "city"), str(folder / "out")
    run = (
        "run", f"{city}/tiles", "--footprints", f"{city}/footprints.shp", "--out", out, "--workers", "2",
    )  # fmt: skip
    pictures = {
        f"`render --what {what}`": ("render", out, "--what", what, "-o", str(folder / f"{what}.png"))
        for what in ("boundary", "mesh", "overview", "tiles")
    }
    exports = {
        f"`export --format {kind}{more}`": (
            *("export", out, "--format", kind, "-o", str(folder / f"case.{kind}"), "--overwrite"),
            *more.split(),
        )
        for kind in ("openfoam", "vtu")
        for more in ("", " --workers 2")
    }
    size = ("--size", "2500", "--buildings", "3000")
    return {
        "`run --workers 2`": (*run, "--overwrite"),
        "the same again, nothing to do": run,
        "`plan` of 1,000 files": ("plan", str(folder / "many"), "--footprints", f"{city}/footprints.shp"),
        "`check --workers 2`": ("check", out, "--workers", "2"),
        "`check`": ("check", out),
        **pictures,
        **exports,
        "`report`": ("report", out),
        "`synth --size 2500 --buildings 3000`": ("synth", str(folder / "again"), *size),
        "the same with `--workers 2`": ("synth", str(folder / "more"), *size, "--workers", "2"),
    }


def table(rows: dict[str, list[Measured]]) -> list[str]:
    """Write the medians as Markdown."""
    first = next(iter(rows.values()))
    lines = [
        "## Beside the mesh",
        "",
        f"Written by `python -m tests.benchmarks.beside_the_mesh` on {time.strftime('%Y-%m-%d')}; do not edit.",
        "The city of 2.5 km (`citystitch synth CITY --size 2500 --buildings 3000`), medians of "
        f"{len(first)} in turn,",
        f"on two cores (load at the end {os.getloadavg()[0]:.1f}); processor time is user and system, of all",
        "processes. The run has two workers: on two free cores the ratio in wall time of what is one process is",
        "up to twice that in processor time. Memory is that of the largest process.",
        "",
        "| command | wall (s) | of the run | processor (s) | of the run | memory |",
        "|---|---|---|---|---|---|",
    ]
    whole = [median(one[k] for one in first) for k in range(2)]
    for name, found in rows.items():
        wall, processor, memory = (median(one[k] for one in found) for k in range(3))
        lines.append(
            f"| {name} | {wall:.1f} | {wall / whole[0]:.2f} | {processor:.1f} | {processor / whole[1]:.2f} | "
            f"{memory / 2**20:.0f} MiB |"
        )
    return lines


def main(words: list[str]) -> None:
    """Measure, and write the table after each round."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        measure("synth", str(folder / "city"), "--size", "2500", "--buildings", "3000")
        (folder / "many").mkdir()
        for path in (folder / "city" / "tiles").iterdir():  # 25 files, each by 40 names
            for k in range(40):
                os.link(path, folder / "many" / f"{k}_{path.name}")
        commands = list_commands(folder)
        for title in ("`run --workers 2`", "`check`"):  # kernels are compiled and files cached
            measure(*commands[title])
        rows: dict[str, list[Measured]] = {title: [] for title in commands}
        for _ in range(int(words[0]) if words else 3):
            for title, command in commands.items():
                for old in ("again", "more", "case.openfoam"):
                    shutil.rmtree(folder / old, ignore_errors=True)
                rows[title].append(measure(*command))
                print(
                    title, *(f"{value:.2f}" for value in rows[title][-1][:2]), rows[title][-1][2] >> 20, flush=True
                )
            REPORT.write_text(replace_between(REPORT.read_text(), "beside", table(rows)))


if __name__ == "__main__":
    main(sys.argv[1:])
