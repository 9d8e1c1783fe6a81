"""The pictures: not blank, the city in them, and framed; bad runs end in one message."""

import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import pyvista
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from PIL import Image

from pipeline.errors import ConfigError, InputError, OutputError
from tests.scene import write_scene
from tiler.picture_parts import (
    City,
    _edge_style,
    _skirt,
    add_air,
    add_houses,
    heights_above_ground,
    load_city,
    load_volume,
)
from tiler.render import SIZES, fit_camera, render_run

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
    for what in ("boundary", "mesh"):
        render_run(run, folder / f"{what}.png", what=what, size=SIZE)
    assert sorted(path.name for path in folder.iterdir()) == ["boundary.png", "mesh.png"]
    return {path.stem: pixels(path) for path in folder.iterdir()}


@pytest.fixture
def copy(run: Path, tmp_path: Path) -> Path:
    return shutil.copytree(run, tmp_path / "run")


def pixels(path: Path) -> NDArray[np.int64]:
    with Image.open(path) as image:
        assert (image.format, image.mode) == ("PNG", "RGB")
        return np.asarray(image).astype(np.int64)


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
    assert warm(image).mean() > 0.02
    assert green(image).mean() > 0.005


def test_only_the_mesh_shows_air(pictures: dict[str, NDArray[np.int64]]) -> None:
    assert blue(pictures["mesh"]).mean() > 0.02
    assert blue(pictures["boundary"]).mean() < 0.002


def test_the_sky_gets_bluer_upwards_and_nothing_touches_the_frame(
    pictures: dict[str, NDArray[np.int64]],
) -> None:
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


def test_a_picture_has_a_size_of_its_own(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(SIZES, "boundary", (64, 41))
    render_run(run, tmp_path / "out.png")
    assert pixels(tmp_path / "out.png").shape == (41, 64, 3)


def test_ground_alone_is_a_picture(copy: Path, tmp_path: Path) -> None:
    for piece in (copy / "boundary").iterdir():
        surface = pyvista.read(piece)
        surface.extract_cells(np.flatnonzero(surface["marker"] == 1)).extract_surface(algorithm=None).save(piece)
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
    skirt = _skirt(city)
    assert np.allclose(np.abs(skirt.points[:, :2]).max(axis=1), SIDE / 2)
    assert skirt.points[:, 2].min() == pytest.approx(-0.015 * SIDE)
    assert skirt.area > 4 * SIDE * 0.015 * SIDE


def test_the_cut_keeps_whole_cells_of_the_northern_half(run: Path) -> None:
    city = load_city(run)
    plotter = pyvista.Plotter(off_screen=True)
    points = add_air(plotter, load_volume(run), city.origin, SIZE)
    plotter.close()
    assert -12 < points[:, 1].min() < 0
    assert points[:, 1].max() == pytest.approx(SIDE / 2)
    assert np.ptp(points[:, 0]) == pytest.approx(SIDE)


def test_heights_above_ground_are_those_of_the_building() -> None:
    points = np.array([[0, 0, 1.0], [1, 0, 2.0], [0, 1, 9.0], [1, 1, 9.0], [2, 2, 9.0]])
    facets = np.array([[0, 1, 2], [2, 3, 4], [0, 1, 1]])
    city = City(points, facets, np.array([2, 3, 1], np.int32), np.array([7, 7, -1]), np.zeros(3))
    np.testing.assert_array_equal(heights_above_ground(city), [8, 8, 0])


def test_walls_are_pale_and_roofs_redder_with_height(run: Path) -> None:
    city = load_city(run)
    plotter = pyvista.Plotter(off_screen=True)
    add_houses(plotter, city, SIZE)
    houses = plotter.meshes[0]
    plotter.close()
    marker = city.marker[city.marker != 1]
    assert np.all(houses["rgb"][marker == 2] == [255, 250, 240])
    height = heights_above_ground(city)[city.marker == 3]
    order = np.argsort(height)
    red, blue = houses["rgb"][marker == 3][order][:, [0, 2]].astype(np.int64).T
    assert red[0] - red[-1] > 20
    assert np.all(np.diff(blue[height[order] < 26.6]) <= 0)


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
        ({"what": "sunset"}, "picture 'sunset' must be one of boundary, mesh, overview"),
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
        ("boundary/1.vtp", "boundary", "boundary.pvtp: it or a piece of it is missing"),
        ("mesh.pvtu", "mesh", "mesh.pvtu: no such file"),
        ("mesh/0.vtu", "mesh", "mesh.pvtu: it or a piece of it is missing"),
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
    copy: Path,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
    damage: str,
) -> None:
    piece = copy / "boundary" / "1.vtp"
    blob = piece.read_bytes()
    if damage == "index":
        (copy / "boundary.pvtp").write_text("<VTKFile")
    elif damage == "cut":
        piece.write_bytes(blob[: len(blob) // 2])
    elif damage == "garbage":
        piece.write_bytes(blob[: len(blob) // 2] + b"A" * 50 + blob[len(blob) // 2 + 50 :])
    else:
        piece.write_bytes(blob.replace(b'Name="marker"', b'Name="merker"'))
    with pytest.raises(InputError, match=r"boundary.pvtp: it or a piece of it is missing, damaged"):
        render_run(copy, tmp_path / "out.png", size=SIZE)
    assert capfd.readouterr() == ("", "")
    assert caplog.records == []


@pytest.mark.parametrize(
    ("array", "message"),
    [("building", "need marker and building"), ("marker", "none of [0-9]+ facets is marked as ground")],
)
def test_a_boundary_without_marks_is_named(copy: Path, tmp_path: Path, array: str, message: str) -> None:
    for piece in (copy / "boundary").iterdir():
        surface = pyvista.read(piece)
        if array == "building":
            del surface.cell_data["building"]
        else:
            surface["marker"][:] = 3
        surface.save(piece)
    if array == "building":
        index = copy / "boundary.pvtp"
        lines = index.read_text().splitlines()
        index.write_text("\n".join(line for line in lines if 'Name="building"' not in line))
    with pytest.raises(InputError, match=message):
        render_run(copy, tmp_path / "out.png", size=SIZE)


def test_without_pyvista_the_extra_is_named(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyvista", None)
    with pytest.raises(ConfigError, match=r"pip install citystitch\[pictures\]"):
        render_run(run, tmp_path / "out.png")


def test_a_folder_in_the_way_leaves_nothing_behind(run: Path, tmp_path: Path) -> None:
    (tmp_path / "out.png").mkdir()
    with pytest.raises(OutputError, match=r"out.png: cannot be written"):
        render_run(run, tmp_path / "out.png", size=SIZE)
    assert [path.name for path in tmp_path.iterdir()] == ["out.png"]
