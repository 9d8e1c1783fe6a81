"""The second picture of docs/towns.md: `python -m tests.benchmarks.town_views FILE.png`."""

import sys
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import laspy
import numpy as np
import pyvista as pv

from pipeline.architecture.interiors import INTERIORS, make_interior
from pipeline.architecture.levels import make_level
from pipeline.architecture.parameters import ROOF_SHAPES
from tests.benchmarks.town_levels import find_house, show, show_house
from tiler.cli.main import main as citystitch
from tiler.towns.parameter_files import read_json

CLASSES = {1: "#999999", 2: "#b08d57", 5: "#4f8f3a", 6: "#b5533c"}
TOWN = ("--style", "blocks", "--size", "110", "--lidar", "8", "--trees", "0.8", "--relief", "8", "--seed", "3")


def look(plotter: pv.Plotter, title: str, way: tuple[float, float, float]) -> None:
    """Look at a panel along a way."""
    plotter.add_text(title, font_size=10, color="black")
    plotter.view_vector(way, (0, 0, 1))
    plotter.camera.zoom(1.12)


def draw(path: Path) -> None:
    """Draw six panels."""
    plotter = pv.Plotter(off_screen=True, window_size=(1500, 860), shape=(2, 3))
    plotter.set_background("white")
    house = find_house()
    plotter.subplot(0, 0)
    for number, shape in enumerate(ROOF_SHAPES):
        bare = replace(house, dormers=(), chimneys=(), roof_windows=())
        rise = 0.0 if shape == "flat" else house.roof.rise
        one = replace(bare, roof=replace(house.roof, shape=shape, rise=rise))
        show_house(plotter, one, "3.2", np.array([22.0 * (number % 3), -26.0 * (number // 3), 0.0]))
    look(plotter, "five roofs", (-0.5, -1, 0.7))
    plotter.subplot(0, 1)
    for number, level in enumerate(INTERIORS):
        shift = np.array([20.0 * (number % 2), -20.0 * (number // 2), 0.0])
        for room in make_interior(house, level):
            show(plotter, room.volume.surfaces, shift)
        walls = [one for volume in make_level(house, "2.0") for one in volume.surfaces]
        show(plotter, walls, shift, 0.15)
    look(plotter, "interiors 0, 1, 2.2 and 2.3", (-0.5, -1, 0.6))
    with TemporaryDirectory() as name:
        town, out = Path(name) / "town", Path(name) / "out"
        citystitch(["synth", str(town), *TOWN])
        inputs = [str(town / "tiles"), "--buildings", str(town / "town.city.jsonl")]
        citystitch(["run", *inputs, "--out", str(out), "--workers", "0", "--mesh-size", "6", "-q"])
        houses = list(read_json(town / "parameters.jsonl"))
        las = laspy.read(next((town / "tiles").glob("*.laz")))
        mesh = pv.merge([pv.read(piece) for piece in sorted((out / "boundary").glob("*.vtp"))])
    middle = np.array([-np.mean([h.x for h in houses]), -np.mean([h.y for h in houses]), 0.0])
    plotter.subplot(0, 2)
    for one in houses:
        if np.hypot(one.x + middle[0], one.y + middle[1]) < 35:
            show_house(plotter, one, "3.2", middle)
    look(plotter, "a street", (-0.6, -1, 0.3))
    plotter.subplot(1, 0)
    xyz = np.column_stack((las.x, las.y, las.z)) + middle
    for number, colour in CLASSES.items():
        plotter.add_points(xyz[np.asarray(las.classification) == number], color=colour, point_size=1.5)
    look(plotter, "the town scanned", (-0.5, -1, 0.9))
    plotter.subplot(1, 1)
    for one in houses:
        for volume in make_level(one, "2.2"):
            show(plotter, volume.surfaces, middle)
    look(plotter, "its city model", (-0.5, -1, 0.9))
    plotter.subplot(1, 2)
    low = mesh.extract_cells(np.flatnonzero(np.isin(mesh["marker"], (1, 2, 3)))).translate(middle)
    plotter.add_mesh(
        low, scalars="marker", cmap=["#b08d57", "#e8dcc8", "#b5533c"], show_edges=True, show_scalar_bar=False
    )
    look(plotter, "its mesh", (-0.5, -1, 0.9))
    plotter.screenshot(path)


if __name__ == "__main__":
    draw(Path(sys.argv[1]))
