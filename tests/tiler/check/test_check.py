"""The check proves a sound run folder and fails on each way of tampering with it."""

import json
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from numpy.typing import NDArray

from pipeline.data.citymodel import take_model
from pipeline.data.errors import InputError
from pipeline.data.mesh import Boundary, Marker, TetMesh
from pipeline.data.roofs import flat_roofs
from stitch.pieces.conformity import match_facets, pair_cell_faces
from stitch.pieces.frontier import Settled
from tests.helpers.meshes import (
    CORNER,
    HOUSES,
    LEVELS,
    SIZE,
    PlaneDtm,
    TinyCity,
    compact,
    edit_json,
    load_plane,
    make_city,
    mark_boundary,
    split_city,
    with_boundary,
    with_mesh,
    write_run,
)
from tests.helpers.vtk_writers import make_stream, write_vtp, write_vtu
from tiler.check.check import CheckReport, _Sums, check_run
from tiler.check.proofs import Dtm, Fault, merge_faults
from tiler.mesh_files.vtk_xml import write_data_file

Tamper = Callable[[TinyCity], TinyCity]
N_PROOFS = 18


@pytest.fixture(scope="module")
def city() -> TinyCity:
    return make_city()


def check(directory: Path, dtm: Dtm | None = None) -> CheckReport:
    def load_dtm(path: Path) -> Dtm:
        assert path == directory / "store.zarr"
        return dtm or PlaneDtm()

    return check_run(directory, load_dtm)


def kinds(report: CheckReport) -> set[str]:
    return {fault.kind for fault in report.faults}


# --- sound folders ---------------------------------------------------------------------------------


@pytest.mark.parametrize("names", ["", "0_0 1_0", "1_0 0_0"])
def test_a_sound_folder_is_proved(tmp_path: Path, city: TinyCity, names: str) -> None:
    """In one piece, or in two in any order."""
    halves = split_city(city, 50.0)
    write_run(tmp_path, city, pieces={name: halves[name] for name in names.split()})

    report = check(tmp_path)

    assert report.ok, report.lines()
    assert len(report.proofs) == N_PROOFS
    assert report.facts["cells"] == len(city.mesh.cells)
    assert report.facts["points"] == len(city.mesh.points)
    assert report.facts["facets"] == len(city.boundary.facets)
    assert report.facts["building parts"] == len(HOUSES)
    assert bool(names) == any("seams of 2 pieces are bitwise equal from both sides" in s for s in report.lines())
    # The two houses that touch in a corner, up to the lower roof: two levels of it.
    assert report.facts["non_manifold_edges"] == 2
    assert any("touch in a corner only: (" in line for line in report.lines())
    # By hand: the box below LEVELS[-1], minus the plane's mean, minus the prisms between plane and roof.
    assert report.facts["volume"] == pytest.approx(volume_by_hand(), rel=1e-12)
    assert report.lines()[-1] == f"{tmp_path}: everything is proved"


def volume_by_hand() -> float:
    squares = {square: LEVELS[level - 1] for all_, level in HOUSES.values() for square in all_}
    dtm, total = PlaneDtm(), 0.0
    for i in range(10):
        for j in range(8):
            middle = np.array([[CORNER[0] + SIZE * (i + 0.5), CORNER[1] + SIZE * (j + 0.5)]])
            total += SIZE**2 * (LEVELS[-1] - squares.get((i, j), float(dtm.sample(middle)[0])))
    return total


def test_bare_terrain_is_proved(tmp_path: Path) -> None:
    write_run(tmp_path, make_city(houses={}, shape=(3, 2)))
    assert check(tmp_path).ok


def test_a_house_walled_in_by_higher_ones_needs_no_wall(tmp_path: Path) -> None:
    """Its outline touches air nowhere: higher neighbours on three sides, the border on the fourth."""
    high = tuple((i, j) for i in range(3) for j in range(2) if (i, j) != (1, 0))
    write_run(tmp_path, make_city(houses={"high": (high, 3), "low": (((1, 0),), 1)}, shape=(5, 4)))
    assert check(tmp_path).ok


def test_the_stated_top_is_proved(tmp_path: Path, city: TinyCity) -> None:
    write_run(tmp_path, city)
    edit_json(tmp_path / "run.json", lambda record: record["region"].update(top=LEVELS[-1]))
    assert check(tmp_path).ok


# --- tampering with the mesh -----------------------------------------------------------------------


def remark(city: TinyCity, cells: NDArray[np.bool_]) -> TinyCity:
    """Keep some cells and make the boundary anew, as a faulty mesher would."""
    mesh = compact(TetMesh(city.mesh.points, city.mesh.cells[cells]))
    boundary, owner = mark_boundary(mesh, city.model, city.bounds)
    return replace(city, mesh=mesh, boundary=boundary, owner=owner)


def inner_cell(city: TinyCity) -> int:
    return next(i for i in range(len(city.mesh.cells)) if i not in set(city.owner.tolist()))


def cell_under(city: TinyCity, marker: Marker) -> int:
    return int(city.owner[city.boundary.marker == marker][0])


def remove_cell(city: TinyCity) -> TinyCity:
    return with_mesh(city, city.mesh.points, np.delete(city.mesh.cells, inner_cell(city), axis=0))


def duplicate_cell(city: TinyCity) -> TinyCity:
    cells = city.mesh.cells
    return with_mesh(city, city.mesh.points, np.concatenate([cells, cells[[inner_cell(city)]]]))


def invert_cell(city: TinyCity) -> TinyCity:
    cells = city.mesh.cells.copy()
    cells[inner_cell(city), [0, 1]] = cells[inner_cell(city), [1, 0]]
    return with_mesh(city, city.mesh.points, cells)


