"""Volumes below ground: soil that meets the air in the ground, in one tile and in many, and the proofs of it."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from numpy.typing import ArrayLike, NDArray

from pipeline.columns.cell_blocks import UsedPoints, number_used
from pipeline.columns.nodes import (
    FREE,
    GROUND_LEVEL,
    ROOF_LEVEL,
    TOP_LEVEL,
    Levels,
    SeamColumns,
    bare_levels,
    no_seam,
)
from pipeline.columns.spacing import SpacingLimits
from pipeline.columns.underground import (
    RegionMesh,
    SoilOptions,
    add_soil,
    count_regions,
    expand_regions,
    fill_soil,
    find_used,
    is_grounded,
    join_soil,
    soil_tops,
    split_regions,
)
from pipeline.data.errors import ConfigError, InputError
from pipeline.data.mesh import Boundary, ColumnMesh, Marker, PlaneMesh, SeamEdges, TetMesh
from pipeline.data.regions import Region
from stitch.pieces.conformity import compute_cell_volumes, pair_cell_faces
from tests.helpers.cities import crowded_blocks
from tests.helpers.tiles import (
    SIZE,
    around,
    hash_files,
    make_town,
    prove,
    prove_local,
    put_beside,
    run_of,
    write_town,
)
from tests.helpers.vtk_writers import write_vtp, write_vtu
from tiler.check.check import CheckReport, check_run
from tiler.config.config import Config, idle_parameters, make_config
from tiler.export.export import export_run
from tiler.mesh_files.vtk_files import BoundaryPiece, VolumePiece, read_vtp, read_vtu
from tiler.store.results import StoredTerrain
from tiler.store.run_folder import ROOF_MOVED
from tiler.store.store import Store

DEPTH = 25.0
LIMITS = SpacingLimits(least=0.1, most=0.8)
OPTIONS = SoilOptions(depth=20.0, mesh_size=10.0, limits=LIMITS, stagger=0.8)


def write_blocks(folder: Path, size: float, *, seed: int = 1) -> dict[str, Any]:
    """Crowded blocks on hills, across the lines between tiles, and a hall that no seam of 140 m can go around."""
    region = (0.0, 0.0, size, size)
    blocks = crowded_blocks(region, round(45 * (size / 280) ** 2), seed=seed)
    town = make_town(region, put_beside(blocks, shapely.box(90, 30, 190, 105)), relief=15)
    return write_town(folder, town) | {"domain_height": 50.0, "bounds": region}


def check(out: Path) -> CheckReport:
    return check_run(out, StoredTerrain)


def kinds(out: Path) -> set[str]:
    return {fault.kind for fault in check(out).faults}


# Columns.


def two_triangles(*buildings: int) -> PlaneMesh:
    """The unit square of 10 m, cut from south-west to north-east: the southern triangle, then the northern one."""
    xy = np.array([[0.0, 0.0], [0.0, 10.0], [10.0, 0.0], [10.0, 10.0]])
    return PlaneMesh(xy, np.array([[0, 2, 3], [0, 1, 3]], np.int32), np.array(buildings, np.int32))


def air_over(plane: PlaneMesh, lowest: list[float], bottom: list[list[int]]) -> ColumnMesh:
    """Columns from the lowest level 4 m up in two steps."""
    z = np.array([[low, low + 2, low + 4] for low in lowest])
    start = np.arange(0, z.size + 1, 3)
    return ColumnMesh(plane, start, z.ravel(), np.array(bottom, np.int32), "heights")


def test_soil_ends_at_the_ground_or_at_the_terrain_below_the_roof() -> None:
    lowest, terrain = np.array([5.0, 12.0, 12.0]), np.array([9.0, 6.0, 11.5])
    top, lowered = soil_tops(lowest, np.array([True, False, False]), terrain, OPTIONS)
    assert top.tolist() == [5.0, 6.0, 11.0]  # the air's own node; the terrain; 0.1 mesh sizes below the roof
    assert lowered.tolist() == [False, False, True]


def levels_of(start: NDArray[np.int64], z: NDArray[np.float64], kind: ArrayLike) -> Levels:
    """Levels that are something, without their surfaces."""
    return replace(bare_levels(start, z), kind=np.array(kind, np.int8))


def test_levels_of_soil_are_even_down_to_the_depth() -> None:
    plane = two_triangles(-1, -1)
    # Edges of 10 and 10 m at vertex 1, and of 14.1 m besides at vertex 0: 11.4 m in the mean.
    options = replace(OPTIONS, stagger=0.0, mesh_size=40.0, depth=84.0)
    levels = fill_soil(plane, np.array([1, 0], np.int32), np.array([3.0, 7.0]), options)
    assert levels.start.tolist() == [0, 9, 17]
    np.testing.assert_allclose(levels.z[:9], np.linspace(-81, 3, 9))
    np.testing.assert_allclose(levels.z[9:], np.linspace(-77, 7, 8))
    assert (levels.kind == FREE).all()
    # At most 8 m apart where cells are 10 m large, and one step at least.
    assert np.diff(fill_soil(plane, np.array([1], np.int32), np.zeros(1), OPTIONS).start).tolist() == [4]
    shallow = fill_soil(plane, np.array([0], np.int32), np.array([3.0]), replace(options, depth=0.5))
    assert shallow.z.tolist() == [2.5, 3.0]


@pytest.mark.parametrize("stagger", [0.0, 1.0])
def test_levels_of_soil_ascend(stagger: float) -> None:
    plane = two_triangles(-1, -1)
    for depth in np.linspace(1.0, 60.0, 40):
        levels = fill_soil(
            plane, np.arange(4, dtype=np.int32), np.zeros(4), replace(OPTIONS, depth=depth, stagger=stagger)
        )
        assert all((np.diff(column) > 0.2).all() for column in np.split(levels.z, levels.start[1:-1]))


def test_air_stands_on_soil_by_its_ground() -> None:
    air = levels_of(
        np.array([0, 2, 4]), np.array([1.0, 9.0, 6.0, 9.0]), [GROUND_LEVEL, TOP_LEVEL, ROOF_LEVEL, TOP_LEVEL]
    )
    soil = bare_levels(np.array([0, 2, 5]), np.array([-4.0, 1.0, -4.0, 0.0, 1.0]))
    assert is_grounded(air).tolist() == [True, False]
    whole = join_soil(soil, air, is_grounded(air))
    assert whole.start.tolist() == [0, 3, 8]
    assert whole.z.tolist() == [-4.0, 1.0, 9.0, -4.0, 0.0, 1.0, 6.0, 9.0]
    assert whole.kind[1] == GROUND_LEVEL
    wrong = replace(soil, z=soil.z + 0.5)
    with pytest.raises(ValueError, match="does not end at the ground"):
        join_soil(wrong, air, is_grounded(air))


def test_soil_goes_on_under_a_house() -> None:
    """Half of the square is a house: its far corner has soil of its own, the others share the ground."""
    plane = two_triangles(-1, 0)
    # The house's roof is 2 m above the ground at its wall; its far corner, vertex 1, has no ground.
    air = air_over(plane, [0.0, 2.0, 0.0, 0.0], [[0, 0, 0], [1, 0, 1]])
    mesh, raised, lowered = add_soil(air, np.array([9.0, 0.5, 9.0, 9.0]), no_seam(), no_seam(), OPTIONS)
    cells, region = _expand(mesh)
    assert len(lowered) == 0
    assert (mesh.top + 1 - raised).tolist() == [1, 0, 1, 1]
    volume, flat = compute_cell_volumes(cells.points, cells.cells)
    assert (volume > 0).all()
    assert not flat.any()
    assert (region == Region.SOIL).sum() == count_regions(mesh)[Region.SOIL]
    np.testing.assert_allclose(volume[region == Region.SOIL].sum(), 100 * OPTIONS.depth)
    np.testing.assert_allclose(volume[region == Region.AIR].sum(), 50 * 4 + 50 * (2 + 2 + 4) / 3)
    assert find_used(mesh).all()

    none = np.empty((0, 2), np.int32)
    seams = SeamEdges(none, none, np.empty(0, np.int64), np.empty(0, np.bool_))
    boundary, shared = split_regions(mesh, np.array([7]), (0.0, 0.0, 10.0, 10.0), seams)
    assert len(shared) == 0
    faces = pair_cell_faces(cells.cells, len(cells.points))
    inside = boundary.marker == Marker.GROUND
    assert sorted(map(sorted, faces.exterior.tolist())) == sorted(map(sorted, boundary.facets[~inside].tolist()))
    count = {mark: int((boundary.marker == mark).sum()) for mark in Marker}
    assert count[Marker.GROUND] == count[Marker.FOUNDATION] == count[Marker.ROOF] == 1
    assert count[Marker.BOTTOM] == count[Marker.TOP] == 2
    assert boundary.building[boundary.marker == Marker.FOUNDATION].tolist() == [7]
    foundation = cells.points[boundary.facets[boundary.marker == Marker.FOUNDATION][0]]
    assert sorted(foundation[:, 2].tolist()) == [0.0, 0.0, 0.5]


def test_soil_ends_at_the_ground_that_a_neighbour_has_at_a_seam() -> None:
    """A tile of one house whose wall is the seam: columns there have ground, which its own cells do not reach."""
    plane = two_triangles(0, 0)
    air = air_over(plane, [0.0, 0.0, 2.0, 2.0], [[1, 0, 0], [1, 1, 0]])
    start, vertex = np.array([0, 3, 6]), np.array([0, 1], np.int32)
    levels = levels_of(start, air.z[:6], [GROUND_LEVEL, ROOF_LEVEL, TOP_LEVEL] * 2)
    given = fill_soil(plane, vertex, np.zeros(2), OPTIONS)
    terrain = np.full(4, 0.7)  # other than the ground of the seam, to tell which is taken
    mesh, raised, _ = add_soil(air, terrain, SeamColumns(vertex, levels), SeamColumns(vertex, given), OPTIONS)
    columns = np.split(mesh.columns.z, mesh.columns.z_start[1:-1])
    assert all((np.diff(column) > 0).all() for column in columns)
    assert [column[top] for column, top in zip(columns, mesh.top, strict=True)] == [0.0, 0.0, 0.7, 0.7]
    assert (mesh.top + 1 - raised).tolist() == [1, 1, 0, 0]
    assert [column[raised[k] + 1] for k, column in enumerate(columns)] == [2.0, 2.0, 4.0, 4.0]


def test_terrain_that_reaches_a_roof_from_inside_is_lowered() -> None:
    plane = two_triangles(-1, 0)
    air = air_over(plane, [0.0, 2.0, 0.0, 0.0], [[0, 0, 0], [1, 0, 1]])
    mesh, _, lowered = add_soil(air, np.array([0.0, 30.0, 0.0, 0.0]), no_seam(), no_seam(), OPTIONS)
    assert lowered.tolist() == [1]
    assert mesh.columns.z[mesh.columns.z_start[1] + mesh.top[1]] == 1.0
    assert (compute_cell_volumes(*_points_and_cells(mesh))[0] > 0).all()


def test_cells_of_soil_come_after_those_of_air_in_any_block() -> None:
    plane = two_triangles(-1, 0)
    air = air_over(plane, [0.0, 2.0, 0.0, 0.0], [[0, 0, 0], [1, 0, 1]])
    mesh, _, _ = add_soil(air, np.array([9.0, 0.5, 9.0, 9.0]), no_seam(), no_seam(), OPTIONS)
    blocks, region = expand_regions(mesh)
    whole, first = blocks.make(0, blocks.n_cells), int((region == Region.AIR).sum())
    assert 1 < first < blocks.n_cells - 1
    for begin in range(blocks.n_cells):
        for end in range(begin, blocks.n_cells + 1):
            assert np.array_equal(blocks.make(begin, end), whole[begin:end])


def _expand(mesh: RegionMesh) -> tuple[TetMesh, NDArray[np.int8]]:
    blocks, region = expand_regions(mesh)
    used = find_used(mesh)
    points = UsedPoints(mesh.columns, used)
    places = points.place(points.levels(0, points.n_points))
    return TetMesh(places, number_used(used)[blocks.make(0, blocks.n_cells)]), region


def _points_and_cells(mesh: RegionMesh) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    cells, _ = _expand(mesh)
    return cells.points, cells.cells


# Parameters.


def test_a_depth_below_a_cell_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"underground = 0\.5 m: at least 1 m"):
        make_config({"underground": 0.5})
    with pytest.raises(ConfigError, match="underground = -1 m: must be at least 0 m"):
        make_config({"underground": -1.0})


def test_limits_of_spacing_count_for_soil_with_layers_too() -> None:
    assert len(idle_parameters(Config(mesher="layered", most_spacing=0.7))) == 1
    assert idle_parameters(Config(mesher="layered", most_spacing=0.7, underground=20.0)) == []
    assert len(idle_parameters(Config(mesher="layered", improve_passes=2, underground=20.0))) == 1


# Runs.


@pytest.fixture(scope="module")
def four(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], Path]:
    """Four tiles of blocks with soil, not to be changed, and what they were made from."""
    folder = tmp_path_factory.mktemp("four")
    values = write_blocks(folder / "city", 280.0) | {"tile_size": SIZE}
    run_of(values, folder / "out", underground=DEPTH)
    return values, folder / "out"


@pytest.mark.parametrize(
    ("tiles", "mesher"),
    [(1, "adaptive"), (1, "layered"), (2, "layered"), pytest.param(3, "adaptive", marks=pytest.mark.long)],
)
def test_soil_is_proved(tiles: int, mesher: str, tmp_path: Path) -> None:
    size = SIZE * max(tiles, 2)
    values = write_blocks(tmp_path / "city", size, seed=tiles) | {"tile_size": size / tiles, "mesher": mesher}
    record = run_of(values, tmp_path / "out", underground=DEPTH)
    report = prove(tmp_path / "out")
    assert record["counts"]["tiles"] == tiles**2
    np.testing.assert_allclose(report.facts["soil_volume"], size**2 * DEPTH, rtol=1e-9)
    assert report.facts["cells"] == record["counts"]["cells"]


def test_four_tiles_with_houses_on_seams_are_proved(four: tuple[dict[str, Any], Path]) -> None:
    _, out = four
    prove(out)
    store = Store(out / "store.zarr")
    seams = [store.read("seams", name)[0] for name in store.names("seams")]
    air = [levels_of(s["level_start"], s["level_z"], s["level_kind"]) for s in seams if "level_z" in s]
    # Under some vertices of seams there are houses all around.
    assert sum(int((~is_grounded(levels)).sum()) for levels in air) > 0


def test_soil_leaves_the_air_of_a_run_that_goes_on_with_it(
    four: tuple[dict[str, Any], Path], tmp_path: Path
) -> None:
    """Houses and terrain are taken over from a run without soil; the result is that of a new folder."""
    values, out = four
    run_of(values, tmp_path / "out")
    for path in sorted((tmp_path / "out" / "mesh").iterdir()):
        plain, whole = read_vtu(path), read_vtu(out / "mesh" / path.name)
        air = whole.cell_data["region"] == Region.AIR
        corners = whole.mesh.points[whole.mesh.cells[air]]
        assert plain.cell_data == {}
        assert corners.tobytes() == plain.mesh.points[plain.mesh.cells].tobytes()
        boundary, both = (read_vtp(folder / "boundary" / f"{path.stem}.vtp") for folder in (tmp_path / "out", out))
        for marker in (Marker.GROUND, Marker.WALL, Marker.ROOF, Marker.TOP):
            one, two = (
                piece.points[piece.boundary.facets[piece.boundary.marker == marker]] for piece in (boundary, both)
            )
            assert one.tobytes() == two.tobytes()
    record = run_of(values, tmp_path / "out", underground=DEPTH)
    assert record["ran"].keys().isdisjoint({"points", "terrain", "houses", "model"})
    assert hash_files(tmp_path / "out") == hash_files(out)


@pytest.mark.parametrize("mesher", ["adaptive", pytest.param("layered", marks=pytest.mark.long)])
def test_soil_depends_on_the_surroundings_of_its_tile_alone(mesher: str, tmp_path: Path) -> None:
    far = around((0, 0), 2)
    town = make_town(far, crowded_blocks(far, 100, seed=5), relief=10)
    values = write_town(tmp_path / "city", town, files=(2, 2)) | {"mesher": mesher, "tile_size": SIZE}
    values |= {"domain_height": 50.0 if mesher == "adaptive" else 38.0, "underground": DEPTH}
    least = 1.0 if mesher == "adaptive" else 1.5
    prove_local(values, (0, 0), tmp_path, around((0, 0), least + 0.1), around((0, 0), least))


@pytest.mark.parametrize(
    ("mesher", "gone", "solids"),
    [
        ("adaptive", [(0, 2), (1, 1), (2, 0)], False),
        pytest.param("adaptive", [(0, 2), (1, 1), (2, 0)], True, marks=pytest.mark.long),
        pytest.param("layered", [(1, 1)], False, marks=pytest.mark.long),
        pytest.param("layered", [(0, 2), (1, 1), (2, 0)], True, marks=pytest.mark.long),
    ],
)
def test_soil_ends_at_tiles_that_are_absent(
    mesher: str, gone: list[tuple[int, int]], solids: bool, tmp_path: Path
) -> None:
    """Tiles that meet in a corner alone share its column of soil too."""
    region = (0.0, 0.0, 420.0, 420.0)
    town = make_town(region, crowded_blocks(region, 90, seed=4), relief=10)
    values = write_town(tmp_path / "city", town, files=(3, 3), without=gone)
    values |= {"tile_size": SIZE, "domain_height": 50.0, "mesher": mesher, "underground": DEPTH}
    record = run_of(values, tmp_path / "out", solids=solids)
    report = prove(tmp_path / "out")
    assert record["counts"]["tiles"] == 9 - len(gone)
    assert report.facts["missing_facets"] > 0


# Damage.

Change = Callable[[VolumePiece, BoundaryPiece], tuple[VolumePiece, BoundaryPiece]]


@pytest.fixture
def damaged(four: tuple[dict[str, Any], Path], tmp_path: Path) -> Callable[[Change], Path]:
    """Change the first piece of the run in a copy of it."""
    return lambda change: damage(four[1], tmp_path / "damaged", change)


def damage(run: Path, out: Path, change: Change, k: int = 0) -> Path:
    """Change a piece of a run in a copy of it."""
    shutil.copytree(run, out)
    paths = sorted((out / "mesh").iterdir())[k], sorted((out / "boundary").iterdir())[k]
    volume, surface = change(read_vtu(paths[0]), read_vtp(paths[1]))
    write_vtu(paths[0], volume.mesh, point_data=volume.point_data, cell_data=volume.cell_data)
    points, vertex = volume.mesh.points.copy(), surface.vertex
    points[vertex] = surface.points
    boundary = replace(surface.boundary, facets=vertex.astype(np.int32)[surface.boundary.facets])
    point_data = {"vertex_id": volume.point_data["vertex_id"]}
    if ROOF_MOVED in surface.point_data:
        point_data[ROOF_MOVED] = np.zeros(len(points))
        point_data[ROOF_MOVED][vertex] = surface.point_data[ROOF_MOVED]
    write_vtp(paths[1], points, boundary, point_data=point_data)
    return out


def keep_cells(volume: VolumePiece, kept: NDArray[np.bool_]) -> VolumePiece:
    mesh = TetMesh(volume.mesh.points, volume.mesh.cells[kept])
    return replace(volume, mesh=mesh, cell_data={"region": volume.cell_data["region"][kept]})


def first_facet(surface: BoundaryPiece, marker: Marker) -> int:
    return int(np.flatnonzero(surface.boundary.marker == marker)[0])


def drop_facet(surface: BoundaryPiece, row: int) -> BoundaryPiece:
    b = surface.boundary
    rest = Boundary(np.delete(b.facets, row, axis=0), np.delete(b.marker, row), np.delete(b.building, row))
    return replace(surface, boundary=rest)


def inner_cell(volume: VolumePiece, region: Region) -> int:
    """A cell with all of its faces inside."""
    outer = np.unique(pair_cell_faces(volume.mesh.cells, len(volume.mesh.points)).exterior)
    inside = ~np.isin(volume.mesh.cells, outer).any(axis=1) & (volume.cell_data["region"] == region)
    return int(np.flatnonzero(inside)[0])


def lose_cell(region: Region) -> Change:
    def change(volume: VolumePiece, surface: BoundaryPiece) -> tuple[VolumePiece, BoundaryPiece]:
        kept = np.ones(len(volume.mesh.cells), np.bool_)
        kept[inner_cell(volume, region)] = False
        return keep_cells(volume, kept), surface

    return change


def invert_cell(volume: VolumePiece, surface: BoundaryPiece) -> tuple[VolumePiece, BoundaryPiece]:
    cells, row = volume.mesh.cells.copy(), inner_cell(volume, Region.SOIL)
    cells[row] = cells[row][[1, 0, 2, 3]]
    return replace(volume, mesh=TetMesh(volume.mesh.points, cells)), surface


def mix_up_cell(one: Region, two: Region) -> Change:
    def change(volume: VolumePiece, surface: BoundaryPiece) -> tuple[VolumePiece, BoundaryPiece]:
        region = volume.cell_data["region"].copy()
        region[inner_cell(volume, one)] = two
        return replace(volume, cell_data={"region": region}), surface

    return change


def part_soil(volume: VolumePiece, surface: BoundaryPiece) -> tuple[VolumePiece, BoundaryPiece]:
    """Give the soil a point of its own at the ground."""
    region, cells = volume.cell_data["region"], volume.mesh.cells.copy()
    ground = np.unique(surface.vertex[surface.boundary.facets[surface.boundary.marker == Marker.GROUND]])
    outer = np.unique(pair_cell_faces(cells, len(volume.mesh.points)).exterior)
    point = int(np.setdiff1d(ground, outer)[0])
    below = cells[region == Region.SOIL]
    below[below == point] = len(volume.mesh.points)
    cells[region == Region.SOIL] = below
    points = np.concatenate((volume.mesh.points, volume.mesh.points[[point]]))
    ids = np.append(volume.point_data["vertex_id"], 2**62 + 2**30)
    return VolumePiece(TetMesh(points, cells), {"vertex_id": ids}, volume.cell_data), surface


def drop(marker: Marker) -> Change:
    return lambda volume, surface: (volume, drop_facet(surface, first_facet(surface, marker)))


def turn(marker: Marker) -> Change:
    def change(volume: VolumePiece, surface: BoundaryPiece) -> tuple[VolumePiece, BoundaryPiece]:
        facets, row = surface.boundary.facets.copy(), first_facet(surface, marker)
        facets[row] = facets[row][[0, 2, 1]]
        return volume, replace(surface, boundary=replace(surface.boundary, facets=facets))

    return change


def remark(marker: Marker, other: Marker) -> Change:
    def change(volume: VolumePiece, surface: BoundaryPiece) -> tuple[VolumePiece, BoundaryPiece]:
        marks = surface.boundary.marker.copy()
        marks[first_facet(surface, marker)] = other
        return volume, replace(surface, boundary=replace(surface.boundary, marker=marks))

    return change


def move(marker: Marker, up: float, *, inside: bool = True) -> Change:
    """Move a point of such a facet, in both files; within the tile, or on the side where it meets the next one."""

    def change(volume: VolumePiece, surface: BoundaryPiece) -> tuple[VolumePiece, BoundaryPiece]:
        rows = np.unique(surface.boundary.facets[surface.boundary.marker == marker])
        sides = surface.boundary.facets[np.isin(surface.boundary.marker, (Marker.WEST, Marker.SOUTH))]
        if inside:
            spots = surface.points[rows, :2]
            rows = rows[np.hypot(*(spots - spots.mean(axis=0)).T).argsort()]
        else:
            rows = np.setdiff1d(rows, sides)
            rows = rows[surface.points[rows, :2].max(axis=1).argsort()[::-1]]
        points, moved = volume.mesh.points.copy(), surface.points.copy()
        points[surface.vertex[rows[0]], 2] += up
        moved[rows[0], 2] += up
        return replace(volume, mesh=TetMesh(points, volume.mesh.cells)), replace(surface, points=moved)

    return change


DAMAGE: dict[str, tuple[Change, set[str]]] = {
    "a cell of soil is lost": (lose_cell(Region.SOIL), {"facet-missing", "soil-volume", "counts"}),
    "a cell of soil is inverted": (invert_cell, {"cell-inverted", "face-same-side"}),
    "a cell of soil is marked as air": (
        mix_up_cell(Region.SOIL, Region.AIR),
        {"ground-missing", "soil-volume", "volume"},
    ),
    "soil and air have a point each": (part_soil, {"vertex-duplicate", "ground-one-sided"}),
    "a ground facet is lost": (drop(Marker.GROUND), {"ground-missing", "plan-area", "soil-area", "counts"}),
    "a ground facet points up": (turn(Marker.GROUND), {"ground-flipped", "facet-direction"}),
    "a bottom facet is ground": (remark(Marker.BOTTOM, Marker.GROUND), {"ground-one-sided", "facet-missing"}),
    "a ground facet is bottom": (remark(Marker.GROUND, Marker.BOTTOM), {"ground-missing", "facet-extra"}),
    "a foundation is lost": (drop(Marker.FOUNDATION), {"foundation-area", "facet-missing"}),
    "a foundation points down": (turn(Marker.FOUNDATION), {"facet-flipped", "facet-direction"}),
    "a bottom facet points up": (turn(Marker.BOTTOM), {"facet-flipped", "facet-direction", "soil-area"}),
    "a foundation is a wall": (remark(Marker.FOUNDATION, Marker.WALL), {"foundation-area", "wall-not-vertical"}),
    "the bottom is moved": (move(Marker.BOTTOM, 0.01), {"bottom-depth"}),
    "a point under a seam is moved": (move(Marker.BOTTOM, 0.01, inside=False), {"bottom-depth", "seam-open"}),
    "a foundation is raised": (move(Marker.FOUNDATION, 0.01), {"foundation-over-terrain"}),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_damage_is_found(name: str, damaged: Callable[[Change], Path]) -> None:
    change, expected = DAMAGE[name]
    assert expected <= kinds(damaged(change))


def test_the_copy_is_sound_without_damage(damaged: Callable[[Change], Path]) -> None:
    assert kinds(damaged(lambda volume, surface: (volume, surface))) == set()


@pytest.mark.parametrize("values", [None, np.int8(2), np.int8(-1)])
def test_a_piece_must_tell_its_regions(values: Any, damaged: Callable[[Change], Path]) -> None:
    def change(volume: VolumePiece, surface: BoundaryPiece) -> tuple[VolumePiece, BoundaryPiece]:
        region = volume.cell_data["region"].copy()
        region[:1] = 0 if values is None else values
        return replace(volume, cell_data={} if values is None else {"region": region}), surface

    out = damaged(change)
    with pytest.raises(InputError, match="has no cell array 'region' of 0"):
        check(out)


def test_a_record_with_another_depth_is_found(damaged: Callable[[Change], Path]) -> None:
    out = damaged(lambda volume, surface: (volume, surface))
    record = json.loads((out / "run.json").read_text())
    record["parameters"]["underground"] = DEPTH + 1
    (out / "run.json").write_text(json.dumps(record))
    assert kinds(out) == {"bottom-depth"}
    record["parameters"]["underground"] = 0.0
    (out / "run.json").write_text(json.dumps(record))
    assert "marker-unknown" in kinds(out)


# Files.


def test_one_file_has_the_regions_and_shares_the_ground(four: tuple[dict[str, Any], Path], tmp_path: Path) -> None:
    _, out = four
    export_run(out, tmp_path / "all.vtu", name="vtu")
    whole = read_vtu(tmp_path / "all.vtu")
    counts = json.loads((out / "run.json").read_text())["counts"]
    region = whole.cell_data["region"]
    assert region.dtype == np.int8
    assert (len(whole.mesh.points), len(whole.mesh.cells)) == (counts["points"], counts["cells"])
    air, soil = (np.unique(whole.mesh.cells[region == value]) for value in (Region.AIR, Region.SOIL))
    export_run(out, tmp_path / "all.vtp", name="vtp")
    surface = read_vtp(tmp_path / "all.vtp")
    ground = np.unique(surface.vertex[surface.boundary.facets[surface.boundary.marker == Marker.GROUND]])
    assert np.intersect1d(air, soil).tolist() == ground.tolist()
    volume = compute_cell_volumes(whole.mesh.points, whole.mesh.cells)[0]
    np.testing.assert_allclose(volume[region == Region.SOIL].sum(), 280.0**2 * DEPTH, rtol=1e-9)
