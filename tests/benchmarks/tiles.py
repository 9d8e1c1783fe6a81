"""`make bench-tiles`: what seams cost in quality, with a picture; written to docs/tiles.md.

The same city as one tile and in 4, 16 and 64 tiles, for both meshers. Cells near seams are held against the cells
of the untiled mesh in the same places.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np
import shapely
from matplotlib.figure import Figure
from numpy.typing import NDArray

from pipeline.columns.columns import expand_cells
from pipeline.quality.quality import Quality, measure_cells
from tests.benchmarks.runs import citystitch
from tests.helpers.columns import read_columns
from tiler.store.store import Store

SIZE = 1200
BUILDINGS = 1000
TILES = {"1": 1200.0, "4": 600.0, "16": 300.0, "64": 150.0}
NEAR = 20.0  # m from a seam
PERCENTILES = (0, 1, 5, 50)
MESHERS = {"adaptive": (), "layered": ("--mesher", "layered", "--layer-height", "5")}
MEASURES = {"radius_ratio": "radius ratio", "min_dihedral": "least dihedral angle, degrees"}
HEAD = ("| mesh | cells | 0 % | 1 % | 5 % | 50 % |", "|---|---|---|---|---|---|")
REPORT = Path(__file__).resolve().parents[2] / "docs" / "tiles.md"


def cells_of(out: Path) -> tuple[Quality, NDArray[np.float64]]:
    """Quality of all cells of a run, and their centres (n, 2)."""
    store = Store(out / "store.zarr")
    ratio, angle, aspect, centre = [], [], [], []
    for tile in store.names("columns"):
        mesh = expand_cells(read_columns(store, tile)[0])
        found = measure_cells(mesh)
        ratio.append(found.radius_ratio)
        angle.append(found.min_dihedral)
        aspect.append(found.aspect_ratio)
        centre.append(mesh.points[mesh.cells, :2].mean(axis=1))
    return Quality(*map(np.concatenate, (ratio, angle, aspect))), np.concatenate(centre)


def near_seams(out: Path, centre: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Cells whose centre is within `NEAR` of a seam of a run."""
    store = Store(out / "store.zarr")
    lines = []
    for name in store.names("seams"):
        arrays, attributes = store.read("seams", name, names=("xy",))
        if not attributes["facts"]["border"]:
            lines.append(shapely.LineString(arrays["xy"]))
    near = np.zeros(len(centre), np.bool_)
    for first in range(0, len(centre), 200_000):
        part = shapely.points(centre[first : first + 200_000])
        near[first + shapely.STRtree(part).query(lines, predicate="dwithin", distance=NEAR)[1]] = True
    return near


def row(title: str, values: NDArray[np.float64], base: NDArray[np.float64]) -> tuple[str, NDArray[np.float64]]:
    """A line of the table: percentiles, and their ratios to those of the untiled mesh."""
    found, wanted = np.percentile(values, PERCENTILES), np.percentile(base, PERCENTILES)
    cells = " | ".join(f"{a:.3f} ({a / b:.2f})" for a, b in zip(found, wanted, strict=True))
    return f"| {title} | {len(values):,} | {cells} |", found / wanted


def draw(path: Path, series: dict[str, NDArray[np.float64]]) -> None:
    """Draw the shares of cells by radius ratio, one line a number of tiles."""
    figure = Figure(figsize=(9, 4.2))
    axes = figure.subplots()
    for name, values in series.items():
        counts, edges = np.histogram(values, 100, (0, 1))
        axes.stairs(counts / len(values), edges, label=name)
    axes.set_title("cells within 20 m of seams, by radius ratio (share of each mesh)")
    axes.legend()
    figure.savefig(path)


def main() -> int:
    """Measure, write the report, and tell whether seams keep their promise."""
    lines = [
        "# Mesh quality at seams",
        "",
        "Cell quality of one city as one tile and in 4, 16 and 64 tiles of 600, 300 and 150 m. The city is",
        "synthetic, of 1.2 km with 1,000 buildings, meshed at 10 m",
        "(`citystitch synth CITY --size 1200 --buildings 1000`). In brackets: the ratio to the untiled mesh, over",
        "all cells or over the cells in the same places. Written by `make bench-tiles`; do not edit.",
        "",
    ]
    worst = []
    with tempfile.TemporaryDirectory() as folder:
        city = Path(folder) / "city"
        citystitch("synth", str(city), "--size", str(SIZE), "--buildings", str(BUILDINGS))
        for mesher, options in MESHERS.items():
            found = {}
            for tiles, size in TILES.items():
                out = Path(folder) / f"{mesher}-{tiles}"
                given = ("--footprints", str(city / "footprints.shp"), "--tile-size", str(size), *options)
                citystitch("run", str(city / "tiles"), *given, "--out", str(out))
                found[tiles] = cells_of(out)
            whole, places = found["1"]
            series: dict[str, NDArray[np.float64]] = {}
            for measure, title in MEASURES.items():
                lines += [f"## {mesher}: {title}", "", *HEAD]
                base = getattr(whole, measure)
                lines.append(row("1 tile, all cells", base, base)[0])
                for tiles, (quality, centre) in list(found.items())[1:]:
                    values = getattr(quality, measure)
                    text, ratio = row(f"{tiles} tiles, all cells", values, base)
                    lines.append(text)
                    out = Path(folder) / f"{mesher}-{tiles}"
                    here, there = near_seams(out, centre), near_seams(out, places)
                    text, close = row(f"{tiles} tiles, within {NEAR:g} m of seams", values[here], base[there])
                    lines.append(text)
                    worst += [
                        (ratio, f"{mesher} {tiles} {measure} all"),
                        (close, f"{mesher} {tiles} {measure} near"),
                    ]
                    if measure == "radius_ratio" and mesher == "adaptive":
                        series |= {f"{tiles} tiles": values[here]}
                        if tiles == "64":
                            series = {"1 tile": base[there]} | series
                lines.append("")
            if series:
                draw(REPORT.parent / "tiles-quality.png", series)
                lines += ["![Cells near seams by radius ratio](tiles-quality.png)", ""]
    missed = [name for ratio, name in worst if ratio[0] < 0.5 or (ratio[1:] < 0.97).any()]
    lines += [
        "Requirement: within 3 % at the 1st percentile and above, and a minimum of at least half.",
        "Missed by: " + (", ".join(missed) or "none") + ".",
    ]
    REPORT.write_text("\n".join(lines) + "\n")
    print("\n".join(lines))
    return 0


if __name__ == "__main__":
    sys.exit(main())
