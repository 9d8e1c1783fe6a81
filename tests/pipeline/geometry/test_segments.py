"""Kernels of the division of houses against array expressions that say the same, to the bit."""

from collections.abc import Callable
from typing import Any

import numba
import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from pipeline.geometry import segments
from pipeline.geometry.segments import (
    BLUNT,
    ON_EDGE,
    add_places,
    distances_to_segments,
    divide_edges,
    insert_corners,
    place_walls,
)
from pipeline.roofs import lines
from pipeline.roofs.lines import MIN_GAIN, _sum_pairwise
from tests.helpers.campaigns import examples

Array = NDArray[np.float64]
SEEDS = st.integers(0, 10**6)


def in_kernel(kernel: Any) -> Callable[..., Any]:
    """A kernel as other kernels call it: see `test_no_kernel_is_for_kernels_and_gives_arrays_to_python`."""

    @numba.njit  # type: ignore[untyped-decorator]
    def call(*given: Any) -> Any:
        return kernel(*given)

    called: Callable[..., Any] = call
    return called


are_clear, find_nodes = in_kernel(segments.are_clear), in_kernel(segments.find_nodes)
heights_beside = in_kernel(segments.heights_beside)
best_lines, directions = in_kernel(lines._best_lines), in_kernel(lines.wall_directions)


def segments_away(xy: Array, a: Array, b: Array) -> Array:
    d = b - a
    to = xy[None] - a[:, None]
    t = np.clip((to * d[:, None]).sum(axis=2) / (d * d).sum(axis=1)[:, None], 0, 1)
    off = to - t[..., None] * d[:, None]
    return np.asarray(np.hypot(off[..., 0], off[..., 1]))


def away(p: Array, q: Array) -> Array:
    d = p[:, None] - q[None]
    return np.asarray(np.hypot(d[..., 0], d[..., 1]))


def blunt(start: Array, end: Array, a: Array, b: Array) -> NDArray[np.bool_]:
    along = (end - start) / np.hypot(*(end - start).T)[:, None]
    meets = segments_away(start, a, b).T <= ON_EDGE
    sharp = np.zeros(len(start), np.bool_)
    for other in (a, b):
        way = other[None] - start[:, None]
        length = np.hypot(way[..., 0], way[..., 1])
        sharp |= (meets & ((way * along[:, None]).sum(axis=2) > BLUNT * length) & (length > ON_EDGE)).any(axis=1)
    return ~sharp


def clear(start: Array, end: Array, a: Array, b: Array, clearance: float) -> list[bool]:
    length = np.hypot(*(end - start).T)
    wide = segments_away((start + end) / 2, a, b).min(axis=0) >= np.minimum(clearance, length / 4)
    needed = np.minimum(clearance, np.minimum(away(start, a), away(end, a)) / 2) - ON_EDGE
    far = (segments_away(a, start, end) >= needed).all(axis=1)
    ends = blunt(start, end, a, b) & blunt(end, start, a, b)
    found: list[bool] = ((length >= clearance) & wide & far & ends).tolist()
    return found


def outline(rng: np.random.Generator, n: int = 12) -> Array:
    """A closed ring with right angles here and there."""
    turn = np.sort(rng.uniform(0, 2 * np.pi, n))
    xy = rng.uniform(5, 12, (n, 1)) * np.column_stack((np.cos(turn), np.sin(turn)))
    xy[1::3, 0] = xy[::3, 0]
    return np.concatenate((xy, xy[:1]))


@settings(max_examples=examples(50), deadline=None)
@given(seed=SEEDS)
def test_distances_are_those_of_arrays(seed: int) -> None:
    rng = np.random.default_rng(seed)
    ring, xyz = outline(rng), rng.uniform(-12, 12, (40, 3))
    expected = segments_away(xyz[:, :2], ring[:-1], ring[1:])
    assert distances_to_segments(xyz[:, :2], ring[:-1], ring[1:]).tolist() == expected.tolist()
    beside = heights_beside(xyz, ring[2], ring[3], 6.0)
    assert beside.tolist() == xyz[expected[2] <= 6.0, 2].tolist()
    assert 0 < len(beside) < len(xyz)


