"""The ground filter on request: terrain stays, buildings and trees go, and tiles get what the region gets."""

import functools

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.data.classes import GROUND, LOW_NOISE, UNCLASSIFIED
from pipeline.data.pointcloud import PointCloud
from pipeline.points_terrain.ground_filter import FILTER_REACH, GAP, classify_ground


def test_terrain_is_ground_and_what_stands_on_it_is_not() -> None:
    rng = np.random.default_rng(4)
    xy = rng.uniform(0, 120, (40000, 2))
    terrain = 5 * np.sin(xy[:, 0] / 40) + rng.normal(0, 0.05, len(xy))
    on_roof = (abs(xy[:, 0] - 40) < 15) & (abs(xy[:, 1] - 60) < 10)
    in_tree = ~on_roof & (rng.random(len(xy)) < 0.1) & (np.hypot(xy[:, 0] - 90, xy[:, 1] - 30) < 10)
    z = np.where(on_roof, 20.0, np.where(in_tree, terrain + rng.uniform(2, 9, len(xy)), terrain))
    noise = np.array([[60.0, 60.0, -30.0]])
    cloud = PointCloud(
        np.concatenate((np.column_stack((xy, z)), noise)),
        np.concatenate((np.full(len(xy), UNCLASSIFIED), [LOW_NOISE])).astype(np.uint8),
    )
    found = classify_ground(cloud).classification[:-1] == GROUND
    assert not found[on_roof].any()
    assert not found[in_tree & (z > terrain + 2)].any()
    assert found[~on_roof & ~in_tree].mean() > 0.99
    assert classify_ground(cloud).classification[-1] == LOW_NOISE


def test_an_earlier_ground_class_is_not_trusted() -> None:
    x, y = np.meshgrid(np.arange(40.0), np.arange(40.0))
    z = np.zeros(x.size)
    z[820] = 30.0
    cloud = PointCloud(np.column_stack((x.ravel(), y.ravel(), z)), np.full(x.size, GROUND, np.uint8))
    assert classify_ground(cloud).classification[820] == UNCLASSIFIED


def test_no_points_are_no_ground() -> None:
    empty = PointCloud(np.empty((0, 3)), np.empty(0, np.uint8))
    assert len(classify_ground(empty).classification) == 0


Box = tuple[float, float, float, float]
REGION: Box = (2000.3, -800.0, 2560.0, -290.8)


def rough_town(seed: int) -> PointCloud:
    """Hills under roofs of all sizes, many touching, and gaps narrower and wider than what is filled."""
    rng = np.random.default_rng(seed)
    n = 60_000
    xy = rng.uniform(REGION[:2], REGION[2:], (n, 2))
    z = 6 * np.sin(xy[:, 0] / 60) * np.cos(xy[:, 1] / 50) + rng.normal(0, 0.3, n)
    middle = rng.uniform(REGION[:2], REGION[2:], (300, 2))
    half, top = rng.uniform(2, 30, (300, 2)), rng.uniform(3, 25, 300)
    for k in range(300):
        z[(np.abs(xy - middle[k]) < half[k]).all(axis=1)] = top[k]
    dry = np.ones(n, np.bool_)
    for x, y, r in ((2250, -560, 70), (2150, -500, 12), (2380, -420, 40), (2440, -520, 25)):
        dry &= np.hypot(xy[:, 0] - x, 1.5 * (xy[:, 1] - y)) > r
    classes = rng.choice([UNCLASSIFIED, GROUND, LOW_NOISE], n, p=[0.7, 0.29, 0.01])
    return PointCloud(np.column_stack((xy, z))[dry], classes[dry].astype(np.uint8))


@functools.cache
def classified_town(seed: int) -> PointCloud:
    return classify_ground(rough_town(seed), bounds=REGION)


def select(cloud: PointCloud, box: Box) -> NDArray[np.bool_]:
    xy = cloud.xyz[:, :2]
    inside: NDArray[np.bool_] = np.all((xy >= box[:2]) & (xy <= box[2:]), axis=1)
    return inside


