"""Rows in order of cells, against numpy's sorting."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.helpers.campaigns import examples
from tiler.pointclouds.cells import order_by_cell


@settings(max_examples=examples(60), deadline=None)
@given(seed=st.integers(0, 10**6), n=st.integers(0, 60), size=st.sampled_from([0.3, 64.0]), wide=st.booleans())
def test_rows_are_ordered_as_by_numpy(seed: int, n: int, size: float, wide: bool) -> None:
    rng = np.random.default_rng(seed)
    xy = size * np.rint(rng.uniform(-4, 4, (n, 2)) * 4) / 4
    if wide and n:
        xy[0] = size * 2**20
    among = rng.random(n) < 0.7
    cell = np.floor(xy / size).astype(np.int64)
    expected = [k for k in np.lexsort((np.arange(n), cell[:, 0], cell[:, 1])).tolist() if among[k]]
    found = order_by_cell(xy, size, among=among)
    assert found.order.tolist() == expected
    assert np.repeat(found.cell, np.diff(found.start), axis=0).tolist() == cell[expected].tolist()
    assert (np.diff(found.start) > 0).all()
    assert found.start[-1] == len(expected)
    everything = order_by_cell(xy, size)
    assert everything.order[among[everything.order]].tolist() == expected
    assert len(everything.order) == n
