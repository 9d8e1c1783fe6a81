"""What a run shows while it is at work, and at its end: what was made, how good it is, what next."""

import logging
import shlex
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from tiler.engine.watcher import Watcher
from tiler.monitoring.live_view import LiveView
from tiler.monitoring.run_log import LogView
from tiler.objects.places import Place, in_bucket
from tiler.store.run_folder import PARTS
from tiler.words.note_words import say_notes
from tiler.words.plain_text import printable
from tiler.words.stage_groups import title_of_stage

LISTED_NOTES = 12  # kinds of notes that the summary shows; run.json has all
LISTED_MISSING = 20  # tiles and other failures that it shows, likewise


def plain(text: str) -> str:
    """Write text of unknown origin for rich: neither control characters nor markup."""
    return escape(printable(text))


def make_view(*, quiet: bool = False, verbose: bool = False, console: Console | None = None) -> Watcher:
    """Make the watcher that shows a run until it ends: a live view on a terminal, lines where there is none.

    Parameters
    ----------
    quiet : bool
        Failures alone, on standard error.
    verbose : bool
        A line for each item too.
    console : Console, optional
        Where; standard output by default.
    """
    if quiet:
        return LogView(logging.StreamHandler(sys.stderr), logging.ERROR)
    console = console or Console(highlight=False)
    if console.file.isatty() and not console.is_dumb_terminal:
        return LiveView(console, verbose=verbose)
    return LogView(logging.StreamHandler(sys.stdout), logging.DEBUG if verbose else logging.INFO)


def print_last_line(record: dict[str, Any], out: Path) -> None:
    """Print the end of a run in one line."""
    counts = record["counts"]
    lost = len(record["missing"]) + len(record["set_aside"]) + len(record["unreadable"])
    items = "1 item" if lost == 1 else f"{lost:,} items"
    left_out = f"; {items} left out, see {out / 'run.json'}" if lost else ""
    print(printable(f"{counts['cells']:,} cells in {out}, {record['seconds_total']:.1f} s{left_out}"))


def print_summary(record: dict[str, Any], out: Path) -> None:
    """Print what was made, how good it is, what was not taken as it came, and the next commands."""
    console, counts = Console(highlight=False), record["counts"]
    console.print(
        f"[bold]{counts['cells']:,}[/] cells, {counts['points']:,} points, {report_buildings(counts)} "
        f"in {record['seconds_total']:.1f} s, peak memory {record['peak_memory_bytes'] / 2**20:.0f} MiB"
    )
    _print_quality(record, console)
    _print_missing(record, console)
    kinds = sorted(record["notes"].items(), key=lambda item: -item[1]["count"])
    if kinds:
        console.print("dropped, repaired or defaulted, or worth a look:")
    for kind, group in kinds[:LISTED_NOTES]:
        console.print(f"  {plain(say_notes(kind, group['count']))}", soft_wrap=True)
    if len(kinds) > LISTED_NOTES:
        console.print(f"  and {len(kinds) - LISTED_NOTES} more kinds")
    console.print(f"all of it with places: {plain(str(out / 'run.json'))}", soft_wrap=True)
    for k, words in enumerate(next_commands(out)):
        console.print(f"{'     ' if k else 'next:'} {plain(shlex.join(words))}", soft_wrap=True)


def report_buildings(counts: Mapping[str, int]) -> str:
    """Write how many buildings a mesh has, and their parts where these are more.

    Examples
    --------
    >>> report_buildings({"buildings": 1036, "building parts": 1531}), report_buildings({"buildings": 1})
    ('1,036 buildings (1,531 parts)', '1 building')
    """
    n, parts = counts["buildings"], counts.get(PARTS, counts["buildings"])
    words = "1 building" if n == 1 else f"{n:,} buildings"
    return words if parts == n else f"{words} ({parts:,} parts)"


def next_commands(out: Place) -> Sequence[Sequence[str]]:
    """List what to do with a finished run: prove it, look at it, take it along."""
    folder = str(out)
    if in_bucket(out):
        return (("citystitch", "fetch", folder, "DIR"),)
    from tiler.store.kept import IN_STORE, WHOLE, find_kept  # with numpy, which the parser does without
    from tiler.store.out_folder import CONFIG

    keep = find_kept(out)
    if keep == IN_STORE:
        return (("citystitch", "run", str(out / CONFIG), "--keep", WHOLE),)
    return (
        ("citystitch", "check", folder),
        *((("citystitch", "report", folder),) if keep == WHOLE else ()),
        ("citystitch", "render", folder, "-o", "city.png"),
        ("citystitch", "export", folder, "--format", "openfoam", "-o", "case"),
    )


def _print_quality(record: dict[str, Any], console: Console) -> None:
    table = Table(box=None, pad_edge=False)
    percentiles = ("0", "0.1", "1", "5", "50")
    for title in ("quality, percentile", *percentiles):
        table.add_column(title, justify="left" if title.startswith("q") else "right")
    for name, title in (("radius_ratio", "radius ratio"), ("min_dihedral", "least dihedral angle (degrees)")):
        table.add_row(title, *(f"{record['quality'][name][p]:.2f}" for p in percentiles))
    console.print(table)
    fits = [
        f"{kind} points {found['rmse']:.2f} m"
        for kind in ("roof", "ground")
        if (found := record["fidelity"].get(kind, {})).get("rmse") is not None
    ]
    if fits:
        console.print(f"distance to the model (RMSE): {', '.join(fits)}")


def _print_missing(record: dict[str, Any], console: Console) -> None:
    missing, failed = list(record["missing"].items()), record["set_aside"]
    for tile, found in missing[:LISTED_MISSING]:
        reason = plain(found["reason"])
        console.print(
            f"[red]missing[/] tile {tile}: {title_of_stage(found['stage'])} {found['name']}: {reason}",
            soft_wrap=True,
        )
        console.print(f"        alone: {plain(found['command'])}", soft_wrap=True)
    for found in failed[:LISTED_MISSING]:
        why = f"{title_of_stage(found['stage'])} {found['name']}: {plain(found['reason'])}"
        console.print(f"[red]failed[/] {why}", soft_wrap=True)
    more = sum(max(len(lost) - LISTED_MISSING, 0) for lost in (missing, failed))
    if more:
        console.print(f"[red]and {more:,} more[/]")
    for path, reason in record["unreadable"].items():
        console.print(f"[yellow]left out[/] {plain(f'{path}: {reason}')}", soft_wrap=True)
