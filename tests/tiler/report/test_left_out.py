"""What of the buildings is not in the mesh: counted, with the tallest one, which the domain must clear too."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely

from tests.helpers.bad_input import write_cloud, write_houses
from tests.helpers.cities import cloud_over
from tiler.cli.main import main
from tiler.config.config import Config, make_config
from tiler.report.left_out import report_left_out
from tiler.stages.domain import LOW_DOMAIN
from tiler.workflow.run import run

WEST, SOUTH = 318_000.0, 6_399_000.0
BOUNDS = (WEST, SOUTH, WEST + 120, SOUTH + 120)
GROUND = 2.0
INNER = shapely.box(WEST + 50, SOUTH + 50, WEST + 70, SOUTH + 65)  # 10 m high
TOWER = shapely.box(WEST - 8, SOUTH + 20, WEST + 12, SOUTH + 40)  # 30 m high, on the western border
SHED = shapely.box(WEST + 90, SOUTH + 90, WEST + 91.5, SOUTH + 92)  # 3 m²
NAMES = {"inner": INNER, "tower": TOWER, "shed": SHED}
ROOFS = [(INNER, GROUND + 10), (TOWER, GROUND + 30), (SHED, GROUND + 3)]


def write_town(folder: Path, *, classes: bool = True, stray: shapely.Polygon | None = None) -> dict[str, Any]:
    """Write a house, a tower on the border and a shed; and building points beside all footprints."""
    folder.mkdir()
    cloud = cloud_over(BOUNDS, [*ROOFS, *([(stray, GROUND + 5)] if stray else [])], ground=GROUND)
    kind = cloud.classification if classes else np.where(cloud.classification == 6, 1, cloud.classification)
    write_cloud(folder / "cloud.laz", cloud.xyz, kind)
    write_houses(folder / "houses.gpkg", list(NAMES.values()), ids=list(NAMES))
    return {
        "pointcloud": [str(folder / "cloud.laz")],
        "footprints": str(folder / "houses.gpkg"),
        "mesh_size": 20.0,
        "bounds": BOUNDS,
        "out": str(folder / "out"),
    }


def test_clip_is_the_default_and_keeps_the_tower(tmp_path: Path) -> None:
    assert Config().border == "clip"
    record = run(make_config(write_town(tmp_path / "town")))
    assert record["domain"]["tallest building (m)"] == pytest.approx(30.0, abs=0.1)
    assert record["domain"]["tallest building in the mesh (m)"] == pytest.approx(30.0, abs=0.1)
    assert record["left_out"]["footprints"] == 1  # the shed
    assert record["left_out"]["area (m2)"] == pytest.approx(3.0, abs=0.05)


@pytest.mark.parametrize("classes", [True, False], ids=["class 6", "no building class"])
def test_a_tower_that_is_dropped_is_counted_and_makes_the_domain_higher(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], *, classes: bool
) -> None:
    given = write_town(tmp_path / "town", classes=classes)
    record = run(make_config(given | {"border": "drop", "domain_height": "6H", "tile_size": 300.0}))
    found = record["left_out"]
    assert record["domain"]["height (m)"] == pytest.approx(180.0, abs=0.5)
    assert record["domain"]["tallest building in the mesh (m)"] == pytest.approx(10.0, abs=0.1)
    assert found["footprints"] == 2
    assert found["area (m2)"] == pytest.approx(12 * 20 + 3, abs=0.1)  # within the region
    assert found["building points"] == found["in left-out footprints"] == 12 * 20 * 4 + 3 * 4
    assert found["of building points"] == found["building points"] + 20 * 15 * 4
    tallest = found["tallest"]
    assert tallest["id"] == "tower"
    assert tallest["height (m)"] == pytest.approx(30.0, abs=0.1)
    assert shapely.Point(tallest["x"], tallest["y"]).within(TOWER)
    assert "crosses the region's border" in tallest["reason"]
    told = " ".join(record["messages"])
    assert "2 footprints (243 m² within the region) are not in the mesh" in told
    assert "the tallest building left out: tower, 30.0 m" in told
    # The guideline asks for six times a building that is not there.
    low = run(make_config(given | {"border": "drop", "domain_height": 100.0, "tile_size": 300.0}))
    (note,) = low["notes"][LOW_DOMAIN]["items"]
    assert note["subject"] == "tower"
    assert "which is left out" in note["detail"]
    assert "6H" in note["detail"]
    capsys.readouterr()


def test_points_beside_all_footprints_are_told(tmp_path: Path) -> None:
    barn = shapely.box(WEST + 20, SOUTH + 90, WEST + 30, SOUTH + 100)
    found = run(make_config(write_town(tmp_path / "town", stray=barn)))["left_out"]
    assert found["beside footprints"] == 10 * 10 * 4
    assert found["in left-out footprints"] == 3 * 4
    # The clipped tower keeps a metre from the border: its points there are over no building.
    assert found["building points"] == 10 * 10 * 4 + 3 * 4 + 20 * 4


def test_the_number_of_tiles_changes_nothing(tmp_path: Path) -> None:
    given = write_town(tmp_path / "town") | {"border": "drop", "mesh_size": 4.0}
    several = [
        run(make_config(given | {"tile_size": size, "out": str(tmp_path / f"{size:g}")}))["left_out"]
        for size in (60.0, 300.0)
    ]
    assert several[0] == several[1]


def test_the_terminal_tells_what_is_left_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    given = write_town(tmp_path / "town")
    command = ["run", *given["pointcloud"], "--footprints", given["footprints"], "--out", given["out"]]
    command += ["--bounds", *map(str, BOUNDS), "--mesh-size", "20", "--border", "drop", "--no-dashboard"]
    assert main(command) == 0
    shown = capsys.readouterr().out
    assert "the tallest building left out: tower, 30.0 m, at (" in shown
    assert "1 footprint on the region's border was dropped" in shown


def test_nothing_is_told_where_all_is_in_the_mesh() -> None:
    assert (
        report_left_out({"footprints": 0, "area (m2)": 0.0, "building points": 0, "of building points": 9}) == []
    )


DATA = Path(__file__).resolve().parents[4] / "shared" / "data" / "amsterdam"


@pytest.mark.long
@pytest.mark.skipif(not DATA.is_dir(), reason=f"no real data at {DATA}")
def test_central_amsterdam_keeps_its_tallest_tower(tmp_path: Path) -> None:
    """It stands on the region's border: without it the tallest building would be 30.5 m high."""
    given = {"pointcloud": [str(DATA / "tiles")], "footprints": str(DATA / "footprints.gpkg"), "mesh_size": 20.0}
    given["roofs"] = "flat"  # a roof is as high as its points are in the median
    record = run(make_config(given | {"out": str(tmp_path / "out")}))
    assert record["domain"]["tallest building in the mesh (m)"] == pytest.approx(53.8, abs=0.1)
    assert record["left_out"]["area (m2)"] < 100
    dropped = run(make_config(given | {"out": str(tmp_path / "out"), "border": "drop"}))
    assert dropped["domain"]["tallest building in the mesh (m)"] == pytest.approx(30.5, abs=0.1)
    assert dropped["domain"]["tallest building (m)"] > 50
    found = dropped["left_out"]
    assert found["building points"] / found["of building points"] == pytest.approx(0.26, abs=0.01)
    assert found["tallest"]["height (m)"] == pytest.approx(dropped["domain"]["tallest building (m)"], abs=0.01)
