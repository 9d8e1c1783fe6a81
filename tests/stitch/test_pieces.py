"""Pieces of a tiled mesh: boundaries and numbers that fit together."""

from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np
import pytest
import shapely
from numpy.typing import NDArray
from shapely import affinity

from pipeline.columns.adaptive import AdaptiveOptions, mesh_adaptive
from pipeline.columns.columns import expand_cells, find_used_points, split_boundary
from pipeline.data.errors import GeometryError
from pipeline.data.mesh import Boundary, ColumnMesh, Marker, SeamEdges
from pipeline.plane_mesh.plane import mesh_plane
from stitch.pieces.conformity import match_facets, pair_cell_faces, pair_edges, pair_faces
from stitch.pieces.frontier import find_edges_below
from stitch.pieces.numbering import (
    LOCAL_BITS,
    MOST_TILES,
    collect_ids,
    corner_part,
    count_all_points,
    count_by_part,
    first_id,
    number_columns,
    number_without_gaps,
    seam_ids,
    seam_part,
    tile_part,
)
from stitch.seams.facets import Side, find_seam_edges, label_beyond
from stitch.seams.seam_columns import tile_columns
from stitch.seams.seams import find_vertices
from stitch.tiling.grid import Key, SeamKey, TileGrid, corner_keys, make_grid, seam_keys, seams_of_tile, tile_keys
from tests.helpers.cities import tilted_dtm
from tests.helpers.stitching import (
    OPTIONS,
    SQUARE,
    Scene,
    Tile,
    clip_scene,
    glue,
    mesh_all,
    random_scene,
    scene_of,
)
from tests.helpers.terraces import terrace_town
from tests.helpers.whole_city import extract_boundary
from tiler.stages.pieces import prove_seams

Split = tuple[ColumnMesh, Boundary, NDArray[np.int32]]


@dataclass(frozen=True, eq=False)
class City:
    """A scene meshed in tiles, with all that these were made from."""

    scene: Scene
    grid: TileGrid
    options: AdaptiveOptions
    tiles: dict[Key, Tile]


def mesh_city(scene: Scene, grid: TileGrid, options: AdaptiveOptions = OPTIONS) -> City:
    """Mesh all tiles."""
    return City(scene, grid, options, mesh_all(scene, grid, options))


def seam_edges(city: City, key: Key, missing: Collection[SeamKey] = ()) -> SeamEdges:
    """What a tile knows of its neighbours: its own seams, labelled with the houses of its halo."""
    tile, near = city.tiles[key], clip_scene(city.scene, city.grid, key, city.options).model
    south, east, _, _ = seams_of_tile(key)
    inner = [seam for seam in seams_of_tile(key) if seam in tile.columns]
    sides = [Side(tile.seams[seam], seam in (south, east), seam in missing) for seam in inner]
    columns = tile_columns(tile.mesh.plane, [(tile.seams[seam], tile.columns[seam]) for seam in inner])
    return find_seam_edges(tile.mesh.plane, sides, columns, near.numbers)


def split_all(city: City, gone: Collection[Key] = ()) -> dict[Key, Split]:
    """Split the boundaries of all tiles but those that are gone."""
    numbers, bounds = city.scene.model.numbers, city.grid.bounds
    lost = {seam for key in gone for seam in seams_of_tile(key)}
    return {
        key: (tile.mesh, *split_boundary(tile.mesh, numbers, bounds, seam_edges(city, key, lost)))
        for key, tile in city.tiles.items()
        if key not in gone
    }


def number_city(city: City) -> dict[Key, NDArray[np.int64]]:
    """Give the points of all tiles their ids."""
    ids = {}
    for key, tile in city.tiles.items():
        start = tile.mesh.z_start
        column = number_columns(tile.mesh, *_number_seams(tile), first_id(tile_part(key)))
        ids[key] = np.repeat(column - start[:-1], np.diff(start)) + np.arange(start[-1])
    return ids


def count_city(city: City) -> int:
    """Count the points of all parts, as a run does."""
    counts = []
    for tile in city.tiles.values():
        shared, lowest = _number_seams(tile)
        counts.append(count_by_part(tile.mesh, find_used_points(tile.mesh), shared, lowest))
    return count_all_points(counts)


def _number_seams(tile: Tile) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    shared = [find_vertices(tile.mesh.plane.xy, tile.seams[seam].xy) for seam in tile.columns]
    lowest = [seam_ids(seam, levels) for seam, levels in tile.columns.items()]
    return np.concatenate(shared), np.concatenate(lowest)


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


def test_a_point_has_one_id_in_all_tiles_and_none_is_left_out(crowded: City) -> None:
    ids, total = number_city(crowded), count_city(crowded)
    kept = {key: find_used_points(tile.mesh) for key, tile in crowded.tiles.items()}
    used = [ids[key][kept[key]] for key in crowded.tiles]
    flat = np.concatenate(used)
    points = np.concatenate([expand_cells(crowded.tiles[key].mesh).points[used] for key, used in kept.items()])
    assert flat.min() >= 0
    assert len(np.unique(flat)) == len(np.unique(points, axis=0)) == total
    assert len(np.unique(np.column_stack((flat, points)), axis=0)) == total
    table = collect_ids(used)
    assert np.unique(number_without_gaps(table, flat)).tolist() == list(range(table.n_points))
    assert table.n_points == total
    # Every part is one run: there is no id of a level that no tile uses.
    assert len(table.start) == len(np.unique(flat >> LOCAL_BITS))


def test_ids_say_nothing_of_the_region() -> None:
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


def test_seams_that_differ_are_an_error() -> None:
    one, other = {"faces": 2, "hash": "a"}, {"faces": 2, "hash": "b"}
    assert prove_seams([("0_0", "x1_0", one), ("1_0", "x1_0", one), ("0_0", "y0_1", other)])["seam faces"] == 2
    with pytest.raises(GeometryError, match="seam x1_0: tiles 0_0 and 1_0 have different faces"):
        prove_seams([("0_0", "x1_0", one), ("1_0", "x1_0", other)])
