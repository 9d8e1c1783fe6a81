"""Steps 3.2 to 3.5 with the same number of layers everywhere: the paper's mesher on columns."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.city_model.groups import adjacent_houses
from pipeline.columns.columns import expand_cells
from pipeline.columns.fixed_levels import GivenLevels, find_given_levels, stand_on_floors, take_used_levels
from pipeline.columns.growth import Growth, full_height, layer_levels
from pipeline.columns.neighbours import check_groups, join_equal_roofs, part_neighbours
from pipeline.columns.nodes import Levels, SeamColumns, no_seam
from pipeline.columns.trim_layers import check_headroom, count_removed_layers, first_kept, first_levels
from pipeline.data.citymodel import Prisms
from pipeline.data.mesh import ColumnMesh, PlaneMesh
from pipeline.points_terrain.terrain import Dtm, sample_dtm
from pipeline.smoothing.column_smoothing import guess_displacement, relax_columns
from pipeline.smoothing.fem import solve_laplace
from pipeline.smoothing.ground_smoothing import (
    Bounds,
    SlabShape,
    lift_places,
    shape_levels,
    slab_reach,
    slab_window,
    smooth_slab,
)
from pipeline.smoothing.repair import repair_columns

MIN_GAP = 0.1  # of a layer's height: what the repair leaves between two levels of a column
GRID_FACTOR = 1.0  # grid of the fast step 3.3, in mesh sizes
CHOICE_GRID = 0.1  # of the domain's height; grid on which layers are chosen, unless the mesh is coarser

Smoother = Literal["columns", "fem"]


@dataclass(frozen=True)
class LayeredOptions:
    """Parameters of the layered mesher."""

    mesh_size: float  #: mesh size of the plane mesh (m)
    layer_height: float  #: height of a layer (m); the domain is cut into the closest whole number of layers
    domain_height: float  #: height of the domain above the terrain (m)
    smoother: Smoother  #: the fast path, or linear finite elements with multigrid
    tolerance: float  #: residual over the diagonal (m) at which the fast path's step 3.5 stops
    fem_tolerance: float  #: relative residual at which the finite elements stop
    #: how layers grow from the ground up to `layer_height`; None: all have the same height
    growth: Growth | None = None
    #: absolute height of the domain's top (m) if it is flat; None: it follows the smoothed terrain
    top: float | None = None
    solids: bool = False  #: whether columns go on below roofs, down to the terrain, for cells of buildings


@dataclass(frozen=True)
class LayeredReport:
    """What the layered mesher did."""

    n_layers: int  #: layers of the slab
    #: groups of equal roofs whose layer is not the closest, because of the roofs that they touch
    parted_groups: int
    #: levels that the repair moved after step 3.3 and after step 3.5
    repaired_terrain: int
    repaired_roofs: int
    iterations: int  #: iterations of step 3.5's solver (with finite elements: of both steps)
    residual: float  #: its residual: over the diagonal (m), or relative with finite elements


def count_layers(options: LayeredOptions) -> int:
    """Number of layers: the closest whole number, at least two."""
    if options.growth is not None:
        return len(layer_levels(options.domain_height, options.layer_height, options.growth)) - 1
    return max(round(options.domain_height / options.layer_height), 2)


def slab_shape(options: LayeredOptions) -> SlabShape | None:
    """Shape of the slab's layers; None for equal ones below a top that follows the terrain."""
    if options.growth is None and options.top is None:
        return None
    if options.growth is None:
        n_layers = count_layers(options)
        return SlabShape(options.domain_height * np.arange(n_layers + 1) / n_layers, 0.0, options.top)
    levels = layer_levels(options.domain_height, options.layer_height, options.growth)
    calm = min(float(full_height(options.layer_height, options.growth)), options.domain_height)
    return SlabShape(levels, calm, options.top)


def terrain_reach(options: LayeredOptions) -> float:
    """How far beyond a mesh, a seam's triangles or a building's walls terrain counts (m), within the region."""
    return slab_reach(options.domain_height, grid_spacing=GRID_FACTOR * options.mesh_size)


