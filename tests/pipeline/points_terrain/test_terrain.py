"""Step 1.3: bin means, filling, sampling, and the same bytes from any tiles."""

from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from pipeline.data.classes import BUILDING, GROUND, WATER
from pipeline.data.errors import InputError
from pipeline.data.pointcloud import PointCloud
from pipeline.points_terrain.las_points import UnitPoints
from pipeline.points_terrain.raster import (
    HEIGHT_UNIT,
    NodeWindow,
    cut_nodes,
    grow_window,
    join_dtm,
    measure_over,
    node_window,
    window_of,
)
from pipeline.points_terrain.terrain import (
    Dtm,
    bin_ground,
    bin_nodes,
    bin_units,
    compute_dtm,
    fill_dtm,
    sample_dtm,
)
from pipeline.points_terrain.terrain_fill import (
    COARSE,
    DEEPER,
    FILL_RINGS,
    RIM,
    FillCounts,
    coarse_terrain,
    coarsen,
    fill_terrain,
    flood_terrain,
    merge_coarse,
)
from tests.helpers.campaigns import examples
from tests.helpers.cities import tilted_dtm


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


@settings(max_examples=examples(50), deadline=None)
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
    xyz, among = np.column_stack((xy, xy[:, 0])), np.arange(len(xy)) % 3 > 0
    assert measure_over(cut, xyz, among).tobytes() == (sample_dtm(cut, xy) - xyz[:, 2])[among].tobytes()


def test_sampling_beyond_the_raster_takes_its_border() -> None:
    dtm = tilted_dtm((0.0, 0.0, 4.0, 4.0), slope_x=1.0)
    assert sample_dtm(dtm, np.array([[-3.0, 2.0], [9.0, 2.0]])).tolist() == [0.0, 4.0]


Box = tuple[float, float, float, float]
REGION: Box = (1000.4, -501.7, 1470.0, -120.3)


def tile_boxes(region: Box, size: float) -> Iterator[tuple[Box, tuple[bool, bool], tuple[bool, bool]]]:
    """Tiles of the region, aligned to multiples of their size, and which of their sides are its border."""
    lines = []
    for low, high in ((region[0], region[2]), (region[1], region[3])):
        inner = np.arange(np.floor(low / size) + 1, np.ceil(high / size)) * size
        lines.append([low, *inner.tolist(), high])
    for x0, x1 in zip(lines[0][:-1], lines[0][1:], strict=True):
        for y0, y1 in zip(lines[1][:-1], lines[1][1:], strict=True):
            yield (x0, y0, x1, y1), (x0 == region[0], y0 == region[1]), (x1 == region[2], y1 == region[3])


def tile_windows(region: Box, size: float, spacing: float) -> list[NodeWindow]:
    return [
        node_window(box, spacing, low_border=low, high_border=high) for box, low, high in tile_boxes(region, size)
    ]


@pytest.mark.parametrize(("size", "spacing"), [(77.3, 1.0), (90.0, 0.7), (0.4, 1.0), (100.0, 2.0), (1e4, 0.5)])
def test_every_node_belongs_to_one_tile(size: float, spacing: float) -> None:
    region = (1000.4, -501.7, 1010.0, -489.3) if size < 1 else REGION
    whole = node_window(region, spacing)
    owners = np.zeros((whole.ny, whole.nx), int)
    for window in tile_windows(region, size, spacing):
        assert grow_window(window, 0, within=whole) == window
        cut_nodes(owners, whole, window)[...] += 1
    assert (owners == 1).all()


def test_the_whole_region_has_the_nodes_just_outside() -> None:
    assert node_window((0.1, 2.0, 3.9, 4.0), 1.0) == NodeWindow(0, 2, 5, 3)
    with pytest.raises(ValueError, match="no nodes"):
        node_window((1.0, 0.0, 0.0, 1.0), 1.0)


