"""Roofs of houses from the roof surfaces of a city model: parts with a plane each (step 2.0, ours)."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.data.roofs import Roofs, join_roofs, plane_heights, roof_heights, take_roofs
from pipeline.geometry.rings import compute_sharpest_corners, make_canonical

GRID = 0.001  # m, on which lines are noded
SAME_PLANE = 0.05  # m; surfaces that are closer to one plane get one part
CROSSING = 0.05  # m; roofs that change order by less within a cell do not cross there
LEAST_SHARE = 0.125  # of a house; parts that are smaller, and than the least area, are joined with others
LEAST_WIDTH = 0.5  # m, twice the area over the perimeter; narrower parts are joined with others ...
SQUARES = 4.0  # ... and those smaller than this many squares of the least width
JOINED_OFF = 0.5  # m; where roofs are farther off by joining parts (RMSE of the house), narrower ones are kept ...
LEAST_ANGLE = 20.0  # degrees; ... if none of them has a sharper corner
ROUNDS = 2  # of adding lines where surfaces cross
LEAST_COVER = 0.01  # m2 of a house; a surface over less is that of another one
LOST = 1e-3  # share of a house's area that its parts may miss

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class RoofSurfaces:
    """Roof surfaces that are known of houses."""

    #: (h + 1,): the surfaces of house k are ``start[k]`` to ``start[k + 1]``: none where nothing is known
    start: Index
    #: (s,): where they lie in plan, valid polygons or multipolygons (m): may overlap each other and the outline
    polygons: NDArray[np.object_]
    roofs: Roofs  #: their planes


def no_surfaces(n: int) -> RoofSurfaces:
    """Know nothing of the roofs of n houses."""
    return RoofSurfaces(np.zeros(n + 1, np.int64), np.empty(0, object), join_roofs([]))


@dataclass(frozen=True, eq=False)
class SurfacedRoof:
    """The roof of one house."""

    parts: NDArray[np.object_]  #: (p,): polygons that cover the house without overlap and share their vertices (m)
    roofs: Roofs  #: the plane of each
    #: area of surfaces beyond the house, and of the house without a surface (m²)
    overhang: float
    gap: float


def square_gaps(polygons: NDArray[np.object_], roofs: Roofs, one: Index, other: Index) -> Array:
    """Integrate the square of the distance of two roofs over polygons, without their limits.

    Parameters
    ----------
    polygons : object, (n,)
        Valid geometries (m); what has no area counts for nothing.
    one, other : int64, (n,)
        Both roofs of each.

    Returns
    -------
    float64, (n,)
        Integrals (m4).

    Examples
    --------
    >>> shed = Roofs(np.array([[1.0, 0, 0], [0, 0, 0]]), np.zeros((2, 2)), np.array([[0, 9.0], [0, 0]]))
    >>> square_gaps(np.array([shapely.box(0, 0, 3, 2)]), shed, np.array([0]), np.array([1])).tolist()
    [18.0]
    """
    parts, of = shapely.get_parts(shapely.normalize(polygons), return_index=True)
    rings, ring_of = shapely.get_rings(parts, return_index=True)
    xy, ring = shapely.get_coordinates(rings, return_index=True)
    part = ring_of[ring]
    row = of[part]
    gap = plane_heights(roofs, one[row], xy) - plane_heights(roofs, other[row], xy)
    first = np.flatnonzero(np.diff(part, prepend=-1))[np.unique(part, return_inverse=True)[1].reshape(-1)]
    # Triangles from the first vertex of a polygon to each of its edges, with the sign of their turn.
    a = np.flatnonzero(ring[1:] == ring[:-1])
    b, c = a + 1, first[a]
    u, v = xy[a] - xy[c], xy[b] - xy[c]
    f, g, h = gap[a], gap[b], gap[c]
    total = (u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]) / 12 * (f * f + g * g + h * h + f * g + g * h + h * f)
    return np.abs(np.bincount(row[a], total, len(polygons)))


def make_surfaced_roof(
    polygon: shapely.Polygon, surfaces: NDArray[np.object_], roofs: Roofs, *, clearance: float, finer: float = 0.0
) -> SurfacedRoof | None:
    """Make the roof of a house from the surfaces over it.

    Parameters
    ----------
    polygon : shapely.Polygon
        Its outline, valid (m).
    surfaces : object, (s,)
        Roof surfaces in plan, at least one.
    roofs : Roofs
        Their planes.
    clearance : float
        Least distance of walls (m). A part that is narrower than it, or than `LEAST_WIDTH`, is joined with its
        neighbour of the closest plane; as is one smaller than `SQUARES` squares of that width and than an eighth
        of the house.
    finer : float
        Instead of the clearance where that puts the roof off by more than `JOINED_OFF` (m); 0 for none.

    Returns
    -------
    SurfacedRoof or None
        None where the surfaces give no parts that cover the house.

    Notes
    -----
    Outline and surfaces, noded on a grid of a millimetre, part the plane into cells. A cell under several surfaces
    takes the highest; where two of them cross in a cell, their line is added and the cells are made again. A cell
    under none takes the nearest surface. Cells of one plane are joined, and parts that are too small or too narrow
    are joined with the neighbour whose plane is closest to theirs. What lies outside the outline is left out.

    The order of the surfaces does not matter. O(s^2) for s surfaces.
    """
    over = np.flatnonzero(shapely.area(shapely.intersection(surfaces, polygon)) > LEAST_COVER)
    if not len(over):
        return None
    surfaces, roofs = _sort(surfaces[over], take_roofs(roofs, over))
    leader = _join_planes(surfaces, roofs)
    if (leader == leader[0]).all():
        inside = float(shapely.area(shapely.intersection(shapely.union_all(surfaces), polygon)))
        whole = float(shapely.area(shapely.union_all(surfaces)))
        one = _widen(roofs, [leader == leader[0]], leader[:1])
        return SurfacedRoof(np.array([polygon], object), one, whole - inside, polygon.area - inside)
    extra: list[shapely.Geometry] = []
    cells = _Cells.of(polygon, surfaces, extra)
    for _ in range(ROUNDS):
        lines = _find_crossings(cells, roofs)
        if not lines:
            break
        extra += lines
        cells = _Cells.of(polygon, surfaces, extra)
    if not len(cells.inside):
        return None
    chosen, gap = _choose(cells, surfaces, roofs)
    label = leader[chosen]
    parts, owner = _join_cells(cells.polygons[cells.inside], label)
    made = _widen(roofs, [leader == k for k in owner.tolist()], owner)
    cut, width = parts, min(LEAST_WIDTH, clearance)
    parts, rows, whose = _join_small(cut, made, width, min(SQUARES * width**2, LEAST_SHARE * polygon.area))
    if finer and square_gaps(cut, made, np.arange(len(cut)), whose).sum() > JOINED_OFF**2 * polygon.area:
        narrow, others, _ = _join_small(cut, made, finer, min(SQUARES * finer**2, LEAST_SHARE * polygon.area))
        if compute_sharpest_corners(narrow).min() >= LEAST_ANGLE:
            parts, rows = narrow, others
    made = take_roofs(made, rows)
    if abs(float(shapely.area(parts).sum()) - polygon.area) > max(LOST * polygon.area, 0.05):
        return None
    if len(parts) == 1:
        parts = np.array([polygon], object)
    beyond = np.array(cells.under.any(axis=0), np.bool_)
    beyond[cells.inside] = False
    return SurfacedRoof(
        make_canonical(parts) if len(parts) > 1 else parts,
        made,
        float(shapely.area(cells.polygons[beyond]).sum()),
        gap,
    )


def _sort(surfaces: NDArray[np.object_], roofs: Roofs) -> tuple[NDArray[np.object_], Roofs]:
    """Put surfaces in an order of their own."""
    blobs = shapely.to_wkb(shapely.normalize(surfaces), byte_order=1)
    keys = list(zip(blobs, roofs.plane.tolist(), roofs.origin.tolist(), strict=True))
    order = np.array(sorted(range(len(keys)), key=keys.__getitem__), np.int64)
    return surfaces[order], take_roofs(roofs, order)


def _join_planes(surfaces: NDArray[np.object_], roofs: Roofs) -> Index:
    """Give each surface the row of the largest one whose plane it lies in."""
    xy, owner = shapely.get_coordinates(surfaces, return_index=True)
    start = np.searchsorted(owner, np.arange(len(surfaces) + 1))
    leader = np.arange(len(surfaces))
    leaders: list[int] = []
    by_area = np.lexsort((np.arange(len(surfaces)), -np.round(shapely.area(surfaces), 3)))
    for k in by_area.tolist():
        own = xy[start[k] : start[k + 1]]
        height = plane_heights(roofs, np.full(len(own), k), own)
        for one in leaders:
            there = plane_heights(roofs, np.full(len(own), one), own)
            if np.abs(there - height).max() <= SAME_PLANE:
                leader[k] = one
                break
        else:
            leaders.append(k)
    return leader


def _widen(roofs: Roofs, members: Sequence[NDArray[np.bool_]], leaders: Index) -> Roofs:
    """Take the roofs of leaders, with limits that hold for all of their members."""
    found = take_roofs(roofs, leaders)
    level = (found.plane[:, :2] == 0).all(axis=1)
    limits = found.limits.copy()
    for k, own in enumerate(members):
        if not level[k]:
            limits[k] = roofs.limits[own, 0].min(), roofs.limits[own, 1].max()
    return Roofs(found.plane, found.origin, limits)


@dataclass(frozen=True, eq=False)
class _Cells:
    """The cells that outline and surfaces part the plane into.

    ``under`` (s, c) tells which surfaces each lies under, ``inside`` the rows of those in the house, ``place``
    (c, 2) has a place in each.
    """

    polygons: NDArray[np.object_]
    place: Array
    under: NDArray[np.bool_]
    inside: Index = field(default_factory=lambda: np.empty(0, np.int64))

    @classmethod
    def of(
        cls, polygon: shapely.Polygon, surfaces: NDArray[np.object_], extra: Sequence[shapely.Geometry]
    ) -> "_Cells":
        lines = shapely.boundary(np.array([polygon, *surfaces], object))
        noded = shapely.union_all([*lines, *extra], grid_size=GRID)
        cells = shapely.get_parts(shapely.polygonize([noded]))
        points = shapely.point_on_surface(cells)
        shapely.prepare(surfaces)
        under = shapely.intersects(surfaces[:, np.newaxis], points[np.newaxis, :])
        inside = np.flatnonzero(shapely.intersects(polygon, points))
        return cls(cells, shapely.get_coordinates(points).reshape(-1, 2), under, inside)


def _find_crossings(cells: _Cells, roofs: Roofs) -> list[shapely.Geometry]:
    """Lines within cells of the house where the highest of their surfaces is crossed by another one."""
    lines = []
    for cell in cells.inside[cells.under[:, cells.inside].sum(axis=0) > 1].tolist():
        rows = np.flatnonzero(cells.under[:, cell])
        corner = shapely.get_coordinates(cells.polygons[cell])
        height = np.array([plane_heights(roofs, np.full(len(corner), row), corner) for row in rows])
        here = np.array([plane_heights(roofs, np.array([row]), cells.place[[cell]])[0] for row in rows])
        best = int(np.argmax(here))
        for k in np.flatnonzero((height - height[best]).max(axis=1) > CROSSING).tolist():
            line = _crossing(roofs, (int(rows[best]), int(rows[k])), cells.polygons[cell])
            if line is not None and not line.is_empty:
                lines.append(line)
    return lines


def _crossing(roofs: Roofs, rows: tuple[int, int], cell: shapely.Polygon) -> shapely.Geometry | None:
    """Where two planes cross within a cell; None where they are parallel."""
    a, b = roofs.plane[rows[0], :2] - roofs.plane[rows[1], :2]
    steep = a * a + b * b
    if steep < 1e-12:
        return None
    xmin, ymin, xmax, ymax = cell.bounds
    middle = np.array([[(xmin + xmax) / 2, (ymin + ymax) / 2]])
    one, other = (plane_heights(roofs, np.array([row]), middle)[0] for row in rows)
    x, y = middle[0] - (one - other) * np.array([a, b]) / steep
    far = (xmax - xmin + ymax - ymin) / np.sqrt(steep)
    line = shapely.LineString([(x - b * far, y + a * far), (x + b * far, y - a * far)])
    return shapely.intersection(line, cell)


def _choose(cells: _Cells, surfaces: NDArray[np.object_], roofs: Roofs) -> tuple[Index, float]:
    """Choose the surface of each cell of the house; gives them, and the area of cells under none (m²)."""
    place = cells.place[cells.inside]
    n = len(surfaces)
    row = np.repeat(np.arange(n), len(place))
    height = roof_heights(roofs, row, np.tile(place, (n, 1))).reshape(n, -1)
    under = cells.under[:, cells.inside]
    chosen: Index = np.argmax(np.where(under, height, -np.inf), axis=0)
    bare = ~under.any(axis=0)
    if bare.any():
        far = shapely.distance(surfaces[:, np.newaxis], shapely.points(place[bare])[np.newaxis, :])
        chosen[bare] = np.argmin(far, axis=0)
    return chosen, float(shapely.area(cells.polygons[cells.inside][bare]).sum())


def _join_cells(cells: NDArray[np.object_], label: Index) -> tuple[NDArray[np.object_], Index]:
    """Join the cells of each label, and take apart what does not hang together; gives parts and labels."""
    parts, owner = [np.empty(0, object)], [np.empty(0, np.int64)]
    for one in np.unique(label).tolist():
        found = shapely.get_parts(shapely.coverage_union_all(cells[label == one]))
        parts.append(found)
        owner.append(np.full(len(found), one))
    return np.concatenate(parts), np.concatenate(owner)


def _join_small(
    parts: NDArray[np.object_], roofs: Roofs, least_width: float, least: float
) -> tuple[NDArray[np.object_], Index, Index]:
    """Join parts that are too narrow (m) or small (m²), the smallest first, with that of the closest plane beside.

    Gives the parts that are left, the row of the roof of each, and that of the roof over each of all parts.
    """
    parts, row = parts.copy(), np.arange(len(parts))
    whose = row.copy()
    there, kept = np.ones(len(parts), np.bool_), np.zeros(len(parts), np.bool_)
    area, width = shapely.area(parts), 2 * shapely.area(parts) / shapely.length(parts)
    while True:
        small = np.flatnonzero(there & ~kept & ((area < least) | (width < least_width)))
        if not len(small):
            return parts[there], row[there], whose
        k = int(small[np.argmin(area[small])])
        near = np.flatnonzero(there & shapely.intersects(parts, parts[k]))
        near = near[near != k]
        shared = shapely.length(shapely.intersection(parts[near], parts[k]))
        near = near[shared > 2 * GRID]
        if not len(near):
            kept[k] = True
            continue
        corner = shapely.get_coordinates(parts[k])
        height = roof_heights(roofs, np.full(len(corner), row[k]), corner)
        far = [np.abs(roof_heights(roofs, np.full(len(corner), row[j]), corner) - height).max() for j in near]
        joined = [shapely.coverage_union_all([parts[j], parts[k]]) for j in near.tolist()]
        whole = [one.geom_type == "Polygon" for one in joined]
        if not any(whole):
            kept[k] = True
            continue
        j = min((np.round(f, 6), i) for i, f in enumerate(far) if whole[i])[1]
        parts[near[j]], there[k] = joined[j], False
        whose[whose == k] = near[j]
        area[near[j]] = parts[near[j]].area
        width[near[j]] = 2 * area[near[j]] / parts[near[j]].length
