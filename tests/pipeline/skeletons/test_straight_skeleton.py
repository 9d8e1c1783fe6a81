"""Straight skeletons by hand: nodes, faces, speeds, and what must not change them."""

import math
import pickle
import time

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import affinity

from pipeline.data.errors import GeometryError
from pipeline.skeletons.straight_skeleton import Skeleton, outline_edges, straight_skeleton
from pipeline.skeletons.wavefront import Chain
from tests.helpers.house_outlines import HAND, KINDS, random_outlines, symmetric_star

# Place and time of the nodes inside, by hand.
NODES = {
    "rectangle": [(2, 2, 2), (4, 2, 2)],
    "square": [(2, 2, 2)],
    "L": [(2, 2, 2), (2, 10, 2), (8, 2, 2)],
    "T": [(2, 2, 2), (6, 2, 2), (6, 10, 2), (10, 2, 2)],
    "U": [(2, 2, 2), (2, 8, 2), (10, 2, 2), (10, 8, 2)],
    "H": [(2, 2, 2), (2, 6, 2), (2, 10, 2), (10, 2, 2), (10, 6, 2), (10, 10, 2)],
    "plus": [(2, 6, 2), (6, 2, 2), (6, 6, 2), (6, 10, 2), (10, 6, 2)],
    "courtyard": [(2, 2, 2), (2, 10, 2), (10, 2, 2), (10, 10, 2)],
    "two courtyards": [(2, 2, 2), (2, 10, 2), (10, 2, 2), (10, 10, 2), (18, 2, 2), (18, 10, 2)],
    "vertices in walls": [(1, 3, 1), (2, 2, 2), (3, 2, 2), (4, 2, 2)],
}


def inside(skeleton: Skeleton) -> list[tuple[float, float, float]]:
    n = len(skeleton)
    return [(*xy, t) for xy, t in zip(skeleton.nodes[n:].tolist(), skeleton.time[n:].tolist(), strict=True)]


def meeting(skeleton: Skeleton, node: int) -> set[int]:
    """Edges whose faces meet in a node."""
    return {e for e in range(len(skeleton)) if node in skeleton.face(e)}


def same(one: Skeleton, other: Skeleton) -> bool:
    return all(
        np.array_equal(getattr(one, name), getattr(other, name))
        for name in ("nodes", "time", "edges", "speed", "start", "face_start", "face_node", "origin")
    )


@pytest.mark.parametrize("name", NODES)
def test_nodes_are_those_found_by_hand(name: str) -> None:
    skeleton = straight_skeleton(HAND[name])
    found = sorted(inside(skeleton))
    assert found == [pytest.approx(node, abs=1e-12) for node in sorted(NODES[name])]


def test_a_node_has_all_edges_that_end_there() -> None:
    plus = straight_skeleton(HAND["plus"])
    middle = next(k for k in range(len(plus), len(plus.nodes)) if np.allclose(plus.nodes[k], (6, 6)))
    # Four corners inwards meet there, each between the sides of two arms: all sides, no end of an arm.
    sides = {e for e, (a, b) in enumerate(outline_edges(HAND["plus"])) if sorted(abs((a + b) / 2 - 6)) == [2, 4]}
    assert meeting(plus, middle) == sides
    assert len(sides) == 8
    star = straight_skeleton(symmetric_star(7, 4.0, 13.0))
    assert len(star.nodes) == 15
    assert meeting(star, 14) == set(range(14))


def test_faces_go_around_their_edge() -> None:
    skeleton = straight_skeleton(HAND["rectangle"])
    assert [skeleton.face(e).tolist() for e in range(4)] == [[0, 1, 5, 4], [1, 2, 5], [2, 3, 4, 5], [3, 0, 4]]


@pytest.mark.parametrize("name", ["rectangle", "L", "T", "U", "H", "plus", "courtyard"])
def test_faces_have_the_order_of_directions_seen_from_their_edge(name: str) -> None:
    """The paper's order, for faces whose nodes are all seen from the middle of their edge."""
    skeleton = straight_skeleton(HAND[name])
    for e in range(len(skeleton)):
        face = skeleton.face(e)
        a, b = skeleton.nodes[face[:2]]
        middle, along = (a + b) / 2, b - a
        to = skeleton.nodes[face[1:]] - middle
        azimuth = np.arctan2(along[0] * to[:, 1] - along[1] * to[:, 0], to @ along)
        assert (np.diff(azimuth) >= -1e-12).all()


