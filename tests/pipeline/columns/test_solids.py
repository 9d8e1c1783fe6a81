"""Cells in buildings: they meet the air in walls and roofs, the soil in foundations, in one tile and in many."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import meshio
import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.columns.fixed_levels import GivenLevels, stand_on_floors
from pipeline.columns.nodes import FREE, GROUND_LEVEL, ROOF_LEVEL, Nodes, add_floors, no_seam
from pipeline.columns.order_keys import wall_gates
from pipeline.columns.underground import RegionMesh, add_soil, count_regions, split_regions
from pipeline.data.errors import ConfigError, InputError
from pipeline.data.mesh import INTERFACES, ColumnMesh, Marker, SeamEdges, find_inside
from pipeline.data.regions import Region
from stitch.pieces.conformity import compute_cell_volumes, match_facets, pair_cell_faces
from stitch.pieces.frontier import as_places
from tests.helpers.cities import crowded_blocks
from tests.helpers.programs import mesh_is_ok, run_foam
from tests.helpers.tiles import SIZE, make_town, prove_local, run_of, write_town
from tests.pipeline.columns.test_underground import (
    DEPTH,
    OPTIONS,
    Change,
    _expand,
    check,
    damage,
    drop,
    drop_facet,
    kinds,
    lose_cell,
    mix_up_cell,
    remark,
    turn,
    two_triangles,
    write_blocks,
)
from tiler.export.export import export_run, list_formats, load_format
from tiler.mesh_files.mesh_pieces import MeshPiece, open_pieces
from tiler.mesh_files.vtk_files import BoundaryPiece, VolumePiece, read_vtp, read_vtu

NO_EDGES = np.empty((0, 2), np.int32)
NO_SEAMS = SeamEdges(NO_EDGES, NO_EDGES, np.empty(0, np.int64), np.empty(0, np.bool_))


def two_houses() -> ColumnMesh:
    """Houses of 4 m and 7 m share the diagonal of a square of 10 m; the corner of either has its own columns."""
    plane = two_triangles(0, 1)
    columns = [[0.0, 2, 4, 7, 9], [0.5, 3, 5, 7, 9], [0.0, 1, 4, 6, 9], [0.0, 4, 7, 8, 9]]
    # Vertices 0 and 3 are of both; 1 is of the higher house alone, 2 of the lower one.
    bottom = np.array([[2, 2, 1], [3, 3, 2]], np.int32)
    return ColumnMesh(plane, np.arange(0, 21, 5), np.concatenate(columns), bottom, "heights")


@pytest.mark.parametrize("soil", [False, True])
def test_a_house_meets_the_air_in_walls_and_roofs_alone(soil: bool) -> None:
    """Each house is as large as its plan below its roof; all faces between regions are marked, and no others."""
    columns = two_houses()
    mesh = RegionMesh(columns, np.zeros(4, np.int32), solids=True)
    if soil:
        terrain = columns.z[columns.z_start[:-1]]
        mesh, _, lowered = add_soil(columns, terrain, no_seam(), no_seam(), OPTIONS, solids=True)
        assert len(lowered) == 0
    whole, region = _expand(mesh)
    volume, flat = compute_cell_volumes(whole.points, whole.cells)
    assert (volume > 0).all()
    assert not flat.any()
    kinds_there = np.unique(region).tolist()
    assert kinds_there == ([0, 1, 2] if soil else [0, 2])
    counts = count_regions(mesh)
    assert {kind: int((region == kind).sum()) for kind in kinds_there} == counts
    inside = 50 * 4.0 + 50 * (7 + 6.5 + 7) / 3  # the floor of the far corner is 0.5 m higher
    np.testing.assert_allclose(volume[region == Region.BUILDING].sum(), inside)

    boundary, shared = split_regions(mesh, np.array([3, 8]), (0.0, 0.0, 10.0, 10.0), NO_SEAMS)
    assert len(shared) == 0
    faces = {Region(k): pair_cell_faces(whole.cells[region == k], len(whole.points)).exterior for k in kinds_there}
    for (one, two), markers in INTERFACES.items():
        if one in faces and two in faces:
            marked = boundary.facets[np.isin(boundary.marker, markers)]
            between = faces[one][match_facets(faces[two], faces[one]).flipped]
            match = match_facets(between, marked)
            assert [len(match.missing), len(match.extra), len(match.flipped), len(match.duplicate)] == [0] * 4
    outer = boundary.facets[~find_inside(boundary.marker, (*faces,))]
    match = match_facets(pair_cell_faces(whole.cells, len(whole.points)).exterior, outer)
    assert [len(match.missing), len(match.extra), len(match.flipped), len(match.duplicate)] == [0] * 4
    # The step between the two roofs is the higher house's wall.
    walls = boundary.marker == Marker.WALL
    assert boundary.building[walls].tolist() == [8] * int(walls.sum())
    assert walls.any()
    assert sorted(boundary.building[boundary.marker == Marker.FOUNDATION].tolist()) == [3, 8]


@pytest.mark.parametrize("soil", [False, True])
def test_a_house_at_seams_has_faces_from_its_foundation_up(soil: bool) -> None:
    """Towards a tile that is missing all of them are boundary, towards one with open ground none."""
    columns = two_houses()
    mesh = RegionMesh(columns, np.zeros(4, np.int32), solids=True)
    if soil:
        mesh, _, _ = add_soil(columns, columns.z[::5], no_seam(), no_seam(), OPTIONS, solids=True)
    ends = np.array([[0, 2], [2, 3]], np.int32)
    seams = SeamEdges(ends, mesh.top[ends], np.full(2, -1), np.array([True, False]))
    boundary, shared = split_regions(mesh, np.array([3, 8]), (0.0, 0.0, 10.0, 10.0), seams)
    whole, region = _expand(mesh)
    outer = boundary.facets[~find_inside(boundary.marker, tuple(Region(k) for k in np.unique(region)))]
    exterior = pair_cell_faces(whole.cells, len(whole.points)).exterior
    match = match_facets(exterior, np.concatenate((outer, shared)))
    assert [len(match.missing), len(match.extra), len(match.flipped), len(match.duplicate)] == [0] * 4
    missing = whole.points[boundary.facets[boundary.marker == Marker.MISSING]]
    assert missing[:, :, 2].min() == (-OPTIONS.depth if soil else 0)
    assert (whole.points[shared][:, :, 0] == 10).all()
    assert not np.isin(boundary.marker, (Marker.SOUTH, Marker.EAST)).any()


def test_columns_below_roofs_begin_at_the_terrain() -> None:
    nodes = Nodes(
        np.array([0, 2, 3, 4]),
        np.array([1.0, 6, 7, 8]),
        np.array([GROUND_LEVEL, ROOF_LEVEL, ROOF_LEVEL, ROOF_LEVEL], np.int8),
        np.full(4, -1, np.int32),
        np.array([[0, 2, 3], [1, 2, 3]]),
    )
    found = add_floors(nodes, np.array([1.0, 6.5, 2]), np.zeros(3, np.bool_), np.ones(3))
    assert found.start.tolist() == [0, 2, 4, 6]
    assert found.z.tolist() == [1, 6, 6, 7, 2, 8]  # the terrain comes within 1 m of the second roof
    assert found.kind.tolist() == [GROUND_LEVEL, ROOF_LEVEL] * 3
    assert found.of_corner.tolist() == [[0, 3, 5], [1, 3, 5]]
    given = add_floors(nodes, np.zeros(3), np.array([False, True, True]), np.ones(3))
    assert given.z.tolist() == nodes.z.tolist()


def test_layers_below_a_roof_keep_the_ratios_of_their_heights() -> None:
    kind, z = np.full((2, 4), FREE, np.int8), np.array([[0.0, 2, 6, 10], [1, 9, 7, 10]])
    given = GivenLevels(np.array([0, 2], np.int32), kind, np.zeros((2, 4), np.bool_), z)
    whole, found = stand_on_floors(given, z, np.array([0.0, 1, 3, 5]), min_gap=0.1)
    np.testing.assert_allclose(found, [[0, 2, 6, 10], [1, 3, 7, 10]])
    assert whole.kept.tolist() == [0, 0]
    assert whole.kind[:, 0].tolist() == [FREE, GROUND_LEVEL]
    z[1, 0] = 6.9
    np.testing.assert_allclose(stand_on_floors(given, z, np.array([0.0, 1, 3, 5]), min_gap=0.1)[1][1, 0], 6.7)


def test_the_higher_house_makes_the_faces_of_the_lower_one() -> None:
    gates = wall_gates(two_houses(), floors=True)
    assert gates.tolist() == [[[2, 3], [16, 17]], [[0, 2], [15, 16]]]
    assert wall_gates(two_houses()).tolist() == gates[:1].tolist()


# Runs.


def regions_of(part: MeshPiece) -> NDArray[np.int8]:
    assert part.region is not None
    return part.region


@pytest.fixture(scope="module")
def filled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four tiles of blocks with soil, air and cells in buildings, not to be changed."""
    folder = tmp_path_factory.mktemp("filled")
    values = write_blocks(folder / "city", 280.0) | {"tile_size": SIZE}
    run_of(values, folder / "out", underground=DEPTH, solids=True)
    return folder / "out"


