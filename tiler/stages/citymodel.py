"""Stages 1.7 and 2.4: the city model of the region as CityJSON files, before and after it is simplified."""

from collections.abc import Sequence
from pathlib import Path

from pipeline.building_facts import tell_buildings
from tiler.cityjson import write_city_model
from tiler.stage import Facts, Read, Scope, Stage
from tiler.tables import BUILDING_ARRAYS, Buildings, join_buildings, unpack_buildings
from tiler.task import Task

FULL_CITY_MODEL = "citymodel-full.city.json"
CITY_MODEL = "citymodel.city.json"


def city_model_stages() -> list[Stage]:
    """Stages that write the city models."""
    return [
        Stage("citymodel-full", Scope.REGION, write_full_model, (Read("houses"),)),
        Stage("citymodel", Scope.REGION, write_simple_model, (Read("model"),)),
    ]


def write_full_model(task: Task) -> Facts:
    """Write the city model before it is simplified (step 1.7)."""
    return _write(task, "houses", "full_", FULL_CITY_MODEL)


def write_simple_model(task: Task) -> Facts:
    """Write the simplified city model (step 2.4)."""
    return _write(task, "model", "", CITY_MODEL)


def _write(task: Task, stage: str, prefix: str, name: str) -> Facts:
    arrays = [prefix + array for array in BUILDING_ARRAYS]
    buildings = join_buildings([unpack_buildings(result.arrays, prefix) for result in task.read(stage, arrays)])
    task.notes(
        write_city_model(
            Path(task.context.out) / name,
            buildings.model,
            crs=task.context.crs,
            bounds=_bounds(task, buildings),
            attributes=_tell(buildings),
        )
    )
    return {"n": len(buildings)}


def _bounds(task: Task, buildings: Buildings) -> tuple[float, ...]:
    xmin, ymin, xmax, ymax = task.context.bounds
    model = buildings.model
    low, high = (float(model.ground.min()), float(model.roof.max())) if len(model) else (0.0, 0.0)
    return xmin, ymin, low, xmax, ymax, high


def _tell(buildings: Buildings) -> dict[str, Sequence[object]]:
    return tell_buildings(buildings.model, buildings.roof_source, buildings.measured_roof, buildings.fidelity)
