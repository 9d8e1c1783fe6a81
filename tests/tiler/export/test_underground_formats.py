"""Exports of a mesh with soil: two regions that share the ground, read by programs that are not ours."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import meshio
import numpy as np
import pytest
import pyvista
from numpy.typing import NDArray

from pipeline.data.errors import InputError
from pipeline.data.mesh import Marker
from pipeline.data.regions import Region
from stitch.pieces.conformity import compute_cell_volumes
from tests.conftest import Once
from tests.helpers.foam_reader import PolyMesh, read_boundary, read_labels, read_poly_mesh, read_zones
from tests.helpers.hand_pieces import HandPieces
from tests.helpers.patch_readers import open_edges, read_obj, surface_of
from tests.helpers.programs import mesh_is_ok, read_check, run_foam, run_program
from tests.helpers.synthetic import run_city
from tests.helpers.vtk_writers import write_vtu
from tests.tiler.export.conftest import Exported
from tests.tiler.export.test_formats_msh import check_with_gmsh
from tests.tiler.export.test_formats_openfoam import MESH, assert_in_order, volumes_of
from tiler.check.export_proofs import check_export
from tiler.export.export import export_run, list_formats
from tiler.export.foam_files import read_foam_faces
from tiler.export.foam_patches import PATCHES
from tiler.formats.openfoam import write_openfoam
from tiler.mesh_files.mesh_pieces import MeshPiece, open_pieces
from tiler.mesh_files.vtk_files import read_vtu

DEPTH = 20.0
TYPES = {"tetra": pyvista.CellType.TETRA, "pyramid": pyvista.CellType.PYRAMID, "wedge": pyvista.CellType.WEDGE}


@pytest.fixture(scope="module")
def soil_run(once: Once) -> Path:
    """Finished run of a synthetic city with soil on four tiles, not to be changed."""
    return once("soil", lambda folder: run_city(folder, underground=DEPTH)) / "out"


def parts_of(folder: Path) -> list[MeshPiece]:
    pieces = open_pieces(folder)
    return [pieces.read(k) for k in range(len(pieces.names))]


def counts_of(folder: Path) -> dict[str, int]:
    found: dict[str, int] = json.loads((folder / "run.json").read_text())["counts"]
    return found


def marked(parts: list[MeshPiece]) -> dict[str, int]:
    """Facets by name, but for the ground, which is inside."""
    marker = np.concatenate([part.marker for part in parts])
    return {PATCHES[Marker(m)]: int((marker == m).sum()) for m in np.unique(marker) if m != Marker.GROUND}


def places(points: NDArray[np.float64], rows: NDArray[np.integer]) -> list[list[float]]:
    """Middles of faces or cells, sorted, to compare sets of them."""
    middle = np.sort(points[rows], axis=1).mean(axis=1).round(6)
    found: list[list[float]] = middle[np.lexsort(middle.T)].tolist()
    return found


def read_cell_zones(path: Path) -> dict[str, NDArray[np.int64]]:
    text = path.read_text()
    body = text[text.index("}") + 1 :]
    pattern = r"(\w+)\s*\{\s*type cellZone;\s*cellLabels List<label>\s*(\d+)\s*\(([\s\d]*)\)\s*;\s*\}"
    zones = {name: np.array(labels.split(), np.int64) for name, _, labels in re.findall(pattern, body)}
    assert [len(zones[name]) for name in zones] == [int(n) for _, n, _ in re.findall(pattern, body)]
    count = re.match(r"\s*(\d+)", body)
    assert count
    assert int(count[1]) == len(zones)
    return zones


def region_volumes(parts: list[MeshPiece]) -> dict[str, float]:
    sums = {region.name.lower(): 0.0 for region in Region}
    for part in parts:
        assert part.region is not None
        volume = compute_cell_volumes(part.points, part.cells)[0]
        for region in Region:
            sums[region.name.lower()] += float(volume[part.region == region].sum())
    return sums


def test_hybrid_cells_have_prisms_in_the_air_and_a_zone_a_region(soil_run: Path, exported: Exported) -> None:
    folder = exported(soil_run, "openfoam", "--cells", "hybrid", "--buildings", "zones") / MESH
    assert check_export(soil_run, folder.parents[1]).ok
    faces = read_foam_faces(folder / "faces")
    owner, neighbour = (read_labels(folder / name) for name in ("owner", "neighbour"))
    cells = read_cell_zones(folder / "cellZones")
    region = np.full(sum(map(len, cells.values())), -1)
    for value, name in enumerate(("air", "soil")):
        region[cells[name]] = value
    assert set(region.tolist()) == {0, 1}
    sides = region[owner[: len(neighbour)]], region[neighbour]
    zones = read_zones(folder / "faceZones")
    assert np.array_equal(np.sort(zones["ground"]), np.flatnonzero(sides[0] != sides[1]))
    assert not sides[0][zones["ground"]].any()
    assert region[owner[(faces[:, 3] >= 0).nonzero()]].max() == 0  # no side of four corners in soil
    boundary = read_boundary(folder / "boundary")
    of_houses = [
        np.arange(patch.start, patch.start + patch.n) for patch in map(boundary.get, ("walls", "roofs")) if patch
    ]
    assert np.array_equal(
        np.sort(np.concatenate([rows for name, rows in zones.items() if name != "ground"])),
        np.concatenate(of_houses),
    )
    grid = meshio.read(exported(soil_run, "msh", "--cells", "hybrid"))
    groups = {number: name for name, (number, dimension) in grid.field_data.items() if dimension == 3}
    found = dict.fromkeys(groups.values(), 0.0)
    for kind, rows in grid.cells_dict.items():
        if kind in ("tetra", "pyramid", "wedge"):
            part = pyvista.UnstructuredGrid({TYPES[kind]: rows}, grid.points - grid.points[0])
            volume = part.compute_cell_sizes(length=False, area=False)["Volume"]
            for number, name in groups.items():
                found[name] += volume[grid.cell_data_dict["gmsh:physical"][kind] == number].sum()
    expected = region_volumes(parts_of(soil_run))
    assert found == pytest.approx({name: expected[name] for name in groups.values()}, rel=1e-9)


# OpenFOAM.


def assert_zones(folder: Path, mesh: PolyMesh) -> int:
    """Cells of the zones are all cells, and the ground's faces those between them; returns how many these are."""
    cells = read_cell_zones(folder / "cellZones")
    assert list(cells) == ["air", "soil"]
    assert np.array_equal(np.sort(np.concatenate(list(cells.values()))), np.arange(mesh.n_cells))
    soil = np.zeros(mesh.n_cells, np.bool_)
    soil[cells["soil"]] = True
    between = np.flatnonzero(soil[mesh.owner[: len(mesh.neighbour)]] != soil[mesh.neighbour])
    ground = read_zones(folder / "faceZones")["ground"]
    assert np.array_equal(np.sort(ground), between)
    # The face zone is not turned: its normals, out of the owners, all point down, out of the air.
    assert not soil[mesh.owner[ground]].any()
    return len(ground)


