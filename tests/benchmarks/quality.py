"""`make quality`: fidelity and cell quality by mode, measured on real and synthetic cities, to docs/quality.md."""

import os
import platform
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from PIL import Image, ImageDraw

from tests.helpers.synthetic import city_files
from tests.helpers.written_models import read_city_model
from tiler.config.config import make_config
from tiler.pictures.render import render_run
from tiler.workflow.run import run

ROOT = Path(__file__).resolve().parents[2]
DATA = ROOT.parent / "shared" / "data"
CLOUDS = {"AHN3, with building class": "amsterdam", "AHN2, without": "amsterdam_no_building_class"}
BLOCK = (120840.0, 486110.0, 121010.0, 486250.0)
PAPER = {"simplify": "paper", "mesher": "layered", "roof_height": "percentile"}
MODES: dict[str, dict[str, Any]] = {
    "paper (merging, 90th percentile)": PAPER,
    "one height a house, 90th percentile": {"split_levels": False, "roof_height": "percentile"},
    "one height a house, median": {"split_levels": False},
    "levels, 90th percentile": {"roof_height": "percentile"},
    "**levels, median** (default)": {},
    "levels, median, clearance 0.5 m": {"clearance": 0.5},
}
BLOCKS = ("paper (merging, 90th percentile)", "one height a house, median", "**levels, median** (default)")
FIDELITY_HEAD = (
    "| mode | buildings | outline error | same, a house | lost | clearance, m | roof RMSE, m | median | p95 "
    "| bias | points off | ground RMSE, m |"
)
PAGE = """# Quality

How well the city model fits the input, and how good the cells are, by mode. Written by `make quality`; do
not edit. Real data is central Amsterdam in `../shared/data`; synthetic cities are `citystitch synth` of 1 km with
500 buildings. Each line is one `citystitch run` with the stated options. Machine: {machine}.

For published samples of city models, meshed with their own roofs, see [city-models.md](city-models.md#samples), by
`python -m tests.benchmarks.city_models`.

![The same block in three modes](block-modes.png)

## How well the city model fits

- *Outline error*: area that the built-up outline lost or gained, over that of the footprints; *a house*: the same
  of each house and its own footprint.
- *Roof*: height of the model minus that of the point, for every roof point inside its buildings.
- *Points off*: roof points of original houses where the model has no building, and ground points of streets and
  courtyards under a building of the model.
- *Ground*: height of the DTM minus that of its points.
FIDELITY

## How good the cells are

Percentiles {percentiles} over all cells of the radius ratio (1 at best) and of the least dihedral angle
(70.5 degrees at best); cells per second in steps 3.1 to 3.5, in one process on a shared machine.
QUALITY
"""
PERCENTILES = ("0", "0.1", "1", "5", "50")
SEEDS = range(1, 7)


def amsterdam(name: str, out: Path, **options: Any) -> dict[str, Any]:
    """Mesh central Amsterdam and return the run's record."""
    values = {
        "pointcloud": [str(DATA / name / "tiles")],
        "footprints": str(DATA / "amsterdam" / "footprints.shp"),
        "crs": "EPSG:28992",
        "out": str(out),
        "overwrite": True,
        "roofs": "flat",
    }
    return run(make_config(values | options))


def synthetic(folder: Path, out: Path, *, seed: int, relief: float = 20.0, **options: Any) -> dict[str, Any]:
    """Mesh a synthetic square kilometre with 500 buildings."""
    city = folder / f"city-{seed}-{relief:g}"
    values = city_files(city, size=1000, buildings=500, relief=relief, seed=seed)
    return run(make_config(values | {"out": str(out), "overwrite": True, "roofs": "flat"} | options))


def union_error(out: Path) -> float:
    """Area that the built-up outline lost or gained, over the footprints' area; houses together."""
    full, simple = (
        shapely.union_all(read_city_model(out / name).polygons)
        for name in ("citymodel-full.city.json", "citymodel.city.json")
    )
    return float(full.symmetric_difference(simple).area / full.area)


def fidelity_row(title: str, record: dict[str, Any], out: Path) -> str:
    """One line of the fidelity table."""
    found, roof = record["fidelity"], record["fidelity"]["roof"]
    outline = found.get("outline", {})
    house = f"{100 * outline['area_error']:.2f} %" if outline else "-"
    clearance = f"{outline['min_clearance']:.2f}" if outline else "-"
    lost = record["notes"].get("building-lost", {}).get("count", 0) if outline else "-"
    return (
        f"| {title} | {record['counts']['buildings']} | {100 * union_error(out):.2f} % | {house} | {lost} "
        f"| {clearance} "
        f"| {roof['rmse']:.2f} | {roof['p50']:.2f} | {roof['p95']:.2f} | {roof['bias']:+.2f} "
        f"| {found['missed']['n'] + found['swallowed']['n']} | {found['ground']['rmse']:.3f} |"
    )


def quality_row(title: str, record: dict[str, Any]) -> str:
    """One line of a quality table."""
    ratio, angle = (record["quality"][name] for name in ("radius_ratio", "min_dihedral"))
    seconds = record["seconds"]["seams"] + record["seconds"]["columns"]
    cells = record["counts"]["cells"]
    return (
        f"| {title} | {cells / 1e6:.2f} M | {' / '.join(f'{ratio[p]:.3f}' for p in PERCENTILES)} "
        f"| {' / '.join(f'{angle[p]:.1f}' for p in PERCENTILES)} | {cells / seconds / 1e6:.1f} M |"
    )