def test_bins_of_tiles_are_those_of_the_region_from_points_half_a_spacing_beyond() -> None:
    rng = np.random.default_rng(5)
    spacing, n = 0.8, 40_000
    xyz = np.column_stack((rng.uniform(1000, 1100, n), rng.uniform(-80, 0, n), rng.uniform(0, 500, n).round(3)))
    xyz[::50, :2] = (np.rint(xyz[::50, :2] / spacing) + 0.5) * spacing  # between two nodes
    points = PointCloud(xyz, np.full(n, GROUND, np.uint8))
    region = (1000.0, -80.0, 1100.0, 0.0)
    whole, count = bin_ground(points, region, spacing=spacing)
    node = np.rint(xyz[:, :2] / spacing).astype(int) - (whole.i0, whole.j0)
    here = ((node >= 0) & (node < whole.z.shape[::-1])).all(axis=1)
    bins = node[here] @ [1, whole.z.shape[1]]
    assert np.bincount(bins, minlength=count.size).tolist() == count.ravel().tolist()
    heights = np.bincount(bins, np.rint(xyz[here, 2] / HEIGHT_UNIT), count.size).reshape(count.shape) * HEIGHT_UNIT
    means = heights[count > 0] / count[count > 0]
    np.testing.assert_array_equal(whole.z[count > 0], np.rint(means / HEIGHT_UNIT) * HEIGHT_UNIT)
    parts, n_points = [], 0
    for window in tile_windows(region, 33.3, spacing):
        low = (np.array([window.i0, window.j0]) - 0.5) * spacing - 1e-9
        high = low + np.array([window.nx, window.ny]) * spacing + 2e-9
        near = ((xyz[:, :2] >= low) & (xyz[:, :2] <= high)).all(axis=1)
        several = [PointCloud(xyz[near][k::3], points.classification[near][k::3]) for k in range(3)]
        part, found = bin_nodes(several, window, spacing=spacing)
        parts.append(part)
        n_points += int(found.sum())
    assert join_dtm(parts[::-1], window_of(whole)).z.tobytes() == whole.z.tobytes()
    assert n_points == count.sum()


def test_bins_of_units_are_those_of_points_within_the_box() -> None:
    rng = np.random.default_rng(3)
    n, scale, offset = 5000, (0.01, 0.01, 0.002), (100.0, -50.0, 7.0)
    units = rng.integers(0, 1500, (n, 3)).astype(np.int32)
    units[::7, :2] = units[::7, :2] // 50 * 50  # on the borders of the box, and between two nodes
    classes = rng.choice(np.array([GROUND, WATER, BUILDING], np.uint8), n)
    xyz = units * np.array(scale) + np.array(offset)
    box, window = (103.5, -46.5, 112.5, -39.5), NodeWindow(104, -46, 9, 7)
    within = ((xyz[:, :2] >= box[:2]) & (xyz[:, :2] <= box[2:])).all(axis=1)
    expected, count = bin_nodes([PointCloud(xyz[within], classes[within])], window, spacing=1.0)
    parts = [UnitPoints(units[k::3], scale, offset, classes[k::3]) for k in range(3)]
    assert bin_units(parts, box, window, spacing=1.0).z.tobytes() == expected.z.tobytes()
    smaller = (103.6, -46.5, 112.5, -39.5)
    assert bin_units(parts, smaller, window, spacing=1.0).z.tobytes() != expected.z.tobytes()
    assert count.all()
    assert np.isnan(bin_units([], box, window, spacing=1.0).z).all()


