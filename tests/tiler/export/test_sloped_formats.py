"""Exports of a city with sloped roofs: closed surfaces, roofs on the planes that the city model states."""

import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyogrio
import pytest
import pyvista
import shapely
from numpy.typing import NDArray

from pipeline.data.citymodel import CityModel
from pipeline.data.mesh import Marker
from pipeline.data.roofs import ROOF_METHODS, is_flat, roof_heights
from tests.helpers.foam_reader import read_poly_mesh
from tests.helpers.written_models import read_city_model
from tests.tiler.export.test_formats_buildings import READERS as BY_BUILDING
from tests.tiler.export.test_formats_buildings import sorted_rows
from tests.tiler.export.test_formats_cgns import corners_of
from tests.tiler.export.test_formats_glb import read_document, turned
from tests.tiler.export.test_formats_openfoam import MESH, assert_in_order, volumes_of
from tests.tiler.export.test_formats_surfaces import READERS as SURFACES
from tests.tiler.export.test_formats_surfaces import Facets, facets_of, open_edges, volume
from tiler.export.export import export_run, list_formats, load_format
from tiler.mesh_files.mesh_pieces import open_pieces
from tiler.store.out_folder import CITY_MODEL

ON_PLANE = 1e-6  # m, of a facet's corner inside a roof
HOUSE_FIELDS = ("roof_method", "roof_fallback", "roof_form", "roof_parts", "roof_planes")


