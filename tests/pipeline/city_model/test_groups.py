"""Grouping of adjacent houses: contacts, heights worked out by hand, and the promises on random cities."""

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from pipeline.city_model.groups import adjacent_houses, group_roofs
from tests.helpers.campaigns import examples

Array = NDArray[np.float64]
NO_PAIRS = np.empty((0, 2), np.int64)


def shapes(*polygons: shapely.Polygon) -> NDArray[np.object_]:
    array = np.empty(len(polygons), object)
    array[:] = polygons
    return array


def row(n: int) -> NDArray[np.int64]:
    """Pairs of a terrace of `n` houses."""
    return np.column_stack((np.arange(n - 1), np.arange(1, n)))


def group(
    roof: list[float], pairs: NDArray[np.int64], *, area: list[float] | None = None, threshold: float = 2.0
) -> tuple[list[float], list[int]]:
    areas = np.ones(len(roof)) if area is None else np.array(area)
    heights, groups = group_roofs(np.array(roof), areas, pairs, key=np.arange(len(roof)), threshold=threshold)
    return heights.tolist(), groups.tolist()


def test_walls_and_corners_are_contacts_and_gaps_are_not() -> None:
    houses = shapes(
        shapely.box(0, 0, 10, 10),
        shapely.box(10, 0, 20, 10),  # shares a wall with 0
        shapely.box(20, 10, 30, 20),  # shares a corner with 1
        shapely.box(10.001, 10.001, 19, 20),  # a millimetre from 0
    )
    assert adjacent_houses(houses).tolist() == [[0, 1], [1, 2]]


def test_a_house_in_a_courtyard_touches_its_neighbour_by_the_hole() -> None:
    ring = shapely.Polygon(shapely.box(0, 0, 30, 30).exterior, [shapely.box(10, 10, 20, 20).exterior])
    assert adjacent_houses(shapes(ring, shapely.box(10, 10, 20, 20))).tolist() == [[0, 1]]


def test_houses_around_one_vertex_all_touch() -> None:
    quarters = [shapely.box(x, y, x + 5, y + 5) for x in (-5.0, -0.0) for y in (-5.0, 0.0)]
    assert adjacent_houses(shapes(*quarters)).tolist() == [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]]


def test_contacts_by_brute_force() -> None:
    rng = np.random.default_rng(4)
    corner = rng.integers(0, 12, (60, 2)) * 5.0
    houses = shapely.box(corner[:, 0], corner[:, 1], corner[:, 0] + 5, corner[:, 1] + 5)
    vertices = [set(map(tuple, shapely.get_coordinates(house).tolist())) for house in houses]
    expected = [[i, j] for i in range(60) for j in range(i + 1, 60) if vertices[i] & vertices[j]]
    assert adjacent_houses(houses).tolist() == expected
    assert len(expected) > 20


@pytest.mark.parametrize("houses", [shapes(), shapes(shapely.box(0, 0, 1, 1))])
def test_none_or_one_house_has_no_contact(houses: NDArray[np.object_]) -> None:
    assert adjacent_houses(houses).shape == (0, 2)
    roof, groups = group_roofs(
        np.full(len(houses), 5.0), np.ones(len(houses)), NO_PAIRS, key=np.arange(len(houses))
    )
    assert roof.tolist() == [5.0] * len(houses)
    assert groups.tolist() == [0] * len(houses)
    assert groups.dtype == np.int32


def test_the_smallest_difference_goes_first() -> None:
    # 10 and 10.5 join to 10.25; 12.4 is then 2.15 away. Joined first, 10.5 and 12.4 would leave 10 alone.
    assert group([10.0, 10.5, 12.4], row(3)) == ([10.25, 10.25, 12.4], [0, 0, 1])


def test_the_mean_is_weighted_by_area() -> None:
    assert group([10.0, 11.0], row(2), area=[300.0, 100.0]) == ([10.25, 10.25], [0, 0])


def test_a_joined_group_may_come_close_to_the_next() -> None:
    # 12 is exactly 2 from 10, which is enough; pulled to 11 by the house behind it, it is not.
    heights, groups = group([10.0, 12.0, 10.5], np.array([[0, 1], [1, 2]]), area=[1.0, 1.0, 2.0])
    assert groups == [0, 0, 0]
    assert heights == [10.75] * 3
    assert group([10.0, 12.0], row(2))[1] == [0, 1]


def test_far_apart_houses_do_not_join_and_those_without_roof_stay_alone() -> None:
    heights, groups = group([10.0, np.nan, 10.1], row(3))
    assert groups == [0, 1, 2]
    np.testing.assert_array_equal(heights, [10.0, np.nan, 10.1])


def test_equal_heights_join_without_a_change_of_bits() -> None:
    heights, groups = group([0.1 + 0.2] * 3, row(3), area=[0.1, 1.7, 0.1])
    assert groups == [0, 0, 0]
    assert heights == [0.1 + 0.2] * 3


