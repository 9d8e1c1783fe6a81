"""docs/benchmarks.md and its pictures, written of what `tests.benchmarks.bench` measured."""

import os
import platform
import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

DOCS = Path(__file__).resolve().parents[2] / "docs"
REPORT = DOCS / "benchmarks.md"
LEAST_SECONDS = 0.05  # less is not fitted
LEAST_INNER = 0.004  # s: events tell thousandths
MEASURED = "measured"  # day of each study, beside the studies
# Key and title of a table's first column, where they are not the study's own key.
TITLES = {"cells": ("mesh size", "mesh size (m)"), "area": ("area", "area (km²)")}
OTHERS = "<!-- exports -->"  # what `make bench-exports` has written begins here

Rows = list[dict[str, Any]]

CHOICE = "model: 3.4 choose layers"  # where a stage of step 2 does a part of step 3

# Steps of the paper by the stages and parts of stages that do them, as run.json names them.
STEPS: Mapping[str, tuple[str, ...]] = {
    "1.1 points": ("points",),
    "1.2 footprints": ("footprints", "outlines"),
    "1.3 terrain": ("ground", "flooded", "coarse", "lakes", "terrain"),
    "1.4-2.0 houses": ("houses",),
    "2.1 simplify": ("near", "join", "members", "shapes"),
    "2.3 heights": ("model",),
    "1.7, 2.4 city model": ("citymodel", "citymodel-full"),
    "3.1 plane mesh": ("columns: 3.1 plane mesh", "seams: 3.1 seams"),
    "3.2-3.5 columns": ("columns: 3.2-3.5 columns", "seams: 3.2-3.5 columns of seams", "layers", CHOICE),
    "3.6 pieces": ("pieces",),
    "fit, report": ("fit", "report"),
}


def step_seconds(record: Mapping[str, Any]) -> dict[str, float]:
    """Seconds of each step of a run, all tiles together; what no step names is ``rest``."""
    given: Counter[str] = Counter()
    for name, seconds in record["seconds"].items():
        given[re.sub(r"-\d+(?=:|$)", "", name)] += seconds
    found = {step: sum(given[part] for part in parts) for step, parts in STEPS.items()}
    found["2.3 heights"] -= given[CHOICE]
    stages = sum(seconds for name, seconds in record["seconds"].items() if ": " not in name)
    found["rest"] = max(stages - sum(found.values()), 0.0)
    return {step: round(seconds, 3) for step, seconds in found.items()}


def fit_exponent(sizes: Sequence[float], seconds: Sequence[float]) -> float | None:
    """Slope of log(seconds) over log(sizes) by least squares; None with fewer than two values that count.

    Examples
    --------
    >>> round(fit_exponent([1, 10, 100], [2, 20, 200]), 3)
    1.0
    """
    n, t = np.asarray(sizes, np.float64), np.asarray(seconds, np.float64)
    use = t >= LEAST_SECONDS
    if use.sum() < 2:
        return None
    return float(np.polyfit(np.log(n[use]), np.log(t[use]), 1)[0])


def draw_log_plot(
    path: Path, sizes: Sequence[float], series: Mapping[str, Sequence[float]], *, x: str, y: str
) -> None:
    """Draw lines over one axis, the last one thick, with a dashed line of slope one through its first value."""
    figure = Figure(figsize=(10, 5.6))
    axes = figure.subplots()
    *_, (last, whole) = series.items()
    for name, line in series.items():
        places = [value if value > 0 else float("nan") for value in line]
        axes.loglog(sizes, places, marker="o", label=name, linewidth=4 if name == last else 2)
    axes.loglog(sizes, [whole[0] * size / sizes[0] for size in sizes], "--", color="#999999")
    axes.set(xlabel=x, ylabel=y)
    axes.legend(loc="center left", bbox_to_anchor=(1, 0.5))
    figure.savefig(path, bbox_inches="tight")


def write_report(kept: Mapping[str, Any]) -> None:
    """Write docs/benchmarks.md and its pictures of what was measured."""
    lines = [
        "# Benchmarks",
        "",
        "Written by `make bench` (one part: `python -m tests.benchmarks.bench cells`); do not edit.",
        "Synthetic cities (`citystitch synth`), LAZ and SHP to written pieces, mesh size 10 m, tiles of the",
        "default size, numba's cache warm, one run each, where nothing else is said. The machine is shared:",
        "compare within a table.",
        "",
        f"Machine: {os.cpu_count()} cores, {platform.machine()}, Python {platform.python_version()}.",
    ]
    for study, title, words, body in SECTIONS:
        if study in kept:
            lines += [
                "",
                f"## {title}",
                "",
                f"{words} Measured on {kept[MEASURED][study]}.",
                "",
                *body(kept[study]),
            ]
    _, marker, others = REPORT.read_text().partition(OTHERS)
    REPORT.write_text("\n".join([*lines, "", marker + others]))


