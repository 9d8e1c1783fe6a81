"""Connected components, against scipy's."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from pipeline.geometry.components import join_pairs
from tests.helpers.campaigns import examples


@settings(max_examples=examples(60), deadline=None)
@given(st.integers(1, 80), st.integers(0, 80), st.integers(0, 2**32 - 1))
def test_components_are_those_of_scipy_named_by_their_first(n: int, n_pairs: int, seed: int) -> None:
    pairs = np.random.default_rng(seed).integers(0, n, (n_pairs, 2))
    graph = coo_array((np.ones(n_pairs), (pairs[:, 0], pairs[:, 1])), shape=(n, n))
    _, number = connected_components(graph, directed=False)
    _, first, index = np.unique(number, return_index=True, return_inverse=True)
    assert (join_pairs(n, pairs) == first[index]).all()


def test_a_long_chain_is_one_component_from_either_end() -> None:
    n = 100_000
    chain = np.column_stack((np.arange(n - 1), np.arange(1, n)))
    assert not join_pairs(n, chain).any()
    assert not join_pairs(n, chain[::-1, ::-1]).any()


def test_without_pairs_each_thing_is_alone() -> None:
    assert join_pairs(3, np.zeros((0, 2), np.int64)).tolist() == [0, 1, 2]