def test_ties_go_by_key_not_by_row() -> None:
    # Both differences are 1: the key says which pair is first, 0-1 or 1-2.
    roof, area = np.array([10.0, 11.0, 12.0]), np.ones(3)
    one, _ = group_roofs(roof, area, row(3), key=np.array(["a", "b", "c"]), threshold=1.2)
    other, _ = group_roofs(roof, area, row(3), key=np.array(["c", "b", "a"]), threshold=1.2)
    assert one.tolist() == [10.5, 10.5, 12.0]
    assert other.tolist() == [10.0, 11.5, 11.5]


def random_city(seed: int, n: int) -> tuple[Array, Array, NDArray[np.int64]]:
    rng = np.random.default_rng(seed)
    roof = np.round(rng.uniform(5, 5 + rng.choice([3.0, 15.0]), n), rng.choice([0, 3]))
    area = np.exp(rng.normal(4, 1, n))
    pairs = rng.integers(0, n, (2 * n, 2))
    return roof, area, np.unique(np.sort(pairs[pairs[:, 0] != pairs[:, 1]], axis=1), axis=0)


@settings(max_examples=examples(60), deadline=None)
@given(st.integers(0, 10**6), st.integers(2, 40))
def test_promises_on_random_cities(seed: int, n: int) -> None:
    roof, area, pairs = random_city(seed, n)
    heights, groups = group_roofs(roof, area, pairs, key=np.arange(n))
    a, b = groups[pairs[:, 0]], groups[pairs[:, 1]]
    difference = np.abs(heights[pairs[:, 0]] - heights[pairs[:, 1]])
    assert (difference[a != b] >= 2.0).all()
    assert (difference[a == b] == 0).all()
    total = np.bincount(groups, area)
    np.testing.assert_allclose(np.bincount(groups, area * roof), np.bincount(groups, area * heights), rtol=1e-12)
    assert (np.abs(heights - roof) <= 2.0 * np.log(total[groups] / area) + 1e-9).all()
    alone = np.bincount(groups)[groups] == 1
    assert (heights[alone] == roof[alone]).all()


@settings(max_examples=examples(30), deadline=None)
@given(st.integers(0, 10**6), st.integers(2, 40))
def test_order_of_houses_and_pairs_does_not_matter(seed: int, n: int) -> None:
    roof, area, pairs = random_city(seed, n)
    key = np.random.default_rng(seed).permutation(n)
    heights, groups = group_roofs(roof, area, pairs, key=key)
    order = np.random.default_rng(seed + 1).permutation(n)
    rank = np.argsort(order)
    moved = rank[pairs][::-1, ::-1]
    other, other_groups = group_roofs(roof[order], area[order], moved, key=key[order])
    assert other.tobytes() == heights[order].tobytes()
    assert other_groups.tolist() == groups[order].tolist()


def test_a_cluster_alone_has_the_same_bytes() -> None:
    roof, area, pairs = random_city(7, 30)
    more, more_area, more_pairs = random_city(8, 30)
    key = np.random.default_rng(1).permutation(60)
    both, _ = group_roofs(
        np.concatenate((roof, more)),
        np.concatenate((area, more_area)),
        np.concatenate((pairs, more_pairs + 30)),
        key=key,
    )
    alone, _ = group_roofs(roof, area, pairs, key=key[:30])
    assert both[:30].tobytes() == alone.tobytes()


def test_a_large_block_is_grouped_in_time() -> None:
    n = 60
    index = np.arange(n * n).reshape(n, n)
    right = np.column_stack((index[:, :-1].ravel(), index[:, 1:].ravel()))
    up = np.column_stack((index[:-1].ravel(), index[1:].ravel()))
    roof = np.random.default_rng(0).uniform(8, 10, n * n)
    heights, groups = group_roofs(roof, np.ones(n * n), np.concatenate((right, up)), key=np.arange(n * n))
    assert np.ptp(groups) == 0
    assert heights[0] == pytest.approx(roof.mean())


@pytest.mark.parametrize(
    ("area", "key", "pairs", "message"),
    [
        ([1.0, 0.0], [0, 1], row(2), "least area is 0.0"),
        ([1.0, np.nan], [0, 1], row(2), "least area is nan"),
        ([1.0, 1.0], [5, 5], row(2), "1 of 2 keys are repeated"),
        ([1.0], [0, 1], row(2), "do not match"),
        ([1.0, 1.0], [0, 1], np.arange(4), "do not match"),
    ],
)
def test_wrong_arguments_are_told(
    area: list[float], key: list[int], pairs: NDArray[np.int64], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        group_roofs(np.array([5.0, 6.0]), np.array(area), pairs, key=np.array(key))
    with pytest.raises(ValueError, match="threshold -1"):
        group_roofs(np.array([5.0, 6.0]), np.ones(2), row(2), key=np.arange(2), threshold=-1)
