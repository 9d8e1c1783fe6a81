"""All representations of a house: their number, their heights, and solids that are valid."""

import math
from dataclasses import replace

import numpy as np
import pytest
import shapely

from pipeline.architecture.draw import draw_house
from pipeline.architecture.heights import house_heights
from pipeline.architecture.interiors import make_interior
from pipeline.architecture.levels import Volume, make_level, move_walls, outline_rings
from pipeline.architecture.lots import Lot
from pipeline.architecture.parameters import ROOF_SHAPES, BuildingPart, Chimney, Dormer, House, Opening
from pipeline.architecture.representations import (
    HEIGHTS,
    Representation,
    list_representations,
    make_representation,
    reference_height,
)
from pipeline.architecture.roof_sides import count_walls, list_sides, wall_length
from pipeline.architecture.rules import make_rules
from pipeline.architecture.surfaces import GROUND, ROOF
from pipeline.architecture.twins import degrade_house
from pipeline.data.errors import GeometryError, InputError
from tests.benchmarks.town_variants import PAGE, make_page
from tests.helpers.iso19107 import check_shell
from tests.pipeline.architecture.test_levels import is_closed, plain, some_houses, total_volume

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
        ring = shapely.Polygon(outline_rings(bare)[0])
        places = rng.uniform(ring.bounds[:2], ring.bounds[2:], (20_000, 2))
        seen = house_heights(bare, places)
        assert np.nanmean(seen) == pytest.approx(height["HAvgAll"], abs=0.05)
        assert np.nanmedian(seen) == pytest.approx(height["HMedian"], abs=0.05)
    assert reference_height(HOUSE, "H6") == pytest.approx(HOUSE.height + HOUSE.roof.rise + 0.8)


@pytest.mark.parametrize(
    ("footprint", "shapes"),
    [
        ("L", ("gabled", "shed")),
        ("T", ("gabled",)),
        ("U", ("gabled", "hipped")),
        ("courtyard", ("hipped", "flat")),
    ],
)
def test_houses_with_wings_are_valid_at_all_levels(footprint: str, shapes: tuple[str, ...]) -> None:
    rules = {"storeys": 1, "roof_pitch": 40, "garage": 1, "dormers": 2, "overhang": 0.5, "window_distance": 4}
    rules |= {"wing": 6.0, "dormer_height": 1.0, "dormer_gabled": 0}
    lot = Lot(3, 0, 100.0, 200.0, 44.0, 30.0)
    for shape in shapes:
        read = make_rules(rules | {"footprint": footprint, "roof_shape": shape}, preset="wings")
        house = draw_house(read, lot, lambda x, y: 3.0, seed=4)
        assert house.plan
        walls = count_walls(house)
        assert {one.wall for one in house.openings} >= set(range(walls)) - {1}  # where its garage is
        inner = {"L": 2, "T": 2, "U": 3, "courtyard": 4}[footprint]  # which roofs make shorter at its end
        window = Opening("window", inner, wall_length(house, inner) - 0.45, 0.9, 0.4, 1.0)
        others = (one for one in house.openings if one.wall != inner)
        house = replace(house, openings=(*others, window))
        sloped = [side.slope for side in list_sides(house) if shape in ("gabled", "hipped")]
        assert sloped == pytest.approx([math.tan(math.radians(40))] * len(sloped), rel=1e-3)
        gables = {"L": 2, "T": 3, "U": 2, "courtyard": 0}[footprint] if shape == "gabled" else 0
        assert len(sloped) == (walls - gables if sloped else 0)
        assert len(house.dormers) == 2 or not sloped
        for level in ("1.2", "3.2", "3.3"):
            volumes = make_level(house, level, footprint="eaves" if level == "3.2" else "walls")
            assert [found for one in volumes if (found := faults(one))] == [], (shape, level)
        for room in make_interior(house, "2.3")[::-1][:2] + make_interior(house, "1"):
            assert faults(room.volume) == set()
        assert make_interior(house, "2.2")[-1].volume.part == 0
        if shape == "shed":
            border = house.plan[0]
            with pytest.raises(GeometryError, match="begin it elsewhere"):
                list_sides(replace(house, plan=((*border[2:], *border[:2]),)))
        with pytest.raises(InputError, match="its walls cannot stand -5 m further out"):
            move_walls(house, -5.0)
        for sigma in (0.2, 0.02):  # with the smaller one nodes of the skeleton are 1 to 5 mm apart
            twin = degrade_house(house, sigma, seed=1)
            assert is_closed(make_level(twin, "2.2")[0].surfaces)
        # Heights are those of the surfaces, with overhangs and without; no point of a roof is missed.
        check_heights(replace(house, dormers=(), chimneys=()))


def check_heights(house: House) -> None:
    rng = np.random.default_rng(1)
    bare = replace(house, x=0.0, y=0.0, z=0.0, rotation=0.0, parts=())
    for one in make_level(bare, "2.3", solid=False)[0].surfaces:
        if one.kind == ROOF:
            corners = np.array(one.border)
            outline = shapely.Polygon(corners[:, :2], [np.array(hole)[:, :2] for hole in one.holes])
            places = rng.uniform(corners[:, :2].min(axis=0), corners[:, :2].max(axis=0), (100, 2))
            places = places[shapely.contains_xy(outline.buffer(-0.02), *places.T)]
            normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
            z = corners[0, 2] - (places - corners[0, :2]) @ normal[:2] / normal[2]
            np.testing.assert_allclose(house_heights(bare, places), z, atol=0.008)
    bare = replace(bare, roof=replace(house.roof, overhang=0.0))
    height = {name: reference_height(bare, name) for name in HEIGHTS}
    border, *holes = outline_rings(bare)
    outline = shapely.Polygon(border, holes)
    (volume,) = make_level(bare, "2.0")
    assert total_volume([volume]) == pytest.approx(outline.area * height["HAvg"], rel=1e-3)
    places = rng.uniform(outline.bounds[:2], outline.bounds[2:], (4000, 2))
    assert np.nanmedian(house_heights(bare, places)) == pytest.approx(height["HMedian"], abs=0.1)


def test_interiors_are_valid_and_lie_within_the_house() -> None:
    attics = dormers = parts = 0
    for house in some_houses(1):
        shell = total_volume(make_representation(house, Representation("x", "2.2", kind="solid")))
        rooms = {level: make_interior(house, level) for level in ("0", "1", "2.2", "2.3")}
        assert [sum(room.volume.part >= 0 for room in each) for each in rooms.values()] == [len(house.parts)] * 4
        assert len(rooms["0"]) - len(house.parts) == house.storeys
        for level in ("1", "2.2", "2.3"):
            assert [found for room in rooms[level][-3:] if (found := faults(room.volume))] == []
            assert 0.3 * shell < total_volume([room.volume for room in rooms[level]]) < shell
        attics += sum(room.storey == house.storeys for room in rooms["2.3"])
        plain_attic, attic = (total_volume([room.volume for room in rooms[level]]) for level in ("2.2", "2.3"))
        dormers += attic > plain_attic + 0.1
        parts += len(house.parts)
        tops = [z for room in rooms["2.3"] for one in room.volume.surfaces for *_, z in one.border]
        assert max(tops) < house.z + house.height + house.roof.rise - 0.15
    assert attics > 1
    assert dormers
    assert parts
