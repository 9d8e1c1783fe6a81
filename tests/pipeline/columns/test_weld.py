"""Tests of roofs that are joined or parted at a vertex (step 3.4, ours)."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.columns.weld import least_steps, weld_heights
from pipeline.data.roofs import Weld
from tests.helpers.campaigns import examples

NONE = -np.inf


def weld_one(
    heights: list[float], *, ground: float = NONE, step: float = 2.0, gap: float = 1.0, given: bool = False
) -> tuple[list[float], list[int]]:
    """Nodes of one column, and the node of each roof."""
    on_ground = ground != NONE
    wanted = np.array([ground, *heights] if on_ground else heights)
    start, is_ground = np.array([0, len(wanted)]), np.zeros(len(wanted), np.bool_)
    is_ground[:1] = on_ground
    one = np.ones(1)
    node_start, z, of = weld_heights(start, is_ground, wanted, np.array([given]), step * one, gap * one, 2.0)
    assert node_start.tolist() == [0, len(z)]
    return z.tolist(), of.tolist()


@pytest.mark.parametrize(
    ("heights", "nodes", "of"),
    [
        ([5.0, 9.0], [5.0, 9.0], [0, 1]),  # far apart: exact
        ([9.0, 5.0], [5.0, 9.0], [1, 0]),
        ([5.0, 5.0], [5.0], [0, 0]),  # equal: one
        ([5.0, 5.9], [5.45], [0, 0]),  # closer than half a step: joined at the mean
        ([5.0, 6.5], [4.75, 6.75], [0, 1]),  # closer than a step: parted to it, both by the same way
        ([5.0, 5.2, 5.4], [5.2], [0, 0, 0]),
        ([5.0, 5.9, 7.4], [5.425, 7.425], [0, 0, 1]),  # joined first, then parted
    ],
)
def test_roofs_at_a_vertex(heights: list[float], nodes: list[float], of: list[int]) -> None:
    z, found = weld_one(heights)
    assert z == pytest.approx(nodes)
    assert found == of


def test_the_lowest_roof_keeps_the_clearance_above_the_ground() -> None:
    assert weld_one([6.0], ground=1.0)[0] == [1.0, 6.0]
    assert weld_one([1.5], ground=1.0)[0] == [1.0, 3.0]
    # The next one is raised with it where it would come too close.
    assert weld_one([1.5, 4.0], ground=1.0) == ([1.0, 3.0, 5.0], [0, 1, 2])


def test_given_columns_and_no_step_change_nothing_but_equal_heights() -> None:
    assert weld_one([5.0, 5.1, 5.1], given=True) == ([5.0, 5.1], [0, 1, 1])
    assert weld_one([5.0, 5.5], step=0.0, gap=0.1) == ([5.0, 5.5], [0, 1])
    assert weld_one([], ground=1.0) == ([1.0], [0])


def test_steps_follow_the_spacing_within_limits() -> None:
    assert least_steps(Weld(), np.array([0.5, 2.0, 8.0])).tolist() == [1.0, pytest.approx(1.4), 2.5]
    assert least_steps(None, np.array([0.5, 2.0])).tolist() == [0.0, 0.0]


@settings(max_examples=examples(200), deadline=None)
@given(st.lists(st.floats(0, 30), min_size=1, max_size=7), st.floats(0.5, 3.0))
def test_nodes_keep_the_step_and_the_order_and_move_roofs_little(heights: list[float], step: float) -> None:
    z, of = weld_one(heights, step=step, gap=0.1)
    assert (np.diff(z) >= step * (1 - 1e-6)).all()
    order = np.argsort(heights, kind="stable")
    assert (np.diff(np.array(of)[order]) >= 0).all()
    # A roof never leaves the heights that meet by more than half a step for each other roof.
    room = 0.5 * step * (len(heights) - 1) + 1e-9
    assert min(heights) - room <= z[0]
    assert z[-1] <= max(heights) + room
    shuffled, _ = weld_one(heights[::-1], step=step, gap=0.1)
    assert shuffled == pytest.approx(z)
