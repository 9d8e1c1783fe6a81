"""``python -m tests.benchmarks.one_file FOLDER [ROUNDS]``: a km² of 25 points a m² in one LAZ file.

One worker and two mesh it in turn, in tiles of several sizes; a row of medians for each goes into docs/scaling.md
by hand, with the date and the machine.
"""

import sys
from pathlib import Path
from statistics import median

import laspy

from tests.benchmarks.bench_report import step_seconds
from tests.benchmarks.runs import citystitch, record_of

TILE_SIZES = ("250", "350")  # m
SOME = 1_000_000  # points that are in memory
MIB = 2**20


def make_city(city: Path) -> None:
    """Write a dense city, and join its point clouds to one file."""
    citystitch("synth", str(city), "--size", "1000", "--buildings", "480", "--density", "25", "--workers", "2")
    tiles = sorted((city / "tiles").iterdir())
    with laspy.open(tiles[0]) as first:
        header = laspy.LasHeader(point_format=first.header.point_format, version=first.header.version)
        header.scales, header.offsets = first.header.scales, first.header.offsets
        header.add_crs(first.header.parse_crs())
    with laspy.open(city / "tiles" / "all.laz", "w", header=header) as joined:
        for path in tiles:
            with laspy.open(path) as reader:
                for points in reader.chunk_iterator(SOME):
                    joined.write_points(points)
            path.unlink()


def main(words: list[str]) -> None:
    """Measure and print the table."""
    folder, rounds = Path(words[0]), int(words[1]) if len(words) > 1 else 3
    city, out = folder / "dense", folder / "out"
    if not city.exists():
        make_city(city)
    runs = [(size, workers) for size in TILE_SIZES for workers in ("1", "2")]
    found: dict[tuple[str, str], list[tuple[float, float, float]]] = {run: [] for run in runs}
    for _ in range(rounds):
        for size, workers in runs:
            record = record_of(city, out, "--tile-size", size, "--workers", workers)
            early = sum(seconds for step, seconds in step_seconds(record).items() if step[0] in "12")
            rate = record["counts"]["points read"] / early / 1e6
            found[size, workers].append((record["seconds_of_command"], record["peak_memory_bytes"] / MIB, rate))
            print(size, workers, *(f"{value:.2f}" for value in found[size, workers][-1]), flush=True)
    print("| tile size (m) | workers | whole command | times one worker | worker's peak | steps 1-2, points/s |")
    print("|---|---|---|---|---|---|")
    for size, workers in runs:
        wall, memory, rate = (median(values) for values in zip(*found[size, workers], strict=True))
        one = median(values[0] for values in found[size, "1"])
        print(f"| {size} | {workers} | {wall:.1f} s | {one / wall:.2f} | {memory:.0f} MiB | {rate:.2f} M |")


if __name__ == "__main__":
    main(sys.argv[1:])
