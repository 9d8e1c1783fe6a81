"""`python -m tests.benchmarks.town_roofs FOLDER [--size M] [--density N ...]`: roofs of towns, found again.

A town is scanned (`synth --lidar`), the stages of a run up to the city model are made from its points and
footprints, and level 2.2 of it is held against the truth, by type of roof: share of the houses with the right type
and the right number of planes (dormers and parts included), angle between true and found planes of the main roof
(degrees: median, 95th percentile), mean distance of outlines (m), and heights of the main roof (m: median of the
absolute error, RMSE).
"""

import argparse
from pathlib import Path

from tiler.cli.main import main as citystitch
from tiler.config.config import make_config
from tiler.executors.local_cluster import local
from tiler.planning.own_stages import OwnStages
from tiler.planning.plan import make_plan
from tiler.report.roof_truth import compare_with_truth
from tiler.stages.citymodel import city_model_stages
from tiler.workflow.stage_sequence import make_engine, run_city_stages


def measure(folder: Path, size: float, density: float, class_errors: float, tile_size: float) -> None:
    """Scan a town, make its city model, and print a line for each type of roof."""
    town, out = folder / f"town-{density:g}", folder / f"out-{density:g}"
    words = ["--style", "detached", "--size", f"{size:g}", "--seed", "7", "--trees", "0.3", "--workers", "2"]
    words += ["--class-errors", f"{class_errors:g}"]
    if citystitch(["synth", str(town), *words, "--lidar", f"{density:g}", "--levels", "2.2"]):
        raise SystemExit("synth failed")
    inputs = {"pointcloud": [str(town / "tiles")], "footprints": str(town / "footprints.gpkg")}
    config = make_config({**inputs, "id_attribute": "id", "out": str(out), "workers": 2, "tile_size": tile_size})
    out.mkdir(parents=True)
    with local(config.workers) as executor:
        engine = make_engine(config, out, make_plan(config, lambda _: None), executor, OwnStages())
        run_city_stages(engine, config)
        engine.run(*city_model_stages(config))
    for row in compare_with_truth(out, town / "truth.jsonl"):
        print(
            f"| {density:g} | {row['type']} | {row['houses']} | {row['lost']} | {100 * row['right_type']:.1f} | "
            f"{100 * row['right_planes']:.1f} | {row['angle_50']:.2f} / {row['angle_95']:.1f} | "
            f"{row['outline']:.3f} | {row['height_50']:.3f} / {row['height_rmse']:.2f} |",
            flush=True,
        )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--size", type=float, default=2400.0, help="m; 10,000 houses by default")
    parser.add_argument("--density", type=float, nargs="+", default=[2.0, 8.0, 20.0])
    parser.add_argument("--class-errors", type=float, default=0.01)
    parser.add_argument("--tile-size", type=float, default=500.0, help="m; memory grows with its square")
    given = parser.parse_args()
    print(
        "| pulses/m² | roof | houses | lost | type % | planes % | angle p50 / p95 | outline | height p50 / RMSE |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    for density in given.density:
        measure(given.folder, given.size, density, given.class_errors, given.tile_size)


if __name__ == "__main__":
    main()
