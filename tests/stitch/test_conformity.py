"""Conformity: faces, edges and volumes against hand-worked cases and a brute-force count."""

from collections import Counter

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from stitch.pieces.conformity import (
    compute_cell_volumes,
    compute_facet_areas,
    find_duplicate_points,
    find_unused_points,
    group_rows,
    match_facets,
    pair_cell_faces,
    pair_edges,
    pair_faces,
)
from tests.helpers.campaigns import examples
from tests.helpers.meshes import make_city

# The corner of a cube: volume 1/6, its faces outwards.
CORNER = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
ONE = np.array([[0, 1, 2, 3]], np.int32)
SHELL = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int32)


def rows(*values: tuple[int, ...]) -> NDArray[np.int32]:
    return np.array(values, np.int32)


def outward_faces(cell: tuple[int, ...]) -> list[tuple[int, int, int]]:
    a, b, c, d = cell
    return [(a, c, b), (a, b, d), (a, d, c), (b, c, d)]


def turn(face: tuple[int, ...]) -> tuple[int, ...]:
    """Rotate a face until its smallest vertex is in front: one name for each oriented face."""
    k = face.index(min(face))
    return (*face[k:], *face[:k])


def names(facets: NDArray[np.int32]) -> list[tuple[int, ...]]:
    return sorted(turn(tuple(face)) for face in facets.tolist())


def test_one_cell_is_bounded_by_its_faces_outwards() -> None:
    pairs = pair_cell_faces(ONE, 4)
    assert names(pairs.exterior) == names(SHELL)
    area, volume = compute_facet_areas(CORNER, pairs.exterior)
    assert area.tolist() == pytest.approx([-0.5, 0, 0, 0.5])
    assert volume.sum() == pytest.approx(1 / 6)


def test_two_cells_meet_in_a_face() -> None:
    pairs = pair_cell_faces(rows((0, 1, 2, 3), (1, 2, 3, 4)), 5)
    assert (1, 2, 3) not in names(pairs.exterior)
    assert len(pairs.exterior) == 6
    assert len(pairs.same_side) == len(pairs.shared) == 0


def test_two_cells_on_one_side_are_found() -> None:
    pairs = pair_cell_faces(rows((0, 1, 2, 3), (4, 1, 2, 3)), 5)
    assert names(pairs.same_side) == [(1, 2, 3), (1, 2, 3)]
    assert len(pairs.exterior) == 6


def test_a_face_of_three_cells_is_found() -> None:
    pairs = pair_cell_faces(rows((0, 1, 2, 3), (1, 2, 3, 4), (5, 1, 2, 3)), 6)
    assert len(pairs.shared) == 3
    assert {tuple(sorted(face)) for face in pairs.shared.tolist()} == {(1, 2, 3)}
    assert len(pairs.exterior) == 9


def test_a_cell_twice_shows_in_all_its_faces() -> None:
    pairs = pair_cell_faces(rows((0, 1, 2, 3), (0, 1, 2, 3)), 4)
    assert len(pairs.same_side) == 8
    assert len(pairs.exterior) == 0


@settings(max_examples=examples(100), deadline=None)
@given(st.lists(st.lists(st.integers(0, 7), min_size=4, max_size=4, unique=True), min_size=0, max_size=12))
def test_faces_are_those_of_a_brute_force_count(cells: list[list[int]]) -> None:
    faces = [turn(face) for cell in cells for face in outward_faces(tuple(cell))]
    count = Counter(tuple(sorted(face)) for face in faces)
    oriented = Counter(faces)
    exterior = sorted(face for face in faces if count[tuple(sorted(face))] == 1)
    shared = sorted(face for face in faces if count[tuple(sorted(face))] > 2)
    same_side = sorted(face for face in faces if count[tuple(sorted(face))] == 2 and oriented[face] == 2)
    array = np.array(cells, np.int32).reshape(-1, 4)

    for pairs in (pair_cell_faces(array, 8), pair_faces(np.array(faces, np.int32).reshape(-1, 3))):
        assert names(pairs.exterior) == exterior
        assert names(pairs.shared) == shared
        assert names(pairs.same_side) == same_side


def test_faces_of_pieces_are_those_of_the_whole() -> None:
    city = make_city()
    half = len(city.mesh.cells) // 2
    n = len(city.mesh.points)
    pieces = [pair_cell_faces(cells, n).exterior for cells in np.split(city.mesh.cells, [half])]

    joined = pair_faces(np.concatenate(pieces))

    assert names(joined.exterior) == names(pair_cell_faces(city.mesh.cells, n).exterior)
    assert names(joined.exterior) == names(city.boundary.facets)
    assert len(joined.shared) == len(joined.same_side) == 0