def choose_layers(
    polygons: NDArray[np.object_],
    roof: NDArray[np.float64],
    wall_ground: NDArray[np.float64],
    group: NDArray[np.int32],
    pairs: NDArray[np.int64],
    dtm: Dtm,
    bounds: Bounds,
    options: LayeredOptions,
) -> tuple[NDArray[np.int32], int]:
    """Choose the layer that becomes the roof of each building (step 3.4), before there is a mesh.

    Parameters
    ----------
    polygons : object, (b,)
        Footprints; those that touch share vertices.
    roof : float64, (b,)
        Absolute roof heights (m).
    wall_ground : float64, (b,)
        Highest terrain at the walls of each building (m).
    group : int32, (b,)
        Buildings of one group have the same roof height.
    pairs : int64, (p, 2)
        Buildings that touch, as from `adjacent_houses`.
    dtm : Dtm
        Terrain, as far beyond the walls as `terrain_reach` says; it may be NaN at nodes of tiles that are absent.
    bounds : (xmin, ymin, xmax, ymax)
        The region (m).

    Returns
    -------
    int32, (b,)
        Number of layers removed in each building.
    int
        Groups of equal roofs whose layer is not the closest, because of the roofs that they touch.

    Raises
    ------
    GeometryError
        If more roofs rise above each other than there are layers.
    ValueError
        If a group has two heights.

    Notes
    -----
    What a building gets depends on the buildings of its cluster, which touch each other, and on the terrain in
    reach alone: every tile that has a part of it may choose for the cluster, or one for all. Levels are looked
    up along the walls, a mesh size apart at most, on a grid that is no finer than a choice among them needs.
    """
    check_groups(roof, group)
    if len(roof) == 0:
        return np.empty(0, np.int32), 0
    n_layers, shape = count_layers(options), slab_shape(options)
    xy, building = shapely.get_coordinates(shapely.segmentize(polygons, options.mesh_size), return_index=True)
    places = np.unique(np.column_stack((building, xy)), axis=0)  # a ring's first vertex is its last as well
    levels = lift_places(
        dtm,
        places[:, 1:],
        bounds,
        domain_height=options.domain_height,
        n_layers=n_layers,
        grid_spacing=max(GRID_FACTOR * options.mesh_size, CHOICE_GRID * options.domain_height),
        shape=shape,
    )
    group = join_equal_roofs(pairs, roof, group)
    removed = count_removed_layers(
        levels,
        places[:, 0].astype(np.int64),
        roof,
        wall_ground,
        group,
        layer_height=options.domain_height / n_layers,
        flat_levels=None if options.growth is None or shape is None else shape.levels,
    )
    return part_neighbours(pairs, roof, group, removed, polygons, n_layers=n_layers)


def layer_mesh(
    plane: PlaneMesh,
    z: NDArray[np.float64],
    first: NDArray[np.int32],
    kept: NDArray[np.int32] | None = None,
) -> ColumnMesh:
    """Make columns of the used levels (steps 3.2 and 3.4).

    Parameters
    ----------
    z : float64, (n, l)
        Heights of all levels (m).
    first : int32, (m,)
        First level of the cells over each triangle.
    kept : int32, (n,), optional
        First level of each column; by default the first that one of these triangles uses.
    """
    levels = z.shape[1]
    kept = first_kept(plane, first) if kept is None else kept
    used = np.arange(levels) >= kept[:, None]
    z_start = np.concatenate(([0], np.cumsum(levels - kept))).astype(np.int64)
    bottom = first[:, None] - kept[plane.triangles]
    return ColumnMesh(plane, z_start, z[used], bottom.astype(np.int32))


def mesh_layers(
    plane: PlaneMesh,
    dtm: Dtm,
    city: Prisms,
    wall_ground: NDArray[np.float64],
    bounds: Bounds,
    options: LayeredOptions,
    *,
    group: NDArray[np.int32] | None = None,
    removed: NDArray[np.int32] | None = None,
    seam: SeamColumns | None = None,
) -> tuple[ColumnMesh, LayeredReport]:
    """Fill the columns with layers that follow the terrain and meet every roof (steps 3.2 to 3.5).

    Parameters
    ----------
    dtm : Dtm
        Terrain, as far beyond the plane mesh as `terrain_reach` says.
    city : Prisms
        Buildings, row by row those of `PlaneMesh.building`.
    wall_ground : float64, (b,)
        Highest terrain at the walls of each building (m); of no use if `removed` is given.
    bounds : (xmin, ymin, xmax, ymax)
        The region (m).
    group : int32, (b,), optional
        Buildings of one group have the same roof height; by default each is a group of its own. Of no use if
        `removed` is given.
    removed : int32, (b,), optional
        Layers removed in each building, as from `choose_layers`, which is asked by default.
    seam : SeamColumns, optional
        Columns that are given by a seam: they stay bit for bit.

    Raises
    ------
    GeometryError
        If a building reaches the top of the domain, or more roofs rise above each other than there are layers.
    SolverError
        If a linear solve does not converge.
    ValueError
        If a group has two heights, two roofs that meet share a layer, the seam lacks a level that the mesh has
        there, or finite elements are asked for beside a seam.
    """
    parted = 0
    if removed is None:
        group = np.arange(len(city), dtype=np.int32) if group is None else group
        pairs = adjacent_houses(city.polygons)
        removed, parted = choose_layers(city.polygons, city.roof, wall_ground, group, pairs, dtm, bounds, options)
    seam = no_seam() if seam is None else seam
    z, given, report = _settle(plane, dtm, city.roof, city.ids, removed, bounds, options, seam)
    mesh = layer_mesh(plane, z, first_levels(plane, removed), given.kept)
    return mesh, replace(report, parted_groups=parted)


