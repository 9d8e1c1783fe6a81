"""`python -m tests.benchmarks.lod_zones FOLDER [--size M] [--mesh M] [--radius M]`: a focus against full detail.

A city is meshed three times: in full detail, in full detail with other tiles, and with a focus in its middle. Two
problems are solved on each with linear elements: heat that is made evenly and leaves through ground, walls and
roofs (Poisson), and potential flow from west to east. By radius around the focus it prints how far the second and
the third mesh are from the first (relative L2 norms of temperature and velocity below 30 m), so that the
former is what another mesh of the same detail differs by; and cells, quality in the focus, and its city model.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyamg
import pyvista
import skfem
from numpy.typing import NDArray
from scipy.sparse.linalg import cg
from skfem.helpers import dot, grad

from pipeline.data.mesh import TetMesh
from pipeline.quality.quality import measure_cells
from tests.helpers.synthetic import city_files
from tiler.config.config import make_config
from tiler.config.zones import LOD, LOD_POINT
from tiler.export.export import export_run
from tiler.store.out_folder import CITY_MODEL
from tiler.workflow.run import run

Array = NDArray[np.float64]
LOW = 30.0  # m above the lowest ground; cells above it do not count
SOLID, WEST, EAST = (1, 2, 3), 5, 6  # boundary markers
TOLERANCE = 1e-9
PERCENTILES = (0.1, 1, 5, 50)


@skfem.BilinearForm  # type: ignore[untyped-decorator]
def stiffness(u: Any, v: Any, _: Any) -> Any:
    """Laplace's operator."""
    return dot(grad(u), grad(v))


@skfem.LinearForm  # type: ignore[untyped-decorator]
def load(v: Any, _: Any) -> Any:
    """An even source, or an even flux."""
    return 1.0 * v