def test_openfoam_has_the_ground_inside_and_a_zone_a_region(soil_run: Path, exported: Exported) -> None:
    folder, parts = exported(soil_run, "openfoam") / MESH, parts_of(soil_run)
    mesh = read_poly_mesh(folder)
    assert_in_order(mesh)
    volume = volumes_of(mesh)
    assert (volume > 0).all()
    for name, cells in read_cell_zones(folder / "cellZones").items():
        assert volume[cells].sum() == pytest.approx(region_volumes(parts)[name], rel=1e-9)
    assert {name: patch.n for name, patch in mesh.patches.items()} == marked(parts)
    assert mesh.patches["foundations"].kind == "wall"
    assert mesh.patches["bottom"].kind == "patch"
    ground = read_zones(folder / "faceZones")["ground"]
    assert assert_zones(folder, mesh) == sum(int((part.marker == Marker.GROUND).sum()) for part in parts)
    expected = [part.ids[part.facets[part.marker == Marker.GROUND]] for part in parts]
    assert places(mesh.points, mesh.faces[ground]) == places(mesh.points, np.concatenate(expected))


def test_parts_have_their_share_of_the_zones(soil_run: Path, tmp_path: Path) -> None:
    export_run(soil_run, tmp_path / "case", name="openfoam", options={"parts": 3, "buildings": "zones"})
    folders = [tmp_path / "case" / f"processor{k}" / MESH for k in range(3)]
    found = [assert_zones(folder, read_poly_mesh(folder)) for folder in folders]
    assert sum(found) == sum(int((part.marker == Marker.GROUND).sum()) for part in parts_of(soil_run))
    zones = [list(read_zones(folder / "faceZones")) for folder in folders]
    assert zones[0] == zones[1] == zones[2]
    assert len(zones[0]) == counts_of(soil_run)["building parts"] + 1


