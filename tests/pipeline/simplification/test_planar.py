"""The planar city model: hand-worked streets, fallbacks, and promises on random ones, checked by brute force."""

from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from shapely import Polygon, box

import pipeline.simplification.graph
import pipeline.simplification.shaping
import pipeline.simplification.snap
from pipeline.data.errors import GeometryError
from pipeline.data.roofs import Roofs, flat_roofs, join_roofs
from pipeline.geometry.components import join_pairs
from pipeline.roofs.house_levels import HouseParts
from pipeline.simplification.fidelity import FARTHEST, measure_moved_roofs, measure_simplification
from pipeline.simplification.graph import WallGraph, find_near, make_graph, node_walls, trace_faces
from pipeline.simplification.house_clusters import find_close
from pipeline.simplification.labels import Territories
from pipeline.simplification.planar import COUNTS, PlanarCity, shape_planar
from pipeline.simplification.shaping import Shaped
from pipeline.simplification.snap import collapse, node_crossings, straighten
from pipeline.simplification.square_cells import draw_cells
from tests.helpers.campaigns import examples
from tests.helpers.cities import CITY_OPTIONS
from tests.helpers.whole_city import simplify_houses

EPS, MIN_AREA, MIN_COURTYARD = 0.5, 5.0, 5.0


def simplify(*polygons: Polygon, clearance: float = EPS, manifold: bool = False) -> PlanarCity:
    return shape_joined(np.array(polygons, dtype=object), clearance=clearance, manifold=manifold)[0]


def shape_joined(
    houses: NDArray[np.object_], *, clearance: float, manifold: bool = False
) -> tuple[PlanarCity, NDArray[np.int64]]:
    """Shape clusters of close houses, joined until their results are apart; give the clusters too."""
    cluster = find_clusters(houses, clearance)
    while True:
        city = shape_planar(
            houses,
            cluster,
            clearance=clearance,
            min_area=MIN_AREA,
            min_courtyard_area=MIN_COURTYARD,
            manifold=manifold,
        )
        joined = join_pairs(len(houses), cluster[city.house][find_close(city.polygons, clearance)])[cluster]
        if (joined == cluster).all():
            return city, cluster
        cluster = joined


def find_clusters(houses: NDArray[np.object_], clearance: float) -> NDArray[np.int64]:
    return join_pairs(len(houses), find_close(houses, clearance))


def test_near_vertices_are_the_pairs_of_one_cluster_that_are_closer_than_the_bound() -> None:
    rng = np.random.default_rng(4)
    rows = np.unique(np.column_stack((rng.integers(0, 3, 400), rng.integers(0, 40, (400, 2)))), axis=0)
    cluster, xy = rows[:, 0], rows[:, 1:].astype(np.float64)
    graph = WallGraph(xy, cluster, np.zeros((0, 2), np.int64), np.zeros(0))
    (i, j), distance = find_near(graph, 5.0)
    apart = np.hypot(*(xy[:, None] - xy[None]).transpose(2, 0, 1))
    close = np.triu((apart < 5) & (cluster[:, None] == cluster[None]), 1)
    assert (apart == 5).any()
    assert sorted(zip(i.tolist(), j.tolist(), strict=True)) == list(map(tuple, np.argwhere(close).tolist()))
    assert (distance == apart[i, j]).all()


def shapes(city: PlanarCity) -> dict[int, list[str]]:
    """List the faces of each house as text."""
    return {
        house: [str(polygon) for polygon in city.polygons[city.house == house]]
        for house in np.unique(city.house).tolist()
    }


