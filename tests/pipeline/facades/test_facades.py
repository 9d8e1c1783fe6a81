"""Façades by rules: the rewritten graph, what criteria keep, and assets that are closed at each share."""

from collections import Counter
from collections.abc import Sequence

import numpy as np
import pytest

from pipeline.architecture.surfaces import Surface
from pipeline.facades.assets import Made, build, count_steps, polygons
from pipeline.facades.criteria import Criteria
from pipeline.facades.facade import Frame, Obstacles, Product, execute, find_free, make_facade
from pipeline.facades.graph import ConditionalLod, Insert, InsertLod, make_graph
from pipeline.facades.rewrite import rewrite
from tiler.detail import RULES
from tiler.detail.rule_files import load_graph

WINDOW = {"op": "insert", "asset": "window", "width": 1, "height": 1}
ASSETS = (
    Insert("window", 1.2, 1.5, columns=2, rows=2),
    Insert("door", 1.1, 2.2, rows=3),
    Insert("balcony", 2.8, 2.4, columns=3),
)


def has_pairs(rings: Sequence[Sequence[tuple[float, float, float]]]) -> bool:
    """Whether each edge is there as often in one direction as in the other."""
    edges = Counter((ring[k - 1], ring[k]) for ring in rings for k in range(len(ring)))
    return bool(edges) and all(n == 1 == edges[b, a] for (a, b), n in edges.items())


def rings_of(surfaces: Sequence[Surface]) -> list[list[tuple[float, float, float]]]:
    return [ring for one in surfaces for ring in (one.border, *one.holes)]


@pytest.mark.parametrize("insert", ASSETS, ids=lambda insert: insert.asset)
def test_an_asset_is_closed_and_has_at_most_its_share_of_polygons(insert: Insert) -> None:
    full = polygons(insert)[-1]
    found = []
    for percent in range(101):
        made = Made()
        build(made, insert, (0.25, 0.5), percent)
        assert has_pairs([*made.wall.holes, *rings_of(made.surfaces)]), percent
        assert all(has_pairs(rings_of(parts)) for parts in made.installations), percent
        assert made.count() == polygons(insert)[count_steps(insert, percent) - 1]
        assert made.count() == 1 or 100 * made.count() <= percent * full
        found.append(made.count())
    assert (found[0], found[100], found) == (1, full, sorted(found))
    assert len(set(found)) == len(polygons(insert))


@pytest.mark.parametrize("rules", RULES)
def test_each_insert_becomes_a_pair_behind_what_led_to_it(rules: str) -> None:
    nodes = load_graph(rules).nodes
    pairs = [name for node in nodes.values() if isinstance(node, ConditionalLod) for name in node.to]
    inserts = [name for name, node in nodes.items() if isinstance(node, InsertLod)]
    assert sorted(pairs) == sorted(inserts)
    assert len(inserts) >= 2
    assert not any(isinstance(node, Insert) for node in nodes.values())


def test_inserts_with_the_same_predecessors_share_a_conditional_node() -> None:
    parts = [{"size": 2, "to": "a"}, {"size": 2, "to": "b"}, {"share": 1, "to": "c"}]
    nodes = {"row": {"op": "split", "axis": "u", "parts": parts}, **dict.fromkeys("abc", WINDOW)}
    graph = rewrite(make_graph({"front": "row", "other": "c", "nodes": nodes}))
    groups = {name: node.to for name, node in graph.nodes.items() if isinstance(node, ConditionalLod)}
    assert groups == {"ConditionalLoD-1": ("a", "b"), "ConditionalLoD-2": ("c",)}
    assert (graph.front, graph.other) == ("row", "ConditionalLoD-2:c")
    # A conditional node evaluates the middle of each product's own rectangle.
    seen = []

    def decide(middle: tuple[float, float], labels: frozenset[str]) -> tuple[int, ...]:
        seen.append((middle, *labels))
        return (100,)

    corners = [one.corner for one in execute(graph, "row", (10.0, 3.0), decide)]
    assert seen == [((1.0, 1.5), "window"), ((3.0, 1.5), "window"), ((7.0, 1.5), "window")]
    assert corners == [(0.5, 0.03), (2.5, 0.03), (6.5, 0.03)]


@pytest.mark.parametrize(
    ("nodes", "told"),
    [
        ({"a": {"op": "repeat", "axis": "u", "size": 2, "to": "b"}}, "nodes.a: leads to 'b', which is no node"),
        ({"a": WINDOW, "lost": WINDOW}, "nodes.lost: nothing leads to it"),
        (
            {
                "a": {"op": "repeat", "axis": "u", "size": 2, "to": "b"},
                "b": {"op": "repeat", "axis": "v", "size": 2, "to": "a"},
            },
            r"nodes: (a -> b -> a|b -> a -> b) is a circle",
        ),
    ],
)
def test_a_wrong_graph_is_refused_by_name(nodes: dict[str, dict[str, object]], told: str) -> None:
    with pytest.raises(ValueError, match=told):
        make_graph({"front": "a", "nodes": nodes})


def test_criteria_are_the_least_of_distance_and_orientation_and_semantics_keeps() -> None:
    seen = Criteria((0.0, -100.0, 0.0), 50.0, 150.0, 80.0, {"door": 30})
    front, back = (0.0, -1.0, 0.0), (0.0, 1.0, 0.0)
    assert seen.share((0.0, 0.0, 0.0), front, ["window"]) == 50
    assert seen.share((0.0, 0.0, 0.0), back, ["window"]) == 0
    assert seen.share((0.0, 0.0, 0.0), back, ["floor", "door"]) == 30
    slanted = (-np.sin(np.radians(60)), -np.cos(np.radians(60)), 0.0)  # half way from 40 to 80 degrees
    assert Criteria(seen.viewpoint, facing=80.0).share((0.0, 0.0, 0.0), slanted, []) == 50
    assert [Criteria(keep={"door": 7}).share(front, front, [label]) for label in ("door", "window")] == [7, 0]
    assert Criteria().share(front, front, []) == 100


def test_a_facade_of_flat_assets_is_one_polygon() -> None:
    both = [Product(ASSETS[0], (0.0, 0.0), (0, 50)), Product(ASSETS[1], (2.0, 0.0), (0, 0))]
    assert make_facade(both, 0) == Made()
    kinds = [one.kind for one in make_facade(both, 1).surfaces]
    assert kinds.count("Door") == 1
    assert kinds.count("WallSurface") >= 4


def test_an_asset_has_no_room_where_a_face_cuts_its_box() -> None:
    frame = Frame(np.zeros(3), np.array([1.0, 0.0, 0.0]), np.array([0.0, -1.0, 0.0]))
    products = [Product(Insert("door", 1.0, 2.0, depth=0.2), (u, 0.05), (100,)) for u in (0.5, 5.0)]
    wall = [[0, 0, 0], [9, 0, 0], [9, 0, 3], [0, 0, 3]]
    near = [[0, 0.1, 0], [2, 0.1, 0], [2, 0.1, 3], [0, 0.1, 3]]  # behind the first door alone
    roof = [[0, 0, 3], [9, 0, 3], [9, 4, 6], [0, 4, 6]]
    normal = np.array([[0, -1.0, 0], [0, -1.0, 0], [0, -0.6, 0.8]])
    borders = np.array([wall, near, roof], float)
    faces = Obstacles(borders.reshape(-1, 3), np.array([0, 4, 8]), normal, borders.mean(axis=1))
    assert find_free(products, frame, faces, 0) == [False, True]
