"""The notebooks: committed without outputs, and run from their first cell to their last."""

import base64
import re
import struct
from pathlib import Path
from typing import Any

import nbformat
import pytest

NOTEBOOKS = sorted((Path(__file__).resolve().parents[1] / "notebooks").glob("*.ipynb"))


def read_notebook(path: Path) -> Any:
    return nbformat.read(path, as_version=4)  # type: ignore[no-untyped-call]


def run_notebook(path: Path, folder: Path) -> tuple[str, list[bytes]]:
    """Run all cells in a folder; returns what they print, and their pictures."""
    from nbclient import NotebookClient

    notebook = read_notebook(path)
    client = NotebookClient(notebook, timeout=900, resources={"metadata": {"path": str(folder)}})
    client.execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    said = "".join(output["text"] for output in outputs if output.get("name") == "stdout")
    pictures = [output["data"]["image/png"] for output in outputs if "image/png" in output.get("data", {})]
    return said, [base64.b64decode(picture) for picture in pictures]


def test_there_are_notebooks() -> None:
    assert [path.name for path in NOTEBOOKS] == ["first_poisson.ipynb"]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebooks_are_committed_without_outputs(path: Path) -> None:
    notebook = read_notebook(path)
    nbformat.validate(notebook)
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert cells
    assert all(cell.outputs == [] and cell.execution_count is None for cell in cells)


@pytest.mark.long
@pytest.mark.timeout(1200)
def test_first_poisson_runs_and_draws(tmp_path: Path) -> None:
    said, pictures = run_notebook(NOTEBOOKS[0], tmp_path)
    assert "4 tiles," in said
    assert "everything is proved" in said
    fixed = re.search(r"(\d+) unknowns, (\d+) of them fixed, u between 0 and", said)
    assert fixed
    assert 0 < int(fixed[2]) < int(fixed[1])
    assert (tmp_path / "first_poisson" / "out" / "run.json").is_file()
    (picture,) = pictures
    width, height = struct.unpack(">II", picture[16:24])
    assert picture.startswith(b"\x89PNG")
    assert min(width, height) > 300
    assert len(picture) > 20_000  # not one colour