def assert_promises(city: PlanarCity, clearance: float) -> None:
    """Check distances by brute force, faces by overlay."""
    assert shapely.is_valid(city.polygons).all()
    assert (shapely.get_type_id(city.polygons) == shapely.GeometryType.POLYGON).all()
    assert tuple(city.counts) == COUNTS
    if not len(city.polygons):
        return
    xy, ring = shapely.get_coordinates(shapely.get_rings(city.polygons), return_index=True)
    assert np.array_equal(xy, np.rint(xy * 1000) / 1000)
    start = np.flatnonzero(ring[1:] == ring[:-1])
    vertices, number = np.unique(xy, axis=0, return_inverse=True)
    number = number.reshape(-1)
    walls = np.unique(np.sort(np.column_stack((number[start], number[start + 1])), axis=1), axis=0)
    points = shapely.points(vertices)
    lines = shapely.linestrings(vertices[walls])
    apart = shapely.distance(points[:, None], points)
    assert (apart[~np.eye(len(points), dtype=np.bool_)] >= clearance - 1e-7).all()
    apart = shapely.distance(points[:, None], lines)
    ends = (walls[:, 0] == np.arange(len(points))[:, None]) | (walls[:, 1] == np.arange(len(points))[:, None])
    assert (apart[~ends] >= clearance - 1e-7).all()
    assert not shapely.crosses(lines[:, None], lines).any()
    together = shapely.union_all(city.polygons).area
    assert shapely.area(city.polygons).sum() == pytest.approx(together, abs=1e-6 * together)


def blobs(city: PlanarCity) -> list[tuple[bytes, str]]:
    return list(zip(shapely.to_wkb(city.polygons).tolist(), city.method, strict=True))


def test_terraces_that_are_set_off_keep_their_party_wall() -> None:
    city = simplify(box(0, 0, 5, 10), box(5, 0.3, 10, 10.3))
    # The corners of one house on the wall of the other are junctions: these stay, the plain corners join them.
    assert shapes(city) == {
        0: ["POLYGON ((0 0, 5 0.3, 5 10, 0 10, 0 0))"],
        1: ["POLYGON ((5 0.3, 10 0.3, 10 10.3, 5 10, 5 0.3))"],
    }
    assert (city.counts["collapsed"], city.counts["clusters"], city.method) == (2, 1, ("snapped", "snapped"))
    assert_promises(city, EPS)


def test_a_gap_below_the_clearance_becomes_a_party_wall() -> None:
    city = simplify(box(0, 0, 4, 4), box(4.4, 0, 9, 4))
    # The corners with the longer walls stay.
    assert shapes(city) == {
        0: ["POLYGON ((0 0, 4.4 0, 4.4 4, 0 4, 0 0))"],
        1: ["POLYGON ((4.4 0, 9 0, 9 4, 4.4 4, 4.4 0))"],
    }


def test_a_gap_of_the_clearance_stays() -> None:
    city = simplify(box(0, 0, 4, 4), box(4.5, 0, 9, 4), box(9.499, 0, 14, 4))
    assert shapes(city)[0] == ["POLYGON ((0 0, 4 0, 4 4, 0 4, 0 0))"]
    assert shapely.distance(city.polygons[city.house == 1], city.polygons[city.house == 2]) == 0
    assert city.counts["clusters"] == 2


def test_a_corner_on_a_wall_is_a_vertex_of_both_houses() -> None:
    city = simplify(box(0, 0, 4, 10), box(4, 3, 8, 7))
    assert shapes(city) == {
        0: ["POLYGON ((0 0, 4 0, 4 3, 4 7, 4 10, 0 10, 0 0))"],
        1: ["POLYGON ((4 3, 8 3, 8 7, 4 7, 4 3))"],
    }


def test_a_wall_too_close_to_a_corner_bends_through_it() -> None:
    city = simplify(box(0, 0, 4, 10), Polygon([(4.3, 5), (9, 2), (9, 8)]))
    # Along a wall of 10 m a bend is 0.3 m at most; the tip does not move.
    assert shapes(city) == {
        0: ["POLYGON ((0 0, 4 0, 4.3 5, 4 10, 0 10, 0 0))"],
        1: ["POLYGON ((4.3 5, 9 2, 9 8, 4.3 5))"],
    }
    assert (city.counts["bent"], city.counts["corner-touches"]) == (1, 1)


def test_a_jog_of_two_centimetres_goes() -> None:
    city = simplify(Polygon([(0, 0), (5, 0), (5, 0.02), (10, 0.02), (10, 8), (0, 8)]))
    ring = shapely.get_coordinates(city.polygons)
    assert len(ring) == 5
    assert measure_simplification(np.array([box(0, 0, 10, 8)]), city.polygons, city.house).house_error[0] <= 0.11


