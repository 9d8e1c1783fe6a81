"""Deliveries of agencies through the whole run: every house there, with its height."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.data.errors import CityError, InputError
from tests.helpers.deliveries import HOUSES, Delivery, forget_chunk_size, ground, house_of, write_delivery
from tiler.config.config import make_config
from tiler.workflow.run import run

Edit = Callable[[laspy.LasData, NDArray[np.str_]], None]
ASPRS = {"ground": 2, "roof": 6, "tree": 5, "water": 9, "noise": 7}
NO_ROOFS = {"ground": 2, "roof": 1, "tree": 1, "water": 9, "noise": 7}


def withhold_noise(las: laspy.LasData, what: NDArray[np.str_]) -> None:
    las.withheld[:] = what == "noise"


def las_1_2(
    classes: dict[str, int], epsg: int, corner: tuple[float, float], *, heights: int = 0, **more: Any
) -> Delivery:
    """A delivery as LAS 1.2 with GeoTIFF keys of its CRS, and of that of its heights if it has one."""
    keys = {1024: 1, 3072: epsg} | ({4096: heights} if heights else {})
    given: dict[str, Any] = {
        "point_format": 1,
        "version": "1.2",
        "crs": f"EPSG:{epsg}",
        "record": "keys",
        "keys": keys,
    }
    return Delivery(classes, corner=corner, **(given | more))


DELIVERIES = {
    # USGS 3DEP, Lidar Base Specification: no class of buildings; noise is withheld too.
    "3dep": Delivery(
        {"ground": 2, "roof": 1, "tree": 1, "water": 9, "noise": 18},
        crs="EPSG:6347+5703",
        corner=(323000, 4306000),
        record="wkt1",
        edit=withhold_noise,
    ),
    # AHN3: LAS 1.2, format 1; GeoTIFF keys.
    "ahn3": las_1_2(
        {"ground": 2, "roof": 6, "tree": 1, "water": 9, "noise": 7},
        28992,
        (120000, 487000),
        heights=5709,
        scale=0.001,
    ),
    # AHN4: LAS 1.4 with format 1, extra bytes, no CRS record.
    "ahn4": Delivery(
        {"ground": 2, "roof": 6, "tree": 1, "water": 9, "noise": 26},
        point_format=1,
        crs="EPSG:28992",
        corner=(120000, 487000),
        record="",
        scale=0.001,
        extra=("Amplitude", "Reflectance", "Deviation"),
        edit=withhold_noise,
    ),
    # AHN5: format 8 with colour and near infrared.
    "ahn5": Delivery(ASPRS | {"tree": 1}, point_format=8, crs="EPSG:7415", corner=(120000, 487000), scale=0.001),
    "lidar-hd": Delivery(
        ASPRS | {"noise": 65},
        crs="EPSG:2154+5720",
        corner=(652000, 6862000),
        suffix=".copc.laz",
        edit=withhold_noise,
    ),
    "swisssurface3d": las_1_2(ASPRS | {"tree": 3}, 2056, (2600000, 1200000), suffix=".las"),
    "pnoa": las_1_2(ASPRS, 25830, (440000, 4474000), point_format=3, scale=0.001),
    "pnoa-3": Delivery(ASPRS, point_format=8, crs="EPSG:25830", corner=(440000, 4474000), record="wkt1"),
    "lantmateriet": las_1_2(NO_ROOFS, 3006, (674000, 6580000), heights=5613),
    "lantmateriet-1.4": Delivery(
        NO_ROOFS | {"noise": 18}, crs="EPSG:5845", corner=(674000, 6580000), record="wkt1"
    ),
    "nls-finland": las_1_2(
        {"ground": 2, "roof": 1, "tree": 5, "water": 9, "noise": 7}, 3067, (385000, 6672000), heights=3900
    ),
    "elvis": las_1_2(ASPRS, 28355, (320000, 5812000), heights=5711, scale=0.001),
    "elvis-1.4": Delivery(ASPRS, crs="EPSG:7855+5711", corner=(320000, 5812000), record="wkt1"),
    "linz": Delivery(ASPRS | {"noise": 18}, crs="EPSG:2193+7839", corner=(1748000, 5427000), record="wkt1"),
    "kartverket": Delivery(ASPRS, crs="EPSG:5972", corner=(597000, 6643000), record="wkt1"),
    "denmark": las_1_2(ASPRS, 25832, (720000, 6175000), heights=5799, point_format=3),
    # North Rhine-Westphalia: what is not ground has class 20; water is ground.
    "nrw": Delivery(
        {"ground": 2, "roof": 20, "tree": 1, "water": 2, "noise": 18},
        point_format=1,
        version="1.2",
        crs="EPSG:25832",
        corner=(356000, 5645000),
        record="",
    ),
    # Flanders II: ground, water, and the rest.
    "flanders-2": las_1_2(NO_ROOFS, 31370, (152000, 212000)),
    # Catalonia: what has no class is withheld (129 as a byte).
    "icgc": las_1_2(
        {"ground": 2, "roof": 6, "tree": 5, "water": 2, "noise": 1}, 25831, (430000, 4582000), edit=withhold_noise
    ),
    # Japan, plane rectangular CS: no class of buildings, no CRS record.
    "japan": Delivery(
        {"ground": 2, "roof": 1, "tree": 1, "water": 1, "noise": 7},
        point_format=2,
        version="1.2",
        crs="EPSG:6676",
        corner=(-8400, -113000),
        record="",
        scale=0.001,
    ),
}


def run_delivery(delivery: Delivery, tmp_path: Path, **given: Any) -> dict[str, Any]:
    values = write_delivery(tmp_path / "in", delivery)
    values |= {"out": str(tmp_path / "out"), "mesh_size": 20.0, **given}
    return run(make_config(values))


def houses(tmp_path: Path) -> list[dict[str, Any]]:
    """Attributes of each house in the city model, by its number."""
    model = json.loads((tmp_path / "out" / "citymodel.city.json").read_text())
    found = {name: thing["attributes"] for name, thing in model["CityObjects"].items() if "-" not in name}
    assert sorted(found) == [f"h{k:02d}" for k in range(len(HOUSES))]
    return [found[name] for name in sorted(found)]


def assert_right(tmp_path: Path) -> None:
    """Roofs are within 0.1 m, and the ground, which slopes around a house, within 0.4 m."""
    middle = np.array([((a + c) / 2, (b + d) / 2) for a, b, c, d, _ in HOUSES])
    soil, found = ground(*middle.T), houses(tmp_path)
    np.testing.assert_allclose([one["ground_height"] for one in found], soil, atol=0.4)
    expected = soil + [height for *_, height in HOUSES]
    np.testing.assert_allclose([one["roof_height"] for one in found], expected, atol=0.1)


@pytest.mark.parametrize("name", DELIVERIES)
def test_every_house_has_its_height(name: str, tmp_path: Path) -> None:
    record = run_delivery(DELIVERIES[name], tmp_path)
    assert record["exit_code"] == 0
    assert "footprint-roof-from-default" not in record["notes"]
    assert_right(tmp_path)


def test_a_copc_file_may_say_chunk_size_0(tmp_path: Path) -> None:
    values = write_delivery(tmp_path / "in", DELIVERIES["lidar-hd"])
    forget_chunk_size(Path(values["pointcloud"][0]))
    run(make_config(values | {"out": str(tmp_path / "out"), "mesh_size": 20.0}))
    assert_right(tmp_path)


def roofs_as(classes: dict[int, int]) -> Edit:
    """Give all points above some houses other classes, by the number of the house."""

    def edit(las: laspy.LasData, what: NDArray[np.str_]) -> None:
        house = house_of(np.asarray(las.xyz) - np.floor(np.asarray(las.xyz).min(axis=0)))
        for number, other in classes.items():
            las.classification[(house == number) & (what == "roof")] = other

    return edit


def other_roofs(record: dict[str, Any]) -> list[str]:
    kinds = record["notes"].get("footprint-roof-from-other-classes", {"items": []})
    return [item["subject"] for item in kinds["items"]]


def test_roofs_in_other_classes_are_taken_house_by_house(tmp_path: Path) -> None:
    classes = {2: 0, 3: 1, 4: 12, 5: 20, 6: 26, 7: 64, 9: 67}
    record = run_delivery(replace(DELIVERIES["linz"], edit=roofs_as(classes)), tmp_path)
    assert other_roofs(record) == [f"h{house:02d}" for house in classes]
    assert record["counts"]["roofs from other classes"] == len(classes)
    assert "building-roof-from-default" not in record["notes"]
    assert_right(tmp_path)
    model = json.loads((tmp_path / "out" / "citymodel.city.json").read_text())
    assert model["CityObjects"]["h09"]["attributes"]["roof_points"] > 300
    assert model["CityObjects"]["h09"]["attributes"]["roof_rmse"] < 0.05


def test_ground_plants_water_and_bridges_make_no_roof(tmp_path: Path) -> None:
    classes = {2: 2, 4: 3, 6: 5, 7: 9, 9: 17}
    record = run_delivery(replace(DELIVERIES["linz"], edit=roofs_as(classes)), tmp_path)
    assert not other_roofs(record)
    told = [item["subject"] for item in record["notes"]["footprint-roof-from-default"]["items"]]
    assert told == [f"h{house:02d}" for house in classes]


def overlap(las: laspy.LasData, what: NDArray[np.str_]) -> None:
    """Every second point is of the overlap of two strips, class 12 up to LAS 1.3, whatever it lies on."""
    las.classification[1::2][what[1::2] != "noise"] = 12


@pytest.mark.parametrize("name", ["pnoa", "lantmateriet"])
def test_points_in_the_overlap_of_strips_do_no_harm(name: str, tmp_path: Path) -> None:
    record = run_delivery(replace(DELIVERIES[name], edit=overlap), tmp_path)
    assert not other_roofs(record)
    assert_right(tmp_path)


def test_strays_of_the_next_house_do_not_mark_a_roof(tmp_path: Path) -> None:
    def edit(las: laspy.LasData, what: NDArray[np.str_]) -> None:
        roofs_as({9: 1})(las, what)
        place = np.asarray(las.xyz) - np.floor(np.asarray(las.xyz).min(axis=0))
        las.classification[(house_of(place) == 9) & (place[:, 0] < HOUSES[9][0] + 0.8)] = 6

    assert other_roofs(run_delivery(replace(DELIVERIES["linz"], edit=edit), tmp_path)) == ["h09"]
    assert_right(tmp_path)


def test_other_classes_may_mark_buildings(tmp_path: Path) -> None:
    delivery = replace(DELIVERIES["linz"], edit=roofs_as({2: 67, 9: 67}))
    record = run_delivery(delivery, tmp_path, building_classes=(6, 67))
    assert not other_roofs(record)
    assert_right(tmp_path)


def test_a_tree_over_a_roof_of_no_class_does_not_lift_it(tmp_path: Path) -> None:
    def edit(las: laspy.LasData, what: NDArray[np.str_]) -> None:
        roofs_as({9: 1})(las, what)
        trees = np.flatnonzero(what == "tree")
        las.classification[trees] = 1
        corner = np.floor(np.asarray(las.xyz).min(axis=0))
        first = trees[: len(trees) // 4]  # the first tree moves over the tower
        las.x[first], las.y[first] = las.x[first] - 35 + 48, las.y[first] - 40 + 90
        las.z[first] = las.z[first] + 20
        assert (house_of(np.asarray(las.xyz)[first] - corner) == 9).mean() > 0.7

    record = run_delivery(replace(DELIVERIES["linz"], edit=edit), tmp_path)
    assert other_roofs(record) == ["h09"]
    assert_right(tmp_path)


def test_roofs_of_other_classes_do_not_depend_on_files_and_tiles(tmp_path: Path) -> None:
    values = write_delivery(
        tmp_path / "in", replace(DELIVERIES["linz"], edit=roofs_as({5: 1, 9: 1}), suffix=".las")
    )
    las = laspy.read(values["pointcloud"][0])
    (tmp_path / "parts").mkdir()
    for k, rows in enumerate((las.y < las.header.y_min + 93, las.y >= las.header.y_min + 93)):  # through the tower
        laspy.LasData(las.header, points=las.points[np.asarray(rows)]).write(tmp_path / "parts" / f"{k}.laz")
    models = []
    for name, given in {
        "whole": {},
        "parts": {"pointcloud": [str(tmp_path / "parts")], "tile_size": 70.0},
    }.items():
        record = run(make_config(values | {"out": str(tmp_path / name), "mesh_size": 5.0} | given))
        assert other_roofs(record) == ["h05", "h09"]
        models.append(json.loads((tmp_path / name / "citymodel.city.json").read_text())["CityObjects"])
    assert models[0] == models[1]


ENGLAND = Delivery(  # Environment Agency: classes by height alone
    {"ground": 2, "roof": 5, "tree": 5, "water": 2, "noise": 7},
    point_format=1,
    version="1.2",
    crs="EPSG:27700",
    corner=(530000, 180000),
    record="",
)


def test_roofs_among_plants_are_told_and_taken_when_asked(tmp_path: Path) -> None:
    record = run_delivery(ENGLAND, tmp_path)
    told = record["notes"]["footprint-roof-like-plants"]
    assert told["count"] == len(HOUSES)
    assert "--building-classes 5,6" in told["items"][0]["detail"]
    assert record["notes"]["footprint-roof-from-default"]["count"] == len(HOUSES)
    record = run_delivery(ENGLAND, tmp_path, building_classes=(5, 6))
    assert_right(tmp_path)


UNCLASSIFIED = replace(ENGLAND, classes=dict.fromkeys(ASPRS, 0) | {"noise": 7})
DALES = replace(ENGLAND, classes={"ground": 1, "roof": 8, "tree": 2, "water": 1, "noise": 0}, edit=withhold_noise)
FLANDERS_1 = replace(
    ENGLAND, classes={"ground": 1, "roof": 2, "tree": 2, "water": 1, "noise": 7}, crs="EPSG:31370",
    corner=(152000, 212000),
)  # fmt: skip


@pytest.mark.parametrize("delivery", [FLANDERS_1, DALES])
def test_class_2_that_is_no_ground_is_refused(delivery: Delivery, tmp_path: Path) -> None:
    with pytest.raises(CityError, match=r"class 2 lies .* m above classes 0 and 1 .* --ground-filter"):
        run_delivery(delivery, tmp_path)


@pytest.mark.parametrize(
    ("delivery", "marks"),
    [
        (FLANDERS_1, (6,)),
        (DALES, (6,)),
        (replace(DALES, point_format=6, version="1.4"), (8,)),
        (UNCLASSIFIED, (6,)),
    ],
)
def test_ground_is_found_anew_where_classes_are_of_its_own(
    delivery: Delivery, marks: tuple[int, ...], tmp_path: Path
) -> None:
    run_delivery(delivery, tmp_path, ground_filter=True, building_classes=marks)
    assert_right(tmp_path)


def test_key_points_of_old_formats_mark_no_buildings(tmp_path: Path) -> None:
    with pytest.raises(CityError, match=r"--building-classes names 8, .* key points .* --ground-filter"):
        run_delivery(DALES, tmp_path, ground_filter=True, building_classes=(6, 8))


def test_a_cloud_without_any_class_names_the_filter(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="--ground-filter"):
        run_delivery(UNCLASSIFIED, tmp_path)
