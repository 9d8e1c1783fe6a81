"""What pictures are made from: quality behind facets, coarser facets, the middle of a region, and blocks."""

import json
import shutil
import tracemalloc
from collections import Counter
from itertools import pairwise, product
from pathlib import Path

import numpy as np
import pytest
import shapely

from pipeline.data.errors import InputError
from pipeline.data.mesh import Boundary, Marker
from pipeline.data.roofs import roof_heights
from pipeline.quality.quality import measure_cells
from tests.helpers.scene import PIECES, write_scene
from tests.helpers.vtk_writers import write_vtp
from tests.helpers.written_models import read_city_model
from tiler.mesh_files.facet_quality import measure_facets
from tiler.mesh_files.vtk_files import read_vtp, read_vtu, write_pvtp
from tiler.pictures.city_model_data import DEEP, load_blocks
from tiler.pictures.picture_data import Facets, coarsen, find_middle, join_facets, load_air, load_city
from tiler.pictures.picture_parts import QUALITY_COLOURS, blend, heights_above_ground
from tiler.pictures.render import render_run
from tiler.store.out_folder import CITY_MODEL


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("scene")
    write_scene(directory, side=200, n_buildings=30, mesh_size=15)
    return directory


def test_facets_have_the_quality_of_the_cell_behind_them(small_run: Path) -> None:
    """Against a search through all faces of all cells."""
    (path, *_) = sorted((small_run / "mesh").iterdir())
    mesh, piece = read_vtu(path).mesh, read_vtp(small_run / "boundary" / f"{path.stem}.vtp")
    ratio = measure_cells(mesh).radius_ratio
    behind = {
        frozenset(cell[:k] + cell[k + 1 :]): ratio[row]
        for row, cell in enumerate(mesh.cells.tolist())
        for k in range(4)
    }
    wanted = [behind[frozenset(piece.vertex[facet].tolist())] for facet in piece.boundary.facets]
    assert measure_facets(mesh, piece).tolist() == wanted


def test_the_worst_facet_of_a_run_is_found(small_run: Path) -> None:
    city = load_city(small_run, quality=True)
    assert not np.isnan(city.quality).any()
    record = json.loads((small_run / "run.json").read_text())
    assert float(city.quality.min()) >= record["quality"]["radius_ratio"]["0"] - 1e-4
    for name in ("points", "facets", "building"):
        assert np.array_equal(getattr(city, name), getattr(load_city(small_run), name))


def test_coarsening_keeps_the_worst_of_equal_triangles() -> None:
    points = np.array([[0.1, 0, 0], [4.1, 0, 0], [4.1, 4, 0], [0.2, 0.1, 0], [4.2, 0.1, 0], [4.2, 4.1, 0]])
    mark = np.array([1, 1], np.int32)
    quality = np.array([0.9, 0.3], np.float32)
    part = Facets(points, np.array([[0, 1, 2], [3, 4, 5]]), mark, mark, np.array([7, 8]), quality)
    coarse = coarsen(part, 1.0)
    assert (coarse.building.tolist(), coarse.quality.tolist()) == ([8], [np.float32(0.3)])
    assert coarse.points[:, :2].tolist() == [[0.5, 0.5], [4.5, 0.5], [4.5, 4.5]]
    assert len(coarsen(join_facets([part, part]), 8.0)) == 0  # all in one cell


def test_the_air_has_no_ground_or_building(small_run: Path) -> None:
    city = load_city(small_run)
    air = load_air(small_run, city.origin).cell_centers().points
    known = set(map(tuple, city.points[city.facets].mean(axis=1).round(2).tolist()))
    assert known.isdisjoint(map(tuple, air.round(2).tolist()))


def test_the_air_around_the_middle_is_a_part_of_all(small_run: Path) -> None:
    origin = load_city(small_run).origin
    air, part = (load_air(small_run, origin, within=within).points for within in (np.inf, 60.0))
    assert set(map(tuple, part[part[:, 1] < 1].tolist())) < set(map(tuple, air.tolist()))
    assert np.abs(part[:, :2]).max() < 80 < np.abs(air[:, :2]).max()
    elsewhere = load_air(small_run, origin + np.array([1e4, 0, 0]), within=60.0).points
    assert np.array_equal(elsewhere[:, 1:], air[:, 1:])


def spread(scene: Path, folder: Path, along: int) -> None:
    """Copy the boundary of a scene to a region of many tiles."""
    (folder / "boundary").mkdir(parents=True)
    piece = read_vtp(scene / "boundary" / f"{PIECES[0]}.vtp")
    kept = piece.boundary.marker <= Marker.ROOF
    boundary = Boundary(*(getattr(piece.boundary, name)[kept] for name in ("facets", "marker", "building")))
    paths = []
    for i, j in product(range(along), repeat=2):
        paths.append(folder / "boundary" / f"{i}_{j}.vtp")
        write_vtp(paths[-1], piece.points + np.array([100.0 * i, 200.0 * j, 0.0]), boundary)
    write_pvtp(folder / "boundary.pvtp", paths)


def test_memory_does_not_grow_with_the_region(scene: Path, tmp_path: Path) -> None:
    n = (read_vtp(scene / "boundary" / f"{PIECES[0]}.vtp").boundary.marker <= Marker.ROOF).sum()
    peaks, facets = [], []
    for along in (4, 12):
        spread(scene, tmp_path / str(along), along)
        tracemalloc.start()
        facets.append(len(load_city(tmp_path / str(along), most=6 * int(n)).facets))
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert max(facets) <= 6 * n < 144 * n
    assert peaks[1] < 1.5 * peaks[0]