def test_a_courtyard_stays_and_a_light_shaft_goes() -> None:
    city = simplify(box(0, 0, 20, 10).difference(box(2, 2, 8, 8)).difference(box(14, 4, 16, 6)))
    assert shapes(city) == {0: ["POLYGON ((0 0, 20 0, 20 10, 0 10, 0 0), (2 2, 2 8, 8 8, 8 2, 2 2))"]}
    assert city.counts["small-faces"] == 1


def test_a_court_between_houses_stays_open() -> None:
    ring = box(0, 0, 20, 20).difference(box(7, 7, 13, 13))
    halves = [ring.intersection(box(0, 0, 10, 20)), ring.intersection(box(10, 0, 20, 20))]
    city = simplify(*halves)
    assert shapely.area(city.polygons).tolist() == [182.0, 182.0]


def test_a_house_in_a_courtyard_keeps_its_distance() -> None:
    inner = box(4, 4, 8, 8)
    city = simplify(box(0, 0, 12, 12).difference(box(3, 3, 9, 9)), inner)
    assert [str(polygon) for polygon in city.polygons[city.house == 1]] == ["POLYGON ((4 4, 8 4, 8 8, 4 8, 4 4))"]
    assert city.counts["clusters"] == 2
    assert_promises(city, EPS)


def test_a_house_in_a_light_shaft_is_not_swallowed() -> None:
    # The shaft has 4 m2 less the house: it would be filled, and the house with it, were they not taken together.
    outer = box(0, 0, 12, 12).difference(box(5, 5, 7.1, 7.1))
    city = simplify(outer, box(5.6, 5.6, 6.5, 6.5), clearance=0.4)
    assert city.counts["clusters"] == 1
    assert set(city.house.tolist()) == {0, 1}
    assert_promises(city, 0.4)


def test_of_equal_houses_one_is_lost_and_said_to_be() -> None:
    city = simplify(box(0, 0, 4, 4), box(9, 0, 13, 4), box(0, 0, 4, 4))
    assert (city.lost, city.counts["houses-lost"], city.counts["lost-area-m2"]) == ((2,), 1, 16)
    assert city.house.tolist() == [0, 1]


def test_common_ground_goes_to_the_smaller_house() -> None:
    city = simplify(box(0, 0, 10, 10), box(8, 2, 12, 6))
    assert shapely.area(city.polygons[city.house == 1]).tolist() == [16.0]
    assert shapely.area(city.polygons[city.house == 0]).tolist() == [92.0]


@pytest.mark.parametrize(("height", "areas"), [(15.0, [100.0, 8.0]), (25.0, [92.0, 16.0]), (np.nan, [92.0, 16.0])])
def test_common_ground_goes_to_the_higher_house_where_roofs_are_known(height: float, areas: list[float]) -> None:
    """The large house slopes from 10 m in the west to 20 m in the east, 18 m at least where they overlap."""
    slope = Roofs(np.array([[1.0, 0.0, 10.0]]), np.zeros((1, 2)), np.array([[10.0, 20.0]]))
    houses = np.array([box(0, 0, 10, 10), box(8, 2, 12, 6)], dtype=object)
    city = shape_planar(
        houses,
        np.zeros(2, np.int64),
        clearance=EPS,
        min_area=MIN_AREA,
        min_courtyard_area=MIN_COURTYARD,
        roofs=join_roofs([slope, flat_roofs(np.array([height]))]),
    )
    assert np.bincount(city.house, shapely.area(city.polygons)).tolist() == areas


