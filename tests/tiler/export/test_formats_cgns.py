"""CGNS: named patches and families, read by VTK's reader and by the CGNS library's own check."""

import json
import re
import shutil
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.data.errors import OutputError
from pipeline.data.mesh import Marker
from tests.helpers.hand_pieces import box_pieces
from tests.helpers.programs import run_program
from tiler.cli.main import main
from tiler.export.export import export_run
from tiler.export.foam_patches import HOUSE, PATCHES, building_name
from tiler.formats import cgns
from tiler.formats.cgns import write_cgns
from tiler.mesh_files.mesh_pieces import open_pieces

Corners = NDArray[np.float64]


@pytest.fixture(scope="module")
def exported(small_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The small city as CGNS, with a patch a building."""
    path = tmp_path_factory.mktemp("cgns") / "city.cgns"
    command = ["export", str(small_run), "--format", "cgns", "-o", str(path)]
    assert main([*command, "--buildings", "patches"]) == 0
    return path


def read_with_vtk(path: Path) -> dict[str, Corners]:
    """Corners of all cells by block, `Internal` and the patches, as ParaView's reader has them."""
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkIOCGNSReader import vtkCGNSReader

    reader = vtkCGNSReader()
    errors: list[str] = []
    reader.AddObserver("ErrorEvent", lambda *_: errors.append("error"))
    reader.SetFileName(str(path))
    reader.UpdateInformation()
    reader.EnableAllBases()
    reader.EnableAllFamilies()
    reader.LoadBndPatchOn()
    reader.Update()
    assert not errors
    found: dict[str, Corners] = {}

    def collect(blocks: Any) -> None:
        for i in range(blocks.GetNumberOfBlocks()):
            block, name = blocks.GetBlock(i), blocks.GetMetaData(i).Get(blocks.NAME())
            if block.IsA("vtkMultiBlockDataSet"):
                collect(block)
                continue
            nodes = vtk_to_numpy(block.GetCells().GetConnectivityArray())
            width = 4 if name == "Internal" else 3
            assert {block.GetCellType(j) for j in range(block.GetNumberOfCells())} == {10 if width == 4 else 5}
            found[name] = vtk_to_numpy(block.GetPoints().GetData())[nodes].reshape(-1, width, 3)

    collect(reader.GetOutput())
    return found


def corners_of(pieces: Any, *, by_building: bool) -> dict[str, Corners]:
    """What the file must hold, from the pieces."""
    parts = [pieces.read(k) for k in range(len(pieces.names))]
    found: dict[str, list[Corners]] = {"Internal": [part.points[part.cells] for part in parts]}
    for part in parts:
        for facet, marker, building in zip(part.facets, part.marker, part.building, strict=True):
            name = PATCHES[Marker(int(marker))]
            if by_building and marker in HOUSE and building >= 0:
                name = building_name(int(building))
            found.setdefault(name, []).append(part.points[facet][None])
    return {name: np.concatenate(rows) for name, rows in found.items()}


@pytest.mark.parametrize("buildings", [None, "patches"])
def test_vtk_reads_cells_and_patches_of_a_city(small_run: Path, tmp_path: Path, buildings: str | None) -> None:
    path = tmp_path / "city.cgns"
    export_run(small_run, path, name="cgns", options={"buildings": buildings} if buildings else {})
    found = read_with_vtk(path)
    expected = corners_of(open_pieces(small_run), by_building=buildings is not None)
    assert sorted(found) == sorted(expected)
    assert ("walls" in found) == (buildings is None)
    for name, corners in expected.items():
        assert np.array_equal(found[name], corners), name


@pytest.mark.parametrize("seed", range(3))
def test_pieces_in_any_order_keep_all_cells(tmp_path: Path, seed: int) -> None:
    pieces = box_pieces(seed=seed)
    write_cgns(tmp_path / "box.cgns", pieces, crs="EPSG:28992", buildings="patches")
    found, expected = read_with_vtk(tmp_path / "box.cgns"), corners_of(pieces, by_building=True)
    assert sorted(found) == sorted(expected)
    assert "building_11" in found
    for name, corners in expected.items():
        assert np.array_equal(found[name], corners), name


def test_numbers_beyond_32_bits_are_read_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cgns, "INT32_LIMIT", 10)
    pieces = box_pieces()
    write_cgns(tmp_path / "box.cgns", pieces, crs="EPSG:28992")
    with h5py.File(tmp_path / "box.cgns") as file:
        zone = file["city/air"]
        places = ["", "cells/ElementRange/", "cells/ElementConnectivity/", "ZoneBC/top/PointRange/"]
        assert {zone[f"{place} data"].dtype for place in places} == {np.dtype(np.int64)}
        assert {zone[place or "."].attrs["type"] for place in places} == {b"I8"}
    found, expected = read_with_vtk(tmp_path / "box.cgns"), corners_of(pieces, by_building=False)
    assert sorted(found) == sorted(expected)
    for name, corners in expected.items():
        assert np.array_equal(found[name], corners), name


