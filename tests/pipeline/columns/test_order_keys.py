"""Tests of sloped roofs in the mesh, and of the keys by which columns beside steep tops of walls are merged."""

import dataclasses

import numpy as np
import pytest

from pipeline.columns.adaptive import mesh_adaptive
from pipeline.columns.columns import expand_cells, lowest_gap
from pipeline.columns.order_keys import set_order_keys, wall_gates
from pipeline.data.mesh import ColumnMesh, Marker, PlaneMesh
from pipeline.data.roofs import roof_heights
from stitch.pieces.conformity import compute_cell_volumes
from tests.helpers.sloped_towns import OPTIONS, SlopedTown, sloped_town
from tests.helpers.terraces import prove_conforming
from tests.helpers.whole_city import extract_boundary
from tiler.check.wall_proofs import Walls, check_overlap, measure_walls


def walls_of(mesh: ColumnMesh, town: SlopedTown) -> Walls:
    boundary = extract_boundary(mesh, town.model.numbers)
    return measure_walls(expand_cells(mesh).points[boundary.facets[boundary.marker == Marker.WALL]])


def wall_area(mesh: ColumnMesh) -> float:
    """Area of all walls from the levels at which their two sides begin."""
    column = np.repeat(np.arange(len(mesh.plane.xy)), np.diff(mesh.z_start))
    gates = wall_gates(mesh)
    length = np.hypot(*(mesh.plane.xy[column[gates[:, 0, 0]]] - mesh.plane.xy[column[gates[:, 1, 0]]]).T)
    height = mesh.z[gates[:, :, 1]] - mesh.z[gates[:, :, 0]]
    return float((length * height.sum(axis=1) / 2).sum())


@pytest.mark.parametrize("seed", range(4))
def test_sloped_roofs_conform_and_walls_are_there_once(seed: int) -> None:
    town = sloped_town(seed)
    mesh, report = mesh_adaptive(town.plane, town.dtm, town.model.roofs, town.model.ids, OPTIONS)
    assert lowest_gap(mesh)[1] == 0
    prove_conforming(mesh, town.model.numbers)
    cells = expand_cells(mesh)
    assert (compute_cell_volumes(cells.points, cells.cells)[0] > 0).all()
    assert report.crossed_edges == 0
    assert report.keyed_levels > 0
    walls = walls_of(mesh, town)
    assert check_overlap(walls).faults == ()
    assert walls.area.sum() == pytest.approx(wall_area(mesh), rel=1e-12)
    # Without keys, both sides of some walls have facets above the roof: the check finds them.
    without = walls_of(dataclasses.replace(mesh, key=None), town)
    assert {fault.kind for fault in check_overlap(without).faults} == {"wall-twice"}
    assert without.area.sum() > walls.area.sum() + 10


def test_roofs_are_exact_but_where_they_meet_others() -> None:
    town = sloped_town(1)
    mesh, _ = mesh_adaptive(town.plane, town.dtm, town.model.roofs, town.model.ids, OPTIONS)
    plane = town.plane
    inside = np.flatnonzero(plane.building >= 0)
    corner, building = plane.triangles[inside].ravel(), np.repeat(plane.building[inside].astype(np.int64), 3)
    z = mesh.z[(mesh.z_start[plane.triangles[inside]] + mesh.bottom[inside]).ravel()]
    error = np.abs(z - roof_heights(town.model.roofs, building, plane.xy[corner]))
    pairs = np.unique(np.column_stack((plane.triangles.ravel(), np.repeat(plane.building, 3))), axis=0)
    alone = np.bincount(pairs[:, 0], minlength=len(plane.xy)) == 1
    assert error[alone[corner]].max() == 0
    assert alone[corner].sum() > 50


# A square in two triangles; the wall between them rises steeply from vertex 0 to vertex 3.
SQUARE = PlaneMesh(
    np.array([[0.0, 0.0], [0.0, 10.0], [10.0, 0.0], [10.0, 10.0]]),
    np.array([[0, 1, 3], [0, 2, 3]], np.int32),
    np.array([-1, 0], np.int32),
)


