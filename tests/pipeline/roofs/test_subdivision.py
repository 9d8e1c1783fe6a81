"""Cuts of a net of half-edges: neighbours share vertices, courtyards stay, straight vertices go."""

from typing import Any

import numba
import numpy as np
import pytest
import shapely
from numpy.typing import NDArray
from shapely import affinity

from pipeline.roofs.subdivision import FACES, HALVES, cut_face, open_subdivision, outline_regions

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Net = tuple[Index, Array, Index]


@numba.njit  # type: ignore[untyped-decorator]
def _open(xy: Array, ring: Index) -> Any:
    return open_subdivision(xy, ring, 100)


@numba.njit  # type: ignore[untyped-decorator]
def _outline(half: Index, place: Array, count: Index, region: Index, n_given: int) -> Any:
    return outline_regions(half, place, count, region, n_given)


def open_net(polygon: shapely.Polygon) -> Net:
    rings = shapely.get_rings(polygon)
    xy, ring = shapely.get_coordinates(rings, return_index=True)
    net: Net = _open(xy, ring)
    return net


def outline(net: Net, polygon: shapely.Polygon, region: list[int]) -> list[shapely.Polygon]:
    """Regions by their names."""
    n_given = len(shapely.get_coordinates(polygon)) - len(shapely.get_rings(polygon))
    xy, ring, owner, shell = _outline(*net, np.array(region), n_given)
    found = []
    for name in sorted(set(region)):
        rings = [xy[ring == k] for k in np.flatnonzero(owner == name)]
        outer = [bool(around) for around in shell[owner == name]]
        assert sum(outer) == 1
        found.append(
            shapely.Polygon(
                rings[outer.index(True)], [r for r, around in zip(rings, outer, strict=True) if not around]
            )
        )
    return found


@pytest.mark.parametrize("reverse", [False, True])
def test_a_square_is_cut_in_two_and_the_second_cut_ends_on_the_first(reverse: bool) -> None:
    square = shapely.box(0, 0, 10, 10)
    net = open_net(square.reverse() if reverse else square)
    assert cut_face(*net, 0, (0.0, 1.0, -4.0), 1.0)  # x = 4
    assert net[2][FACES] == 2
    pieces = outline(net, square, [0, 1])
    right = int(np.argmax([piece.area for piece in pieces]))
    assert sorted(piece.area for piece in pieces) == [40, 60]
    assert cut_face(*net, right, (1.0, 0.0, 7.0), 1.0)  # y = 7, of the right half alone
    found = outline(net, square, [0, 1, 2])
    assert sorted(piece.area for piece in found) == [18, 40, 42]
    assert sum([4.0, 7.0] in shapely.get_coordinates(piece).tolist() for piece in found) == 3
    # Joined again, the vertex that only these two had goes.
    region = [0, 1, right]
    assert (
        sum([4.0, 7.0] in shapely.get_coordinates(piece).tolist() for piece in outline(net, square, region)) == 0
    )


def test_a_line_that_comes_too_close_to_a_corner_bends_through_it() -> None:
    square = shapely.box(0, 0, 10, 10)
    net = open_net(square)
    assert not cut_face(*net, 0, (0.0, 1.0, -0.5), 1.0)  # along a wall
    assert cut_face(*net, 0, (0.6, 0.8, 0.3), 1.0)  # 0.3 m from the corner (0, 0)
    assert [0.0, 0.0] in shapely.get_coordinates(outline(net, square, [0, 1])[1]).tolist()


def test_a_cut_through_a_courtyard_divides_the_house_around_it() -> None:
    house = shapely.Polygon(shapely.box(0, 0, 30, 30).exterior, [shapely.box(10, 10, 20, 20).exterior])
    net = open_net(house)
    assert cut_face(*net, 0, (1.0, 0.0, 15.0), 1.0)  # y = 15
    assert [piece.area for piece in outline(net, house, [0, 1])] == [400, 400]
    assert shapely.equals(outline(net, house, [0, 0])[0], house)


def test_a_courtyard_goes_with_the_piece_around_it() -> None:
    house = shapely.Polygon(shapely.box(0, 0, 40, 30).exterior, [shapely.box(5, 10, 15, 20).exterior])
    for x in (20.0, 30.0):
        net = open_net(house)
        assert cut_face(*net, 0, (0.0, 1.0, -x), 1.0)
        found = sorted(outline(net, house, [0, 1]), key=lambda piece: float(piece.centroid.x))
        assert [len(piece.interiors) for piece in found] == [1, 0]
        assert [piece.area for piece in found] == [30 * x - 100, 30 * (40 - x)]


def test_walls_around_courtyards_leave_valid_faces_that_cover_the_house() -> None:
    """A wall that ends at a courtyard and divides nothing would be crossed by later ones."""
    rng = np.random.default_rng(4)
    for _ in range(60):
        x, y = rng.uniform(4, 10, 2)
        yard = affinity.rotate(shapely.box(x, y, x + rng.uniform(2, 6), y + rng.uniform(2, 6)), rng.uniform(0, 90))
        house = shapely.Polygon(shapely.box(0, 0, 22, 20).exterior, [yard.exterior])
        net = open_net(house)
        for _ in range(14):
            angle, face = rng.choice([0.1, 0.9, 0.1 + np.pi / 2]), int(rng.integers(net[2][FACES]))
            line = (np.cos(angle), np.sin(angle), rng.uniform(-22, 22))
            n_faces, n_halves = net[2][FACES], net[2][HALVES]
            divided = cut_face(*net, face, line, 1.5)
            assert divided == (net[2][FACES] > n_faces)
            assert divided or net[2][HALVES] == n_halves
        pieces = outline(net, house, list(range(net[2][FACES])))
        assert all(piece.is_valid for piece in pieces)
        assert sum(piece.area for piece in pieces) == pytest.approx(house.area)
        assert shapely.union_all(pieces).area == pytest.approx(house.area)
