"""Steps 3.2 to 3.5 with levels of their own in every column: our mesher, composed.

No equation is solved. Every column is exact at the ground and at each roof that it touches, evenly spaced
between them, about as widely as its plane edges are long; columns are merged by the height of their segments.
What a column holds depends on its neighbourhood in the plane mesh and on the terrain within `top_reach`.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipeline.columns.growth import Growth, movable_height
from pipeline.columns.improve_columns import WORST, improve_columns
from pipeline.columns.levels import fill_levels, stagger_columns
from pipeline.columns.nodes import (
    FREE,
    GROUND_LEVEL,
    ROOF_LEVEL,
    Levels,
    NodeMoves,
    Nodes,
    SeamColumns,
    add_floors,
    collect_surfaces,
    no_seam,
    place_nodes,
)
from pipeline.columns.order_keys import set_order_keys, wall_gates
from pipeline.columns.spacing import SpacingLimits, column_spacing, domain_top, is_stretched
from pipeline.columns.trim_layers import check_headroom
from pipeline.data.errors import GeometryError
from pipeline.data.mesh import ColumnMesh, PlaneMesh
from pipeline.data.roofs import Roofs, Weld, roof_heights
from pipeline.plane_mesh.edges import plane_edges
from pipeline.plane_mesh.sizes import SizeField
from pipeline.points_terrain.terrain import Dtm, sample_dtm

HEADROOM = 0.5  # of the largest spacing: least air between a roof and the domain's top
WORST_SLOPED = 0.55  # as `WORST`, where roofs slope
MOVED = 1e-9  # m; a roof that a node is closer to than this is exact


@dataclass(frozen=True)
class AdaptiveOptions:
    """Parameters of the adaptive mesher."""

    mesh_size: float  #: mesh size of the plane mesh (m)
    #: height of the domain above the smoothed terrain, or above the highest terrain where its top is flat (m)
    domain_height: float
    limits: SpacingLimits  #: limits of the vertical spacing
    #: by how much neighbouring columns are shifted against each other: 0 for none, 1 for thirds of a step
    stagger: float
    passes: int  #: rounds of moving levels at the worst cells; one more where roofs slope, whose keys change by it
    #: how the vertical spacing grows from the ground up to the limits; None: it is the same at all heights
    growth: Growth | None = None
    #: absolute height of the domain's top (m) if it is flat; None: it follows the smoothed terrain
    top: float | None = None
    #: how roofs that meet at a vertex are joined and parted; None: only roofs of one height are joined
    weld: Weld | None = None
    solids: bool = False  #: whether columns go on below roofs, down to the terrain, for cells of buildings


@dataclass(frozen=True)
class AdaptiveReport:
    """What the adaptive mesher did."""

    #: columns, and levels of all of them
    n_columns: int
    n_levels: int
    shared_columns: int  #: columns that touch two roofs or more
    #: roofs that stand higher or lower in a column than they should: joined with others or parted from them
    moved_nodes: int
    largest_move: float  #: by how much at most (m)
    eased_nodes: int  #: roofs that were moved in a column for its cells, by `Weld.slack` at most
    joined_for_order: int  #: roofs that were joined at one end of an edge, since they change order along it
    crossed_edges: int  #: edges along which two roofs still change order, both ends being those of seams
    keyed_levels: int  #: levels with an order key of their own
    passed_edges: int  #: ends of tops of walls that the merge of columns still passes by
    improved_levels: int  #: levels that the last passes moved
    worst_ratio: tuple[float, float]  #: smallest radius ratio before and after those passes


def mesh_adaptive(
    plane: PlaneMesh,
    dtm: Dtm,
    roofs: Roofs,
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
    roofs : Roofs
        Roof of each building, row by row those of `PlaneMesh.building`. Where two of them meet in a vertex at less
        than the least step of `AdaptiveOptions.weld`, both are moved there, and at outlines one may be moved where
        cells would be bad. All others are exact.
    ids : str, (b,)
        Building ids, for messages.
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
        If the seam lacks a roof that the mesh has there.
    """
    seam = no_seam() if seam is None else seam
    levels, bottom, moves = _fill_columns(plane, dtm, roofs, ids, options, seam, sizes)
    mesh = ColumnMesh(plane, levels.start, levels.z, bottom, "heights")
    given = np.zeros(len(plane.xy), np.bool_)
    given[seam.vertex] = True
    spacing = column_spacing(plane, sizes, options.limits, mesh_size=options.mesh_size)
    surfaces = collect_surfaces(plane, bottom)
    outline = np.diff(surfaces.start) > 1
    kept = given | is_stretched(plane.xy, sizes, mesh_size=options.mesh_size)
    slack = _level_slack(levels, outline, given, kept, sample_dtm(dtm, plane.xy), spacing, options)
    surface = levels.start[:-1].repeat(np.diff(surfaces.start)) + surfaces.level
    n_shared, home = _count_shared(levels), levels.z
    del levels  # its kinds are of no use any more
    # Level tops of walls are never passed by: without sloped roofs there is nothing to see to.
    keyed = options.weld is not None or options.solids
    gates = wall_gates(mesh, floors=options.solids) if keyed else np.empty((0, 2, 2), np.int64)

    def key_anew(mesh: ColumnMesh) -> ColumnMesh:
        return _key_columns(replace(mesh, key=None), seam, given, gates)[0]

    sloped = options.weld is not None
    mesh, worst, improved = improve_columns(
        key_anew(mesh),
        home,
        slack,
        spacing,
        passes=options.passes + (sloped and options.passes > 0),
        worst=WORST_SLOPED if sloped else WORST,
        rekey=key_anew if sloped else None,
        flat_cells=options.growth is not None,
    )
    mesh, passed = _key_columns(mesh, seam, given, gates)  # levels beside walls moved
    eased = mesh.z[surface] - home[surface]
    if sloped:
        moved = np.zeros(len(mesh.z))
        moved[surface] = eased
        mesh = replace(mesh, moved=moved)
    report = AdaptiveReport(
        n_columns=len(plane.xy),
        n_levels=len(mesh.z),
        shared_columns=n_shared,
        moved_nodes=int((np.abs(moves.distance + eased) > MOVED).sum()),
        largest_move=float(np.abs(moves.distance + eased).max(initial=0.0)),
        eased_nodes=int((eased != 0).sum()),
        joined_for_order=moves.joined_for_order,
        crossed_edges=moves.crossed,
        keyed_levels=0 if mesh.key is None else int((mesh.key != mesh.z).sum()),
        passed_edges=passed,
        improved_levels=improved,
        worst_ratio=worst,
    )
    return mesh, report