def test_families_units_and_crs_stand_in_the_file(small_run: Path, exported: Path) -> None:
    with h5py.File(exported) as file:
        base = file["city"]
        labels = {name: node.attrs["label"].decode() for name, node in base.items() if name != " data"}
        kinds = {
            name: base[name]["FamilyBC/ data"][()].tobytes().decode()
            for name, label in labels.items()
            if label == "Family_t"
        }
        units = [row.tobytes().decode().strip() for row in base["DimensionalUnits/ data"][()]]
        crs = base["CRS/ data"][()].tobytes().decode()
    walls = {name for name, kind in kinds.items() if kind == "BCWall"}
    assert {name for name in kinds if name not in walls} == {"top", "west", "east", "south", "north"}
    assert "ground" in walls
    assert all(name == "ground" or name.startswith("building_") for name in walls)
    assert units == ["Null", "Meter", "Null", "Null", "Null"]
    assert crs == json.loads((small_run / "run.json").read_text())["region"]["crs"]


def test_export_is_the_same_bytes_again_and_whole_or_not_at_all(
    small_run: Path, exported: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "again.cgns"
    export_run(small_run, path, name="cgns", options={"buildings": "patches"})
    assert path.read_bytes() == exported.read_bytes()
    assert list(tmp_path.iterdir()) == [path]
    assert main(["export", str(small_run), "--format", "cgns", "-o", str(tmp_path / "x.hdf")]) == 2
    assert "x.hdf: a file of format cgns ends with .cgns; give another --output" in capsys.readouterr().err
    command = ["export", str(small_run), "--format", "cgns", "-o", str(tmp_path / "x.cgns")]
    assert main([*command, "--buildings", "zones"]) == 2
    assert "--buildings zones: format cgns takes patches" in capsys.readouterr().err
    with pytest.raises(OutputError, match="cannot be written"):
        export_run(small_run, tmp_path / "none" / "x.cgns", name="cgns")


def check_with_cgns(path: Path) -> dict[str, Any]:
    """What the CGNS library's check says of a file; it ends with 0 either way."""
    text = run_program(["cgnscheck", "-v", str(path)], path.parent)
    assert "checking complete" in text, text[-3000:]
    sets = re.findall(
        r'checking element set "(\w+)"\n +Element Set Type=TRI_3\n.*\n.*\n'
        r" +\[internal,external\] Faces=\[(\d+),(\d+)\]",
        text,
    )
    size = re.search(r"Vertex Size=\[(\d+)\]\s+Cell Size=\[(\d+)\]", text)
    assert size
    return {
        "points": int(size[1]),
        "cells": int(size[2]),
        "outer": {name: int(outer) for name, inner, outer in sets if inner == "0"},
        "families": set(re.findall(r'^    Family="(\w+)"$', text, re.MULTILINE)),
        "complaints": len(re.findall(r"^(?:WARNING|ERROR)", text, re.MULTILINE)),
    }


@pytest.mark.long
def test_the_cgns_library_has_no_complaints(small_run: Path, exported: Path) -> None:
    counts = json.loads((small_run / "run.json").read_text())["counts"]
    expected = {name: len(rows) for name, rows in corners_of(open_pieces(small_run), by_building=True).items()}
    assert expected.pop("Internal") == counts["cells"]
    assert check_with_cgns(exported) == {
        "points": counts["points"],
        "cells": counts["cells"],
        "outer": expected,
        "families": set(expected),
        "complaints": 0,
    }


def not_a_face(file: h5py.File) -> None:
    file["city/air/ground/ElementConnectivity/ data"][:3] = [1, 1, 2]


def beyond_the_elements(file: h5py.File) -> None:
    file["city/air/ZoneBC/north/PointRange/ data"][1, 0] = 10**8


def no_such_family(file: h5py.File) -> None:
    file["city"].move("ground", "floor")
    file["city/floor"].attrs.modify("name", np.bytes_("floor"))


def no_such_point(file: h5py.File) -> None:
    file["city/air/cells/ElementConnectivity/ data"][0] = 10**8


@pytest.mark.long
@pytest.mark.parametrize("damage", [not_a_face, beyond_the_elements, no_such_family, no_such_point])
def test_the_cgns_library_sees_what_is_broken(exported: Path, tmp_path: Path, damage: Any) -> None:
    sound = check_with_cgns(exported)
    path = Path(shutil.copy(exported, tmp_path / "broken.cgns"))
    with h5py.File(path, "r+") as file:
        damage(file)
    assert check_with_cgns(path) != sound
