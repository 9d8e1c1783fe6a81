"""Deliveries of agencies through the whole run: every house there, with its height."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.errors import InputError
from tests.deliveries import HOUSES, Delivery, write_delivery
from tiler.config import make_config
from tiler.run import run

ASPRS = {"ground": 2, "roof": 6, "tree": 5, "water": 9, "noise": 7}
NO_ROOFS = {"ground": 2, "roof": 1, "tree": 1, "water": 9, "noise": 7}


def withhold_noise(las: laspy.LasData, what: NDArray[np.str_]) -> None:
    las.withheld[:] = what == "noise"


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
    "ahn3": Delivery(
        {"ground": 2, "roof": 6, "tree": 1, "water": 9, "noise": 7},
        point_format=1,
        version="1.2",
        crs="EPSG:28992",
        corner=(120000, 487000),
        record="keys",
        keys={1024: 1, 3072: 28992, 4096: 5709},
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
        ASPRS | {"noise": 65}, crs="EPSG:2154+5720", corner=(652000, 6862000), edit=withhold_noise
    ),
    "swisssurface3d": Delivery(
        ASPRS | {"tree": 3},
        point_format=1,
        version="1.2",
        crs="EPSG:2056",
        corner=(2600000, 1200000),
        record="keys",
        keys={1024: 1, 3072: 2056},
        suffix=".las",
    ),
    "pnoa": Delivery(
        ASPRS,
        point_format=3,
        version="1.2",
        crs="EPSG:25830",
        corner=(440000, 4474000),
        record="keys",
        keys={1024: 1, 3072: 25830},
        scale=0.001,
    ),
    "pnoa-3": Delivery(ASPRS, point_format=8, crs="EPSG:25830", corner=(440000, 4474000), record="wkt1"),
    "lantmateriet": Delivery(
        NO_ROOFS,
        point_format=1,
        version="1.2",
        crs="EPSG:3006",
        corner=(674000, 6580000),
        record="keys",
        keys={1024: 1, 3072: 3006, 4096: 5613},
    ),  # fmt: skip
    "lantmateriet-1.4": Delivery(
        NO_ROOFS | {"noise": 18}, crs="EPSG:5845", corner=(674000, 6580000), record="wkt1"
    ),
    "nls-finland": Delivery(
        {"ground": 2, "roof": 1, "tree": 5, "water": 9, "noise": 7},
        point_format=1,
        version="1.2",
        crs="EPSG:3067",
        corner=(385000, 6672000),
        record="keys",
        keys={1024: 1, 3072: 3067, 4096: 3900},
    ),
    "elvis": Delivery(
        ASPRS,
        point_format=1,
        version="1.2",
        crs="EPSG:28355",
        corner=(320000, 5812000),
        record="keys",
        keys={1024: 1, 3072: 28355, 4096: 5711},
        scale=0.001,
    ),
    "elvis-1.4": Delivery(ASPRS, crs="EPSG:7855+5711", corner=(320000, 5812000), record="wkt1"),
    "linz": Delivery(ASPRS | {"noise": 18}, crs="EPSG:2193+7839", corner=(1748000, 5427000), record="wkt1"),
    "kartverket": Delivery(ASPRS, crs="EPSG:5972", corner=(597000, 6643000), record="wkt1"),
    "denmark": Delivery(
        ASPRS,
        point_format=3,
        version="1.2",
        crs="EPSG:25832",
        corner=(720000, 6175000),
        record="keys",
        keys={1024: 1, 3072: 25832, 4096: 5799},
    ),
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
    "flanders-2": Delivery(
        NO_ROOFS,
        point_format=1,
        version="1.2",
        crs="EPSG:31370",
        corner=(152000, 212000),
        record="keys",
        keys={1024: 1, 3072: 31370},
    ),  # fmt: skip
    # Catalonia: what has no class is withheld (129 as a byte).
    "icgc": Delivery(
        {"ground": 2, "roof": 6, "tree": 5, "water": 2, "noise": 1},
        point_format=1,
        version="1.2",
        crs="EPSG:25831",
        corner=(430000, 4582000),
        record="keys",
        keys={1024: 1, 3072: 25831},
        edit=withhold_noise,
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


def heights(tmp_path: Path) -> list[float]:
    """Heights of the roofs above the ground at the middle of each house (m), by the house's number."""
    model = json.loads((tmp_path / "out" / "citymodel.city.json").read_text())
    found = {name: thing["attributes"] for name, thing in model["CityObjects"].items() if "-" not in name}
    assert sorted(found) == [f"h{k:02d}" for k in range(len(HOUSES))]
    return [found[name]["roof_height"] for name in sorted(found)]


def assert_right(tmp_path: Path) -> None:
    from tests.deliveries import ground

    middle = np.array([((a + c) / 2, (b + d) / 2) for a, b, c, d, _ in HOUSES])
    expected = ground(*middle.T) + [height for *_, height in HOUSES]
    np.testing.assert_allclose(heights(tmp_path), expected, atol=0.1)


@pytest.mark.parametrize("name", DELIVERIES)
def test_every_house_has_its_height(name: str, tmp_path: Path) -> None:
    record = run_delivery(DELIVERIES[name], tmp_path)
    assert record["exit_code"] == 0
    assert "footprint-roof-from-default" not in record["notes"]
    assert_right(tmp_path)