def raster_with_lakes(seed: int, nx: int, ny: int) -> Dtm:
    """Rough terrain with single empty nodes, a long gap, and lakes that are not flooded wholly."""
    rng = np.random.default_rng(seed)
    x, y = np.arange(nx), np.arange(ny)[:, None]
    z = (20 * np.sin(x / 90) * np.cos(y / 70) + rng.normal(0, 1, (ny, nx))).round(4)
    z[rng.random((ny, nx)) < 0.3] = np.nan
    for cx, cy, r in ((0.3, 0.35, 0.22), (1.0, 0.6, 0.25), (0.6, 0.9, 0.1), (0.75, 0.15, 0.07)):
        z[np.hypot(x - cx * nx, 1.3 * (y - cy * ny)) < r * nx] = np.nan
    z[ny // 2 : ny // 2 + 9, :] = np.nan
    return Dtm(z, 999, -502, 1.0)


def fill_by_tiles(raw: Dtm, windows: list[NodeWindow]) -> tuple[Dtm, FillCounts]:
    """Fill each tile from what it may read only, and join all."""
    region = window_of(raw)
    halos = [grow_window(window, FILL_RINGS, within=region) for window in windows]
    flooded = [flood_terrain(join_dtm([raw], h), w) for h, w in zip(halos, windows, strict=True)]
    coarse = coarse_terrain(merge_coarse([coarsen(part) for part in flooded[::-1]]))
    filled = [fill_terrain(part, coarse) for part in flooded]
    counts = FillCounts(sum(c.filled for _, c in filled), sum(c.coarse for _, c in filled))
    return join_dtm([dtm for dtm, _ in filled], region), counts


def test_heights_of_terrain_are_whole_numbers_of_their_unit() -> None:
    rng = np.random.default_rng(2)
    xyz = np.column_stack((rng.uniform(0, 400, (20_000, 2)), rng.uniform(0, 300, 20_000)))
    xyz = xyz[np.hypot(xyz[:, 0] - 200, xyz[:, 1] - 200) > 150]  # with a lake that takes the coarse level
    raw, _ = bin_ground(
        PointCloud(xyz, np.full(len(xyz), GROUND, np.uint8)), (0.0, 0.0, 400.0, 400.0), spacing=1.0
    )
    filled = fill_dtm(raw)
    assert (flood_terrain(raw, window_of(raw)).ring == DEEPER).any()
    for z in (raw.z[~np.isnan(raw.z)], filled.z):
        np.testing.assert_array_equal(z / HEIGHT_UNIT, np.rint(z / HEIGHT_UNIT))


@pytest.mark.parametrize(("seed", "size"), [(0, 150.0), (1, 97.3), (2, 311.9), (3, 41.0)])
def test_filling_by_tiles_gives_the_bytes_of_the_region(seed: int, size: float) -> None:
    raw = raster_with_lakes(seed, 700, 520)
    region = (999.0, -502.0, 999.0 + 699, -502.0 + 519)
    tiled, counts = fill_by_tiles(raw, tile_windows(region, size, 1.0))
    whole = fill_dtm(raw)
    assert not np.isnan(whole.z).any()
    assert tiled.z.tobytes() == whole.z.tobytes()
    flooded = flood_terrain(raw, window_of(raw))
    assert (flooded.ring == DEEPER).sum() > 5000
    assert counts == FillCounts(int(np.isnan(raw.z).sum()), int((flooded.ring > RIM).sum()))


def test_a_flooded_tile_depends_on_its_halo_only_and_needs_all_of_it() -> None:
    raw = raster_with_lakes(4, 700, 520)
    window = NodeWindow(raw.i0 + 150, raw.j0 + 120, 200, 180)
    whole = flood_terrain(raw, window_of(raw))
    expected = cut_nodes(whole.dtm.z, window_of(raw), window)
    ring = cut_nodes(whole.ring, window_of(raw), window)
    assert (ring == FILL_RINGS).any()
    equal = []
    for reach in (FILL_RINGS, FILL_RINGS // 3):
        halo = grow_window(window, reach, within=window_of(raw))
        part = flood_terrain(join_dtm([raw], halo), window)
        equal.append(part.dtm.z.tobytes() == expected.tobytes() and part.ring.tobytes() == ring.tobytes())
    assert equal == [True, False]


def flood_by_definition(z: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Fill rings one by one, each from what was known before it; ring -1 where none reaches."""
    z, ring = z.copy(), np.where(np.isnan(z), -1, 0)
    for r in range(1, FILL_RINGS + 1):
        known, before = ring >= 0, z.copy()
        for j, i in np.argwhere(~known).tolist():
            near = np.s_[max(j - 1, 0) : j + 2, max(i - 1, 0) : i + 2]
            if known[near].any():
                # In rows, one after the other: the order of a sum shows in its last bits.
                mean = sum(before[near][known[near]].tolist()) / np.count_nonzero(known[near])
                z[j, i] = round(mean / HEIGHT_UNIT) * HEIGHT_UNIT
                ring[j, i] = r
    return z, ring


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (9, 1), (2, 2), (2, 30), (3, 3), (24, 31)])
@pytest.mark.parametrize("share", [0.3, 0.9, 1.0])
def test_a_flood_is_what_its_definition_says_at_every_border(shape: tuple[int, int], share: float) -> None:
    rng = np.random.default_rng(1)
    z = rng.normal(0.0, 10.0, shape)
    z[rng.random(shape) < share] = np.nan
    expected, ring = flood_by_definition(z)
    raw = Dtm(z, 3, -4, 1.0)
    flooded = flood_terrain(raw, window_of(raw))
    assert flooded.dtm.z.tobytes() == expected.tobytes()
    assert flooded.ring.tolist() == np.where(ring < 0, DEEPER, ring).tolist()


def test_rings_count_nodes_along_the_larger_axis() -> None:
    z = np.full((4, FILL_RINGS + 4), np.nan)
    z[1, 0] = 2.0
    ring = flood_terrain(Dtm(z, 0, 0, 1.0), NodeWindow(0, 0, FILL_RINGS + 4, 4)).ring
    assert ring[:, :3].tolist() == [[1, 1, 2], [0, 1, 2], [1, 1, 2], [2, 2, 2]]
    assert ring[0, -5:].tolist() == [FILL_RINGS - 1, FILL_RINGS, DEEPER, DEEPER, DEEPER]


def test_the_coarse_level_is_the_mean_of_the_rim_by_hand() -> None:
    # A shore of 3 m on the left: rings 33 to 64 are rim; nodes 33 to 64 of the row. Coarse node 1 is node 64.
    z = np.full((1, 300), np.nan)
    z[0, 0] = 3.0
    raw = Dtm(z, 0, 0, 1.0)
    sums = coarsen(flood_terrain(raw, window_of(raw)))
    assert sums.node.tolist() == [[1, 0]]
    assert (sums.count.tolist(), sums.total.tolist(), sums.n_known) == ([32], [32 * 3 * 2**13], 1)
    coarse = coarse_terrain(sums)
    assert (coarse.i0, coarse.j0, coarse.spacing, coarse.z.tolist()) == (0, 0, COARSE, [[3.0] * 6])


def test_a_lake_is_as_flat_as_its_shore_and_its_hills_do_not_lift_it() -> None:
    x, y = np.arange(600), np.arange(500)[:, None]
    off_shore = np.hypot(x - 300, y - 250) - 200
    z = np.where(off_shore < 0, np.nan, 7.0 + 0.3 * np.maximum(off_shore - 3, 0))
    filled = fill_dtm(Dtm(z, 50, 17, 0.5))
    np.testing.assert_allclose(filled.z[off_shore < 0], 7.0, atol=1e-9)


def test_the_blend_has_no_step() -> None:
    # Shores of 0 m and 12 m, 500 nodes apart: the flood alone has a step of 12 m in the middle.
    z = np.full((3, 502), np.nan)
    z[:, 0], z[:, -1] = 0.0, 12.0
    row = fill_dtm(Dtm(z, 0, 0, 1.0)).z[1]
    assert np.abs(np.diff(row)).max() <= 12 / COARSE + 1e-9
    assert row[RIM] == 0.0
    assert row[501 - RIM] == 12.0


def test_the_blend_by_hand() -> None:
    # The flood is 0 m on the left and 12 m on the right, the mean of the rim 6 m. Ring 40 takes a quarter of it.
    z = np.full((1, 101), np.nan)
    z[0, 0], z[0, 100] = 0.0, 12.0
    row = fill_dtm(Dtm(z, 0, 0, 1.0)).z[0]
    assert row[[32, 40, 48, 50, 52, 60, 68]].tolist() == [0.0, 1.5, 3.0, 6.0, 9.0, 10.5, 12.0]


def test_a_tile_without_ground_takes_the_coarse_level_alone() -> None:
    raw = raster_with_lakes(0, 700, 520)
    window = NodeWindow(raw.i0 + 190, raw.j0 + 160, 30, 30)
    halo = join_dtm([raw], grow_window(window, FILL_RINGS, within=window_of(raw)))
    assert np.isnan(halo.z).all()
    flooded = flood_terrain(halo, window)
    assert coarsen(flooded).n_known == len(coarsen(flooded).node) == 0
    coarse = coarse_terrain(coarsen(flood_terrain(raw, window_of(raw))))
    dtm, counts = fill_terrain(flooded, coarse)
    assert counts == FillCounts(900, 900)
    x, y = np.meshgrid(window.i0 + np.arange(30.0), window.j0 + np.arange(30.0))
    expected = sample_dtm(coarse, np.column_stack((x.ravel(), y.ravel())))
    np.testing.assert_allclose(dtm.z.ravel(), expected, rtol=0, atol=0.51 * HEIGHT_UNIT)


def test_ground_away_from_large_lakes_leaves_the_coarse_level_alone() -> None:
    raw = raster_with_lakes(0, 700, 520)
    known = raw.z.copy()
    known[np.isnan(known)] = 0.0
    dry = coarsen(flood_terrain(Dtm(known, 0, 0, 1.0), NodeWindow(0, 0, 700, 520)))
    assert len(dry.node) == 0
    assert fill_dtm(Dtm(known, 0, 0, 1.0)).z.tobytes() == known.tobytes()


def test_a_region_without_ground_in_any_tile_is_an_error() -> None:
    empty = flood_terrain(Dtm(np.full((4, 5), np.nan), 0, 0, 1.0), NodeWindow(0, 0, 5, 4))
    none = flood_terrain(Dtm(np.full((4, 0), np.nan), 5, 0, 1.0), NodeWindow(5, 0, 0, 4))
    with pytest.raises(InputError, match="none of the 20 nodes"):
        coarse_terrain(merge_coarse([coarsen(none), coarsen(empty)]))


def test_joining_checks_its_parts() -> None:
    one = Dtm(np.array([[1.0, 2.0]]), 0, 0, 1.0)
    joined = join_dtm([one, Dtm(np.array([[2.0, 3.0]]), 1, 0, 1.0)], NodeWindow(-1, 0, 5, 1))
    np.testing.assert_array_equal(joined.z, [[np.nan, 1.0, 2.0, 3.0, np.nan]])
    hole = Dtm(np.array([[np.nan, 3.0]]), 1, 0, 1.0)
    assert join_dtm([one, hole], NodeWindow(0, 0, 3, 1)).z.tolist() == [[1.0, 2.0, 3.0]]
    with pytest.raises(ValueError, match="different heights"):
        join_dtm([one, Dtm(np.array([[2.5, 3.0]]), 1, 0, 1.0)], NodeWindow(0, 0, 3, 1))
    with pytest.raises(ValueError, match="spacings"):
        join_dtm([one, Dtm(one.z, 0, 0, 0.5)], NodeWindow(0, 0, 3, 1))


def test_windows_that_do_not_fit_are_refused() -> None:
    raw = raster_with_lakes(0, 300, 300)
    with pytest.raises(ValueError, match="not inside"):
        flood_terrain(raw, NodeWindow(raw.i0 - 1, raw.j0, 10, 10))
    flooded = flood_terrain(Dtm(np.full((9, 9), np.nan), 0, 0, 1.0), NodeWindow(0, 0, 9, 9))
    with pytest.raises(ValueError, match="not 64 times"):
        fill_terrain(flooded, Dtm(np.zeros((2, 2)), 0, 0, 1.0))
    with pytest.raises(ValueError, match="do not reach"):
        fill_terrain(flooded, Dtm(np.zeros((2, 1)), 0, 0, 64.0))
