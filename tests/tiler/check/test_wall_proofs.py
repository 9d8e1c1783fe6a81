"""Tests of the proof that no wall is there twice."""

import numpy as np
from numpy.typing import NDArray

from tiler.check.wall_proofs import check_overlap, join_walls, measure_walls, no_walls

# A wall of 4 m over an edge of 3 m, as two facets that face one way.
WALL = np.array([[[0, 0, 0], [3, 0, 0], [3, 0, 4]], [[0, 0, 0], [3, 0, 4], [0, 0, 4]]], np.float64)


def turned(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    return corners[:, ::-1]


def test_a_wall_by_hand() -> None:
    walls = measure_walls(WALL)
    assert walls.ends.tolist() == [[[0.0, 0.0], [3.0, 0.0]]]
    assert sorted(walls.area[0].tolist()) == [0.0, 12.0]
    assert walls.top.tolist() == [4.0]
    found = check_overlap(walls)
    assert (found.faults, found.sums) == ((), {"edges": 1, "area": 12.0})
    other = measure_walls(turned(WALL))
    assert other.area.tolist() == walls.area[:, ::-1].tolist()


def test_facets_over_an_edge_from_both_sides_are_a_fault_that_names_place_and_area() -> None:
    walls = measure_walls(np.concatenate((WALL, turned(WALL[1:]))))
    (fault,) = check_overlap(walls).faults
    assert (fault.kind, fault.count, fault.places) == ("wall-twice", 1, ((1.5, 0.0, 4.0),))
    assert "6 m²" in fault.detail


def test_facets_of_two_pieces_over_a_seam_are_held_against_each_other() -> None:
    one, two = measure_walls(WALL), measure_walls(turned(WALL[:1]))
    assert check_overlap(one).faults == check_overlap(two).faults == ()
    (fault,) = check_overlap(join_walls(one, two)).faults
    assert "6 m²" in fault.detail
    # Two pieces that have a part of a wall each.
    parts = join_walls(measure_walls(WALL[:1]), measure_walls(WALL[1:]))
    assert check_overlap(parts).faults == ()
    assert parts.area.sum() == 12.0
    elsewhere = join_walls(one, measure_walls(WALL + np.array([10.0, 0.0, 0.0])))
    assert elsewhere.ends[:, 0, 0].tolist() == [0.0, 10.0]


def test_no_walls_and_facets_that_are_no_walls() -> None:
    roof = np.array([[[0, 0, 1], [3, 0, 1], [3, 3, 1]]], np.float64)
    for walls in (no_walls(), measure_walls(np.empty((0, 3, 3))), measure_walls(roof)):
        assert len(walls.ends) == 0
        assert check_overlap(walls).faults == ()
