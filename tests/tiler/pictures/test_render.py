"""The pictures: not blank, the city in them, and framed; bad runs end in one message."""

import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from PIL import Image

from pipeline.data.errors import ConfigError, InputError, OutputError
from pipeline.data.mesh import Boundary, Marker
from tests.helpers.scene import PIECES, write_scene
from tests.helpers.vtk_writers import write_vtp
from tiler.cli.main import main
from tiler.mesh_files.vtk_files import read_vtp, read_vtu, write_pvtp
from tiler.pictures import picture_data, render
from tiler.pictures.picture_data import City, find_outer_faces, load_air, load_city
from tiler.pictures.picture_parts import (
    TILE_COLOURS,
    _edge_style,
    height_colours,
    heights_above_ground,
    make_skirt,
    tile_colours,
)
from tiler.pictures.render import SIZES, draw_city, fit_camera, render_run

SIDE = 240.0
SIZE = (400, 250)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("run")
    write_scene(directory, side=SIDE, n_buildings=60, mesh_size=12)
    return directory


@pytest.fixture(scope="module")
def pictures(run: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, NDArray[np.int64]]:
    folder = tmp_path_factory.mktemp("pictures")
    for what in ("boundary", "mesh", "tiles"):
        render_run(run, folder / f"{what}.png", what=what, size=SIZE)
    assert sorted(path.name for path in folder.iterdir()) == ["boundary.png", "mesh.png", "tiles.png"]
    return {path.stem: pixels(path) for path in folder.iterdir()}


@pytest.fixture
def copy(run: Path, tmp_path: Path) -> Path:
    return shutil.copytree(run, tmp_path / "run")


def pixels(path: Path) -> NDArray[np.int64]:
    with Image.open(path) as image:
        assert (image.format, image.mode) == ("PNG", "RGB")
        return np.asarray(image).astype(np.int64)


def take_facets(boundary: Boundary, kept: NDArray[np.bool_]) -> Boundary:
    return Boundary(boundary.facets[kept], boundary.marker[kept], boundary.building[kept])