def test_a_cluster_whose_roofs_would_be_off_keeps_a_finer_clearance() -> None:
    """A party wall with a step of 0.4 m, between 5 and 45 m; and the same one between 5 and 5.2 m elsewhere.

    A corner of 7 cm in another wall stays with the finer clearance alone.
    """
    low = Polygon([(0, 0), (10, 0), (10, 5), (10.4, 5), (10.4, 10), (5, 10.07), (0, 10)])
    pair = np.array([low, box(0, 0, 20, 10) - low], dtype=object)
    houses = np.concatenate((pair, shapely.transform(pair, lambda xy: xy + 100.0)))
    roofs, cluster = flat_roofs(np.array([5.0, 45.0, 5.0, 5.2])), np.array([0, 0, 1, 1])

    def shape(finer: float) -> PlanarCity:
        return shape_planar(
            houses,
            cluster,
            clearance=EPS,
            min_area=MIN_AREA,
            min_courtyard_area=MIN_COURTYARD,
            roofs=roofs,
            finer=finer,
        )

    coarse, fine = shape(0.0), shape(0.3)
    assert set(coarse.clearance.tolist()) == {EPS}
    assert fine.clearance[np.argsort(fine.house)].tolist() == [0.3, 0.3, EPS, EPS]
    outlines = [city.polygons[np.argmin(city.house)].exterior.coords for city in (coarse, fine)]
    assert [(5.0, 10.07) in outline for outline in outlines] == [False, True]
    territories = Territories(shapely.transform(houses, lambda xy: xy * 1000), np.arange(4), cluster)
    for city, off in ((coarse, 40 * 0.1), (fine, 0.0)):  # a triangle of 1 m2, or none, of 100 m2
        faces = shapely.transform(city.polygons, lambda xy: xy * 1000)
        shaped = Shaped(faces, city.house, cluster[city.house], np.empty(0, np.int64), {})
        rmse = measure_moved_roofs(territories, shaped, roofs, np.arange(4))
        assert rmse[:2].max() == pytest.approx(off, rel=0.05)
        assert rmse[2:].max() == pytest.approx(0.02, rel=0.05)


@pytest.mark.parametrize(("least_moved", "left"), [(False, [0.0, 70.0]), (True, [0.0, 0.0])])
def test_of_a_step_the_end_of_the_long_wall_can_stay(least_moved: bool, left: list[float]) -> None:
    """A step of 7 cm between a wall of 11 m and a corner of shorter walls, which is the more important one."""
    xy = np.array([[0, 0], [11000, 0], [0, 70], [0, 7000], [-400, 70]], np.float64)
    edges = np.array([[0, 1], [0, 2], [2, 3], [2, 4], [1, 3], [3, 4]])
    graph = make_graph(xy, np.zeros(5, np.int64), edges, np.zeros(6))
    united, _ = collapse(graph, 300.0, least_moved=least_moved)
    assert [left in united.xy.tolist(), len(united.xy)] == [True, 4]


def test_houses_that_touch_in_a_corner_are_counted_or_parted() -> None:
    pair = (box(0, 0, 4, 4), box(4, 4, 8, 8))
    city = simplify(*pair)
    assert (city.counts["corner-touches"], city.counts["opened"]) == (1, 0)
    assert measure_simplification(np.array(pair), city.polygons, city.house).corner_touches == 1
    city = simplify(*pair, manifold=True)
    assert (city.counts["corner-touches"], city.counts["opened"]) == (0, 1)
    found = measure_simplification(np.array(pair), city.polygons, city.house)
    # The cut across a right angle at 1.05 x sqrt(2) times the clearance: half of that squared goes.
    assert found.house_error.sum() == pytest.approx((1.05 * EPS) ** 2, rel=0.01)
    assert found.corner_touches == 0
    assert_promises(city, EPS)


def test_a_corner_without_room_to_open_it_is_closed() -> None:
    # Both houses at the corner (4, 4) are as narrow as the clearance there.
    left = Polygon([(0, 0), (4, 3.4), (4, 4), (0, 4)])
    right = Polygon([(4, 4), (8, 4), (8, 8), (4, 4.6)])
    city = simplify(left, right, manifold=True)
    assert city.counts["corner-touches"] == 0
    assert city.counts["opened"] + city.counts["closed"] >= 1
    assert_promises(city, EPS)


def test_houses_too_blunt_to_part_are_joined_at_their_corner() -> None:
    # Both have 150 degrees at the origin, too much for a chord across; the open sectors have 30.
    x, y = 9.659, 2.588
    upper = Polygon([(0, 0), (x, y), (x, 12), (-x, 12), (-x, y)])
    lower = Polygon([(0, 0), (-x, -y), (-x, -12), (x, -12), (x, -y)])
    city = simplify(upper, lower, manifold=True)
    assert (city.counts["opened"], city.counts["closed"], city.counts["corner-touches"]) == (0, 1, 0)
    assert set(city.method) == {"snapped"}
    # The tip that is filled is 1.05 clearances wide; the grid bends walls of 10 m by half a millimetre.
    filled = shapely.area(city.polygons).sum() - upper.area - lower.area
    assert filled == pytest.approx(0.25 * (1.05 * EPS) ** 2 / np.tan(np.radians(15)), rel=0.02)
    assert_promises(city, EPS)


