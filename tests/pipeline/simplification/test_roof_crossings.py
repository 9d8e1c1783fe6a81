"""Tests of nodes where the roofs on both sides of a wall change order (step 2.3, ours)."""

from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.data.roofs import Roofs
from pipeline.simplification.roof_crossings import add_crossings

WIDE = [-100.0, 100.0]


def roofs_of(*rows: tuple[float, float, float], limits: list[list[float]] | None = None) -> Roofs:
    plane = np.array(rows)
    return Roofs(plane, np.zeros((len(rows), 2)), np.array(limits or [WIDE] * len(rows)))


def pair() -> NDArray[Any]:
    """Two houses with a wall of 20 m in common, along x = 10."""
    return np.array([shapely.box(0, 0, 10, 20), shapely.box(10, 0, 20, 20)])


def nodes_of(polygon: shapely.Polygon) -> set[tuple[float, float]]:
    return {tuple(place) for place in shapely.get_coordinates(polygon).tolist()}


def test_a_level_and_a_rising_roof_cross_once() -> None:
    roofs = roofs_of((0, 0, 10), (0, 0.5, 5))  # equal at y = 10
    found, n, short = add_crossings(pair(), roofs, clearance=np.ones(2))
    assert (n, short) == (1, 0)
    for before, after in zip(pair(), found, strict=True):
        assert nodes_of(after) - nodes_of(before) == {(10.0, 10.0)}
        assert shapely.equals(before, after)
        assert after.is_valid


def test_roofs_that_keep_their_order_or_begin_together_need_no_node() -> None:
    for roofs in (
        roofs_of((0, 0, 20), (0, 0.5, 5)),
        roofs_of((0, 0, 10), (0, 0, 12)),  # flat ones
        roofs_of((0, 0, 10), (0, 0.5, 9.8)),  # closer than half a metre at one end: joined there
    ):
        found, n, short = add_crossings(pair(), roofs, clearance=np.ones(2))
        assert (n, short) == (0, 0)
        assert found.tolist() == pair().tolist()


def test_a_crossing_too_close_to_an_end_or_to_another_wall_is_counted() -> None:
    roofs = roofs_of((0, 0, 10), (0, 2.0, 8.6))  # equal at y = 0.7
    found, n, short = add_crossings(pair(), roofs, clearance=np.ones(2))
    assert (n, short) == (0, 1)
    assert found.tolist() == pair().tolist()
    close = np.append(pair(), shapely.Polygon([(10.5, 10), (20, 25), (10.5, 25)]))
    roofs = roofs_of((0, 0, 10), (0, 0.5, 5), (0, 0, 3))
    assert add_crossings(close[[0, 1, 2]], roofs, clearance=np.ones(3))[1:] == (0, 1)


def test_limits_bend_a_roof() -> None:
    # A roof that rises from 0 to 20 m, kept between 8 and 12 m, and one that falls from 11 to 9 m.
    roofs = roofs_of((0, 1.0, 0), (0, -0.1, 11), limits=[[8.0, 12.0], WIDE])
    found, n, _ = add_crossings(pair(), roofs, clearance=np.ones(2))
    assert n == 1
    (node,) = nodes_of(found[0]) - nodes_of(pair()[0])
    assert node == (10.0, 10.0)
    # One that falls meets the other where it is kept at 7 m, not where the planes meet, at y = 7.8.
    roofs = roofs_of((0, -2.0, 22), (0, 0.3, 4.0), limits=[[7.0, 16.0], WIDE])
    found, n, _ = add_crossings(pair(), roofs, clearance=np.ones(2))
    assert n == 1
    assert nodes_of(found[0]) - nodes_of(pair()[0]) == {(10.0, 10.0)}


def test_nothing_to_do() -> None:
    none = np.empty(0, object)
    found, n, short = add_crossings(none, roofs_of((0, 0, 1)), clearance=np.ones(2))
    assert (len(found), n, short) == (0, 0, 0)