@settings(max_examples=examples(100), deadline=None)
@given(seed=SEEDS, clearance=st.sampled_from([0.2, 1.0]))
def test_walls_have_room_as_arrays_say(seed: int, clearance: float) -> None:
    rng = np.random.default_rng(seed)
    ring = outline(rng)
    a, b = ring[:-1], ring[1:]
    normal, offset = np.array([0.6, 0.8]), rng.uniform(-5, 5)
    side_a, side_b = a @ normal - offset, b @ normal - offset
    crossed = np.flatnonzero(side_a * side_b < 0)
    share = side_a[crossed] / (side_a[crossed] - side_b[crossed])
    places = a[crossed] + share[:, None] * (b[crossed] - a[crossed])
    free = (away(places, a) >= clearance).all(axis=1)
    near = a[np.abs(side_a) < clearance]
    nodes, edge = find_nodes(a, b, side_a, side_b, clearance)
    assert nodes.tolist() == [*near.tolist(), *places[free].tolist()]
    assert edge.tolist() == [-1] * len(near) + crossed[free].tolist()
    ends = np.concatenate((nodes, a, rng.uniform(-6, 6, (6, 2))))
    start, end = (ends[index.ravel()] for index in np.mgrid[: len(ends), : len(ends)])
    apart = (start != end).any(axis=1)
    found = are_clear(start, end, a, b, clearance)
    assert not found[~apart].any()
    assert found[apart].tolist() == clear(start[apart], end[apart], a, b, clearance)


def test_walls_from_corner_to_corner_are_clear_or_not() -> None:
    ring = np.array([[0.0, 0], [10, 0], [10, 10], [5, 10], [0, 10], [0, 0]])
    start, end = np.array([[5.0, 0], [0, 0], [5, 10], [0, 9]]), np.array([[5.0, 10], [10, 10], [0, 0.3], [1, 9]])
    #   straight across; from corner to corner; too close to a corner; ends in the middle
    assert are_clear(start, end, ring[:-1], ring[1:], 1.0).tolist() == [True, True, False, True]


@settings(max_examples=examples(50), deadline=None)
@given(seed=SEEDS, levels=st.sampled_from([5, 10**6]))
def test_the_best_lines_are_those_of_arrays(seed: int, levels: int) -> None:
    rng = np.random.default_rng(seed)
    n, least, clearance = int(rng.integers(2, 200)), int(rng.integers(1, 8)), 0.2
    across, z = rng.integers(0, levels, n) * (20 / levels), rng.normal(size=n)
    vertex = rng.uniform(0, 20, 6)
    total = float(z @ z)
    order = np.argsort(across, kind="stable")
    left = np.arange(least, n - least + 1)
    gain = np.zeros(n + 1)
    gain[left] = np.cumsum(z[order])[left - 1] ** 2 * n / (left * (n - left)) / total
    row, corner = across[order], np.sort(vertex)
    middle = (row[1:] + row[:-1]) / 2
    free = np.abs(middle[:, None] - corner).min(axis=1) >= clearance
    free &= row[1:] > row[:-1]
    expected = [(-1.0, 0.0), (-1.0, 0.0)]
    for k, (offset, place) in enumerate(
        ((corner, np.searchsorted(row, corner)), (middle[free], np.flatnonzero(free) + 1))
    ):
        if len(offset):
            best = int(np.argmax(gain[place]))
            expected[k] = (gain[place[best]], offset[best])
    best_gain, best_offset = best_lines(across, z, corner, total, clearance, least)
    assert list(zip(best_gain.tolist(), best_offset.tolist(), strict=True)) == expected
    assert MIN_GAIN > 0  # a line that is not there has no gain and falls away


@pytest.mark.parametrize("n", [0, 3, 7, 8, 20, 127, 128, 129, 300, 1100])
def test_sums_are_numpys(n: int) -> None:
    for values in np.random.default_rng(n).uniform(0.1, 30, (20, n)):
        assert _sum_pairwise(values) == values.sum()