def test_the_wind_case_is_of_the_air_alone(soil_run: Path, exported: Exported) -> None:
    case = exported(soil_run, "openfoam", "--case", "wind", "--cells", "hybrid", "--parts", "2")
    report = check_export(soil_run, case)
    assert report.ok
    assert report.facts["volume"] == pytest.approx(region_volumes(parts_of(soil_run))["air"])
    record = json.loads((case / "export.json").read_text())
    assert record["notes"][0] == "the case is of the air alone: cells in soil stay out"
    patches = record["meshes"][0]["patches"]
    assert patches["ground"]
    assert not {"bottom", "foundations"} & set(patches)


@pytest.mark.parametrize("words", [(), ("--cells", "hybrid")])
def test_cgns_tells_the_region_of_cells(soil_run: Path, exported: Exported, words: tuple[str, ...]) -> None:
    with h5py.File(exported(soil_run, "cgns", *words)) as file:
        zone = file["city/regions"]
        region = zone["Regions/region/ data"][:]
        corners = zone[f"{'tetrahedra' if words else 'cells'}/ElementConnectivity/ data"][:].reshape(-1, 4) - 1
        points = np.stack([zone[f"GridCoordinates/Coordinate{axis}/ data"][:] for axis in "XYZ"], axis=1)
        conditions = set(zone["ZoneBC"])
        assert "ground" in zone
    volume = compute_cell_volumes(points, corners.astype(np.int32))[0]
    soil = volume[region[-len(corners) :] == Region.SOIL].sum()  # soil is tetrahedra, which stand last
    assert soil == pytest.approx(region_volumes(parts_of(soil_run))["soil"])
    assert "bottom" in conditions
    assert "ground" not in conditions


def test_ground_that_is_not_between_the_regions_is_refused(soil_run: Path, tmp_path: Path) -> None:
    parts = parts_of(soil_run)
    region = parts[0].region
    assert region is not None
    wrong = region.copy()
    wrong[np.flatnonzero(region == Region.SOIL)[0]] = Region.AIR
    for bad in (wrong, 1 - region):
        pieces = HandPieces(
            tuple(part.name for part in parts),
            open_pieces(soil_run).n_points,
            [replace(parts[0], region=bad), *parts[1:]],
        )
        folder = tmp_path / str(int(bad.sum()))
        folder.mkdir()
        with pytest.raises(InputError, match="its ground is not what air and soil share"):
            write_openfoam(folder, pieces)


@pytest.mark.long
@pytest.mark.timeout(1200)
def test_check_mesh_is_content_with_two_regions(soil_run: Path, tmp_path: Path) -> None:
    parts = parts_of(soil_run)
    for number in (None, 2):
        case = tmp_path / str(number)
        export_run(soil_run, case, name="openfoam", options={} if number is None else {"parts": number})
        text = run_foam("checkMesh", case, parts=number)
        assert mesh_is_ok(text), text[-3000:]
        found = read_check(text)
        assert found["regions"] == 1
        assert found["cells"] == found["tetrahedra"] == counts_of(soil_run)["cells"]
        assert {name[6:]: n for name, n in found.items() if name.startswith("patch ")} == marked(parts)
        zones = dict(re.findall(r"^    (air|soil|ground) +(\d+) ", text, re.MULTILINE))
        cells = np.concatenate([part.region for part in parts if part.region is not None])
        ground = sum(int((part.marker == Marker.GROUND).sum()) for part in parts)
        assert zones == {"air": str((cells == 0).sum()), "soil": str((cells == 1).sum()), "ground": str(ground)}


# Gmsh and XDMF.


