"""Runs with land cover, water and trees: check proves them, a tile alone is the same, and OpenFOAM runs them."""

import json
import re
from pathlib import Path
from typing import Any

import h5py
import laspy
import meshio
import numpy as np
import pyogrio
import pytest
import pyvista
import shapely

from pipeline.data.errors import InputError
from pipeline.data.mesh import Marker
from stitch.pieces.conformity import compute_cell_volumes
from tests.helpers.foam_reader import read_field, read_poly_mesh
from tests.helpers.programs import mesh_is_ok, run_foam
from tests.helpers.tiles import hash_files
from tiler.check.check import check_run
from tiler.config.config import make_config
from tiler.export.export import export_run
from tiler.interface.synth import write_city
from tiler.mesh_files.run_files import find_files
from tiler.mesh_files.vtk_files import read_vtp, read_vtu
from tiler.store.results import StoredTerrain
from tiler.workflow.run import run
from tiler.workflow.single_tile import run_alone

X, Y = 318_000.0, 6_399_000.0
CRS = "EPSG:3006"


def write_layer(path: Path, shapes: list[shapely.Geometry], form: str, **fields: list[Any]) -> str:
    wkb = shapely.to_wkb(np.array(shapes, object))
    columns = [np.array(values, None if isinstance(values[0], float) else object) for values in fields.values()]
    pyogrio.raw.write(path, wkb, columns, list(fields), geometry_type=form, crs=CRS)
    return str(path)


def write_leaves(path: Path) -> str:
    """Write a crown of points of class 5, a ball of 16 m around (X + 200, Y + 120, 25)."""
    rng = np.random.default_rng(1)
    way = rng.normal(size=(3000, 3))
    ball = 8 * way / np.linalg.norm(way, axis=1)[:, None] * rng.random((3000, 1)) ** (1 / 3)
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = np.full(3, 0.001), np.array([X, Y, 0.0])
    las = laspy.LasData(header)
    las.x, las.y, las.z = (ball + np.array([X + 200, Y + 120, 25.0])).T
    las.classification = np.full(3000, 5, np.uint8)
    las.write(path)
    return str(path)


