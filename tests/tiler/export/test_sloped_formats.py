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
from tests.helpers.patch_readers import corners_of, patch_of, sorted_rows, surface_of, volume
from tests.helpers.written_models import read_city_model
from tests.tiler.export.conftest import Exported
from tests.tiler.export.test_formats_openfoam import MESH, assert_in_order, volumes_of
from tiler.export.export import list_formats
from tiler.mesh_files.mesh_pieces import open_pieces
from tiler.store.out_folder import CITY_MODEL

ON_PLANE = 1e-6  # m, of a facet's corner inside a roof
HOUSE_FIELDS = ("roof_method", "roof_fallback", "roof_form", "roof_parts", "roof_planes")


def roof_facets(run: Path) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Corners of all roof facets, (k, 3, 3), and their buildings."""
    pieces = open_pieces(run)
    parts = [(part, part.marker == Marker.ROOF) for part in map(pieces.read, range(len(pieces.names)))]
    corners = np.concatenate([part.points[part.facets[roof]] for part, roof in parts])
    return corners, np.concatenate([part.building[roof] for part, roof in parts])


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


def test_vtp_has_the_building_of_each_facet(sloped_run: Path, exported: Exported) -> None:
    data = pyvista.read(exported(sloped_run, "vtp"))
    assert isinstance(data, pyvista.PolyData)
    facets = data.regular_faces
    roof = data.cell_data["marker"] == Marker.ROOF
    corners, building = np.asarray(data.points)[facets[roof]], np.asarray(data.cell_data["building"])[roof]
    assert_roofs(corners, building, read_city_model(sloped_run / CITY_MODEL))


def test_xdmf_has_every_cell(sloped_run: Path, exported: Exported) -> None:
    with h5py.File(exported(sloped_run, "xdmf").with_suffix(".h5")) as file:
        points, cells = file["points"][()], file["cells"][()]
    edges = np.diff(points[cells], axis=1)
    volumes = np.einsum("ij,ij->i", np.cross(edges[:, 0], edges[:, 1]), edges[:, 2]) / 6
    assert (volumes > 0).all()
    surface = surface_of(corners_of(open_pieces(sloped_run), patch_of))
    assert volumes.sum() == pytest.approx(volume(surface), rel=1e-9)


def test_openfoam_has_a_patch_of_sloped_roofs(sloped_run: Path, exported: Exported) -> None:
    mesh = read_poly_mesh(exported(sloped_run, "openfoam") / MESH)
    assert_in_order(mesh)
    assert (volumes_of(mesh) > 0).all()
    roofs = mesh.patches["roofs"]
    faces = mesh.points[mesh.faces[roofs.start : roofs.start + roofs.n]]
    assert sorted_rows(np.sort(faces, axis=1)) == sorted_rows(np.sort(roof_facets(sloped_run)[0], axis=1))


def test_geopackage_has_what_is_known_of_each_roof(sloped_run: Path, exported: Exported) -> None:
    meta, _, _, columns = pyogrio.raw.read(exported(sloped_run, "gpkg"))
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
def test_every_format_takes_a_mesh_with_sloped_roofs(sloped_run: Path, exported: Exported, name: str) -> None:
    assert exported(sloped_run, name).exists()