def worst_row(title: str, records: Sequence[dict[str, Any]]) -> str:
    """The worst of each percentile over several runs."""
    ratio, angle = (
        {p: min(record["quality"][name][p] for record in records) for p in PERCENTILES}
        for name in ("radius_ratio", "min_dihedral")
    )
    return (
        f"| **{title}** | | {' / '.join(f'{ratio[p]:.3f}' for p in PERCENTILES)} "
        f"| {' / '.join(f'{angle[p]:.1f}' for p in PERCENTILES)} | |"
    )


def fidelity_tables(folder: Path) -> list[str]:
    """Tables of how well the model fits the data, for both clouds."""
    lines = []
    for title, name in CLOUDS.items():
        lines += [
            "",
            f"### Amsterdam, {title}",
            "",
            FIDELITY_HEAD,
            "|---|---|---|---|---|---|---|---|---|---|---|---|",
        ]
        for mode, options in MODES.items():
            out = folder / "fidelity"
            lines.append(fidelity_row(mode, amsterdam(name, out, **options), out))
    return lines


QUALITY_HEAD = ["", "| run | cells | radius ratio | least dihedral angle | cells/s |", "|---|---|---|---|---|"]


def quality_tables(folder: Path) -> list[str]:
    """Tables of how good the cells are."""
    out = folder / "quality"
    lines = ["", "### Synthetic cities, relief 20 m", *QUALITY_HEAD]
    meshers: dict[str, dict[str, Any]] = {"adaptive": {}, "layered": {"mesher": "layered"}}
    for size in (10.0, 5.0):
        for mesher, options in meshers.items():
            title = f"{mesher}, {size:g} m"
            records = [synthetic(folder, out, seed=seed, mesh_size=size, **options) for seed in SEEDS]
            lines += [quality_row(f"{title}, seed {seed}", r) for seed, r in zip(SEEDS, records, strict=True)]
            lines.append(worst_row(f"{title}, worst of six", records))
    lines += ["", "### Steep terrain, synthetic, 10 m, seed 1, domain height 250 m", *QUALITY_HEAD]
    for relief in (38.0, 76.0, 152.0):
        record = synthetic(folder, out, seed=1, relief=relief, domain_height=250.0)
        lines.append(quality_row(f"adaptive, relief {relief:g} m", record))
    lines += ["", "### Amsterdam, AHN3", *QUALITY_HEAD]
    for title, options in (
        ("adaptive, 10 m (default)", {}),
        ("adaptive, 10 m, one height a house", {"split_levels": False}),
        ("adaptive, 5 m", {"mesh_size": 5.0}),
        ("layered, 10 m", {"mesher": "layered"}),
        ("layered, 10 m, layers 5 m", {"mesher": "layered", "layer_height": 5.0}),
        ("layered, 5 m", {"mesher": "layered", "mesh_size": 5.0}),
        ("paper: merging and layers, 10 m", PAPER),
    ):
        lines.append(quality_row(title, amsterdam("amsterdam", out, **options)))
    return lines


def draw_blocks(folder: Path, target: Path) -> None:
    """Draw the same block in three modes, side by side."""
    pictures = []
    for mode in BLOCKS:
        out, picture = folder / "block", folder / "block.png"
        amsterdam("amsterdam", out, bounds=BLOCK, **MODES[mode])
        render_run(out, picture, size=(1000, 700))
        image = Image.open(picture).convert("RGB").resize((700, 490), Image.Resampling.LANCZOS)
        words = mode.replace("*", "").replace(" (default)", "")
        ImageDraw.Draw(image).text((12, 8), words, fill=(60, 53, 48), font_size=20)
        pictures.append(np.asarray(image))
    Image.fromarray(np.hstack(pictures)).quantize(256, dither=Image.Dither.NONE).save(target, optimize=True)


def draw_tiles(run_folder: Path, target: Path) -> None:
    """Draw a tiled run as it is, and beside it coloured by tile."""
    pictures = []
    for what in ("boundary", "tiles"):
        picture = run_folder / f"{what}.png"
        render_run(run_folder, picture, what=what, size=(1600, 1000))
        pictures.append(np.asarray(Image.open(picture).resize((800, 500), Image.Resampling.LANCZOS)))
    # Without the lowest bit, which nobody sees, the file is a fifth smaller.
    Image.fromarray(np.hstack(pictures) | 1).save(target, optimize=True)


def main() -> None:
    """Measure and write the page."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        fidelity, quality = fidelity_tables(folder), quality_tables(folder)
        draw_blocks(folder, ROOT / "docs" / "block-modes.png")
        amsterdam("amsterdam", folder / "tiled", tile_size=150.0, workers=2)
        draw_tiles(folder / "tiled", ROOT / "docs" / "tiles.png")
    machine = f"{os.cpu_count()} shared cores, {platform.machine()}"
    page = PAGE.format(machine=machine, percentiles=" / ".join(PERCENTILES))
    page = page.replace("FIDELITY", "\n".join(fidelity)).replace("QUALITY", "\n".join(quality))
    (ROOT / "docs" / "quality.md").write_text(page)
    print(page)


if __name__ == "__main__":
    main()
