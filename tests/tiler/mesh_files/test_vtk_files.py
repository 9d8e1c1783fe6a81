"""VTU, VTP and their index files (step 3.6): written by us, read back by vtk, meshio and ourselves."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest
from deflate import zlib_compress
from numpy.typing import NDArray
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkIOXML import (
    vtkXMLPolyDataReader,
    vtkXMLPPolyDataReader,
    vtkXMLPUnstructuredGridReader,
    vtkXMLUnstructuredGridReader,
)

from pipeline.data.errors import InputError, OutputError
from pipeline.data.mesh import Boundary, TetMesh
from tests.helpers.meshes import TinyCity, make_city, split_city
from tests.helpers.vtk_readers import read_vtk
from tests.helpers.vtk_writers import make_stream, write_vtp, write_vtu
from tiler.mesh_files import vtk_files, vtk_xml
from tiler.mesh_files.vtk_files import read_piece_paths, read_vtp, read_vtu, write_pvtp, write_pvtu
from tiler.mesh_files.vtk_xml import write_data_file


@pytest.fixture(scope="module")
def city() -> TinyCity:
    return make_city()


@pytest.fixture
def small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make a tiny mesh fill several blocks of zlib, the last one partly."""
    monkeypatch.setattr(vtk_xml, "BLOCK_BYTES", 1 << 10)


def read_with_vtk(reader: Any, path: Path) -> Any:
    found = read_vtk(reader, path)
    assert not found.GetErrorCode()
    return found.GetOutput()


def arrays_of(data: Any) -> dict[str, NDArray[Any]]:
    return {data.GetArrayName(i): vtk_to_numpy(data.GetArray(i)) for i in range(data.GetNumberOfArrays())}


def rows_of(cells: Any, width: int) -> NDArray[Any]:
    assert np.array_equal(vtk_to_numpy(cells.GetOffsetsArray()), np.arange(cells.GetNumberOfCells() + 1) * width)
    rows: NDArray[Any] = vtk_to_numpy(cells.GetConnectivityArray()).reshape(-1, width)
    return rows


def assert_same(found: NDArray[Any], expected: NDArray[Any]) -> None:
    """Equal to the last bit, and of one type."""
    assert found.dtype == expected.dtype
    assert found.shape == expected.shape
    assert found.tobytes() == expected.tobytes()


Arrays = dict[str, NDArray[Any]]


def some_data(mesh: TetMesh) -> tuple[Arrays, Arrays]:
    rng = np.random.default_rng(5)
    n_points, n_cells = len(mesh.points), len(mesh.cells)
    point_data: Arrays = {"id": np.arange(n_points) * 2**40, "u": rng.normal(size=(n_points, 3))}
    cell_data: Arrays = {
        "quality": rng.random(n_cells).astype(np.float32),
        'tile <1> & "2"': rng.integers(0, 9, n_cells).astype(np.int32),
        "flag": rng.integers(0, 2, n_cells).astype(np.uint8),
    }
    return point_data, cell_data


def test_the_reading_helper_notices_what_vtk_only_prints(tmp_path: Path, city: TinyCity) -> None:
    path = tmp_path / "mesh.vtu"
    write_vtu(path, city.mesh)
    path.write_bytes(path.read_bytes()[:-2000])
    with pytest.raises(AssertionError):
        read_with_vtk(vtkXMLUnstructuredGridReader(), path)


@pytest.mark.parametrize("blocks", ["one", "several"])
def test_vtk_reads_the_volume(tmp_path: Path, city: TinyCity, blocks: str, request: pytest.FixtureRequest) -> None:
    if blocks == "several":
        request.getfixturevalue("small_blocks")
    point_data, cell_data = some_data(city.mesh)
    path = tmp_path / "mesh.vtu"
    write_vtu(path, city.mesh, point_data=point_data, cell_data=cell_data)

    grid = read_with_vtk(vtkXMLUnstructuredGridReader(), path)

    assert_same(vtk_to_numpy(grid.GetPoints().GetData()), city.mesh.points)
    assert np.array_equal(rows_of(grid.GetCells(), 4), city.mesh.cells)
    assert {grid.GetCellType(i) for i in range(grid.GetNumberOfCells())} == {10}
    for expected, found in (
        (point_data, arrays_of(grid.GetPointData())),
        (cell_data, arrays_of(grid.GetCellData())),
    ):
        assert list(found) == list(expected)
        for name, array in expected.items():
            assert_same(found[name], array)


