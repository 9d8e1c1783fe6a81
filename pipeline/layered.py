"""Steps 3.2 to 3.5 with the same number of layers everywhere: the paper's mesher on columns."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pipeline.citymodel import CityModel
from pipeline.columns import expand_cells
from pipeline.fem import solve_laplace
from pipeline.mesh import ColumnMesh, PlaneMesh
from pipeline.neighbours import check_groups, join_equal_roofs, part_neighbours
from pipeline.relax import guess_displacement, relax_columns
from pipeline.repair import repair_columns
from pipeline.slab import smooth_slab
from pipeline.terrain import Dtm, sample_dtm
from pipeline.trim import check_headroom, count_removed_layers, first_kept, first_levels

MIN_GAP = 0.1  # of a layer's height: what the repair leaves between two levels of a column
GRID_FACTOR = 1.0  # grid of the fast step 3.3, in mesh sizes

Smoother = Literal["columns", "fem"]


@dataclass(frozen=True)
class LayeredOptions:
    """Parameters of the layered mesher.

    Attributes
    ----------
    mesh_size : float
        Mesh size of the plane mesh (m).
    layer_height : float
        Height of a layer (m); the domain is cut into the closest whole number of layers.
    domain_height : float
        Height of the domain above the terrain (m).
    smoother : "columns" or "fem"
        The fast path, or linear finite elements with multigrid.
    tolerance : float
        Residual over the diagonal (m) at which the fast path's step 3.5 stops.
    fem_tolerance : float
        Relative residual at which the finite elements stop.
    """

    mesh_size: float
    layer_height: float
    domain_height: float
    smoother: Smoother
    tolerance: float
    fem_tolerance: float


@dataclass(frozen=True)
class LayeredReport:
    """What the layered mesher did.

    Attributes
    ----------
    n_layers : int
        Layers of the slab.
    parted_groups : int
        Groups of equal roofs whose layer is not the closest, because of the roofs that they touch.
    repaired_terrain, repaired_roofs : int
        Levels that the repair moved after step 3.3 and after step 3.5.
    iterations : int
        Iterations of step 3.5's solver (with finite elements: of both steps).
    residual : float
        Its residual: over the diagonal (m), or relative with finite elements.
    """

    n_layers: int
    parted_groups: int
    repaired_terrain: int
    repaired_roofs: int
    iterations: int
    residual: float


def count_layers(options: LayeredOptions) -> int:
    """Number of layers: the closest whole number, at least two."""
    return max(round(options.domain_height / options.layer_height), 2)


def layer_mesh(plane: PlaneMesh, z: NDArray[np.float64], first: NDArray[np.int32]) -> ColumnMesh:
    """Make columns of the used levels (steps 3.2 and 3.4).

    Parameters
    ----------
    plane : PlaneMesh
        Plane mesh.
    z : float64, (n, l)
        Heights of all levels (m).
    first : int32, (m,)
        First level of the cells over each triangle.
    """
    levels = z.shape[1]
    kept = first_kept(plane, first)
    used = np.arange(levels) >= kept[:, None]
    z_start = np.concatenate(([0], np.cumsum(levels - kept))).astype(np.int64)
    bottom = first[:, None] - kept[plane.triangles]
    return ColumnMesh(plane, z_start, z[used], bottom.astype(np.int32))


def mesh_layers(
    plane: PlaneMesh,
    dtm: Dtm,
    city: CityModel,
    wall_ground: NDArray[np.float64],
    bounds: tuple[float, float, float, float],
    options: LayeredOptions,
    *,
    group: NDArray[np.int32] | None = None,
) -> tuple[ColumnMesh, LayeredReport]:
    """Fill the columns with layers that follow the terrain and meet every roof (steps 3.2 to 3.5).

    Parameters
    ----------
    plane : PlaneMesh
        Plane mesh.
    dtm : Dtm
        Terrain.
    city : CityModel
        Buildings, row by row those of `PlaneMesh.building`.
    wall_ground : float64, (b,)
        Highest terrain at the walls of each building (m).
    bounds : (xmin, ymin, xmax, ymax)
        The region (m).
    options : LayeredOptions
        Parameters.
    group : int32, (b,), optional
        Buildings of one group have the same roof height; by default each is a group of its own.

    Raises
    ------
    GeometryError
        If a building reaches the top of the domain, or more roofs rise above each other than there are layers.
    SolverError
        If a linear solve does not converge.
    ValueError
        If a group has two heights.
    """
    group = np.arange(len(city), dtype=np.int32) if group is None else group
    check_groups(city.roof, group)
    n_layers = count_layers(options)
    layer_height = options.domain_height / n_layers
    min_gap = MIN_GAP * layer_height
    z, iterations = _follow_terrain(plane, dtm, bounds, n_layers, options)
    ground_only = np.zeros(z.shape, np.bool_)
    ground_only[:, 0] = True
    z, moved_terrain = repair_columns(z, np.zeros(len(z), np.int32), ground_only, min_gap=min_gap)
    check_headroom(z[:, -1], plane, city.roof, city.ids, domain_height=options.domain_height, air=layer_height / 2)
    group = join_equal_roofs(plane, city.roof, group)
    removed = count_removed_layers(z, plane, city.roof, wall_ground, group, layer_height=layer_height)
    removed, parted = part_neighbours(plane, city.roof, group, removed, n_layers=n_layers)
    first = first_levels(plane, removed)
    kept = first_kept(plane, first)
    given, target = _given_heights(plane, first, kept, z, city.roof)
    fixed = given | (np.arange(n_layers + 1) < kept[:, None])
    displacement = np.where(given, target - z, 0.0)
    if options.smoother == "fem":
        u, steps, residual = _solve_fem(plane, z, first, fixed, displacement, options)
        iterations += steps
    else:
        guess = guess_displacement(fixed, displacement)
        u, iterations, residual = relax_columns(plane, first, z, fixed, guess, tolerance=options.tolerance)
    z = np.where(given, target, z + u)
    z, moved_roofs = repair_columns(z, kept, given, min_gap=min_gap)
    report = LayeredReport(n_layers, parted, moved_terrain, moved_roofs, iterations, residual)
    return layer_mesh(plane, z, first), report


def _follow_terrain(
    plane: PlaneMesh,
    dtm: Dtm,
    bounds: tuple[float, float, float, float],
    n_layers: int,
    options: LayeredOptions,
) -> tuple[NDArray[np.float64], int]:
    """Step 3.3: heights of all levels, and the iterations that it took."""
    if options.smoother == "columns":
        z = smooth_slab(
            dtm,
            plane.xy,
            bounds,
            domain_height=options.domain_height,
            n_layers=n_layers,
            grid_spacing=GRID_FACTOR * options.mesh_size,
        )
        return z, 0
    flat = np.tile(np.linspace(0, options.domain_height, n_layers + 1), (len(plane.xy), 1))
    first = np.zeros(len(plane.triangles), np.int32)
    fixed = np.zeros(flat.shape, np.bool_)
    fixed[:, 0] = True
    values = np.tile(sample_dtm(dtm, plane.xy)[:, None], n_layers + 1)
    u, iterations, _ = solve_laplace(
        expand_cells(layer_mesh(plane, flat, first)),
        fixed.ravel(),
        values.ravel(),
        relative_tolerance=options.fem_tolerance,
        step="3.3",
    )
    return flat + u.reshape(flat.shape), iterations


def _given_heights(
    plane: PlaneMesh,
    first: NDArray[np.int32],
    kept: NDArray[np.int32],
    z: NDArray[np.float64],
    roof: NDArray[np.float64],
) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Levels that step 3.5 keeps, with their heights: the ground under air, and every roof."""
    given = np.zeros(z.shape, np.bool_)
    given[kept == 0, 0] = True
    target = z.copy()
    inside = plane.building >= 0
    vertex = plane.triangles[inside].ravel()
    level = np.repeat(first[inside], 3)
    given[vertex, level] = True
    target[vertex, level] = np.repeat(roof[plane.building[inside]], 3)
    return given, target


def _solve_fem(
    plane: PlaneMesh,
    z: NDArray[np.float64],
    first: NDArray[np.int32],
    fixed: NDArray[np.bool_],
    displacement: NDArray[np.float64],
    options: LayeredOptions,
) -> tuple[NDArray[np.float64], int, float]:
    """Step 3.5 with finite elements."""
    used = np.arange(z.shape[1]) >= first_kept(plane, first)[:, None]
    solution, iterations, residual = solve_laplace(
        expand_cells(layer_mesh(plane, z, first)),
        fixed[used],
        displacement[used],
        relative_tolerance=options.fem_tolerance,
        step="3.5",
    )
    u = displacement.copy()
    u[used] = solution
    return u, iterations, residual
