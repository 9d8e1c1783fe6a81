"""City models that the project wrote, read back with all attributes."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.data.citymodel import CityModel
from pipeline.data.roofs import Roofs, choose_roofs, flat_roofs
from tiler.citymodels.building_index import PLANE, PLANE_VALUES


def read_city_model(path: Path) -> CityModel:
    """Read a file of `write_city_model`: footprints with its 1 mm, an empty Polygon where there is no geometry."""
    document = json.loads(path.read_text(encoding="utf-8"))
    transform = document["transform"]
    vertices = np.array(document["vertices"], dtype=np.float64).reshape(-1, 3)[:, :2]
    vertices = vertices * transform["scale"][:2] + transform["translate"][:2]
    objects = {name: item for name, item in document["CityObjects"].items() if "children" not in item}
    rows = [item["attributes"] for item in objects.values()]
    polygons = np.empty(len(objects), dtype=np.object_)
    polygons[:] = [_footprint(item["geometry"], vertices) for item in objects.values()]
    stated = [row.get(PLANE) for row in rows]
    plane = np.array([[np.nan] * PLANE_VALUES if one is None else one for one in stated], np.float64)
    plane = plane.reshape(-1, PLANE_VALUES)
    flat = flat_roofs(np.array([row["roof_height"] for row in rows], dtype=np.float64))
    sloped = Roofs(plane[:, :3], plane[:, 3:5], plane[:, 5:])
    return CityModel(
        polygons=polygons,
        ids=np.array(list(objects), dtype=np.str_),
        numbers=np.array([row["number"] for row in rows], dtype=np.int64),
        ground=np.array([row["ground_height"] for row in rows], dtype=np.float64),
        roofs=choose_roofs(np.array([one is None for one in stated], np.bool_), flat, sloped),
        members=tuple(tuple(row["members"]) for row in rows),
        house=np.array([item.get("parents", [name])[0] for name, item in objects.items()], dtype=np.str_),
    )


def _footprint(geometry: list[dict[str, Any]], xy: NDArray[np.float64]) -> shapely.Polygon:
    for item in geometry:
        if item["lod"] == "0":
            shell, *holes = (xy[ring] for ring in item["boundaries"][0])
            return shapely.Polygon(shell, holes)
    return shapely.Polygon()