def test_meshio_reads_the_volume(tmp_path: Path, city: TinyCity, small_blocks: None) -> None:
    point_data, cell_data = some_data(city.mesh)
    path = tmp_path / "mesh.vtu"
    write_vtu(path, city.mesh, point_data=point_data, cell_data=cell_data)

    mesh = meshio.read(path)

    assert [block.type for block in mesh.cells] == ["tetra"]
    assert_same(mesh.points, city.mesh.points)
    assert np.array_equal(mesh.cells[0].data, city.mesh.cells)
    for name, array in point_data.items():
        assert_same(mesh.point_data[name], array)
    for name, array in cell_data.items():
        assert_same(mesh.cell_data[name][0], array)


def test_vtk_reads_the_boundary(tmp_path: Path, city: TinyCity, small_blocks: None) -> None:
    path = tmp_path / "boundary.vtp"
    height = city.mesh.points[:, 2] * 2
    write_vtp(path, city.mesh.points, city.boundary, point_data={"height": height})

    surface = read_with_vtk(vtkXMLPolyDataReader(), path)

    points = vtk_to_numpy(surface.GetPoints().GetData())
    vertex = arrays_of(surface.GetPointData())["vertex"]
    marks = arrays_of(surface.GetCellData())
    assert len(points) < len(city.mesh.points), "points inside the mesh are left out"
    assert vertex.dtype == np.int64
    assert_same(points, city.mesh.points[vertex])
    assert np.array_equal(vertex[rows_of(surface.GetPolys(), 3)], city.boundary.facets)
    assert_same(marks["marker"], city.boundary.marker)
    assert_same(marks["building"], city.boundary.building)
    assert_same(arrays_of(surface.GetPointData())["height"], height[vertex])


def test_vtk_reads_the_index_files(tmp_path: Path, city: TinyCity) -> None:
    pieces = split_city(city, 45.0)
    volumes, surfaces = [], []
    for name, (mesh, boundary) in pieces.items():
        folder = tmp_path / "a & b" / name
        folder.mkdir(parents=True)
        volumes.append(folder / "mesh.vtu")
        surfaces.append(folder / "boundary.vtp")
        write_vtu(volumes[-1], mesh, point_data=some_data(mesh)[0], cell_data=some_data(mesh)[1])
        write_vtp(surfaces[-1], mesh.points, boundary)
    write_pvtu(tmp_path / "mesh.pvtu", volumes)
    write_pvtp(tmp_path / "boundary.pvtp", surfaces)

    grid = read_with_vtk(vtkXMLPUnstructuredGridReader(), tmp_path / "mesh.pvtu")
    surface = read_with_vtk(vtkXMLPPolyDataReader(), tmp_path / "boundary.pvtp")

    meshes = [mesh for mesh, _ in pieces.values()]
    assert_same(vtk_to_numpy(grid.GetPoints().GetData()), np.concatenate([mesh.points for mesh in meshes]))
    assert grid.GetNumberOfCells() == len(city.mesh.cells)
    assert_same(
        arrays_of(grid.GetCellData())["quality"],
        np.concatenate([some_data(mesh)[1]["quality"] for mesh in meshes]),
    )
    assert list(arrays_of(grid.GetPointData())) == ["id", "u"]
    marker = np.concatenate([boundary.marker for _, boundary in pieces.values()])
    assert_same(arrays_of(surface.GetCellData())["marker"], marker)
    assert read_piece_paths(tmp_path / "mesh.pvtu") == volumes
    assert str(tmp_path) not in (tmp_path / "mesh.pvtu").read_text(), "pieces have relative paths"


