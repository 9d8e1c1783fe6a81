"""Shortest paths, against scipy's, and where paths are equally short or there is none."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from stitch.tiling.shortest import find_shortest
from tests.helpers.campaigns import examples


def all_usable(n: int) -> NDArray[np.bool_]:
    return np.ones(n, np.bool_)


@settings(max_examples=examples(60), deadline=None)
@given(st.integers(2, 60), st.integers(0, 2**32 - 1))
def test_paths_are_as_short_as_those_of_scipy(n: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    edges = np.unique(np.sort(rng.integers(0, n, (2 * n, 2)), axis=1), axis=0)
    edges = edges[edges[:, 0] != edges[:, 1]]
    cost, usable = rng.integers(1, 5, len(edges)) / 2, rng.random(n) < 0.9
    start, end = rng.choice(n, 2, replace=False)
    usable[[start, end]] = True
    path = find_shortest(edges, cost, usable, int(start), int(end))
    kept = usable[edges].all(axis=1)
    graph = csr_array((cost[kept], (edges[kept, 0], edges[kept, 1])), shape=(n, n))
    expected = dijkstra(graph, directed=False, indices=[int(start)])[0, end]
    if not len(path):
        assert np.isinf(expected)
        return
    costs = {frozenset(edge): c for edge, c in zip(edges.tolist(), cost.tolist(), strict=True)}
    assert (path[0], path[-1]) == (start, end)
    assert usable[path].all()
    assert (
        sum(costs[frozenset(step)] for step in zip(path[:-1].tolist(), path[1:].tolist(), strict=True)) == expected
    )


@pytest.mark.parametrize(("numbers", "middle"), [((0, 1, 2, 3), 1), ((0, 2, 1, 3), 1)])
def test_of_equally_short_paths_it_is_that_of_the_lower_numbers(numbers: tuple[int, ...], middle: int) -> None:
    square = np.array([[0, 1], [1, 3], [0, 2], [2, 3]])
    edges = np.array(numbers)[square]
    assert find_shortest(edges, np.ones(4), all_usable(4), 0, 3).tolist() == [0, middle, 3]


def test_no_path_leads_through_what_is_not_usable_or_where_no_edge_is() -> None:
    edges = np.array([[0, 1], [1, 2]])
    usable = np.array([True, False, True])
    assert find_shortest(edges, np.ones(2), all_usable(3), 0, 2).tolist() == [0, 1, 2]
    assert find_shortest(edges, np.ones(2), usable, 0, 2).size == 0
    assert find_shortest(edges[:1], np.ones(1), all_usable(3), 0, 2).size == 0
