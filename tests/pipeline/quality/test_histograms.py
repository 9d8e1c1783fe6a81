"""Histograms and sums that tiles add up, against the values themselves."""

from dataclasses import asdict

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from pipeline.data.classes import BUILDING, GROUND, WATER
from pipeline.data.mesh import TetMesh
from pipeline.data.pointcloud import PointCloud
from pipeline.quality.building_facts import fidelity_table
from pipeline.quality.histograms import (
    QUALITY_BINS,
    Histogram,
    count_values,
    histogram_percentiles,
    merge_histograms,
    percentile,
    quality_histograms,
    share_below,
)
from pipeline.quality.point_fidelity import (
    KINDS,
    FidelitySums,
    conclude_fidelity,
    index_model,
    measure_fidelity,
    merge_fidelity,
    sum_fidelity,
)
from pipeline.quality.quality import PERCENTILES, Quality, measure_cells, quality_percentiles
from pipeline.quality.residuals import Residuals, conclude, merge_residuals, sum_residuals, summarise
from tests.helpers.campaigns import examples
from tests.helpers.cities import city_of, random_blocks, tilted_dtm


def same(one: Histogram, other: Histogram) -> bool:
    return (one.low, one.high, one.minimum, one.maximum, one.counts.tobytes()) == (
        other.low,
        other.high,
        other.minimum,
        other.maximum,
        other.counts.tobytes(),
    )


def test_bins_by_hand() -> None:
    counted = count_values(np.array([0.0, 0.24, 0.25, 0.5, 1.0, 1.5, -3.0]), (0.0, 1.0), 4)
    assert counted.counts.tolist() == [3, 1, 1, 2]
    assert (counted.minimum, counted.maximum) == (-3.0, 1.5)


@settings(max_examples=examples(100), deadline=None)
@given(st.lists(st.floats(0, 1), min_size=1, max_size=40), st.floats(0, 100))
def test_a_percentile_is_within_a_bin_of_that_of_the_values(values: list[float], percent: float) -> None:
    counted = count_values(np.array(values), (0.0, 1.0), 50)
    assert percentile(counted, percent) == pytest.approx(np.percentile(values, percent), abs=1 / 50 + 1e-12)
    assert percentile(counted, 0) == min(values)
    assert percentile(counted, 100) == max(values)


def test_values_in_a_bin_are_spread_over_it() -> None:
    even = (np.arange(1000) + 0.5) / 1000
    counted = count_values(even, (0.0, 1.0), 10)
    for percent in (0.1, 1, 17, 50, 95):
        assert percentile(counted, percent) == pytest.approx(np.percentile(even, percent), abs=1e-9)


def test_values_beyond_the_range_reach_to_the_greatest() -> None:
    counted = count_values(np.array([0.5, 60.0, 70.0, 80.0, 90.0]), (0.0, 50.0), 50)
    assert 49 < percentile(counted, 50) < 90
    assert percentile(counted, 100) == 90.0


def test_merging_gives_the_histogram_of_all_values_in_any_order() -> None:
    values = np.random.default_rng(0).normal(0.5, 0.4, 5000)
    parts = [count_values(part, (0.0, 1.0), 64) for part in np.array_split(values, 7)]
    parts.append(count_values(np.empty(0), (0.0, 1.0), 64))
    whole = count_values(values[::-1], (0.0, 1.0), 64)
    assert same(merge_histograms(parts), whole)
    assert same(merge_histograms(parts[::-1]), whole)
    assert parts[0].counts.sum() == len(np.array_split(values, 7)[0])


def test_no_values_have_no_percentile() -> None:
    assert np.isnan(percentile(count_values(np.empty(0), (0.0, 1.0), 3), 50))


def test_what_cannot_be_counted_is_refused() -> None:
    with pytest.raises(ValueError, match="1 of 2 values are not finite"):
        count_values(np.array([0.0, np.nan]), (0.0, 1.0), 3)
    with pytest.raises(ValueError, match="no histogram"):
        count_values(np.zeros(1), (1.0, 1.0), 3)
    with pytest.raises(ValueError, match="different bins"):
        merge_histograms([count_values(np.zeros(1), (0.0, 1.0), bins) for bins in (3, 4)])
    with pytest.raises(ValueError, match="0 histograms"):
        merge_histograms([])
    with pytest.raises(ValueError, match="between 0 and 100"):
        percentile(count_values(np.zeros(1), (0.0, 1.0), 3), 101)


