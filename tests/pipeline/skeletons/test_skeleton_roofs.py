"""Roofs of a shape over outlines: planes, parts, solids."""

import math
from pathlib import Path

import numpy as np
import pytest
import shapely
from numpy.typing import NDArray

from pipeline.data.roof_forms import ROOF_SHAPES
from pipeline.data.roofs import is_flat, roof_heights
from pipeline.skeletons.part_cycles import LevelCuts, join_cycles
from pipeline.skeletons.skeleton_roofs import (
    RoofForm,
    ShapedRoof,
    find_gables,
    roof_solid,
    skeleton_roofs,
)
from pipeline.skeletons.straight_skeleton import outline_edges, straight_skeleton
from tests.helpers.house_outlines import HAND, KINDS, random_outlines
from tests.pipeline.skeletons.test_skeleton_peer import read_footprints

Array = NDArray[np.float64]

SLOPED = tuple(shape for shape in ROOF_SHAPES if shape not in ("flat", "skillion"))


def volume(points: Array, facets: list[list[int]]) -> float:
    """Volume inside plane facets by the divergence theorem."""
    at = points - points.mean(axis=0)
    return float(
        sum(
            np.linalg.det(at[[facet[0], facet[k], facet[k + 1]]]) / 6
            for facet in facets
            for k in range(1, len(facet) - 1)
        )
    )


def is_closed(facets: list[list[int]]) -> bool:
    """Tell whether each side of a facet is that of another one, backwards."""
    sides = [side for facet in facets for side in zip(facet, [*facet[1:], facet[0]], strict=True)]
    return len(set(sides)) == len(sides) and {(b, a) for a, b in sides} == set(sides)


def integrate(roof: ShapedRoof) -> float:
    """Integral of the planes of all parts, over their areas (m³): area times the height over their centroids."""
    centroids = shapely.get_coordinates(shapely.centroid(roof.parts))
    a, b, c = roof.roofs.plane.T
    x, y = (centroids - roof.roofs.origin).T
    return float((shapely.area(roof.parts) * (a * x + b * y + c)).sum())


def check_roof(polygon: shapely.Polygon, roof: ShapedRoof, tolerance: float = 0.02) -> None:
    """Parts cover the polygon and share all vertices; planes pass through all nodes; the solid is closed."""
    parts = roof.parts
    assert shapely.is_valid(parts).all()
    assert shapely.coverage_is_valid(parts)
    assert shapely.area(parts).sum() == pytest.approx(polygon.area, rel=1e-6)
    part = np.repeat(np.arange(len(roof)), np.diff(roof.part_start))
    heights = roof_heights(roof.roofs, part, roof.nodes[roof.part_node])
    np.testing.assert_allclose(heights, roof.height[roof.part_node], atol=tolerance)
    points, facets = roof_solid(roof, 0.0)
    assert is_closed(facets)
    assert volume(points, facets) == pytest.approx(integrate(roof), rel=1e-3)
    corners = set(map(tuple, outline_edges(polygon)[:, 0].tolist()))
    assert corners <= {tuple(xy) for part in parts for xy in shapely.get_coordinates(part).tolist()}


@pytest.mark.parametrize("shape", SLOPED)
@pytest.mark.parametrize("name", HAND)
def test_roofs_over_hand_made_outlines_are_closed(name: str, shape: str) -> None:
    polygon = HAND[name]
    roof = skeleton_roofs(polygon, 10.0, RoofForm(shape, height=3.0))
    check_roof(polygon, roof)
    assert roof.height.min() == 10.0
    assert roof.height.max() == pytest.approx(13.0)
    assert roof.roofs.limits.max() == pytest.approx(13.0)


@pytest.mark.parametrize("shape", SLOPED)
@pytest.mark.parametrize("kind", KINDS)
def test_roofs_over_random_outlines_are_closed(kind: str, shape: str) -> None:
    for polygon in random_outlines(kind, 1, seed=3):
        check_roof(polygon, skeleton_roofs(polygon, 10.0, RoofForm(shape)))


@pytest.mark.parametrize(
    ("shape", "expected"),
    [
        # Prism of 6 m: 4 x 3 / 2 across. The hip takes a pyramid's two thirds of both ends of 2 m.
        ("gabled", 6 * 6.0),
        ("hipped", 2 * 6.0 + 4 * 4 * 3 / 3),
        ("pyramidal", 6 * 4 * 3 / 3),
        # Each half hip takes a third of its gable above 1.5 m, 2 m wide there, times the 1 m that it is deep.
        ("half-hipped", 6 * 6.0 - 2 * 0.5),
        # Up to 0.3 of 2 m the height is 0.6 of 3 m: (0.6 x 1.8 + 1.4 x (1.8 + 3)) across.
        ("gambrel", 6 * (0.6 * 1.8 + 1.4 * 4.8)),
    ],
)
def test_volumes_are_those_found_by_hand(shape: str, expected: float) -> None:
    roof = skeleton_roofs(HAND["rectangle"], 10.0, RoofForm(shape, height=3.0))
    points, facets = roof_solid(roof, 10.0)
    assert volume(points, facets) == pytest.approx(expected)


