"""Steps 3.2 to 3.5 with levels of their own in every column: our mesher, composed.

No equation is solved. Every column is exact at the ground and at each roof that it touches, evenly spaced
between them, about as widely as its plane edges are long; columns are merged by the height of their segments.
What a column holds depends on its neighbourhood in the plane mesh and on the terrain within `top_reach`.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.columns.growth import Growth, movable_height
from pipeline.columns.improve_columns import improve_columns
from pipeline.columns.levels import fill_levels, stagger_columns
from pipeline.columns.neighbours import check_groups
from pipeline.columns.nodes import Levels, Nodes, SeamColumns, no_seam, place_nodes, triangle_surfaces
from pipeline.columns.spacing import SpacingLimits, domain_top, mean_edges, vertical_spacing
from pipeline.columns.trim_layers import check_headroom
from pipeline.data.errors import GeometryError
from pipeline.data.mesh import ColumnMesh, PlaneMesh
from pipeline.plane_mesh.edges import plane_edges
from pipeline.plane_mesh.sizes import SizeField, local_sizes
from pipeline.points_terrain.terrain import Dtm, sample_dtm

HEADROOM = 0.5  # of the largest spacing: least air between a roof and the domain's top


@dataclass(frozen=True)
class AdaptiveOptions:
    """Parameters of the adaptive mesher.

    Attributes
    ----------
    mesh_size : float
        Mesh size of the plane mesh (m).
    domain_height : float
        Height of the domain above the smoothed terrain, or above the highest terrain where its top is flat (m).
    limits : SpacingLimits
        Limits of the vertical spacing.
    stagger : float
        By how much neighbouring columns are shifted against each other: 0 for none, 1 for thirds of a step.
    passes : int
        Rounds of moving levels at the worst cells.
    growth : Growth or None
        How the vertical spacing grows from the ground up to the limits; None: it is the same at all heights.
    top : float or None
        Absolute height of the domain's top (m) if it is flat; None: it follows the smoothed terrain.
    """

    mesh_size: float
    domain_height: float
    limits: SpacingLimits
    stagger: float
    passes: int
    growth: Growth | None = None
    top: float | None = None


@dataclass(frozen=True)
class AdaptiveReport:
    """What the adaptive mesher did.

    Attributes
    ----------
    n_columns, n_levels : int
        Columns, and levels of all of them.
    shared_columns : int
        Columns that touch two roofs or more.
    moved_nodes : int
        Roofs that stand higher in a column than they should, for the sake of the least spacing.
    largest_move : float
        By how much at most (m).
    improved_levels : int
        Levels that the last passes moved.
    worst_ratio : (float, float)
        Smallest radius ratio before and after those passes.
    """

    n_columns: int
    n_levels: int
    shared_columns: int
    moved_nodes: int
    largest_move: float
    improved_levels: int
    worst_ratio: tuple[float, float]


def mesh_adaptive(
    plane: PlaneMesh,
    dtm: Dtm,
    roof: NDArray[np.float64],
    group: NDArray[np.int32],
    ids: NDArray[np.str_],
    options: AdaptiveOptions,
    *,
    seam: SeamColumns | None = None,
    sizes: SizeField | None = None,
) -> tuple[ColumnMesh, AdaptiveReport]:
    """Fill the columns, merge them, and mend the worst cells.

    Parameters
    ----------
    plane : PlaneMesh
        Plane mesh with walls and party walls as edges.
    dtm : Dtm
        Terrain, as far beyond the plane mesh as `top_reach` says.
    roof : float64, (b,)
        Absolute roof height (m) of each building, row by row those of `PlaneMesh.building`. For exact roofs,
        those that meet in a vertex are equal or `limits.least` mesh sizes apart, and as much above the terrain.
    group : int32, (b,)
        Buildings of one group have one roof: the same height, and no wall between them.
    ids : str, (b,)
        Building ids, for messages.
    options : AdaptiveOptions
        Parameters.
    seam : SeamColumns, optional
        Columns that are given by a seam: they stay bit for bit.
    sizes : SizeField, optional
        Target edge lengths of the plane mesh, where they are not the same everywhere: the spacing's limits are in
        these.

    Raises
    ------
    GeometryError
        If a building or the terrain reaches the top of the domain.
    ValueError
        If a group has two heights, or the seam lacks a roof that the mesh has there.
    """
    check_groups(roof, group)
    seam = no_seam() if seam is None else seam
    levels, bottom, moves = _fill_columns(plane, dtm, roof, ids, options, seam, sizes)
    mesh = ColumnMesh(plane, levels.start, levels.z, bottom, "heights")
    free = np.isnan(levels.surface)
    count, n_shared = np.diff(levels.start), _count_shared(levels)
    free &= ~np.repeat(np.isin(np.arange(len(plane.xy)), seam.vertex), count)
    size = local_sizes(sizes, plane.xy, mesh_size=options.mesh_size)
    spacing = vertical_spacing(mean_edges(plane), size, options.limits)
    if options.growth is not None:
        lowest = sample_dtm(dtm, plane.xy) + movable_height(spacing, options.growth)
        free &= levels.z > np.repeat(lowest, count)
    del levels  # its surfaces are as large as its heights
    mesh, worst, improved = improve_columns(
        mesh, free, spacing, passes=options.passes, flat_cells=options.growth is not None
    )
    report = AdaptiveReport(
        n_columns=len(plane.xy),
        n_levels=len(mesh.z),
        shared_columns=n_shared,
        moved_nodes=int((moves > 0).sum()),
        largest_move=float(moves.max(initial=0.0)),
        improved_levels=improved,
        worst_ratio=worst,
    )
    return mesh, report


def fill_columns(
    plane: PlaneMesh,
    dtm: Dtm,
    roof: NDArray[np.float64],
    ids: NDArray[np.str_],
    options: AdaptiveOptions,
    *,
    sizes: SizeField | None = None,
) -> Levels:
    """Fill the columns of a plane mesh, as a seam's are from the mesh of its strip.

    Parameters and errors as in `mesh_adaptive`.
    """
    return _fill_columns(plane, dtm, roof, ids, options, no_seam(), sizes)[0]


def _fill_columns(
    plane: PlaneMesh,
    dtm: Dtm,
    roof: NDArray[np.float64],
    ids: NDArray[np.str_],
    options: AdaptiveOptions,
    seam: SeamColumns,
    sizes: SizeField | None,
) -> tuple[Levels, NDArray[np.int32], NDArray[np.float64]]:
    """Levels, where cells begin in them, and how far each node was moved (m)."""
    size, limits = options.mesh_size, options.limits
    if options.top is None:
        top = domain_top(dtm, plane.xy, domain_height=options.domain_height)
    else:
        top = np.full(len(plane.xy), options.top)
    air = HEADROOM * limits.most * size
    check_headroom(top, plane, roof, ids, domain_height=options.domain_height, air=air)
    local = local_sizes(sizes, plane.xy, mesh_size=size)
    spacing = vertical_spacing(mean_edges(plane), local, limits)
    shift = np.zeros(len(plane.xy))
    if options.stagger:
        shift = options.stagger * stagger_columns(len(plane.xy), plane_edges(plane.triangles)[0])
    surface = triangle_surfaces(plane, roof)
    least_gap = np.full(len(plane.xy), limits.least * size)
    ground = sample_dtm(dtm, plane.xy)
    nodes, moves = place_nodes(plane, surface, ground, seam, least_gap=least_gap)
    _check_top(plane, nodes, top, least_gap, options.domain_height)
    levels, bottom = fill_levels(nodes, top, spacing, shift, seam, ground=ground, growth=options.growth)
    return levels, bottom, moves


def _check_top(
    plane: PlaneMesh, nodes: Nodes, top: NDArray[np.float64], least_gap: NDArray[np.float64], domain_height: float
) -> None:
    """Refuse terrain, or a roof that was moved, at the top of the domain."""
    missing = nodes.z[nodes.start[1:] - 1] + least_gap - top
    worst = int(missing.argmax())
    if missing[worst] <= 0:
        return
    x, y = plane.xy[worst]
    highest = nodes.z[nodes.start[worst + 1] - 1]
    raise GeometryError(
        f"column at ({x:.1f}, {y:.1f}), step 3.2: ground or roof at {highest:.1f} m is less than "
        f"{least_gap[worst]:.1f} m below the domain's top at {top[worst]:.1f} m; raise --domain-height to "
        f"{np.ceil(domain_height + missing[worst]):.0f}, or mend the terrain there"
    )


def _count_shared(levels: Levels) -> int:
    column = np.searchsorted(levels.start, np.flatnonzero(np.isfinite(levels.surface)), side="right")
    return int((np.bincount(column) > 1).sum())