def roof_facets(run: Path) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Corners of all roof facets, (k, 3, 3), and their buildings."""
    found = facets_of(open_pieces(run))
    roof = found.marker == Marker.ROOF
    assert found.building is not None
    return found.corners[roof], found.building[roof]


def assert_roofs(corners: NDArray[np.float64], building: NDArray[np.int64], model: CityModel) -> None:
    """Roof facets lie on the plane of the building of their number, but at vertices where roofs meet."""
    assert set(building.tolist()) == set(model.numbers.tolist())
    order = np.argsort(model.numbers)
    row = order[np.searchsorted(model.numbers, building, sorter=order)]
    assert shapely.contains_xy(shapely.buffer(model.polygons[row], 0.002), *corners.mean(axis=1)[:, :2].T).all()
    of, xy = np.repeat(row, 3), corners.reshape(-1, 3)
    inside = shapely.distance(shapely.boundary(model.polygons[of]), shapely.points(xy[:, :2])) > 0.01
    off = np.abs(xy[:, 2] - roof_heights(model.roofs, of, xy[:, :2]))
    assert off[inside].max(initial=0) < ON_PLANE
    assert np.median(off) < 0.01
    sloped = ~is_flat(model.roofs)
    assert sloped.sum() > 30
    for k in np.flatnonzero(sloped).tolist():
        assert np.ptp(corners[row == k][..., 2]) > 0.1, model.ids[k]


def test_roofs_of_the_mesh_lie_on_the_planes_of_the_city_model(sloped_run: Path) -> None:
    assert_roofs(*roof_facets(sloped_run), read_city_model(sloped_run / CITY_MODEL))


@pytest.mark.parametrize("name", sorted(SURFACES))
def test_surfaces_are_closed(sloped_run: Path, tmp_path: Path, name: str) -> None:
    export_run(sloped_run, tmp_path / f"a.{name}", name=name)
    found, expected = SURFACES[name](tmp_path / f"a.{name}"), facets_of(open_pieces(sloped_run))
    assert sorted_rows(found.corners) == sorted_rows(expected.corners)
    assert open_edges(found) == 0
    assert volume(found) == pytest.approx(volume(expected), rel=1e-9)
    if found.building is not None:
        roof = found.marker == Marker.ROOF
        assert_roofs(found.corners[roof], found.building[roof], read_city_model(sloped_run / CITY_MODEL))


@pytest.mark.parametrize("name", sorted(BY_BUILDING))
def test_each_building_has_its_walls_and_its_sloped_roof(sloped_run: Path, tmp_path: Path, name: str) -> None:
    path = tmp_path / f"a{load_format(name).suffix}"
    export_run(sloped_run, path, name=name, options={"buildings": "patches"})
    found, expected = BY_BUILDING[name](path), corners_of(open_pieces(sloped_run), by_building=True)
    if name != "cgns":
        del expected["Internal"]
    if name == "glb":
        origin = read_document(path)[0]["asset"]["extras"]["origin"]
        expected = {patch: turned(corners, origin) for patch, corners in expected.items()}
    assert sorted(found) == sorted(expected)
    for patch, corners in expected.items():
        assert sorted_rows(found[patch]) == sorted_rows(corners), patch
    if name != "cgns":
        assert open_edges(Facets(np.concatenate(list(found.values())), np.empty(0, np.int64))) == 0


def test_vtp_has_the_building_of_each_facet(sloped_run: Path, tmp_path: Path) -> None:
    export_run(sloped_run, tmp_path / "a.vtp", name="vtp")
    data = pyvista.read(tmp_path / "a.vtp")
    assert isinstance(data, pyvista.PolyData)
    facets = data.regular_faces
    roof = data.cell_data["marker"] == Marker.ROOF
    corners, building = np.asarray(data.points)[facets[roof]], np.asarray(data.cell_data["building"])[roof]
    assert_roofs(corners, building, read_city_model(sloped_run / CITY_MODEL))


def test_xdmf_has_every_cell(sloped_run: Path, tmp_path: Path) -> None:
    export_run(sloped_run, tmp_path / "a.xdmf", name="xdmf")
    with h5py.File(tmp_path / "a.h5") as file:
        points, cells = file["points"][()], file["cells"][()]
    edges = np.diff(points[cells], axis=1)
    volumes = np.einsum("ij,ij->i", np.cross(edges[:, 0], edges[:, 1]), edges[:, 2]) / 6
    assert (volumes > 0).all()
    assert volumes.sum() == pytest.approx(volume(facets_of(open_pieces(sloped_run))), rel=1e-9)


def test_openfoam_has_a_patch_of_sloped_roofs(sloped_run: Path, tmp_path: Path) -> None:
    export_run(sloped_run, tmp_path / "case", name="openfoam")
    mesh = read_poly_mesh(tmp_path / "case" / MESH)
    assert_in_order(mesh)
    assert (volumes_of(mesh) > 0).all()
    roofs = mesh.patches["roofs"]
    faces = mesh.points[mesh.faces[roofs.start : roofs.start + roofs.n]]
    assert sorted_rows(np.sort(faces, axis=1)) == sorted_rows(np.sort(roof_facets(sloped_run)[0], axis=1))


def test_geopackage_has_what_is_known_of_each_roof(sloped_run: Path, tmp_path: Path) -> None:
    export_run(sloped_run, tmp_path / "a.gpkg", name="gpkg")
    meta, _, _, columns = pyogrio.raw.read(tmp_path / "a.gpkg")
    table = dict(zip(meta["fields"], columns, strict=True))
    document = json.loads((sloped_run / CITY_MODEL).read_text())
    things = {name: thing["attributes"] for name, thing in document["CityObjects"].items() if "geometry" in thing}
    assert len(set(table)) > 25
    for row, name in enumerate(table["id"].tolist()):
        for field in set(table) - {"id", "house"}:
            assert same(table[field][row], things[name].get(field)), (name, field)
    assert set(table["roof_method"]) <= set(ROOF_METHODS)
    assert {"planes", "family"} & set(table["roof_method"])
    parts = dict(zip(*np.unique(table["house"], return_counts=True), strict=True))
    assert [parts[house] for house in table["house"]] == table["roof_parts"].tolist()
    assert (table["roof_planes"] <= table["roof_parts"]).all()
    for house in parts:
        rows = table["house"] == house
        assert all(len(set(table[field][rows])) == 1 for field in HOUSE_FIELDS)
    seen = table["roof_points"] > 0
    for field, low, high in (
        ("roof_rmse", 0, 5),
        ("roof_median", 0, 1),
        ("roof_within", 0.0, 1.0),
        ("roof_coverage", 0.0, 1.0),
        ("roof_density", 0.5, 5),
        ("roof_clipped", 0.0, 1.0),
        ("roof_slope", 0.0, 80.0),
    ):
        values = table[field][seen].astype(float)
        assert ((values >= low) & (values <= high)).all(), field
    assert np.median(table["roof_within"][seen].astype(float)) > 0.9


def same(one: Any, other: Any) -> bool:
    """A value of a column, and that of the city model: lists are text, numbers NaN where there is none."""
    if other is None:
        return one is None or bool(np.isnan(one))
    return bool(json.loads(one) == other if isinstance(other, list) else one == other)


@pytest.mark.parametrize("name", sorted(list_formats()))
def test_every_format_takes_a_mesh_with_sloped_roofs(sloped_run: Path, tmp_path: Path, name: str) -> None:
    target = tmp_path / f"a{load_format(name).suffix}"
    export_run(sloped_run, target, name=name)
    assert target.exists()
