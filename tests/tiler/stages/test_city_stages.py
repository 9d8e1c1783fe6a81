"""City models of the region, written tile by tile: the same bytes for any tiles, and clashes across tiles."""

import json
from collections import defaultdict
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely

from pipeline.data.citymodel import CityModel, number_ids
from pipeline.data.errors import InputError
from pipeline.data.roof_forms import NO_FORM
from pipeline.data.roofs import NOT_FITTED, flat_roofs
from pipeline.quality.point_fidelity import HouseFidelity
from tests.helpers.cityjson_rules import file_faults, solid_faults
from tests.helpers.written_models import read_city_model
from tiler.citymodels import cityjson
from tiler.citymodels.tables import Buildings, no_buildings, pack_buildings, take_buildings
from tiler.config.config import Config
from tiler.engine.engine import Engine
from tiler.engine.executor import Serial
from tiler.engine.stage import Box, Facts, Layout, Scope, Stage
from tiler.engine.task import Task
from tiler.stages.citymodel import city_model_stages, house_cells
from tiler.store.out_folder import CITY_MODEL
from tiler.store.store import Store

SIDE = 5000.0  # m
BOUNDS: Box = (120_000.0, 486_000.0, 120_000.0 + SIDE, 486_000.0 + SIDE)


def make_town(n: int, *, seed: int = 4) -> Buildings:
    """Boxes all over the region; a third of the houses have two parts, 60 m apart so that cells cut some."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(100, SIDE - 200, (2, n)).round(3) + np.array([[BOUNDS[0]], [BOUNDS[1]]])
    names, houses, boxes = [], [], []
    for k in range(n):
        for part in range(2 if k % 3 == 0 else 1):
            names.append(f"h{k:04d}" + (f"-part{part + 1}" if k % 3 == 0 else ""))
            houses.append(f"h{k:04d}")
            left = x[k] + 60 * part
            boxes.append(shapely.box(left, y[k], left + rng.uniform(5, 20), y[k] + 9))
    ids, polygons = np.array(names), np.array(boxes, object)
    ground = rng.uniform(-2, 3, len(ids))
    house = np.array(houses)
    model = CityModel(
        polygons, ids, number_ids(ids), ground, flat_roofs(ground + 9), tuple((name,) for name in houses), house
    )
    values = rng.uniform(0, 1, (5, len(ids)))
    fit = HouseFidelity(np.arange(len(ids)), *values)
    zeros = np.zeros(len(ids), np.int8)
    methods = np.full(len(ids), NOT_FITTED, np.int8)
    return Buildings(
        model,
        zeros,
        ground + 8.5,
        ground,
        np.arange(len(ids)),
        zeros.astype(np.int32),
        fit,
        methods,
        zeros,
        np.full(len(ids), NO_FORM, np.int8),
    )


def put_town(task: Task) -> Facts:
    """Stand in for the stages that own houses: all parts of a house are put by one tile, in any order."""
    town: Buildings = task.context.town
    rows = np.random.default_rng(len(task.name)).permutation(task.context.owned.get(task.name, []))
    mine = take_buildings(town, rows) if len(rows) else no_buildings()
    task.put(**pack_buildings(mine), **pack_buildings(mine, "full_"))
    return {"n": len(rows)}


@dataclass(frozen=True)
class Context:
    """What a run's context has that the stages use, and the town."""

    town: Buildings
    owned: dict[str, list[int]]
    out: str
    crs: str = "EPSG:28992"
    bounds: Box = BOUNDS


def write_tiled(out: Path, town: Buildings, size: float) -> Store:
    """Deal the houses out to tiles by their first part, and run the stages."""
    out.mkdir()
    tiles: dict[str, Box] = {}
    n = int(np.ceil(SIDE / size))
    for i in range(n):
        for j in range(n):
            low = BOUNDS[0] + i * size, BOUNDS[1] + j * size
            tiles[f"{i}_{j}"] = (*low, low[0] + size, low[1] + size)
    owned: defaultdict[str, list[int]] = defaultdict(list)
    for k, house in enumerate(town.model.house.tolist()):
        # The parts of a house follow each other.
        first = k - 1 if k and "-part" in town.model.ids[k] and house == town.model.house[k - 1] else k
        x, y = town.model.polygons[first].bounds[:2]
        owned[f"{int((x - BOUNDS[0]) // size)}_{int((y - BOUNDS[1]) // size)}"].append(k)
    context = Context(town, dict(owned), str(out))
    layout = Layout(tiles=tiles, bounds=BOUNDS)
    engine = Engine(out / "store.zarr", layout, parameters=None, context=context, executor=Serial())
    engine.run(
        Stage("houses", Scope.TILE, put_town), Stage("model", Scope.TILE, put_town), *city_model_stages(Config())
    )
    return engine.store


