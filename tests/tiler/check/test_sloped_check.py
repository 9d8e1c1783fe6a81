"""Tests of `citystitch check` on sloped roofs: what it finds where they or their walls are wrong."""

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

import numpy as np
import pytest
import shapely
from numpy.typing import NDArray

from pipeline.columns.adaptive import mesh_adaptive
from pipeline.columns.columns import expand_cells
from pipeline.data.mesh import ColumnMesh, Marker
from pipeline.data.roofs import Roofs
from pipeline.points_terrain.terrain import Dtm, sample_dtm
from tests.helpers.meshes import PlaneDtm, TinyCity, edit_json, write_run
from tests.helpers.sloped_towns import BOUNDS, OPTIONS, SlopedTown, sloped_town
from tests.helpers.whole_city import extract_boundary
from tiler.check.check import CheckReport, check_run
from tiler.check.roof_proofs import are_above_roofs
from tiler.check.solid_proofs import check_solids, read_outlines
from tiler.citymodels.building_index import copy_vertices
from tiler.store.out_folder import FULL_CITY_MODEL, STORE
from tiler.store.run_folder import ROOF_MOVED, Buildings, RoofRules


class Terrain:
    """A raster that can be sampled."""

    def __init__(self, dtm: Dtm) -> None:
        self._dtm = dtm

    def sample(self, xy: NDArray[np.float64], /) -> NDArray[np.float64]:
        return sample_dtm(self._dtm, xy)


@pytest.fixture(scope="module")
def town() -> SlopedTown:
    return sloped_town(0, 16)


@pytest.fixture(scope="module")
def mesh(town: SlopedTown) -> ColumnMesh:
    mesh, report = mesh_adaptive(town.plane, town.dtm, town.model.roofs, town.model.ids, OPTIONS)
    assert report.eased_nodes > 0
    return mesh


def write(folder: Path, town: SlopedTown, mesh: ColumnMesh, *, roofs: str = "planes") -> None:
    """Write the run folder of a mesh of the town."""
    boundary = extract_boundary(mesh, town.model.numbers)
    used = expand_cells(mesh)
    city = TinyCity(used, boundary, np.empty(0, np.int64), town.model, PlaneDtm(), BOUNDS)
    write_run(folder, city, boundary_data={} if mesh.moved is None else {ROOF_MOVED: mesh.moved})
    parameters: dict[str, object] = {"roofs": roofs, "mesher": "adaptive", "simplify": "clearance"}
    parameters |= {"least_spacing": 0.1, "mesh_size": 10.0, "roof_clearance": 2.0}
    edit_json(folder / "run.json", lambda record: record.update(parameters=parameters))


def check(folder: Path, town: SlopedTown) -> CheckReport:
    return check_run(folder, lambda _: Terrain(town.dtm))


def kinds(report: CheckReport) -> set[str]:
    return {fault.kind for fault in report.faults}


def test_a_town_with_sloped_roofs_is_proved(tmp_path: Path, town: SlopedTown, mesh: ColumnMesh) -> None:
    write(tmp_path, town, mesh)
    report = check(tmp_path, town)
    assert report.ok, report.lines()
    assert any("are joined with other roofs, parted from them, raised" in line for line in report.lines())
    assert any("none twice" in line for line in report.lines())


def test_a_mesh_without_order_keys_has_walls_twice(tmp_path: Path, town: SlopedTown, mesh: ColumnMesh) -> None:
    assert mesh.key is not None
    write(tmp_path, town, dataclasses.replace(mesh, key=None))
    report = check(tmp_path, town)
    assert kinds(report) >= {"wall-twice"}
    # Nothing else about the cells tells of it: they are closed, and their volumes add up.
    assert kinds(report) <= {"wall-twice", "wall-above-roof"}


def test_roofs_that_should_be_flat_are_not(tmp_path: Path, town: SlopedTown, mesh: ColumnMesh) -> None:
    write(tmp_path, town, mesh, roofs="flat")
    assert "roof-height" in kinds(check(tmp_path, town))


def test_a_wall_may_rise_to_a_roof_that_was_moved_up_and_no_further() -> None:
    """Free levels of the wall below that roof are above its plane, too, and were not moved."""
    roofs = Roofs(np.array([[0.5, 0.0, 10.0]]), np.zeros((1, 2)), np.array([[0.0, 99.0]]))
    footprint = np.array([shapely.box(0, 0, 10, 10)], dtype=object)
    buildings = Buildings(np.array([7]), footprint, np.zeros(1), np.array([15.0]), roofs)
    rules = RoofRules(sloped=True, step=1.0, clearance=2.0, slack=1.0)
    rise = np.array([[0.0, 15.3, 15.6], [0.0, 15.0, 15.3]])
    corners = np.stack((np.full((2, 3), 10.0), np.array([[5.0, 5, 5], [2, 5, 5]]), rise), axis=2)
    moved = np.array([[0.0, 0.0, 0.6], [0.0, 0.0, 0.0]])
    for way, above in ((moved, [False, False]), (moved * 0, [True, True]), (moved / 2, [True, True])):
        found = are_above_roofs(corners, way, np.zeros(2, np.int64), buildings, PlaneDtm(0, 0, 0), rules)
        assert found.tolist() == above


