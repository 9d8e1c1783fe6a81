"""Columns in parts: cuts where they are by hand, even shares, the same whatever the order."""

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.data.errors import ConfigError
from tests.helpers.hand_pieces import box_pieces
from tiler.export import bisection
from tiler.export.bisection import bisect_columns, column_centres, count_columns
from tiler.formats.openfoam import write_openfoam

Floats = NDArray[np.float64]


def grid(n: int = 40, seed: int = 3) -> Floats:
    """Columns on a grid of 1 m with 20 to 40 cells each."""
    cells = np.random.default_rng(seed).integers(20, 40, n * n).astype(np.float64)
    x, y = np.meshgrid(np.arange(float(n)), np.arange(float(n)))
    return np.column_stack([x.ravel(), y.ravel(), cells])


def shares(columns: Floats, n_parts: int) -> Floats:
    part = bisect_columns(columns, n_parts).part_of(columns[:, :2])
    return np.bincount(part, columns[:, 2], minlength=n_parts).astype(np.float64)


def test_a_column_is_one_whichever_vertex_its_cells_have_twice() -> None:
    # A prism in three tetrahedra: each has two of its vertices one above the other.
    plan = np.array([[0.0, 0.0], [3.0, 1.0], [1.0, 2.0]])
    points = np.vstack([np.column_stack([plan, np.full(3, z)]) for z in (0.0, 1.0)])
    cells = np.array([[0, 1, 2, 3], [1, 2, 3, 4], [2, 3, 4, 5]], np.int32)
    assert column_centres(points, cells).tolist() == [[1.5, 1.0]] * 3
    assert count_columns(points, cells).tolist() == [[1.5, 1.0, 3.0]]
    assert count_columns(points, cells[:0]).shape == (0, 3)


def test_cuts_by_hand() -> None:
    # Eight columns in a row of x, the last as heavy as the rest together; then two rows across the longer side.
    row = np.array([[x, 0.0, 1.0] for x in range(7)] + [[7.0, 0.0, 7.0]])
    assert bisect_columns(row, 2).part_of(row[:, :2]).tolist() == [0] * 7 + [1]
    across = row[:, [1, 0, 2]]
    assert bisect_columns(across, 2).part_of(across[:, :2]).tolist() == [0] * 7 + [1]
    assert bisect_columns(row, 1).part_of(row[:, :2]).tolist() == [0] * 8
    thirds = np.array([[x, 0.0, 1.0] for x in range(9)])
    assert bisect_columns(thirds, 3).part_of(thirds[:, :2]).tolist() == [0, 0, 0, 1, 1, 1, 2, 2, 2]


@pytest.mark.parametrize("n_parts", [2, 3, 4, 7, 16])
def test_parts_are_even_within_three_percent_and_compact(n_parts: int) -> None:
    columns = grid()
    load = shares(columns, n_parts)
    assert load.max() <= 1.03 * load.mean()
    part = bisect_columns(columns, n_parts).part_of(columns[:, :2])
    for number in range(n_parts):
        size = np.ptp(columns[part == number, :2], axis=0) + 1
        assert size.max() <= 3 * size.min() + 1


def test_neither_order_nor_chunks_nor_divided_rows_count(monkeypatch: pytest.MonkeyPatch) -> None:
    columns = grid()
    expected = bisect_columns(columns, 6).part_of(columns[:, :2])
    turned = np.random.default_rng(1).permutation(columns)
    halves = np.vstack([turned, turned])
    halves[:, 2] = np.concatenate([turned[:, 2] - 5, np.full(len(turned), 5.0)])
    monkeypatch.setattr(bisection, "CHUNK", 100)
    for rows in (turned, halves):
        assert np.array_equal(bisect_columns(rows, 6).part_of(columns[:, :2]), expected)


def test_coordinates_of_millions_are_cut_as_finely() -> None:
    columns = grid() + np.array([6.4e6, 5.0e5, 0.0])
    load = shares(columns, 16)
    assert load.max() <= 1.03 * load.mean()


def test_more_parts_than_columns_are_refused(tmp_path_factory: pytest.TempPathFactory) -> None:
    folder = tmp_path_factory.mktemp("parts")
    with pytest.raises(ConfigError, match=r"--parts 1000: the 48 cells stand in columns.*; give fewer parts"):
        write_openfoam(folder, box_pieces((1, 1)), parts=1000)
