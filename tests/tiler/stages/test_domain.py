"""Height and top of the domain in tiled runs: of the region, not of its tiles; told where they are too low."""

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from numpy.typing import NDArray

from pipeline.data.errors import ConfigError, InputError
from stitch.tiling.grid import Bounds
from tests.helpers.cities import crowded_blocks
from tests.helpers.tiles import SIZE, Town, around, hash_files, make_town, prove, prove_local, write_town
from tests.runs.test_tiled_runs import TILE
from tiler.cli.main import main
from tiler.config.config import Config, idle_parameters, make_config
from tiler.config.config_file import load_config
from tiler.config.domain_height import Domain, read_height, resolve_height
from tiler.config.step_options import expected_levels
from tiler.mesh_files.vtk_files import read_vtu
from tiler.stages.domain import LOW_DOMAIN, layer_stages
from tiler.stages.mesh import mesh_stages
from tiler.store.store import Store
from tiler.workflow.run import run
from tiler.workflow.single_tile import run_alone

NEW = {"first_layer", "layer_growth", "top_elevation"}
CFD = {"first_layer": 0.5, "layer_growth": 1.25, "top": "flat"}
MIDDLE = ((TILE[0] + 0.5) * SIZE, (TILE[1] + 0.5) * SIZE)
TOWER = 31.0  # m above its ground
PEAK = 12.0  # m