def test_planes_of_a_gabled_roof() -> None:
    roof = skeleton_roofs(shapely.box(100.5, 200, 106.5, 204), 10.0, RoofForm("gabled", slope=1.5))
    assert [outline_edges(roof.polygon)[e, :, 1].tolist() for e in roof.edge] == [[200, 200], [204, 204]]
    np.testing.assert_allclose(roof.roofs.plane, [(0, 1.5, 10), (0, -1.5, 16)], atol=1e-12)
    np.testing.assert_array_equal(roof.roofs.origin, [(100, 200)] * 2)
    np.testing.assert_allclose(roof.roofs.limits, [(10, 13)] * 2)


def test_slope_and_height_say_the_same() -> None:
    steep = skeleton_roofs(HAND["L"], 5.0, RoofForm("hipped", slope=0.8))
    high = skeleton_roofs(HAND["L"], 5.0, RoofForm("hipped", height=1.6))
    np.testing.assert_allclose(steep.roofs.plane, high.roofs.plane, atol=1e-12)


@pytest.mark.parametrize(
    ("direction", "expected"),
    [
        (180.0, (0, 0.75, 10)),
        (0.0, (0, -0.75, 13)),
        (90.0, (-0.5, 0, 13)),
        (270.0, (0.5, 0, 10)),
        (None, (0, 0.75, 10)),
    ],
)
def test_a_skillion_roof_looks_downhill(direction: float | None, expected: tuple[float, float, float]) -> None:
    roof = skeleton_roofs(HAND["rectangle"], 10.0, RoofForm("skillion", height=3.0, direction=direction))
    np.testing.assert_allclose(roof.roofs.plane, [expected], atol=1e-12)
    np.testing.assert_allclose(roof.roofs.limits, [(10, 13)])
    assert roof.parts[0] == roof.polygon


def test_a_flat_roof_is_flat() -> None:
    roof = skeleton_roofs(HAND["courtyard"], 10.0, RoofForm("flat"))
    assert is_flat(roof.roofs).all()
    assert roof_heights(roof.roofs, np.array([0]), np.array([[1.0, 1.0]])).tolist() == [10.0]


def test_ends_of_wings_are_gables() -> None:
    def gables(name: str) -> list[list[list[float]]]:
        edges = outline_edges(HAND[name])
        return sorted(edges[e].tolist() for e in find_gables(straight_skeleton(HAND[name])))

    assert gables("rectangle") == [[[0, 4], [0, 0]], [[6, 0], [6, 4]]]
    assert gables("L") == [[[4, 12], [0, 12]], [[10, 0], [10, 4]]]
    assert gables("T") == [[[0, 4], [0, 0]], [[8, 12], [4, 12]], [[12, 0], [12, 4]]]
    assert len(gables("plus")) == len(gables("H")) == 4
    assert gables("courtyard") == []
    assert len(gables("square")) == 2


def test_a_gable_may_have_vertices_within() -> None:
    """A house of 10 m, whose end of 4 m has a vertex 1 cm off its line."""
    house = shapely.Polygon([(0, 0), (10, 0), (10.01, 1.5), (10, 4), (0, 4)])
    assert len(find_gables(straight_skeleton(house))) == 3
    roof = skeleton_roofs(house, 0.0, RoofForm("gabled"))
    assert len(roof) == 2
    check_roof(house, roof)


def test_an_edge_that_ends_before_its_half_hip_is_a_gable() -> None:
    """The lower 60 cm of the end are gone when the hip begins, at 1 of 2 m."""
    house = shapely.Polygon([(0, 0), (10, 0), (10.01, 0.6), (10, 4), (0, 4)])
    roof = skeleton_roofs(house, 0.0, RoofForm("half-hipped"))
    check_roof(house, roof)
    assert len(roof) == 4  # two sides, two half hips


def test_shorter_sides_are_gables() -> None:
    for axis, nearly_square in enumerate((shapely.box(0, 0, 4.003, 4), shapely.box(0, 0, 4, 4.003))):
        gables = find_gables(straight_skeleton(nearly_square))
        assert np.ptp(outline_edges(nearly_square)[gables], axis=1)[:, axis].tolist() == [0, 0]


def test_gables_may_be_given() -> None:
    """With its long sides as gables the ridge of a rectangle runs across."""
    roof = skeleton_roofs(HAND["rectangle"], 0.0, RoofForm("gabled", height=3.0, gables=(0, 2)))
    np.testing.assert_allclose(sorted(roof.roofs.plane.tolist()), [(-1, 0, 6), (1, 0, 0)], atol=1e-12)