def inner_roof_level(town: SlopedTown, mesh: ColumnMesh) -> int:
    """A level of a sloped roof at a vertex that touches nothing but this roof."""
    plane = town.plane
    building = np.full(len(plane.xy), -2)
    for row, triangle in zip(plane.building.tolist(), plane.triangles.tolist(), strict=True):
        for vertex in triangle:
            building[vertex] = row if building[vertex] in (-2, row) else -3
    steep = np.abs(town.model.roofs.plane[:, :2]).max(axis=1) > 0.1
    vertex = next(k for k, row in enumerate(building.tolist()) if row >= 0 and steep[row])
    return int(mesh.z_start[vertex])


def raise_inner_corner(town: SlopedTown, mesh: ColumnMesh) -> ColumnMesh:
    z = mesh.z.copy()
    z[inner_roof_level(town, mesh)] += 1e-5
    return dataclasses.replace(mesh, z=z)


def lift_eaves(town: SlopedTown, mesh: ColumnMesh) -> ColumnMesh:
    """Raise a roof at the outline of its house by more than roofs may be moved."""
    gates = [
        (int(mesh.z_start[v] + level), t)
        for t in np.flatnonzero(town.plane.building >= 0).tolist()
        for v, level in zip(town.plane.triangles[t].tolist(), mesh.bottom[t].tolist(), strict=True)
        if level > 0
    ]
    level, _ = gates[0]
    z = mesh.z.copy()
    z[level : level + 3] += 4.0 + np.arange(3) * 0.1
    end = int(np.searchsorted(mesh.z_start, level, side="right"))
    top = mesh.z_start[end] - 1
    z[level : top + 1] = np.sort(np.maximum(z[level : top + 1], z[level] + 0.1 * np.arange(top + 1 - level)))
    z[top] = max(mesh.z[top], z[top])
    return dataclasses.replace(mesh, z=z, key=None)


def move_ridge(town: SlopedTown, mesh: ColumnMesh) -> ColumnMesh:
    """Raise by 0.3 m a level where two sloped roofs of one height meet, and nothing else does."""
    plane = town.plane
    at: dict[int, set[tuple[int, int]]] = {}
    for row, triangle, bottom in zip(plane.building, plane.triangles, mesh.bottom, strict=True):
        for vertex, level in zip(triangle.tolist(), bottom.tolist(), strict=True):
            at.setdefault(vertex, set()).add((int(row), level))
    rows = {vertex: {row for row, _ in found} for vertex, found in at.items()}
    ridges = [
        vertex
        for vertex, found in at.items()
        if len(found) == 2 and min(rows[vertex]) >= 0 and len({level for _, level in found}) == 1
    ]
    z = mesh.z.copy()
    level = int(mesh.z_start[ridges[0]])
    z[level] += 0.3
    assert z[level] < z[level + 1]
    return dataclasses.replace(mesh, z=z)


@pytest.mark.parametrize(
    ("change", "fault"),
    [(raise_inner_corner, "roof-height"), (lift_eaves, "roof-height"), (move_ridge, "roof-height")],
)
def test_a_roof_that_is_off_its_plane(
    tmp_path: Path,
    town: SlopedTown,
    mesh: ColumnMesh,
    change: Callable[[SlopedTown, ColumnMesh], ColumnMesh],
    fault: str,
) -> None:
    write(tmp_path, town, change(town, mesh))
    assert fault in kinds(check(tmp_path, town))


