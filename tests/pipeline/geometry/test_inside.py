"""Points inside polygons and their order, against GEOS and numpy: random ones, and those that lie on outlines."""

import numpy as np
import shapely
import shapely.affinity
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from pipeline.geometry.group_order import sort_points, sort_values
from pipeline.geometry.inside import (
    INDEX_CELL,
    are_covered,
    are_inside,
    cover_polygons,
    find_inside,
    find_owner,
    index_polygons,
)
from tests.helpers.campaigns import examples

Array = NDArray[np.float64]


def by_geos(xy: Array, polygons: NDArray[np.object_], *, closed: bool) -> NDArray[np.bool_]:
    """Matrix (n_polygons, n_points) of which are inside."""
    predicate = shapely.intersects_xy if closed else shapely.contains_xy
    return np.array([predicate(polygon, xy[:, 0], xy[:, 1]) for polygon in polygons]).reshape(
        len(polygons), len(xy)
    )


def check(xy: Array, polygons: NDArray[np.object_]) -> None:
    pairs = [index.tolist() for index in np.nonzero(by_geos(xy, polygons, closed=False))]
    assert [index.tolist() for index in find_inside(xy, polygons)] == pairs
    some = np.arange(len(xy)) % 3 > 0
    some_pairs = [(a, b) for a, b in zip(*pairs, strict=True) if some[b]]
    assert (
        list(zip(*(index.tolist() for index in find_inside(xy, polygons, among=some)), strict=True)) == some_pairs
    )
    low = xy.min(axis=0, initial=1e9)
    high = (low + xy.max(axis=0, initial=-1e9)) / 2
    near = ((xy >= low) & (xy <= high)).all(axis=1)
    index = index_polygons(polygons, (*low.tolist(), *high.tolist()))
    found = find_inside(xy, polygons, among=near, index=index)
    assert list(zip(*(rows.tolist() for rows in found), strict=True)) == [
        (a, b) for a, b in zip(*pairs, strict=True) if near[b]
    ]
    polygon, point = np.divmod(np.arange(len(polygons) * len(xy)), max(len(xy), 1))
    for closed in (False, True):
        inside = are_inside(polygons, polygon, xy[point], closed=closed)
        assert inside.tolist() == by_geos(xy, polygons, closed=closed).ravel().tolist()


def star(rng: np.random.Generator, *, whole: bool) -> shapely.Polygon:
    """Polygon with a hole, its vertices on whole metres or anywhere."""
    turn = np.sort(rng.uniform(0, 2 * np.pi, rng.integers(3, 30)))
    spokes = rng.uniform(2, 12, (len(turn), 1)) * np.column_stack((np.cos(turn), np.sin(turn)))
    ring = spokes + rng.uniform(-9, 9, 2)
    hole = shapely.Polygon(ring).buffer(0).representative_point().buffer(0.7, quad_segs=2)
    found = shapely.Polygon(ring).buffer(0).difference(hole)
    found = shapely.set_precision(found, 1.0) if whole else found
    return max(shapely.get_parts(found), key=shapely.area, default=shapely.Polygon())


@settings(max_examples=examples(60), deadline=None)
@given(seed=st.integers(0, 10**6), whole=st.booleans(), far=st.sampled_from([0.0, 6_400_000.0]))
def test_points_are_where_geos_says(seed: int, whole: bool, far: float) -> None:
    rng = np.random.default_rng(seed)
    polygons = np.array([star(rng, whole=whole) for _ in range(4)], dtype=object)
    polygons = shapely.transform(polygons, lambda xy: xy + far)
    corners = shapely.get_coordinates(polygons)
    middles = (corners[1:] + corners[:-1]) / 2
    inside = rng.uniform(-20, 20, (200, 2)) + far
    grid = np.rint(inside)
    check(np.concatenate((inside, grid, corners, middles)), polygons)


