"""`make reliability`: run the campaigns, and write their tables into docs/reliability.md between markers.

A campaign is tests that are marked `long` and write their outcomes as JSON into the folder that the environment
variable ``CITYSTITCH_RELIABILITY`` names, which has them run all their rounds, too (`tests.helpers.campaigns`).
Another one is an entry of `CAMPAIGNS`: the tests, and a function that makes lines of Markdown of its JSON.
``--from FOLDER`` writes the tables of outcomes that are there already.
"""

import json
import os
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
REPORT = ROOT / "docs" / "reliability.md"
CODES = ("0", "1", "2", "3")
# Tests of drawn cities and properties that have more rounds too, but no table.
WITHOUT_TABLE = (
    *("tests/pipeline", "tests/stitch", "tests/tiler/citymodels"),
    *("tests/runs/test_sloped_runs.py", "tests/runs/test_disk_faults.py"),
)


def fuzz_table(record: Any) -> list[str]:
    """Make the table of the fuzz campaign: cases by exit code."""
    lines = ["| family | cases | 0 | 1 | 2 | 3 | other | slowest, s |", "|---|---|---|---|---|---|---|---|"]
    total = [0] * (len(CODES) + 2)
    for family, found in record.items():
        counts = [found["codes"].get(code, 0) for code in CODES]
        row = [found["cases"], *counts, found["cases"] - sum(counts)]
        total = [a + b for a, b in zip(total, row, strict=True)]
        lines.append(f"| {family} | {' | '.join(map(str, row))} | {found['slowest']:g} |")
    slowest = max((found["slowest"] for found in record.values()), default=0.0)
    return [*lines, f"| **all** | {' | '.join(map(str, total))} | {slowest:g} |"]


TENTHS = 10  # of the results of a run


def cross_table(cells: Counter[tuple[str, str]], title: str) -> list[str]:
    """Make a table of counts by row and column, with sums; both in the order in which they are met."""
    rows, columns = (list(dict.fromkeys(cell[k] for cell in cells)) for k in (0, 1))
    lines = [f"| {title} | {' | '.join(columns)} | all |", "|---" * (len(columns) + 2) + "|"]
    for row in rows:
        counts = [cells[row, column] for column in columns]
        lines.append(f"| {row} | {' | '.join(map(str, counts))} | {sum(counts)} |")
    sums = [sum(cells[row, column] for row in rows) for column in columns]
    return [*lines, f"| **all** | {' | '.join(map(str, sums))} | {sum(sums)} |"]


def find_share(done: int, total: int) -> str:
    """Tell about how much of a run was done.

    Examples
    --------
    >>> [find_share(n, 513) for n in (0, 100, 512, 513)]
    ['0 to 10 %', '10 to 20 %', '90 to 100 %', 'all, but not indexes, manifest and record']
    """
    if done >= total:
        return "all, but not indexes, manifest and record"
    tenth = TENTHS * done // total
    return f"{10 * tenth} to {10 * tenth + 10} %"


def kills_table(record: Any) -> list[str]:
    """Make the table of the kills: how much was done by what was killed."""
    found = Counter(
        (find_share(kill["results"], run["results"]), kill["kind"]) for run in record for kill in run["kills"]
    )
    kinds = list(dict.fromkeys(kind for _, kind in found))
    shares = [find_share(k, TENTHS) for k in range(TENTHS + 1)]
    cells = Counter({(share, kind): found[share, kind] for share in shares for kind in kinds})
    seeds = ", ".join(f"{run['round']} {run['seed']}" for run in record)
    return [*cross_table(cells, "results there"), "", f"{len(record)} runs ended, by kind and seed: {seeds}."]


def faults_table(record: Any) -> list[str]:
    """Make the table of the injected faults: stage by kind."""
    cells = Counter((stage, kind) for run in record for stage, kind in run["kinds"].items())
    seeds = ", ".join(str(run["seed"]) for run in record if "seed" in run)
    missing = sum(run.get("missing", 0) for run in record)
    return [
        *cross_table(cells, "stage"),
        "",
        f"{len(record)} runs; {missing} tiles were missing before the repair. Seeds: {seeds}.",
    ]


def damage_table(record: Any) -> list[str]:
    """Make the table of the damaged artefacts: kind of artefact by what was done to it."""
    cells: Counter[tuple[str, str]] = Counter()
    for run in record:
        for kind, n in run["kinds"].items():
            cells[kind, run["what"]] += n
    seeds = sorted({run["seed"] for run in record})
    return [*cross_table(cells, "artefact"), "", f"{len(record)} runs, seeds {seeds[0]} to {seeds[-1]}."]


