"""Pieces of tiles and graphs of cells, by examples whose answers are found by hand."""

from typing import Any

import numpy as np
import pytest
import shapely

from pipeline.generalisation.aggregation import find_adjacent, merge_outlines
from pipeline.generalisation.barriers import deal_segments, explode_lines, split_at_grid
from pipeline.generalisation.cell_graph import SmallCells
from pipeline.generalisation.measures import count_faces
from pipeline.generalisation.partition import EAST, find_borders, match_sides, partition_tile
from pipeline.generalisation.street_axis import find_street_axis


def test_a_segment_is_cut_at_the_same_places_from_both_ends() -> None:
    lines = shapely.linestrings([[[3.0, 1], [27.3, 19.7]], [[27.3, 19.7], [3.0, 1]], [[10.0, 2], [10, 8]]])
    one, other, along = (split_at_grid(explode_lines(line), 10.0) for line in lines)
    np.testing.assert_array_equal(one, other)
    assert {tuple(row) for row in one[:, [0, 2]].tolist()} >= {(3.0, 10.0)}  # cut at x = 10
    assert set(deal_segments(along, 10.0)) == {(0, 0), (1, 0)}  # on a border: both sides have it


def test_a_tile_is_parted_by_what_crosses_it_and_tells_its_borders() -> None:
    """A square of 10 m with a line at y = 4, a dead end, and a rim that leaves out its north."""
    rim = shapely.box(-5, -5, 15, 8)
    lines = shapely.linestrings([[[-1.0, 4], [11, 4]], [[5, 4], [5, 7]], [[10, 4], [10, 6]]])
    segments = split_at_grid(explode_lines(np.append(lines, rim)), 10.0)
    segments = deal_segments(segments, 10.0)[0, 0]
    pieces = partition_tile(segments, (0.0, 0.0, 10.0, 10.0), rim)
    assert shapely.area(pieces).tolist() == [40.0, 40.0]
    borders = find_borders(pieces, segments, (0.0, 0.0, 10.0, 10.0))
    assert (borders.pairs.tolist(), borders.length.tolist()) == ([[0, 1]], [10.0])
    east = borders.side == EAST
    told = [part[east].tolist() for part in (borders.piece, borders.low, borders.high, borders.barrier)]
    assert sorted(zip(*told, strict=True)) == [(0, 0.0, 4.0, False), (1, 4.0, 6.0, True), (1, 6.0, 8.0, False)]


def test_pieces_of_two_tiles_meet_along_what_both_have() -> None:
    one = np.array([7, 8]), np.array([0.0, 5]), np.array([5.0, 9])
    other = np.array([3, 4]), np.array([2.0, 6]), np.array([6.0, 12])
    met, shared = match_sides(one, other)
    assert (met.tolist(), shared.tolist()) == ([[7, 3], [8, 3], [8, 4]], [3.0, 1.0, 3.0])
    empty = np.empty(0, np.int64), np.empty(0), np.empty(0)
    assert len(match_sides(one, empty)[0]) == len(match_sides(empty, empty)[0]) == 0


def join(area: Any, pairs: Any, length: Any, limit: float, *, step: int = 0, **how: bool) -> tuple[list[int], int]:
    """Name of each cell, where so many are given at once, and the most in memory after that; NaN is no cell."""
    graph, log, most = SmallCells(limit, **how), [], 0
    for part in np.split(np.arange(len(area)), range(step, len(area), step) if step else []):
        known, mine = part[~np.isnan(area[part])], np.isin(pairs[:, 0], part)
        graph.add(known, area[known], pairs[mine], length[mine])
        log += graph.join(int(part[-1]) + 1)
        most = max(most, len(graph.size))
    names: dict[int, int] = {}
    for one, other in reversed(log):
        names[one] = names.get(other, other)
    return [names.get(k, k) for k in range(len(area))], most


