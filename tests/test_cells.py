"""Rows in order of cells, against numpy's sorting."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from tiler.pointclouds.cells import MOST_CELLS, find_places, order_by_cell


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 10**6), n=st.integers(0, 60), size=st.sampled_from([0.3, 64.0]), wide=st.booleans())
def test_rows_are_ordered_as_by_numpy(seed: int, n: int, size: float, wide: bool) -> None:
    rng = np.random.default_rng(seed)
    xy = size * np.rint(rng.uniform(-4, 4, (n, 2)) * 4) / 4
    if wide and n:
        xy[0] = size * MOST_CELLS
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


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 10**6), n=st.integers(0, 60), wide=st.booleans())
def test_places_of_units_are_those_in_the_order_of_coordinates(seed: int, n: int, wide: bool) -> None:
    rng = np.random.default_rng(seed)
    units = rng.integers(-20_000, 20_000, (n, 2)).astype(np.int32)
    if wide and n:
        units[0] = 2**31 - 1
    among = rng.random(n) < 0.7
    scale, offset = (0.01, 0.02), (318_000.0, -64.0)
    place, cell, start = find_places(units[:, 0], units[:, 1], scale, offset, among, 64.0 if n % 2 else 3.0)
    found = order_by_cell(np.asarray(units * scale + offset, np.float64), 64.0 if n % 2 else 3.0, among=among)
    assert place[found.order].tolist() == list(range(len(found.order)))
    assert (place[~among] == -1).all()
    assert cell.tolist() == found.cell.tolist()
    assert start.tolist() == found.start.tolist()
