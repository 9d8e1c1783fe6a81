"""Houses at all levels of detail: closed solids, volumes and heights that agree with each other."""

from collections import Counter
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import shapely

from pipeline.architecture.draw import draw_house
from pipeline.architecture.heights import house_heights
from pipeline.architecture.levels import FOOTPRINTS, LEVELS, TOPS, Volume, at_eaves, make_level, outline_rings
from pipeline.architecture.lots import Lot, list_lots
from pipeline.architecture.parameters import (
    ROOF_SHAPES,
    BuildingPart,
    Chimney,
    Dormer,
    House,
    Opening,
    Roof,
    RoofShape,
)
from pipeline.architecture.rules import PRESETS, make_rules
from pipeline.architecture.surfaces import ROOF, Surface


def plain(shape: RoofShape = "gabled", **others: Any) -> House:
    house = House(
        "h", 100.0, 200.0, 5.0, 30.0, 12.0, 8.0, 6.0, 2, 0.1, 0.3, Roof(shape, 3.0 * (shape != "flat"), 0.4)
    )
    return replace(house, **others)


def some_houses(n: int = 3) -> list[House]:
    """Houses of all presets, on hilly ground."""
    houses = []
    for preset, placement, size in (
        ("detached", "random", 24.0),
        ("terraces", "rows", 6.5),
        ("apartments", "grid", 60.0),
    ):
        rules = make_rules({}, preset=preset)
        lots = list(list_lots((0, 0, 400, 400), placement, size, seed=3, depth=9.0))
        few = n if preset == "apartments" else 3 * n
        houses += [draw_house(rules, lot, lambda x, y: 10 + 0.01 * x - 0.02 * y, seed=3) for lot in lots[:few]]
    return houses


def is_closed(surfaces: list[Surface]) -> bool:
    """Whether each edge is there once in each direction."""
    edges = Counter(
        (ring[k - 1], ring[k]) for one in surfaces for ring in (one.border, *one.holes) for k in range(len(ring))
    )
    return all(n == 1 and edges[b, a] == 1 for (a, b), n in edges.items())


def volume(surfaces: list[Surface]) -> float:
    """Signed volume by fans of triangles, holes included (their rings turn the other way)."""
    total = 0.0
    origin = np.array(surfaces[0].border[0])
    for one in surfaces:
        for ring in (one.border, *one.holes):
            places = np.array(ring) - origin
            for b, c in pairwise(places[1:]):
                total += float(np.dot(places[0], np.cross(b, c))) / 6
    return total


def total_volume(volumes: list[Volume]) -> float:
    return sum(volume(one.surfaces) for one in volumes)


@pytest.mark.parametrize("footprint", FOOTPRINTS)
def test_solids_are_closed_and_have_the_volume_of_their_level(footprint: Any) -> None:
    for house in some_houses():
        for level in LEVELS[4:]:
            volumes = make_level(house, level, footprint=footprint)
            for one in volumes:
                assert one.closed
                assert is_closed(one.surfaces), (house, level)
                assert volume(one.surfaces) > 0
        if footprint == "walls":
            main = {level: volume(make_level(house, level)[0].surfaces) for level in LEVELS[4:]}
            rectangle = house.length * house.width
            share = {"flat": 0.0, "shed": 0.5, "gabled": 0.5, "pyramidal": 1 / 3}.get(house.roof.shape)
            if share is not None:
                expected = rectangle * (house.height + share * house.roof.rise)
                assert main["2.0"] == pytest.approx(expected, rel=1e-3)
            assert main["1.1"] == pytest.approx(rectangle * (house.height + house.roof.rise / 2), rel=1e-3)
            assert main["2.2"] > main["2.0"] - 0.01 if not house.dormers else main["2.2"] > main["2.0"]
            assert main["3.3"] < main["3.2"] or not house.openings  # embrasures


def test_surfaces_without_overhangs_are_closed_with_chimneys() -> None:
    house = plain(chimneys=(Chimney(2, 4.0, 2.0, 0.6, 0.8),), roof=Roof("gabled", 3.0, 0.0))
    (bare,), (whole,) = make_level(house, "2.2"), make_level(house, "2.3", solid=False)
    assert is_closed(whole.surfaces)
    assert Counter(one.kind for one in whole.surfaces)["ClosureSurface"] == 1
    assert 0.6 * 0.6 * 0.8 < volume(whole.surfaces) - volume(bare.surfaces) < 0.6 * 0.6 * 2.5


