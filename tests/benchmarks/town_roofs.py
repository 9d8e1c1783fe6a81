"""`python -m tests.benchmarks.town_roofs FOLDER [--size M] [--density N ...]`: roofs of towns, found again.

A town is scanned (`synth --lidar`), meshed by `run` from its points and footprints, and its city model of level
2.2 held against the truth, by type of roof: share of the houses with the right type and the right number of planes
(dormers and parts included), angle between true and found planes of the main roof (degrees: median, 95th
percentile), mean distance of outlines (m), and heights of the main roof (m: median of the absolute error, RMSE).
"""

import argparse
import json
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from tiler.cli.main import main as citystitch

SAME_ANGLE, SAME_HEIGHT = 3.0, 0.15  # degrees and m: faces that agree so well are of one plane
SLOPED = 5.0  # degrees, from which on a plane is sloped
MAIN = 0.08  # of the area of the main body: planes with less say nothing of its type
POINT = 0.25  # m from one point, in which the planes of a pyramid meet
STEP = 0.5  # m between the places where heights are compared
Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Found:
    """A house of a city model: faces of its roof in plan, the plane a, b, c of each, and its outline."""

    faces: NDArray[np.object_]
    planes: Array
    outline: shapely.Geometry


def read_model(path: Path) -> dict[str, Found]:
    """Read the roofs of level 2.2; planes are about the origins of `truth.jsonl`, which are subtracted later."""
    document = json.loads(path.read_text())
    xyz = np.array(document["vertices"]) * document["transform"]["scale"] + document["transform"]["translate"]
    faces: dict[str, list[Any]] = defaultdict(list)
    ground: dict[str, list[Any]] = defaultdict(list)
    for name, thing in document["CityObjects"].items():
        owner = thing.get("parents", [name])[0]
        for one in thing.get("geometry", []):
            if one["lod"] != "2.2" or one["type"] != "Solid":
                continue
            kinds = [surface["type"] for surface in one["semantics"]["surfaces"]]
            for face, kind in zip(one["boundaries"][0], one["semantics"]["values"][0], strict=True):
                rings = [xyz[ring] for ring in face]
                if kinds[kind] == "RoofSurface":
                    faces[owner].append(rings)
                elif kinds[kind] == "GroundSurface":
                    ground[owner].append(shapely.Polygon(rings[0][:, :2], [ring[:, :2] for ring in rings[1:]]))
    return {name: _make_found(rings, ground[name]) for name, rings in faces.items()}


def _make_found(faces: list[list[Array]], ground: list[shapely.Polygon]) -> Found:
    polygons = np.array(
        [shapely.Polygon(rings[0][:, :2], [r[:, :2] for r in rings[1:]]) for rings in faces], object
    )
    middle = np.mean([rings[0][0, :2] for rings in faces], axis=0)
    planes = np.zeros((len(faces), 3))
    for k, rings in enumerate(faces):
        rows = np.column_stack((rings[0][:, :2] - middle, np.ones(len(rings[0]))))
        planes[k] = np.linalg.lstsq(rows, rings[0][:, 2], rcond=None)[0]
    planes[:, 2] -= planes[:, :2] @ middle
    return Found(polygons, planes, shapely.union_all(shapely.buffer(ground, 0)))


def count_planes(found: Found) -> int:
    """How many different planes a roof has."""
    kept: list[tuple[Array, Array]] = []
    for polygon, plane in zip(found.faces, found.planes, strict=True):
        x, y = shapely.get_coordinates(polygon.representative_point())[0]
        place = np.array([x, y, 1.0])
        if not any(
            angle_between(plane, other) < SAME_ANGLE and abs((plane - other) @ place) < SAME_HEIGHT
            for other, _ in kept
        ):
            kept.append((plane, place))
    return len(kept)


def angle_between(one: Array, other: Array) -> float:
    """Angle between two planes (degrees)."""
    a, b = np.array([*one[:2], -1.0]), np.array([*other[:2], -1.0])
    return float(np.degrees(np.arccos(np.clip(a @ b / np.linalg.norm(a) / np.linalg.norm(b), -1, 1))))


def name_type(found: Found, body: shapely.Polygon) -> str:
    """Name the type of the main roof by its planes."""
    area = shapely.area(shapely.intersection(shapely.buffer(found.faces, 0), body))
    planes: list[list[Any]] = []
    for plane, size in zip(found.planes, area, strict=True):
        near = next((one for one in planes if angle_between(one[0], plane) < 2 * SAME_ANGLE), None)
        if near is None:
            planes.append([plane, size])
        else:
            near[1] += size
    flat = np.array([0.0, 0.0, 0.0])
    sloped = [plane for plane, size in planes if size > MAIN * body.area and angle_between(plane, flat) > SLOPED]
    if len(sloped) < 2:
        return "shed" if sloped else "flat"
    if len(sloped) == 2:
        return "gabled" if sloped[0][:2] @ sloped[1][:2] < 0 else "other"
    if len(sloped) != 4:
        return "other"
    centre = np.array([body.centroid.x, body.centroid.y])
    rows = np.array([[*plane[:2], -1.0, -(plane[2] + plane[:2] @ centre)] for plane in sloped])
    tip = np.linalg.lstsq(rows[:, :3], rows[:, 3], rcond=None)[0]
    return "pyramidal" if np.abs(rows[:, :3] @ tip - rows[:, 3]).max() < POINT else "hipped"


