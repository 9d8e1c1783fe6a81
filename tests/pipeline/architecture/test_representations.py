"""All representations of a house: their number, their heights, and solids that are valid."""

from dataclasses import replace

import numpy as np
import pytest
import shapely

from pipeline.architecture.heights import house_heights
from pipeline.architecture.interiors import make_interior
from pipeline.architecture.levels import Volume, outline_ring
from pipeline.architecture.parameters import ROOF_SHAPES, BuildingPart, Chimney, Dormer
from pipeline.architecture.representations import (
    HEIGHTS,
    Representation,
    list_representations,
    make_representation,
    reference_height,
)
from pipeline.architecture.surfaces import GROUND
from tests.benchmarks.town_variants import PAGE, make_page
from tests.helpers.iso19107 import check_shell
from tests.pipeline.architecture.test_levels import plain, some_houses, total_volume

GARAGE = BuildingPart("garage", 1, 1.0, 4.0, 3.0, 2.8)
HOUSE = plain(
    parts=(GARAGE,), dormers=(Dormer(0, 3.0, 0.8, 1.5, 0.6),), chimneys=(Chimney(2, 4.0, 2.0, 0.6, 0.8),)
)


def faults(volume: Volume) -> set[str]:
    number: dict[tuple[float, float, float], int] = {}
    faces = [
        [[number.setdefault(place, len(number)) for place in ring] for ring in (one.border, *one.holes)]
        for one in volume.surfaces
    ]
    return set(check_shell(faces, np.rint(1000 * np.array(list(number))).astype(np.int64)))


def test_all_are_there_and_their_solids_are_valid() -> None:
    asked = list_representations()
    assert len({one.name for one in asked}) == len(asked) == 392
    areas = {}
    for one in asked:
        if one.interior:
            continue
        volumes = make_representation(HOUSE, one)
        assert all(volume.closed == (one.kind == "solid") for volume in volumes), one.name
        if one.kind == "solid" and one.walls == "Fd" and one.height in ("", "HMed"):  # others: test_towns.py
            assert [found for volume in volumes if (found := faults(volume))] == [], one.name
        base = next(surface for surface in volumes[0].surfaces if surface.kind == GROUND)
        areas[one.name] = shapely.Polygon([place[:2] for place in base.border]).area
    assert areas["LOD1_2_F0_H3"] < areas["LOD1_2_Fd_H3"] < areas["LOD1_2_F1_H3"]
    assert PAGE.read_text() == make_page(), "python -m tests.benchmarks.town_variants"


def test_heights_are_in_order_and_means_those_of_the_roof() -> None:
    rng = np.random.default_rng(1)
    for shape in ROOF_SHAPES:
        house = plain(shape, parts=(GARAGE,))
        height = {name: reference_height(house, name) for name in HEIGHTS}
        assert height["H0"] <= height["H1"] <= height["H2"] <= height["H3"] <= height["H4"] <= height["H5"]
        assert height["H5"] == height["H6"] == height["HMax"]
        assert height["HMin"] == 2.8
        whole = make_representation(house, Representation("x", "2.0", kind="solid"))
        assert total_volume(whole) == pytest.approx(house.length * house.width * height["HAvg"], rel=1e-3)
        bare = replace(house, x=0.0, y=0.0, z=0.0, rotation=0.0, roof=replace(house.roof, overhang=0.0))
        ring = shapely.Polygon(outline_ring(bare))
        places = rng.uniform(ring.bounds[:2], ring.bounds[2:], (20_000, 2))
        seen = house_heights(bare, places)
        assert np.nanmean(seen) == pytest.approx(height["HAvgAll"], abs=0.05)
        assert np.nanmedian(seen) == pytest.approx(height["HMedian"], abs=0.05)
    assert reference_height(HOUSE, "H6") == pytest.approx(HOUSE.height + HOUSE.roof.rise + 0.8)


def test_interiors_are_valid_and_lie_within_the_house() -> None:
    attics = 0
    for house in some_houses(1):
        shell = total_volume(make_representation(house, Representation("x", "2.0", kind="solid")))
        rooms = {level: make_interior(house, level) for level in ("0", "1", "2.2", "2.3")}
        assert len(rooms["0"]) == len(rooms["2.2"]) == house.storeys
        for level in ("1", "2.2", "2.3"):
            assert [found for room in rooms[level][-2:] if (found := faults(room.volume))] == []
            assert 0.3 * shell < total_volume([room.volume for room in rooms[level]]) < shell
        attics += len(rooms["2.3"]) - house.storeys
        tops = [z for room in rooms["2.3"] for one in room.volume.surfaces for *_, z in one.border]
        assert max(tops) < house.z + house.height + house.roof.rise - 0.15
    assert attics > 1
