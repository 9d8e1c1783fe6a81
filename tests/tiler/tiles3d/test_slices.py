"""Slices through the volume mesh: where they lie, what they measure, and what meets nothing."""

from pathlib import Path

import numpy as np
import pytest

from pipeline.data.errors import ConfigError
from tests.helpers.tilesets import contents, read_content, to_degrees
from tiler.export.export import export_run
from tiler.mesh_files.mesh_pieces import open_pieces
from tiler.tiles3d.slices import cut_cells, cut_pieces, make_slices


def test_cells_are_cut_in_three_and_four_corners() -> None:
    """Slices of a cube in five tetrahedra have the cube's section, whatever the plane."""
    cube = np.array([[x, y, z] for z in (0.0, 1) for y in (0.0, 1) for x in (0.0, 1)])
    cells = np.array([[0, 1, 2, 4], [3, 1, 7, 2], [5, 1, 4, 7], [6, 2, 7, 4], [1, 2, 4, 7]], np.int32)
    for normal, place, area in (
        ((0, 0, 1), 0.3, 1.0),
        ((1, 0, 0), 0.5, 1.0),
        ((1, 1, 0), 1.0, 2**0.5),
        ((1, 1, 1), 1.5, 1.299038),
    ):
        level = cube @ np.array(normal) - place + 1e-12
        corners, cell = cut_cells(cube, cells, level)
        a, b, c = (corners[:, k] for k in range(3))
        found = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
        assert found == pytest.approx(area, rel=1e-5)
        assert np.abs(corners @ np.array(normal) - place).max() < 1e-9
        assert set(cell.tolist()) <= set(range(5))


def test_slices_of_a_run(small_run: Path, tmp_path: Path) -> None:
    pieces = open_pieces(small_run)
    west, south = np.array([pieces.read(k).points[:, :2].min(axis=0) for k in range(4)]).min(axis=0).tolist()
    x, y = west + 130.0, south + 60.0
    line = f"{x},{y},{x + 100},{y + 50}"
    given = {"slice_height": [12.0], "slice_line": [line]}
    export_run(small_run, tmp_path / "tiles", name="3dtiles", options=given)
    parts = [read_content(path)[1] for _, path in contents(tmp_path / "tiles")]
    found = [part["cells"] for part in parts if "cells" in part]
    wanted = np.concatenate(list(cut_pieces(pieces, make_slices([12.0], [line]))))
    n = sum(len(part.table["quality"]) for part in found)
    assert n == len(wanted) > 1000
    heights = np.concatenate([to_degrees(part.places)[:, 2] for part in found])
    assert np.allclose(np.sort(heights), np.sort(wanted[:, :9].reshape(-1, 3)[:, 2]), atol=1e-3)
    quality = np.concatenate([np.array(part.table["quality"]) for part in found])
    assert 0 < quality.min() < quality.max() <= 1
    # The upright one ends where its line ends, and is as long as that.
    upright = np.concatenate(list(cut_pieces(pieces, make_slices([], [line]))))[:, :9].reshape(-1, 3)
    along = ((upright[:, :2] - (x, y)) * (100, 50)).sum(axis=1) / (100**2 + 50**2)
    assert along.min() == pytest.approx(0, abs=0.15)
    assert along.max() == pytest.approx(1, abs=0.15)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"slice_height": [-1.0]}, "--slice-height -1 m: more than 0 expected"),
        ({"slice_line": ["1,2,3"]}, "four numbers X0,Y0,X1,Y1 expected"),
        ({"slice_line": ["1,2,1,2"]}, "two different places"),
        ({"slice_line": ["1,2,3,4"]}, "--slice-line 1,2,3,4: meets no cell of the mesh"),
    ],
)
def test_wrong_slices_are_refused(
    small_run: Path, tmp_path: Path, given: dict[str, list[float]], said: str
) -> None:
    with pytest.raises(ConfigError, match=said):
        export_run(small_run, tmp_path / "tiles", name="3dtiles", options=given)
    assert not list(tmp_path.iterdir())
