"""`python -m tests.benchmarks.lod_zones FOLDER [--size M] [--mesh M] [--radius M]`: a focus against full detail.

A city is meshed three times: in full detail, in full detail with other tiles, and with a focus in its middle. Two
problems are solved on each with linear elements: heat that is made evenly and leaves through ground, walls and
roofs (Poisson), and potential flow from west to east. By radius around the focus it prints how far the second and
the third mesh are from the first (relative L2 norms of temperature and velocity below 30 m), so that the
former is what another mesh of the same detail differs by; and cells, quality in the focus, and its city model. It
ends with 1 where the bounds of docs/lod-zones.md are exceeded.
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
# Of a focus: share of the cells of full detail, and loss of radius ratios in it.
MOST_CELLS, MOST_LOSS = 0.15, 0.03


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


def measure(folder: Path, size: float, mesh: float, radius: float, *, tiles: int = 2) -> dict[str, Any]:
    """Mesh, solve, print the tables; gives the share of cells, the largest loss of quality, and differences."""
    whole = city_files(
        folder / "city", size=size, buildings=round(480 * size**2 / 1e6), density=2.0, roofs="mixed", seed=3
    )
    whole |= {"tile_size": size / tiles, "overwrite": True}
    middle = (318000.0 + size / 2, 6399000.0 + size / 2)
    options: dict[str, dict[str, Any]] = {
        "full": {"mesh_size": mesh},
        "other tiles": {"mesh_size": mesh, "tile_size": size / (tiles + 1)},
        "focus": {"mesh_size": 4 * mesh, "focus": f"{middle[0]:g},{middle[1]:g},{radius:g},{mesh:g}"},
    }
    solved, cells = {}, {}
    for name, more in options.items():
        out = folder / name.replace(" ", "-")
        record = run(make_config(whole | more | {"out": str(out)}))
        cells[name], solved[name] = record["counts"]["cells"], Solved(out)
    objects = json.loads((folder / "focus" / CITY_MODEL).read_text())["CityObjects"]
    told = {name: row["attributes"] for name, row in objects.items() if "attributes" in row}
    same = focus_model(folder / "full", told) == focus_model(folder / "focus", told)
    full = solved["full"]
    distance = np.hypot(*(full.centre[:, :2] - middle).T)
    low = full.centre[:, 2] < full.points[:, 2].min() + LOW
    print(f"buildings of the focus are {'the same' if same else 'NOT the same'} as in full detail\n")
    print("| mesh | cells | " + " | ".join(f"{p:g} %" for p in PERCENTILES) + " |\n|---|---|" + "---|" * 4)
    ratios = {}
    for name, one in solved.items():
        inside = np.hypot(*(one.centre[:, :2] - middle).T) < radius
        found = measure_cells(TetMesh(one.points, one.cells[inside])).radius_ratio
        ratios[name] = np.percentile(found, PERCENTILES)
        print(f"| {name} | {cells[name]:,} | " + " | ".join(f"{value:.3f}" for value in ratios[name]) + " |")
    print(
        "\n| within | Poisson: other tiles | focus | potential flow: other tiles | focus |\n|---|---|---|---|---|"
    )
    by_radius = {}
    for reach in (radius / 4, radius / 2, radius, 2 * radius, 3 * radius):
        rows = np.flatnonzero((distance < reach) & low)
        places, margin = full.centre[rows], 40 * mesh
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
        by_radius[reach / radius] = [shown[0][0], shown[1][0], shown[0][1], shown[1][1]]
        values = " | ".join(f"{value:.2f} %" for value in by_radius[reach / radius])
        print(f"| {reach:g} m | {values} |", flush=True)
    return {
        "same": same,
        "cells": cells["focus"] / cells["full"],
        "quality": float((1 - ratios["focus"] / ratios["full"]).max()),
        "by radius": by_radius,
    }


def find_excess(found: dict[str, Any], *, poisson: float, flow: float) -> list[str]:
    """Tell which bounds are exceeded: those of the focus, and differences within it (%).

    `flow` is the difference of velocities beyond that of another mesh of the same detail.
    """
    _, heat, others, speed = found["by radius"][1]
    bounds = {
        "buildings of the focus that differ": (float(not found["same"]), 0.0),
        "cells over those of full detail": (found["cells"], MOST_CELLS),
        "loss of quality in the focus": (found["quality"], MOST_LOSS),
        "Poisson, difference in the focus (%)": (heat, poisson),
        "potential flow, difference in the focus beyond other tiles (%)": (speed - others, flow),
    }
    return [f"{name}: {value:.3g}; bound: {most:g}" for name, (value, most) in bounds.items() if value > most]


def main() -> None:
    """Measure, and end with 1 where a bound is exceeded."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--size", type=float, default=640.0, help="side of the city (m)")
    parser.add_argument("--mesh", type=float, default=5.0, help="size of cells in full detail (m)")
    parser.add_argument("--radius", type=float, default=80.0, help="of the focus (m)")
    given = parser.parse_args()
    found = measure(given.folder, given.size, given.mesh, given.radius)
    if excess := find_excess(found, poisson=3.0, flow=1.5):
        raise SystemExit("\n".join(excess))


if __name__ == "__main__":
    main()