def test_our_readers_give_back_what_was_written(tmp_path: Path, city: TinyCity, small_blocks: None) -> None:
    point_data, cell_data = some_data(city.mesh)
    write_vtu(tmp_path / "m.vtu", city.mesh, point_data=point_data, cell_data=cell_data)
    write_vtp(tmp_path / "b.vtp", city.mesh.points, city.boundary, point_data=point_data)

    volume, surface = read_vtu(tmp_path / "m.vtu"), read_vtp(tmp_path / "b.vtp")

    assert_same(volume.mesh.points, city.mesh.points)
    assert_same(volume.mesh.cells, city.mesh.cells)
    for expected, found in ((point_data, volume.point_data), (cell_data, volume.cell_data)):
        assert list(found) == list(expected)
        for name, array in expected.items():
            assert_same(found[name], array)
    assert_same(surface.points, city.mesh.points[surface.vertex])
    assert np.array_equal(surface.vertex[surface.boundary.facets], city.boundary.facets)
    assert_same(surface.boundary.marker, city.boundary.marker)
    assert_same(surface.boundary.building, city.boundary.building)
    assert_same(surface.point_data["u"], point_data["u"][surface.vertex])


def test_an_empty_mesh_is_a_file(tmp_path: Path) -> None:
    mesh = TetMesh(np.empty((0, 3)), np.empty((0, 4), np.int32))
    boundary = Boundary(np.empty((0, 3), np.int32), np.empty(0, np.int32), np.empty(0, np.int64))
    write_vtu(tmp_path / "m.vtu", mesh)
    write_vtp(tmp_path / "b.vtp", mesh.points, boundary)

    assert read_vtu(tmp_path / "m.vtu").mesh.cells.shape == (0, 4)
    assert read_vtp(tmp_path / "b.vtp").points.shape == (0, 3)
    grid = read_with_vtk(vtkXMLUnstructuredGridReader(), tmp_path / "m.vtu")
    surface = read_with_vtk(vtkXMLPolyDataReader(), tmp_path / "b.vtp")
    assert grid.GetNumberOfCells() == surface.GetNumberOfCells() == 0


def test_a_block_that_is_exactly_full(tmp_path: Path, small_blocks: None) -> None:
    """128 heights are one block of 1 kB; VTK's header then says 0 for the last, partial one."""
    points = np.random.default_rng(1).random((128, 3))
    cells = np.arange(128, dtype=np.int32).reshape(-1, 4)
    write_vtu(tmp_path / "m.vtu", TetMesh(points, cells), point_data={"h": points[:, 2].copy()})

    grid = read_with_vtk(vtkXMLUnstructuredGridReader(), tmp_path / "m.vtu")

    assert_same(arrays_of(grid.GetPointData())["h"], points[:, 2].copy())
    assert_same(read_vtu(tmp_path / "m.vtu").point_data["h"], points[:, 2].copy())
    assert_same(meshio.read(tmp_path / "m.vtu").point_data["h"], points[:, 2].copy())


@pytest.mark.usefixtures("small_blocks")
def test_offsets_that_are_kept_are_those_of_the_file(tmp_path: Path, city: TinyCity) -> None:
    meshes = [TetMesh(city.mesh.points, city.mesh.cells[:n]) for n in (len(city.mesh.cells), 100, 37, 1000)]
    for k, mesh in enumerate(meshes):
        write_vtu(tmp_path / f"{k}.vtu", mesh)
        data = read_with_vtk(vtkXMLUnstructuredGridReader(), tmp_path / f"{k}.vtu")
        assert_same(rows_of(data.GetCells(), 4).astype(np.int32), mesh.cells.astype(np.int32))
    for k, mesh in enumerate(meshes):
        vtk_files._kept_ends.cache_clear()
        write_vtu(tmp_path / "alone.vtu", mesh)
        assert (tmp_path / "alone.vtu").read_bytes() == (tmp_path / f"{k}.vtu").read_bytes()