def test_a_vertex_that_runs_into_an_edge_divides_it() -> None:
    """A notch from below, tip at (5, 3): its tip meets the upper wall's front at (5, y): y - 3 = (8 - y) √2."""
    notched = shapely.Polygon([(0, 0), (4, 0), (5, 3), (6, 0), (10, 0), (10, 8), (0, 8)])
    skeleton = straight_skeleton(notched)
    # The notch's sides lean by atan(1/3): its tip moves up at sqrt(10) a unit of time, as each side moves at 1.
    t = 5 / (1 + math.sqrt(10))
    assert any(node == pytest.approx((5, 8 - t, t)) for node in inside(skeleton))


def test_two_vertices_that_run_into_each_other_are_one_node() -> None:
    """Notches from below and from above whose tips meet at (5, 4)."""
    hour_glass = shapely.Polygon(
        [(0, 0), (4, 0), (5, 3), (6, 0), (10, 0), (10, 8), (6, 8), (5, 5), (4, 8), (0, 8)]
    )
    skeleton = straight_skeleton(hour_glass)
    tips = [k for k in range(10, len(skeleton.nodes)) if np.allclose(skeleton.nodes[k], (5, 4))]
    assert len(tips) == 1
    assert len(meeting(skeleton, tips[0])) == 4


@pytest.mark.parametrize("name", [*HAND, *KINDS])
def test_neither_the_start_nor_the_order_of_rings_counts(name: str) -> None:
    polygons = [HAND[name]] if name in HAND else random_outlines(name, 3, seed=7)
    for polygon in polygons:
        turned = [
            [*ring.coords[k:-1], *ring.coords[: k + 1]][:: -1 if k % 2 else 1]
            for k, ring in enumerate((polygon.exterior, *polygon.interiors), start=1)
        ]
        other = shapely.Polygon(turned[0], turned[:0:-1])
        assert same(straight_skeleton(polygon), straight_skeleton(other))


@pytest.mark.parametrize("kind", KINDS)
def test_a_shift_by_whole_metres_shifts_nodes_alone(kind: str) -> None:
    for polygon in random_outlines(kind, 2, seed=8):
        here = shapely.set_precision(polygon, 2.0**-10)
        there = affinity.translate(here, 121_000, 487_000)
        one, other = straight_skeleton(here), straight_skeleton(there)
        assert np.array_equal(one.time, other.time)
        assert np.array_equal(one.face_node, other.face_node)
        assert np.array_equal(other.origin - one.origin, (121_000, 487_000))
        np.testing.assert_allclose(other.nodes - one.nodes - (121_000, 487_000), 0, atol=1e-10)


def test_an_edge_of_no_speed_is_a_gable() -> None:
    skeleton = straight_skeleton(HAND["rectangle"], [1, 0, 1, 0])
    assert inside(skeleton) == [(0, 2, 2), (6, 2, 2)]
    assert [len(skeleton.face(e)) for e in range(4)] == [4, 3, 4, 3]


def test_one_moving_edge_is_a_shed() -> None:
    skeleton = straight_skeleton(HAND["rectangle"], [1, 0, 0, 0])
    assert inside(skeleton) == [(0, 4, 4), (6, 4, 4)]
    np.testing.assert_array_equal(skeleton.nodes[4:], [(0, 4), (6, 4)])


def test_an_edge_that_sets_off_later_is_a_gable_below_a_hip() -> None:
    """The ends of a rectangle set off when both walls have come 1 m closer."""
    skeleton = straight_skeleton(HAND["rectangle"], start=[0, 1, 0, 1])
    assert inside(skeleton) == [(0, 1, 1), (0, 3, 1), (6, 1, 1), (6, 3, 1), (1, 2, 2), (5, 2, 2)]
    assert {len(skeleton.face(e)) for e in (1, 3)} == {5}