def test_fragments_go_to_the_longest_border_and_grow() -> None:
    area = np.array([3.0, 4, 50, 60])
    pairs, length = np.array([[0, 1], [0, 3], [1, 2], [1, 3]]), np.array([5.0, 2, 2, 1])
    # 0 goes to 1, which then has the same border with 2 as 1 + 2 with 3: 3 is the longer one.
    assert join(area, pairs, length, 10.0)[0] == [0, 0, 2, 0]
    assert join(area, pairs, length, 3.0)[0] == [0, 1, 2, 3]  # not below the limit


def test_cells_are_aggregated_up_to_a_limit_among_their_kind() -> None:
    area = np.array([10.0, 10, 10, np.nan, 10])
    pairs, length = np.array([[0, 1], [1, 2], [2, 3], [3, 4]]), np.array([1.0, 2, 9, 9])
    assert join(area, pairs, length, 10.0, alike=True)[0] == [0, 0, 2, 3, 4]
    assert join(area, pairs, length, 20.0, alike=True)[0] == [0, 0, 0, 3, 4]


@pytest.mark.parametrize("alike", [False, True])
def test_cells_by_columns_are_joined_as_those_of_the_whole_region(alike: bool) -> None:
    """A grid of 12 by 60 cells with few different areas and borders, and a cell beside some columns."""
    rng = np.random.default_rng(45)
    k = np.arange(720).reshape(60, 12)
    sides = (k[:-1], k[1:]), (k[:, :-1], k[:, 1:]), (np.full(20, 5), k[10:30, 7])
    pairs = np.concatenate([np.column_stack((one.ravel(), other.ravel())) for one, other in sides])
    for _ in range(3):
        area, length = rng.integers(1, 9, 720).astype(float), rng.integers(1, 4, len(pairs)).astype(float)
        if alike:
            area[rng.random(720) < 0.2] = np.nan
        whole, _ = join(area, pairs, length, 6.0, alike=alike)
        assert len(set(whole)) < 600
        for step in (12, 36, 100):
            names, most = join(area, pairs, length, 6.0, step=step, alike=alike)
            assert names == whole
            assert most < 400


def test_adjacent_buildings_of_a_cell_are_one_and_a_gap_is_closed() -> None:
    boxes = np.array([shapely.box(0, 0, 4, 4), shapely.box(4, 0, 8, 4), shapely.box(8.08, 0, 9, 4)])
    rows = np.append(boxes, [shapely.box(9, 0, 12, 4), shapely.box(4, 4, 8, 6)])
    landmark = np.array([False, False, False, False, True])
    assert find_adjacent(rows, np.array([1, 1, 1, 2, 1]), landmark, 0.1).tolist() == [0, 0, 0, 3, 4]
    merged = merge_outlines(boxes, 0.1)
    assert (merged.geom_type, merged.area) == ("Polygon", pytest.approx(36.0, abs=1e-6))
    assert count_faces(np.array([merged])).tolist() == [6]
    assert merge_outlines(boxes[:1], 0.1) is boxes[0]


def test_the_axis_of_a_street_is_in_its_middle_and_goes_into_no_courtyard() -> None:
    """Two rows along a street of 10 m; one has a courtyard, whose own axis parts nothing."""
    court = shapely.box(0, 0, 60, 30).difference(shapely.box(10, 10, 50, 20))
    outlines, block = np.array([court, shapely.box(0, 40, 60, 70)]), np.array([0, 1])
    segments = find_street_axis(outlines, block, (-50.0, -50.0, 110.0, 120.0))
    along = (segments[:, 0] > 0) & (segments[:, 2] < 60)
    assert np.ptp(segments[along][:, [0, 2]]) > 55
    np.testing.assert_allclose(segments[along][:, [1, 3]], 35.0, atol=0.01)
    assert len(find_street_axis(outlines[:1], block[:1], (0.0, 0.0, 9.0, 9.0))) == 0
