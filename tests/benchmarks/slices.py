"""`python -m tests.benchmarks.slices`: vertical slices through meshes for wind; written to docs/meshing.png.

A synthetic city on hills, meshed as by default, and with layers that grow from the ground below a flat top by both
meshers. Prints what each costs, as rows of a table.
"""

import tempfile
import time
from pathlib import Path
from typing import Any

import pyvista as pv
from PIL import Image

from tests.helpers.synthetic import city_files
from tiler.config.config import make_config
from tiler.workflow.run import run

SIZE, TILE, HEIGHT = 300.0, 150.0, 60.0  # m
ROW = 0.3  # of the region's depth: where it is cut
WIND = {"first_layer": 0.5, "layer_growth": 1.2, "top": "flat"}
RUNS: dict[str, dict[str, Any]] = {
    "default": {},
    "--first-layer 0.5 --top flat": WIND,
    "--first-layer 0.5 --top flat --mesher layered --layer-height 8": WIND
    | {"mesher": "layered", "layer_height": 8.0},
}
COLOURS = ("#d7e3ee", "#eee3d3")  # of tiles beside each other
WIDTH, DEPTH = 1200, 344  # pixels a slice
COLOURS_KEPT = 24
PICTURE = Path(__file__).resolve().parents[2] / "docs" / "meshing.png"


def draw_slice(plotter: pv.Plotter, out: Path, bounds: list[float], title: str) -> None:
    """Draw the cells along a line of a run, from the south."""
    west, south, east, north = bounds
    x, y = (west + east) / 2, south + ROW * (north - south)
    parts = []
    for path in sorted((out / "mesh").glob("*.vtu")):
        mesh = pv.read(path)
        if mesh.bounds[2] < y < mesh.bounds[3]:
            parts.append(mesh.slice(normal="y", origin=(x, y, 0)))
    for k, part in enumerate(parts):
        plotter.add_mesh(part, color=COLOURS[k % 2], show_edges=True, line_width=1, lighting=False)
    low = min(part.bounds[4] for part in parts)
    plotter.add_text(title, font_size=10, color="black", position="upper_left")
    plotter.enable_parallel_projection()
    plotter.camera.parallel_scale = 0.51 * (east - west) * DEPTH / WIDTH
    middle = low + 0.96 * plotter.camera.parallel_scale
    plotter.camera.focal_point, plotter.camera.position = (x, y, middle), (x, y - 1000, middle)
    plotter.camera.up = (0, 0, 1)
    plotter.reset_camera_clipping_range()


def main() -> None:
    """Mesh, measure and draw."""
    shape = (len(RUNS), 1)
    plotter = pv.Plotter(shape=shape, window_size=(WIDTH, len(RUNS) * DEPTH), border=False, off_screen=True)
    with tempfile.TemporaryDirectory() as folder:
        given = city_files(Path(folder) / "city", size=SIZE, buildings=45, density=1.0, relief=20, seed=4)
        given |= {"tile_size": TILE, "domain_height": HEIGHT}
        for k, (title, options) in enumerate(RUNS.items()):
            out = Path(folder) / str(k)
            start = time.perf_counter()
            record = run(make_config(given | {"out": str(out)} | options))
            ratio, cells = record["quality"]["radius_ratio"], record["counts"]["cells"]
            shown = " | ".join(f"{ratio[p]:.2f}" for p in ("0", "1", "5", "50"))
            print(f"| `{title}` | {cells:,} | {shown} | {time.perf_counter() - start:.1f} |")
            plotter.subplot(k, 0)
            draw_slice(plotter, out, record["region"]["bounds"], title)
        picture = plotter.screenshot(return_img=True)
    Image.fromarray(picture).quantize(COLOURS_KEPT).save(PICTURE, optimize=True)


if __name__ == "__main__":
    main()
