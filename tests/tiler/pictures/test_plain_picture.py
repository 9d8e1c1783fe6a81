"""Pictures without OpenGL."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import pyvista
from PIL import Image

from tests.helpers.scene import write_scene
from tiler.pictures import plain_picture, render
from tiler.pictures.plain_picture import PlainPlotter, has_graphics


def paint(*squares: tuple[float, str]) -> np.ndarray[tuple[int, int, int], np.dtype[np.uint8]]:
    """Squares across the view at some depth, of some colour, seen along y."""
    plotter = PlainPlotter()
    for depth, colour in squares:
        points = np.array([[-1.0, depth, -1], [1, depth, -1], [1, depth, 1], [-1, depth, 1]])
        plotter.add_mesh(pyvista.PolyData.from_regular_faces(points, [[0, 1, 2, 3]]), color=colour)
    camera = np.array([0.0, -10.0, 0.0]), np.zeros(3)
    return plotter.paint(*camera, view_angle=30.0, size=(60, 40), sky=("#ffffff", "#0000ff"))


def test_what_is_near_hides_what_is_far() -> None:
    red, green = "#ff0000", "#00ff00"
    for squares in (((0.0, red), (5.0, green)), ((5.0, green), (0.0, red))):
        middle = paint(*squares)[20, 30].astype(int)
        assert middle[0] > 100 > middle[1]


def test_sky_runs_from_bottom_to_top_and_sizes_are_right() -> None:
    image = paint((0.0, "#ff0000"))
    assert image.shape == (40, 60, 3)
    assert image[0, 0, 0] < 20
    assert image[-1, 0, 0] > 240


def test_a_square_covers_the_pixels_that_perspective_says() -> None:
    red = (paint((0.0, "#ff0000"))[..., 2] < 60).sum()
    # 2 m at 10 m and 30 degrees over 40 rows: 2 / (2 * 10 * tan 15) * 40 = 14.9 pixels.
    assert red == pytest.approx(14.93**2, rel=0.15)


def test_graphics_are_asked_for_in_another_process(monkeypatch: pytest.MonkeyPatch) -> None:
    has_graphics.cache_clear()
    monkeypatch.setattr(plain_picture, "PROBE", "import os, signal; os.kill(os.getpid(), signal.SIGSEGV)")
    assert not has_graphics()
    has_graphics.cache_clear()
    monkeypatch.setattr(plain_picture, "PROBE", "")
    assert has_graphics()
    has_graphics.cache_clear()


@pytest.mark.parametrize("what", ["boundary", "mesh", "overview"])
def test_a_run_is_drawn_without_graphics(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, what: str) -> None:
    write_scene(tmp_path, side=300, n_buildings=12, mesh_size=15)
    monkeypatch.setattr(render, "has_graphics", lambda: False)
    pictures = [tmp_path / "one.png", tmp_path / "two.png"]
    for picture in pictures:
        render.render_run(tmp_path, picture, what=what, size=(400, 200))
    assert pictures[0].read_bytes() == pictures[1].read_bytes()
    image = np.asarray(Image.open(pictures[0]))
    assert image.shape == (200, 400, 3)
    assert len(np.unique(image.reshape(-1, 3), axis=0)) > 100


def test_importing_the_module_needs_no_graphics() -> None:
    code = "import sys, tiler.pictures.plain_picture; sys.exit('pyvista' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