def add_flat_cell(city: TinyCity) -> TinyCity:
    """A cell on four vertices of the flat top."""
    top = city.boundary.facets[city.boundary.marker == Marker.TOP]
    cell = np.concatenate([top[0], [np.setdiff1d(top[1], top[0])[0]]]).astype(np.int32)
    return with_mesh(city, city.mesh.points, np.concatenate([city.mesh.cells, cell[None]]))


def inner_vertex(city: TinyCity) -> int:
    return int(np.setdiff1d(city.mesh.cells, city.boundary.facets)[0])


def hang_vertex(city: TinyCity) -> TinyCity:
    """One cell gets its own copy of an inner vertex, 1 cm away."""
    vertex, cells = inner_vertex(city), city.mesh.cells.copy()
    points = np.concatenate([city.mesh.points, city.mesh.points[[vertex]] + [0, 0, 0.01]])
    row, column = np.argwhere(cells == vertex)[0]
    cells[row, column] = len(points) - 1
    return with_mesh(city, points, cells)


def unmerge_vertex(city: TinyCity) -> TinyCity:
    """Half the cells around an inner vertex get a copy of it in the same place."""
    vertex, cells = inner_vertex(city), city.mesh.cells.copy()
    places = np.argwhere(cells == vertex)
    row, column = places[: len(places) // 2].T
    cells[row, column] = len(city.mesh.points)
    return with_mesh(city, np.concatenate([city.mesh.points, city.mesh.points[[vertex]]]), cells)


def push_inner_vertex_far(city: TinyCity) -> TinyCity:
    points = city.mesh.points.copy()
    points[inner_vertex(city), 2] += 30
    return with_mesh(city, points, city.mesh.cells)


def add_unused_vertex(city: TinyCity) -> TinyCity:
    points = np.concatenate([city.mesh.points, city.mesh.points[:1] + 1.0])
    return with_mesh(city, points, city.mesh.cells)


def drop_top_layer(city: TinyCity) -> TinyCity:
    above = city.mesh.points[city.mesh.cells][:, :, 2].max(axis=1) > LEVELS[-2]
    return remark(city, ~above)


def drop_middle_layer(city: TinyCity) -> TinyCity:
    """A cavity through the whole region, with a sound boundary of its own."""
    z = city.mesh.points[city.mesh.cells][:, :, 2]
    return remark(city, ~((z.min(axis=1) >= LEVELS[1]) & (z.max(axis=1) <= LEVELS[2])))


def drop_ground_cell(city: TinyCity) -> TinyCity:
    """A pit in open ground, marked as ground."""
    chosen = np.ones(len(city.mesh.cells), np.bool_)
    chosen[cell_under(city, Marker.GROUND)] = False
    return remark(city, chosen)


def fill_house(city: TinyCity) -> TinyCity:
    """Mesh the lowest house as if it were not there, boundary included."""
    houses = {name: house for name, house in HOUSES.items() if name != "lower-neighbour"}
    return replace(make_city(houses=houses), model=city.model)


def leave_house_out_of_model(city: TinyCity) -> TinyCity:
    model, keep = city.model, np.arange(len(city.model)) != 1
    return replace(city, model=take_model(model, keep))


def raise_roof_in_model(city: TinyCity) -> TinyCity:
    roof = city.model.roof.copy()
    roof[0] += 2e-6
    return replace(city, model=replace(city.model, roofs=flat_roofs(roof)))


def lower_roof_in_model(city: TinyCity) -> TinyCity:
    roof = city.model.roof.copy()
    roof[0] -= 2e-6
    return replace(city, model=replace(city.model, roofs=flat_roofs(roof)))


def move_footprint_in_model(city: TinyCity) -> TinyCity:
    polygons = city.model.polygons.copy()
    polygons[0] = shapely.transform(polygons[0], lambda xy: xy + np.array([0.004, 0.0]))
    return replace(city, model=replace(city.model, polygons=polygons))


def shrink_footprint_in_model(city: TinyCity) -> TinyCity:
    """A courtyard in the model that the mesh has not."""
    polygons = city.model.polygons.copy()
    polygons[0] = shapely.difference(polygons[0], shapely.buffer(shapely.centroid(polygons[0]), 0.5))
    return replace(city, model=replace(city.model, polygons=polygons))


def shift(city: TinyCity, marker: Marker, axis: int, by: float) -> TinyCity:
    """Move all vertices of one kind of facet, cells and boundary alike."""
    points = city.mesh.points.copy()
    points[np.unique(city.boundary.facets[city.boundary.marker == marker]), axis] += by
    return with_mesh(city, points, city.mesh.cells)


def lift_ground_vertex(city: TinyCity) -> TinyCity:
    points, marker = city.mesh.points.copy(), city.boundary.marker
    ground = np.unique(city.boundary.facets[marker == Marker.GROUND])
    points[np.setdiff1d(ground, city.boundary.facets[marker != Marker.GROUND])[0], 2] += 2e-6
    return with_mesh(city, points, city.mesh.cells)


def lean_wall(city: TinyCity) -> TinyCity:
    """Move one wall vertex sideways by 0.1 mm, cells and boundary alike: on the outline, not vertical."""
    points = city.mesh.points.copy()
    inside = np.abs(points[:, 0] - (CORNER[0] + 1 * SIZE)) < 1e-6
    chosen = inside & (np.abs(points[:, 1] - (CORNER[1] + 2 * SIZE)) < 1e-6) & (points[:, 2] == LEVELS[1])
    points[chosen, 0] += 1e-4
    return with_mesh(city, points, city.mesh.cells)


CELLS: dict[str, tuple[Tamper, set[str]]] = {
    "cell removed": (remove_cell, {"facet-missing", "volume", "counts"}),
    "cell twice": (duplicate_cell, {"face-shared", "volume", "counts"}),
    "cell inverted": (invert_cell, {"cell-inverted", "face-same-side", "volume"}),
    "flat cell": (add_flat_cell, {"cell-flat", "facet-missing", "facet-extra", "counts"}),
    "hanging vertex": (hang_vertex, {"facet-missing", "volume", "counts"}),
    "unmerged vertex": (unmerge_vertex, {"vertex-duplicate"}),
    "vertex moved far": (push_inner_vertex_far, {"cell-inverted"}),
    "vertex unused": (add_unused_vertex, {"vertex-unused", "counts"}),
    "top layer dropped": (drop_top_layer, {"building-without-roof", "plan-area", "counts"}),
    "middle layer dropped": (
        drop_middle_layer,
        {"building-without-roof", "ground-off-dtm", "plan-area", "counts"},
    ),
    "pit in the ground": (drop_ground_cell, {"ground-off-dtm", "facet-direction", "counts"}),
    "house not in the mesh": (fill_house, {"building-missing", "counts"}),
    "house not in the model": (leave_house_out_of_model, {"building-unknown", "counts"}),
    "roof too low": (raise_roof_in_model, {"roof-height"}),
    "roof too high": (lower_roof_in_model, {"roof-height", "wall-above-roof"}),
    "footprint moved": (move_footprint_in_model, {"roof-off-footprint", "wall-off-outline"}),
    "courtyard roofed over": (shrink_footprint_in_model, {"roof-area", "roof-off-footprint"}),
    "ground off the DTM": (lift_ground_vertex, {"ground-off-dtm"}),
    "west side off": (
        partial(shift, marker=Marker.WEST, axis=0, by=-2e-6),
        {"side-off-box", "vertex-outside-box", "plan-area"},
    ),
    "north side off": (
        partial(shift, marker=Marker.NORTH, axis=1, by=-2e-6),
        {"side-off-box", "plan-area"},
    ),
    "leaning wall": (lean_wall, {"wall-not-vertical", "volume"}),
}


def counts_of(city: TinyCity) -> dict[str, int]:
    return {
        "cells": len(city.mesh.cells),
        "points": len(city.mesh.points),
        "facets": len(city.boundary.facets),
        "building parts": len(city.model),
    }


def test_a_lower_top_needs_the_stated_one(tmp_path: Path) -> None:
    """A whole layer dropped from above is a sound mesh of a lower box: the stated top alone tells."""
    city = drop_top_layer(make_city(houses={"one": (((1, 1),), 2)}, shape=(4, 3)))
    write_run(tmp_path, city)
    assert check(tmp_path).ok
    edit_json(tmp_path / "run.json", lambda record: record["region"].update(top=LEVELS[-1]))
    report = check(tmp_path)
    assert kinds(report) == {"top-height"}
    assert "stated 18.000000 m" in report.faults[0].detail


# --- tampering with the boundary -------------------------------------------------------------------


def first_of(city: TinyCity, marker: Marker, house: int | None = None) -> int:
    """Return the first facet with a marker, of a building of the model if one is given."""
    chosen = city.boundary.marker == marker
    if house is not None:
        chosen &= city.boundary.building == city.model.numbers[house]
    return int(np.flatnonzero(chosen)[0])


def keep_facets(city: TinyCity, rows: NDArray[Any]) -> TinyCity:
    old = city.boundary
    return with_boundary(city, facets=old.facets[rows], marker=old.marker[rows], building=old.building[rows])


def remove_facet(city: TinyCity) -> TinyCity:
    rows = np.arange(len(city.boundary.facets))
    return keep_facets(city, rows[rows != first_of(city, Marker.WALL)])


def repeat_facet(city: TinyCity) -> TinyCity:
    rows = np.arange(len(city.boundary.facets))
    return keep_facets(city, np.append(rows, first_of(city, Marker.WALL)))


def flip_facet(city: TinyCity) -> TinyCity:
    facets, row = city.boundary.facets.copy(), first_of(city, Marker.WALL)
    facets[row] = facets[row, ::-1]
    return with_boundary(city, facets=facets)


def add_inner_facet(city: TinyCity) -> TinyCity:
    """A face between two cells of the air, put in the boundary as a top."""
    old = city.boundary
    face = city.mesh.cells[inner_cell(city), :3][None]
    return with_boundary(
        city,
        facets=np.concatenate([old.facets, face]),
        marker=np.append(old.marker, np.int32(Marker.TOP)),
        building=np.append(old.building, np.int64(-1)),
    )


def mark(city: TinyCity, *, marker: Marker, to: int, building: int | None = None) -> TinyCity:
    """Give one facet another marker, and the number of a building of the model if one is given."""
    row, old = first_of(city, marker), city.boundary
    markers, buildings = old.marker.copy(), old.building.copy()
    markers[row] = to
    buildings[row] = -1 if building is None else city.model.numbers[building]
    return with_boundary(city, marker=markers, building=buildings)


def give(city: TinyCity, *, row: int, number: int) -> TinyCity:
    building = city.boundary.building.copy()
    building[row] = number
    return with_boundary(city, building=building)


def give_wall_away(city: TinyCity) -> TinyCity:
    return give(city, row=first_of(city, Marker.WALL, 3), number=int(city.model.numbers[4]))


def give_roof_away(city: TinyCity) -> TinyCity:
    """To the courtyard house: as high, elsewhere."""
    return give(city, row=first_of(city, Marker.ROOF, 1), number=int(city.model.numbers[2]))


def give_ground_to_house(city: TinyCity) -> TinyCity:
    return give(city, row=first_of(city, Marker.GROUND), number=int(city.model.numbers[0]))


def give_roof_to_stranger(city: TinyCity) -> TinyCity:
    return give(city, row=first_of(city, Marker.ROOF), number=17)


def give_party_wall_to_lower_house(city: TinyCity) -> TinyCity:
    points, old = city.mesh.points, city.boundary
    centres = points[old.facets].mean(axis=1)
    high, low = city.model.numbers[:2]
    above = centres[:, 2] > city.model.roof[1]
    on_wall = shapely.dwithin(city.model.polygons[1], shapely.points(centres[:, :2]), 1e-6)
    row = np.flatnonzero((old.marker == Marker.WALL) & (old.building == high) & above & on_wall)[0]
    return give(city, row=int(row), number=int(low))


def drop_all(city: TinyCity, marker: Marker, house: int) -> TinyCity:
    old = city.boundary
    gone = (old.marker == marker) & (old.building == city.model.numbers[house])
    return keep_facets(city, ~gone)


def swallow_walls(city: TinyCity) -> TinyCity:
    """Give all walls of one corner house to the other."""
    building = city.boundary.building.copy()
    building[(city.boundary.marker == Marker.WALL) & (building == city.model.numbers[4])] = city.model.numbers[5]
    return with_boundary(city, building=building)


def side_as_wall(city: TinyCity) -> TinyCity:
    """The side of the box over the house on the border, given to that house."""
    old, marker, building = city.boundary, city.boundary.marker.copy(), city.boundary.building.copy()
    centres = shapely.points(city.mesh.points[old.facets].mean(axis=1)[:, :2])
    over = shapely.dwithin(city.model.polygons[3], centres, 1e-6) & (old.marker == Marker.EAST)
    row = np.flatnonzero(over)[0]
    marker[row], building[row] = Marker.WALL, city.model.numbers[3]
    return with_boundary(city, marker=marker, building=building)


OPEN = {"facet-missing", "boundary-open", "counts"}
FACETS: dict[str, tuple[Tamper, set[str]]] = {
    "facet removed": (remove_facet, OPEN),
    "facet twice": (repeat_facet, {"facet-duplicate", "boundary-open", "counts"}),
    "facet flipped": (flip_facet, {"facet-flipped", "boundary-open", "wall-twice"}),
    "facet inside": (add_inner_facet, {"boundary-open", "counts", "facet-extra", "plan-area", "volume"}),
    "ground as wall": (
        partial(mark, marker=Marker.GROUND, to=2, building=0),
        {"plan-area", "volume", "wall-not-vertical", "wall-off-outline"},
    ),
    "ground as roof": (
        partial(mark, marker=Marker.GROUND, to=3, building=0),
        {"roof-area", "roof-height", "roof-off-footprint"},
    ),
    "ground as top": (partial(mark, marker=Marker.GROUND, to=4), {"facet-direction", "plan-area"}),
    "wall as ground": (partial(mark, marker=Marker.WALL, to=1), {"facet-direction", "ground-off-dtm"}),
    "wall as roof": (
        partial(mark, marker=Marker.WALL, to=3, building=0),
        {"facet-direction", "roof-height"},
    ),
    "wall as west": (partial(mark, marker=Marker.WALL, to=5), {"side-off-box"}),
    "wall of nobody": (partial(mark, marker=Marker.WALL, to=2), {"building-unknown"}),
    "roof as ground": (partial(mark, marker=Marker.ROOF, to=1), {"ground-off-dtm", "roof-area"}),
    "top as roof": (
        partial(mark, marker=Marker.TOP, to=3, building=0),
        {"facet-direction", "plan-area", "roof-area", "roof-height", "roof-off-footprint"},
    ),
    "west as east": (partial(mark, marker=Marker.WEST, to=6), {"facet-on-side", "side-off-box"}),
    "west as wall": (
        partial(mark, marker=Marker.WEST, to=2, building=0),
        {"facet-on-side", "wall-off-outline"},
    ),
    "side as wall of the house below": (side_as_wall, {"facet-on-side", "wall-above-roof"}),
    "marker 0": (partial(mark, marker=Marker.WALL, to=0), {"marker-unknown"}),
    "marker 10": (partial(mark, marker=Marker.TOP, to=10), {"marker-unknown", "plan-area", "volume"}),
    "marker -3": (partial(mark, marker=Marker.WALL, to=-3), {"marker-unknown"}),
    "wall of another house": (give_wall_away, {"wall-off-outline"}),
    "party wall of the lower house": (give_party_wall_to_lower_house, {"wall-above-roof"}),
    "roof of another house": (give_roof_away, {"roof-off-footprint", "roof-area"}),
    "roof of a stranger": (give_roof_to_stranger, {"building-unknown", "roof-area"}),
    "ground of a house": (give_ground_to_house, {"building-astray"}),
    "house without walls": (partial(drop_all, marker=Marker.WALL, house=2), OPEN | {"building-without-wall"}),
    "house without roof": (
        partial(drop_all, marker=Marker.ROOF, house=2),
        OPEN | {"building-without-roof", "plan-area", "volume"},
    ),
    "walls of the neighbour": (swallow_walls, {"building-without-wall", "wall-off-outline"}),
}


@pytest.mark.parametrize("name", [*CELLS, *FACETS])
def test_tampering_with_the_mesh_and_its_boundary(tmp_path: Path, city: TinyCity, name: str) -> None:
    tamper, expected = (CELLS | FACETS)[name]
    write_run(tmp_path, tamper(city))
    edit_json(tmp_path / "run.json", lambda record: record.update(counts=counts_of(city)))

    assert kinds(check(tmp_path)) == expected


# --- tampering with the files ----------------------------------------------------------------------


def edit_run(change: Callable[[dict[str, Any]], None]) -> Callable[[Path], None]:
    return lambda folder: edit_json(folder / "run.json", change)


def edit_model(change: Callable[[dict[str, Any]], None]) -> Callable[[Path], None]:
    return lambda folder: edit_json(folder / "citymodel.city.json", change)


def test_both_city_models_are_proved(tmp_path: Path, city: TinyCity) -> None:
    write_run(tmp_path, city)
    files = [tmp_path / name for name in ("citymodel.city.json", "citymodel-full.city.json")]
    texts = [file.read_text() for file in files]
    for file, text in zip(files, texts, strict=True):
        edit_json(
            file,
            lambda model: model["metadata"].update(referenceSystem=model["metadata"]["referenceSystem"] + "1"),
        )
        assert kinds(check(tmp_path)) == {"model-crs"}
        file.write_text(text)
    edit_json(files[1], lambda model: model["CityObjects"]["corner-a"]["attributes"].update(ground_height=-1.0))
    (found,) = (proof for proof in check(tmp_path).proofs if "before simplification" in proof.claim)
    assert {fault.kind for fault in found.faults} >= {"solid-height"}


def add_building(model: dict[str, Any]) -> None:
    new = json.loads(json.dumps(model["CityObjects"]["corner-a"]))
    new["attributes"]["number"] += 1
    model["CityObjects"]["another"] = new


def take_solid(model: dict[str, Any], house: str = "corner-a") -> list[Any]:
    """Faces of the solid of a house."""
    faces: list[Any] = model["CityObjects"][house]["geometry"][1]["boundaries"][0]
    return faces


def raise_vertices(model: dict[str, Any]) -> None:
    """The roof of a solid 5 m up, walls too; attributes as they were."""
    for vertex in {vertex for ring in take_solid(model)[1] for vertex in ring}:
        model["vertices"][vertex][2] += 5000


def move_solid(model: dict[str, Any]) -> None:
    """The whole solid 2 m to the east, the outline as it was."""
    place = {}
    for face in take_solid(model):
        for ring in face:
            for k, vertex in enumerate(ring):
                if vertex not in place:
                    x, y, z = model["vertices"][vertex]
                    place[vertex] = len(model["vertices"])
                    model["vertices"].append([x + 2000, y, z])
                ring[k] = place[vertex]


def turn_solid(model: dict[str, Any]) -> None:
    for face in take_solid(model):
        for ring in face:
            ring.reverse()


def drop_solid(model: dict[str, Any]) -> None:
    del model["CityObjects"]["corner-a"]["geometry"][1]


def drop_wall(model: dict[str, Any]) -> None:
    take_solid(model).pop()
    model["CityObjects"]["corner-a"]["geometry"][1]["semantics"]["values"][0].pop()


def add_parent(model: dict[str, Any]) -> None:
    model["CityObjects"]["corner-a"]["parents"] = ["corner-b"]


def nudge_volume(folder: Path) -> None:
    """Move a wall vertex by the last bit of its x, in the volume alone."""
    mesh = make_city().mesh
    points = mesh.points.copy()
    points[make_city().boundary.facets[400, 0], 0] += np.spacing(CORNER[0])
    write_vtu(folder / "mesh" / "0_0.vtu", TetMesh(points, mesh.cells))


def shuffle_vertices(folder: Path) -> None:
    """Write the volume with its points in another order: the boundary's array `vertex` is then wrong."""
    mesh = make_city().mesh
    order = np.random.default_rng(3).permutation(len(mesh.points))
    cells = np.argsort(order).astype(np.int32)[mesh.cells]
    write_vtu(folder / "mesh" / "0_0.vtu", TetMesh(mesh.points[order], cells))


def unmerge_boundary(folder: Path) -> None:
    """Let one facet of the boundary file have its own copy of a vertex."""
    city = make_city()
    facets, n = city.boundary.facets.copy(), len(city.mesh.points)
    points = np.concatenate([city.mesh.points, city.mesh.points[facets[:1, 0]]])
    facets[0, 0] = n
    write_vtp(folder / "boundary" / "0_0.vtp", points, replace(city.boundary, facets=facets))


def add_unused_boundary_point(folder: Path) -> None:
    """Write the boundary with all the points of the volume, those inside too."""
    city = make_city()
    facets, n_facets, n = city.boundary.facets, len(city.boundary.facets), len(city.mesh.points)
    sections = {
        "Points": [make_stream("Points", city.mesh.points, np.float64)],
        "Polys": [
            make_stream("connectivity", facets.ravel(), np.int32),
            make_stream("offsets", 3 * np.arange(1, n_facets + 1), np.int32),
        ],
        "PointData": [make_stream("vertex", np.arange(n), np.int64)],
        "CellData": [
            make_stream("marker", city.boundary.marker, np.int32),
            make_stream("building", city.boundary.building, np.int64),
        ],
    }
    counts = {"NumberOfPoints": n, "NumberOfPolys": n_facets}
    write_data_file(folder / "boundary" / "0_0.vtp", "PolyData", counts, sections)


FILES: dict[str, tuple[Callable[[Path], None], set[str]]] = {
    "cells off": (edit_run(lambda run: run["counts"].update(cells=1685)), {"counts"}),
    "points off": (edit_run(lambda run: run["counts"].update(points=490)), {"counts"}),
    "facets off": (edit_run(lambda run: run["counts"].update(facets=0)), {"counts"}),
    "buildings off": (edit_run(lambda run: run["counts"].update(buildings=7)), {"counts"}),
    "not done": (edit_run(lambda run: run.update(status="running")), {"not-done"}),
    "top off": (edit_run(lambda run: run["region"].update(top=18.00001)), {"top-height"}),
    "east border off": (
        edit_run(lambda run: run["region"]["bounds"].__setitem__(2, 121100.12501)),
        {"side-off-box", "plan-area"},
    ),
    "building gone": (
        edit_model(lambda model: model["CityObjects"].pop("corner-a")),
        {"building-unknown", "counts"},
    ),
    "building added": (edit_model(add_building), {"building-missing", "counts"}),
    "roof height off": (
        edit_model(
            lambda model: model["CityObjects"]["corner-a"]["attributes"].update(roof_height=LEVELS[1] + 2e-6)
        ),
        {"roof-height"},
    ),
    "solid raised": (edit_model(raise_vertices), {"solid-height", "solid-volume"}),
    "solid moved": (edit_model(move_solid), {"solid-plan"}),
    "solid inside out": (edit_model(turn_solid), {"solid-volume"}),
    "solid gone": (edit_model(drop_solid), {"solid-missing"}),
    "solid open": (edit_model(drop_wall), {"solid-open"}),
    "height off": (
        edit_model(lambda model: model["CityObjects"]["corner-a"]["attributes"].update(height=3.0)),
        {"height-attribute"},
    ),
    "part of another house": (edit_model(add_parent), {"parts"}),
    "last bit of a vertex": (nudge_volume, {"facet-missing", "facet-extra", "vertex-link"}),
    "other order of points": (shuffle_vertices, {"vertex-link"}),
    "boundary vertex twice": (unmerge_boundary, {"vertex-duplicate", "vertex-link"}),
    "boundary vertex unused": (add_unused_boundary_point, {"vertex-unused"}),
}


@pytest.mark.parametrize("name", FILES)
def test_tampering_with_the_files(tmp_path: Path, city: TinyCity, name: str) -> None:
    tamper, expected = FILES[name]
    write_run(tmp_path, city)
    tamper(tmp_path)

    assert kinds(check(tmp_path)) == expected


def test_ground_against_another_dtm(tmp_path: Path, city: TinyCity) -> None:
    class Hole:
        def sample(self, xy: NDArray[np.float64], /) -> NDArray[np.float64]:
            return np.full(len(xy), np.nan)

    write_run(tmp_path, city)
    (whole,) = check(tmp_path, PlaneDtm(a=1 + 2e-6)).faults
    assert whole.kind == "ground-off-dtm"
    assert check(tmp_path, PlaneDtm(a=1 + 5e-7)).ok
    assert kinds(check(tmp_path, Hole())) == {"ground-off-dtm"}
    write_run(tmp_path / "split", city, pieces=split_city(city, 50.0))
    (split,) = check(tmp_path / "split", PlaneDtm(a=1 + 2e-6)).faults
    assert (split.kind, split.count) == (whole.kind, whole.count), "vertices over a seam count once"


# --- seams -----------------------------------------------------------------------------------------


def test_a_seam_that_differs_in_the_last_bit_is_a_fault(tmp_path: Path, city: TinyCity) -> None:
    pieces = split_city(city, 50.0)
    mesh, boundary = pieces["1_0"]
    points = mesh.points.copy()
    left = {tuple(point) for point in pieces["0_0"][0].points.tolist()}
    inside = set(range(len(points))) - set(boundary.facets.ravel().tolist())
    vertex = next(i for i in sorted(inside) if tuple(points[i].tolist()) in left)
    points[vertex, 2] = np.nextafter(points[vertex, 2], np.inf)
    pieces["1_0"] = (TetMesh(points, mesh.cells), boundary)
    write_run(tmp_path, city, pieces=pieces)

    report = check(tmp_path)
    assert kinds(report) == {"seam-open", "counts"}
    assert check_run(tmp_path, load_plane, workers=2).lines() == report.lines()


Pieces = dict[str, tuple[TetMesh, Boundary]]


def add_facet(pieces: Pieces, name: str, face: NDArray[np.int32], marker: Marker, building: int = -1) -> None:
    mesh, old = pieces[name]
    facets, marks = np.concatenate((old.facets, face[None])), np.append(old.marker, np.int32(marker))
    pieces[name] = mesh, Boundary(facets, marks, np.append(old.building, np.int64(building)))


def seam_face(pieces: Pieces) -> NDArray[np.int32]:
    """An exterior face of the western piece that is not in its boundary."""
    mesh, boundary = pieces["0_0"]
    exterior = pair_cell_faces(mesh.cells, len(mesh.points)).exterior
    face: NDArray[np.int32] = exterior[match_facets(exterior, boundary.facets).missing[0]]
    return face


def seam_as_wall(pieces: Pieces, city: TinyCity) -> None:
    """A face of the seam, written as a wall by both pieces: each boundary alone is as good as before."""
    face, number = seam_face(pieces), int(city.model.numbers[0])
    corners, points = pieces["0_0"][0].points[face], pieces["1_0"][0].points
    twin = np.array([np.flatnonzero((points == corner).all(axis=1))[0] for corner in corners[::-1]], np.int32)
    add_facet(pieces, "0_0", face, Marker.WALL, number)
    add_facet(pieces, "1_0", twin, Marker.WALL, number)


def seam_as_missing(pieces: Pieces, city: TinyCity) -> None:
    add_facet(pieces, "0_0", seam_face(pieces), Marker.MISSING)


def seam_as_side(pieces: Pieces, city: TinyCity) -> None:
    add_facet(pieces, "0_0", seam_face(pieces), Marker.EAST)


def leave_out_seam_wall(pieces: Pieces, city: TinyCity) -> None:
    """A wall over the seam that its piece leaves to the neighbour, who has no such face."""
    mesh, old = pieces["0_0"]
    over = (mesh.points[old.facets][..., 0] == CORNER[0] + 50).all(axis=1)
    kept = np.arange(len(old.facets)) != np.flatnonzero(over & (old.marker == Marker.WALL))[0]
    pieces["0_0"] = mesh, Boundary(old.facets[kept], old.marker[kept], old.building[kept])


def drop_piece(pieces: Pieces, city: TinyCity) -> None:
    del pieces["1_0"]


def repeat_piece(pieces: Pieces, city: TinyCity) -> None:
    """A piece under two names."""
    pieces["2_0"] = pieces["1_0"]


SEAMS: dict[str, tuple[Callable[[Pieces, TinyCity], None], set[str]]] = {
    "seam as wall on both sides": (seam_as_wall, {"facet-extra", "wall-off-outline"}),
    "seam as missing on one side": (seam_as_missing, {"facet-extra", "boundary-open"}),
    "seam as a side": (seam_as_side, {"facet-extra", "boundary-open", "side-off-box", "counts"}),
    "wall over the seam left out": (leave_out_seam_wall, {"seam-open", "boundary-open", "counts"}),
    "piece dropped": (drop_piece, {"seam-open", "boundary-open", "plan-area", "counts"}),
    "piece twice": (repeat_piece, {"seam-open", "boundary-open", "plan-area", "roof-area", "counts"}),
}


@pytest.mark.parametrize("name", SEAMS)
def test_tampering_with_a_seam(tmp_path: Path, city: TinyCity, name: str) -> None:
    tamper, expected = SEAMS[name]
    pieces = split_city(city, 50.0)
    tamper(pieces, city)
    write_run(tmp_path, city, pieces=pieces)
    found = check(tmp_path)
    assert kinds(found) >= expected, found.lines()
    assert all(fault.places or fault.kind in ("plan-area", "volume", "counts") for fault in found.faults)


def test_all_houses_that_are_missing_are_counted(tmp_path: Path, city: TinyCity) -> None:
    write_run(tmp_path, replace(make_city(houses={}), model=city.model))
    (fault,) = (fault for fault in check(tmp_path).faults if fault.kind == "building-missing")
    assert (fault.count, len(fault.places)) == (len(HOUSES), 3)
    inside = shapely.points(np.array(fault.places)[:, :2])
    order = np.argsort(city.model.numbers)[:3]
    assert shapely.intersects(city.model.polygons[order], inside).all()
    np.testing.assert_array_equal(np.array(fault.places)[:, 2], city.model.roof[order])


def test_a_house_that_is_missing_beside_missing_tiles(tmp_path: Path, city: TinyCity) -> None:
    """Where parts of the region are not there, houses count whose place is in the plan of the others."""
    write_run(tmp_path, mark(fill_house(city), marker=Marker.WEST, to=Marker.MISSING))
    assert "building-missing" in kinds(check(tmp_path))


def test_a_seam_that_settles_bit_by_bit_counts_once() -> None:
    none = np.empty((0, 3, 3))
    lines = np.empty((0, 2, 3))
    sums = _Sums.start(0)
    for pairs in ([[0, 1]], [], [[0, 1], [1, 2]]):
        seams = np.array(pairs, np.int64).reshape(-1, 2)
        sums.add_settled(Settled(len(pairs), seams, seams, none, none, none, none, none, lines, lines))
    assert sums.seams.tolist() == [[0, 1], [1, 2]]


def test_a_roof_of_a_building_in_another_piece(tmp_path: Path, city: TinyCity) -> None:
    """Its building is far from the piece, and is known all the same."""
    pieces = split_city(city, 50.0)
    (_, boundary), (_, other) = pieces.values()
    far = np.setdiff1d(other.building, boundary.building)[0]
    building = boundary.building.copy()
    building[np.flatnonzero(boundary.marker == Marker.ROOF)[0]] = far
    name, (mesh, _) = next(iter(pieces.items()))
    write_run(tmp_path, city, pieces=pieces | {name: (mesh, replace(boundary, building=building))})
    assert kinds(check(tmp_path)) >= {"roof-off-footprint", "roof-area"}
    assert "building-unknown" not in kinds(check(tmp_path))


# --- the report ------------------------------------------------------------------------------------


def test_a_fault_tells_place_value_and_bound(tmp_path: Path, city: TinyCity) -> None:
    write_run(tmp_path, lift_ground_vertex(city))
    report = check(tmp_path)
    (fault,) = report.faults
    assert (fault.kind, fault.count) == ("ground-off-dtm", 1)
    assert fault.detail == "2e-06 m off; bound: 1e-06 m"
    (line,) = (line for line in report.lines() if "ground-off-dtm" in line)
    x, y, z = fault.places[0]
    assert line == f"      ground-off-dtm: 1, 2e-06 m off; bound: 1e-06 m, at ({x:.3f}, {y:.3f}, {z:.3f})"
    assert report.lines()[-1] == f"{tmp_path}: 1 kind of fault"


def test_faults_of_one_kind_are_counted_and_the_first_places_named(tmp_path: Path, city: TinyCity) -> None:
    write_run(tmp_path, city, pieces=split_city(city, 50.0))
    report = check(tmp_path, PlaneDtm(a=0.0))
    (fault,) = report.faults
    assert fault.count == len(np.unique(city.boundary.facets[city.boundary.marker == Marker.GROUND]))
    assert len(fault.places) == 3


def test_faults_of_one_kind_add_up() -> None:
    one = Fault("a", 2, ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0)), "first")
    two = Fault("a", 3, ((2.0, 0.0, 0.0), (3.0, 0.0, 0.0)), "second")
    other = Fault("b", 1, (), "other")
    joined = Fault("a", 5, ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (2.0, 0.0, 0.0)), "first")
    assert merge_faults([one, other, two]) == (joined, other)