def test_any_tiles_give_the_same_bytes_in_the_order_of_cells(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cityjson, "RUN", 37)  # buildings that share vertices: runs end within cells
    town = make_town(180)
    files = {}
    for size in (700.0, 1100.0, 6000.0):
        out = tmp_path / f"{size:g}"
        write_tiled(out, town, size)
        files[size] = [(out / name).read_bytes() for name in (CITY_MODEL, "citymodel-full.city.json")]
    assert files[700.0] == files[1100.0] == files[6000.0]
    assert files[700.0][0] == files[700.0][1]
    # The order, by hand: cell of the house's first part, row before column, then id.
    first = {h: p.bounds for p, h in reversed(list(zip(town.model.polygons, town.model.house, strict=True)))}
    keys = []
    for name, house in zip(town.model.ids.tolist(), town.model.house.tolist(), strict=True):
        xmin, ymin, xmax, ymax = first[house]
        keys.append(((ymin + ymax) / 2 // 1024, (xmin + xmax) / 2 // 1024, name))
    written = read_city_model(tmp_path / "700" / CITY_MODEL)
    assert written.ids.tolist() == [name for _, _, name in sorted(keys)]
    document = json.loads(files[700.0][0])
    assert not file_faults(document)
    assert not any(solid_faults(document).values())


def test_cells_cut_houses_and_their_parts_stay_together() -> None:
    """Guards the test above: it has houses whose parts lie in two cells."""
    model = make_town(180).model
    own = np.array([[(p.bounds[0] + p.bounds[2]) / 2 // 1024] for p in model.polygons])
    assert (own[:, 0] != house_cells(model)[:, 1]).sum() >= 3


def test_a_region_without_buildings_has_a_valid_model(tmp_path: Path) -> None:
    write_tiled(tmp_path / "o", no_buildings(), 2500.0)
    assert len(read_city_model(tmp_path / "o" / CITY_MODEL)) == 0


def test_a_tile_stays_while_the_next_cell_needs_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    reads: list[str] = []
    plain = Store.read

    def count(store: Store, stage: str, name: str, *, names: Any = None) -> Any:
        reads.extend([name] * (stage == "model" and "member" in names))
        return plain(store, stage, name, names=names)

    monkeypatch.setattr(Store, "read", count)
    write_tiled(tmp_path / "o", make_town(90), 6000.0)
    assert reads == ["0_0"]


def rename(town: Buildings, old: str, new: str) -> Buildings:
    """Another id for a house of one part."""
    ids, house = town.model.ids.astype("<U20"), town.model.house.astype("<U20")
    house[ids == old] = new
    ids[ids == old] = new
    numbers = np.array([int(number_ids(ids[k : k + 1])[0]) for k in range(len(ids))])
    return replace(town, model=replace(town.model, ids=ids, house=house, numbers=numbers))


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (("0123", "123"), "building ids '0123' and '123' both have the number 123"),
        (("twin", "twin"), r"building id 'twin': 2 buildings have it, in tiles \d+_\d+, \d+_\d+; rename"),
    ],
)
def test_clashes_of_far_tiles_are_found(tmp_path: Path, names: tuple[str, str], message: str) -> None:
    town = make_town(60)
    x = [polygon.bounds[0] for polygon in town.model.polygons]
    single = [k for k in np.argsort(x) if "-part" not in town.model.ids[k]]
    for k, name in zip((single[0], single[-1]), names, strict=True):
        town = rename(town, town.model.ids[k], name)
    with pytest.raises(InputError, match=message):
        write_tiled(tmp_path / "o", town, 700.0)
    assert not (tmp_path / "o" / CITY_MODEL).exists()