def test_a_sharp_corner_is_cut() -> None:
    wedge = Polygon([(0, 0), (30, 0), (30, 4)])
    city = simplify(wedge)
    found = measure_simplification(np.array([wedge]), city.polygons, city.house)
    assert city.counts["blunted"] == 1
    assert found.sharpest > 60
    # Where the wedge is 1.05 x 0.5 m wide, its tip is 3.9 m long.
    assert found.house_error[0] == pytest.approx(0.5 * 0.525 * 3.95, rel=0.03)


def test_clusters_whose_results_come_too_close_are_taken_together() -> None:
    # The dent of 8 cm is straightened away, towards the tip that is 0.52 m from it.
    dented = Polygon([(0, 0), (10, 0), (9.92, 5), (10, 10), (0, 10)])
    tip = Polygon([(10.44, 5), (13, 2), (16, 5), (13, 8)])
    pair = np.array([dented, tip], dtype=object)
    assert find_clusters(pair, EPS).tolist() == [0, 1]
    parts = HouseParts(pair, np.arange(2))
    shapes = simplify_houses(parts, pair, replace(CITY_OPTIONS, simplify="clearance", clearance=EPS))
    assert (shapes.counts["clusters joined"], shapes.cluster.tolist()) == (1, [0, 0])
    assert shapely.to_wkb(shapes.polygons).tolist() == shapely.to_wkb(simplify(dented, tip).polygons).tolist()
    assert_promises(simplify(dented, tip), EPS)


@pytest.mark.parametrize("manifold", [False, True])
def test_walls_that_do_not_settle_are_drawn_with_cells(manifold: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pipeline.simplification.snap, "MAX_ROUNDS", 0)
    houses = [box(0, 0, 7.7, 10.1), box(7.7, 0.2, 15, 10), Polygon([(15, 10), (21, 12), (17, 19)])]
    city = simplify(*houses, box(40, 0, 50, 10), manifold=manifold)
    assert set(city.method) == {"cells"}
    assert (city.counts["cells"], city.counts["corner-touches"]) == (2, 0)
    assert shapes(city)[3] == ["POLYGON ((40 0, 50 0, 50 10, 40 10, 40 0))"]
    found = measure_simplification(np.array([*houses, box(40, 0, 50, 10)]), city.polygons, city.house)
    assert (found.lost, city.lost) == ((), ())
    assert found.area_error < 0.05
    assert_promises(city, EPS)


def test_a_cluster_that_fails_is_tried_with_a_wider_clearance_first(monkeypatch: pytest.MonkeyPatch) -> None:
    settle = pipeline.simplification.snap.settle

    def fail(graph: WallGraph, *, clearance: float, **rules: Any) -> object:
        settled, restless, counts = settle(graph, clearance=clearance, **rules)
        return settled, np.unique(graph.cluster[graph.xy[:, 0] < 20000]) if clearance == 500 else restless, counts

    monkeypatch.setattr(pipeline.simplification.shaping, "settle", fail)
    city = simplify(box(0, 0, 4, 4), box(4.4, 0, 9, 4), box(30, 0, 40, 4))
    assert city.method == ("snapped-wider", "snapped-wider", "snapped")
    assert (city.counts["snapped"], city.counts["snapped-wider"], city.counts["cells"]) == (1, 1, 0)


