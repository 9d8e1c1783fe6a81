"""The picture of docs/towns.md, a house in 16 levels: `python -m tests.benchmarks.town_levels FILE.png`."""

import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pyvista as pv
import triangle
from PIL import Image

from pipeline.architecture.draw import draw_house
from pipeline.architecture.levels import LEVELS, make_level
from pipeline.architecture.lots import Lot
from pipeline.architecture.parameters import House
from pipeline.architecture.rules import make_rules
from pipeline.architecture.surfaces import Surface

COLOURS = {
    "GroundSurface": "#777777",
    "WallSurface": "#e8dcc8",
    "RoofSurface": "#b5533c",
    "Window": "#6fa8dc",
    "Door": "#6b4226",
    "ClosureSurface": "#333333",
}
RULES = {
    "roof_shape": "gabled",
    "dormers": 2,
    "chimney": 1,
    "garage": 1,
    "alcove": 1,
    "roof_pitch": 42,
    "storeys": 2,
}


def triangulate(surface: Surface) -> pv.PolyData:
    """Triangles of a polygon with holes."""
    rings = [surface.border, *surface.holes]
    places = np.array([place for ring in rings for place in ring])
    border = np.array(surface.border) - places[0]
    normal = np.cross(border, np.roll(border, -1, axis=0)).sum(axis=0)
    normal /= np.linalg.norm(normal)
    east = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    east /= np.linalg.norm(east)
    axes = np.column_stack((east, np.cross(normal, east)))
    flat = (places - places[0]) @ axes
    ends = np.cumsum([0, *map(len, rings)])
    sides = [(a + k, a + (k + 1) % (b - a)) for a, b in pairwise(ends.tolist()) for k in range(b - a)]
    holes = [flat[a:b].mean(axis=0) for a, b in pairwise(ends[1:].tolist())]
    found = triangle.triangulate({"vertices": flat, "segments": sides} | ({"holes": holes} if holes else {}), "p")
    corners = found["triangles"]
    faces = np.column_stack((np.full(len(corners), 3), corners)).ravel()
    return pv.PolyData(places[0] + found["vertices"] @ axes.T, faces)


def find_house() -> House:
    """The first house that has all there is."""
    rules = make_rules(RULES | {"roof_windows": 2, "overhang": 0.5})
    houses = (draw_house(rules, Lot(k, 0, 0, 0, 30, 0.0), lambda x, y: 0.0, seed=2) for k in range(100))
    return next(house for house in houses if len(house.dormers) == len(house.parts) == 2 and house.roof_windows)


def show(plotter: pv.Plotter, surfaces: list[Surface], shift: np.ndarray, opacity: float = 1.0) -> None:
    """Add surfaces and their edges."""
    for surface in surfaces:
        faces = triangulate(surface).translate(shift)
        plotter.add_mesh(faces, color=COLOURS[surface.kind], opacity=opacity, ambient=0.45, diffuse=0.65)
        for ring in (surface.border, *surface.holes):
            plotter.add_mesh(pv.lines_from_points(np.array([*ring, ring[0]]) + shift), color="#444444")


def show_house(plotter: pv.Plotter, house: House, level: str, shift: np.ndarray) -> None:
    """Add a house with all that it has."""
    for volume in make_level(house, level, solid=level < "2.3"):
        show(plotter, volume.surfaces, shift)


def save(plotter: pv.Plotter, path: Path, colours: int) -> None:
    """Save a picture with few colours."""
    picture = Image.fromarray(plotter.screenshot())
    few = picture.quantize(colours, method=Image.Quantize.MAXCOVERAGE, kmeans=2, dither=Image.Dither.NONE)
    few.save(path, optimize=True)


def draw(path: Path) -> None:
    """Draw the levels in rows of four."""
    house, plotter = find_house(), pv.Plotter(off_screen=True, window_size=(1400, 1120))
    for number, level in enumerate(LEVELS):
        shift = np.array([24 * (number % 4), 0, -22 * (number // 4)])
        show_house(plotter, house, level, shift)
        place = shift + np.array([house.x - 3, house.y - 6, 0])
        plotter.add_point_labels(
            [place], [level], font_size=22, shape=None, show_points=False, always_visible=True
        )
    plotter.set_background("white")
    plotter.enable_parallel_projection()
    plotter.camera_position = [(85, -125, 48), (38, 0, -33), (0, 0, 1)]
    plotter.camera.parallel_scale = 46
    save(plotter, path, 48)


if __name__ == "__main__":
    draw(Path(sys.argv[1]))
