"""The Python interface: what `import tiler` gives, and that it does what the commands do."""

import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import shapely

import tiler
from pipeline.data.errors import ConfigError, InputError
from tiler.citymodels.building_index import index_buildings
from tiler.cli.main import main
from tiler.interface.city_mesh import CityMesh
from tiler.interface.notebook_progress import NotebookProgress, in_notebook
from tiler.monitoring.watchers import Watchers
from tiler.pictures.render import render_run

ROOT = Path(__file__).resolve().parents[3]
HEAVY = ("numpy", "dask", "distributed", "shapely", "zarr", "numba", "rich", "IPython", "pyvista")


@pytest.fixture
def city(small_run: Path) -> CityMesh:
    return tiler.open(small_run)


@pytest.mark.parametrize(
    "command",
    [
        "import tiler; tiler.CityError",
        "import tiler.interface.api",
        "from tiler.cli.main import make_parser; make_parser()",
    ],
)
def test_the_import_is_light(command: str) -> None:
    code = f"{command}; import sys; print(*(name for name in {HEAVY} if name in sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "\n"


def test_no_module_takes_the_place_of_a_function() -> None:
    """Importing the module would set it as the package's attribute."""
    modules = {path.stem for path in (ROOT / "tiler").iterdir()}
    assert not modules & set(tiler.__all__)
    assert {name: getattr(tiler, name).__module__.split(".")[0] for name in tiler.__all__} == {
        name: "pipeline" if name == "CityError" else "tiler" for name in tiler.__all__
    }
    assert set(tiler.__all__) <= set(dir(tiler))
    with pytest.raises(AttributeError, match="has no attribute 'walk'"):
        tiler.walk  # noqa: B018


def test_a_mesh_from_python_is_that_of_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = tiler.write_city(tmp_path / "city", size=160, buildings=4, density=0.5, seed=3)
    city = tiler.mesh(files.clouds[0].parent / "*.laz", files.footprints, out=tmp_path / "a", domain_height=60)
    said = capsys.readouterr().out
    assert re.search(r"mesh +1 task +\d", said)
    assert "tasks ran" in said
    words = ["run", str(files.clouds[0]), "--footprints", str(files.footprints), "--domain-height", "60"]
    assert main([*words, "--out", str(tmp_path / "b")]) == 0
    for name in (f"mesh/{city.tiles[0]}.vtu", f"boundary/{city.tiles[0]}.vtp", "citymodel.city.json"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    capsys.readouterr()
    again = tiler.mesh(tmp_path / "a" / "config.toml", progress=False)
    assert capsys.readouterr().out == ""
    assert (again.folder, again.record["tasks"]["ran"]) == (tmp_path / "a", 0)


def test_arguments_that_are_no_parameters() -> None:
    with pytest.raises(TypeError, match="unknown parameter 'mesh_siz'; did you mean mesh_size"):
        tiler.mesh("a.laz", mesh_siz=5)
    with pytest.raises(TypeError, match="unknown parameter 'zzzzz'; citystitch config lists all"):
        tiler.plan("a.laz", zzzzz=5)
    with pytest.raises(ConfigError, match="mesh_size = 0 m: must be at least"):
        tiler.mesh("a.laz", mesh_size=0)
    with pytest.raises(InputError, match="run citystitch first"):
        tiler.open("nowhere")


@pytest.mark.parametrize(("guard", "refused"), [("", True), ('if __name__ == "__main__":\n    ', False)])
def test_a_script_that_its_workers_would_run_is_refused(tmp_path: Path, guard: str, refused: bool) -> None:
    script = tmp_path / "script.py"
    script.write_text(f"import tiler\n{guard}tiler.mesh('nowhere.laz', workers=2)\n")
    done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, check=False, cwd=tmp_path)
    found = done.stderr.splitlines()[-1]
    assert ("workers = 2: each imports" in found) == refused
    assert ("nowhere.laz" in found) != refused


def test_tiles_are_read_as_arrays(city: CityMesh) -> None:
    assert len(city) == len(city.tiles) == 4
    pieces = list(city)
    assert [piece.name for piece in pieces] == list(city.tiles)
    assert sum(len(piece.cells) for piece in pieces) == city.record["counts"]["cells"]
    assert city.read(city.tiles[2]).points.tobytes() == pieces[2].points.tobytes()
    low, high = np.array(city.bounds[:2]), np.array(city.bounds[2:])
    assert all((piece.points[:, :2] >= low).all() and (piece.points[:, :2] <= high).all() for piece in pieces)
    assert (city.crs, city.missing, city.failed) == ("EPSG:3006", {}, {})
    with pytest.raises(ValueError, match="no tile 'x'; there are 4: "):
        city.read("x")


