"""The picture of docs/facade-rules.md: `python -m tests.benchmarks.facade_views MODEL FILE.png X,Y,Z RULES`.

Buildings around a viewpoint, the red ball: full near it, flat far from it, and edges of all polygons' triangles.
"""

import sys
from pathlib import Path

import numpy as np
import pyvista as pv

from tiler.cityinput.faces import GROUND, ROOF, UNKNOWN
from tiler.convert.glb_files import DETAILS
from tiler.convert.inputs import open_source
from tiler.convert.triangles import iter_triangles
from tiler.detail.detail import DetailAsked, make_criteria
from tiler.detail.detailed_source import detail_source
from tiler.detail.rule_files import load_graph

NEAR = 130.0  # m, of the buildings that are drawn
DISTANCE = "30,80"
COLOURS = {ROOF: "#a8543f", GROUND: "#73806a", UNKNOWN: "#d1c7b3"} | {k: c for k, (_, c) in DETAILS.items()}


def draw(model: Path, picture: Path, viewpoint: str, rules: str) -> None:
    """Draw the buildings near a viewpoint."""
    criteria = tuple(make_criteria(DetailAsked(viewpoint=viewpoint, distance=DISTANCE)).values())
    eye = np.array([float(word) for word in viewpoint.split(",")])
    plotter = pv.Plotter(off_screen=True, window_size=(1600, 900))
    with open_source([model]) as plain:
        for one in iter_triangles(detail_source(plain, load_graph(rules), criteria), "auto"):
            xyz = one.xyz - eye
            if np.hypot(*xyz.mean(axis=0)[:2]) > NEAR:
                continue
            for kind in np.unique(one.kind).tolist():
                part = pv.PolyData.from_regular_faces(xyz, one.triangles[one.kind == kind])
                colour = COLOURS.get(kind, COLOURS[UNKNOWN])
                plotter.add_mesh(part, color=colour, show_edges=True, edge_color="#555555", line_width=1)
    plotter.add_mesh(pv.Sphere(radius=2.0), color="red")
    plotter.camera.position = (-60.0, -75.0, 45.0)
    plotter.camera.focal_point = (10.0, 15.0, -10.0)
    plotter.camera.up = (0.0, 0.0, 1.0)
    plotter.background_color = "white"
    plotter.screenshot(picture)


if __name__ == "__main__":
    draw(Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3], sys.argv[4])