def test_the_middle_of_a_large_region_is_its_inner_rings(tmp_path: Path) -> None:
    (tmp_path / "mesh").mkdir()
    names = [f"{i}_{j}" for i, j in product(range(-3, 4), repeat=2)]
    rows = "".join(f'<Piece Source="mesh/{name}.vtu"/>' for name in names)
    (tmp_path / "mesh.pvtu").write_text(f"<VTKFile><PUnstructuredGrid>{rows}</PUnstructuredGrid></VTKFile>")
    for name in names:
        (tmp_path / "mesh" / f"{name}.vtu").write_bytes(b"x" * 100)
    assert find_middle(tmp_path, most=4_900) is None
    assert find_middle(tmp_path, most=1_000) == frozenset(f"{i}_{j}" for i, j in product((-1, 0, 1), repeat=2))
    assert find_middle(tmp_path, most=10) == frozenset({"0_0"})


@pytest.mark.long
def test_blocks_stand_on_the_terrain(small_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    record = json.loads((small_run / "run.json").read_text())
    west, south, east, north = record["region"]["bounds"]
    city, n_buildings, n_shown = load_blocks(small_run)
    assert (n_buildings, n_shown) == (record["counts"]["building parts"],) * 2
    assert np.isfinite(city.points).all()
    low, high = city.points[:, :2].min(axis=0), city.points[:, :2].max(axis=0)
    assert np.allclose([*low, *high], np.array([west - east, south - north, east - west, north - south]) / 2)
    assert np.array_equal(np.unique(city.building), np.arange(-1, n_buildings))
    a, b, c = np.moveaxis(city.points[city.facets], 1, 0)
    normal = np.cross(b - a, c - a)
    for marker in (Marker.GROUND, Marker.ROOF):
        assert (normal[city.marker == marker, 2] > 0).all()
    assert np.allclose(normal[city.marker == Marker.WALL, 2], 0)
    model = json.loads((small_run / "citymodel.city.json").read_text())
    heights = [thing["attributes"] for thing in model["CityObjects"].values() if "geometry" in thing]
    tallest = max(each["roof_height"] - each["ground_height"] for each in heights)
    assert heights_above_ground(city).max() == pytest.approx(tallest + DEEP, abs=0.01)
    # Walls look away from their building: they and its lid enclose it.
    house = city.building == 0
    corners = city.points[city.facets[house]]
    inside = corners[city.marker[house] == Marker.ROOF].mean(axis=(0, 1))
    away = ((corners.mean(axis=1) - inside) * normal[house]).sum(axis=1)
    assert away[city.marker[house] == Marker.WALL].sum() > 0
    monkeypatch.setattr("tiler.pictures.city_model_data.MOST_BLOCKS", 5)
    said: list[str] = []
    render_run(small_run, tmp_path / "x.png", what="citymodel", size=(160, 100), say=said.append)
    assert said == [f"the largest 5 of {n_buildings} building parts are drawn"]


def test_the_city_model_is_drawn_with_its_roofs(sloped_run: Path) -> None:
    model = read_city_model(sloped_run / CITY_MODEL)
    city, n_buildings, _ = load_blocks(sloped_run)
    assert n_buildings == len(model)
    points = city.points + city.origin
    triangles = points[city.facets[city.marker == Marker.ROOF]]
    centre = triangles.mean(axis=1)
    found, row = shapely.STRtree(model.polygons).query(shapely.points(centre[:, :2]), predicate="within")
    assert np.array_equal(found, np.arange(len(centre)))  # each lies in one building
    heights = [roof_heights(model.roofs, row, triangles[:, k, :2]) for k in range(3)]
    assert np.abs(np.stack(heights, axis=1) - triangles[..., 2]).max() < 0.01
    assert (np.ptp(triangles[..., 2], axis=1) > 0.5).sum() > 20
    area = np.bincount(row, shapely.area(shapely.polygons(triangles[..., :2])))
    assert np.allclose(area, shapely.area(model.polygons), rtol=1e-3)
    # Roofs and walls of a building enclose it, but for its bottom: open edges are at the feet of walls.
    for building in range(n_buildings):
        edges = Counter(
            edge for face in city.facets[city.building == building].tolist() for edge in pairwise([*face, face[0]])
        )
        assert max(edges.values()) == 1
        rim = [edge for edge in edges if edge[::-1] not in edges]
        assert len(set(points[np.array(rim), 2].ravel().tolist())) == 1


def test_what_is_missing_is_one_error(small_run: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(small_run, tmp_path / "run")
    for path in (copy / "mesh").iterdir():
        path.unlink()
        break
    with pytest.raises(InputError, match=path.name):
        render_run(copy, tmp_path / "x.png", what="quality")
    shutil.rmtree(copy / "store.zarr")
    with pytest.raises(InputError, match="run citystitch again"):
        render_run(copy, tmp_path / "x.png", what="citymodel")
    assert not (tmp_path / "x.png").exists()


def test_bad_cells_are_darker_than_good_ones() -> None:
    rgb = blend(np.linspace(0, 1, 50), QUALITY_COLOURS).astype(float) @ [0.3, 0.59, 0.11]
    assert (np.diff(rgb) > 0).all()