@dataclass(frozen=True, eq=False)
class Hill(Town):
    """A town with its highest ground in the middle of a tile, and its tallest building beside that."""

    def ground(self, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        far = (x - MIDDLE[0]) ** 2 + (y - MIDDLE[1]) ** 2
        hill: NDArray[np.float64] = 5.0 + PEAK * np.exp(-far / (2 * 45.0**2)) + np.sin(x / 40)
        return hill


def hill_town(tiles: float, *, seed: int = 5, houses: int = 60) -> Hill:
    """A tile in the middle of a region of some tiles on every side, with a tower."""
    region = around(TILE, tiles)
    x, y = MIDDLE
    tower = shapely.box(x + 20, y + 15, x + 34, y + 31)
    free = shapely.buffer(tower, 8.0)
    blocks = [block for block in crowded_blocks(region, houses, seed=seed) if not block.intersects(free)]
    town = make_town(region, [*blocks, tower], seed=seed)
    heights = np.append(town.heights[:-1], TOWER)
    return Hill(region, town.polygons, heights)


def highest_ground(bounds: Bounds) -> float:
    x, y = np.meshgrid(np.arange(bounds[0], bounds[2]), np.arange(bounds[1], bounds[3]))
    return float(hill_town(0.0, houses=0).ground(x, y).max())


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Files of a town of 280 m, on four tiles of 140 m or one of 280 m, and what a configuration says of them."""
    folder = tmp_path_factory.mktemp("town")
    i, j = TILE
    region = (i * SIZE, j * SIZE, (i + 2) * SIZE, (j + 2) * SIZE)
    hill = hill_town(1.0)
    inner = shapely.box(*region).buffer(-4.0)
    rows = [k for k, polygon in enumerate(hill.polygons) if polygon.within(inner)]
    small = Hill(region, hill.polygons[rows], hill.heights[rows])
    return write_town(folder, small, files=(2, 1)) | {"tile_size": SIZE}


@pytest.mark.parametrize("mesher", ["adaptive", pytest.param("layered", marks=pytest.mark.long)])
def test_a_flat_top_above_grown_layers_is_proved_in_tiles_of_any_size(
    town: dict[str, Any], mesher: str, tmp_path: Path
) -> None:
    given = town | CFD | {"mesher": mesher, "domain_height": "6H"}
    facts, models = [], []
    for size in (SIZE, 2 * SIZE):
        out = tmp_path / f"{size:g}"
        record = run(make_config(given | {"tile_size": size, "out": str(out)}))
        report = prove(out)
        assert record["exit_code"] == 0
        assert LOW_DOMAIN not in record["notes"]
        tallest = record["domain"]["tallest building (m)"]
        assert tallest == pytest.approx(TOWER, abs=1.5)
        assert record["domain"]["height (m)"] == pytest.approx(6 * tallest)
        assert any(f"(stated {record['region']['top']:.6f} m)" in proof.claim for proof in report.proofs)
        ground = record["region"]["top"] - record["domain"]["height (m)"]
        assert ground == pytest.approx(highest_ground(record["region"]["bounds"]), abs=0.1)
        facts.append((record["domain"], record["region"]["top"], len(record["tiles"])))
        models.append(hash_files(out, besides=lambda path: not path.name.startswith("citymodel")))
    assert facts[0][:2] == facts[1][:2]
    assert (facts[0][2], facts[1][2]) == (4, 1)
    assert models[0] == models[1]
    assert len(models[0]) >= 2


@pytest.mark.long
@pytest.mark.shared
@pytest.mark.parametrize("mesher", ["adaptive", "layered"])
def test_real_blocks_have_a_flat_top_above_grown_layers(shared_data: Path, mesher: str, tmp_path: Path) -> None:
    data = shared_data / "amsterdam"
    inputs = {"pointcloud": [str(data / "tiles")], "footprints": str(data / "footprints.gpkg")}
    given = (
        inputs
        | CFD
        | {"crs": "EPSG:28992"}
        | {"first_layer": 1.0, "domain_height": "3H", "tile_size": 150.0, "mesher": mesher}
        | {"bounds": [120_700.0, 486_000.0, 121_000.0, 486_300.0]}
    )
    record = run(make_config(given | {"out": str(tmp_path)}))
    report = prove(tmp_path)
    assert report.facts["seam_faces"] > 3000
    assert record["notes"][LOW_DOMAIN]["count"] == 1
    assert record["quality"]["radius_ratio"]["0"] > 0.03


@pytest.mark.parametrize(
    ("mesher", "options"),
    [
        ("adaptive", CFD | {"domain_height": "1.5H"}),
        pytest.param("layered", CFD | {"domain_height": "1.3H"}, marks=pytest.mark.long),
    ],
)
def test_a_tile_is_the_same_in_a_larger_region(mesher: str, options: dict[str, Any], tmp_path: Path) -> None:
    """The larger region has neither a higher ground nor a taller building."""
    values = write_town(tmp_path / "city", hill_town(1.8, houses=100), files=(2, 2))
    values |= options | {"tile_size": SIZE, "mesher": mesher}
    least = 1.0 if mesher == "adaptive" else 1.5
    prove_local(values, TILE, tmp_path, around(TILE, least + 0.2), around(TILE, least))


@pytest.mark.parametrize("mesher", [pytest.param("adaptive", marks=pytest.mark.long), "layered"])
def test_a_tile_alone_has_the_domain_of_the_whole(town: dict[str, Any], mesher: str, tmp_path: Path) -> None:
    """Four tiles alone know the highest ground and the tallest building of nine."""
    values = write_town(tmp_path / "city", hill_town(1.0)) | CFD | {"tile_size": SIZE, "mesher": mesher}
    out = tmp_path / "out"
    i, j = TILE
    far = {"bounds": ((i - 1) * SIZE, (j - 1) * SIZE, (i + 2) * SIZE, (j + 2) * SIZE), "domain_height": "1.5H"}
    config = make_config(values | far | {"out": str(out)})
    with pytest.raises(InputError, match="follows from the whole region, and its run has not come that far"):
        run_alone(dataclasses.replace(config, out=str(tmp_path / "none")), f"{i}_{j}")
    run(config)
    name = f"{i - 1}_{j - 1}"
    piece = run_alone(config, name)
    alone, whole = (read_vtu(path).mesh for path in (piece, out / "mesh" / f"{name}.vtu"))
    assert alone.points.tobytes() == whole.points.tobytes()
    assert alone.cells.tobytes() == whole.cells.tobytes()


def test_a_low_domain_is_told_and_counted(
    town: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    command = ["run", *town["pointcloud"], "--footprints", town["footprints"], "--tile-size", f"{SIZE:g}"]
    assert main([*command, "--out", str(out), "--domain-height", "5h"]) == 0
    shown = capsys.readouterr().out
    assert "the domain is 16" in shown
    assert "5.00 times the tallest building's 3" in shown
    assert "  the domain is lower than six times the tallest building" in shown
    record = json.loads((out / "run.json").read_text())
    (note,) = record["notes"][LOW_DOMAIN]["items"]
    assert record["notes"][LOW_DOMAIN]["count"] == 1
    tower = shapely.box(MIDDLE[0] + 19, MIDDLE[1] + 14, MIDDLE[0] + 35, MIDDLE[1] + 32)
    assert tower.contains(shapely.Point(note["x"], note["y"]))
    # As high as it must be, nothing is said; the city model and what is before it stay.
    enough = 6 * record["domain"]["tallest building (m)"]
    high = run(make_config(load_config(out / "config.toml") | {"domain_height": enough}))
    assert LOW_DOMAIN not in high["notes"]
    assert not [message for message in high["messages"] if LOW_DOMAIN in message]
    assert not {"ground", "houses", "model", "citymodel"} & high["ran"].keys()


def test_without_buildings_nothing_is_low_and_no_multiple_is_known(town: dict[str, Any], tmp_path: Path) -> None:
    empty = town | {"footprints": "", "domain_height": 40.0}
    record = run(make_config(empty | {"out": str(tmp_path / "out")}))
    assert record["domain"]["height (m)"] == 40.0
    assert record["domain"]["tallest building (m)"] == 0.0
    assert LOW_DOMAIN not in record["notes"]
    with pytest.raises(ConfigError, match="domain_height = 6H: there are no buildings in the region"):
        run(make_config(empty | {"domain_height": "6H", "out": str(tmp_path / "multiple")}))


def test_a_multiple_that_is_too_low_for_the_cells_ends_with_two(town: dict[str, Any], tmp_path: Path) -> None:
    command = ["run", *town["pointcloud"], "--footprints", town["footprints"], "--tile-size", f"{SIZE:g}"]
    assert main([*command, "--out", str(tmp_path / "out"), "--domain-height", "0.1H"]) == 2


def test_keys_know_the_options_only_where_they_are_used() -> None:
    plain = {name for stage in mesh_stages(Config()) for name in stage.parameters}
    assert not NEW & plain
    used = Config(first_layer=1.0, top="flat")
    for stage in mesh_stages(used):
        assert set(stage.parameters) >= NEW
    assert layer_stages(Config(mesher="layered"), Domain(100.0, None)) == []
    (layers,) = layer_stages(Config(mesher="layered", top="flat"), Domain(100.0, 120.0))
    assert "top_elevation" in layers.parameters


def test_the_city_model_does_not_wait_for_the_domain_of_adaptive_columns(
    town: dict[str, Any], tmp_path: Path
) -> None:
    """Digests of the city model are those of a run without any of the options."""
    digests = []
    changes: tuple[dict[str, Any], ...] = ({"domain_height": 60.0}, CFD | {"domain_height": "2H"})
    for k, more in enumerate(changes):
        out = tmp_path / str(k)
        run(make_config(town | more | {"out": str(out)}))
        store = Store(out / "store.zarr")
        digests.append({name: store.describe("model", name)[1] for name in store.names("model")})
        assert ("summits" in store.stages()) == (k == 1)
    assert digests[0] == digests[1]


@pytest.mark.parametrize(
    ("text", "read"), [("6H", "6H"), (" 6.50 h ", "6.5H"), (".5H", "0.5H"), ("80", 80.0), (80.0, 80.0)]
)
def test_heights_are_read(text: str | float, read: str | float) -> None:
    assert read_height(text) == read
    assert make_config({"domain_height": text}).domain_height == read


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"domain_height": "6X"}, "domain_height = '6X': expected metres, or a multiple"),
        ({"domain_height": "-6H"}, "domain_height = '-6H': expected metres, or a multiple"),
        ({"domain_height": "0H"}, "domain_height = '0H': expected metres, or a multiple"),
        ({"domain_height": "nan"}, "domain_height = nan: must be a finite number"),
        ({"domain_height": -5}, "domain_height = -5 m: must be above 0 m"),
        ({"domain_height": True}, "domain_height = True: float expected, not bool"),
        ({"top": "round"}, "top = 'round': must be one of terrain, flat"),
        ({"first_layer": -1.0}, "first_layer = -1 m: must be at least 0 m"),
        ({"first_layer": 9.0}, r"first_layer = 9 m: at most the largest vertical spacing, 8 m \(most_spacing x"),
        ({"first_layer": 6.0, "layer_height": 5.0, "mesher": "layered"}, r"spacing, 5 m \(layer_height\)"),
        ({"first_layer": 0.005}, "first_layer = 0.005 m: at least 0.001 of mesh_size = 10 m"),
        ({"layer_growth": 0.9}, "layer_growth = 0.9: must be at least 1"),
    ],
)
def test_bad_options_are_refused_with_value_and_bound(values: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        make_config(values)


def test_growth_alone_has_no_effect_and_says_so() -> None:
    (told,) = idle_parameters(Config(layer_growth=1.5))
    assert told == "layer_growth = 1.5 has no effect: it counts with first_layer above 0"
    assert idle_parameters(Config(layer_growth=1.5, first_layer=1.0)) == []


def test_forecasts_count_the_levels_of_growing_layers() -> None:
    assert expected_levels(Config(domain_height=80.0), 8.0) == 10.0
    # 1, 2 and 4 m up to 7 m, then steps of 8 m.
    assert expected_levels(Config(domain_height=87.0, first_layer=1.0, layer_growth=2.0), 8.0) == 13.0
    assert Config(domain_height="6H").expected_height == 120.0


def test_domains_are_settled_by_what_the_region_holds() -> None:
    facts = {"tallest": 20.5, "highest_ground": 7.25}
    assert resolve_height("6H", "flat", facts) == Domain(123.0, 130.25)
    assert resolve_height("6H", "terrain", facts) == Domain(123.0, None)
    assert resolve_height(50.0, "flat", facts) == Domain(50.0, 57.25)