def fill_columns(
    plane: PlaneMesh,
    dtm: Dtm,
    roofs: Roofs,
    ids: NDArray[np.str_],
    options: AdaptiveOptions,
    *,
    sizes: SizeField | None = None,
) -> tuple[Levels, NDArray[np.int32]]:
    """Fill the columns of a plane mesh, as a seam's are from the mesh of its strip.

    Parameters and errors as in `mesh_adaptive`.

    Returns
    -------
    Levels
        The columns, with the surfaces that they touch.
    int32, (m, 3)
        For each corner of a triangle, the level of its column where its cells begin.
    """
    levels, bottom, _ = _fill_columns(plane, dtm, roofs, ids, options, no_seam(), sizes)
    return replace(levels, surfaces=collect_surfaces(plane, bottom)), bottom


def _fill_columns(
    plane: PlaneMesh,
    dtm: Dtm,
    roofs: Roofs,
    ids: NDArray[np.str_],
    options: AdaptiveOptions,
    seam: SeamColumns,
    sizes: SizeField | None,
) -> tuple[Levels, NDArray[np.int32], NodeMoves]:
    """Levels, where cells begin in them, and how far each node was moved (m)."""
    size, limits = options.mesh_size, options.limits
    if options.top is None:
        top = domain_top(dtm, plane.xy, domain_height=options.domain_height)
    else:
        top = np.full(len(plane.xy), options.top)
    air = HEADROOM * limits.most * size
    check_headroom(top, plane, highest_roofs(plane, roofs), ids, domain_height=options.domain_height, air=air)
    spacing = column_spacing(plane, sizes, options.limits, mesh_size=options.mesh_size)
    shift = np.zeros(len(plane.xy))
    if options.stagger:
        shift = options.stagger * stagger_columns(len(plane.xy), plane_edges(plane.triangles)[0])
    least_gap = np.full(len(plane.xy), limits.least * size)
    ground = sample_dtm(dtm, plane.xy)
    nodes, moves = place_nodes(plane, roofs, ground, seam, spacing=spacing, least_gap=least_gap, weld=options.weld)
    if options.solids:
        given = np.isin(np.arange(len(plane.xy)), seam.vertex)
        nodes = add_floors(nodes, ground, given, least_gap)
    _check_top(plane, nodes, top, least_gap, options.domain_height)
    levels, bottom = fill_levels(nodes, top, spacing, shift, seam, ground=ground, growth=options.growth)
    return levels, bottom, moves