def fill_layers(
    plane: PlaneMesh,
    dtm: Dtm,
    roof: NDArray[np.float64],
    ids: NDArray[np.str_],
    removed: NDArray[np.int32],
    bounds: Bounds,
    options: LayeredOptions,
    *,
    seam: SeamColumns | None = None,
) -> Levels:
    """Fill the columns of a plane mesh, as a seam's are from the mesh of its strip.

    Parameters and errors as in `mesh_layers`; the sides of the mesh are free, wherever they are.
    """
    seam = no_seam() if seam is None else seam
    z, given, _ = _settle(plane, dtm, roof, ids, removed, bounds, options, seam)
    return take_used_levels(plane, first_levels(plane, removed), given, z)


def _settle(
    plane: PlaneMesh,
    dtm: Dtm,
    roof: NDArray[np.float64],
    ids: NDArray[np.str_],
    removed: NDArray[np.int32],
    bounds: Bounds,
    options: LayeredOptions,
    seam: SeamColumns,
) -> tuple[NDArray[np.float64], GivenLevels, LayeredReport]:
    """Steps 3.3 to 3.5: heights of all levels."""
    n_layers = count_layers(options)
    lowest = highest = options.domain_height / n_layers
    shape = slab_shape(options)
    if shape is not None:
        lowest, highest = (float(step) for step in np.diff(shape.levels)[[0, -1]])
    min_gap = MIN_GAP * lowest
    if options.smoother == "fem" and len(seam.vertex):
        raise ValueError("finite elements on one tile know nothing of its seams; take smoother columns")
    z, iterations = _follow_terrain(plane, dtm, bounds, n_layers, options)
    ground_only = np.zeros(z.shape, np.bool_)
    ground_only[:, 0] = True
    z, moved_terrain = repair_columns(z, np.zeros(len(z), np.int32), ground_only, min_gap=min_gap)
    check_headroom(z[:, -1], plane, roof, ids, domain_height=options.domain_height, air=highest / 2)
    first = first_levels(plane, removed)
    given = find_given_levels(plane, first, z[:, 0], roof, seam, n_layers=n_layers, top=options.top)
    fixed = given.stays | (np.arange(n_layers + 1) < given.kept[:, None])
    displacement = np.where(given.stays, given.z - z, 0.0)
    if options.smoother == "fem":
        u, steps, residual = _solve_fem(plane, z, first, fixed, displacement, options)
        iterations += steps
    else:
        guess = guess_displacement(fixed, displacement)
        u, iterations, residual = relax_columns(plane, first, z, fixed, guess, tolerance=options.tolerance)
    z = np.where(given.stays, given.z, z + u)
    z, moved_roofs = repair_columns(z, given.kept, given.stays, min_gap=min_gap)
    if options.solids:
        heights = np.arange(n_layers + 1.0) if shape is None else shape.levels
        given, z = stand_on_floors(given, z, heights, min_gap=min_gap)
    return z, given, LayeredReport(n_layers, 0, moved_terrain, moved_roofs, iterations, residual)


def _follow_terrain(
    plane: PlaneMesh,
    dtm: Dtm,
    bounds: Bounds,
    n_layers: int,
    options: LayeredOptions,
) -> tuple[NDArray[np.float64], int]:
    """Step 3.3: heights of all levels, and the iterations that it took."""
    shape = slab_shape(options)
    if options.smoother == "columns":
        height, spacing = options.domain_height, GRID_FACTOR * options.mesh_size
        window = slab_window(plane.xy, bounds, domain_height=height, grid_spacing=spacing)
        z = smooth_slab(
            dtm,
            plane.xy,
            window,
            domain_height=height,
            n_layers=n_layers,
            grid_spacing=spacing,
            shape=shape,
        )
        return z, 0
    levels = np.linspace(0, options.domain_height, n_layers + 1) if shape is None else shape.levels
    flat = np.tile(levels, (len(plane.xy), 1))
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
    z = flat + u.reshape(flat.shape)
    return z if shape is None else shape_levels(z, shape), iterations


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
