"""`python -m tests.benchmarks.town_variants`: write docs/town-variants.md, the table of all representations."""

from pathlib import Path

from pipeline.architecture.representations import HEIGHTS, WALLS_AT, list_representations

PAGE = Path(__file__).resolve().parents[2] / "docs" / "town-variants.md"
HEAD = """# Representations of a house

Written by `python -m tests.benchmarks.town_variants`; do not edit. The names are those of Random3Dcity.
`citystitch synth DIR --style STYLE --variants all` writes them all, `--variants NAME,NAME` some: each to
`variants/NAME.city.jsonl` (CityJSONSeq); `citystitch convert` makes CityGML of them.
[towns.md](towns.md) says what levels show.

Walls: F0 where they are, F1 below the edges of the roof, Fd halfway. Blocks and roof outlines are as high as:

"""


def make_page() -> str:
    """Give the text of the page."""
    rows = [f"| {name} | {text} |" for name, text in HEIGHTS.items()]
    lines = [
        "| height | is |",
        "|---|---|",
        *rows,
        "",
        "| n | file | level | walls | height | as |",
        "|---|---|---|---|---|---|",
    ]
    for number, one in enumerate(list_representations(), 1):
        level = f"{one.level}{' without dormers' if not one.dormers else ''}{', inside' if one.interior else ''}"
        walls = one.walls if one.walls in WALLS_AT else ""
        lines.append(f"| {number} | `{one.name}` | {level} | {walls} | {one.height} | {one.kind} |")
    return HEAD + "\n".join(lines) + "\n"


if __name__ == "__main__":
    PAGE.write_text(make_page())
