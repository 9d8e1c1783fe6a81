"""``python -m tests.benchmarks.large_city FOLDER [SIZE BUILDINGS TILE_SIZE]``: a thousand km² on two workers.

A synthetic city of 5 km is made, meshed and checked first, then one of 31.6 km: its run is killed with all of
its processes when half of its tasks are done, and run again. The table goes into docs/scaling.md by hand, with the
date and the machine. The large city takes some 45 GB below FOLDER; what is there already is not made anew.
"""

import json
import subprocess
import sys
import time
from pathlib import Path

import psutil

from tests.benchmarks.beside_the_mesh import Measured, measure
from tests.benchmarks.runs import COMMAND

LOOK = 1.0  # s between two looks at a run
SMALL = ("5000", "12000")  # side (m) and buildings
LARGE = ("31623", "480000", "700")  # and the size of tiles (m)


def kill_halfway(words: tuple[str, ...], out: Path) -> float:
    """Start a run, kill all of its processes at half of its tasks; how long it was at work (s)."""
    start = time.perf_counter()
    process = subprocess.Popen([*COMMAND, *words], stdout=subprocess.DEVNULL)
    done = total = 0
    while not total or 2 * done < total:
        time.sleep(LOOK)
        if process.poll() is not None:
            raise RuntimeError(f"{' '.join(words)}: ended before it was killed")
        try:
            stages = json.loads((out / "progress.json").read_text())["stages"]
        except (OSError, ValueError):
            continue
        done, total = (sum(stage[key] for stage in stages.values()) for key in ("done", "total"))
    tree = [*psutil.Process(process.pid).children(recursive=True), psutil.Process(process.pid)]
    for one in tree:
        one.kill()
    psutil.wait_procs(tree)
    return time.perf_counter() - start


def describe(title: str, measured: Measured, square_km: float) -> str:
    """Write a row of the table."""
    wall, processor, memory = measured
    return (
        f"| {title} | {wall:.0f} | {processor:.0f} | {wall / square_km:.2f} | {processor / square_km:.2f} | "
        f"{memory / 2**20:.0f} MiB |"
    )


def measure_city(folder: Path, size: str, buildings: str, tile_size: str, killed: bool) -> None:
    """Make, mesh and check one city, and print a row for each."""
    city, out, square_km = folder / f"city-{size}", folder / f"out-{size}", (float(size) / 1000) ** 2
    if not city.exists():
        synth = ("synth", str(city), "--size", size, "--buildings", buildings, "--workers", "2")
        print(describe(f"`{' '.join(synth)}`", measure(*synth, look=LOOK), square_km), flush=True)
    run = (
        "run", f"{city}/tiles", "--footprints", f"{city}/footprints.shp", "--out", str(out),
        "--tile-size", tile_size, "--workers", "2",
    )  # fmt: skip
    if not (out / "run.json").exists():
        if killed:
            print(f"killed after {kill_halfway(run, out):.0f} s, at half of its tasks", flush=True)
        print(describe(f"`{' '.join(run)}`", measure(*run, look=LOOK), square_km), flush=True)
    record = json.loads((out / "run.json").read_text())
    kept = ("counts", "tasks", "seconds_total", "peak_memory_bytes", "driver_memory_bytes")
    print(json.dumps({key: record[key] for key in kept}), flush=True)
    check = ("check", str(out), "--workers", "2")
    print(describe(f"`{' '.join(check)}`", measure(*check, look=LOOK), square_km), flush=True)


def main(words: list[str]) -> None:
    """Measure the small city, then the large one."""
    folder = Path(words[0])
    size, buildings, tile_size = words[1:4] or LARGE
    measure_city(folder, *SMALL, tile_size, killed=False)
    measure_city(folder, size, buildings, tile_size, killed=True)


if __name__ == "__main__":
    main(sys.argv[1:])