def _growth(rows: Rows, name: str, key: str) -> list[str]:
    """A table of runs, one of exponents, and the plot."""
    sizes = [float(row[key]) for row in rows]
    steps = [*STEPS, "rest"]
    series = {step: [row["steps"][step] for row in rows] for step in steps}
    whole = [sum(row["steps"].values()) for row in rows]
    draw_log_plot(DOCS / f"study-{name}.png", sizes, {**series, "all": whole}, x=key, y="seconds")
    lines = [
        *_runs(rows, *TITLES.get(key, (key,))),
        "",
        "| step | exponent, all sizes | upper half |",
        "|---|---|---|",
    ]
    half = len(rows) // 2
    told_too = {"all steps": whole}
    if key != "cells":
        told_too["the number of cells"] = [float(row["cells"]) for row in rows]
    for step, seconds in {**series, **told_too}.items():
        told = [fit_exponent(sizes, seconds), fit_exponent(sizes[half:], seconds[half:])]
        lines.append(f"| {step} | " + " | ".join("-" if e is None else f"{e:.2f}" for e in told) + " |")
    return [*lines, "", f"![Seconds of each step against {key}](study-{name}.png)"]


def _inner(rows: Rows) -> list[str]:
    """What an item with others all around takes, by stage and by the area of the region."""
    rows = [row for row in rows if row["inner"]]
    areas = [float(row["area"]) for row in rows]
    lines = [
        "A large region has more tiles with others all around, which read more than those at its border. Each of",
        "these alone takes (ms; the median of a run):",
        "",
        f"| stage | {' | '.join(f'{area:g} km²' for area in areas)} | exponent against area |",
        "|---" * (2 + len(rows)) + "|",
    ]
    series = {stage: [row["inner"][stage] for row in rows] for stage in rows[0]["inner"]}
    series = {stage: seconds for stage, seconds in series.items() if min(seconds) >= LEAST_INNER}
    series["all of these"] = [sum(seconds) for seconds in zip(*series.values(), strict=True)]
    for stage, seconds in series.items():
        shown = " | ".join(f"{1000 * value:.0f}" for value in seconds)
        # Of one of them: their number goes with the area, so that all together grow by one power more.
        slope = np.polyfit(np.log(areas), np.log(seconds), 1)[0]
        lines.append(f"| {stage} | {shown} | {1 + slope:.2f} |")
    return lines