def test_a_roof_may_be_off_by_what_the_file_tells_and_by_no_more_than_its_slack(
    tmp_path: Path, town: SlopedTown, mesh: ColumnMesh
) -> None:
    moved = mesh.moved
    assert moved is not None
    off = move_ridge(town, mesh)
    way = off.z - mesh.z
    for name, told, ok in (
        ("nothing", np.zeros(len(way)), False),
        ("all but the ridge", moved, False),
        ("the ridge", moved + way, True),
        ("too much", moved + 4 * way, False),
    ):
        write(tmp_path / name, town, dataclasses.replace(off, moved=told))
        assert ("roof-height" not in kinds(check(tmp_path / name, town))) == ok, name
    inner = inner_roof_level(town, mesh)
    z, told = mesh.z.copy(), moved.copy()
    z[inner] += 0.1
    told[inner] += 0.1
    write(tmp_path / "inner", town, dataclasses.replace(mesh, z=z, moved=told))
    assert "roof-height" in kinds(check(tmp_path / "inner", town))
    z, told = mesh.z.copy(), moved.copy()
    ridge = int(np.flatnonzero(way)[0])
    z[ridge] += 1.2
    told[ridge] += 1.2
    while z[ridge + 1] <= z[ridge]:
        ridge += 1
        z[ridge] = z[ridge - 1] + 0.1
    write(tmp_path / "far", town, dataclasses.replace(mesh, z=z, moved=told))
    assert "roof-height" in kinds(check(tmp_path / "far", town))


def test_another_plane_in_the_city_model(tmp_path: Path, town: SlopedTown, mesh: ColumnMesh) -> None:
    write(tmp_path, town, mesh)

    def tilt(model: dict[str, Any]) -> None:
        sloped = [thing for thing in model["CityObjects"].values() if thing["attributes"].get("roof_plane")]
        plane = sloped[0]["attributes"]["roof_plane"]
        plane[2] += 0.01

    edit_json(tmp_path / "citymodel.city.json", tilt)
    assert "roof-height" in kinds(check(tmp_path, town))


def test_a_house_that_lost_its_walls(tmp_path: Path, town: SlopedTown, mesh: ColumnMesh) -> None:
    boundary = extract_boundary(mesh, town.model.numbers)
    number = boundary.building[boundary.marker == Marker.WALL][0]
    kept = ~((boundary.marker == Marker.WALL) & (boundary.building == number))
    write(tmp_path, town, mesh)
    less = dataclasses.replace(
        boundary, facets=boundary.facets[kept], marker=boundary.marker[kept], building=boundary.building[kept]
    )
    city = TinyCity(expand_cells(mesh), less, np.empty(0, np.int64), town.model, PlaneDtm(), BOUNDS)
    write_run(tmp_path / "less", city)
    (tmp_path / "less" / "run.json").write_text((tmp_path / "run.json").read_text())
    assert {"building-without-wall", "facet-missing"} <= kinds(check(tmp_path / "less", town))


def test_the_full_city_model_has_the_outlines_and_attributes_of_its_parts(
    sloped_run: Path, tmp_path: Path
) -> None:
    """Each number of a part or house that is another one, and a part that is moved or gone, is found."""
    outlines = read_outlines(sloped_run / STORE)
    text = (sloped_run / FULL_CITY_MODEL).read_text()
    things = json.loads(text)["CityObjects"]
    name, part = next(
        (k, one) for k, one in things.items() if "parents" in one and one["attributes"]["roof_slope"]
    )
    assert len(things[part["parents"][0]]["children"]) == part["attributes"]["roof_parts"] > 1

    def faults(change: Callable[[dict[str, Any]], None]) -> set[str]:
        model = json.loads(text)
        change(model)
        path = tmp_path / FULL_CITY_MODEL
        path.write_text(json.dumps(model))
        with TemporaryFile() as file:
            found = check_solids(path, copy_vertices(path, file), outlines=outlines)
        return {fault.kind for fault in found.faults}

    def add(attribute: str, by: float) -> Callable[[dict[str, Any]], None]:
        return lambda model: model["CityObjects"][name]["attributes"].update(
            {attribute: part["attributes"][attribute] + by}
        )

    def move(model: dict[str, Any]) -> None:
        ring = model["CityObjects"][name]["geometry"][0]["boundaries"][0][0]
        x, y, z = model["vertices"][ring[0]]
        (xmin, xmax), *_ = np.sort([model["vertices"][k] for k in ring], axis=0)[[0, -1]].T
        model["vertices"].append([x + 300 * (1 if x > (xmin + xmax) / 2 else -1), y, z])
        ring[0] = len(model["vertices"]) - 1

    def drop(model: dict[str, Any]) -> None:
        del model["CityObjects"][name]

    assert faults(lambda model: None) == set()
    for attribute, by in (("slope", 0.2), ("azimuth", 0.2), ("clipped", 0.1), ("density", 0.2), ("points", 3)):
        assert faults(add(f"roof_{attribute}", by)) == {"roof-attribute"}
    for attribute, by in (("roof_parts", -1), ("roof_planes", 2), ("lod12_height", 0.02)):
        assert "house-attribute" in faults(add(attribute, by))
    assert faults(move) & {"parts-outline", "parts-overlap"}
    assert faults(drop) >= {"house-attribute"}