@pytest.mark.parametrize(
    "other",
    [Polygon([(4.3, 4.2), (9, 4.2), (9, 9), (4.3, 9)]), Polygon([(4.3, 2), (9, 0), (9, 4)])],
    ids=["two corners", "a corner and a wall"],
)
def test_the_check_believes_no_round(other: Polygon, monkeypatch: pytest.MonkeyPatch) -> None:
    def claim(graph: WallGraph, *, clearance: float, chain_tolerance: float, least_moved: bool) -> object:
        assert clearance > chain_tolerance
        return graph, np.zeros(0, np.int64), Counter({"rounds": 1})

    monkeypatch.setattr(pipeline.simplification.shaping, "settle", claim)
    city = simplify(box(0, 0, 4, 4), other, box(30, 0, 40, 4))
    assert city.counts["cells"] == city.counts["snapped"] == 1
    assert_promises(city, EPS)


def test_a_vertex_stays_where_the_straight_wall_would_cross_another() -> None:
    blunt = Polygon([(0, 0), (0, -5000), (10000, -5000), (10000, 0), (5000, 100)])
    free = straighten(node_walls(np.array([blunt]), np.zeros(1, np.int64)), 200.0)
    assert (len(free[0].xy), free[1].tolist()) == (4, [0])
    assert free[0].slack.tolist() == [0, 0, 100, 0]
    inside = Polygon([(5000, 50), (4000, -3000), (6000, -3000)])
    blocked = straighten(node_walls(np.array([blunt, inside]), np.zeros(2, np.int64)), 200.0)
    assert (len(blocked[0].xy), blocked[1].tolist()) == (8, [])