def test_houses_on_seams_are_proved(filled: Path) -> None:
    report = check(filled)
    assert report.ok, "\n".join(report.lines())
    assert report.facts["building_volume"] > 0
    assert report.facts["cells"] == json.loads((filled / "run.json").read_text())["counts"]["cells"]
    # Walls between the air of a tile and a house of the next one stand over a seam.
    pieces = open_pieces(filled)
    parts = [pieces.read(k) for k in range(len(pieces.names))]
    walls, houses = (set[tuple[int, ...]]() for _ in range(2))
    for part in parts:
        outer = pair_cell_faces(part.cells, len(part.points))
        of_house = regions_of(part)[outer.row] == Region.BUILDING
        houses |= {tuple(sorted(row)) for row in part.ids[outer.exterior[of_house]].tolist()}
        walls |= {tuple(sorted(row)) for row in part.ids[part.facets[part.marker == Marker.WALL]].tolist()}
    assert walls & houses


@pytest.mark.long
@pytest.mark.parametrize(
    ("tiles", "options"),
    [
        (1, {}),
        (2, {"roofs": "skeleton"}),
        (2, {"mesher": "layered", "underground": DEPTH}),
        (2, {"first_layer": 1.0, "top": "flat"}),
    ],
)
def test_solids_are_proved(tiles: int, options: dict[str, object], tmp_path: Path) -> None:
    values = write_blocks(tmp_path / "city", 280.0, seed=tiles) | {"tile_size": 280.0 / tiles}
    run_of(values | options, tmp_path / "out", solids=True)
    report = check(tmp_path / "out")
    assert report.ok, "\n".join(report.lines())


