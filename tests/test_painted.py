"""Painted pictures: what is in front is seen, shadows fall, large regions take no more memory than small ones."""

import json
import shutil
import tracemalloc
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import shapely
from PIL import Image

from pipeline.errors import InputError
from pipeline.mesh import Boundary, Marker
from pipeline.quality import measure_cells
from tests.scene import PIECES, write_scene
from tiler.cli.main import main
from tiler.mesh_files.facet_quality import measure_facets
from tiler.mesh_files.vtk_files import read_vtp, read_vtu, write_pvtp, write_vtp
from tiler.pictures import render
from tiler.pictures.coarsening import Facets, coarsen, join_facets
from tiler.pictures.paint import SUN, Scene, View, fill_polygons, paint
from tiler.pictures.painted_pictures import paint_blocks, paint_cut
from tiler.pictures.picture_data import find_middle, load_city
from tiler.pictures.render import render_run
from tiler.pictures.scenes import QUALITY_COLOURS, block_scene, quality_colours

SKY = ("#ffffff", "#ffffff")
DOWN = View(np.array([0.0, -0.01, 100.0]), np.zeros(3), 30.0, (100, 80))


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("scene")
    write_scene(directory, side=200, n_buildings=30, mesh_size=15)
    return directory


def square(z: float, half: float, colour: tuple[int, int, int], middle: tuple[float, float] = (0, 0)) -> Scene:
    """Two triangles at a height, seen from above and from below."""
    low, high = np.array(middle) - half, np.array(middle) + half
    a, b, c, d = ([low[0], low[1], z], [high[0], low[1], z], [high[0], high[1], z], [low[0], high[1], z])
    return Scene(
        np.array([[a, b, c], [a, d, c]], np.float64), np.array([colour] * 2, np.uint8), np.zeros(2, np.bool_)
    )


def join(*scenes: Scene) -> Scene:
    return Scene(
        *(np.concatenate([getattr(each, name) for each in scenes]) for name in ("corners", "rgb", "lined"))
    )


def test_what_is_in_front_is_seen_whatever_the_order() -> None:
    red, blue = square(5, 5, (250, 0, 0)), square(0, 20, (0, 0, 250))
    pictures = [paint(join(*order), DOWN, sky=SKY) for order in ((red, blue), (blue, red))]
    assert np.array_equal(pictures[0], pictures[1])
    image = pictures[0].astype(int)
    assert image.shape == (80, 100, 3)
    assert (image[40, 50, 0] > 100, image[40, 50, 2]) == (True, 0)
    assert (image[40, 27, 0], image[40, 27, 2] > 100) == (0, True)
    assert image[2, 2].tolist() == [255, 255, 255]


def test_the_sun_throws_a_shadow_to_the_other_side() -> None:
    lid = join(square(8, 4, (250, 250, 250)), square(0, 26, (200, 200, 200)))
    image = paint(lid, DOWN, sky=SKY).astype(int)[..., 0]
    shift = 8 * SUN[:2] / SUN[2]  # m, from the lid to its shadow, away from the sun
    scale = 40 / np.tan(np.radians(15)) / 100

    def at(x: float, y: float) -> int:
        return int(image[round(40 - y * scale), round(50 + x * scale)])

    assert at(-shift[0], -shift[1] + 2) < 0.75 * at(shift[0], shift[1] - 2)


def test_polygons_are_filled_but_for_their_holes() -> None:
    image = np.zeros((40, 40), np.uint8)
    ring = shapely.difference(shapely.box(5, 5, 30, 35), shapely.box(10, 10, 20, 20))
    both = shapely.MultiPolygon([ring, shapely.box(33, 1, 39, 9)])
    fill_polygons(image, np.array([both, shapely.box(-50, -50, 2, 2)]), np.zeros(2), 1.0)
    assert image.sum() == ring.area + 6 * 8 + 4
    x, y = np.meshgrid(np.arange(40) + 0.5, np.arange(40) + 0.5)
    wanted = shapely.contains_xy(both, x, y) | ((x < 2) & (y < 2))
    assert np.array_equal(image.astype(bool), wanted)


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


def test_blocks_stand_on_the_terrain(small_run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    record = json.loads((small_run / "run.json").read_text())
    bounds = tuple(record["region"]["bounds"])
    found = block_scene(small_run, (bounds[0], bounds[1], bounds[2], bounds[3]))
    assert (found.n_buildings, found.n_shown) == (record["counts"]["building parts"],) * 2
    corners = found.scene.corners
    assert np.isfinite(corners).all()
    assert np.abs(corners[..., :2]).max() <= (bounds[2] - bounds[0]) / 2 + 1e-6
    monkeypatch.setattr("tiler.pictures.scenes.MOST_BLOCKS", 5)
    image, words = paint_blocks(small_run, (160, 100))
    assert image.shape == (100, 160, 3)
    assert words == f"the largest 5 of {found.n_buildings} building parts are drawn"


def test_a_cut_shows_cells_of_air(small_run: Path) -> None:
    city = load_city(small_run)
    image = paint_cut(small_run, city, (320, 200)).astype(int)
    red, green, blue = np.moveaxis(image, -1, 0)
    assert ((blue > red + 20) & (blue > green)).mean() > 0.2  # air, in the upper half
    assert ((red > green + 40) & (green > blue)).mean() > 0.01  # roofs
    assert image[-1, 160].sum() < 3 * 250  # ground, where the sky would be white


def test_what_reaches_behind_the_camera_is_left_out() -> None:
    ahead = square(0, 20, (0, 200, 0))
    behind = Scene(ahead.corners + np.array([0, 0, 99.5]), ahead.rgb, ahead.lined)
    assert (paint(join(ahead, behind), DOWN, sky=SKY)[40, 50] > 0).tolist() == [False, True, False]


def test_render_paints_quality_and_the_city_model(
    small_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(render.SIZES, "quality", (320, 240))
    for what, size in (("quality", (320, 240)), ("citymodel", (1600, 1000))):
        files = [tmp_path / f"{what}{k}.png" for k in range(2)]
        for file in files:
            assert main(["render", str(small_run), "--what", what, "-o", str(file)]) == 0
        assert files[0].read_bytes() == files[1].read_bytes()
        with Image.open(files[0]) as image:
            assert image.size == size
            assert len(np.unique(np.asarray(image).reshape(-1, 3), axis=0)) > 1000
    assert capsys.readouterr().err == ""


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
    with pytest.raises(ValueError, match="at least 2 x 48"):
        render_run(small_run, tmp_path / "x.png", what="quality", size=(100, 40))
    assert not (tmp_path / "x.png").exists()


def test_bad_cells_are_darker_than_good_ones() -> None:
    rgb = quality_colours(np.linspace(0.2, 0.8, 50)).astype(float) @ [0.3, 0.59, 0.11]
    assert (np.diff(rgb) > 0).all()
    assert quality_colours(np.array([np.nan])).tolist() == [[128, 128, 128]]
    assert len(QUALITY_COLOURS) == 6
