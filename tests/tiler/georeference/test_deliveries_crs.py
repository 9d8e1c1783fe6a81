"""Deliveries whose records need care: feet, heights in feet beside metres, Web Mercator, old key points."""

import math
from pathlib import Path

import laspy
import numpy as np
import pyproj
import pytest
from numpy.typing import NDArray

from pipeline.data.errors import CityError
from tests.helpers.deliveries import FEET, SURVEY_FEET, Delivery
from tests.tiler.georeference.test_deliveries import ASPRS, NO_ROOFS, assert_right, las_1_2, run_delivery


def thin_to_key_points(las: laspy.LasData, what: NDArray[np.str_]) -> None:
    """Every third ground point is a key point, class 8 up to LAS 1.3."""
    rows = np.flatnonzero(what == "ground")[::3]
    las.classification[rows] = 8


def only_key_points(las: laspy.LasData, what: NDArray[np.str_]) -> None:
    """The ground is delivered as key points alone."""
    las.classification[what == "ground"] = 8


IN_FEET = {
    # New York Long Island, US survey feet; NAVD88 in the same.
    "state-plane-wkt": Delivery(
        NO_ROOFS,
        crs="EPSG:2263+6360",
        corner=(985000, 200000),
        record="wkt1",
        unit=SURVEY_FEET,
        unit_z=SURVEY_FEET,
    ),
    "state-plane-keys": Delivery(
        NO_ROOFS,
        point_format=1,
        version="1.2",
        crs="EPSG:2263+6360",
        corner=(985000, 200000),
        record="keys",
        keys={1024: 1, 3072: 2263, 3076: 9003, 4096: 6360, 4099: 9003},
        unit=SURVEY_FEET,
        unit_z=SURVEY_FEET,
    ),
    # Arizona Central, international feet.
    "state-plane-international": Delivery(
        NO_ROOFS, crs="EPSG:2223+8228", corner=(700000, 900000), record="wkt1", unit=FEET, unit_z=FEET
    ),
    "heights-alone-wkt": Delivery(
        NO_ROOFS, crs="EPSG:6347+6360", corner=(323000, 4306000), record="wkt1", unit_z=SURVEY_FEET
    ),
    "heights-alone-code": las_1_2(NO_ROOFS, 26918, (323000, 4306000), heights=6360, unit_z=SURVEY_FEET),
    "heights-alone-unit": las_1_2(
        NO_ROOFS,
        26918,
        (323000, 4306000),
        keys={1024: 1, 3072: 26918, 4096: 5703, 4099: 9003},
        unit_z=SURVEY_FEET,
    ),
}


@pytest.mark.parametrize("name", IN_FEET)
def test_feet_become_metres(name: str, tmp_path: Path) -> None:
    record = run_delivery(IN_FEET[name], tmp_path)
    assert record["exit_code"] == 0
    assert_right(tmp_path)
    xmin, ymin, xmax, ymax = record["region"]["bounds"]
    assert xmax - xmin == pytest.approx(120, abs=3)
    assert ymax - ymin == pytest.approx(120, abs=3)
    assert pyproj.CRS(record["region"]["crs"]).axis_info[0].unit_conversion_factor == 1.0


LATITUDE = 38.9
EPT = Delivery(  # the national archive's copies of 3DEP: heights in metres, plan stretched by 1 / cos(latitude)
    NO_ROOFS,
    crs="EPSG:3857",
    corner=(-8575000, pyproj.Transformer.from_crs(4326, 3857, always_xy=True).transform(0, LATITUDE)[1]),
    record="wkt1",
    unit=math.cos(math.radians(LATITUDE)),
)


def test_web_mercator_is_never_meshed_as_metres(tmp_path: Path) -> None:
    with pytest.raises(CityError, match="EPSG:"):
        run_delivery(EPT, tmp_path)


def test_web_mercator_is_taken_to_the_utm_zone_that_is_asked_for(tmp_path: Path) -> None:
    record = run_delivery(EPT, tmp_path, crs="EPSG:26918", reproject=True)
    assert_right(tmp_path)
    xmin, _, xmax, _ = record["region"]["bounds"]
    assert xmax - xmin == pytest.approx(120, abs=5)


@pytest.mark.parametrize("edit", [thin_to_key_points, only_key_points])
def test_key_points_are_ground_in_las_1_2(edit: object, tmp_path: Path) -> None:
    """Catalonia and others deliver them; a model of key points alone is all the ground that there is."""
    run_delivery(las_1_2(ASPRS, 25831, (430000, 4582000), edit=edit), tmp_path)
    assert_right(tmp_path)
