"""The page of a run of 100,000 tiles: `python -m tests.benchmarks.page --tiles 100000`.

The run is simulated, at work, with six tenths of its tiles done. Prints bytes of the first answer, of one with
nothing new and of one a hundred tasks later, as sent (gzip), what the server takes for them, and in headless
Chromium the time to the first drawing and that of a frame while the map moves.
"""

import argparse
import json
import tempfile
import time
import urllib.parse
import urllib.request
from pathlib import Path
from typing import Any

from tests.helpers.simulated_runs import simulate, write_events
from tests.tiler.dashboard.test_dashboard_page import run_browser
from tiler.dashboard.event_reader import EventReader
from tiler.dashboard.server import serve


def ask(url: str, since: int = 0, key: str = "") -> tuple[dict[str, Any], int, float]:
    """Ask for the state; gives the answer, its bytes as sent, and the seconds that it took."""
    import gzip

    words = urllib.parse.urlencode({"since": since, "key": key})
    request = urllib.request.Request(f"{url}api/state?{words}", headers={"Accept-Encoding": "gzip"})
    begin = time.perf_counter()
    with urllib.request.urlopen(request, timeout=60) as reply:
        content = reply.read()
    seconds = time.perf_counter() - begin
    answer: dict[str, Any] = json.loads(gzip.decompress(content))
    return answer, len(content), seconds


def main() -> None:
    """Measure, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tiles", type=int, default=100_000)
    parser.add_argument("--out", type=Path, help="folder for screenshots")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        folder, out = Path(place), given.out or Path(place)
        out.mkdir(parents=True, exist_ok=True)
        path = write_events(folder, simulate(given.tiles, done=0.6, failed=12, running=8, status="running"))
        follower = EventReader(folder, lambda: True)
        begin = time.process_time()
        with follower.lock:
            follower.advance(1e9)
        reading = time.process_time() - begin
        rows: list[tuple[str, str]] = [
            ("events", f"{follower.model.version:,}, {path.stat().st_size / 1e6:.0f} MB"),
            ("reading them for the first time", f"{reading:.1f} s of CPU"),
        ]
        with serve(follower, "127.0.0.1:0") as url:
            answer, size, seconds = ask(url)
            rows.append(("first answer", f"{size / 1000:.1f} kB, {1000 * seconds:.0f} ms"))
            begin = time.process_time()
            for _ in range(10):
                _, size, seconds = ask(url, answer["version"], answer["map"]["key"])
            busy = (time.process_time() - begin) / 10
            rows.append(("answer with nothing new", f"{size / 1000:.1f} kB, {1000 * busy:.0f} ms of CPU"))
            more = [
                {"t": 1.7e9 + 9e3, "event": "done", "stage": "terrain", "name": f"{k}_310", "seconds": 1.0}
                for k in range(100)
            ]
            with path.open("a") as file:
                file.writelines(json.dumps(event) + "\n" for event in more)
            _, size, _ = ask(url, answer["version"], answer["map"]["key"])
            rows.append(("answer a hundred tasks later", f"{size / 1000:.1f} kB"))
            with run_browser("benchmarks/page.js", url, out) as job:
                assert job.stdout is not None
                found = json.loads(job.stdout.read())
        for name, one in found.items():
            whole, near = one["whole"], one["near"]
            rows.append((f"{name}: first drawing", f"{one['first'] / 1000:.2f} s after the page was asked for"))
            text = f"{whole['shown']:,} squares of {whole['level']} x {whole['level']} tiles"
            rows.append(
                (f"{name}: {text}", f"drawn in {whole['draw']:.1f} ms, a frame each {whole['frame']:.1f} ms")
            )
            text = f"{near['shown']:,} tiles and {near['seams']:,} seams, zoomed in"
            rows.append(
                (f"{name}: {text}", f"drawn in {near['draw']:.1f} ms, a frame each {near['frame']:.1f} ms")
            )
        print(f"| {given.tiles:,} tiles | |\n|---|---|")
        for row in rows:
            print(f"| {row[0]} | {row[1]} |")


if __name__ == "__main__":
    main()