def compare(truth: dict[str, Any], found: Found) -> dict[str, Any]:
    """Hold a house against its truth."""
    x0, y0 = truth["origin"]
    main, others = truth["planes"][: truth["main"]], truth["planes"][truth["main"] :]
    outline = shapely.Polygon(truth["outline"])
    rings = [shapely.Polygon([corner[:2] for corner in plane["ring"]]) for plane in main]
    body = shapely.union_all(rings, grid_size=0.001)
    hidden = shapely.union_all(
        [shapely.Polygon([c[:2] for c in plane["ring"]]) for plane in others], grid_size=0.001
    )
    tree = shapely.STRtree(found.faces)
    angles, errors = [], []
    for plane, ring in zip(main, rings, strict=True):
        a, b, c = plane["plane"]
        true = np.array([a, b, c - a * x0 - b * y0])
        west, south, east, north = ring.bounds
        places = np.stack(np.meshgrid(np.arange(west, east, STEP), np.arange(south, north, STEP)), axis=-1)
        places = places.reshape(-1, 2)
        shown = ring.difference(hidden).buffer(-0.1)
        places = places[shapely.contains_xy(shown, *places.T)]
        point, face = tree.query(shapely.points(places), "intersects")
        if not len(point):
            continue
        z = found.planes[face, :2] * places[point]
        errors.append(z.sum(axis=1) + found.planes[face, 2] - places[point] @ true[:2] - true[2])
        most = np.argmax(np.bincount(face))
        angles.append(angle_between(found.planes[most], true))
    return {
        "type": name_type(found, body) == truth["type"],
        "planes": count_planes(found) == len(truth["planes"]),
        "angles": angles,
        "outline": outline.symmetric_difference(found.outline).area / outline.length,
        "errors": np.concatenate(errors) if errors else np.empty(0),
    }


def measure(folder: Path, size: float, density: float, class_errors: float) -> None:
    """Scan a town, mesh it, and print a line for each type of roof."""
    town, out = folder / f"town-{density:g}", folder / f"out-{density:g}"
    words = ["--style", "detached", "--size", f"{size:g}", "--seed", "7", "--trees", "0.3", "--workers", "2"]
    words += ["--class-errors", f"{class_errors:g}"]
    if citystitch(["synth", str(town), *words, "--lidar", f"{density:g}", "--levels", "2.2"]):
        raise SystemExit("synth failed")
    inputs = [str(town / "tiles"), "--footprints", str(town / "footprints.gpkg"), "--id-attribute", "id"]
    given = [
        "--out",
        str(out),
        "--mesh-size",
        "20",
        "--domain-height",
        "60",
        "--workers",
        "2",
        "--overwrite",
        "-q",
    ]
    if citystitch(["run", *inputs, *given]):
        raise SystemExit("run failed")
    found = read_model(out / "citymodel.city.json")
    rows: dict[str, list[dict[str, Any]]] = defaultdict(list)
    missed: dict[str, int] = defaultdict(int)
    for line in (town / "truth.jsonl").read_text().splitlines():
        truth = json.loads(line)
        if truth["id"] not in found:
            missed[truth["type"]] += 1
            continue
        row = compare(truth, found[truth["id"]])
        for kind in (truth["type"], "all"):
            rows[kind].append(row)
    for kind in ("flat", "shed", "gabled", "hipped", "pyramidal", "all"):
        told = rows[kind]
        if not told:
            continue
        angles, errors = (np.concatenate([row[name] for row in told]) for name in ("angles", "errors"))
        share = [np.mean([row[name] for row in told]) for name in ("type", "planes")]
        gone = sum(missed.values()) if kind == "all" else missed[kind]
        print(
            f"| {density:g} | {kind} | {len(told)} | {gone} | {100 * share[0]:.1f} | {100 * share[1]:.1f} | "
            f"{np.median(angles):.2f} / {np.percentile(angles, 95):.1f} | "
            f"{np.median([row['outline'] for row in told]):.3f} | {np.median(np.abs(errors)):.3f} / "
            f"{np.sqrt(np.mean(errors**2)):.2f} |",
            flush=True,
        )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--size", type=float, default=2400.0, help="m; 10,000 houses by default")
    parser.add_argument("--density", type=float, nargs="+", default=[2.0, 8.0, 20.0])
    parser.add_argument("--class-errors", type=float, default=0.01)
    given = parser.parse_args()
    print(
        "| pulses/m² | roof | houses | lost | type % | planes % | angle p50 / p95 | outline | height p50 / RMSE |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    for density in given.density:
        measure(given.folder, given.size, density, given.class_errors)


if __name__ == "__main__":
    main()
