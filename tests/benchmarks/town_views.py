"""The second picture of docs/towns.md: `python -m tests.benchmarks.town_views FILE.png`."""

import json
import sys
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import laspy
import numpy as np
import pyvista as pv

from pipeline.architecture.draw import draw_house
from pipeline.architecture.interiors import INTERIORS, make_interior
from pipeline.architecture.levels import make_level
from pipeline.architecture.lots import Lot
from pipeline.architecture.parameters import ROOF_SHAPES
from pipeline.architecture.rules import make_rules
from tests.benchmarks.town_levels import RULES, find_house, save, show, show_house
from tiler.cli.main import main as citystitch
from tiler.towns.parameter_files import read_json
from tiler.towns.town import open_town

GREEN = "#4f8f3a"
CLASSES = {1: "#999999", 2: "#b08d57", 5: GREEN, 6: "#b5533c"}
AROUND = {"Road": "#a8a8a8", "PlantCover": "#b9d3a0", "SolitaryVegetationObject": GREEN}
STREET = 32.0  # m around it
WINGS = ("L", "T", "U", "courtyard")
TOWN = ("--style", "blocks", "--size", "110", "--lidar", "8", "--trees", "0.8", "--relief", "8", "--seed", "3")


def read_around(path: Path, middle: np.ndarray) -> dict[str, pv.PolyData]:
    """Roads, green and trees of a town."""
    found: dict[str, list[pv.PolyData]] = {kind: [] for kind in AROUND}
    for feature in map(json.loads, path.read_text().splitlines()[1:]):
        (thing, *_) = feature["CityObjects"].values()
        if thing["type"] in AROUND:
            faces = [[len(ring), *ring] for (ring,) in thing["geometry"][0]["boundaries"]]
            places = 0.001 * np.array(feature["vertices"]) + middle
            found[thing["type"]].append(pv.PolyData(places, np.concatenate(faces)))
    return {kind: pv.merge(parts) for kind, parts in found.items() if parts}


def look(plotter: pv.Plotter, title: str, way: tuple[float, float, float]) -> None:
    """Look at a panel along a way."""
    plotter.add_text(title, font_size=10, color="black")
    plotter.view_vector(way, (0, 0, 1))
    plotter.camera.zoom(1.05)


def draw_houses(plotter: pv.Plotter) -> None:
    """Draw three panels of houses, and one of a town of them."""
    house = find_house()
    plotter.subplot(0, 0)
    for number, shape in enumerate(ROOF_SHAPES):
        bare = replace(house, dormers=(), chimneys=(), roof_windows=())
        rise = 0.0 if shape == "flat" else house.roof.rise
        one = replace(bare, roof=replace(house.roof, shape=shape, rise=rise))
        show_house(plotter, one, "3.2", np.array([22.0 * (number % 3), -26.0 * (number // 3), 0.0]))
    look(plotter, "five roofs", (-0.5, -1, 0.7))
    plotter.subplot(0, 1)
    for number, footprint in enumerate(WINGS):
        rules = make_rules(RULES | {"footprint": footprint, "wing": 7, "roof_pitch": 38}, preset="wings")
        lot = Lot(number, 0, 44.0 * (number % 2), -44.0 * (number // 2), 44.0, 0.0)
        show_house(plotter, draw_house(rules, lot, lambda x, y: 0.0, seed=2), "3.2", np.zeros(3))
    look(plotter, "L, T, U and courtyard", (-0.5, -1, 0.9))
    plotter.subplot(0, 2)
    for number, level in enumerate(INTERIORS):
        shift = np.array([20.0 * (number % 2), -20.0 * (number // 2), 0.0])
        for room in make_interior(house, level):
            show(plotter, room.volume.surfaces, shift)
        walls = [one for volume in make_level(house, "2.0") for one in volume.surfaces]
        show(plotter, walls, shift, 0.15)
    look(plotter, "interiors 0, 1, 2.2, 2.3", (0.6, -1, 0.6))
    plotter.subplot(1, 3)
    other = open_town(130.0, "wings", rules=None, seed=3, relief=8.0)
    for one in other.houses(other.bounds):
        for volume in make_level(one, "2.2"):
            show(plotter, volume.surfaces, -np.array([*other.bounds[:2], 0.0]))
    look(plotter, "a town of wings", (-0.5, -1, 0.9))


def draw_town(plotter: pv.Plotter) -> None:
    """Draw four panels of a town: a street, its points, its city model and its mesh."""
    with TemporaryDirectory() as name:
        town, out = Path(name) / "town", Path(name) / "out"
        citystitch(["synth", str(town), *TOWN])
        inputs = [str(town / "tiles"), "--buildings", str(town / "town.city.jsonl")]
        citystitch(["run", *inputs, "--out", str(out), "--workers", "0", "--mesh-size", "6", "-q"])
        houses = list(read_json(town / "parameters.jsonl"))
        las = laspy.read(next((town / "tiles").glob("*.laz")))
        mesh = pv.merge([pv.read(piece) for piece in sorted((out / "boundary").glob("*.vtp"))])
        middle = np.array([-np.mean([h.x for h in houses]), -np.mean([h.y for h in houses]), 0.0])
        around = read_around(town / "town.city.jsonl", middle)
    plotter.subplot(0, 3)
    roads = around["Road"].cell_centers().points[:, :2]
    crossing = roads[np.argmin(np.hypot(*roads.T))]
    for one in houses:
        if np.hypot(one.x + middle[0] - crossing[0], one.y + middle[1] - crossing[1]) < STREET:
            show_house(plotter, one, "3.2", middle)
    for kind, faces in around.items():
        near = np.hypot(*(faces.cell_centers().points[:, :2] - crossing).T) < STREET
        plotter.add_mesh(faces.extract_cells(np.flatnonzero(near)), color=AROUND[kind], ambient=0.6, diffuse=0.4)
    look(plotter, "a street", (-0.3, -1, 0.8))
    plotter.subplot(1, 0)
    xyz = np.column_stack((las.x, las.y, las.z)) + middle
    for number, colour in CLASSES.items():
        some = xyz[np.asarray(las.classification) == number]
        plotter.add_points(some, color=colour, point_size=1.5, lighting=False)
    look(plotter, "the town scanned", (-0.5, -1, 0.9))
    plotter.subplot(1, 1)
    for one in houses:
        for volume in make_level(one, "2.2"):
            show(plotter, volume.surfaces, middle)
    for kind, faces in around.items():
        plotter.add_mesh(faces, color=AROUND[kind], ambient=0.6, diffuse=0.4)
    look(plotter, "its city model", (-0.5, -1, 0.9))
    plotter.subplot(1, 2)
    low = mesh.extract_cells(np.flatnonzero(np.isin(mesh["marker"], (1, 2, 3)))).translate(middle)
    colours = ["#b08d57", "#e8dcc8", "#b5533c"]
    edges = {"show_edges": True, "edge_color": "#444444", "line_width": 0.5, "ambient": 0.45, "diffuse": 0.6}
    plotter.add_mesh(low, scalars="marker", cmap=colours, show_scalar_bar=False, **edges)
    look(plotter, "its mesh", (-0.5, -1, 0.9))


def draw(path: Path) -> None:
    """Draw eight panels."""
    plotter = pv.Plotter(off_screen=True, window_size=(2000, 860), shape=(2, 4))
    plotter.set_background("white")
    draw_houses(plotter)
    draw_town(plotter)
    save(plotter, path, 255)


if __name__ == "__main__":
    draw(Path(sys.argv[1]))