@settings(max_examples=examples(50), deadline=None)
@given(seed=SEEDS)
def test_directions_are_those_with_most_wall(seed: int) -> None:
    rng = np.random.default_rng(seed)
    turn = rng.choice([0.0, 0.03, 1.0, 1.57, 2.3, 3.14, 4.0], 30)
    d = rng.uniform(1, 9, (30, 1)) * np.column_stack((np.cos(turn), np.sin(turn)))
    length = np.hypot(d[:, 0], d[:, 1])
    unit = d / length[:, None]
    left, groups = np.argsort(-length, kind="stable"), []
    while len(left):
        along = unit[left[0]]
        same = np.abs(unit[left, 0] * along[1] - unit[left, 1] * along[0]) <= 0.0872
        groups.append((length[left[same]].sum(), along))
        left = left[~same]
    groups.sort(key=lambda group: -group[0])
    assert directions(np.zeros((30, 2)), d).tolist() == [along.tolist() for _, along in groups[:4]]


def test_corners_are_inserted_by_their_way_along_the_edge() -> None:
    ring = np.array([[0.0, 0], [10, 0], [10, 10], [0, 0], [2, 1], [3, 1], [3, 2], [2, 1]])
    of_ring = np.array([0, 0, 0, 0, 1, 1, 1, 1])
    corners = np.array([[7.0, 0], [2, 0], [10, 0], [10, 5], [2.5, 1 + 5e-7], [5, 1], [3, 3]])
    xy, owner = insert_corners(ring, of_ring, corners)
    inserted = [[0, 0], [2, 0], [7, 0], [10, 0], [10, 5], [10, 10], [3, 3], [0, 0]]
    assert xy.tolist() == [*inserted, [2, 1], [2.5, 1 + 5e-7], [3, 1], [3, 2], [2, 1]]
    assert owner.tolist() == [0] * 8 + [1] * 5


def test_edges_are_divided_where_walls_end() -> None:
    square = shapely.get_coordinates(shapely.box(0, 0, 4, 4, ccw=True))
    walls, edge = np.array([[[4.0, 1], [0, 1]], [[0, 1], [0, 4]]]), np.array([[0, 2], [2, -1]])
    segments = divide_edges(square[:-1], square[1:], walls, edge)
    whole, halves = segments[:2].tolist(), segments[2:6].tolist()
    assert whole == [[[4, 4], [0, 4]], [[0, 0], [4, 0]]]
    assert halves == [[[4, 0], [4, 1]], [[0, 4], [0, 1]], [[4, 1], [4, 4]], [[0, 1], [0, 0]]]
    assert segments[6:].tolist() == walls.tolist()


@settings(max_examples=examples(50), deadline=None)
@given(seed=SEEDS)
def test_places_are_added_in_order_and_once(seed: int) -> None:
    rng = np.random.default_rng(seed)
    first, more = rng.integers(0, 4, (2, 9, 2)).astype(np.float64)
    places = add_places(np.empty((0, 2)), first)
    assert places.tolist() == np.unique(first, axis=0).tolist()
    assert add_places(places, more).tolist() == np.unique(np.concatenate((first, more)), axis=0).tolist()


@settings(max_examples=examples(100), deadline=None)
@given(seed=SEEDS)
def test_walls_go_from_node_to_node_inside_the_outline(seed: int) -> None:
    rng = np.random.default_rng(seed)
    ring, along, offset, clearance = outline(rng), np.array([0.6, 0.8]), rng.uniform(-5, 5), 0.3
    a, b = ring[:-1], ring[1:]
    side_a, side_b = (end[:, 1] * along[0] - end[:, 0] * along[1] - offset for end in (a, b))
    nodes, edge = find_nodes(a, b, side_a, side_b, clearance)
    order = np.argsort(nodes[:, 0] * along[0] + nodes[:, 1] * along[1], kind="stable")
    nodes, edge = nodes[order], edge[order]
    polygon = shapely.polygons(ring)
    middle = (nodes[:-1] + nodes[1:]) / 2
    wall = are_clear(nodes[:-1], nodes[1:], a, b, clearance) & shapely.contains_xy(polygon, *middle.T)
    ends, divided = place_walls(a, b, along, offset, clearance)
    assert ends.tolist() == np.stack((nodes[:-1], nodes[1:]), axis=1)[wall].tolist()
    assert divided.tolist() == np.column_stack((edge[:-1], edge[1:]))[wall].tolist()