def test_a_pyramid_needs_edges_that_face_its_apex() -> None:
    assert skeleton_roofs(HAND["rectangle"], 0.0, RoofForm("pyramidal")).shape == "pyramidal"
    assert skeleton_roofs(HAND["U"], 0.0, RoofForm("pyramidal")).shape == "hipped"
    assert skeleton_roofs(HAND["courtyard"], 0.0, RoofForm("pyramidal")).shape == "hipped"


def test_small_parts_are_joined_with_the_closest_plane() -> None:
    polygon = HAND["stair of half metres"]
    whole = skeleton_roofs(polygon, 10.0)
    roof = skeleton_roofs(polygon, 10.0, min_area=2.0)
    assert (shapely.area(whole.parts) < 2.0).sum() == 6
    assert shapely.area(roof.parts).min() >= 2.0
    assert shapely.area(roof.parts).sum() == pytest.approx(polygon.area)
    assert shapely.coverage_is_valid(roof.parts)
    assert (roof.roofs.limits[:, 0] == 10.0).all()


def test_cuts_at_a_level_give_pieces_on_both_sides() -> None:
    """A face with two humps of 3 m, cut at 2 m, its neighbour along one side of a hump."""
    xy = [(0.0, 0.0), (9.0, 0.0), (7.0, 3.0), (4.5, 1.0), (2.0, 3.0), (12.0, 3.0)]
    cuts = LevelCuts(xy, [y for _, y in xy], 2.0)
    below, above = cuts.cut([0, 1, 2, 3, 4], (1.0, 0.0))
    assert (len(below), len(above)) == (1, 2)
    area = {True: 0.0, False: 0.0}
    for cycle in below + above:
        area[cycle in above] += shapely.Polygon([cuts.xy[node] for node in cycle]).area
    assert sum(area.values()) == pytest.approx(shapely.Polygon(xy[:5]).area)
    assert area[True] == pytest.approx(2 * 0.5 * (2 / 3 + 1.25))
    n = len(cuts.xy)
    cuts.cut([1, 5, 2], (1.0, 0.0))
    assert len(cuts.xy) == n + 1  # the side in common is cut once


@pytest.mark.parametrize(
    ("one", "other", "expected"),
    [
        ([0, 1, 2, 3], [1, 4, 5, 2], [0, 1, 4, 5, 2, 3]),
        ([0, 1, 2], [3, 4, 5], None),  # apart
        ([0, 1, 2, 3, 4, 5, 6, 7], [1, 0, 8, 3, 2, 9], None),  # two sides in common, with a hole between
    ],
)
def test_cycles_are_joined_to_one_or_not_at_all(
    one: list[int], other: list[int], expected: list[int] | None
) -> None:
    assert join_cycles(one, other) == expected


@pytest.mark.parametrize(
    "form", [RoofForm("onion"), RoofForm(slope=0.0), RoofForm(height=-1.0), RoofForm(slope=math.nan)]
)
def test_forms_that_are_none_are_refused(form: RoofForm) -> None:
    with pytest.raises(ValueError, match="roof"):
        skeleton_roofs(HAND["square"], 0.0, form)


@pytest.mark.long
@pytest.mark.shared
@pytest.mark.parametrize("shape", SLOPED)
def test_roofs_over_footprints_are_closed(shared_data: Path, shape: str) -> None:
    for polygon in read_footprints(shared_data)[::3]:
        check_roof(polygon, skeleton_roofs(polygon, 10.0, RoofForm(shape, height=3.0)))


@pytest.mark.parametrize(
    ("form", "ridge"),
    [
        (RoofForm("gabled"), [(0, 3), (10, 3)]),
        (RoofForm("gabled", across=True), [(5, 0), (5, 6)]),
        (RoofForm("gabled", direction=80), [(5, 0), (5, 6)]),  # looks to the east and to the west
        (RoofForm("gabled", direction=190, across=True), [(0, 3), (10, 3)]),
    ],
)
def test_the_ridge_of_a_gabled_roof_over_four_sides_runs_as_told(
    form: RoofForm, ridge: list[tuple[float, float]]
) -> None:
    outline = shapely.Polygon([(0, 0), (4, 0), (10, 0), (10, 6), (0, 6)])  # one side in two pieces
    roof = skeleton_roofs(outline, 0.0, form)
    highest = roof.nodes[roof.height > roof.height.max() - 1e-9]
    np.testing.assert_allclose(sorted(highest.round(9).tolist())[:: len(highest) - 1], ridge, atol=1e-9)
    check_roof(outline, roof)


def test_an_orientation_says_nothing_over_more_than_four_sides() -> None:
    one, two = (skeleton_roofs(HAND["L"], 0.0, RoofForm("gabled", across=across)) for across in (False, True))
    assert one.height.tolist() == two.height.tolist()
