"""What the page of a run costs it: `python -m tests.benchmarks.watching_page --pairs 5`.

Runs a synthetic city of 1 km2 in pairs, without a page and with one that is asked every second as an open browser
does, and scraped as often as Prometheus does; the order changes from pair to pair. What is compared is processor
time, user and system, of the run and all its processes: wall time tells more of the machine's other users. As the
difference is less than what one run differs from the next, a row tells what an answer takes the server of the
finished run, too: asked every second, that is the page's share of one core.
"""

import argparse
import json
import os
import re
import statistics
import subprocess
import tempfile
import threading
import time
import urllib.parse
import urllib.request
from collections.abc import Sequence
from pathlib import Path

from tests.benchmarks.runs import COMMAND, citystitch

SCRAPE = 15  # s between two scrapes; the page asks every second


def run_once(words: Sequence[str], *, watched: bool) -> tuple[float, int]:
    """Run a command to its end; gives its processor time (s), and how often its page was asked."""
    begin = os.times()
    place = os.environ | {"PYTHONUNBUFFERED": "1"}
    options = ["--dashboard-address", "127.0.0.1:0"] if watched else ["--no-dashboard"]
    asked = 0
    with subprocess.Popen([*words, *options], stdout=subprocess.PIPE, text=True, env=place) as job:
        assert job.stdout is not None
        over = threading.Event()
        thread = None
        for line in job.stdout:
            found = re.search(r"dashboard: (http://\S+)", line)
            if found:
                thread = Reader(found[1], over)
                thread.start()
        code = job.wait()
    over.set()
    if thread is not None:
        thread.join()
        asked = thread.asked
    if code:
        raise SystemExit(f"{' '.join(words)}: exit code {code}")
    end = os.times()
    return end.children_user + end.children_system - begin.children_user - begin.children_system, asked


def cost_of_answer(out: Path, asked: int = 300) -> float:
    """Processor time (s) that the server of a run's folder takes to answer a page that is open."""
    words = [*COMMAND, "dashboard", str(out)]
    place = os.environ | {"PYTHONUNBUFFERED": "1"}
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True, env=place) as job:
        assert job.stdout is not None
        found = re.search(r"dashboard: (http://\S+)", job.stdout.readline())
        assert found
        reader = Reader(found[1], threading.Event())
        for _ in range(10):
            reader.ask()
        begin = time_of(job.pid)
        for _ in range(asked):
            reader.ask()
        taken = time_of(job.pid) - begin
        job.terminate()
    return taken / asked


def time_of(pid: int) -> float:
    """Processor time (s) of a process so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


class Reader(threading.Thread):
    """Asks as a browser does, once a second for what is new, and as Prometheus does."""

    def __init__(self, url: str, over: threading.Event) -> None:
        super().__init__(daemon=True)
        self.url, self.over, self.asked = url, over, 0
        self.since, self.key = 0, ""

    def run(self) -> None:
        """Ask until the run is over."""
        scraped = time.monotonic()
        while not self.over.wait(1.0):
            try:
                self.ask()
                if time.monotonic() - scraped > SCRAPE:
                    scraped = time.monotonic()
                    urllib.request.urlopen(f"{self.url}metrics", timeout=10).read()
            except OSError:
                continue

    def ask(self) -> None:
        """Ask for what is new, as the page does."""
        words = urllib.parse.urlencode({"since": self.since, "key": self.key})
        with urllib.request.urlopen(f"{self.url}api/state?{words}", timeout=10) as reply:
            answer = json.load(reply)
        self.since, self.key = answer["version"], answer["map"]["key"]
        self.asked += 1


def main() -> None:
    """Measure, and print a row for each number of workers."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pairs", type=int, default=5)
    parser.add_argument("--workers", type=int, nargs="*", default=[0, 2])
    parser.add_argument("--size", type=float, default=1000.0, help="side of the city (m)")
    parser.add_argument("--buildings", type=int, default=500)
    parser.add_argument("--tile-size", type=float, default=250.0)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        city, out = Path(folder, "city"), Path(folder, "out")
        citystitch("synth", str(city), "--size", str(given.size), "--buildings", str(given.buildings))
        words = [*COMMAND, "run", str(city / "tiles"), "--footprints", str(city / "footprints.gpkg")]
        words += ["--out", str(out), "--overwrite", "--tile-size", str(given.tile_size)]
        print("| workers | pairs | CPU without a page (s) | with one (s) | difference | asked |")
        print("|---|---|---|---|---|---|")
        for workers in given.workers:
            one = [*words, "--workers", str(workers)]
            run_once(one, watched=False)  # what is compiled is kept
            pairs: list[tuple[float, float]] = []
            asked = 0
            for k in range(given.pairs):
                found = {}
                for watched in (False, True) if k % 2 == 0 else (True, False):
                    found[watched], times = run_once(one, watched=watched)
                    asked += times
                pairs.append((found[False], found[True]))
            shares = [100 * (after / before - 1) for before, after in pairs]
            spread = statistics.stdev(shares) / len(shares) ** 0.5 if len(shares) > 1 else float("nan")
            before, after = (statistics.mean(pair[side] for pair in pairs) for side in (0, 1))
            told = f"{statistics.mean(shares):+.2f} ± {spread:.2f} %"
            print(f"| {workers} | {len(pairs)} | {before:.2f} | {after:.2f} | {told} | {asked} |", flush=True)
        cost = cost_of_answer(out)
        print(f"\nAn answer takes {1000 * cost:.1f} ms of CPU: asked every second, {100 * cost:.2f} % of a core.")


if __name__ == "__main__":
    main()