def test_the_whole_mesh_is_put_together(city: CityMesh) -> None:
    mesh = city.to_meshio()
    counts = city.record["counts"]
    tetra, facets = mesh.cells_dict["tetra"], mesh.cells_dict["triangle"]
    assert (len(mesh.points), len(tetra), len(facets)) == (counts["points"], counts["cells"], counts["facets"])
    edges = mesh.points[tetra[:, 1:]] - mesh.points[tetra[:, :1]]
    volumes = np.linalg.det(edges) / 6
    assert volumes.min() > 0
    assert volumes.sum() == pytest.approx(city.check().facts["volume"], rel=1e-9)
    # Stitched: what one cell alone has is the boundary, no seam is left open.
    faces = np.sort(np.concatenate([np.delete(tetra, k, axis=1) for k in range(4)]), axis=1)
    faces, times = np.unique(faces, axis=0, return_counts=True)
    assert np.array_equal(faces[times == 1], np.unique(np.sort(facets, axis=1), axis=0))
    marker = mesh.cell_data_dict["marker"]
    assert np.unique(marker["tetra"]).tolist() == [0]
    assert np.unique(marker["triangle"]).tolist() == list(range(1, 9))
    walls = np.isin(marker["triangle"], (2, 3))
    assert np.array_equal(mesh.cell_data_dict["building"]["triangle"] >= 0, walls)
    with pytest.raises(ConfigError, match=rf"{counts['cells']:,} cells > 1,000 of one mesh in memory"):
        city.to_meshio(most_cells=1000)


def test_buildings_are_those_of_the_city_model(city: CityMesh) -> None:
    found = sorted(city.buildings(), key=lambda building: building.number)
    with index_buildings(city.folder / "citymodel.city.json") as index:
        expected = index.take(np.arange(len(index)))
    assert [building.number for building in found] == expected.numbers.tolist()
    assert [building.roof for building in found] == expected.roof.tolist()
    assert [building.ground for building in found] == expected.ground.tolist()
    assert shapely.equals(np.array([building.footprint for building in found]), expected.footprints).all()
    on_walls = np.unique(np.concatenate([piece.building for piece in city]))
    assert set(on_walls.tolist()) - {-1} == set(expected.numbers.tolist())
    assert all(building.house == building.id or "parts" not in building.attributes for building in found)


def test_files_for_other_programs(city: CityMesh, tmp_path: Path) -> None:
    path = city.export("stl", tmp_path / "x.stl")
    assert path.read_text().startswith("solid")
    with pytest.raises(ConfigError, match="exists"):
        city.export("stl", path)
    with pytest.raises(ConfigError, match="--parts: format stl does not take it"):
        city.export("stl", path, overwrite=True, parts=2)


def test_it_shows_itself(city: CityMesh, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = []

    def draw(directory: Path, output: Path, **options: Any) -> None:
        drawn.append(options)
        render_run(directory, output, **options | {"size": (64, 40)})

    monkeypatch.setattr("tiler.pictures.render.render_run", draw)
    cells = f"{city.record['counts']['cells']:,} cells"
    assert repr(city) == (
        f"CityMesh({str(city.folder)!r}): {cells}, {city.record['counts']['points']:,} points, "
        f"{city.record['counts']['buildings']} buildings, 4 tiles"
    )
    page = city._repr_html_()
    assert 'src="data:image/jpeg;base64,/9j/' in page
    assert f"<td>{city.record['counts']['cells']:,}</td>" in page
    assert city._repr_html_() == page
    assert len(drawn) == 1  # kept
    picture = city.render("tiles", city_picture := city.folder.parent / "tiles.png")
    assert picture._repr_png_() == picture.png == city_picture.read_bytes()
    assert picture.png.startswith(b"\x89PNG")


def test_it_says_why_there_is_no_picture(city: CityMesh, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyvista", None)
    page = city._repr_html_()
    assert "<p>No picture: pictures need pyvista: pip install citystitch[pictures]</p>" in page
    assert "<img" not in page
    assert "radius ratio" in page
    monkeypatch.setattr("tiler.interface.city_mesh.MOST_SHOWN", 10)
    assert "facets &gt; 10 that are drawn unasked" in tiler.open(city.folder)._repr_html_()


def test_what_is_missing_is_shown(city: CityMesh) -> None:
    city.record["missing"] = {"3_4": {"reason": "<b>disk</b> full"}}
    city.record["set_aside"] = [{"stage": "canopy", "name": "3_5", "reason": "KeyError"}]
    assert repr(city).endswith("1 tiles missing, 1 items failed")
    assert city.missing == {"3_4": "<b>disk</b> full"}
    assert "tile 3_4: &lt;b&gt;disk&lt;/b&gt; full" in "".join(f"{title}" + cell for title, cell in rows(city))
    assert city.failed == {"canopy 3_5": "KeyError"}


def rows(city: CityMesh) -> list[tuple[str, str]]:
    """Rows of the table that a notebook shows, as it is written."""
    city._draw = lambda: ""  # type: ignore[method-assign]
    return re.findall("<tr><th>(.*?)</th><td>(.*?)</td></tr>", city._repr_html_())


def test_a_plan_is_that_of_the_command(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    files = tiler.write_city(tmp_path / "city", size=300, buildings=4, density=0.5)
    with monkeypatch.context() as patch:
        patch.setenv("FORCE_COLOR", "1")
        plan = tiler.plan(files.clouds, files.footprints, tile_size=150)
    assert capsys.readouterr().out == ""
    assert main(["plan", str(files.clouds[0]), "--footprints", str(files.footprints), "--tile-size", "150"]) == 0
    assert [line.split() for line in repr(plan).splitlines()] == [
        line.split() for line in capsys.readouterr().out.splitlines()
    ]
    assert "\x1b" not in repr(plan)
    assert plan.facts["tiles"]["present"] == 4
    picture = plan.picture()
    assert picture._repr_svg_() == picture.svg
    assert picture.save(tmp_path / "plan.svg").read_text() == picture.svg
    assert picture.svg.startswith("<svg")


@pytest.mark.long
def test_code_of_the_guide_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """All Python blocks of docs/python.md, one after the other."""
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "python.md").read_text(), flags=re.DOTALL)
    assert len(blocks) == 7
    names: dict[str, Any] = {}
    for block in blocks:
        exec(compile(block, "docs/python.md", "exec"), names)
    assert len(list(names["city"].buildings())) >= 10
    assert {path.name for path in tmp_path.iterdir()} >= {"city.png", "tiles.png", "city.xdmf", "case", "out"}


def test_code_of_the_readme_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), flags=re.DOTALL)
    (block,) = (block for block in blocks if "import tiler" in block)
    assert len([line for line in block.splitlines() if line]) <= 5
    files = tiler.write_city(tmp_path / "city", size=160, buildings=4, density=0.5, seed=3)
    (tmp_path / "tiles").symlink_to(files.clouds[0].parent)
    (tmp_path / "buildings.gpkg").symlink_to(files.footprints)
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    exec(compile(block, "README.md", "exec"), names)
    assert tiler.open(tmp_path / "out").tiles == names["city"].tiles


