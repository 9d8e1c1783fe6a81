"""What a run prints: a line for each step, and at the end what was made and how good it is."""

from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from tiler.plain_text import printable

LISTED_NOTES = 12  # kinds of notes that the summary shows; run.json has all


def plain(text: str) -> str:
    """Write text of unknown origin for rich: neither control characters nor markup."""
    return escape(printable(text))


def print_step(name: str, seconds: float) -> None:
    """Print a finished step and its time."""
    Console(highlight=False).print(f"  {plain(f'{name:<28}')} {seconds:8.2f} s")


def print_summary(record: dict[str, Any], out: Path) -> None:
    """Print what was made, how good it is, what was not taken as it came, and the next command."""
    console = Console(highlight=False)
    counts, quality = record["counts"], record["quality"]
    console.print(
        f"[bold]{counts['cells']:,}[/] cells, {counts['points']:,} points, {counts['buildings']:,} buildings "
        f"in {record['seconds_total']:.1f} s, peak memory {record['peak_memory_bytes'] / 2**20:.0f} MiB"
    )
    table = Table(box=None, pad_edge=False)
    percentiles = ("0", "0.1", "1", "5", "50")
    for title in ("quality, percentile", *percentiles):
        table.add_column(title, justify="left" if title.startswith("q") else "right")
    for name, title in (("radius_ratio", "radius ratio"), ("min_dihedral", "least dihedral angle (degrees)")):
        table.add_row(title, *(f"{quality[name][p]:.2f}" for p in percentiles))
    console.print(table)
    for tile, found in record["missing"].items():
        console.print(
            f"[red]missing[/] tile {tile}: stage {found['stage']} {found['name']}: {escape(found['reason'])}"
        )
        console.print(f"        alone: {escape(found['command'])}")
    for found in record["set_aside"]:
        console.print(f"[red]failed[/] stage {found['stage']} {found['name']}: {escape(found['reason'])}")
    for path, reason in record["unreadable"].items():
        console.print(f"[yellow]left out[/] {plain(f'{path}: {reason}')}")
    kinds = sorted(record["notes"].items(), key=lambda item: -item[1]["count"])
    for kind, group in kinds[:LISTED_NOTES]:
        console.print(f"{group['count']:7,}  {kind.replace('-', ' ')}")
    if len(kinds) > LISTED_NOTES:
        console.print(f"         and {len(kinds) - LISTED_NOTES} more kinds")
    console.print(
        f"all of it with places: {plain(str(out / 'run.json'))}\nnext: citystitch check {plain(str(out))}"
    )
