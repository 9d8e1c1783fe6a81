"""Houses are drawn by rules, from their lot and a seed alone."""

import math

import pytest
import shapely

from pipeline.architecture.draw import MARGIN, draw_house
from pipeline.architecture.levels import outline_rings
from pipeline.architecture.lots import list_lots
from pipeline.architecture.parameters import House
from pipeline.architecture.roof_sides import list_sides, wall_length
from pipeline.architecture.rules import PRESETS, make_rules
from pipeline.architecture.surfaces import GROUND, Surface, to_town

LAYOUTS = {
    "detached": ("random", 24.0),
    "terraces": ("rows", 6.5),
    "blocks": ("blocks", 10.0),
    "apartments": ("random", 60.0),
    "towers": ("grid", 55.0),
    "wings": ("random", 44.0),
}


PRESET = {"blocks": "terraces"}


def town(preset: str, bounds: tuple[float, float, float, float], **rules: object) -> list[House]:
    placement, size = LAYOUTS[preset]
    read = make_rules(rules, preset=PRESET.get(preset, preset))
    lots = list_lots(bounds, placement, size, seed=5, depth=read["width"].limits()[1])
    return [draw_house(read, lot, lambda x, y: 3.0, seed=5) for lot in lots]


def outline(house: House) -> shapely.Polygon:
    ring = [(x, y, 0.0) for x, y in outline_rings(house)[0]]
    return shapely.Polygon([place[:2] for place in to_town(house, [Surface(GROUND, ring, [])])[0].border])


@pytest.mark.parametrize("preset", LAYOUTS)
def test_a_town_is_the_same_in_parts(preset: str) -> None:
    whole = town(preset, (-120.0, -60.0, 240.0, 180.0))
    parts = town(preset, (-120.0, -60.0, 37.0, 180.0)) + town(preset, (37.0, -60.0, 240.0, 180.0))
    assert len(whole) > 3
    assert sorted(whole, key=lambda house: house.id) == sorted(parts, key=lambda house: house.id)
    assert len({house.id for house in whole}) == len(whole)


@pytest.mark.parametrize("preset", LAYOUTS)
def test_houses_do_not_overlap(preset: str) -> None:
    outlines = [outline(house) for house in town(preset, (0.0, 0.0, 400.0, 300.0))]
    tree = shapely.STRtree(outlines)
    pairs = [(a, b) for a, b in tree.query(outlines, "intersects").T.tolist() if a < b]
    assert all(outlines[a].intersection(outlines[b]).area < 0.05 for a, b in pairs)
    touching = [(a, b) for a, b in pairs if outlines[a].intersection(outlines[b]).length > 5]
    assert bool(touching) == (preset in ("terraces", "blocks"))


@pytest.mark.parametrize("preset", LAYOUTS)
def test_rules_and_constraints_hold(preset: str) -> None:
    rules = make_rules({}, preset=PRESET.get(preset, preset))
    for house in town(preset, (0.0, 0.0, 300.0, 300.0)):
        low, high = rules["storeys"].limits()
        assert low <= house.storeys <= high
        low, high = rules["storey_height"].limits()
        assert low - 0.001 <= house.storey_height <= high + 0.001
        assert house.roof.shape != "flat" or not (house.dormers or house.roof.rise)
        sides = {side.wall: side for side in list_sides(house)}
        for dormer in house.dormers:
            deep = (dormer.height + dormer.rise) / sides[0].slope
            left, right = dormer.along, dormer.along + dormer.width
            assert sides[0].holds((left, dormer.up), (right, dormer.up + deep), MARGIN - 1e-6)
        assert len({(dormer.up, dormer.width) for dormer in house.dormers}) <= 1
        for opening in house.openings:
            assert opening.kind == "window" or opening.sill < 0.1
            assert opening.height < house.storey_height
            assert (
                MARGIN - 1e-3 <= opening.along <= wall_length(house, opening.wall) - opening.width - MARGIN + 1e-3
            )
        assert all(part.height < house.height for part in house.parts)


def test_a_house_depends_on_seed_and_lot() -> None:
    rules = make_rules({})
    lots = list(list_lots((0.0, 0.0, 100.0, 100.0), "grid", 24.0, seed=1))
    one, same, other = (
        [draw_house(rules, lot, lambda x, y: 0.0, seed=seed) for lot in lots] for seed in (1, 1, 2)
    )
    assert one == same
    assert all(a.id != b.id and a.length != b.length for a, b in zip(one, other, strict=True))


def test_the_foot_is_at_the_lowest_corner() -> None:
    (lot, *_) = list_lots((0.0, 0.0, 50.0, 50.0), "random", 24.0, seed=1)
    house = draw_house(make_rules({}), lot, lambda x, y: 0.1 * x, seed=1)
    corners = [(house.x, house.y)]
    angle = math.radians(house.rotation)
    for along, away in ((house.length, 0.0), (house.length, house.width), (0.0, house.width)):
        x, y = along * math.cos(angle) - away * math.sin(angle), along * math.sin(angle) + away * math.cos(angle)
        corners.append((house.x + x, house.y + y))
    assert house.z == pytest.approx(0.1 * min(x for x, _ in corners), abs=0.002)


@pytest.mark.parametrize(
    ("rules", "told"),
    [
        ({"windows": 3}, "'windows' is not known"),
        ({"storeys": 0}, "gives 0 to 0, expected 1 to 200"),
        ({"length": {"uniform": [9, 4000]}}, "gives 9 to 4000"),
        ({"length": {"uniform": [12, 9]}}, "'length'"),
        ({"width": {"normal": [9, 0], "within": [8, 10]}}, "deviation 0"),
        ({"roof_shape": "onion"}, "'onion'; one of flat"),
        ({"roof_shape": {"uniform": [1, 2]}}, "expected a word"),
        ({"storeys": {"choice": [1, 2], "weights": [1]}}, "1 weights for 2"),
        ({"storeys": {"choice": []}}, "0 choices"),
        ({"garage": True}, "is no number"),
        ({"garage": 1.2}, "expected 0 to 1"),
        ({"garage": {"exactly": 1}}, "expected uniform"),
        ({"length": float("nan")}, "is no number"),
    ],
)
def test_wrong_rules_are_told(rules: dict[str, object], told: str) -> None:
    with pytest.raises(ValueError, match=told):
        make_rules(rules)


def test_rules_draw_what_they_say() -> None:
    houses = town("detached", (0.0, 0.0, 500.0, 500.0), roof_shape="hipped", storeys=2, garage=0, overhang=0.3)
    assert {house.roof.shape for house in houses} <= {"hipped", "pyramidal"}
    assert {house.storeys for house in houses} == {2}
    assert not any(part.kind == "garage" for house in houses for part in house.parts)
    shares = town("detached", (0.0, 0.0, 900.0, 900.0), chimney=0.25)
    assert 0.1 < sum(bool(house.chimneys) for house in shares) / len(shares) < 0.3  # some do not fit
    assert PRESETS["detached"]["chimney"] == 0.5
