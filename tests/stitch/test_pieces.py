"""Pieces of a tiled mesh: boundaries and numbers that fit together, and the files that are made of them."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest
import pyvista
import shapely
from numpy.typing import NDArray
from shapely import affinity

from pipeline.columns.adaptive import mesh_adaptive
from pipeline.columns.columns import expand_cells, extract_boundary, find_used_points, split_boundary
from pipeline.data.errors import GeometryError, InputError, OutputError
from pipeline.data.mesh import Boundary, Marker, SeamEdges, TetMesh
from pipeline.plane_mesh.plane import mesh_plane
from stitch.pieces.conformity import match_facets, pair_cell_faces, pair_edges, pair_faces
from stitch.pieces.frontier import find_edges_below
from stitch.pieces.numbering import (
    LOCAL_BITS,
    MOST_TILES,
    collect_ids,
    corner_part,
    first_id,
    number_columns,
    number_without_gaps,
    seam_part,
    tile_part,
)
from stitch.seams.facets import label_beyond
from stitch.tiling.grid import Key, SeamKey, corner_keys, make_grid, seam_keys, tile_keys
from tests.helpers.cities import Bounds, hilly_dtm, tilted_dtm
from tests.helpers.stitching import OPTIONS, Scene, glue, random_scene, scene_of
from tests.helpers.terraces import terrace_town
from tests.helpers.tiled_runs import (
    City,
    Pieces,
    SampledDtm,
    Split,
    count_city,
    cut_city,
    mesh_city,
    number_city,
    seam_edges,
    split_all,
    write_numbered,
    write_tiled_run,
)
from tests.helpers.vtk_writers import write_vtu
from tiler.check.check import CheckReport, check_run
from tiler.mesh_files.merged import VERTEX_ID, write_merged_boundary, write_merged_volume
from tiler.mesh_files.vtk_files import read_vtp, read_vtu
from tiler.stages.pieces import prove_seams

SQUARE: Bounds = (0.0, 0.0, 420.0, 420.0)
FOUR = make_grid(SQUARE, tile_size=210.0, mesh_size=10.0)
SIDES = (Marker.WEST, Marker.EAST, Marker.SOUTH, Marker.NORTH)


def prove_split(pieces: dict[Key, Split]) -> Boundary:
    """Prove that the pieces' boundaries are the glued mesh's, each facet once, and return them on its points."""
    meshes = [mesh for mesh, _, _ in pieces.values()]
    glued = glue(meshes)
    facets, marker, building, seams = [], [], [], []
    for mesh, boundary, shared in pieces.values():
        points = expand_cells(mesh).points
        both, index = np.unique(np.concatenate((glued.points, points)), axis=0, return_inverse=True)
        assert len(both) == len(glued.points)
        to_glued = index.reshape(-1)[len(both) :].astype(np.int32)
        facets.append(to_glued[boundary.facets])
        marker.append(boundary.marker)
        building.append(boundary.building)
        seams.append(to_glued[shared])
    whole = Boundary(np.concatenate(facets), np.concatenate(marker), np.concatenate(building))
    exterior = pair_cell_faces(glued.cells, len(glued.points)).exterior
    match = match_facets(exterior, whole.facets)
    assert [len(rows) for rows in (match.missing, match.extra, match.flipped, match.duplicate)] == [0] * 4
    assert len(pair_edges(whole.facets).open) == 0
    # Seam facets: each from two tiles, in opposite orientations, and none on the boundary.
    every = np.concatenate(seams)
    pairs = pair_faces(every)
    assert [len(rows) for rows in (pairs.exterior, pairs.same_side, pairs.shared)] == [0] * 3
    assert len(match_facets(exterior, every).extra) == len(every)
    return whole


def prove_marks(boundary: Boundary, city: City) -> None:
    """Prove that sides are on the region's sides, and walls on their building's outline, not above its roof."""
    corners = glue([tile.mesh for tile in city.tiles.values()]).points[boundary.facets]
    bounds, model = city.grid.bounds, city.scene.model
    lines = zip(SIDES, (0, 0, 1, 1), (bounds[0], bounds[2], bounds[1], bounds[3]), strict=True)
    for marker, axis, value in lines:
        chosen = boundary.marker == marker
        assert chosen.any()
        assert (corners[chosen][..., axis] == value).all()
        assert (boundary.building[chosen] == -1).all()
    wall = boundary.marker == Marker.WALL
    order = np.argsort(model.numbers)
    row = order[np.searchsorted(model.numbers, boundary.building[wall], sorter=order).clip(max=len(order) - 1)]
    assert (model.numbers[row] == boundary.building[wall]).all()
    assert (corners[wall][..., 2].max(axis=1, initial=-np.inf) <= model.roof[row]).all()
    outline = shapely.boundary(model.polygons)[row]
    assert shapely.dwithin(outline, shapely.points(corners[wall][..., :2].mean(axis=1)), 1e-6).all()


def count_seam_walls(pieces: dict[Key, Split], city: City) -> int:
    """Count the walls over seams."""
    count = 0
    for key, (mesh, boundary, _) in pieces.items():
        corners = expand_cells(mesh).points[boundary.facets[boundary.marker == Marker.WALL]]
        count += int((find_edges_below(corners, mesh.plane.xy[seam_edges(city, key).vertices]) >= 0).sum())
    return count


COURT = shapely.box(60, 60, 360, 360).difference(shapely.box(75, 75, 345, 345))
CITIES: dict[str, list[shapely.Polygon]] = {
    "open ground": [],
    "a hall larger than a tile": [affinity.rotate(shapely.box(100, 90, 330, 320), 12.0)],
    "a courtyard around a tile": [COURT, shapely.box(130, 130, 150, 150), shapely.box(270, 270, 290, 300)],
    "towers on the corners": [shapely.Point(210 * i, 210 * j).buffer(9) for i in (1, 2) for j in (1, 2)],
    "blocks without streets": [
        shapely.box(x, y, x + 25, y + 25) for x in range(10, 410, 25) for y in range(10, 410, 25)
    ],
    "rows across all seams": [shapely.box(3, 110 + 6 * k, 417, 112 + 6 * k) for k in range(10)],
}


@pytest.mark.parametrize("name", CITIES)
def test_boundaries_of_tiles_are_that_of_the_whole(name: str) -> None:
    houses = CITIES[name]
    roofs = [8.0 + 3 * (k % 5) for k in range(len(houses))]
    city = mesh_city(scene_of(houses, roofs, tilted_dtm(SQUARE, height=2.0)), FOUR)
    pieces = split_all(city)
    prove_marks(prove_split(pieces), city)


def test_party_walls_on_seams_are_written_by_the_lower_side() -> None:
    town = terrace_town()
    options = replace(OPTIONS, mesh_size=3.5)
    grid = make_grid(town.bounds, tile_size=49.0, mesh_size=3.5)
    city = mesh_city(Scene(town.model, town.group, tilted_dtm(town.bounds)), grid, options)
    pieces = split_all(city)
    prove_marks(prove_split(pieces), city)
    assert count_seam_walls(pieces, city) > 0


@pytest.fixture(scope="module")
def crowded() -> City:
    return mesh_city(random_scene(SQUARE, 90, seed=3, relief=20.0), FOUR)


def test_walls_over_seams_differ_from_tile_to_tile(crowded: City) -> None:
    pieces = split_all(crowded)
    prove_marks(prove_split(pieces), crowded)
    assert count_seam_walls(pieces, crowded) > 0


def test_where_a_tile_is_missing_its_seams_are_marked(crowded: City) -> None:
    key, gone = Key(0, 0), SeamKey(0, 0, 1)
    mesh = crowded.tiles[key].mesh
    numbers = crowded.scene.model.numbers
    whole, _ = split_boundary(mesh, numbers, SQUARE, seam_edges(crowded, key))
    boundary, shared = split_boundary(mesh, numbers, SQUARE, seam_edges(crowded, key, [gone]))
    absent = boundary.marker == Marker.MISSING
    corners = expand_cells(mesh).points[boundary.facets[absent]]
    line = shapely.LineString(crowded.tiles[key].seams[gone].xy)
    assert shapely.dwithin(shapely.points(corners[..., :2].reshape(-1, 2)), line, 1e-9).all()
    assert (boundary.building[absent] == -1).all()
    # What was shared or a wall there before is missing now, and nothing else is changed.
    exterior = pair_cell_faces(expand_cells(mesh).cells, len(mesh.z)).exterior
    match = match_facets(exterior, np.concatenate((boundary.facets, shared)))
    assert [len(rows) for rows in (match.missing, match.extra, match.flipped, match.duplicate)] == [0] * 4
    kept = match_facets(whole.facets, boundary.facets[~absent])
    assert len(kept.extra) == 0
    assert (whole.marker[kept.missing] == Marker.WALL).all()
    assert len(shared) > 0


def test_of_one_tile_the_boundary_is_all_there_is() -> None:
    scene = random_scene(SQUARE, 60, seed=1)
    plane, _ = mesh_plane(SQUARE, scene.model.polygons, mesh_size=20.0, min_angle=28, refinements=1, passes=1)
    mesh, _ = mesh_adaptive(plane, scene.dtm, scene.model.roofs, scene.model.ids, OPTIONS)
    none = SeamEdges(
        np.empty((0, 2), np.int32), np.empty((0, 2), np.int32), np.empty(0, np.int64), np.empty(0, bool)
    )
    one = extract_boundary(mesh, scene.model.numbers)
    two, shared = split_boundary(mesh, scene.model.numbers, SQUARE, none)
    assert len(shared) == 0
    for name in ("facets", "marker", "building"):
        assert getattr(one, name).tobytes() == getattr(two, name).tobytes()


def test_seams_that_do_not_fit_the_mesh_are_refused(crowded: City) -> None:
    key = Key(1, 1)
    mesh, numbers, seams = crowded.tiles[key].mesh, crowded.scene.model.numbers, seam_edges(crowded, key)
    part = SeamEdges(seams.vertices[1:], seams.bottom[1:], seams.building[1:], seams.missing[1:])
    with pytest.raises(ValueError, match=r"the outer edge at \(.* is neither on the region's border nor a seam"):
        split_boundary(mesh, numbers, SQUARE, part)
    with pytest.raises(ValueError, match="level that the seam's columns lack"):
        split_boundary(mesh, numbers, SQUARE, replace(seams, bottom=seams.bottom + 99))
    with pytest.raises(ValueError, match="no outer edge of the mesh"):
        split_boundary(
            mesh, numbers, SQUARE, replace(seams, vertices=seams.vertices[:1].repeat(len(seams.bottom), 0))
        )
    seam = crowded.tiles[key].seams[SeamKey(0, 1, 1)]
    cut = replace(
        seam, ring=replace(seam.ring, triangles=seam.ring.triangles[:3], building=seam.ring.building[:3])
    )
    with pytest.raises(ValueError, match="lack one beside an edge"):
        label_beyond(cut, left=True)


WIDE: Bounds = (0.0, 0.0, 840.0, 840.0)
COARSE = replace(OPTIONS, mesh_size=20.0)
CENTRE = Key(1, 1)


@pytest.fixture(scope="module")
def nine() -> City:
    houses = [shapely.box(x, y, x + 25, y + 25) for x in range(210, 410, 25) for y in range(210, 410, 25)]
    houses += [affinity.rotate(shapely.box(520, 500, 600, 620), 20.0), shapely.Point(280, 560).buffer(30)]
    scene = scene_of(houses, [12.0 + 4 * (k % 5) for k in range(len(houses))], hilly_dtm(WIDE, relief=15.0))
    return mesh_city(scene, make_grid(WIDE, tile_size=280.0, mesh_size=20.0), COARSE)


@pytest.fixture(scope="module")
def pieces(nine: City) -> Pieces:
    return cut_city(nine)


# --- numbers ---------------------------------------------------------------------------------------


def test_a_point_has_one_id_in_all_tiles_and_none_is_left_out(crowded: City, nine: City) -> None:
    for city in (crowded, nine):
        ids, total = number_city(city), count_city(city)
        kept = {key: find_used_points(tile.mesh) for key, tile in city.tiles.items()}
        used = [ids[key][kept[key]] for key in city.tiles]
        flat = np.concatenate(used)
        points = np.concatenate([expand_cells(city.tiles[key].mesh).points[used] for key, used in kept.items()])
        assert flat.min() >= 0
        assert len(np.unique(flat)) == len(np.unique(points, axis=0)) == total
        assert len(np.unique(np.column_stack((flat, points)), axis=0)) == total
        table = collect_ids(used)
        assert np.unique(number_without_gaps(table, flat)).tolist() == list(range(table.n_points))
        assert table.n_points == total
        # Every part is one run: there is no id of a level that no tile uses.
        assert len(table.start) == len(np.unique(flat >> LOCAL_BITS))


def test_ids_say_nothing_of_the_region(nine: City) -> None:
    """Of a larger region with the same houses, the tiles in the middle have the same ids."""
    houses = CITIES["towers on the corners"]
    roofs = [9.0, 12.0, 15.0, 18.0]
    wide = (-420.0, -420.0, 840.0, 840.0)
    small, large = (
        mesh_city(
            scene_of(houses, roofs, tilted_dtm(wide, height=2.0)),
            make_grid(bounds, tile_size=140.0, mesh_size=10.0),
        )
        for bounds in (SQUARE, (-140.0, -140.0, 560.0, 560.0))
    )
    key = Key(1, 1)
    assert (
        expand_cells(small.tiles[key].mesh).points.tobytes()
        == expand_cells(large.tiles[key].mesh).points.tobytes()
    )
    one, other = (number_city(city)[key] for city in (small, large))
    assert one.tobytes() == other.tobytes()


def test_every_part_has_a_code_of_its_own_wherever_the_region_is() -> None:
    for bounds in ((0.0, 140.0, 420.0, 420.0), (-3e7, 2e7, -3e7 + 420, 2e7 + 280)):
        grid = make_grid(bounds, tile_size=140.0, mesh_size=10.0)
        corners, seams, tiles = corner_keys(grid), seam_keys(grid), tile_keys(grid)
        codes = [corner_part(key) for key in corners] + [seam_part(key) for key in seams]
        codes += [tile_part(key) for key in tiles]
        assert len(set(codes)) == len(codes) > 30
        assert min(codes) >= 0
        assert first_id(max(codes) + 1) <= 2**63
    # As far apart as a region may be: nothing goes round onto itself.
    assert (
        len({tile_part(Key(i, j)) for i in range(-5, MOST_TILES - 5) for j in (0, MOST_TILES - 1)})
        == 2 * MOST_TILES
    )


@pytest.mark.parametrize("seed", range(5))
def test_runs_of_ids_are_numbered_as_their_sorted_list(seed: int) -> None:
    rng = np.random.default_rng(seed)
    pieces = [rng.choice(900, rng.integers(0, 300)) + 2**62 * int(rng.integers(2)) for _ in range(9)]
    table = collect_ids(pieces)
    every = np.unique(np.concatenate(pieces))
    assert table.n_points == len(every)
    for ids in pieces:
        assert np.array_equal(number_without_gaps(table, ids), np.searchsorted(every, ids))
    with pytest.raises(ValueError, match="not among those"):
        number_without_gaps(table, np.setdiff1d(np.arange(2**62 + 900, 2**62 + 902), every))


def test_corners_with_two_ids_are_refused(crowded: City) -> None:
    mesh = crowded.tiles[Key(0, 0)].mesh
    with pytest.raises(ValueError, match="number a corner differently"):
        number_columns(mesh, np.array([0, 1, 0], np.int32), np.array([0, 40, 7]), 100)


# --- one file of all pieces ------------------------------------------------------------------------


def test_one_file_has_all_pieces_and_each_vertex_once(tmp_path: Path, nine: City, pieces: Pieces) -> None:
    volumes, boundaries = write_numbered(tmp_path, nine)
    before = sorted(tmp_path.iterdir())
    write_merged_volume(tmp_path / "all.vtu", volumes)
    write_merged_boundary(tmp_path / "all.vtp", boundaries, volumes)
    assert sorted(tmp_path.iterdir()) == sorted([*before, tmp_path / "all.vtu", tmp_path / "all.vtp"])
    mesh = meshio.vtu.read(str(tmp_path / "all.vtu"))
    cells = mesh.cells[0].data
    corners = np.concatenate([piece.points[piece.cells] for piece, _ in pieces.values()])
    assert mesh.points[cells].tobytes() == corners.tobytes()
    assert len(np.unique(mesh.points, axis=0)) == len(mesh.points)
    tiles = np.repeat([10 * key.i + key.j for key in pieces], [len(piece.cells) for piece, _ in pieces.values()])
    assert (mesh.cell_data["tile"][0] == tiles).all()
    assert len(pair_edges(pair_cell_faces(cells.astype(np.int32), len(mesh.points)).exterior).open) == 0
    merged = read_vtp(tmp_path / "all.vtp")
    facets = np.concatenate([piece.points[boundary.facets] for piece, boundary in pieces.values()])
    assert merged.points[merged.boundary.facets].tobytes() == facets.tobytes()
    assert (mesh.points[merged.vertex] == merged.points).all()
    assert (merged.boundary.marker == np.concatenate([part.marker for _, part in pieces.values()])).all()
    surface = pyvista.read(tmp_path / "all.vtp")
    assert (surface.points == merged.points).all()
    assert (surface.regular_faces == merged.boundary.facets).all()
    assert (surface.cell_data["building"] == merged.boundary.building).all()


def test_pieces_that_cannot_be_merged_leave_no_file(tmp_path: Path, nine: City, pieces: Pieces) -> None:
    volumes, _ = write_numbered(tmp_path, nine)
    target = tmp_path / "all.vtu"
    mesh, ids = pieces[CENTRE][0], read_vtu(tmp_path / "1_1.vtu").point_data[VERTEX_ID]
    tile = np.zeros(len(mesh.cells), np.int32)
    lists: list[tuple[dict[str, NDArray[Any]], dict[str, NDArray[Any]], str]] = [
        ({}, {"tile": tile}, "has no point array vertex_id"),
        ({VERTEX_ID: ids[::-1].copy()}, {"tile": tile}, "stands for two places"),
        ({VERTEX_ID: ids}, {"tile": tile.astype(np.float64)}, "has no array 'tile' like the first piece's"),
    ]
    for point_data, cell_data, message in lists:
        write_vtu(tmp_path / "1_1.vtu", mesh, point_data=point_data, cell_data=cell_data)
        with pytest.raises(InputError, match=message):
            write_merged_volume(target, volumes)
    with pytest.raises(OutputError, match="cannot be written"):
        write_merged_volume(tmp_path / "none" / "all.vtu", volumes)
    with pytest.raises(ValueError, match="at least one piece"):
        write_merged_volume(target, [])
    assert sorted(path.suffix for path in tmp_path.iterdir()) == [".vtp"] * 9 + [".vtu"] * 9
    assert not target.exists()


# --- many pieces, checked --------------------------------------------------------------------------


def check(folder: Path, city: City) -> CheckReport:
    return check_run(folder, lambda path: SampledDtm(city.scene.dtm))


def kinds(report: CheckReport) -> set[str]:
    return {fault.kind for fault in report.faults}


def test_many_pieces_are_proved_in_any_order(tmp_path: Path, nine: City, pieces: Pieces) -> None:
    write_tiled_run(tmp_path / "a", nine, pieces)
    report = check(tmp_path / "a", nine)
    assert report.ok, report.lines()
    n_shared = sum(len(shared) for _, _, shared in split_all(nine).values())
    assert (
        report.lines()[1]
        == f"ok    {n_shared // 2} faces on 12 seams of 9 pieces are bitwise equal from both sides"
    )
    keys = np.random.default_rng(1).permutation(list(pieces))
    write_tiled_run(tmp_path / "b", nine, {Key(i, j): pieces[Key(i, j)] for i, j in keys.tolist()})
    again = check(tmp_path / "b", nine)
    assert again.ok, again.lines()
    assert {name: round(value, 3) for name, value in again.facts.items()} == {
        name: round(value, 3) for name, value in report.facts.items()
    }


def seam_face(pieces: Pieces, key: Key) -> NDArray[np.int32]:
    """An exterior face of a piece that is not in its boundary."""
    mesh, boundary = pieces[key]
    exterior = pair_cell_faces(mesh.cells, len(mesh.points)).exterior
    face: NDArray[np.int32] = exterior[match_facets(exterior, boundary.facets).missing[0]]
    return face


def with_facet(pieces: Pieces, key: Key, face: NDArray[np.int32], marker: Marker, building: int) -> Pieces:
    mesh, old = pieces[key]
    boundary = Boundary(
        np.concatenate((old.facets, face[None])),
        np.append(old.marker, np.int32(marker)),
        np.append(old.building, np.int64(building)),
    )
    return {**pieces, key: (mesh, boundary)}


def twin_of(pieces: Pieces, key: Key, face: NDArray[np.int32], other: Key) -> NDArray[np.int32]:
    """The same face in another piece, turned over."""
    corners, points = pieces[key][0].points[face], pieces[other][0].points
    found = [np.flatnonzero((points == corner).all(axis=1)) for corner in corners]
    return np.array([int(row[0]) for row in found[::-1]], np.int32)


def shift_vertex(pieces: Pieces, nine: City) -> Pieces:
    mesh, boundary = pieces[CENTRE]
    points = mesh.points.copy()
    points[seam_face(pieces, CENTRE)[0], 0] += 1e-9
    return {**pieces, CENTRE: (TetMesh(points, mesh.cells), boundary)}


def lift_vertex(pieces: Pieces, nine: City) -> Pieces:
    mesh, boundary = pieces[CENTRE]
    free = np.setdiff1d(seam_face(pieces, CENTRE), boundary.facets)
    points = mesh.points.copy()
    points[free[0], 2] = np.nextafter(points[free[0], 2], np.inf)
    return {**pieces, CENTRE: (TetMesh(points, mesh.cells), boundary)}


def drop_piece(pieces: Pieces, nine: City) -> Pieces:
    return {key: piece for key, piece in pieces.items() if key != CENTRE}


def stray_facet(pieces: Pieces, nine: City) -> Pieces:
    mesh, _ = pieces[CENTRE]
    faces = mesh.cells[:, [0, 2, 1]]
    exterior = np.unique(pair_cell_faces(mesh.cells, len(mesh.points)).exterior)
    inner = faces[~np.isin(faces, exterior).any(axis=1)][0]
    return with_facet(pieces, CENTRE, inner, Marker.WALL, int(nine.scene.model.numbers[0]))


def seam_as_wall(pieces: Pieces, nine: City) -> Pieces:
    """A face of a seam, written as a wall by both of its pieces: each boundary alone is as good as before."""
    number = int(nine.scene.model.numbers[0])
    face = seam_face(pieces, Key(0, 0))
    corners = pieces[Key(0, 0)][0].points[face]
    others = [
        key
        for key in (Key(0, 1), Key(1, 0))
        if all((pieces[key][0].points == corner).all(axis=1).any() for corner in corners)
    ]
    twin = twin_of(pieces, Key(0, 0), face, others[0])
    once = with_facet(pieces, Key(0, 0), face, Marker.WALL, number)
    return with_facet(once, others[0], twin, Marker.WALL, number)


def seam_wall_left_out(pieces: Pieces, nine: City) -> Pieces:
    """A wall over a seam that its piece leaves to the neighbour, who has no such face."""
    mesh, old = pieces[CENTRE]
    edges = nine.tiles[CENTRE].mesh.plane.xy[seam_edges(nine, CENTRE).vertices]
    over = find_edges_below(mesh.points[old.facets], edges) >= 0
    row = int(np.flatnonzero(over & (old.marker == Marker.WALL))[0])
    kept = np.arange(len(old.facets)) != row
    return {**pieces, CENTRE: (mesh, Boundary(old.facets[kept], old.marker[kept], old.building[kept]))}


def seam_as_missing(pieces: Pieces, nine: City) -> Pieces:
    return with_facet(pieces, CENTRE, seam_face(pieces, CENTRE), Marker.MISSING, -1)


FAULTS: dict[str, tuple[Callable[[Pieces, City], Pieces], set[str]]] = {
    "seam vertex shifted": (shift_vertex, {"seam-open"}),
    "seam vertex lifted by a bit": (lift_vertex, {"seam-open"}),
    "piece dropped": (drop_piece, {"seam-open", "plan-area", "boundary-open", "roof-area"}),
    "stray facet": (stray_facet, {"facet-extra", "boundary-open", "wall-off-outline"}),
    "seam as wall on both sides": (seam_as_wall, {"facet-extra", "wall-off-outline"}),
    "wall over a seam left out": (seam_wall_left_out, {"seam-open", "boundary-open"}),
    "seam as missing on one side": (seam_as_missing, {"facet-extra", "boundary-open"}),
}


@pytest.mark.parametrize("name", FAULTS)
def test_faults_of_many_pieces_are_found(tmp_path: Path, nine: City, pieces: Pieces, name: str) -> None:
    tamper, expected = FAULTS[name]
    write_tiled_run(tmp_path, nine, tamper(pieces, nine))
    found = check(tmp_path, nine)
    assert kinds(found) >= expected, found.lines()
    for fault in found.faults:
        assert fault.places or fault.kind in ("plan-area", "volume", "counts")


def test_missing_pieces_are_told_and_the_rest_is_proved(tmp_path: Path, nine: City) -> None:
    gone = (Key(1, 1), Key(0, 2), Key(1, 0))
    write_tiled_run(tmp_path, nine, cut_city(nine, gone))
    report = check(tmp_path, nine)
    assert report.ok, report.lines()
    assert report.facts["missing_facets"] > 0
    assert any(
        f"{report.facts['missing_facets']} facets bound pieces that are missing" in line for line in report.lines()
    )


def test_seams_that_differ_are_an_error() -> None:
    one, other = {"faces": 2, "hash": "a"}, {"faces": 2, "hash": "b"}
    assert prove_seams([("0_0", "x1_0", one), ("1_0", "x1_0", one), ("0_0", "y0_1", other)])["seam faces"] == 2
    with pytest.raises(GeometryError, match="seam x1_0: tiles 0_0 and 1_0 have different faces"):
        prove_seams([("0_0", "x1_0", one), ("1_0", "x1_0", other)])
