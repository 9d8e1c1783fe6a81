"""Broken blocks have the fault that they are named by, and degraded twins none."""

import json
from dataclasses import replace

import numpy as np
import pytest

from pipeline.architecture.faults import list_faults
from pipeline.architecture.levels import make_level
from pipeline.architecture.twins import degrade_house
from tests.helpers.iso19107 import check_solids
from tests.pipeline.architecture.test_levels import some_houses
from tests.pipeline.architecture.test_representations import faults
from tiler.towns.town_models import fault_feature

# What shapely says of faults of rings within a face.
WORDS = {
    "201": "20x Self-intersection",
    "202": "20x",
    "205": "20x Interior is disconnected",
    "206": "20x Hole lies outside shell",
    "207": "20x",
}


def test_each_fault_is_found_by_its_name() -> None:
    seen = []
    head = {"transform": {"scale": [0.001] * 3}}
    for fault in list_faults():
        line = json.loads(fault_feature(fault, (0.0, 0.0, 0.0)))
        (found,) = [faults for faults in check_solids(head | line, ("1.2",)).values() if faults]
        code = fault.name[:3]
        assert any(one.startswith(WORDS.get(code, code)) for one in found), (fault.name, found)
        assert len(found) == 1 or code < "400", (fault.name, found)
        seen.append(code)
    assert len(set(seen)) == len(seen) == 27


def test_twins_are_valid_houses_with_noise() -> None:
    houses = some_houses(2)
    twins = [degrade_house(house, 0.2, seed=3) for house in houses]
    assert twins == [degrade_house(house, 0.2, seed=3) for house in houses[::-1]][::-1]
    noise = [[getattr(b, name) - getattr(a, name) for name in ("x", "y", "z", "length", "width", "height")]
             for a, b in zip(houses, twins, strict=True)]  # fmt: skip
    assert np.std(noise, axis=0) == pytest.approx([0.2] * 6, rel=0.5)
    for house, twin in zip(houses, twins, strict=True):
        assert replace(house, x=0, y=0) != replace(twin, x=0, y=0)
        assert (twin.id, twin.storeys, len(twin.openings)) == (house.id, house.storeys, len(house.openings))
    assert sum(len(twin.dormers) for twin in twins) > 0.7 * sum(len(house.dormers) for house in houses)
    for twin in sorted(twins, key=lambda twin: len(twin.openings))[:4]:
        assert [found for one in make_level(twin, "3.2") if (found := faults(one))] == []