def test_an_edge_that_sets_off_too_late_is_a_gable() -> None:
    late = straight_skeleton(HAND["rectangle"], start=[0, 2.5, 0, 2.5])
    gabled = straight_skeleton(HAND["rectangle"], [1, 0, 1, 0])
    assert inside(late) == inside(gabled)
    assert late.speed.tolist() == [1, 0, 1, 0]


def test_a_faster_edge_goes_further() -> None:
    """Walls at 1 and 3 across 4 m meet after 1, at 1 m and 3 m from them."""
    skeleton = straight_skeleton(HAND["rectangle"], [1, 1, 3, 1])
    assert inside(skeleton) == [pytest.approx((1, 1, 1)), pytest.approx((5, 1, 1))]


def test_a_faster_edge_takes_the_place_of_a_slower_one_on_its_line() -> None:
    """A T whose shoulders are on one line, y = 2, when its stem ends: the left one, half as fast, is gone then."""
    t = shapely.Polygon([(0, -8), (12, -8), (12, 4), (8, 4), (8, 12), (4, 12), (4, 3), (0, 3)])
    edges = outline_edges(t)
    right, left = (next(e for e, (a, b) in enumerate(edges) if a[1] == b[1] == y) for y in (4, 3))
    speed = np.ones(8)
    speed[left] = 0.5
    skeleton = straight_skeleton(t, speed)
    assert (6, 2, 2) in inside(skeleton)
    assert (2, 2, 2) in inside(skeleton)
    areas = [shapely.Polygon(skeleton.nodes[skeleton.face(e)]).area for e in range(8)]
    assert areas[left] == pytest.approx(0.5 * (4 + 4))  # (0, 3), (2, 2), (6, 2), (4, 3)
    # From there on the right one has all of the line.
    assert skeleton.nodes[skeleton.face(right), 0].min() == pytest.approx(2)


def test_no_two_nodes_are_one() -> None:
    for name, polygon in HAND.items():
        skeleton = straight_skeleton(polygon, tolerance=0.0)
        nodes = {(round(x, 6), round(y, 6), round(t, 6)) for x, y, t in inside(skeleton)}
        assert len(nodes) == len(skeleton.nodes) - len(skeleton), name
        assert skeleton.time[len(skeleton) :].min() > 0, name


def test_nodes_are_joined_no_farther_than_the_tolerance() -> None:
    """Nodes around the middle of an almost round house, 7 mm apart in all, are not all one."""
    rng = np.random.default_rng(4)
    angle = np.arange(24) * math.pi / 12
    radius = 5 + rng.uniform(-0.01, 0.01, 24)
    house = shapely.Polygon(np.column_stack((radius * np.cos(angle), radius * np.sin(angle))))
    exact, joined = straight_skeleton(house, tolerance=0.0), straight_skeleton(house)
    assert len(joined.nodes) < len(exact.nodes)
    distance = np.hypot(*(exact.nodes[24:, np.newaxis] - joined.nodes[24:]).transpose(2, 0, 1))
    assert distance.min(axis=1).max() < 0.005
    assert np.ptp(exact.nodes[24:], axis=0).max() > 0.01


def test_close_nodes_are_one() -> None:
    """A rectangle 3 mm longer than wide has a ridge of 3 mm."""
    nearly_square = shapely.box(0, 0, 4.003, 4)
    assert len(inside(straight_skeleton(nearly_square))) == 1
    assert inside(straight_skeleton(nearly_square, tolerance=0.001)) == [
        pytest.approx((2, 2, 2)),
        pytest.approx((2.003, 2, 2)),
    ]


def test_joining_does_not_break_narrow_faces() -> None:
    """A wall of 2 mm has a face of 2 mm, whose nodes are not joined."""
    chamfered = shapely.Polygon([(0, 0), (6, 0), (6, 3.999), (5.999, 4), (0, 4)])
    skeleton = straight_skeleton(chamfered)
    areas = [shapely.Polygon(skeleton.nodes[skeleton.face(e)]).area for e in range(5)]
    assert min(areas) > 0
    assert sum(areas) == pytest.approx(chamfered.area)


def test_an_edge_is_divided_where_a_courtyard_touches_it() -> None:
    polygon = HAND["courtyard at a wall"]
    assert len(outline_edges(polygon)) == 8
    skeleton = straight_skeleton(polygon)
    assert sum(shapely.Polygon(skeleton.nodes[skeleton.face(e)]).area for e in range(8)) == pytest.approx(
        polygon.area
    )