def rebuild_table(record: Any) -> list[str]:
    """Make the table of the rebuild after one footprint was moved."""
    lines = ["| tiles | tasks | ran | share | s | whole run, s | share |", "|---|---|---|---|---|---|---|"]
    for run in record:
        tasks, seconds = run["ran"] / run["all"], run["seconds"] / run["seconds_whole"]
        counts = f"| {run['tiles']} | {run['all']} | {run['ran']} | {tasks:.0%} "
        lines.append(f"{counts}| {run['seconds']:.1f} | {run['seconds_whole']:.1f} | {seconds:.0%} |")
    return lines


def cities_table(record: Any) -> list[str]:
    """Make the table of the random cities that were meshed and proved: by mesher and simplification."""
    lines = ["| way | cities | tiles | buildings | cells |", "|---|---|---|---|---|"]
    ways: dict[str, list[Any]] = {}
    for run in record:
        ways.setdefault(run["way"], []).append(run)
    for way, runs in [*sorted(ways.items()), ("**all**", record)]:
        tiles, buildings, cells = (sum(run[what] for run in runs) for what in ("tiles", "buildings", "cells"))
        lines.append(f"| {way} | {len(runs)} | {tiles:,} | {buildings:,} | {cells / 1e6:.1f} M |")
    return lines


# By the name of the JSON file and of the markers.
CAMPAIGNS: dict[str, tuple[tuple[str, ...], Callable[[Any], list[str]]]] = {
    "kills": (("tests/runs/test_kill_campaign.py",), kills_table),
    "faults": (("tests/runs/test_fault_campaign.py",), faults_table),
    "damage": (("tests/tiler/store/test_store_audit.py", "tests/tiler/store/test_power_loss.py"), damage_table),
    "rebuild": (("tests/runs/test_rebuild.py",), rebuild_table),
    "cities": (
        (
            "tests/runs/test_tiled_runs.py::test_random_tiled_cities_are_meshed_and_proved",
            "tests/runs/test_run.py::test_random_cities_are_meshed_and_proved",
        ),
        cities_table,
    ),
    "fuzz-input": (("tests/runs/test_fuzz_input.py",), fuzz_table),
}


def replace_between(text: str, name: str, lines: Sequence[str]) -> str:
    """Put lines between the markers of a name.

    Examples
    --------
    >>> replace_between("a <!-- x -->old<!-- /x --> b", "x", ["new"])
    'a <!-- x -->\\nnew\\n<!-- /x --> b'
    """
    before, rest = text.split(f"<!-- {name} -->")
    _, after = rest.split(f"<!-- /{name} -->")
    return f"{before}<!-- {name} -->\n" + "\n".join(lines) + f"\n<!-- /{name} -->{after}"


def run_campaign(name: str, folder: Path) -> bool:
    """Run the tests of a campaign and write its table; False if one of them failed."""
    passed = run_tests(["-m", "long", *CAMPAIGNS[name][0]], folder)
    write_tables(folder)
    return passed


def run_tests(words: Sequence[str], folder: Path) -> bool:
    """Run tests with all their rounds and examples; False if one of them failed."""
    environment = os.environ | {"CITYSTITCH_RELIABILITY": str(folder)}
    command = [sys.executable, "-m", "pytest", "-q", *words]
    return subprocess.run(command, cwd=ROOT, env=environment, check=False).returncode == 0


def write_tables(folder: Path) -> None:
    """Write the tables of all campaigns that have left their outcomes in a folder."""
    text = REPORT.read_text()
    for name, (_, table) in CAMPAIGNS.items():
        path = folder / f"{name}.json"
        if path.exists():
            text = replace_between(text, name, table(json.loads(path.read_text())))
    REPORT.write_text(text)


def main(names: Sequence[str]) -> int:
    """Run the campaigns that are named, or all; or write the tables of ``--from FOLDER``."""
    if len(names) == 2 and names[0] == "--from":
        write_tables(Path(names[1]))
        return 0
    unknown = set(names) - set(CAMPAIGNS)
    if unknown:
        print(f"no campaign {', '.join(sorted(unknown))}; there are: {', '.join(CAMPAIGNS)}", file=sys.stderr)
        return 2
    with tempfile.TemporaryDirectory() as folder:
        passed = [run_campaign(name, Path(folder)) for name in names or CAMPAIGNS]
        if not names:
            passed.append(run_tests(WITHOUT_TABLE, Path(folder)))
    return 0 if all(passed) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
