"""Stages 1.7 and 2.4: the city model of the region as CityJSON files, before and after it is simplified."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.data.citymodel import CityModel, number_ids
from pipeline.data.errors import InputError
from pipeline.data.roofs import NOT_FITTED
from pipeline.quality.building_facts import describe_roofs, report_buildings
from pipeline.quality.roof_fits import RoofFits
from tiler.citymodels.cityjson import Attributes, write_city_blocks
from tiler.citymodels.tables import (
    BUILDING_ARRAYS,
    ROOF_ARRAYS,
    ZONE_ARRAYS,
    Buildings,
    join_buildings,
    take_buildings,
    unpack_buildings,
    unpack_polygons,
    unpack_roofs,
)
from tiler.config.config import Config
from tiler.config.step_options import ZONE_PARAMETERS
from tiler.config.zones import LEVELS, LOD, LOD_POINT
from tiler.engine.stage import Facts, Read, Scope, Stage
from tiler.engine.task import Task
from tiler.store.checksums import FILES, state_files
from tiler.store.out_folder import CITY_MODEL, FULL_CITY_MODEL

CELL = 1024.0  # side of the cells that buildings are sorted by (m), in the CRS


def city_model_stages(config: Config) -> list[Stage]:
    """Stages that write the city models."""
    zones = ZONE_PARAMETERS if config.zoned else ()
    return [
        Stage("citymodel-full", Scope.REGION, write_full_model, (Read("houses"),), version=2),
        Stage("citymodel", Scope.REGION, write_simple_model, (Read("model"),), zones),
    ]


def write_full_model(task: Task) -> Facts:
    """Write the city model before it is simplified (step 1.7)."""
    return _write(task, "houses", "full_", FULL_CITY_MODEL)


def write_simple_model(task: Task) -> Facts:
    """Write the simplified city model (step 2.4)."""
    return _write(task, "model", "", CITY_MODEL)


def house_cells(model: CityModel) -> NDArray[np.int64]:
    """Give the cell that each building is sorted by: that of its house, so that the parts of one stay together.

    Parameters
    ----------
    model : CityModel
        Buildings, all parts of each house among them.

    Returns
    -------
    int64, (n, 2)
        Row and column (j, i) of the grid of `CELL` metres from the CRS's origin that holds the centre of the box
        of the house's part of smallest id.

    Examples
    --------
    >>> from pipeline.data.citymodel import CityModel
    >>> from pipeline.data.roofs import flat_roofs
    >>> ids, one = np.array(["a-2", "a-1", "b"]), np.ones(3)
    >>> boxes = shapely.box([9, 1020, 3000], [0, 0, 5], [10, 1030, 3010], [5, 5, 9])
    >>> roofs = flat_roofs(one)
    >>> house_cells(CityModel(boxes, ids, one, one, roofs, ((),) * 3, np.array(["a", "a", "b"]))).tolist()
    [[0, 1], [0, 1], [0, 2]]
    """
    order = np.argsort(model.ids, kind="stable")
    _, first, row = np.unique(model.house[order], return_index=True, return_inverse=True)
    box = shapely.bounds(model.polygons).reshape(-1, 4)
    # The box of a polygon has no rounding: the same whatever vertex it starts with.
    cell: NDArray[np.int64] = np.floor((box[:, :2] + box[:, 2:]) / 2 / CELL).astype(np.int64)[:, ::-1]
    cells: NDArray[np.int64] = np.empty_like(cell)
    cells[order] = cell[order[first]][row.reshape(-1)]
    return cells


@dataclass(frozen=True, eq=False)
class _Survey:
    """What must be known of all tiles before the first building is written.

    ``cell`` (k, 2) and ``tile`` (k,): which tiles have houses of which cells, by cell and tile; ``number`` (n,)
    and ``of`` (n,): number and tile of every building; lowest ground and highest roof (m).
    """

    names: tuple[str, ...]
    cell: NDArray[np.int64]
    tile: NDArray[np.int64]
    number: NDArray[np.int64]
    of: NDArray[np.int64]
    low: float
    high: float


def _write(task: Task, stage: str, prefix: str, file: str) -> Facts:
    fits = RoofFits()
    with task.step("survey"):
        survey = _survey(task, stage, prefix)
        _check_numbers(task, stage, prefix, survey)
    xmin, ymin, xmax, ymax = task.context.bounds
    blocks = ((part.model, describe_buildings(part, fits)) for part in _by_cell(task, stage, prefix, survey))
    bounds = (xmin, ymin, survey.low, xmax, ymax, survey.high)
    with task.step("write"), task.output() as out:
        task.notes(write_city_blocks(out / file, blocks, crs=task.context.crs, bounds=bounds))
        written = state_files(out, [out / file])
    table = fits.by_method()
    return {"n": len(survey.number), FILES: written} | (
        {"roof_fit": table, "worst_roofs": fits.worst} if table else {}
    )


def _survey(task: Task, stage: str, prefix: str) -> _Survey:
    """Look at all tiles, one after the other."""
    arrays = ("polygon", "polygon_start", "id", "number", "house", "ground", *ROOF_ARRAYS)
    wanted = [prefix + name for name in arrays]
    names = task.refs[stage]
    cells, tiles = [np.empty((0, 2), np.int64)], [np.empty(0, np.int64)]
    numbers, of = [np.empty(0, np.int64)], [np.empty(0, np.int64)]
    ground, roof = [], []
    for k, result in enumerate(task.read(stage, wanted)):
        model = _outlines(result.arrays, prefix)
        if len(model) == 0:
            continue
        own = np.unique(house_cells(model), axis=0)
        cells.append(own)
        tiles.append(np.full(len(own), k))
        numbers.append(model.numbers)
        of.append(np.full(len(model), k))
        ground.append(float(model.ground.min()))
        roof.append(float(model.roof.max()))
    cell, tile = np.concatenate(cells), np.concatenate(tiles)
    order = np.lexsort((tile, cell[:, 1], cell[:, 0]))
    return _Survey(
        names,
        cell[order],
        tile[order],
        np.concatenate(numbers),
        np.concatenate(of),
        min(ground, default=0.0),
        max(roof, default=0.0),
    )


def _outlines(arrays: dict[str, NDArray[Any]], prefix: str) -> CityModel:
    """Make of a tile's arrays what the survey needs: no members."""
    own = {name.removeprefix(prefix): values for name, values in arrays.items()}
    polygons, ids = unpack_polygons(own, "polygon"), own["id"]
    members: tuple[tuple[str, ...], ...] = ((),) * len(ids)
    return CityModel(polygons, ids, own["number"], own["ground"], unpack_roofs(own), members, own["house"])