def classify_tile(cloud: PointCloud, tile: Box, reach: float) -> PointCloud:
    """Classes of the tile's points from those that it may read only."""
    x0, y0, x1, y1 = tile
    bounds = (
        max(x0 - reach, REGION[0]),
        max(y0 - reach, REGION[1]),
        min(x1 + reach, REGION[2]),
        min(y1 + reach, REGION[3]),
    )
    near = select(cloud, bounds)
    found = classify_ground(PointCloud(cloud.xyz[near], cloud.classification[near]), bounds=bounds)
    own = select(found, tile)
    return PointCloud(found.xyz[own], found.classification[own])


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize(
    "tile",
    [
        (2200.4, -600.2, 2350.7, -480.9),  # beside and in the largest gap
        (2000.3, -800.0, 2180.0, -640.0),  # at the region's border
        (2231.1, -575.0, 2262.0, -549.0),  # in the gap alone
        (2300.0, -460.5, 2560.0, -290.8),
    ],
)
def test_a_tile_and_its_reach_get_the_classes_of_the_region(seed: int, tile: Box) -> None:
    cloud = rough_town(seed)
    whole = classified_town(seed)
    own = select(whole, tile)
    part = classify_tile(cloud, tile, FILTER_REACH)
    assert part.xyz.tobytes() == whole.xyz[own].tobytes()
    assert part.classification.tobytes() == whole.classification[own].tobytes()


@pytest.mark.parametrize(("reach", "cut_off"), [(20.0, False), (FILTER_REACH, True)])
def test_a_tile_on_a_wide_roof_needs_the_reach(reach: float, cut_off: bool) -> None:
    rng = np.random.default_rng(3)
    xy = rng.uniform((2150, -700), (2450, -400), (45_000, 2))
    on_roof = (np.abs(xy - [2300, -550]) < 28).all(axis=1)
    cloud = PointCloud(np.column_stack((xy, 20.0 * on_roof)), np.full(len(xy), UNCLASSIFIED, np.uint8))
    found = classify_tile(cloud, (2292.0, -558.0, 2308.0, -542.0), reach)
    assert len(found.xyz) > 50
    assert (found.classification == (UNCLASSIFIED if cut_off else GROUND)).all()


def test_the_order_of_the_points_does_not_matter() -> None:
    cloud = rough_town(9)
    order = np.random.default_rng(0).permutation(len(cloud.xyz))
    shuffled = classify_ground(PointCloud(cloud.xyz[order], cloud.classification[order]))
    assert shuffled.classification.tobytes() == classify_ground(cloud).classification[order].tobytes()


def classes_of(xyz: NDArray[np.float64]) -> NDArray[np.uint8]:
    return classify_ground(PointCloud(xyz, np.full(len(xyz), UNCLASSIFIED, np.uint8))).classification


def pave(x0: int, x1: int, y0: int, y1: int, height: float) -> NDArray[np.float64]:
    """One point in the middle of each cell."""
    x, y = np.meshgrid(np.arange(x0, x1) + 0.5, np.arange(y0, y1) + 0.5)
    return np.column_stack((x.ravel(), y.ravel(), np.full(x.size, height)))


@pytest.mark.parametrize(("gap", "is_ground"), [(2 * GAP - 2, False), (2 * GAP + 14, True)])
def test_shores_beyond_a_wide_gap_do_not_count(gap: int, is_ground: bool) -> None:
    # Filled throughout, the gap would show that the island stands 8 m above the shores.
    island = pave(100, 110, 45, 55, 8.0)
    found = classes_of(
        np.concatenate((island, pave(0, 100 - gap, 0, 100, 0.0), pave(110 + gap, 210, 0, 100, 0.0)))
    )
    assert (found[: len(island)] == (GROUND if is_ground else UNCLASSIFIED)).all()
    assert (found[len(island) :] == GROUND).all()


def test_no_window_lies_in_a_wide_gap() -> None:
    # A window there would see nothing but the long roof on the shore.
    ground, roof, far = pave(0, 90, 0, 200, 0.0), pave(90, 100, 50, 150, 12.0), pave(200, 220, 0, 200, 0.0)
    found = classes_of(np.concatenate((ground, roof, far)))
    assert (found == GROUND).tolist() == [True] * len(ground) + [False] * len(roof) + [True] * len(far)


def test_points_outside_the_bounds_are_refused() -> None:
    cloud = PointCloud(np.array([[5.0, 5.0, 0.0]]), np.array([UNCLASSIFIED], np.uint8))
    with pytest.raises(ValueError, match="outside"):
        classify_ground(cloud, bounds=(0.0, 0.0, 4.0, 9.0))
