"""The roofs of a run held against the truth of a synthetic town, ``truth.jsonl``."""

import json
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.data.errors import ConfigError, InputError
from pipeline.quality.roof_truth import FoundRoof, compare_roof, make_roof, summarise_roofs
from tiler.report.page import number, paragraph, table
from tiler.store.json_stream import iterate_elements, iterate_members, read_members
from tiler.store.out_folder import CITY_MODEL

LOD = "2.2"
HEAD = (
    *("main roof", "houses", "not found", "right type", "right planes"),
    *("angle (°)", "95 % below (°)", "outline (m)", "height (m)", "RMSE (m)"),
)
SHARES = ("right_type", "right_planes")
NUMBERS = ("angle_50", "angle_95", "outline", "height_50", "height_rmse")


def compare_with_truth(directory: Path, truth: Path) -> list[dict[str, Any]]:
    """Hold the city model of a run, level 2.2, against the truth of its town.

    Parameters
    ----------
    directory : Path
        Folder of a run whose buildings have the ids of the town.
    truth : Path
        ``truth.jsonl`` of ``citystitch synth --lidar``.

    Returns
    -------
    list of dict
        As from `pipeline.quality.roof_truth.summarise_roofs`.

    Raises
    ------
    ConfigError
        If there is no such file, or none of its houses is in the city model.
    InputError
        If a line of it is no house.

    Notes
    -----
    Houses come one at a time; memory is that of the roofs of the city model.
    """
    found = read_roofs(directory / CITY_MODEL)
    compared, lost = [], Counter[str]()
    for house in _read_truth(truth):
        if house["id"] in found:
            compared.append(compare_roof(house, found[house["id"]]))
        else:
            lost[house["type"]] += 1
    if not compared:
        raise ConfigError(
            f"{truth}: none of its {sum(lost.values()):,} houses is in {directory / CITY_MODEL}; give the truth "
            "of the town that was meshed, and --id-attribute id to the run"
        )
    return summarise_roofs(compared, lost)


def _read_truth(path: Path) -> Iterator[dict[str, Any]]:
    try:
        with path.open(encoding="utf-8") as file:
            for n, line in enumerate(file, 1):
                try:
                    house = json.loads(line)
                    house["id"], house["type"], house["planes"], house["main"], house["outline"], house["origin"]
                except (ValueError, TypeError, KeyError) as error:
                    raise InputError(f"{path}: line {n} is no house of a town ({error}); make it again") from error
                yield house
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror}); give the truth.jsonl of a town") from error


def read_roofs(path: Path) -> dict[str, FoundRoof]:
    """Read the roofs of level 2.2 of all buildings of a city model, by their ids."""
    transform = read_members(path, ("transform",).__contains__)[0]["transform"]
    xyz = np.array(list(iterate_elements(path, "vertices")), np.float64).reshape(-1, 3)
    xyz = xyz * transform["scale"] + transform["translate"]
    faces: dict[str, list[list[NDArray[np.float64]]]] = defaultdict(list)
    ground: dict[str, list[shapely.Polygon]] = defaultdict(list)
    for name, thing in iterate_members(path, "CityObjects"):
        owner = thing.get("parents", [name])[0]
        for one in thing.get("geometry", []):
            if one["lod"] != LOD or one["type"] != "Solid":
                continue
            kinds = [surface["type"] for surface in one["semantics"]["surfaces"]]
            for face, kind in zip(one["boundaries"][0], one["semantics"]["values"][0], strict=True):
                rings = [xyz[ring] for ring in face]
                if kinds[kind] == "RoofSurface":
                    faces[owner].append(rings)
                elif kinds[kind] == "GroundSurface":
                    ground[owner].append(shapely.Polygon(rings[0][:, :2], [ring[:, :2] for ring in rings[1:]]))
    return {name: make_roof(rings, ground[name]) for name, rings in faces.items()}


def describe_truth(rows: list[dict[str, Any]]) -> Iterator[str]:
    """Show how the roofs of the city model differ from the true ones."""
    yield paragraph(
        "Roofs of the city model against the town that was scanned. The type is that of the main roof; planes are "
        "those of dormers and parts, too: right if there are as many. Angles and heights are of the main roof, "
        "outlines of the whole house; they are medians where nothing else is said."
    )
    shown = [
        [
            row["type"],
            number(row["houses"]),
            number(row["lost"]),
            *(f"{100 * row[name]:.1f} %" if name in row else "" for name in SHARES),
            *(f"{row[name]:.3f}" if name in row else "" for name in NUMBERS),
        ]
        for row in rows
    ]
    yield table("Roofs against the truth, by type", HEAD, shown)
