"""The table of polygons by criterion, as in the paper (He et al., Table 2)."""

from collections.abc import Mapping, Sequence
from typing import Any


def make_table(counts: Mapping[str, int], names: Sequence[str]) -> dict[str, Any]:
    """Make the table from the counts of a `DetailedSource` and the names of its criteria.

    ``buildings``, ``facades``, ``assets`` of what was made by how they are, and ``polygons``: a row for each model
    with ``model``, ``polygons`` and ``remaining`` (per cent of the full model).
    """
    rows = [(name, counts[f"polygons {k}"]) for k, name in enumerate(names)]
    rows += [("low-asset level", counts["low assets"]), ("low-façade level", counts["low facades"])]
    full = max(rows[0][1], 1)
    return {
        "buildings": counts["buildings"],
        "facades": counts["facades"],
        "facades_of_one_polygon": counts["facades replaced by one polygon"],
        "assets": {kind: counts[f"assets {kind}"] for kind in ("full", "reduced", "flat")},
        "polygons": [
            {"model": name, "polygons": number, "remaining": round(100 * number / full, 1)}
            for name, number in rows
        ],
    }


def table_lines(table: Mapping[str, Any]) -> list[str]:
    """Write the table as lines of text."""
    assets = ", ".join(f"{number} {kind}" for kind, number in table["assets"].items())
    lines = [
        f"{table['buildings']} buildings, {table['facades']} façades, "
        f"{table['facades_of_one_polygon']} of one polygon",
        f"assets: {assets}",
        f"{'model':<18}{'polygons':>10}{'remaining':>11}",
    ]
    return lines + [
        f"{row['model']:<18}{row['polygons']:>10}{row['remaining']:>9.1f} %" for row in table["polygons"]
    ]