@pytest.mark.parametrize(
    ("polygon", "reason"),
    [
        (shapely.Polygon([(0, 0), (4, 4), (4, 0), (0, 4)]), r"Self-intersection\[2 2\]"),
        (shapely.Polygon(), "no valid polygon"),
        (shapely.Polygon([(0, 0), (9, 0), (9, 5), (8.99999, 5), (0, 5)]), r"edge at \(9.000, 5.000\) is 1e-05 m"),
        (shapely.MultiPolygon([shapely.box(0, 0, 1, 1)]), "no valid polygon"),
    ],
)
def test_what_has_no_skeleton_is_one_clear_error(polygon: shapely.Polygon, reason: str) -> None:
    with pytest.raises(GeometryError, match=reason) as error:
        straight_skeleton(polygon)
    assert pickle.loads(pickle.dumps(error.value)).args == error.value.args


def test_speeds_that_never_close_the_roof_are_an_error() -> None:
    with pytest.raises(GeometryError, match="meet no other edge"):
        straight_skeleton(HAND["plus"], [1.0] + [0.0] * 11)
    with pytest.raises(ValueError, match="starts"):
        straight_skeleton(HAND["square"], start=[0, 0, 0, -1])
    walls = HAND["vertices in walls"]
    with pytest.raises(GeometryError, match="on one line have speeds"):
        straight_skeleton(walls, [1, 2, 1, 1, 1, 1])


@pytest.mark.parametrize(
    "speed", [[1, 1, 1], [1, 1, 1, -1], [0, 0, 0, 0], [1, 1, 1, math.inf], [1, 1, math.nan, 1]]
)
def test_speeds_that_are_none_are_refused(speed: list[float]) -> None:
    with pytest.raises(ValueError, match="speeds"):
        straight_skeleton(HAND["rectangle"], speed)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.lists(st.floats(0.2, 5), min_size=80, max_size=80))
def test_any_speeds_give_faces_that_cover_a_star(seed: int, speeds: list[float]) -> None:
    polygon = random_outlines("star", 1, seed)[0]
    skeleton = straight_skeleton(polygon, speeds[: len(outline_edges(polygon))])
    faces = np.array([shapely.Polygon(skeleton.nodes[skeleton.face(e)]) for e in range(len(skeleton))])
    assert shapely.is_valid(faces).all()
    assert shapely.area(faces).sum() == pytest.approx(polygon.area, rel=1e-9)
    assert shapely.union_all(faces, grid_size=1e-7).area == pytest.approx(polygon.area, rel=1e-5)


def test_a_small_house_takes_some_milliseconds() -> None:
    polygon = HAND["U"]
    straight_skeleton(polygon)
    start = time.process_time()
    for _ in range(20):
        straight_skeleton(polygon)
    assert (time.process_time() - start) / 20 < 0.02


ALONG = [(1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0)]  # edges to the right, up, to the left, down


def test_an_edge_has_its_outer_side_to_its_right() -> None:
    wall = Chain([], (0, 1), (0, 0), ALONG)
    assert (wall.middle, wall.half) == pytest.approx((1.5 * math.pi, 0.5 * math.pi))


def test_what_touches_from_outside_is_apart_and_what_moved_on_is_not() -> None:
    wall = Chain([], (0, 1), (0, 0), ALONG)
    tip = Chain([5], (2, 3), (3, 1), ALONG)  # down and up again: a notch from above without width
    corner = Chain([6], (2, 3), (1, 2), ALONG)  # a corner of a house, its outer side three quarters
    assert tip.half == pytest.approx(0.0)
    assert tip.is_apart(wall)
    assert not corner.is_apart(wall)
    assert not corner.is_apart(corner)


def test_edges_that_came_to_lie_on_each_other_have_no_inner_side() -> None:
    assert Chain([5, 6], (2, 3), (2, 0), ALONG).half == pytest.approx(math.pi)


def test_events_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pipeline.skeletons.wavefront.EVENTS_PER_EDGE", -25)
    with pytest.raises(GeometryError, match="more than -25 events an edge near"):
        straight_skeleton(HAND["square"])
