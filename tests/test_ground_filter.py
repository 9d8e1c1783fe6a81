"""The ground filter on request: terrain stays, buildings and trees go."""

import numpy as np

from pipeline.ground_filter import classify_ground
from pipeline.pointcloud import GROUND, LOW_NOISE, UNCLASSIFIED, PointCloud


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
