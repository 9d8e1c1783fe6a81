"""Pieces of a tiled mesh: boundaries and numbers that fit together, and the files that are made of them."""

from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np
import pytest
import shapely
from numpy.typing import NDArray
from shapely import affinity

from pipeline.adaptive import AdaptiveOptions, mesh_adaptive
from pipeline.columns import expand_cells, extract_boundary, split_boundary
from pipeline.mesh import Boundary, ColumnMesh, Marker, SeamEdges
from pipeline.plane import mesh_plane
from stitch.conformity import match_facets, pair_cell_faces, pair_edges, pair_faces
from stitch.facets import Side, find_seam_edges, label_beyond
from stitch.grid import Key, SeamKey, TileGrid, make_grid, seams_of_tile
from stitch.seam_columns import tile_columns
from tests.cities import Bounds, tilted_dtm
from tests.stitching import OPTIONS, Scene, Tile, clip_scene, glue, mesh_all, random_scene, scene_of
from tests.terraces import terrace_town

SQUARE: Bounds = (0.0, 0.0, 420.0, 420.0)
FOUR = make_grid(SQUARE, tile_size=210.0, mesh_size=10.0)
SIDES = (Marker.WEST, Marker.EAST, Marker.SOUTH, Marker.NORTH)


Split = tuple[ColumnMesh, Boundary, NDArray[np.int32]]


@dataclass(frozen=True, eq=False)
class City:
    """A scene meshed in tiles, with all that these were made from."""

    scene: Scene
    grid: TileGrid
    options: AdaptiveOptions
    tiles: dict[Key, Tile]


def mesh_city(scene: Scene, grid: TileGrid, options: AdaptiveOptions = OPTIONS) -> City:
    return City(scene, grid, options, mesh_all(scene, grid, options))


def seam_edges(city: City, key: Key, missing: Collection[SeamKey] = ()) -> SeamEdges:
    """What a tile knows of its neighbours: its own seams, labelled with the houses of its halo."""
    tile, near = city.tiles[key], clip_scene(city.scene, city.grid, key, city.options).model
    south, east, _, _ = seams_of_tile(key)
    inner = [seam for seam in seams_of_tile(key) if seam in tile.columns]
    sides = [Side(tile.seams[seam], seam in (south, east), seam in missing) for seam in inner]
    columns = tile_columns(tile.mesh.plane, [(tile.seams[seam], tile.columns[seam]) for seam in inner])
    return find_seam_edges(tile.mesh.plane, sides, columns, near.roof, near.numbers)


def split_all(city: City) -> dict[Key, Split]:
    numbers, bounds = city.scene.model.numbers, city.grid.bounds
    return {
        key: (tile.mesh, *split_boundary(tile.mesh, numbers, bounds, seam_edges(city, key)))
        for key, tile in city.tiles.items()
    }


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
        ends = {tuple(pair) for pair in seam_edges(city, key).vertices.tolist()}
        column = np.repeat(np.arange(len(mesh.plane.xy)), np.diff(mesh.z_start))
        walls = column[boundary.facets[boundary.marker == Marker.WALL]]
        count += sum((low, high) in ends for low, high in zip(walls.min(axis=1), walls.max(axis=1), strict=True))
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
    mesh, _ = mesh_adaptive(plane, scene.dtm, scene.model.roof, scene.group, scene.model.ids, OPTIONS)
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
