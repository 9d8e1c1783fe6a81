"""The notebooks: committed without outputs, and run from their first cell to their last."""

import base64
import re
import struct
from pathlib import Path
from typing import Any

import nbformat
import pytest

import tiler

FOLDER = Path(__file__).resolve().parents[2] / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
NAMES = ["cluster", "first_mesh", "first_poisson", "own_data", "own_stage", "seams"]


def read_notebook(path: Path) -> Any:
    return nbformat.read(path, as_version=4)  # type: ignore[no-untyped-call]


def run_notebook(name: str, folder: Path) -> tuple[str, list[bytes], str]:
    """Run all cells in a folder; returns what they print, their pictures, and the HTML that they show."""
    from nbclient import NotebookClient

    notebook = read_notebook(FOLDER / f"{name}.ipynb")
    client = NotebookClient(notebook, timeout=900, resources={"metadata": {"path": str(folder)}})
    client.execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    complaints = "".join(output["text"] for output in outputs if output.get("name") == "stderr").splitlines()
    # Dask tells of workers that are slow to end, on a machine that is busy.
    assert [line for line in complaints if " - distributed." not in line] == []
    said = "".join(output["text"] for output in outputs if output.get("name") == "stdout")
    data = [output.get("data", {}) for output in outputs]
    pictures = [base64.b64decode(shown["image/png"]) for shown in data if "image/png" in shown]
    for picture in pictures:
        width, height = struct.unpack(">II", picture[16:24])
        assert picture.startswith(b"\x89PNG")
        assert min(width, height) >= 250
        assert len(picture) > 8_000  # not one colour
    return said, pictures, "".join(shown["text/html"] for shown in data if "text/html" in shown)


def test_there_are_notebooks() -> None:
    assert [path.stem for path in NOTEBOOKS] == NAMES


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
    said, pictures, _ = run_notebook("first_poisson", tmp_path)
    assert "4 tiles," in said
    assert "everything is proved" in said
    fixed = re.search(r"(\d+) unknowns, (\d+) of them fixed, u between 0 and", said)
    assert fixed
    assert 0 < int(fixed[2]) < int(fixed[1])
    patch = re.search(r"CPU: (\d+) unknowns, a linear field is off by (\S+) of its range", said)
    assert patch
    assert 0 < int(patch[1]) < int(fixed[1])
    assert float(patch[2]) < 1e-9
    assert (tmp_path / "first_poisson" / "out" / "run.json").is_file()
    assert len(pictures) == 1


@pytest.mark.long
@pytest.mark.timeout(1200)
def test_first_mesh(tmp_path: Path) -> None:
    said, pictures, shown = run_notebook("first_mesh", tmp_path)
    city = tiler.open(tmp_path / "first_mesh" / "out")
    counts, quality = city.record["counts"], city.record["quality"]["radius_ratio"]
    assert "everything is proved" in said
    assert len(re.findall(r"^tile \d+_\d+: ", said, flags=re.MULTILINE)) == len(city) == 4
    ratio = re.search(r"radius ratio: worst (\S+), median (\S+)$", said, flags=re.MULTILINE)
    assert ratio
    assert float(ratio[1]) == pytest.approx(quality["0"], abs=2e-3)
    assert float(ratio[2]) == pytest.approx(quality["50"], abs=2e-3)
    assert f"{counts['building parts']} building parts, " in said
    assert 'src="data:image/jpeg;base64,' in shown
    assert f"<td>{counts['cells']:,}</td>" in shown
    tasks = city.record["tasks"]["all"]
    assert f'<progress value="{tasks}" max="{tasks}" aria-label="all tasks">' in shown
    assert len(pictures) == 2
    assert (tmp_path / "first_mesh" / "case" / "processor1").is_dir()
    assert (tmp_path / "first_mesh" / "city.h5").is_file()


@pytest.mark.long
@pytest.mark.shared
@pytest.mark.timeout(1200)
def test_own_data(tmp_path: Path, shared_data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CITYSTITCH_DATA", str(shared_data))
    said, pictures, shown = run_notebook("own_data", tmp_path)
    city = tiler.open(tmp_path / "own_data" / "out")
    assert "everything is proved" in said
    assert city.crs == "EPSG:28992"
    for kind, group in city.record["notes"].items():
        assert re.search(rf"^ *{group['count']}  {kind}: ", said, flags=re.MULTILINE)
    houses = len({building.house for building in city.buildings()})
    assert f"{houses} houses, {city.record['counts']['building parts']} parts" in said
    assert houses > 300
    assert 'src="data:image/jpeg;base64,' in shown
    assert len(pictures) == 1


@pytest.mark.long
@pytest.mark.timeout(1200)
def test_own_stage(tmp_path: Path) -> None:
    said, pictures, _ = run_notebook("own_stage", tmp_path)
    assert "4 tiles of canopy" in said
    assert "(200, 200) cells, 0 without a value" in said
    assert "tiles, the same heights: True" in said
    assert "ran again: {'canopy': 4}" in said
    assert len(pictures) == 1


def test_the_stage_is_that_of_the_guide() -> None:
    guide = (FOLDER.parent / "docs" / "stages.md").read_text().split("```python\n")[1].split("```")[0]
    (cell,) = (cell for cell in read_notebook(FOLDER / "own_stage.ipynb").cells if "%%writefile" in cell.source)
    assert cell.source.split("\n", 1)[1].strip() == guide.strip()


@pytest.mark.long
@pytest.mark.timeout(1200)
def test_cluster(tmp_path: Path) -> None:
    said, pictures, _ = run_notebook("cluster", tmp_path)
    city, alone = (tiler.open(tmp_path / "cluster" / name) for name in ("out", "alone"))
    assert "2 workers at tcp" in said
    assert f"{repr(city).split(': ')[1]}\n" in said
    assert city.record["parameters"]["scheduler"].startswith("tcp://")
    assert (len(city), city.record["tasks"]) == (16, alone.record["tasks"])
    assert "34 files, the same bytes: True" in said
    assert len(pictures) == 1


@pytest.mark.long
@pytest.mark.timeout(1200)
def test_seams(tmp_path: Path) -> None:
    said, pictures, _ = run_notebook("seams", tmp_path)
    faces = re.search(r"(\d+) faces on one side, (\d+) on the other", said)
    assert faces
    assert faces[1] == faces[2]
    city = tiler.open(tmp_path / "seams" / "out")
    assert f"{city.record['counts']['seam faces']} faces on seams" in said
    assert 100 < int(faces[1]) < city.record["counts"]["seam faces"]
    assert "the same faces, the same bytes: True" in said
    assert len(pictures) == 3