def steep_wall() -> ColumnMesh:
    """Ground at 0 m; the roof over one triangle is at 4 m at vertex 0 and at 13 m at vertex 3."""
    columns = [[0.0, 4.0, 8.0, 24.0], [0.0, 8.0, 24.0], [4.0, 13.0, 24.0], [0.0, 4.0, 9.0, 13.0, 24.0]]
    start = np.concatenate(([0], np.cumsum([len(column) for column in columns])))
    bottom = np.array([[0, 0, 0], [1, 0, 3]], np.int32)
    return ColumnMesh(SQUARE, start, np.concatenate(columns), bottom, "heights")


def test_gates_by_hand() -> None:
    mesh = steep_wall()
    # Vertex 0 has the levels 0 to 3, vertex 3 the levels 10 to 14.
    assert wall_gates(mesh).tolist() == [[[0, 1], [10, 13]]]


def test_keys_let_the_merge_pass_through_both_ends_of_a_gate() -> None:
    mesh = steep_wall()
    gates, free = wall_gates(mesh), np.zeros(4, np.bool_)
    # The segment above 4 m at vertex 0 has its middle at 6 m, that below 13 m at vertex 3 at 11 m.
    keyed, unmet = set_order_keys(mesh, mesh.z, free, gates)
    assert unmet == 0
    assert keyed.key is not None
    key = keyed.key
    assert key[1] + key[2] > key[12] + key[13]
    assert key[13] + key[14] > key[0] + key[1]
    for i in range(4):
        assert (np.diff(key[mesh.z_start[i] : mesh.z_start[i + 1]]) > 0).all()
        ends = [mesh.z_start[i], mesh.z_start[i + 1] - 1]
        assert key[ends].tolist() == mesh.z[ends].tolist()
    # One end given: the other one alone moves.
    for given in (0, 3):
        fixed = np.zeros(4, np.bool_)
        fixed[given] = True
        one, unmet = set_order_keys(mesh, mesh.z, fixed, gates)
        assert unmet == 0
        assert one.key is not None
        column = slice(mesh.z_start[given], mesh.z_start[given + 1])
        assert one.key[column].tolist() == mesh.z[column].tolist()
    # Both given: what is not met is counted.
    fixed = np.array([True, False, False, True])
    still, unmet = set_order_keys(mesh, mesh.z, fixed, gates)
    assert (still.key, unmet) == (None, 1)


def test_between_roofs_the_lowest_key_sinks() -> None:
    """A wall between two roofs tapers to nothing at a given vertex that stands lower than its other end."""
    columns = [[16.0, 18.0, 24.0], [12.0, 24.0], [20.0, 24.0], [17.5, 18.7, 24.0]]
    start = np.concatenate(([0], np.cumsum([len(column) for column in columns])))
    plane = dataclasses.replace(SQUARE, building=np.array([0, 1], np.int32))
    bottom = np.array([[0, 0, 0], [0, 0, 1]], np.int32)
    mesh = ColumnMesh(plane, start, np.concatenate(columns), bottom, "heights")
    given, gates = np.array([True, False, False, False]), wall_gates(mesh)
    assert gates.tolist() == [[[0, 0], [7, 8]]]
    # Above 16 m the segment at vertex 0 has its middle at 17 m: that of the wall at vertex 3 must be lower.
    keyed, unmet = set_order_keys(mesh, mesh.z, given, gates)
    assert unmet == 0
    assert keyed.key is not None
    assert keyed.key[:3].tolist() == [16.0, 18.0, 24.0]
    assert (np.diff(keyed.key[7:]) > 0).all()
    assert keyed.key[7] + keyed.key[8] < 34.0
    # The ground stays, and with it what is in the way.
    ground = dataclasses.replace(mesh, plane=dataclasses.replace(SQUARE, building=np.array([-1, 1], np.int32)))
    still, unmet = set_order_keys(ground, ground.z, given, gates)
    assert unmet == 1
    assert still.key is None or still.key[7] == 17.5


def test_level_walls_need_no_keys() -> None:
    mesh = steep_wall()
    level = dataclasses.replace(mesh, z=np.where(mesh.z == 13.0, 4.5, np.where(mesh.z == 9.0, 4.2, mesh.z)))
    keyed, unmet = set_order_keys(level, level.z, np.zeros(4, np.bool_), wall_gates(level))
    assert (keyed.key, unmet) == (None, 0)