def warm(image: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Roofs: much more red than green, more green than blue."""
    red, green, blue = np.moveaxis(image, -1, 0)
    found: NDArray[np.bool_] = (red > green + 40) & (green > blue)
    return found


def green(image: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Low ground: more green than red and blue."""
    red, green, blue = np.moveaxis(image, -1, 0)
    found: NDArray[np.bool_] = (green > red + 5) & (green > blue + 15)
    return found


def blue(image: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Low air on the cut: darker and bluer than the sky."""
    red, _, blue = np.moveaxis(image, -1, 0)
    found: NDArray[np.bool_] = (blue > red + 25) & (red < 160)
    return found


@pytest.mark.parametrize("what", ["boundary", "mesh"])
def test_a_picture_shows_the_city(pictures: dict[str, NDArray[np.int64]], what: str) -> None:
    image = pictures[what]
    assert image.shape == (SIZE[1], SIZE[0], 3)
    assert len(np.unique(image.reshape(-1, 3), axis=0)) > 2000
    assert warm(image).mean() > 0.018
    assert green(image).mean() > 0.005


def test_only_the_mesh_shows_air(pictures: dict[str, NDArray[np.int64]]) -> None:
    assert blue(pictures["mesh"]).mean() > 0.02
    assert blue(pictures["boundary"]).mean() < 0.002


def test_tiles_have_the_same_outlines_in_other_colours(pictures: dict[str, NDArray[np.int64]]) -> None:
    plain, tiles = pictures["boundary"], pictures["tiles"]
    skies = [np.abs(image - image[:, :1]).max(axis=2) < 3 for image in (plain, tiles)]
    assert (skies[0] != skies[1]).mean() < 0.01
    red, _, blue_ = np.moveaxis(tiles, -1, 0)
    western, eastern = ~skies[1] & (blue_ > red + 20), ~skies[1] & (red > blue_ + 20)
    assert min(western.mean(), eastern.mean()) > 0.1
    assert warm(tiles).mean() < 0.002
    # From the south-west, west is left.
    assert np.nonzero(western)[1].mean() < np.nonzero(eastern)[1].mean() - 0.2 * SIZE[0]


def test_the_sky_gets_bluer_upwards_and_nothing_touches_the_frame(pictures: dict[str, NDArray[np.int64]]) -> None:
    for image in pictures.values():
        rim = np.concatenate([image[:, :1], image[:, -1:]], axis=1)
        assert np.ptp(rim, axis=1).max() <= 1
        assert np.ptp(image[0], axis=0).max() <= 1
        assert np.ptp(image[-1], axis=0).max() <= 1
        assert image[0, 0, 0] < image[-1, 0, 0] - 30
    drawn = np.abs(pictures["boundary"] - pictures["boundary"][:, :1]).max(axis=2) > 3
    columns = np.flatnonzero(drawn.any(axis=0))
    assert np.ptp(columns) > 0.9 * SIZE[0]


def test_the_overview_has_both_halves(run: Path, tmp_path: Path) -> None:
    render_run(run, tmp_path / "both.png", what="overview", size=(501, 180))
    image = pixels(tmp_path / "both.png")
    assert image.shape == (180, 501, 3)
    left, right = image[:, :250], image[:, 250:]
    assert warm(left).mean() > 0.01
    assert warm(right).mean() > 0.01
    assert blue(right).mean() > 0.02
    assert blue(left).mean() < 0.002


def test_a_picture_in_blocks_is_the_one_drawn_at_once(run: Path) -> None:
    city = load_city(run)
    city = replace(city, points=10 * city.points)
    whole = draw_city(city, SIZE, at_once=9999).astype(np.int64)
    blocks = draw_city(city, SIZE, at_once=1).astype(np.int64)
    difference = np.abs(blocks - whole).max(axis=2)
    assert difference.mean() < 3, "the shade has a pattern of 4 pixels"
    assert difference.mean(axis=1).max() < 6


def test_a_picture_has_a_size_of_its_own(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(SIZES, "boundary", (64, 41))
    render_run(run, tmp_path / "out.png")
    assert pixels(tmp_path / "out.png").shape == (41, 64, 3)


def test_ground_alone_is_a_picture(copy: Path, tmp_path: Path) -> None:
    for path in (copy / "boundary").iterdir():
        part = read_vtp(path)
        write_vtp(path, part.points, take_facets(part.boundary, part.boundary.marker == Marker.GROUND))
    render_run(copy, tmp_path / "ground.png", size=SIZE)
    image = pixels(tmp_path / "ground.png")
    assert green(image).mean() > 0.03
    assert not warm(image).any()


def test_the_pieces_are_sewn_and_turned_towards_the_camera(run: Path) -> None:
    city = load_city(run)
    assert len(np.unique(city.points, axis=0)) == len(city.points)
    assert np.abs(city.points[:, :2]).max() == pytest.approx(SIDE / 2)
    assert city.points[:, 2].min() == 0
    a, b, c = np.moveaxis(city.points[city.facets], 1, 0)
    normal = np.cross(b - a, c - a)
    assert np.all(normal[city.marker != 2, 2] > 0)
    assert np.all(np.abs(normal[city.marker == 2, 2]) < 1e-9)
    assert set(city.marker) == {1, 2, 3}
    # Over one house, the walls' area vectors and the roof's horizontal one add up as a lid does.
    house = city.building == city.building.max()
    outwards = ((a + b + c)[house] / 3 - city.points[city.facets[house]].mean(axis=(0, 1))) * normal[house]
    assert outwards.sum() > 0


def test_the_skirt_hangs_from_the_rim_alone(run: Path) -> None:
    city = load_city(run)
    skirt = make_skirt(city)
    assert np.allclose(np.abs(skirt.points[:, :2]).max(axis=1), SIDE / 2)
    assert skirt.points[:, 2].min() == pytest.approx(-0.015 * SIDE)
    assert skirt.area > 4 * SIDE * 0.015 * SIDE


def test_pieces_make_no_difference_but_in_their_names(run: Path, copy: Path) -> None:
    """A seam leaves no trace in what is drawn: the same vertices and facets as of one piece."""
    parts = [read_vtp(run / "boundary" / f"{name}.vtp") for name in PIECES]
    start = len(parts[0].points)
    points, index = np.unique(np.concatenate([part.points for part in parts]), axis=0, return_inverse=True)
    assert len(points) < len(index)
    facets = index.reshape(-1)[np.concatenate((parts[0].boundary.facets, parts[1].boundary.facets + start))]
    marks = (np.concatenate([getattr(part.boundary, name) for part in parts]) for name in ("marker", "building"))
    write_vtp(copy / "boundary" / "7_7.vtp", points, Boundary(facets.astype(np.int32), *marks))
    write_pvtp(copy / "boundary.pvtp", [copy / "boundary" / "7_7.vtp"])
    city, joined = load_city(run), load_city(copy)
    assert (city.names, joined.names) == (PIECES, ("7_7",))
    assert np.bincount(city.piece).min() > 0.3 * len(city.piece)
    for name in ("points", "facets", "marker", "building", "origin"):
        assert getattr(city, name).tobytes() == getattr(joined, name).tobytes()


def test_more_facets_than_the_bound_are_made_coarser(run: Path) -> None:
    fine = load_city(run)
    n = len(fine.facets)
    assert (len(load_city(run, most=n).facets), fine.step) == (n, 0.0)
    coarse = load_city(run, most=n // 3)
    assert 0 < len(coarse.facets) <= n // 3
    assert coarse.step >= 2.0
    assert set(coarse.marker.tolist()) == {Marker.GROUND, Marker.WALL, Marker.ROOF}
    middle = fine.points + fine.origin - coarse.origin
    assert np.abs(coarse.points.max(axis=0) - middle.max(axis=0)).max() <= coarse.step
    assert np.abs(coarse.points.min(axis=0) - middle.min(axis=0)).max() <= coarse.step


def test_walls_and_ground_of_a_tile_are_paler_than_its_roofs(run: Path) -> None:
    city = load_city(run)
    rgb = tile_colours(city)
    for piece, colour in ((0, "6699cc"), (1, "eecc66")):
        full = np.array(list(bytes.fromhex(colour)))
        for marker, white in ((1, 0.3), (2, 0.6), (3, 0.0)):
            mine = rgb[(city.piece == piece) & (city.marker == marker)]
            assert np.all(mine == np.rint(full + white * (255 - full)))


def test_tiles_differ_from_the_eight_around_them() -> None:
    names = [f"{i}_{j}" for i in range(-2, 2) for j in range(3, 6)]
    n = len(names)
    facets, marker = np.zeros((n, 3), np.int64), np.full(n, 3, np.int32)
    rows = np.arange(n)
    city = City(
        np.zeros((1, 3)), facets.astype(np.int32), marker, rows, rows.astype(np.int32), tuple(names), np.zeros(3)
    )
    rgb = tile_colours(city).reshape(4, 3, 3)
    for i, j in np.ndindex(4, 3):
        around = rgb[max(i - 1, 0) : i + 2, max(j - 1, 0) : j + 2].reshape(-1, 3)
        assert np.all(around == rgb[i, j], axis=1).sum() == 1


@pytest.mark.parametrize("missing", ["none", "red", "green", "blue"])
def test_tile_colours_are_apart_for_all_eyes(missing: str) -> None:
    """Machado, Oliveira and Fernandes (2009), full severity: at least 20 steps of CIELAB between any two."""
    eyes = {
        "none": np.eye(3).tolist(),
        "red": [[0.152, 1.053, -0.205], [0.115, 0.786, 0.099], [-0.004, -0.048, 1.052]],
        "green": [[0.367, 0.861, -0.228], [0.280, 0.673, 0.047], [-0.012, 0.043, 0.969]],
        "blue": [[1.256, -0.077, -0.179], [-0.078, 0.931, 0.148], [0.005, 0.691, 0.304]],
    }
    to_xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
    srgb = np.array([list(bytes.fromhex(colour[1:])) for row in TILE_COLOURS for colour in row]) / 255
    linear = ((srgb + 0.055) / 1.055) ** 2.4
    seen = np.clip(linear @ np.array(eyes[missing]).T, 0, 1)
    x, y, z = np.cbrt(seen @ to_xyz.T / (to_xyz.sum(axis=1))).T
    lab = np.column_stack((116 * y, 500 * (x - y), 200 * (y - z)))
    apart = np.linalg.norm(lab[:, None] - lab, axis=2)[np.triu_indices(len(lab), 1)]
    assert apart.min() > 20


def test_pieces_that_are_no_tiles_are_named(run: Path) -> None:
    city = replace(load_city(run), names=("west", "1_0"))
    with pytest.raises(InputError, match="the piece 'west' is not named after a tile"):
        tile_colours(city)


def test_the_cut_keeps_whole_cells_of_the_northern_half(run: Path) -> None:
    city = load_city(run)
    points = load_air(run, city.origin).points
    assert -12 < points[:, 1].min() < 0
    assert points[:, 1].max() == pytest.approx(SIDE / 2)
    assert np.ptp(points[:, 0]) == pytest.approx(SIDE)


def test_outer_faces_enclose_the_cells(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(picture_data, "STRIP_CELLS", 500)
    mesh = read_vtu(run / "mesh" / f"{PIECES[0]}.vtu").mesh
    whole = np.ones(len(mesh.cells), np.bool_)
    faces = find_outer_faces(mesh.points, mesh.cells, whole, np.empty((0, 3), np.int64))
    a, b, c, d = np.moveaxis(mesh.points[mesh.cells] - mesh.points[0], 1, 0)
    volume = np.abs(((b - a) * np.cross(c - a, d - a)).sum(axis=1)).sum() / 6
    a, b, c = np.moveaxis(mesh.points[faces] - mesh.points[0], 1, 0)
    assert (a * np.cross(b, c)).sum() / 6 == pytest.approx(volume)
    assert np.array_equal(find_outer_faces(mesh.points, mesh.cells, whole, faces[:9]), faces[9:])


def test_heights_above_ground_are_those_of_the_building() -> None:
    points = np.array([[0, 0, 1.0], [1, 0, 2.0], [0, 1, 9.0], [1, 1, 9.0], [2, 2, 9.0]])
    facets = np.array([[0, 1, 2], [2, 3, 4], [0, 1, 1]])
    city = City(
        points,
        facets,
        np.array([2, 3, 1], np.int32),
        np.array([7, 7, -1]),
        np.zeros(3, np.int32),
        ("0_0",),
        np.zeros(3),
    )
    np.testing.assert_array_equal(heights_above_ground(city), [8, 8, 0])


def test_walls_are_pale_and_roofs_redder_with_height(run: Path) -> None:
    city = load_city(run)
    rgb = height_colours(city)
    assert np.all(rgb[city.marker == Marker.WALL] == [255, 250, 240])
    roofs = city.marker == Marker.ROOF
    height = heights_above_ground(city)[roofs]
    order = np.argsort(height)
    red, blue = rgb[roofs][order][:, [0, 2]].astype(np.int64).T
    assert red[0] - red[-1] > 20
    assert np.all(np.diff(blue[height[order] < 26.6]) <= 0)


def test_quality_has_its_colours_and_a_legend(run: Path) -> None:
    city = load_city(run, quality=True)
    good, bad = (
        draw_city(
            replace(city, quality=np.full(len(city.facets), ratio, np.float32)), SIZE, colours="quality"
        ).astype(np.int64)
        for ratio in (0.8, 0.2)
    )
    assert good[150, 200].min() > 150  # pale
    assert bad[150, 200].max() < 110  # dark
    legend = good[int(0.86 * SIZE[1]) :, int(0.68 * SIZE[0]) :]
    assert np.array_equal(legend[10:], bad[int(0.86 * SIZE[1]) + 10 :, int(0.68 * SIZE[0]) :])
    red, green, blue_ = np.moveaxis(legend, -1, 0)
    assert ((red > green + 60) & (red > blue_ + 60)).mean() > 0.02


def test_a_close_picture_shows_the_cells_of_the_middle(run: Path) -> None:
    city = load_city(run)
    air = load_air(run, city.origin)
    far, near = (draw_city(city, SIZE, air=air, close=close).astype(np.int64) for close in (False, True))
    assert blue(near).mean() > 1.2 * blue(far).mean()


def test_edges_fade_and_vanish_as_triangles_get_small() -> None:
    few, some, many = (_edge_style(n, (1000, 800)) for n in (5_000, 25_000, 100_000))
    assert few["edge_opacity"] == pytest.approx(0.35)
    assert some["edge_opacity"] == pytest.approx(0.35 / 2)
    assert many == {}


@given(
    box=st.tuples(st.floats(50, 5000), st.floats(50, 5000), st.floats(0, 500)),
    corner=st.tuples(*[st.floats(-1e4, 1e4)] * 3),
    azimuth=st.floats(0, 360),
    elevation=st.floats(15, 60),
    aspect=st.floats(0.5, 3),
)
def test_the_camera_just_holds_all_points(
    box: tuple[float, ...], corner: tuple[float, ...], azimuth: float, elevation: float, aspect: float
) -> None:
    cloud = np.array(np.meshgrid([0, 1], [0, 1], [0, 1])).reshape(3, -1).T * box + corner
    position, focal = fit_camera(cloud, azimuth=azimuth, elevation=elevation, view_angle=30, aspect=aspect)
    ahead = (focal - position) / np.linalg.norm(focal - position)
    turn = np.radians(azimuth)
    assert np.degrees(np.arcsin(-ahead[2])) == pytest.approx(elevation)
    assert -ahead[:2] @ [np.sin(turn), np.cos(turn)] == pytest.approx(np.cos(np.radians(elevation)))
    right = np.cross(ahead, [0, 0, 1]) / np.linalg.norm(ahead[:2])
    away = cloud - position
    share = np.column_stack([away @ right / aspect, away @ np.cross(right, ahead)])
    share /= np.tan(np.radians(15)) * (away @ ahead)[:, None]
    # On one axis both sides of the picture are touched, on the other none is passed.
    reach = np.array([-share.min(axis=0), share.max(axis=0)])
    assert reach.max() == pytest.approx(1, abs=1e-6)
    assert np.all(np.isclose(reach, 1, atol=1e-6), axis=0).any()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"what": "sunset"}, "picture 'sunset' must be one of boundary, mesh, overview, tiles"),
        ({"size": (0, 100)}, "size 0 x 100 must be at least 2 x 2"),
    ],
)
def test_wrong_arguments(run: Path, tmp_path: Path, options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        render_run(run, tmp_path / "out.png", **options)


@pytest.mark.parametrize(
    ("lost", "what", "named"),
    [
        ("boundary.pvtp", "boundary", "boundary.pvtp: no such file"),
        ("boundary/1_0.vtp", "boundary", r"boundary.pvtp: the piece .*1_0.vtp is missing"),
        ("mesh.pvtu", "mesh", "mesh.pvtu: no such file"),
        ("mesh/0_0.vtu", "mesh", r"mesh.pvtu: the piece .*0_0.vtu is missing"),
    ],
)
def test_a_lost_file_is_named(
    copy: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str], lost: str, what: str, named: str
) -> None:
    (copy / lost).unlink()
    with pytest.raises(InputError, match=named):
        render_run(copy, tmp_path / "out.png", what=what, size=SIZE)
    assert capfd.readouterr() == ("", "")
    assert list(tmp_path.iterdir()) == [copy]


@pytest.mark.parametrize("damage", ["index", "cut", "garbage", "array"])
def test_damage_is_named(
    copy: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture, damage: str
) -> None:
    piece = copy / "boundary" / "1_0.vtp"
    blob = piece.read_bytes()
    if damage == "index":
        (copy / "boundary.pvtp").write_text("<VTKFile")
    elif damage == "cut":
        piece.write_bytes(blob[: len(blob) // 2])
    elif damage == "garbage":
        piece.write_bytes(blob[: len(blob) // 2] + b"A" * 50 + blob[len(blob) // 2 + 50 :])
    else:
        piece.write_bytes(blob.replace(b'Name="marker"', b'Name="merker"'))
    named = "boundary.pvtp" if damage == "index" else "1_0.vtp"
    with pytest.raises(InputError, match=rf"{named}: not a file of ours or damaged"):
        render_run(copy, tmp_path / "out.png", size=SIZE)
    assert capfd.readouterr() == ("", "")
    assert caplog.records == []


def test_a_boundary_without_ground_is_named(copy: Path, tmp_path: Path) -> None:
    for path in (copy / "boundary").iterdir():
        part = read_vtp(path)
        write_vtp(
            path, part.points, replace(part.boundary, marker=part.boundary.marker * 0 + np.int32(Marker.ROOF))
        )
    with pytest.raises(InputError, match=r"none of [0-9]+ facets is marked as ground"):
        render_run(copy, tmp_path / "out.png", size=SIZE)


def test_without_pyvista_the_extra_is_named(
    run: Path, small_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "pyvista", None)
    for what in SIZES:
        with pytest.raises(ConfigError, match=r"pip install citystitch\[pictures\]"):
            render_run(run, tmp_path / "out.png", what=what)
    assert main(["render", str(small_run), "-o", str(tmp_path / "out.png")]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_pictures_with_a_legend_need_opengl(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(render, "has_graphics", lambda: False)
    said: list[str] = []
    render_run(run, tmp_path / "out.png", size=(60, 40), say=said.append)
    assert "the picture is plain: VTK finds no OpenGL" in said[0]
    for what in render.NEED_GRAPHICS:
        with pytest.raises(ConfigError, match=rf"picture {what}: VTK finds no OpenGL; .* apt install libegl1"):
            render_run(run, tmp_path / "out.png", what=what, size=(60, 40))


def test_a_picture_needs_no_display(run: Path, tmp_path: Path) -> None:
    code = "from pathlib import Path; from tiler.pictures.render import render_run; import sys\n"
    code += "render_run(Path(sys.argv[1]), Path(sys.argv[2]), size=(60, 40))"
    environment = {name: value for name, value in os.environ.items() if "DISPLAY" not in name}
    done = subprocess.run(
        [sys.executable, "-c", code, run, tmp_path / "out.png"], env=environment, capture_output=True, check=True
    )
    assert (done.stdout, done.stderr) == (b"", b"")
    assert pixels(tmp_path / "out.png").shape == (40, 60, 3)


def test_a_folder_in_the_way_leaves_nothing_behind(run: Path, tmp_path: Path) -> None:
    (tmp_path / "out.png").mkdir()
    with pytest.raises(OutputError, match=r"out.png: cannot be written"):
        render_run(run, tmp_path / "out.png", size=SIZE)
    assert [path.name for path in tmp_path.iterdir()] == ["out.png"]