class Display:
    """Stands for a notebook's output."""

    def __init__(self) -> None:
        self.pages: list[dict[str, str]] = []

    def __call__(self, data: dict[str, str], *, raw: bool, display_id: bool) -> "Display":
        assert raw
        assert display_id
        self.pages.append(data)
        return self

    def update(self, data: dict[str, str], *, raw: bool) -> None:
        assert raw
        self.pages.append(data)


@pytest.fixture
def output(monkeypatch: pytest.MonkeyPatch) -> Display:
    output = Display()
    monkeypatch.setattr("IPython.display.display", output)
    monkeypatch.setattr("tiler.interface.notebook_progress.EVERY", 0.0)
    return output


def test_a_notebook_shows_how_far_it_is(tmp_path: Path, output: Display, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tiler.interface.notebook_progress.in_notebook", lambda: True)
    files = tiler.write_city(tmp_path / "city", size=160, buildings=4, density=0.5, seed=3)
    city = tiler.mesh(files.clouds, files.footprints, out=tmp_path / "out", domain_height=60)
    n = city.record["tasks"]["all"]
    lines = [page["text/plain"] for page in output.pages]
    done = [int(line.split()[0]) for line in lines]
    assert done == sorted(done)
    assert {*range(n + 1)} == set(done)
    assert re.fullmatch(rf"{n} of {n} tasks, \d+ s - done", lines[-1])
    assert f'<progress value="{n}" max="{n}" aria-label="all tasks">' in output.pages[-1]["text/html"]
    assert any('aria-label="mesh"' in page["text/html"] for page in output.pages)
    assert 'aria-label="mesh"' not in output.pages[-1]["text/html"]
    assert "<li>" in output.pages[-1]["text/html"]  # what was said


def test_what_fails_is_shown_and_escaped(output: Display) -> None:
    progress = Watchers([NotebookProgress()])
    progress.submitted("points", "a")
    progress.failed("points", "<script>", "no & no")
    progress.failed("ground", "b", "needs it", ("points", "<script>"))
    for k in range(7):
        progress.say(f"word {k}")
    assert len(output.pages) == 3  # saying draws nothing
    progress.end("failed", "a < b")
    page = output.pages[-1]
    assert "1 failed - failed: a < b" in page["text/plain"]
    assert "points: point-cloud files &lt;script&gt;: no &amp; no" in page["text/html"]
    assert "<script>" not in page["text/html"]
    assert page["text/html"].count("<li>") == 7
    assert "and 2 before" in page["text/html"]


def test_only_a_kernel_is_a_notebook(monkeypatch: pytest.MonkeyPatch) -> None:
    shell: Any = SimpleNamespace()
    monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(get_ipython=lambda: shell))
    assert not in_notebook()
    shell.kernel = object()
    assert in_notebook()
    monkeypatch.delitem(sys.modules, "IPython")
    assert not in_notebook()