@pytest.mark.parametrize("shape", ROOF_SHAPES)
def test_heights_are_those_of_the_surfaces(shape: RoofShape) -> None:
    house = plain(shape, parts=(BuildingPart("garage", 1, 1.0, 4.0, 3.0, 2.8),))
    if shape != "flat":
        house = replace(house, dormers=(Dormer(0, 3.0, 0.8, 1.5, 0.6, 0.3), Dormer(0, 7.0, 0.8, 1.2, 0.5)))
    if shape == "gabled":
        house = replace(house, chimneys=(Chimney(2, 4.0, 2.0, 0.6, 0.8),))
    rng = np.random.default_rng(1)
    seen = 0
    for one in (surface for body in make_level(house, "2.3", solid=False) for surface in body.surfaces):
        if one.kind not in (ROOF, "ClosureSurface"):
            continue
        corners = np.array(one.border)
        outline = shapely.Polygon(corners[:, :2], [np.array(hole)[:, :2] for hole in one.holes])
        normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
        places = rng.uniform(corners[:, :2].min(axis=0), corners[:, :2].max(axis=0), (200, 2))
        places = places[shapely.contains_xy(outline.buffer(-0.02), *places.T)]
        z = corners[0, 2] - (places - corners[0, :2]) @ normal[:2] / normal[2]
        found = house_heights(house, places)
        # Roofs and overhangs may lie below a dormer or beside a part, but nothing is below them.
        assert (found >= z - 0.005).all()
        assert np.abs(found - z).max(initial=0) < 0.005 or one.kind == ROOF
        seen += int((np.abs(found - z) < 0.005).sum())
    assert seen > 200
    far = np.array([[70.0, 200.0], [100.0, 170.0]])
    assert np.isnan(house_heights(house, far)).all()


def test_the_eaves_of_a_house_are_where_its_overhangs_end() -> None:
    for shape in ROOF_SHAPES:
        house = plain(shape)
        out = at_eaves(house)
        (edge,) = (one for one in make_level(house, "0.3")[0].surfaces if one.kind == ROOF)
        body = shapely.Polygon([place[:2] for place in edge.border])
        assert body.area == pytest.approx(out.length * out.width, rel=1e-3)
        assert at_eaves(out) == out
        top = max(z for one in make_level(house, "2.0")[0].surfaces for *_, z in one.border)
        lowest = min(
            z
            for one in make_level(house, "2.3", solid=False)[0].surfaces
            if one.kind == ROOF
            for *_, z in one.border
        )
        assert lowest == pytest.approx(out.z + out.height, abs=0.002)
        assert top == pytest.approx(house.z + house.height + house.roof.rise, abs=0.002)


def test_blocks_are_as_high_as_asked_for() -> None:
    house = plain()
    tops = {
        name: max(z for one in make_level(house, "1.2", top=name)[0].surfaces for *_, z in one.border)
        for name in TOPS
    }
    assert tops == pytest.approx({"eaves": 11.0, "third": 12.0, "half": 12.5, "two-thirds": 13.0, "ridge": 14.0})


def test_an_opening_is_a_hole_with_a_pane_behind_its_reveals() -> None:
    house = plain(openings=(Opening("window", 0, 2.0, 1.0, 1.2, 1.4), Opening("door", 0, 5.0, 0.05, 1.0, 2.0)))
    flush, deep = (make_level(house, level)[0].surfaces for level in ("3.2", "3.3"))
    assert Counter(one.kind for one in flush)["Window"] == Counter(one.kind for one in flush)["Door"] == 1
    assert len(deep) == len(flush) + 8
    lost = volume(flush) - volume(deep)
    assert lost == pytest.approx(0.1 * (1.2 * 1.4 + 1.0 * 2.0), rel=0.02)


def test_an_outline_has_the_area_of_body_and_parts() -> None:
    house = plain(
        parts=(BuildingPart("garage", 1, 1.0, 4.0, 3.0, 2.8), BuildingPart("alcove", 2, 3.0, 3.0, 1.5, 2.8))
    )
    assert shapely.Polygon(outline_rings(house)[0]).area == pytest.approx(12 * 8 + 4 * 3 + 3 * 1.5)


@pytest.mark.parametrize("words", [("2.4", "walls", "half"), ("2.0", "roof", "half"), ("1.0", "walls", "attic")])
def test_what_is_not_known_is_refused(words: Any) -> None:
    level, footprint, top = words
    with pytest.raises(ValueError, match="level"):
        make_level(plain(), level, footprint=footprint, top=top)


def test_presets_are_rules() -> None:
    for preset in PRESETS:
        house = draw_house(make_rules({}, preset=preset), Lot(0, 0, 0.0, 0.0, 60.0, 0.0), lambda x, y: 0.0, seed=1)
        assert make_level(house, "2.2")[0].closed


@pytest.mark.parametrize("shape", ["gabled", "hipped", "pyramidal"])
def test_what_stands_on_a_roof_stays_where_it_is_below_the_eaves(shape: RoofShape) -> None:
    dormers = (Dormer(0, 4.0, 0.8, 1.5, 0.6), Dormer(2, 5.0, 0.9, 1.2, 0.5))
    house = plain(shape, dormers=dormers, chimneys=(Chimney(0, 7.0, 2.0, 0.6, 0.8),))
    if shape == "hipped":
        house = replace(house, dormers=(*dormers, Dormer(1, 3.0, 0.7, 1.2, 0.4)))
    both: list[Any] = list(FOOTPRINTS)
    tops = [
        {place for one in make_level(house, "2.3", footprint=footprint, solid=False)[0].surfaces
         if one.kind == "ClosureSurface" or (one.kind == ROOF and len({z for *_, z in one.border}) == 1)
         for place in one.border}
        for footprint in both
    ]  # fmt: skip
    assert len(tops[0]) >= 12
    np.testing.assert_allclose(sorted(tops[0]), sorted(tops[1]), atol=0.002)