def test_outlines_holes_and_empty_polygons() -> None:
    ring = shapely.box(0, 0, 8, 8).difference(shapely.box(2, 2, 6, 6))
    polygons = np.array([ring, shapely.Polygon(), shapely.MultiPolygon([shapely.box(8, 0, 9, 1), ring])])
    axis = np.arange(-1.0, 11)
    check(np.array([[x, y] for x in axis for y in axis]), polygons)
    check(np.empty((0, 2)), polygons)
    check(np.zeros((3, 2)), polygons[:0])


def test_many_points_in_wide_polygons() -> None:
    """Cells that lie inside as a whole, outlines along their borders, a grid that outgrows its first room."""
    ring = shapely.box(0, 0, 64, 48).difference(shapely.box(8, 8, 30, 31))
    turned = shapely.affinity.rotate(shapely.box(-5, -5, 50, 20), 30)
    polygons = np.array([ring, turned, shapely.box(1000, 1000, 1001, 1001)])
    axis = np.arange(-10.0, 70, 0.5)
    check(np.array([[x, y] for x in axis for y in axis]), polygons)
    check(np.array([[500.0, 500.0], [501.0, 700.0]]), polygons)
    check(np.array([[2000.0, 500.0]]), polygons)


@settings(max_examples=examples(60), deadline=None)
@given(seed=st.integers(0, 10**6))
def test_owners_are_those_of_geos(seed: int) -> None:
    rng = np.random.default_rng(seed)
    corners = np.rint(rng.uniform(0, 20, (12, 2)))
    pieces = shapely.get_parts(shapely.delaunay_triangles(shapely.MultiPoint(corners)))
    xy = np.concatenate((corners, (corners[1:] + corners[:-1]) / 2, rng.uniform(-2, 22, (100, 2))))
    inside = by_geos(xy, pieces, closed=False)
    expected = np.where(inside.any(axis=0), inside.argmax(axis=0) if len(pieces) else -1, -1)
    assert find_owner(pieces, xy).tolist() == expected.tolist()
    assert (expected >= 0).any()


@settings(max_examples=examples(40), deadline=None)
@given(seed=st.integers(0, 10**6), levels=st.sampled_from([1, 3, 1000]), most=st.sampled_from([40, 400]))
def test_groups_are_sorted_as_by_numpy(seed: int, levels: int, most: int) -> None:
    rng = np.random.default_rng(seed)
    start = np.concatenate(([0], np.cumsum(rng.integers(0, most, 6))))
    group = np.repeat(np.arange(6), np.diff(start))
    xyz = rng.integers(0, levels, (start[-1], 3)) / 7.0
    xyz[:: rng.integers(1, 5), 2] += rng.choice([0.0, 1e6])
    order = np.lexsort((xyz[:, 0], xyz[:, 1], xyz[:, 2], group))
    assert sort_points(start, xyz).tolist() == xyz[order].tolist()
    assert sort_values(start, xyz[:, 2]).tolist() == xyz[np.lexsort((xyz[:, 2], group)), 2].tolist()


@settings(max_examples=examples(60), deadline=None)
@given(seed=st.integers(0, 10**6), whole=st.booleans())
def test_a_cover_has_all_that_is_inside_and_nothing_far(seed: int, whole: bool) -> None:
    rng = np.random.default_rng(seed)
    polygons = np.array([star(rng, whole=whole) for _ in range(3)], dtype=object)
    xy = rng.uniform(-30, 30, (500, 2))
    covered = are_covered(cover_polygons(polygons), xy)
    assert covered[find_inside(xy, polygons)[1]].all()
    # A wall along the border of cells may have more of them, but none beyond those that its polygon's box meets.
    parts = shapely.box(*shapely.bounds(polygons).T) if whole else polygons
    near = shapely.buffer(shapely.union_all(parts), 1.5 * INDEX_CELL)
    assert not covered[~shapely.contains_xy(near, xy[:, 0], xy[:, 1])].any()
    assert not are_covered(cover_polygons(polygons[:0]), xy).any()
