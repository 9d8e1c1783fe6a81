"""One file of all tiles, on request: complete, each vertex once, and never over what has to stay."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from pipeline.data.errors import InputError, OutputError
from tests.helpers.vtk_readers import read_xml
from tests.helpers.vtk_writers import write_vtu
from tests.tiler.export.conftest import Exported
from tiler.cli.main import main
from tiler.export.export import export_run, list_formats, load_format
from tiler.mesh_files.merged import VERTEX_ID, write_merged_volume
from tiler.mesh_files.vtk_files import read_vtp, read_vtu


@pytest.fixture
def copy(small_run: Path, tmp_path: Path) -> Path:
    """The run without its store, to be damaged."""
    return shutil.copytree(small_run, tmp_path / "run", ignore=shutil.ignore_patterns("store.zarr"))


def test_one_file_has_the_counts_of_the_record(small_run: Path, exported: Exported) -> None:
    from vtkmodules.util.numpy_support import vtk_to_numpy

    record = json.loads((small_run / "run.json").read_text())
    assert len(record["tiles"]) == 4
    volume, surface = (read_xml(exported(small_run, name)) for name in ("vtu", "vtp"))
    counts = record["counts"]
    assert (volume.GetNumberOfPoints(), volume.GetNumberOfCells()) == (counts["points"], counts["cells"])
    assert surface.GetNumberOfCells() == counts["facets"]
    points = vtk_to_numpy(volume.GetPoints().GetData())
    assert len(np.unique(points, axis=0)) == len(points)
    assert np.array_equal(
        points[vtk_to_numpy(surface.GetPointData().GetArray("vertex"))],
        vtk_to_numpy(surface.GetPoints().GetData()),
    )


def test_cells_and_marks_are_those_of_the_pieces(small_run: Path, exported: Exported) -> None:
    volume, surface = read_vtu(exported(small_run, "vtu")).mesh, read_vtp(exported(small_run, "vtp"))
    pieces = [read_vtu(path).mesh for path in sorted((small_run / "mesh").iterdir())]
    corners = np.concatenate([piece.points[piece.cells] for piece in pieces])
    assert volume.points[volume.cells].tobytes() == corners.tobytes()
    parts = [read_vtp(path) for path in sorted((small_run / "boundary").iterdir())]
    corners = np.concatenate([part.points[part.boundary.facets] for part in parts])
    assert surface.points[surface.boundary.facets].tobytes() == corners.tobytes()
    for mark in ("marker", "building"):
        expected = np.concatenate([getattr(part.boundary, mark) for part in parts])
        assert np.array_equal(getattr(surface.boundary, mark), expected)


def test_scalars_to_colour_by_are_added_on_request(small_run: Path, exported: Exported) -> None:
    from vtkmodules.util.numpy_support import vtk_to_numpy

    plain = [read_xml(exported(small_run, name)) for name in ("vtu", "vtp")]
    volume, surface = (read_xml(exported(small_run, name, "--scalars")) for name in ("vtu", "vtp"))
    for grid, without in zip((volume, surface), plain, strict=True):
        names, few = (
            {g.GetCellData().GetArrayName(i) for i in range(g.GetCellData().GetNumberOfArrays())}
            for g in (grid, without)
        )
        assert names - few == ({"tile", "radius_ratio"} if grid is volume else {"tile", "index"})
    folders = [sorted((small_run / folder).iterdir()) for folder in ("mesh", "boundary")]
    cells = [len(read_vtu(path).mesh.cells) for path in folders[0]]
    facets = [len(read_vtp(path).boundary.facets) for path in folders[1]]
    for grid, sizes in ((volume, cells), (surface, facets)):
        tile = vtk_to_numpy(grid.GetCellData().GetArray("tile"))
        assert np.array_equal(tile, np.repeat(np.arange(4), sizes))
    number, index = (vtk_to_numpy(surface.GetCellData().GetArray(name)) for name in ("building", "index"))
    known = np.unique(number[number >= 0])
    assert (index.dtype, index.max(), index.min()) == (np.int32, len(known) - 1, -1)
    assert np.array_equal(np.where(index < 0, -1, known[index]), number)
    found = vtk_to_numpy(volume.GetCellData().GetArray("radius_ratio"))
    nodes = vtk_to_numpy(volume.GetCells().GetConnectivityArray()).reshape(-1, 4)
    corners = vtk_to_numpy(volume.GetPoints().GetData())[nodes]
    edges = corners[:, 1:] - corners[:, :1]
    outer = np.linalg.norm(np.linalg.solve(2 * edges, (edges**2).sum(axis=2)[..., None])[..., 0], axis=1)
    # The inscribed radius is one over the sum of the reciprocal heights, the lengths of the dual basis.
    dual = np.linalg.inv(edges)
    heights = np.linalg.norm(np.concatenate((dual, -dual.sum(axis=2, keepdims=True)), axis=2), axis=1)
    assert np.allclose(found, 3 / heights.sum(axis=1) / outer, rtol=1e-4)


AGAIN: list[tuple[str, tuple[str, ...]]] = [(name, ()) for name in list_formats()] + [
    (name, ("--buildings", "patches")) for name in ("stl", "obj", "glb", "msh", "msh2", "cgns")
]
AGAIN.append(("openfoam", ("--case", "wind", "--parts", "3")))


@pytest.mark.parametrize(("name", "words"), AGAIN)
def test_a_format_is_the_same_bytes_again_with_workers_and_whole_or_not_at_all(
    small_run: Path, exported: Exported, tmp_path: Path, name: str, words: tuple[str, ...]
) -> None:
    path = exported(small_run, name, *words)
    more = ("--workers", "2") if "workers" in load_format(name).options else ()
    main(["export", str(small_run), "--format", name, "-o", str(tmp_path / path.name), *words, *more])
    one, two = (
        {str(file.relative_to(home)): file.read_bytes() for file in sorted(home.rglob("*")) if file.is_file()}
        for home in (path.parent, tmp_path)
    )
    assert one == two
    assert {file.split("/")[0] for file in one} == {path.name} | ({"city.h5"} if name == "xdmf" else set())
    with pytest.raises(OutputError, match="cannot be written"):
        export_run(small_run, tmp_path / "none" / path.name, name=name)


@pytest.mark.parametrize("name", [name for name in list_formats() if load_format(name).suffix])
def test_other_suffixes_are_refused(
    small_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    assert main(["export", str(small_run), "--format", name, "-o", str(tmp_path / "x.vtu")]) == 2
    suffix = load_format(name).suffix
    assert f"x.vtu: a file of format {name} ends with {suffix}; give another --output" in capsys.readouterr().err


def test_help_has_a_line_a_format(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="0"):
        main(["export", "--help"])
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    for name in list_formats():
        words = [name, *load_format(name).description.split()]
        assert words in [line[: len(words)] for line in lines]


def test_a_file_is_replaced_on_request_alone(
    small_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    target = tmp_path / "all.vtp"
    target.write_text("mine")
    command = ["export", str(small_run), "--format", "vtp", "-o", str(target)]
    assert main(command) == 2
    assert "all.vtp: exists; give another --output, or --overwrite" in capsys.readouterr().err
    assert target.read_text() == "mine"
    assert main([*command, "--overwrite"]) == 0
    assert read_xml(target).GetNumberOfCells() > 0
    assert list(tmp_path.iterdir()) == [target]


@pytest.mark.parametrize("own", ["run.json", "boundary.pvtp", "mesh.pvtu", "mesh", "boundary"])
def test_files_of_the_run_are_never_replaced(copy: Path, capsys: pytest.CaptureFixture[str], own: str) -> None:
    target = copy / own
    target = min(target.iterdir()) if target.is_dir() else target
    before = target.read_bytes()
    # By another way to the same file.
    target = target.parent / ".." / target.parent.name / target.name
    assert main(["export", str(copy), "--format", "vtu", "-o", str(target), "--overwrite"]) == 2
    assert "is a file of the run itself" in capsys.readouterr().err
    assert target.read_bytes() == before


def no_record(folder: Path) -> None:
    (folder / "run.json").unlink()


def failed(folder: Path) -> None:
    (folder / "run.json").write_text(json.dumps({"schema": 1, "status": "failed", "error": "no room"}))


def running(folder: Path) -> None:
    (folder / "run.json").write_text(json.dumps({"schema": 1, "status": "running"}))


def unfinished(folder: Path) -> None:
    record = json.loads((folder / "run.json").read_text())
    (folder / "run.json").write_text(json.dumps(record | {"status": "partial"}))


def no_index(folder: Path) -> None:
    (folder / "mesh.pvtu").unlink()


def no_piece(folder: Path) -> None:
    min((folder / "mesh").iterdir()).unlink()


def cut_piece(folder: Path) -> None:
    piece = max((folder / "mesh").iterdir())
    piece.write_bytes(piece.read_bytes()[:-5000])


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (no_record, "it has no run.json; run citystitch first"),
        (failed, "the run failed (no room)"),
        (running, "the run is running and has no mesh yet"),
        (unfinished, "the run is 'partial', not 'done'"),
        (no_index, "mesh.pvtu: cannot be read"),
        (no_piece, "is missing; run the tile again"),
        (cut_piece, "not a file of ours or damaged"),
    ],
)
def test_what_is_no_finished_run_is_refused(
    copy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], damage: Callable[[Path], None], message: str
) -> None:
    damage(copy)
    assert main(["export", str(copy), "--format", "vtu", "-o", str(tmp_path / "all.vtu")]) == 1
    assert message in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_pieces_that_cannot_be_merged_leave_no_file(copy: Path, tmp_path: Path) -> None:
    first, second, *_ = volumes = sorted((copy / "mesh").iterdir())
    one, other = read_vtu(first), read_vtu(second)
    ids, mark = other.point_data[VERTEX_ID], {"q": np.zeros(len(one.mesh.cells), np.int32)}
    for point_data, cell_data, message in (
        ({}, {}, "has no point array vertex_id"),
        ({VERTEX_ID: ids[::-1].copy()}, {}, "stands for two places"),
        ({VERTEX_ID: ids}, mark, "has no array 'q' like the first piece's"),
    ):
        write_vtu(first, one.mesh, point_data=one.point_data, cell_data=cell_data)
        write_vtu(second, other.mesh, point_data=point_data)
        with pytest.raises(InputError, match=message):
            write_merged_volume(tmp_path / "all.vtu", volumes)
    with pytest.raises(ValueError, match="at least one piece"):
        write_merged_volume(tmp_path / "all.vtu", [])
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_wrong_arguments_and_places(small_run: Path, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="format 'nope' must be one of 3dtiles, cgns, cityjsonseq"):
        export_run(small_run, tmp_path / "all.obj", name="nope")
    (tmp_path / "all.vtu").mkdir()
    with pytest.raises(OutputError, match=r"all.vtu: cannot be written"):
        export_run(small_run, tmp_path / "all.vtu", name="vtu", overwrite=True)
    assert [path.name for path in tmp_path.iterdir()] == ["all.vtu"]