def test_walls_of_houses_that_stand_alone_are_noded_as_all_others(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(4)
    houses = []
    for k in range(300):
        turn = np.sort(rng.uniform(0, 2 * np.pi, rng.integers(3, 9)))
        ring = rng.uniform(3, 40, (len(turn), 1)) * np.column_stack((np.cos(turn), np.sin(turn)))
        house = Polygon(np.rint(ring * 2) / 2 if k % 2 else ring)  # halves, and walls closer than a noder looks
        courtyard = Polygon(ring * 0.4)
        houses.append(house.difference(courtyard) if house.is_valid and courtyard.is_valid else box(0, 0, k, 9))
    polygons = np.array([house for house in houses if isinstance(house, Polygon)], dtype=object)
    cluster = rng.integers(0, len(polygons), len(polygons))
    found = node_walls(polygons, cluster)
    monkeypatch.setattr(
        pipeline.simplification.graph, "round_corners", lambda walls, grid: (walls, np.zeros(len(walls), np.bool_))
    )
    expected = node_walls(polygons, cluster)
    for name in ("xy", "cluster", "edges", "slack"):
        assert getattr(found, name).tolist() == getattr(expected, name).tolist()


def test_cells_that_meet_in_a_corner_get_a_third_one() -> None:
    pair = np.array([box(0, 0, 1000, 1000), box(1000, 1000, 2000, 2000)])
    places = Territories(pair, np.array([0, 1]), np.zeros(2, np.int64))
    _, faces, label = draw_cells(places, 0, 1000.0)
    assert sorted(zip(label.tolist(), shapely.area(faces.polygons).tolist(), strict=True)) == [(0, 2e6), (1, 1e6)]


def test_crossings_are_noded_on_the_grid_but_in_spared_clusters() -> None:
    square = np.array([[0, 0], [1000, 1001], [0, 1000], [1000, 0.0]])
    edges = np.array([[0, 1], [2, 3], [0, 2], [1, 3]])
    graph = make_graph(
        np.concatenate((square, square)), np.repeat([0, 1], 4), np.concatenate((edges, edges + 4)), np.zeros(8)
    )
    noded, where = node_crossings(graph, np.array([1]))
    assert where.tolist() == [0]
    assert (len(noded.xy), len(noded.edges)) == (9, 10)
    assert [500.0, 500.0] in noded.xy.tolist()


def test_faces_know_their_walls() -> None:
    houses = shapely.transform(np.array([box(0, 0, 4, 4), box(4, 0, 8, 4)]), lambda xy: xy * 1000)
    graph = node_walls(houses, np.zeros(2, np.int64))
    faces = trace_faces(graph)
    shared = (faces.sides >= 0).all(axis=1)
    assert graph.xy[graph.edges[shared]].tolist() == [[[4000, 0], [4000, 4000]]]
    # Seen upwards, the house on the left is that with smaller x.
    left, right = faces.sides[shared][0]
    assert faces.polygons[left].centroid.x < faces.polygons[right].centroid.x


def test_no_houses_make_no_city() -> None:
    city = simplify()
    assert (len(city.polygons), city.lost, city.method) == (0, (), ())
    assert set(city.counts.values()) == {0}
    found = measure_simplification(np.zeros(0, object), city.polygons, city.house)
    assert (found.area_error, found.n_walls, found.min_clearance, found.sharpest) == (0.0, 0, FARTHEST, 180.0)


def test_a_house_thinner_than_the_clearance_is_lost() -> None:
    city = simplify(box(0, 0, 20, 0.3), box(9, 9, 19, 19))
    assert (city.lost, city.house.tolist()) == ((0,), [1])


@pytest.mark.parametrize(
    "broken", [Polygon(), None, shapely.LineString([(0, 0), (1, 1)]), Polygon([(0, 0), (4, 4), (4, 0), (0, 4)])]
)
def test_polygons_that_are_none_are_refused(broken: shapely.Geometry) -> None:
    with pytest.raises(GeometryError, match=r"footprint 1 .*clean them first"):
        simplify(box(0, 0, 4, 4), broken)


@pytest.mark.parametrize(
    "wrong",
    [{"clearance": 0.0}, {"clearance": 0.09}, {"min_area": -1.0}, {"min_courtyard_area": float("nan")}],
)
def test_wrong_arguments_are_refused(wrong: dict[str, float]) -> None:
    right = {"clearance": EPS, "min_area": 5.0, "min_courtyard_area": 5.0}
    with pytest.raises(ValueError, match=r"want 0\.1 <= clearance"):
        shape_planar(np.array([box(0, 0, 4, 4)]), np.zeros(1, np.int64), **(right | wrong))  # type: ignore[arg-type]


def test_measures_are_those_of_the_areas() -> None:
    pair = np.array([box(0, 0, 4, 4), box(9, 0, 13, 4)])
    city = simplify(*pair)
    moved = np.array([box(0, 0, 4, 5), box(8, 0, 13, 4), box(50, 0, 53, 1)])
    found = measure_simplification(moved, city.polygons, city.house)
    assert found.house_error.tolist() == [4.0, 4.0, 3.0]
    assert found.area_error == 11 / 43
    assert (found.lost, found.n_walls, found.min_clearance, found.sharpest) == ((2,), 8, 4.0, 90.0)


@st.composite
def streets(draw: st.DrawFn) -> list[Polygon]:
    """Boxes on a grid of 10 cm, many of them close, touching or overlapping, some with a slanted side."""
    n = draw(st.integers(1, 9))
    tenth = st.integers(0, 120)
    houses = []
    for _ in range(n):
        x, y, w, d, slant = draw(
            st.tuples(tenth, tenth, st.integers(8, 90), st.integers(8, 90), st.integers(-6, 6))
        )
        corners: NDArray[np.float64] = np.array([(x, y), (x + w, y), (x + w + slant, y + d), (x, y + d)]) / 10
        houses.append(Polygon(corners))
    return houses


@settings(max_examples=examples(60), deadline=None)
@given(streets(), st.sampled_from([0.3, 0.5, 1.0]), st.booleans(), st.randoms(use_true_random=False))
def test_promises_hold_for_any_street_in_any_order(
    houses: list[Polygon], clearance: float, manifold: bool, shuffler: object
) -> None:
    city, clusters = shape_joined(np.array(houses, dtype=object), clearance=clearance, manifold=manifold)
    assert_promises(city, clearance)
    found = measure_simplification(np.array(houses), city.polygons, city.house)
    assert found.corner_touches == city.counts["corner-touches"]
    assert found.corner_touches == 0 or not manifold
    assert found.lost == city.lost
    again = list(houses)
    shuffler.shuffle(again)  # type: ignore[attr-defined]
    assert blobs(simplify(*again, clearance=clearance, manifold=manifold)) == blobs(city)
    alone = []
    for name in np.unique(clusters):
        members = [house for house, cluster in zip(houses, clusters, strict=True) if cluster == name]
        alone += blobs(simplify(*members, clearance=clearance, manifold=manifold))
    assert sorted(alone) == sorted(blobs(city))
