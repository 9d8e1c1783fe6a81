"""Step 1.3: bin means, filling, sampling."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.errors import InputError
from pipeline.pointcloud import BUILDING, GROUND, WATER, PointCloud
from pipeline.terrain import Dtm, bin_ground, compute_dtm, fill_dtm, sample_dtm
from tests.cities import tilted_dtm


def cloud(rows: list[tuple[float, float, float, int]]) -> PointCloud:
    array = np.array(rows, dtype=np.float64).reshape(-1, 4)
    return PointCloud(np.ascontiguousarray(array[:, :3]), array[:, 3].astype(np.uint8))


def test_bins_take_the_closest_node_and_only_ground_and_water() -> None:
    points = cloud(
        [(0.4, 0.4, 1.0, GROUND), (-0.4, 0.0, 3.0, WATER), (0.0, 0.0, 99.0, BUILDING), (0.6, 0.0, 5.0, GROUND)]
    )
    dtm, count = bin_ground(points, (0.0, 0.0, 1.0, 1.0), spacing=1.0)
    assert count.tolist() == [[2, 1], [0, 0]]
    assert dtm.z[0].tolist() == [2.0, 5.0]
    assert np.isnan(dtm.z[1]).all()


def test_a_bins_mean_does_not_depend_on_the_order_of_its_points() -> None:
    rng = np.random.default_rng(0)
    xyz = np.column_stack((rng.uniform(0, 5, (5000, 2)), rng.uniform(0, 1000, 5000).round(3)))
    classes = np.full(5000, GROUND, np.uint8)
    one = compute_dtm(PointCloud(xyz, classes), (0.0, 0.0, 5.0, 5.0))
    shuffled = compute_dtm(PointCloud(xyz[rng.permutation(5000)], classes), (0.0, 0.0, 5.0, 5.0))
    assert one.z.tobytes() == shuffled.z.tobytes()


def test_filling_goes_ring_by_ring_from_the_border() -> None:
    z = np.full((1, 6), np.nan)
    z[0, 0], z[0, 5] = 1.0, 7.0
    # Ring 1 copies each end; ring 2 copies ring 1: the step is in the middle.
    assert fill_dtm(Dtm(z, 0, 0, 1.0)).z.tolist() == [[1.0, 1.0, 1.0, 7.0, 7.0, 7.0]]


def test_filling_takes_the_mean_of_the_neighbours_known_before_the_ring() -> None:
    z = np.array([[1.0, 2.0, 3.0], [4.0, np.nan, 6.0], [7.0, 8.0, 9.0]])
    assert fill_dtm(Dtm(z, 0, 0, 1.0)).z[1, 1] == 5.0


def test_filling_keeps_what_is_known_and_leaves_its_input() -> None:
    z = np.array([[1.5, np.nan], [np.nan, np.nan]])
    filled = fill_dtm(Dtm(z, 0, 0, 1.0)).z
    assert filled.tolist() == [[1.5, 1.5], [1.5, 1.5]]
    assert np.isnan(z[1, 1])


def test_no_ground_point_is_an_error_with_a_next_move() -> None:
    with pytest.raises(InputError, match="--ground-filter"):
        compute_dtm(cloud([(0.0, 0.0, 1.0, BUILDING)]), (0.0, 0.0, 2.0, 2.0))


@settings(max_examples=50, deadline=None)
@given(st.floats(-1, 1), st.floats(-1, 1), st.lists(st.tuples(st.floats(100, 120), st.floats(-7, 9)), min_size=1))
def test_sampling_reproduces_a_plane(slope_x: float, slope_y: float, places: list[tuple[float, float]]) -> None:
    dtm = tilted_dtm((100.0, -7.0, 120.0, 9.0), slope_x=slope_x, slope_y=slope_y, height=3.0)
    xy = np.array(places)
    expected = 3.0 + slope_x * xy[:, 0] + slope_y * xy[:, 1]
    np.testing.assert_allclose(sample_dtm(dtm, xy), expected, atol=1e-9)


def test_sampling_has_the_same_bits_from_any_cut_of_the_raster() -> None:
    rng = np.random.default_rng(1)
    whole = Dtm(rng.normal(size=(40, 50)), 318000, 6399000, 1.0)
    cut = Dtm(whole.z[10:30, 5:45].copy(), 318005, 6399010, 1.0)
    xy = np.column_stack((rng.uniform(318006, 318043, 500), rng.uniform(6399011, 6399028, 500)))
    assert sample_dtm(whole, xy).tobytes() == sample_dtm(cut, xy).tobytes()


def test_sampling_beyond_the_raster_takes_its_border() -> None:
    dtm = tilted_dtm((0.0, 0.0, 4.0, 4.0), slope_x=1.0)
    assert sample_dtm(dtm, np.array([[-3.0, 2.0], [9.0, 2.0]])).tolist() == [0.0, 4.0]
