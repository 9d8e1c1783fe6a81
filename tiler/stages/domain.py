"""Stages between city model and seams: what the domain's height is measured by, and layers that wait for it."""

from typing import Any

import numpy as np
import shapely

from pipeline.city_model.groups import adjacent_houses
from pipeline.columns.layered import LayeredOptions, choose_layers, terrain_reach
from pipeline.data.notes import Note
from tiler.citymodels.tables import unpack_buildings, unpack_polygons
from tiler.config.config import Config
from tiler.config.domain_height import GUIDELINE, Domain, height_in_metres, is_low
from tiler.config.step_options import PAD_PARAMETERS, layer_parameters, mesh_options
from tiler.engine.stage import Facts, Read, Scope, Stage
from tiler.engine.task import Task
from tiler.stages.approach import ground_stage
from tiler.stages.city import chooses_layers_later
from tiler.stages.left_out import LEFT_OUT, left_out_stage
from tiler.stages.readers import grow, read_known_terrain

LOW_DOMAIN = "domain-lower-than-guidelines"


def domain_stages(config: Config) -> list[Stage]:
    """Stages that find what is left out, the tallest building and, for a flat top, the highest ground."""
    reads = [Read("model"), Read(LEFT_OUT)]
    stages = [left_out_stage(config)]
    if config.top == "flat":
        stages += [Stage("summits", Scope.TILE, find_summit, (Read("terrain", own=True),), after=LEFT_OUT)]
        reads += [Read("summits")]
    parameters = ("domain_height", "top")
    return [*stages, Stage("domain", Scope.REGION, measure_domain, tuple(reads), parameters, version=2)]


def layer_stages(config: Config, domain: Domain) -> list[Stage]:
    """Stage that chooses the layers of roofs where the domain's height is not known before the city model."""
    if not chooses_layers_later(config):
        return []
    reach = mesh_reach(config, domain) + 2 * config.dtm_spacing
    reads = (Read("model", own=True), Read(ground_stage(config), reach, around="model"))
    parameters = (*layer_parameters(config), "dtm_spacing", *(PAD_PARAMETERS[:1] if config.padded else ()))
    return [Stage("layers", Scope.TILE, choose_tile_layers, reads, parameters, version=3)]


def mesh_reach(config: Config, domain: Domain) -> float:
    """How far beyond walls terrain counts for the layers of roofs (m)."""
    options = mesh_options(config, domain)
    return terrain_reach(options) if isinstance(options, LayeredOptions) else 0.0


def find_summit(task: Task) -> Facts:
    """Find the highest terrain of a tile."""
    (terrain,) = task.read("terrain", ("z",))
    return {"highest_ground": float(terrain.arrays["z"].max())}


def measure_domain(task: Task) -> Facts:
    """Find the tallest building and the highest terrain; note a domain that is too low for the building.

    Buildings that were left out count: their neighbours stand in their wind.
    """
    given = task.parameters
    best: tuple[float, str, str] = (0.0, "", "")
    for result in task.read("model", ("ground", "roof", "id")):
        found = result.arrays
        if len(found["id"]):
            height = found["roof"] - found["ground"]
            row = np.lexsort((found["id"], -height))[0]
            best = min(best, (-float(height[row]), str(found["id"][row]), result.name))
    tallest, building, tile = abs(best[0]), best[1], best[2]
    facts: dict[str, Any] = {"tallest": tallest, "tallest_meshed": tallest, "building": building}
    lost, words = _tallest_left_out(task), "the tallest building's"
    place: tuple[float, float] | None = None
    if lost is not None:
        facts["left_out"] = lost
        if lost["height"] > tallest:
            tallest, building, place = lost["height"], lost["id"], (lost["x"], lost["y"])
            words = f"the height of building {building}, which is left out:"
            facts |= {"tallest": tallest, "building": building}
    if given.top == "flat":
        facts["highest_ground"] = max(result.facts["highest_ground"] for result in task.read("summits", ()))
    height = height_in_metres(given.domain_height, tallest)
    if is_low(height, tallest):
        wanted = f"guidelines (COST 732, AIJ) ask for {GUIDELINE:g} times: --domain-height {GUIDELINE:g}H"
        times = f"{height / tallest:.2f} times {words} {tallest:.1f} m"
        detail = f"the domain is {height:.1f} m high, {times}; {wanted}"
        task.note(Note(LOW_DOMAIN, building, *(place or _place(task, tile, building)), detail))
    return facts


def _tallest_left_out(task: Task) -> dict[str, Any] | None:
    """Id, height and place of the tallest building that was left out; None where none has a height."""
    best: dict[str, Any] | None = None
    for result in task.read(LEFT_OUT, ("id", "height", "place")):
        found = result.arrays
        for row in np.flatnonzero(found["height"] > 0).tolist():
            height, name = float(found["height"][row]), str(found["id"][row])
            if best is None or (-height, name) < (-best["height"], best["id"]):
                x, y = found["place"][row].tolist()
                best = {"id": name, "height": height, "x": x, "y": y}
    return best


def choose_tile_layers(task: Task) -> Facts:
    """Choose the layers that become the roofs of the buildings that a tile owns (step 3.4)."""
    given, bounds = task.parameters, task.context.bounds
    (result,) = task.read("model")
    extent = result.facts["extent"]
    if extent is None:
        task.put(layers=np.empty(0, np.int32))
        return {"extent": None}
    options = mesh_options(given)
    if not isinstance(options, LayeredOptions):
        raise ValueError("only the layered mesher has layers")
    buildings = unpack_buildings(result.arrays)
    model = buildings.model
    reach = terrain_reach(options) + 2 * given.dtm_spacing
    layers, parted = choose_layers(
        model.polygons,
        model.roof,
        buildings.wall_ground,
        buildings.group.astype(np.int32),
        adjacent_houses(model.polygons),
        read_known_terrain(task, grow(tuple(extent), reach), spacing=given.dtm_spacing, bounds=bounds),
        bounds,
        options,
    )
    task.put(layers=layers)
    return {"extent": extent, "counts": {"roofs on another layer": parted} if parted else {}}


def _place(task: Task, tile: str, building: str) -> tuple[float, float]:
    """A place in a building (m)."""
    arrays, _ = task.store.read("model", tile, names=("polygon", "polygon_start", "id"))
    row = int(np.flatnonzero(arrays["id"] == building)[0])
    x, y = shapely.get_coordinates(shapely.point_on_surface(unpack_polygons(arrays, "polygon")[row]))[0].tolist()
    return x, y