def test_the_folder_is_left_alone(tmp_path: Path, city: TinyCity) -> None:
    write_run(tmp_path, city)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    check(tmp_path)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


# --- files that cannot be used ---------------------------------------------------------------------


def cut(name: str, part: float) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        data = (folder / name).read_bytes()
        (folder / name).write_bytes(data[: int(part * len(data))])

    return change


def write_other_cells(folder: Path) -> None:
    """A quadrilateral instead of a tetrahedron."""
    rows, types = np.arange(4, dtype=np.int32), np.array([9], np.uint8)
    cells = [
        make_stream(name, array, array.dtype)
        for name, array in (("connectivity", rows), ("offsets", np.array([4], np.int32)), ("types", types))
    ]
    sections = {"Points": [make_stream("Points", np.eye(4, 3), np.float64)], "Cells": cells}
    counts = {"NumberOfPoints": 4, "NumberOfCells": 1}
    write_data_file(
        folder / "mesh" / "0_0.vtu", "UnstructuredGrid", counts, sections | {"PointData": [], "CellData": []}
    )


def write_record(text: str) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        (folder / "run.json").write_text(text)

    return change


def write_bad_volume(points: NDArray[np.float64], cells: NDArray[np.int32]) -> Callable[[Path], None]:
    return lambda folder: write_vtu(folder / "mesh" / "0_0.vtu", TetMesh(points, cells))