@pytest.mark.parametrize("name", ["msh", "msh2"])
def test_meshio_reads_two_volumes(soil_run: Path, exported: Exported, name: str) -> None:
    mesh, parts = meshio.read(exported(soil_run, name)), parts_of(soil_run)
    assert {mesh.field_data[volume][0]: mesh.field_data[volume][1] for volume in ("air", "soil")} == {10: 3, 20: 3}
    assert tuple(mesh.field_data["bottom"]) == (Marker.BOTTOM, 2)
    assert tuple(mesh.field_data["foundations"]) == (Marker.FOUNDATION, 2)
    cells: dict[int, list[Any]] = {10: [], 20: []}
    for block, physical in zip(mesh.cells, mesh.cell_data["gmsh:physical"], strict=True):
        if block.type == "tetra":
            for group in np.unique(physical).tolist():
                cells[group].append(block.data[physical == group])
    for region, group in ((Region.AIR, 10), (Region.SOIL, 20)):
        expected = np.concatenate([part.ids[part.cells[part.region == region]] for part in parts])
        assert np.array_equal(np.concatenate(cells[group]), expected)


@pytest.mark.long
@pytest.mark.parametrize("name", ["msh", "msh2"])
def test_gmsh_has_no_complaints_of_soil(soil_run: Path, exported: Exported, name: str) -> None:
    assert check_with_gmsh(exported(soil_run, name))["complaints"] == 0


@pytest.mark.long
def test_gmsh_to_foam_makes_the_zones(soil_run: Path, exported: Exported, tmp_path: Path) -> None:
    export_run(soil_run, tmp_path / "case", name="openfoam")
    expected = read_check(run_foam("checkMesh", tmp_path / "case"))
    run_foam("gmshToFoam", tmp_path / "case", str(exported(soil_run, "msh2")))
    text = run_foam("checkMesh", tmp_path / "case")
    assert mesh_is_ok(text)
    found = read_check(text)
    assert found.pop("patch ground") == 0
    assert found == expected
    assert re.search(r"^    ground +\d+", text, re.MULTILINE)


def test_xdmf_has_the_region_of_each_cell(soil_run: Path, exported: Exported) -> None:
    path = exported(soil_run, "xdmf")
    with h5py.File(path.with_suffix(".h5")) as file:
        region, cells = file["region"][()], file["cells"][()]
    parts = parts_of(soil_run)
    assert np.array_equal(region, np.concatenate([part.region for part in parts if part.region is not None]))
    assert np.array_equal(cells, np.concatenate([part.ids[part.cells] for part in parts]))
    text = path.read_text()
    assert text.count('<Attribute Name="region" AttributeType="Scalar" Center="Cell">') == 1


@pytest.mark.long
def test_dolfinx_reads_the_regions(soil_run: Path, tmp_path: Path) -> None:
    export_run(soil_run, tmp_path / "a.xdmf", name="xdmf")
    script = """
import json
from dolfinx.io import XDMFFile
from mpi4py import MPI
with XDMFFile(MPI.COMM_WORLD, "a.xdmf", "r") as file:
    mesh = file.read_mesh(name="mesh")
    tags = file.read_meshtags(mesh, name="mesh")
print(json.dumps([tags.dim, int((tags.values == 0).sum()), int((tags.values == 1).sum())]))
"""
    (tmp_path / "read.py").write_text(script)
    text = run_program(["/usr/bin/python3", "read.py"], tmp_path)
    region = np.concatenate([part.region for part in parts_of(soil_run) if part.region is not None])
    assert json.loads(text.strip().splitlines()[-1]) == [3, int((region == 0).sum()), int((region == 1).sum())]


# Surfaces, and all formats.


def test_a_surface_without_its_ground_is_closed(soil_run: Path, exported: Exported) -> None:
    patches = read_obj(exported(soil_run, "obj"))
    whole, ground = surface_of(patches), patches.pop("ground")
    assert {name: len(rows) for name, rows in patches.items()} == marked(parts_of(soil_run))
    assert len(ground) > 0
    assert open_edges(surface_of(patches)) == 0
    assert open_edges(whole) > 0


@pytest.mark.parametrize("name", sorted({*list_formats()} - {"cgns"}))
def test_every_other_format_takes_a_mesh_with_soil(soil_run: Path, exported: Exported, name: str) -> None:
    assert exported(soil_run, name).exists()


def test_a_piece_without_its_regions_is_refused(soil_run: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    shutil.copytree(soil_run, out, ignore=shutil.ignore_patterns("store.zarr"))
    path = sorted((out / "mesh").iterdir())[0]
    piece = read_vtu(path)
    write_vtu(path, piece.mesh, point_data=piece.point_data)
    with pytest.raises(InputError, match="has no cell array 'region'"):
        export_run(out, tmp_path / "a.msh", name="msh")