def test_quality_of_tiles_is_that_of_the_region_to_a_bin() -> None:
    rng = np.random.default_rng(1)
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0.5, 0.9, 0], [0.5, 0.3, 0.8]])
    points = (corners + rng.normal(0, 0.12, (20_000, 4, 3))).reshape(-1, 3)
    quality = measure_cells(TetMesh(points, np.arange(len(points), dtype=np.int32).reshape(-1, 4)))
    tiles = [
        quality_histograms(
            Quality(quality.radius_ratio[k::3], quality.min_dihedral[k::3], quality.aspect_ratio[k::3])
        )
        for k in range(3)
    ]
    merged = {name: merge_histograms([tile[name] for tile in tiles]) for name in QUALITY_BINS}
    found, exact = histogram_percentiles(merged), quality_percentiles(quality)
    assert {name: list(row) for name, row in found.items()} == {name: list(row) for name, row in exact.items()}
    for name, (limits, bins) in QUALITY_BINS.items():
        width = (limits[1] - limits[0]) / bins
        for percent in PERCENTILES:
            true = np.percentile(getattr(quality, name).astype(np.float64), percent)
            if true <= limits[1]:
                assert percentile(merged[name], percent) == pytest.approx(true, abs=width)
            assert found[name][f"{percent:g}"] == pytest.approx(percentile(merged[name], percent), abs=5.1e-5)
        assert (found[name]["0"], found[name]["100"]) == (exact[name]["0"], exact[name]["100"])


def close(found: Residuals, exact: Residuals) -> None:
    assert found.n == exact.n
    assert found.rmse == pytest.approx(exact.rmse, abs=1e-4)
    assert found.bias == pytest.approx(exact.bias, abs=1e-4)
    assert found.p50 == pytest.approx(exact.p50, abs=0.01 + 1e-9)
    assert found.p95 == pytest.approx(exact.p95, abs=0.01 + 1e-9)


def test_sums_of_residuals_conclude_what_the_residuals_do() -> None:
    rng = np.random.default_rng(2)
    residual = rng.normal(-0.1, 2, 30_000)
    parts = [sum_residuals(part) for part in (residual[:100], residual[100:100], residual[100:])]
    close(conclude(merge_residuals(parts)), summarise(residual))


def test_the_share_of_small_residuals_is_exact() -> None:
    residual = np.random.default_rng(4).normal(0, 0.4, 5000)
    sums = sum_residuals(residual)
    assert share_below(sums.absolute, 0.25) == np.mean(np.abs(residual) < 0.25)
    assert np.isnan(share_below(sum_residuals(np.empty(0)).absolute, 0.25))
    for value in (0.255, 0.0, 50.0, 51.0):
        with pytest.raises(ValueError, match="no border of bins"):
            share_below(sums.absolute, value)


def test_sums_of_residuals_are_order_free() -> None:
    residual = np.random.default_rng(3).normal(0, 9, 4000)
    parts = [sum_residuals(part) for part in np.array_split(np.sort(residual), 5)]
    one, other = sum_residuals(residual), merge_residuals(parts[::-1])
    assert (one.n, one.total, one.squares) == (other.n, other.total, other.squares)
    assert same(one.absolute, other.absolute)
    assert conclude(one) == conclude(other)


def test_squares_do_not_overflow() -> None:
    sums = sum_residuals(np.full(5000, -20_000.0))
    assert sums.squares == 5000 * (20_000 * 10_000) ** 2 > 2**63
    assert conclude(merge_residuals([sums] * 3)) == Residuals(15_000, 20_000.0, 20_000.0, 20_000.0, -20_000.0)


def test_no_residuals_are_nan() -> None:
    found = asdict(conclude(sum_residuals(np.empty(0))))
    assert found.pop("n") == 0
    assert np.isnan(list(found.values())).all()


def test_fidelity_of_tiles_is_that_of_the_region() -> None:
    bounds = (0.0, 0.0, 120.0, 120.0)
    blocks = random_blocks(bounds, 12, seed=3)
    city = city_of(blocks[:-2], [9.0] * 10)
    footprints = np.array(blocks[1:], object)
    rng = np.random.default_rng(4)
    xyz = rng.uniform((0, 0, -1), (120, 120, 14), (20_000, 3))
    cloud = PointCloud(xyz, rng.choice([BUILDING, GROUND, WATER], 20_000).astype(np.uint8))
    dtm = tilted_dtm(bounds, slope_x=0.01)

    model = index_model(city.polygons, city.roofs, footprints=footprints, box=bounds)

    def sums_of(own: NDArray[np.bool_]) -> FidelitySums:
        return sum_fidelity(cloud, dtm, model, building_class=True, among=own)

    tile = (xyz[:, 0] // 50 * 3 + xyz[:, 1] // 50).astype(int)
    merged = merge_fidelity([sums_of(tile == k) for k in rng.permutation(9)])
    exact = measure_fidelity(cloud, dtm, city.polygons, city.roofs, footprints=footprints, building_class=True)
    found = conclude_fidelity(merged)
    for kind in KINDS:
        assert getattr(exact, kind).n > 50
        close(getattr(found, kind), getattr(exact, kind))
    assert list(fidelity_table(found)) == list(fidelity_table(exact))