@pytest.mark.usefixtures("small_blocks")
def test_offsets_of_the_first_cells_are_compressed_once(
    tmp_path: Path, city: TinyCity, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a piece that is larger than what is kept, too; the last block alone is the piece's own."""
    step = vtk_xml.BLOCK_BYTES // 4
    monkeypatch.setattr(vtk_files, "KEPT_ROWS", 3 * step)
    vtk_files._kept_ends.cache_clear()
    compressed: list[int] = []

    def note(items: NDArray[Any], dtype: np.dtype[Any], *, level: int = vtk_xml.LEVEL) -> bytes:
        if dtype == np.int32:  # not the types
            compressed.append(int(items[0]) // 4 // step)
        return vtk_xml.compress_block(items, dtype, level=level)

    monkeypatch.setattr(vtk_files, "compress_block", note)
    for n_cells in (5 * step, 3 * step, 2 * step + 1):
        write_vtu(tmp_path / "m.vtu", TetMesh(city.mesh.points, city.mesh.cells[:n_cells]))
    assert compressed == [0, 1, 2, 3, 4, 2, 2]


def test_same_input_same_bytes_and_the_input_is_left_alone(tmp_path: Path, city: TinyCity) -> None:
    point_data, cell_data = some_data(city.mesh)
    inputs: list[NDArray[Any]] = [city.mesh.points, city.mesh.cells, *cell_data.values()]
    kept = [array.copy() for array in inputs]
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        write_vtu(tmp_path / name / "m.vtu", city.mesh, point_data=point_data, cell_data=cell_data)
        write_vtp(tmp_path / name / "b.vtp", city.mesh.points, city.boundary)
        write_pvtu(tmp_path / name / "m.pvtu", [tmp_path / name / "m.vtu"])

    for file in ("m.vtu", "b.vtp", "m.pvtu"):
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()
    for before, after in zip(kept, inputs, strict=True):
        assert_same(after, before)


def test_layout_of_the_array_does_not_matter(tmp_path: Path, city: TinyCity) -> None:
    turned = TetMesh(np.asfortranarray(city.mesh.points), np.asfortranarray(city.mesh.cells))
    write_vtu(tmp_path / "c.vtu", city.mesh)
    write_vtu(tmp_path / "f.vtu", turned)
    assert (tmp_path / "c.vtu").read_bytes() == (tmp_path / "f.vtu").read_bytes()


def test_a_failed_write_leaves_the_old_file(
    tmp_path: Path, city: TinyCity, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "m.vtu"
    write_vtu(path, city.mesh)
    before = path.read_bytes()

    def full(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(vtk_xml, "_write_blocks", full)
    with pytest.raises(OutputError, match=r"m\.vtu: cannot be written \(No space left on device\)"):
        write_vtu(path, city.mesh)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_wrong_arrays_are_refused(tmp_path: Path, city: TinyCity) -> None:
    with pytest.raises(ValueError, match="array 'q' is float64"):
        write_vtu(tmp_path / "m.vtu", city.mesh, cell_data={"q": np.zeros(3)})
    with pytest.raises(ValueError, match="array 'q' is complex128"):
        write_vtu(tmp_path / "m.vtu", city.mesh, cell_data={"q": np.zeros(len(city.mesh.cells), complex)})
    with pytest.raises(ValueError, match="at least one piece"):
        write_pvtu(tmp_path / "m.pvtu", [])
    assert not list(tmp_path.iterdir())


def test_pieces_must_declare_the_same_arrays(tmp_path: Path, city: TinyCity) -> None:
    write_vtu(tmp_path / "a.vtu", city.mesh)
    write_vtu(tmp_path / "b.vtu", city.mesh, cell_data={"q": np.zeros(len(city.mesh.cells))})
    with pytest.raises(InputError, match=r"b\.vtu: declares other arrays than .*a\.vtu"):
        write_pvtu(tmp_path / "m.pvtu", [tmp_path / "a.vtu", tmp_path / "b.vtu"])


DAMAGE: dict[str, Callable[[bytes], bytes]] = {
    "empty": lambda _: b"",
    "other file": lambda _: b"solid of another kind",
    "cut in the head": lambda data: data[:300],
    "cut in the data": lambda data: data[: 3 * len(data) // 4],
    "cut before the end": lambda data: data[:-200],
    "other counts": lambda data: data.replace(b'NumberOfPoints="', b'NumberOfPoints="9', 1),
    "no counts": lambda data: data.replace(b"NumberOfPoints", b"NumberOfNothing", 1),
    "huge counts": lambda data: data.replace(b'NumberOfPoints="', b'NumberOfPoints="99999999999', 1),
    "other type": lambda data: data.replace(b'"Float64"', b'"Float99"'),
    "other offset": lambda data: data.replace(b'offset="0"', b'offset="1"'),
    "one bit": lambda data: data[: data.index(b"_", 1000) + 200] + b"\xff" + data[data.index(b"_", 1000) + 201 :],
    "bad XML": lambda data: data.replace(b"<Piece", b"<Piec<", 1),
    "other kind": lambda data: data.replace(b"UnstructuredGrid", b"ImageData").replace(b"PolyData", b"ImageData"),
    "no marks": lambda data: data.replace(b'"marker"', b'"market"').replace(b'"connectivity"', b'"connections"'),
}


@pytest.mark.parametrize("damage", DAMAGE)
@pytest.mark.parametrize("kind", ["vtu", "vtp"])
def test_damaged_files_are_input_errors(tmp_path: Path, city: TinyCity, kind: str, damage: str) -> None:
    path = tmp_path / f"file.{kind}"
    if kind == "vtu":
        write_vtu(path, city.mesh)
    else:
        write_vtp(path, city.mesh.points, city.boundary)
    path.write_bytes(DAMAGE[damage](path.read_bytes()))

    with pytest.raises(InputError, match=rf"file\.{kind}: .*; run the tile again"):
        read_vtu(path) if kind == "vtu" else read_vtp(path)


def test_every_truncation_is_noticed(tmp_path: Path, city: TinyCity) -> None:
    path = tmp_path / "b.vtp"
    write_vtp(path, city.mesh.points, city.boundary)
    data = path.read_bytes()
    tail = len(b"\n  </AppendedData>\n</VTKFile>\n")
    for length in range(0, len(data) - tail, 97):
        path.write_bytes(data[:length])
        with pytest.raises(InputError):
            read_vtp(path)


# What the table in front of an array's blocks may say wrongly: entry, and the number there.
TABLES = {
    "no block": (0, 0),
    "2**62 blocks": (0, 2**62),
    "a block more": (0, 2),
    "blocks of nothing": (1, 0),
    "blocks of 2**62 bytes": (1, 2**62),
    "a packed block of 2**62 bytes": (3, 2**62),
    "a packed block of nothing": (3, 0),
}


@pytest.mark.parametrize("name", TABLES)
def test_a_wrong_block_table_is_an_input_error(tmp_path: Path, city: TinyCity, name: str) -> None:
    path, (entry, number) = tmp_path / "b.vtp", TABLES[name]
    write_vtp(path, city.mesh.points, city.boundary)
    data = bytearray(path.read_bytes())
    at = data.index(b"_", data.index(b"<AppendedData")) + 1 + 8 * entry
    data[at : at + 8] = number.to_bytes(8, "little")
    path.write_bytes(data)
    with pytest.raises(InputError, match=r"b\.vtp: not a file of ours or damaged"):
        read_vtp(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({}, None),
        ({"types": np.array([10, 14], np.uint8)}, "no tetrahedra"),
        ({"types": None}, "no tetrahedra"),
        ({"offsets": np.array([3, 8], np.int32)}, "have not 4 vertices"),
        ({"offsets": None}, "no connectivity"),
    ],
)
def test_cells_that_are_no_tetrahedra(tmp_path: Path, change: dict[str, Any], message: str | None) -> None:
    arrays: dict[str, NDArray[Any] | None] = {
        "connectivity": np.array([0, 1, 2, 3, 1, 2, 3, 4], np.int32),
        "offsets": np.array([4, 8], np.int32),
        "types": np.array([10, 10], np.uint8),
    }
    arrays |= change
    cells = [make_stream(name, array, array.dtype) for name, array in arrays.items() if array is not None]
    points = make_stream("Points", np.random.default_rng(0).random((5, 3)), np.float64)
    sections = {"Points": [points], "Cells": cells, "PointData": [], "CellData": []}
    counts = {"NumberOfPoints": 5, "NumberOfCells": 2}
    write_data_file(tmp_path / "m.vtu", "UnstructuredGrid", counts, sections)
    if message is None:
        assert len(read_vtu(tmp_path / "m.vtu").mesh.cells) == 2
    else:
        with pytest.raises(InputError, match=message):
            read_vtu(tmp_path / "m.vtu")


def test_vertices_out_of_range_are_input_errors(tmp_path: Path) -> None:
    mesh = TetMesh(np.zeros((4, 3)), np.array([[0, 1, 2, 7]], np.int32))
    write_vtu(tmp_path / "m.vtu", mesh)
    with pytest.raises(InputError, match=r"vertex 0\.\.7 of 4 points"):
        read_vtu(tmp_path / "m.vtu")


def test_missing_files_are_input_errors(tmp_path: Path, city: TinyCity) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        read_vtp(tmp_path / "none.vtp")
    with pytest.raises(OutputError, match="cannot be written"):
        write_vtu(tmp_path / "no" / "such" / "folder.vtu", city.mesh)
    write_vtu(tmp_path / "a.vtu", city.mesh)
    write_pvtu(tmp_path / "m.pvtu", [tmp_path / "a.vtu"])
    (tmp_path / "a.vtu").unlink()
    with pytest.raises(InputError, match=r"the piece .*a\.vtu is missing"):
        read_piece_paths(tmp_path / "m.pvtu")
    for text in ("", "<VTKFile/>", "<VTKFile>"):
        (tmp_path / "m.pvtu").write_text(text)
        with pytest.raises(InputError, match=r"m\.pvtu: not a file of ours"):
            read_piece_paths(tmp_path / "m.pvtu")


def test_meshio_takes_no_array_for_another_whose_offset_is_the_same(tmp_path: Path) -> None:
    """The third array would begin where meshio puts the second one, once it has unpacked the first."""
    rng = np.random.default_rng(5)
    points, cells = rng.random((400, 3)), np.array([[0, 1, 2, 3]])
    unpacked = 4 * -(-(8 + points.nbytes) // 3)
    path, moved = tmp_path / "m.vtu", 0
    for n in range(3600, 3720):
        values = np.concatenate((rng.integers(0, 256, n), np.zeros(4800 - n))).astype(np.uint8)
        sections = {
            "Points": [make_stream("Points", points, np.float64)],
            "PointData": [make_stream("v", values.reshape(400, 12), np.uint8)],
            "Cells": [
                make_stream("connectivity", cells, np.int32),
                make_stream("offsets", np.array([4]), np.int32),
                make_stream("types", np.array([10]), np.uint8),
            ],
        }
        write_data_file(path, "UnstructuredGrid", {"NumberOfPoints": 400, "NumberOfCells": 1}, sections)
        offsets = [int(text) for text in re.findall(rb'offset="(\d+)"', path.read_bytes())]
        assert unpacked not in offsets[2:]
        plain = 32 + len(zlib_compress(values.tobytes(), vtk_xml.LEVEL))
        moved += offsets[1] + plain == unpacked
        mesh = meshio.read(path)
        assert mesh.cells[0].data.tolist() == cells.tolist()
        assert_same(mesh.point_data["v"], values.reshape(400, 12))
    assert moved