class Solved:
    """A mesh with both solutions: temperature at its points and velocity in its cells."""

    def __init__(self, out: Path) -> None:
        export_run(out, out.with_suffix(".xdmf"), name="xdmf", overwrite=True)
        with h5py.File(out.with_suffix(".h5")) as file:
            points, self.cells, facets, marker = (
                file[name][()] for name in ("points", "cells", "facets", "marker")
            )
        self.points = points
        mesh = skfem.MeshTet((points - points.min(axis=0)).T.copy(), self.cells.T.astype(np.int64).copy())
        basis = skfem.Basis(mesh, skfem.ElementTetP1())
        matrix = stiffness.assemble(basis).tocsr()
        solid = np.unique(facets[np.isin(marker, SOLID)])
        self.heat = solve(matrix, load.assemble(basis), solid)
        x = mesh.p[0]
        inflow = mesh.facets_satisfying(lambda p: np.isclose(p[0], x.min(), atol=1e-3), boundaries_only=True)
        west = load.assemble(skfem.FacetBasis(mesh, skfem.ElementTetP1(), facets=inflow))
        potential = solve(matrix, -west, np.unique(facets[marker == EAST]))
        corner = points[self.cells]
        edges = corner[:, 1:] - corner[:, :1]
        self.volume = np.linalg.det(edges) / 6
        rise = potential[self.cells[:, 1:]] - potential[self.cells[:, :1]]
        self.speed = np.linalg.solve(edges, rise[..., None])[..., 0]
        self.centre = corner.mean(axis=1)

    def probe(self, places: Array, box: tuple[Array, Array]) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Temperature and velocity at places, and whether they lie in the mesh."""
        near = ((self.centre > box[0]) & (self.centre < box[1])).all(axis=1)
        grid = pyvista.UnstructuredGrid({pyvista.CellType.TETRA: self.cells[near]}, self.points - box[0])
        grid["heat"] = self.heat
        grid.cell_data["speed"] = self.speed[near]
        found = pyvista.PolyData(places - box[0]).sample(grid)
        return np.asarray(found["heat"]), np.asarray(found["speed"]), np.asarray(found["vtkValidPointMask"]) > 0


def solve(matrix: Any, right: Array, fixed: NDArray[np.int64]) -> Array:
    """Solve with zeros at some nodes, and believe it by the residual alone."""
    free = np.setdiff1d(np.arange(len(right)), fixed)
    inner, given = matrix[free][:, free].tocsr(), right[free]
    before = pyamg.ruge_stuben_solver(inner).aspreconditioner()
    found, _ = cg(inner, given, rtol=TOLERANCE, maxiter=500, M=before)
    residual = float(np.linalg.norm(given - inner @ found) / np.linalg.norm(given))
    if not residual < 10 * TOLERANCE:
        raise SystemExit(f"residual {residual:.1e} > {10 * TOLERANCE:.0e} after 500 iterations")
    result = np.zeros(len(right))
    result[free] = found
    return result


def relative(one: Array, other: Array, weight: Array) -> float:
    """Relative L2 norm of a difference (%)."""
    one, other = one.reshape(len(one), -1), other.reshape(len(other), -1)
    return float(100 * np.sqrt((weight @ (one - other) ** 2).sum() / (weight @ one**2).sum()))


def focus_model(out: Path, told: dict[str, Any]) -> list[str]:
    """Attributes of the buildings whose level is the full one in `told`, as text."""
    objects = json.loads((out / CITY_MODEL).read_text())["CityObjects"]
    names = [name for name, row in told.items() if row.get(LOD) == "2.2"]
    rows = [objects[name]["attributes"] for name in names]
    kept = [{key: value for key, value in row.items() if key not in (LOD, LOD_POINT)} for row in rows]
    return [json.dumps(row, sort_keys=True) for row in kept]


def main() -> None:
    """Mesh, solve, print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--size", type=float, default=640.0, help="side of the city (m)")
    parser.add_argument("--mesh", type=float, default=5.0, help="size of cells in full detail (m)")
    parser.add_argument("--radius", type=float, default=80.0, help="of the focus (m)")
    given = parser.parse_args()
    n = round(480 * given.size**2 / 1e6)
    whole = city_files(given.folder / "city", size=given.size, buildings=n, density=2.0, roofs="mixed", seed=3)
    whole |= {"tile_size": given.size / 2, "overwrite": True}
    west, south, east, north = 318000.0, 6399000.0, 318000.0 + given.size, 6399000.0 + given.size
    middle = ((west + east) / 2, (south + north) / 2)
    focus = f"{middle[0]:g},{middle[1]:g},{given.radius:g},{given.mesh:g}"
    options = {
        "full": {"mesh_size": given.mesh},
        "other tiles": {"mesh_size": given.mesh, "tile_size": given.size / 3},
        "focus": {"mesh_size": 4 * given.mesh, "focus": focus},
    }
    solved, cells = {}, {}
    for name, more in options.items():
        out = given.folder / name.replace(" ", "-")
        record = run(make_config(whole | more | {"out": str(out)}))
        cells[name], solved[name] = record["counts"]["cells"], Solved(out)
    objects = json.loads((given.folder / "focus" / CITY_MODEL).read_text())["CityObjects"]
    told = {name: row["attributes"] for name, row in objects.items() if "attributes" in row}
    same = focus_model(given.folder / "full", told) == focus_model(given.folder / "focus", told)
    full = solved["full"]
    distance = np.hypot(*(full.centre[:, :2] - middle).T)
    low = full.centre[:, 2] < full.points[:, 2].min() + LOW
    print(f"buildings of the focus are {'the same' if same else 'NOT the same'} as in full detail\n")
    print("| mesh | cells | " + " | ".join(f"{p:g} %" for p in PERCENTILES) + " |\n|---|---|" + "---|" * 4)
    for name, one in solved.items():
        inside = np.hypot(*(one.centre[:, :2] - middle).T) < given.radius
        ratio = np.percentile(measure_cells(TetMesh(one.points, one.cells[inside])).radius_ratio, PERCENTILES)
        print(f"| {name} | {cells[name]:,} | " + " | ".join(f"{value:.3f}" for value in ratio) + " |")
    print(
        "\n| within | Poisson: other tiles | focus | potential flow: other tiles | focus |\n|---|---|---|---|---|"
    )
    for radius in (given.radius / 4, given.radius / 2, given.radius, 2 * given.radius, 3 * given.radius):
        rows = np.flatnonzero((distance < radius) & low)
        places, margin = full.centre[rows], 40 * given.mesh
        box = places.min(axis=0) - margin, places.max(axis=0) + margin
        heat = full.heat[full.cells[rows]].mean(axis=1)
        shown = []
        for name in ("other tiles", "focus"):
            other_heat, other_speed, there = solved[name].probe(places, box)
            weight = full.volume[rows][there]
            shown.append(
                (
                    relative(heat[there], other_heat[there], weight),
                    relative(full.speed[rows][there], other_speed[there], weight),
                )
            )
        values = [shown[0][0], shown[1][0], shown[0][1], shown[1][1]]
        print(f"| {radius:g} m | " + " | ".join(f"{value:.2f} %" for value in values) + " |", flush=True)


if __name__ == "__main__":
    main()