@pytest.mark.long
@pytest.mark.parametrize("mesher", ["adaptive", "layered"])
def test_solids_depend_on_the_surroundings_of_their_tile_alone(mesher: str, tmp_path: Path) -> None:
    far = (-2 * SIZE, -2 * SIZE, 3 * SIZE, 3 * SIZE)
    town = make_town(far, crowded_blocks(far, 100, seed=5), relief=10)
    values = write_town(tmp_path / "city", town, files=(2, 2)) | {"mesher": mesher, "tile_size": SIZE}
    values |= {"domain_height": 50.0 if mesher == "adaptive" else 38.0, "solids": True}
    least = 1.0 if mesher == "adaptive" else 1.5
    boxes = [(-by * SIZE, -by * SIZE, (1 + by) * SIZE, (1 + by) * SIZE) for by in (least + 0.1, least)]
    prove_local(values, (0, 0), tmp_path, *boxes)


def walls_over_seams(volume: VolumePiece, surface: BoundaryPiece) -> NDArray[np.int64]:
    """Rows of the walls between the air of a piece and houses of the next ones."""
    walls = np.flatnonzero(surface.boundary.marker == Marker.WALL)
    exterior = pair_cell_faces(volume.mesh.cells, len(volume.mesh.points)).exterior
    match = match_facets(exterior, surface.vertex[surface.boundary.facets[walls]].astype(np.int32))
    return np.delete(walls, match.extra)


def build_in_the_open(volume: VolumePiece, surface: BoundaryPiece) -> tuple[VolumePiece, BoundaryPiece]:
    """Mark a cell of air that touches no house as one of a building."""
    boundary = surface.boundary
    houses = surface.points[boundary.facets[np.isin(boundary.marker, (Marker.WALL, Marker.ROOF))].ravel()]
    apart = ~np.isin(as_places(volume.mesh.points), as_places(houses))[volume.mesh.cells].any(axis=1)
    region = volume.cell_data["region"].copy()
    region[np.flatnonzero(apart & (region == Region.AIR))[0]] = Region.BUILDING
    return replace(volume, cell_data={"region": region}), surface