def highest_roofs(plane: PlaneMesh, roofs: Roofs) -> NDArray[np.float64]:
    """Highest place of each roof over the vertices of a plane mesh (m), (b,); -inf where it has none.

    Parameters
    ----------
    roofs : Roofs
        Roof of each of its buildings.
    """
    inside = plane.building >= 0
    building = np.repeat(plane.building[inside].astype(np.int64), 3)
    highest = np.full(len(roofs), -np.inf)
    np.maximum.at(highest, building, roof_heights(roofs, building, plane.xy[plane.triangles[inside].ravel()]))
    return highest


def _level_slack(
    levels: Levels,
    outline: NDArray[np.bool_],
    given: NDArray[np.bool_],
    kept: NDArray[np.bool_],
    ground: NDArray[np.float64],
    spacing: NDArray[np.float64],
    options: AdaptiveOptions,
) -> NDArray[np.float64]:
    """How far each level may be moved for its cells (m): free ones anywhere, roofs a little at their outlines.

    Columns that are given stay, and so do roofs in those that are kept, or as low over the terrain as they may be,
    and thin layers.
    """
    column = np.repeat(np.arange(len(given)), np.diff(levels.start))
    slack = np.where(levels.kind == FREE, np.inf, 0.0)
    if options.weld is not None:
        high = levels.z >= ground[column] + options.weld.clearance + options.weld.slack
        slack[(levels.kind == ROOF_LEVEL) & (outline & ~kept)[column] & high] = options.weld.slack
    slack[given[column]] = 0.0
    if options.growth is not None:
        slack[levels.z <= (ground + movable_height(spacing, options.growth))[column]] = 0.0
    return slack


def _key_columns(
    mesh: ColumnMesh, seam: SeamColumns, given: NDArray[np.bool_], gates: NDArray[np.int64]
) -> tuple[ColumnMesh, int]:
    """Give the columns order keys, but for those of seams, which have theirs; edges between these were seen to."""
    key = mesh.merge_keys.copy()
    place = np.repeat(mesh.z_start[seam.vertex], np.diff(seam.levels.start))
    within = np.arange(len(seam.levels.z)) - np.repeat(seam.levels.start[:-1], np.diff(seam.levels.start))
    key[place + within] = seam.levels.key
    return set_order_keys(mesh, key, given, gates)


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
    surface = (levels.kind == GROUND_LEVEL) | (levels.kind == ROOF_LEVEL)
    column = np.searchsorted(levels.start, np.flatnonzero(surface), side="right")
    return int((np.bincount(column) > 1).sum())