def _check_numbers(task: Task, stage: str, prefix: str, survey: _Survey) -> None:
    """Refuse two ids of one number, and an id that two buildings have, over the whole region.

    8 bytes a building are looked at; ids are read again only of tiles that share a number.
    """
    order = np.argsort(survey.number, kind="stable")
    number = survey.number[order]
    shared = np.unique(number[1:][np.diff(number) == 0])
    if len(shared) == 0:
        return
    tiles = np.unique(survey.of[np.isin(survey.number, shared)]).tolist()
    found = [task.store.read(stage, survey.names[k], names=(prefix + "id",))[0][prefix + "id"] for k in tiles]
    place = np.repeat([survey.names[k] for k in tiles], [len(ids) for ids in found])
    names = np.concatenate(found)
    number_ids(names)
    once, count = np.unique(names, return_counts=True)
    name = once[count > 1][0]
    raise InputError(
        f"building id {str(name)!r}: {int(count.max())} buildings have it, in tiles "
        f"{', '.join(np.unique(place[names == name]).tolist())}; rename one, or name another --id-attribute"
    )


def _by_cell(task: Task, stage: str, prefix: str, survey: _Survey) -> Iterator[Buildings]:
    """Give the buildings of one cell after the other, by id, holding the tiles of a cell and of the one before."""
    zoned = stage == "model" and task.parameters.get("zones", ())
    arrays = [prefix + array for array in (*BUILDING_ARRAYS, *(ZONE_ARRAYS if zoned else ()))]
    held: dict[int, tuple[Buildings, NDArray[np.int64]]] = {}
    cells, start = np.unique(survey.cell, axis=0, return_index=True)
    for cell, tiles in zip(cells, np.split(survey.tile, start[1:]), strict=False):
        held = {k: held[k] for k in tiles.tolist() if k in held}
        for k in tiles.tolist():
            if k not in held:
                found, _ = task.store.read(stage, survey.names[k], names=arrays)
                buildings = unpack_buildings(found, prefix)
                held[k] = buildings, house_cells(buildings.model)
        yield join_buildings(
            [take_buildings(held[k][0], np.flatnonzero((held[k][1] == cell).all(axis=1))) for k in tiles.tolist()]
        )


def describe_buildings(buildings: Buildings, fits: RoofFits) -> Attributes:
    """Give the attributes of buildings, and add their roofs to `fits`."""
    told: dict[str, Sequence[object]] = report_buildings(
        buildings.model, buildings.roof_source, buildings.measured_roof, buildings.fidelity
    )
    if (buildings.level >= 0).any():
        told |= {LOD: [LEVELS[level] for level in buildings.level.tolist()], LOD_POINT: buildings.place.tolist()}
    method, fallback = buildings.roof_method, buildings.roof_fallback
    if (method != NOT_FITTED).any():
        roofs = describe_roofs(buildings.model, method, fallback, buildings.roof_form, buildings.fidelity)
        fits.add(buildings.model, method, buildings.fidelity, roofs)
        told |= roofs
    return told