DAMAGE: dict[str, tuple[Change, set[str]]] = {
    "a cell is lost": (lose_cell(Region.BUILDING), {"facet-missing", "building-volume", "counts"}),
    "a cell is marked as air": (
        mix_up_cell(Region.BUILDING, Region.AIR),
        {"wall-or-roof-missing", "building-volume", "volume"},
    ),
    "a cell of air is marked as building": (
        build_in_the_open,
        {"wall-or-roof-missing", "building-volume", "volume", "building-cell-astray"},
    ),
    "a wall is lost": (drop(Marker.WALL), {"wall-or-roof-missing", "counts"}),
    "a roof points into the air": (turn(Marker.ROOF), {"wall-or-roof-flipped", "facet-direction"}),
    "a foundation is a roof": (remark(Marker.FOUNDATION, Marker.ROOF), {"foundation-missing"}),
}
OFTEN = 3  # of these are tried every day


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.long] * (k >= OFTEN)) for k, name in enumerate(DAMAGE)]
)
def test_damage_of_buildings_is_found(name: str, filled: Path, tmp_path: Path) -> None:
    change, expected = DAMAGE[name]
    assert expected <= kinds(damage(filled, tmp_path / "out", change))


def test_a_wall_over_a_seam_that_is_lost_is_found(filled: Path, tmp_path: Path) -> None:
    volumes, surfaces = (sorted((filled / name).iterdir()) for name in ("mesh", "boundary"))
    rows = [walls_over_seams(read_vtu(one), read_vtp(two)) for one, two in zip(volumes, surfaces, strict=True)]
    k = next(k for k, found in enumerate(rows) if len(found))
    damage(filled, tmp_path / "out", lambda volume, surface: (volume, drop_facet(surface, int(rows[k][0]))), k)
    assert {"seam-mixed", "counts"} <= kinds(tmp_path / "out")


def test_a_record_without_solids_is_found(filled: Path, tmp_path: Path) -> None:
    shutil.copytree(filled, tmp_path / "out")
    record = json.loads((filled / "run.json").read_text())
    record["parameters"]["solids"] = False
    (tmp_path / "out" / "run.json").write_text(json.dumps(record))
    with pytest.raises(InputError, match=r"of 0 \(air\) and 1 \(soil\) alone"):
        check(tmp_path / "out")


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("msh", {"cells": "prism"}),
        ("openfoam", {"buildings": "patches"}),
    ],
)
def test_what_cannot_hold_solids_is_refused(
    name: str, options: dict[str, str], filled: Path, tmp_path: Path
) -> None:
    with pytest.raises(ConfigError, match=r"cells in buildings|buildings of this mesh have cells"):
        export_run(filled, tmp_path / f"out{load_format(name).suffix}", name=name, options=options)


@pytest.mark.long
@pytest.mark.timeout(1200)
def test_openfoam_parts_the_regions(filled: Path, tmp_path: Path) -> None:
    pieces = open_pieces(filled)
    parts = [pieces.read(k) for k in range(len(pieces.names))]
    regions = np.concatenate([regions_of(part) for part in parts])
    counts = {kind.name.lower(): int((regions == kind).sum()) for kind in Region}
    markers = np.concatenate([part.marker for part in parts])
    walls = int(np.isin(markers, (Marker.WALL, Marker.ROOF)).sum())
    for number in (None, 2):
        case = tmp_path / str(number)
        export_run(filled, case, name="openfoam", options={} if number is None else {"parts": number})
        text = run_foam("checkMesh", case, parts=number)
        assert mesh_is_ok(text), text[-3000:]
        zones = re.findall(r"^    (air|soil|building) +(\d+) ", text, re.MULTILINE)
        assert {name: int(n) for name, n in zones} == counts
    text = run_foam("splitMeshRegions", tmp_path / "None", "-cellZonesOnly", "-overwrite")
    faces = re.findall(r"^\d+\t+\d+\t\d+\t(\d+)$", text, re.MULTILINE)
    assert len(faces) == 3, text[:3000]
    assert str(walls) in faces


@pytest.mark.long
@pytest.mark.parametrize("name", sorted(list_formats()))
def test_every_format_takes_cells_in_buildings(name: str, filled: Path, tmp_path: Path) -> None:
    target = tmp_path / f"a{load_format(name).suffix}"
    export_run(filled, target, name=name)
    if name in ("msh", "msh2"):
        mesh = meshio.read(target)
        number, _ = mesh.field_data["building"]
        n = sum(
            int((physical == number).sum())
            for block, physical in zip(mesh.cells, mesh.cell_data["gmsh:physical"], strict=True)
            if block.type == "tetra"
        )
        pieces = open_pieces(filled)
        found = [regions_of(pieces.read(k)) for k in range(len(pieces.names))]
        assert n == int((np.concatenate(found) == Region.BUILDING).sum())
    assert target.exists()
