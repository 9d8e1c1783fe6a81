"""`python -m tests.benchmarks.town_variants`: write docs/town-variants.md, the table of all representations."""

from pathlib import Path

from pipeline.architecture.representations import HEIGHTS, WALLS_AT, list_representations

PAGE = Path(__file__).resolve().parents[2] / "docs" / "town-variants.md"
HEAD = """# Representations of a house

`citystitch synth DIR --style STYLE --variants all` writes all representations below, `--variants NAME,NAME`
some: each to `variants/NAME.city.jsonl` (CityJSONSeq). `citystitch convert` converts them to CityGML.
[towns.md](towns.md) describes the levels. The names are those of Random3Dcity. Written by
`python -m tests.benchmarks.town_variants`; do not edit.

Walls: F0 at their place, F1 below the edges of the roof, Fd halfway. Height of blocks and roof outlines:

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