@pytest.fixture(scope="module")
def given(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    folder = tmp_path_factory.mktemp("covered")
    files = write_city(folder / "city", size=300, buildings=15, density=1.0)
    along = np.linspace(-20, 320, 60)
    canal = shapely.LineString(np.column_stack((X + along, Y + 150 + 40 * np.sin(along / 60)))).buffer(10)
    pond = shapely.Point(X + 240, Y + 250).buffer(20)
    street = shapely.box(X + 70, Y - 10, X + 78, Y + 320)
    shapes, classes = [canal, pond, street, street], ["Canal", "pond", "road", "spaceship"]
    cover = write_layer(
        folder / "cover.gpkg", shapes, "Polygon", kind=classes, level=[np.nan, 3.25, np.nan, np.nan]
    )
    trees = write_layer(
        folder / "trees.gpkg", [shapely.Point(X + 120, Y + 60)], "Point", height=[12.0], crown=[9.0]
    )
    return {
        "pointcloud": [*map(str, files.clouds), write_leaves(folder / "leaves.laz")],
        "footprints": str(files.footprints),
        "land_cover": [cover],
        "land_cover_field": "nothing,kind",
        "trees": trees,
        "vegetation_classes": [5],
        "crs": CRS,
        "bounds": [X, Y, X + 300, Y + 300],
        "tile_size": 150.0,
        "domain_height": 60.0,
        "top": "flat",
    }


@pytest.fixture(scope="module")
def covered_run(given: dict[str, Any], tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("run") / "out"
    run(make_config(given | {"out": str(out)}))
    return out


def test_check_proves_patches_water_and_leaves(covered_run: Path) -> None:
    report = check_run(covered_run, StoredTerrain)
    assert report.ok, report.lines()
    told = "\n".join(report.lines())
    assert re.search(r"[1-9]\d* ground vertices in water", told)
    assert re.search(r"[1-9]\d* cells of \S+ m³ are between leaves", told)
    record = json.loads((covered_run / "run.json").read_text())
    area = {row["patch"]: row["area (m2)"] for row in record["land_cover"]["patches"]}
    assert area["ground_water"] > 5000
    assert area["ground_street"] > 1500
    assert record["counts"]["bodies of water"] == 2
    assert record["notes"]["land-cover-unknown-class"]["count"] == 1
    heights = {
        round(float(z), 6)
        for path in find_files(covered_run).boundaries
        for piece in [read_vtp(path)]
        for facet in piece.boundary.facets[piece.cell_data["ground_patch"] == 1]
        for x, y, z in piece.points[facet]
        if np.hypot(x - X - 240, y - Y - 250) < 19
    }
    assert heights == {3.25}
    volumes = [read_vtu(path) for path in find_files(covered_run).volumes]
    leaves = np.concatenate([piece.cell_data["lad"] for piece in volumes])
    middle = np.concatenate([piece.mesh.points[piece.mesh.cells].mean(axis=1) for piece in volumes])[leaves > 0]
    planted, measured = (np.hypot(*(middle[:, :2] - (X, Y) - place).T) for place in ((120, 60), (200, 120)))
    # Columns are 2 m wide; the city has points of leaves of its own elsewhere.
    assert set(leaves[leaves > 0][planted < 6].tolist()) == {1.0}
    assert not ((planted > 6) & (planted < 12)).any()
    assert (measured < 9.5).sum() > 10
    assert not ((measured > 9.5) & (measured < 14)).any()
    assert np.abs(middle[measured < 9.5, 2] - 25).max() < 8


@pytest.mark.parametrize("options", [{}, {"cells": "hybrid"}])
def test_msh_and_cgns_have_the_leaf_area_of_each_cell(
    covered_run: Path, tmp_path: Path, options: dict[str, str]
) -> None:
    volumes = [read_vtu(path) for path in find_files(covered_run).volumes]
    found = {
        "": sum(float(p.cell_data["lad"] @ compute_cell_volumes(p.mesh.points, p.mesh.cells)[0]) for p in volumes)
    }
    for name in ("msh", "cgns"):
        export_run(covered_run, path := tmp_path / f"a.{name}", name=name, options=options)
        if name == "msh":
            mesh = meshio.read(path)
            kinds = {"tetra": 10, "pyramid": 14, "wedge": 13}
            blocks = {k: (kinds[k], rows) for k, rows in mesh.cells_dict.items() if k in kinds}
            assert not mesh.cell_data_dict["lad"]["triangle"].any()
            leaves = np.concatenate([mesh.cell_data_dict["lad"][kind] for kind in blocks])
            grid = pyvista.UnstructuredGrid(dict(blocks.values()), mesh.points - (X, Y, 0))
        else:
            with h5py.File(path) as file:
                leaves = file["city/air/Leaves/lad/ data"][:]
        found[name] = float(leaves @ grid.compute_cell_sizes()["Volume"])  # cells are in one order in both
    assert found["cgns"] == found["msh"]
    # The leaves of a prism are those of its middle tetrahedron; a few crowns are less than three hundred cells.
    assert found["msh"] == pytest.approx(found[""], rel=0.3 if options else 1e-9)


@pytest.mark.long
def test_a_tile_alone_and_workers_give_the_same_bytes(
    given: dict[str, Any], covered_run: Path, tmp_path: Path
) -> None:
    name = find_files(covered_run).volumes[1].stem
    alone = run_alone(make_config(given | {"out": str(covered_run)}), name)
    assert alone.read_bytes() == (covered_run / "mesh" / f"{name}.vtu").read_bytes()
    other = tmp_path / "out"
    clouds = list(reversed(given["pointcloud"]))
    run(make_config(given | {"out": str(other), "workers": 2, "pointcloud": clouds}))
    wanted = {
        path: one for path, one in hash_files(covered_run).items() if path.startswith(("mesh/", "boundary/"))
    }
    assert {path: one for path, one in hash_files(other).items() if path in wanted} == wanted


@pytest.mark.long
def test_a_case_has_patches_roughness_and_a_porous_source_that_runs(covered_run: Path, tmp_path: Path) -> None:
    case = tmp_path / "case"
    export_run(covered_run, case, name="openfoam", options={"case": "wind", "roughness": 0.03})
    mesh = read_poly_mesh(case / "constant/polyMesh")
    pieces = [read_vtp(path) for path in find_files(covered_run).boundaries]
    names = {0: "ground", 1: "ground_water", 2: "ground_street"}
    for number, name in names.items():
        n = sum(
            int(((p.cell_data["ground_patch"] == number) & (p.boundary.marker == Marker.GROUND)).sum())
            for p in pieces
        )
        assert mesh.patches[name].n == n > 0
    nut = (case / "0/nut").read_text()
    assert re.search(r"ground_water \{ type nutkAtmRoughWallFunction; z0 uniform 0.0002;", nut)
    assert re.search(r" ground \{ type nutkAtmRoughWallFunction; z0 uniform 0.03;", nut)
    lad = read_field(case / "0/lad", 1).ravel()
    cells = [read_vtu(path).cell_data["lad"] for path in find_files(covered_run).volumes]
    assert lad.tolist() == np.concatenate(cells).astype(np.float64).tolist()
    zones = (case / "constant/polyMesh/cellZones").read_text()
    assert set(re.findall(r"^(vegetation_\S+)$", zones, re.MULTILINE)) == {
        f"vegetation_{value:g}" for value in np.unique(np.round(lad[lad > 0], 3))
    }
    n_leafy = re.search(r"^vegetation\n\{\n.*\n.*\n(\d+)", zones, re.MULTILINE)
    assert n_leafy
    assert int(n_leafy[1]) == (lad > 0).sum()
    assert mesh_is_ok(run_foam("checkMesh", case))
    control = case / "system/controlDict"
    control.write_text(re.sub(r"endTime .*;", "endTime 2;", control.read_text()))
    said = run_foam("simpleFoam", case)
    assert said.count("creating porous zone: vegetation_") == zones.count("vegetation_")


@pytest.mark.long
def test_points_of_class_9_make_the_same_water_in_any_tiles(given: dict[str, Any], tmp_path: Path) -> None:
    las = laspy.read(given["pointcloud"][0])
    x, y = np.asarray(las.x) - X, np.asarray(las.y) - Y
    wet = (np.abs(y - (150 + 40 * np.sin(x / 60))) < 15) & (np.asarray(las.classification) == 2)
    las.classification[wet] = 9
    las.write(tmp_path / "wet.laz")
    areas = []
    dry = {"land_cover": [], "trees": "", "vegetation_classes": [], "land_cover_field": "class"}
    for tile_size in (150.0, 300.0):
        out = tmp_path / f"{tile_size:g}"
        others = {"pointcloud": [str(tmp_path / "wet.laz")], "water_points": True, "tile_size": tile_size}
        run(make_config(given | dry | others | {"out": str(out)}))
        report = check_run(out, StoredTerrain)
        assert report.ok, report.lines()
        record = json.loads((out / "run.json").read_text())
        assert record["counts"]["bodies of water"] == 2  # a house stands across the canal
        areas.append(record["land_cover"]["patches"][1]["area (m2)"])
        pieces = [read_vtp(path) for path in find_files(out).boundaries]
        corners = np.concatenate([p.points[p.boundary.facets[p.cell_data["ground_patch"] == 1]] for p in pieces])
        east, north = (corners.mean(axis=1)[:, :2] - (X, Y)).T
        assert abs(np.median(north - (150 + 40 * np.sin(east / 60)))) < 1.5  # cells are 5 m wide
    assert areas[0] == pytest.approx(areas[1], rel=1e-3)
    assert 6000 < areas[0] < 10_000  # 300 m of some 30 m, less the houses in it


@pytest.mark.long
def test_land_cover_without_a_known_class_is_an_error(given: dict[str, Any], tmp_path: Path) -> None:
    cover = write_layer(tmp_path / "x.gpkg", [shapely.box(X, Y, X + 50, Y + 50)], "Polygon", kind=["spaceship"])
    with pytest.raises(InputError, match="no polygon of a known class"):
        run(make_config(given | {"land_cover": [cover], "out": str(tmp_path / "out")}))