def test_vertex_numbers_up_to_the_last_int32() -> None:
    """Face keys hold two vertices and a bit: the largest numbers must not run into each other."""
    high = 2**31 - 1
    facets = rows((high, high - 1, 0), (0, high - 1, high), (high - 2, high - 1, 0))
    assert names(pair_faces(facets).exterior) == names(facets[2:])
    assert pair_edges(facets).open.tolist() == [[0, high - 2], [0, high - 1], [high - 2, high - 1]]


def test_a_closed_surface_has_no_open_edge() -> None:
    edges = pair_edges(SHELL)
    assert len(edges.open) == len(edges.non_manifold) == 0


def test_a_hole_and_a_flipped_facet_open_their_edges() -> None:
    assert pair_edges(SHELL[:3]).open.tolist() == [[1, 2], [1, 3], [2, 3]]
    flipped = np.concatenate([SHELL[:3], SHELL[3:, ::-1]])
    assert pair_edges(flipped).open.tolist() == [[1, 2], [1, 3], [2, 3]]


def test_two_bodies_on_one_edge_are_closed_but_not_manifold() -> None:
    other = np.array([0, 1, 4, 5], np.int32)[SHELL]
    edges = pair_edges(np.concatenate([SHELL, other]))
    assert len(edges.open) == 0
    assert edges.non_manifold.tolist() == [[0, 1]]


def test_an_open_edge_of_three_facets_is_open_alone() -> None:
    edges = pair_edges(np.concatenate([SHELL, rows((0, 1, 4))]))
    assert [0, 1] in edges.open.tolist()
    assert len(edges.non_manifold) == 0


def test_the_same_facets_in_another_order_and_rotation_match() -> None:
    match = match_facets(SHELL, np.roll(SHELL[::-1], 1, axis=1))
    assert [len(part) for part in (match.missing, match.extra, match.flipped, match.duplicate)] == [0] * 4


def test_each_way_of_not_matching_is_told_apart() -> None:
    found = np.concatenate([SHELL[:2], SHELL[3:, ::-1], SHELL[:1], rows((7, 8, 9))])
    match = match_facets(SHELL, found)
    assert match.missing.tolist() == [2]
    assert match.extra.tolist() == [4]
    assert match.flipped.tolist() == [2]
    assert match.duplicate.tolist() == [3]


def test_matching_against_nothing() -> None:
    nothing = np.empty((0, 3), np.int32)
    assert match_facets(nothing, SHELL).extra.tolist() == [0, 1, 2, 3]
    assert match_facets(SHELL, nothing).missing.tolist() == [0, 1, 2, 3]
    assert len(pair_edges(nothing).open) == 0
    assert pair_cell_faces(np.empty((0, 4), np.int32), 0).exterior.shape == (0, 3)


def test_volumes_have_the_sign_of_the_orientation() -> None:
    cells = rows((0, 1, 2, 3), (0, 2, 1, 3))
    volume, flat = compute_cell_volumes(CORNER, cells)
    assert volume.tolist() == pytest.approx([1 / 6, -1 / 6])
    assert not flat.any()


def test_flat_is_relative_to_the_longest_edge() -> None:
    lifted = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [1, 1, 1e-13], [1, 1, 1e-9]])
    tiny = 1e-4 * CORNER
    points = np.concatenate([lifted, tiny, [[np.nan, 0, 0]]])
    cells = rows((0, 1, 2, 3), (0, 1, 2, 4), (0, 1, 2, 5), (6, 7, 8, 9), (0, 1, 2, 10))
    assert compute_cell_volumes(points, cells)[1].tolist() == [True, True, False, False, True]


@pytest.mark.parametrize("scale", [1e-12, 1e-4, 1.0, 1e4])
def test_flat_does_not_depend_on_the_unit(scale: float) -> None:
    points = scale * np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 1e-10], [1, 1, 1e-12]])
    assert compute_cell_volumes(points, rows((0, 1, 2, 3), (0, 1, 2, 4)))[1].tolist() == [False, True]


def test_volumes_far_from_the_origin() -> None:
    """Differences come first: at national coordinates 1e-9 of the volume is kept."""
    far = CORNER * 8 + np.array([121000.0, 487000.0, 0.0])
    assert compute_cell_volumes(far, ONE)[0][0] == pytest.approx(512 / 6, rel=1e-12)
    _, volume = compute_facet_areas(far, SHELL)
    assert volume.sum() == pytest.approx(512 / 6, rel=1e-12)


def test_rows_are_grouped_by_value() -> None:
    group, n_groups = group_rows(np.array([[0.0, 1], [-0.0, 1], [np.nextafter(0, 1), 1]]))
    assert (group.tolist(), n_groups) == ([0, 0, 1], 2)
    assert group_rows(np.empty((0, 3)))[1] == 0


def test_duplicate_and_unused_points() -> None:
    points = np.concatenate([CORNER, CORNER[[2, 0]], CORNER[:1] + 1e-300])
    assert find_duplicate_points(points).tolist() == [4, 5]
    assert find_unused_points(ONE, 6).tolist() == [4, 5]
    assert find_duplicate_points(np.empty((0, 3))).tolist() == []
