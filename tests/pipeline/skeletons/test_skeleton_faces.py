"""Checks of the faces of a skeleton: each finds what it is there for."""

import pytest

from pipeline.data.errors import GeometryError
from pipeline.skeletons.skeleton_faces import check_faces, drop_repeated, face_area, follow_faces, is_monotone
from pipeline.skeletons.wavefront import Point, Wavefront

RECTANGLE = [(0.0, 0.0), (6.0, 0.0), (6.0, 4.0), (0.0, 4.0)]


@pytest.fixture
def front() -> Wavefront:
    """The wavefront of a rectangle at its end: nodes 0 to 3 at its corners, two at (2, 2) and (4, 2)."""
    front = Wavefront([RECTANGLE], [1.0] * 4)
    front.run()
    return front


def test_faces_follow_the_wavefront(front: Wavefront) -> None:
    faces = follow_faces(front)
    places = [[front.node_xy[node] for node in face] for face in faces]
    assert places[0] == [(0, 0), (6, 0), (4, 2), (2, 2)]
    assert places[1] == [(6, 0), (6, 4), (4, 2)]
    check_faces(front, faces, 24.0, 0.0)


def test_a_face_that_is_absent_is_found(front: Wavefront) -> None:
    with pytest.raises(GeometryError, match="3 faces for 4 edges"):
        check_faces(front, follow_faces(front)[:3], 24.0, 0.0)


def test_a_face_without_area_is_found(front: Wavefront) -> None:
    faces = follow_faces(front)
    with pytest.raises(GeometryError, match=r"edge from \(0.000, 0.000\) to \(6.000, 0.000\) has no area"):
        check_faces(front, [faces[0][:2], *faces[1:]], 24.0, 0.0)
    with pytest.raises(GeometryError, match="has no area"):
        check_faces(front, [faces[0][::-1], *faces[1:]], 24.0, 0.0)


def test_a_node_off_its_plane_is_found(front: Wavefront) -> None:
    faces = follow_faces(front)
    front.node_time[faces[0][2]] += 0.01
    with pytest.raises(GeometryError, match=r"a node 0\.01 m off its plane"):
        check_faces(front, faces, 24.0, 0.0)
    check_faces(front, faces, 24.0, 0.02)


def test_a_side_that_crosses_another_is_found() -> None:
    """With unequal speeds a face need not be monotone, but simple."""
    front = Wavefront([RECTANGLE], [1.0, 1.0, 2.0, 1.0])
    front.run()
    faces = follow_faces(front)
    a, b, c, d = faces[0]
    with pytest.raises(GeometryError, match=r"has no area|crosses itself"):
        check_faces(front, [[a, b, d, c], *faces[1:]], 24.0, 0.0)


def test_areas_that_do_not_sum_are_found(front: Wavefront) -> None:
    with pytest.raises(GeometryError, match=r"faces have 24 m² of 24.1 m²"):
        check_faces(front, follow_faces(front), 24.1, 0.0)


def test_a_wavefront_that_was_not_run_has_no_faces() -> None:
    with pytest.raises(GeometryError, match="does not close"):
        follow_faces(Wavefront([RECTANGLE], [1.0] * 4))


@pytest.mark.parametrize(
    ("xy", "expected"),
    [
        ([(0, 0), (4, 0), (3, 1), (1, 1)], True),
        ([(0, 0), (4, 0), (5, 1), (6, 3), (2, 5), (-2, 3), (-1, 1)], True),  # around both ends
        ([(0, 0), (4, 0), (3, 1), (3.5, 2), (1, 2)], False),
        ([(0, 0), (4, 0), (3, 1), (3.001, 2), (1, 2)], True),  # within the tolerance
    ],
)
def test_monotone_to_the_first_side(xy: list[Point], expected: bool) -> None:
    assert is_monotone(xy, 0.01) is expected


def test_area_is_positive_counter_clockwise() -> None:
    assert face_area(RECTANGLE) == 24
    assert face_area(RECTANGLE[::-1]) == -24


def test_repeated_nodes_are_dropped() -> None:
    assert drop_repeated([1, 1, 2, 2, 2, 3, 1]) == [1, 2, 3]
    assert drop_repeated([1, 1]) == [1]