def write_bad_boundary(folder: Path) -> None:
    facets = np.array([[0, 1, 2]], np.int32)
    boundary = Boundary(facets, np.ones(1, np.int32), np.full(1, -1))
    write_vtp(folder / "boundary" / "0_0.vtp", np.full((3, 3), np.inf), boundary)


def edit_house(change: Callable[[dict[str, Any]], None]) -> Callable[[Path], None]:
    return edit_model(lambda model: change(model["CityObjects"]["corner-a"]))


ONE_CELL = np.array([[0, 1, 2, 3]], np.int32)
UNUSABLE: dict[str, tuple[Callable[[Path], None], str]] = {
    "no record": (lambda folder: (folder / "run.json").unlink(), r"run\.json: cannot be read"),
    "cut record": (cut("run.json", 0.5), r"run\.json: is no JSON"),
    "list as record": (write_record("[]"), "no JSON object"),
    "deep record": (write_record("[" * 99999), "is no JSON"),
    "other schema": (edit_run(lambda run: run.update(schema=2)), "schema 2, expected 1"),
    "no counts": (edit_run(lambda run: run.pop("counts")), "a field is missing or wrong"),
    "bounds turned": (edit_run(lambda run: run["region"]["bounds"].reverse()), "are no box"),
    "bounds of three": (edit_run(lambda run: run["region"]["bounds"].pop()), "a field is missing or wrong"),
    "no city model": (
        lambda folder: (folder / "citymodel.city.json").unlink(),
        r"citymodel\.city\.json: cannot be read",
    ),
    "other CityJSON": (edit_model(lambda model: model.update(version="1.1")), "is no CityJSON 2.0"),
    "no transform": (edit_model(lambda model: model.pop("transform")), "a field is missing or wrong"),
    "no objects": (edit_model(lambda model: model.update(CityObjects=[])), "a field is missing or wrong"),
    "no number": (
        edit_house(lambda house: house["attributes"].pop("number")),
        "building 'corner-a': a field",
    ),
    "no footprint": (edit_house(lambda house: house.update(geometry=[])), "building 'corner-a': a field"),
    "vertex below range": (
        edit_house(lambda house: house["geometry"][0].update(boundaries=[[[0, 1, -1]]])),
        "building 'corner-a': a field",
    ),
    "vertex out of range": (
        edit_house(lambda house: house["geometry"][0].update(boundaries=[[[0, 1, 999]]])),
        "building 'corner-a': a field",
    ),
    "number too large": (
        edit_house(lambda house: house["attributes"].update(number=2**63)),
        "is no JSON",
    ),
    "infinite number": (
        edit_house(lambda house: house["attributes"].update(number=float("inf"))),
        "is no JSON",
    ),
    "infinite count": (
        edit_run(lambda run: run["counts"].update(cells=float("inf"))),
        "is no JSON",
    ),
    "one number twice": (
        edit_house(lambda house: house["attributes"].update(number=363100012078463)),
        "two buildings have one number",
    ),
    "no index": (lambda folder: (folder / "mesh.pvtu").unlink(), r"mesh\.pvtu: cannot be read"),
    "cut index": (cut("boundary.pvtp", 0.5), r"boundary\.pvtp: not a file of ours"),
    "no volume piece": (
        lambda folder: (folder / "mesh" / "0_0.vtu").unlink(),
        r"the piece .*0_0\.vtu is missing",
    ),
    "no boundary piece": (
        lambda folder: (folder / "boundary" / "0_0.vtp").unlink(),
        r"the piece .*0_0\.vtp is missing",
    ),
    "cut volume": (cut("mesh/0_0.vtu", 0.7), r"0_0\.vtu: not a file of ours or damaged"),
    "cut volume head": (cut("mesh/0_0.vtu", 0.01), r"0_0\.vtu: not a file of ours or damaged"),
    "cut boundary": (cut("boundary/0_0.vtp", 0.7), r"0_0\.vtp: not a file of ours or damaged"),
    "other cells": (write_other_cells, "it holds cells that are no tetrahedra"),
    "vertex beyond the points": (write_bad_volume(np.zeros((3, 3)), ONE_CELL), r"vertex 0\.\.3 of 3 points"),
    "NaN in the volume": (write_bad_volume(np.full((4, 3), np.nan), ONE_CELL), "a coordinate is not finite"),
    "infinity in the boundary": (write_bad_boundary, r"0_0\.vtp: .*a coordinate is not finite"),
}


@pytest.mark.parametrize("name", UNUSABLE)
def test_files_that_cannot_be_used(tmp_path: Path, city: TinyCity, name: str) -> None:
    spoil, message = UNUSABLE[name]
    write_run(tmp_path, city)
    spoil(tmp_path)

    with pytest.raises(InputError, match=message) as error:
        check(tmp_path)
    assert "run" in str(error.value).split(";")[-1], "the next move"
    assert error.value.exit_code == 1


def test_pieces_of_different_names(tmp_path: Path, city: TinyCity) -> None:
    write_run(tmp_path, city)
    (tmp_path / "boundary" / "0_0.vtp").rename(tmp_path / "boundary" / "7_7.vtp")
    index = tmp_path / "boundary.pvtp"
    index.write_text(index.read_text().replace("0_0", "7_7"))
    with pytest.raises(InputError, match=r"only one of mesh\.pvtu and boundary\.pvtp names the piece '0_0'"):
        check(tmp_path)