def _runs(rows: Rows, key: str, title: str = "") -> list[str]:
    lines = [
        f"| {title or key} | tiles | cells | whole run | worker's peak | driver | tasks |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        kind = row[key] if isinstance(row[key], str) else f"{row[key]:,g}"
        lines.append(
            f"| {kind} | {row['tiles']} | {row['cells'] / 1e6:.2f} M | {row['total']:.1f} s "
            f"| {row['peak'] / 2**20:.0f} MiB | {row['driver'] / 2**20:.1f} MiB | {row['ran']:,} |"
        )
    return lines


def _rates(rows: Rows) -> list[str]:
    lines = [
        "| mesher | cells | step 3, cells/s | seams | with the store | seams | written | steps 1-2, points/s |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        told = []
        for kind in (" computed", ""):
            both = row[f"seams{kind}"] + row[f"columns{kind}"] + row["layers"]
            told += [f"{row['cells'] / both / 1e6:.2f} M", f"{100 * row[f'seams{kind}'] / both:.0f} %"]
        told.append(f"{row['cells'] / row['written'] / 1e6:.2f} M")
        early = sum(seconds for step, seconds in row["steps"].items() if step[0] in "12")
        told.append(f"{row['points'] / early / 1e6:.2f} M")
        lines.append(f"| {row['mesher']} | {row['cells'] / 1e6:.2f} M | {' | '.join(told)} |")
    return lines


def _ways(rows: Rows) -> list[str]:
    lines = ["| run | cells | whole run | step 3 | step 3, cells/s | peak |", "|---|---|---|---|---|---|"]
    for row in rows:
        step = row["seams computed"] + row["columns computed"] + row["layers"]
        told = [
            f"`{row['way']}`" if row["way"] else "as it is",
            f"{row['cells'] / 1e6:.2f} M",
            f"{row['total']:.1f} s",
            f"{step:.2f} s",
            f"{row['cells'] / step / 1e6:.2f} M",
            f"{row['peak'] / 2**20:.0f} MiB",
        ]
        lines.append(f"| {' | '.join(told)} |")
    return lines


def _speedups(rows: Rows, key: str, unit: str, scale: float, *kinds: str) -> list[str]:
    """How often faster than one process: by the middle runs, and by the slowest and the fastest round."""
    found = {(row[key], row["run as"]): row for row in rows}
    told = []
    for kind in kinds:
        ratios = []
        for value in dict.fromkeys(row[key] for row in rows):
            alone, some = found[value, "one process"], found[value, kind]
            rounds = [one / other for one, other in zip(alone["totals"], some["totals"], strict=True)]
            ratio, low, high = alone["total"] / some["total"], min(rounds), max(rounds)
            ratios.append(f"{ratio:.2f} at {value / scale:g} {unit} ({low:.2f} to {high:.2f})")
        told.append(f"{kind} over one process: {', '.join(ratios)}")
    return [f"{'; '.join(told)}. In brackets the lowest and the highest of a round."]


def _driver(rows: Rows) -> list[str]:
    pairs = [*pairwise(rows), (rows[0], rows[-1])]
    told = [
        f"{(after['driver'] - before['driver']) / (after['tiles'] - before['tiles']) / 1e3:.1f} kB a tile between "
        f"{before['tiles']:,} and {after['tiles']:,}"
        for before, after in pairs
    ]
    return [*_runs(rows, "tiles a side"), "", f"The driver takes {', '.join(told)}."]


def _fine(rows: Rows) -> list[str]:
    two = [row for row in rows if row["run as"] == "2 workers"]
    return [*_runs(two, "mesh size", "mesh size (m)"), "", *_speedups(rows, "mesh size", "m", 1, "2 workers")]


def _profile(rows: Rows) -> list[str]:
    return _table("function", "share", ((f"`{row['place']}`", f"{100 * row['share']:.1f} %") for row in rows))


def _startup(rows: Rows) -> list[str]:
    return _table("from the command to", "seconds", ((row["until"], f"{row['seconds']:.2f}") for row in rows))


def _limits(rows: Rows) -> list[str]:
    return _table("", "", ((row["limit"], row["value"]) for row in rows))


def _table(left: str, right: str, rows: Iterable[tuple[str, str]]) -> list[str]:
    return [f"| {left} | {right} |", "|---|---|", *(f"| {one} | {other} |" for one, other in rows)]


# Of each study: its title, what was run, and what is made of its rows.
SECTIONS: Sequence[tuple[str, str, str, Callable[[Rows], list[str]]]] = (
    (
        "cells",
        "(a) Cells",
        "One kilometre with 480 buildings, mesh size 20 to 2.5 m, serial.",
        lambda rows: _growth(rows, "cells", "cells"),
    ),
    (
        "buildings",
        "(b) Buildings",
        "6.25 km², tiles of 625 m, serial.",
        lambda rows: _growth(rows, "buildings", "buildings"),
    ),
    (
        "area",
        "(c) Area",
        "480 buildings a km², tiles of 500 m, one worker.",
        lambda rows: [*_growth(rows, "area", "area"), "", *_inner(rows)],
    ),
    (
        "driver",
        "Memory of the driver",
        "Tiles of 150 m with hardly a house; client and Dask's scheduler in one process, two workers.",
        _driver,
    ),
    (
        "tiles",
        "(d) Tile size",
        "The city of 2.5 km, two workers.",
        lambda rows: _runs(rows, "tile size", "tile size (m)"),
    ),
    (
        "fine",
        "Fine meshes",
        "The city of 2.5 km, two workers; the time of the command, the middle one of 3 runs (2.5 m: one run).",
        _fine,
    ),
    (
        "rates",
        "Rates",
        "Cities with 480 buildings a km² and 1.5 points a m², of 5 km at 10 m and of 3 km at 5 m, "
        "serial. *Step 3* is what stages `seams` and `columns` compute (3.1 to 3.5), then all that "
        "they do, with what they read and\nwrite of the store; the layers of roofs, which `model` chooses, count "
        "in both. *Written* are cells a second into VTU pieces.",
        _rates,
    ),
    (
        "ways",
        "The paper's way",
        "One kilometre with 480 buildings, serial; the middle one of 3 runs. *Step 3* as in the rates.",
        _ways,
    ),
    (
        "profile",
        "Where the time goes",
        "Serial run of the city of 2.5 km, 250 samples a second (py-spy): our innermost function, with what it "
        "calls of others.",
        _profile,
    ),
    ("startup", "Start-up", "Medians of 7.", _startup),
    ("limits", "What the machine can", "On one core.", _limits),
)
