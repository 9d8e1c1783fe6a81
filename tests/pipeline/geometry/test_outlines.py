"""Outlines: rings, their corners, and the points of pieces."""

import numpy as np
import pytest
import shapely

from pipeline.geometry.outlines import open_outline, points_by_piece

COURT = shapely.Polygon(shapely.box(0, 0, 9, 9).exterior, [shapely.box(3, 3, 6, 6).exterior])


def test_corners_of_neighbours_become_vertices_in_order() -> None:
    corners = np.array([[7, 0.0], [2, 1e-9], [3, 4.0], [5, 5.0], [9, 9.0], [20, 0.0]])
    outline = open_outline(COURT)
    shared = outline.with_corners(corners).polygon
    assert shapely.get_num_coordinates(shared) == shapely.get_num_coordinates(COURT) + 3
    assert shapely.equals(shapely.set_precision(shared, 1e-6), COURT)
    assert {(7, 0), (2, 1e-9), (3, 4)} < set(map(tuple, shapely.get_coordinates(shared).tolist()))
    assert outline.with_corners(corners[3:]) is outline
    assert outline.polygon is COURT


def test_rings_that_touch_stay_apart() -> None:
    # The hole begins and ends where the shell does.
    hole = [(0, 0), (1, 2), (2, 1), (0, 0)]
    pinched = shapely.Polygon([(0, 0), (9, 0), (9, 9), (0, 9)], [hole])
    shared = open_outline(pinched).with_corners(np.array([[4.0, 0.0]])).polygon
    assert len(shared.interiors) == 1
    assert shared.area == pinched.area


def test_area_is_that_of_the_shell_without_the_holes() -> None:
    rng = np.random.default_rng(2)
    for _ in range(20):
        polygon = shapely.affinity.translate(
            shapely.affinity.rotate(COURT, rng.uniform(0, 360)), 674_000, 6_580_000
        )
        assert open_outline(polygon).area == pytest.approx(72, abs=1e-7)
    assert open_outline(shapely.box(0, 0, 4, 5)).area == 20


def test_edges_without_length_are_none() -> None:
    a, b = open_outline(shapely.Polygon([(0, 0), (4, 0), (4, 0), (4, 3)])).ends
    assert a.tolist() == [[0, 0], [4, 0], [4, 3]]
    assert b.tolist() == [[4, 0], [4, 3], [0, 0]]
    assert len(open_outline(COURT).ends[0]) == 8
    assert [open_outline(COURT).n_rings, open_outline(shapely.box(0, 0, 1, 1)).n_rings] == [2, 1]


def test_points_are_dealt_out_to_the_piece_that_has_them() -> None:
    rng = np.random.default_rng(3)
    xyz = rng.uniform(-1, 10, (300, 3))
    xyz[::7, 0] = 3.0  # on a side of the court, where no piece has them
    pieces = np.array([COURT, shapely.box(3, 3, 6, 6)])
    for (outline, found), piece in zip(points_by_piece(pieces, xyz), pieces, strict=True):
        assert outline.polygon is piece
        assert outline.area == piece.area
        assert found.tolist() == xyz[shapely.contains_xy(piece, *xyz[:, :2].T)].tolist()
        assert len(found) > 5
        assert outline.n_rings == 1 + len(piece.interiors)
        shared = outline.with_corners(np.array([[4.0, 3.0]])).polygon
        assert shapely.get_num_coordinates(shared) == shapely.get_num_coordinates(piece) + 1
        assert shapely.equals(shared, piece)
    ((whole, none),) = points_by_piece(pieces[:1], xyz[:0])
    assert (whole.n_rings, none.shape) == (2, (0, 3))
