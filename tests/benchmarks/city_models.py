"""`python -m tests.benchmarks.city_models`: published city models meshed, as rows of docs/city-models.md.

With `--all` each sample is also meshed in two more tilings, which must give the same city, exported in all formats
and converted to all; each of the three runs is proved by `check` with either.
"""

import argparse
import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from tests.runs.test_city_model_samples import city_of
from tests.tiler.convert.test_convert import validate_gml
from tiler.check.check import check_run
from tiler.config.config import make_config
from tiler.convert.convert import TARGETS, Asked, convert_models
from tiler.export.export import export_run, list_formats, load_format
from tiler.store.results import StoredTerrain
from tiler.workflow.run import run

DATA = Path(__file__).resolve().parents[2].parent / "shared" / "data" / "city_models"
CLOSE = 0.5  # m; RMSE of a house whose roofs are those of the model
ZURICH = (2_681_600.0, 1_243_200.0, 2_682_500.0, 1_244_000.0)  # a part of it with 4 buildings
FALLBACKS = ("model-", "footprint-", "building-roof-from", "building-roof-raised", "building-lost")
NOT_FALLBACKS = ("model-ground", "model-axes", "footprint-split")
SAMPLES: dict[str, dict[str, Any]] = {
    "denhaag/DenHaag_01.city.json": {"tile_size": 300.0},
    "3dbag/5870_ext.jsonl": {},
    "3dbag/tile_901_trimmed.jsonl": {},
    "cjio/multi_lod.json": {"crs": "EPSG:28992"},
    "cjio/DH_01_subs.city.json": {"crs": "EPSG:28992"},
    "cjio/zurich_subset_lod2.json": {"bounds": ZURICH},
    "zurich/zurich-lod2-citygml1.xml": {},
    "berlin/partialMierendorffInselLoD2.gml": {},
    "berlin/Block020023.gml": {},
    "vienna/Fichtegasse.gml": {},
    "vienna/Johannesgasse.gml": {},
    "vienna/Schoenbrunn.gml": {},
    "plateau/53392547_bldg_6697_op2.gml": {"reproject": True},
    "plateau/51311568_bldg_6697_op.gml": {"reproject": True},
    "citygml4j/lod2_buildings_v3.gml": {},
}


def measure_houses(out: Path) -> np.ndarray[Any, np.dtype[np.float64]]:
    """RMSE of each house's roofs against the model's own, over all of its parts (m), on the grid of 0.5 m."""
    objects = json.loads((out / "citymodel.city.json").read_text())["CityObjects"]
    sums: dict[str, list[float]] = {}
    for name, thing in objects.items():
        told = thing.get("attributes", {})
        n = told.get("roof_points", 0)
        if thing.get("children") or not n or told.get("roof_rmse") is None:
            continue
        total = sums.setdefault(thing.get("parents", [name])[0], [0.0, 0.0])
        total[0] += n
        total[1] += n * told["roof_rmse"] ** 2
    return np.array([(squares / n) ** 0.5 for n, squares in sums.values()])


def describe(name: str, record: dict[str, Any], out: Path) -> str:
    """Row of a sample: what came in, what was meshed and how, fallbacks, distances, cells."""
    counts, notes = record["counts"], record["notes"]
    rmse = measure_houses(out)
    kinds = [kind for kind in sorted(notes) if kind.startswith(FALLBACKS) and kind not in NOT_FALLBACKS]
    told = ", ".join(f"{notes[kind]['count']} {kind}" for kind in kinds)
    method = {name: one["buildings"] for name, one in record["fidelity"].get("roof_fit", {}).items()}
    parts = ", ".join(f"{n} {name}" for name, n in method.items())
    ratio = record["quality"]["radius_ratio"]
    return (
        f"| {name} | {counts.get('model buildings', 0)} | {counts['buildings']} | {parts} | {told} "
        f"| {np.median(rmse):.2f} | {100 * (rmse <= CLOSE).mean():.0f} % | {counts['cells']:,} "
        f"| {' / '.join(f'{ratio[p]:.2f}' for p in ('0', '1', '50'))} |"
    )


def prove(values: dict[str, Any], out: Path) -> dict[str, Any]:
    """Mesh, and prove what was written; gives the record."""
    record = run(make_config(values | {"out": str(out), "overwrite": True}))
    if not (proved := check_run(out, StoredTerrain)).ok:
        print(*proved.lines(), sep="\n", flush=True)
    return record


def try_all(values: dict[str, Any], record: dict[str, Any], folder: Path) -> str:
    """Mesh in two more tilings, export and convert; gives what there was of each, as words."""
    box = record["region"]["bounds"]
    side = max(box[2] - box[0], box[3] - box[1])
    cities, tiles = [city_of(folder / "out")], [record["counts"]["tiles"]]
    finer = {"mesh_size": min(record["parameters"]["mesh_size"], side / 38)}  # a tile has 14 of them at least
    for share in (0.55, 0.4):
        other = prove(values | finer | {"tile_size": share * side}, folder / "other")
        cities.append(city_of(folder / "other"))
        tiles.append(other["counts"]["tiles"])
    same = sum(one == cities[0] for one in cities)
    for name in list_formats():
        export_run(folder / "out", folder / f"export-{name}{load_format(name).suffix}", name=name, options={})
    for name, target in TARGETS.items():
        path = folder / f"{name}{target.suffixes[0]}"
        convert_models([folder / "out"], path, Asked(name))
        if name.startswith("citygml"):
            print(*validate_gml(path, f"{name[-1]}.0"), sep="\n", end="", flush=True)
    shown = " / ".join(map(str, tiles))
    return (
        f"{shown} tiles: {same} of {len(cities)} cities equal, {len(list_formats())} exports, "
        f"{len(TARGETS)} conversions, CityGML valid unless lines of xmllint stand above"
    )


def main() -> None:
    """Mesh the samples that are named, or all, with one parameter or another."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", help="words in the names of samples; none for all")
    parser.add_argument("--clearance", type=float, help="m; by default that of a run")
    parser.add_argument("--all", action="store_true", help="three tilings, and all exports and conversions")
    given = parser.parse_args()
    for name, options in SAMPLES.items():
        if given.names and not any(word in name for word in given.names):
            continue
        with tempfile.TemporaryDirectory() as folder:
            values = {"buildings": [str(DATA / name)]} | options
            if given.clearance is not None:
                values["clearance"] = given.clearance
            record = prove(values, Path(folder) / "out")
            print(describe(name, record, Path(folder) / "out"), flush=True)
            if given.all:
                print(try_all(values, record, Path(folder)), flush=True)


if __name__ == "__main__":
    main()
