"""An export takes few bytes for a cell of the largest piece: what it makes of a piece, it makes by blocks."""

import tracemalloc
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.helpers.hand_pieces import HandPieces, box_pieces
from tiler.export import region_faces
from tiler.formats import msh
from tiler.formats.openfoam import write_openfoam

BLOCK = 2**10
Export = Callable[[Path, HandPieces], object]


@pytest.fixture(scope="module")
def block() -> HandPieces:
    """One tile of 162,000 cells."""
    return box_pieces((1, 1), cubes=30)


def _openfoam(folder: Path, pieces: HandPieces) -> None:
    folder.mkdir()
    write_openfoam(folder, pieces)


def _parts(folder: Path, pieces: HandPieces) -> None:
    folder.mkdir()
    write_openfoam(folder, pieces, parts=1)


# The faces of all cells alone are 40 bytes a cell.
@pytest.mark.long
@pytest.mark.parametrize(
    ("export", "most"),
    [
        pytest.param(_openfoam, 80, id="openfoam"),
        pytest.param(_parts, 80, id="openfoam in parts"),
        pytest.param(msh.export_msh, 45, id="msh"),
        pytest.param(msh.export_msh2, 45, id="msh2"),
    ],
)
def test_export_takes_few_bytes_a_cell(
    block: HandPieces, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, export: Export, most: int
) -> None:
    monkeypatch.setattr(region_faces, "BLOCK_CELLS", BLOCK)
    monkeypatch.setattr("tiler.export.pieces.ROWS", BLOCK)
    small = box_pieces((1, 1))
    pieces = small
    monkeypatch.setattr(msh, "open_pieces", lambda _: pieces)
    export(tmp_path / "small", small)  # what is imported and compiled is no memory of the pieces

    pieces = block
    tracemalloc.start()
    try:
        export(tmp_path / "block", block)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak / len(block.read(0).cells) < most
