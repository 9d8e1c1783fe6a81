"""The proofs of `citystitch check` that hold the mesh against its city model: marks, walls, roofs."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.data.mesh import Marker
from pipeline.data.regions import Region, Regions
from pipeline.data.roofs import roof_heights
from stitch.pieces.conformity import group_rows
from stitch.pieces.frontier import group_places
from tiler.check.proofs import (
    HEIGHT_TOLERANCE,
    N_PLACES,
    SIDE_TOLERANCE,
    Bounds,
    Dtm,
    Fault,
    Finding,
    Mask,
    Proof,
    Surface,
    Vertices,
    at_most,
    find_faults,
    measure_plan_widths,
)
from tiler.check.roof_proofs import OUTLINE_TOLERANCE, are_above_roofs, check_roof_heights
from tiler.citymodels.building_index import BuildingIndex
from tiler.store.run_folder import FLAT_ROOFS, Buildings, RoofRules

LOADED = 4096  # footprints that are measured at once


def check_marks(surface: Surface, buildings: Buildings, *, regions: Regions = (Region.AIR,)) -> Finding:
    """Every facet has one marker, and walls, roofs and foundations alone have a building, a known one."""
    marker, owner = surface.boundary.marker, surface.boundary.building
    below = [Marker.BOTTOM] * (Region.SOIL in regions) + [Marker.FOUNDATION] * (len(regions) > 1)
    unmarked = ~surface.marked(*(mark for mark in Marker if mark <= Marker.MISSING or mark in below))
    built = surface.marked(Marker.WALL, Marker.ROOF, Marker.FOUNDATION)
    unknown = built & (_rows_of(owner, buildings) < 0)
    astray = ~built & (owner != -1)
    bound = " or ".join(["1 to 9", *(f"{mark:d}" for mark in below)])
    centres = surface.corners.mean(axis=1)
    faults = [
        *find_faults("marker-unknown", centres[unmarked], f"marker {_first(marker[unmarked])}; bound: {bound}"),
        *find_faults(
            "building-unknown",
            centres[unknown],
            f"building {_first(owner[unknown])} of a wall, roof or foundation is not in the city model",
        ),
        *find_faults(
            "building-astray",
            centres[astray],
            f"building {_first(owner[astray])} on a facet that is no wall, roof or foundation; expected -1",
        ),
    ]
    counts = {mark.name.lower(): int(np.count_nonzero(marker == mark)) for mark in Marker}
    return Finding(tuple(faults), counts)


def prove_marks(found: Finding) -> Proof:
    """Tell how many facets have which marker."""
    names = [mark.name.lower() for mark in Marker]
    rare = [mark.name.lower() for mark in (Marker.MISSING, Marker.BOTTOM, Marker.FOUNDATION)]
    counts = ", ".join(f"{found.sums[name]} {name}" for name in names if name not in rare or found.sums[name])
    return Proof(f"every facet has one marker: {counts}", found.faults)


def check_roofs(surface: Surface, buildings: Buildings, dtm: Dtm, rules: RoofRules) -> Finding:
    """Roofs lie on the plane of their building, at outlines near it, and inside its footprint."""
    chosen, row, corners = _facets_of(surface, buildings, Marker.ROOF)
    found = check_roof_heights(corners, surface.moved[chosen], row, buildings, dtm, rules)
    outside = ~_all_near(buildings.footprints, row, corners)
    centres = corners.mean(axis=1)
    faults = find_faults("roof-off-footprint", centres[outside], f"not inside; {at_most(OUTLINE_TOLERANCE)}")
    return replace(found, faults=(*found.faults, *faults))


def prove_roofs(found: Finding) -> Proof:
    """Tell how far roofs are off at most."""
    count, worst = found.sums["facets"], found.largest["worst"]
    claim = f"{count} roof facets lie at their building's height and in its footprint, worst {worst:.2g} m"
    bounds = f"{at_most(HEIGHT_TOLERANCE)} up, {OUTLINE_TOLERANCE:g} m across"
    if found.sums["moved"]:
        share = 100 * found.sums["moved"] / found.sums["corners"]
        bounds += (
            f"; {share:.1f} % of their corners, at outlines, are joined with other roofs, parted from them,"
            f" raised over terrain or moved for cells, by {found.largest['largest move']:.2f} m at most"
        )
    return Proof(f"{claim}; {bounds}", found.faults)


def check_walls(surface: Surface, buildings: Buildings, dtm: Dtm, rules: RoofRules) -> Finding:
    """Walls are vertical, on the outline of their building and not above its roof."""
    chosen, row, corners = _facets_of(surface, buildings, Marker.WALL)
    width = measure_plan_widths(corners, surface.area[chosen])
    leaning = ~(width <= SIDE_TOLERANCE)
    used, index = np.unique(row, return_inverse=True)
    astray = ~_all_near(shapely.boundary(buildings.footprints[used]), index, corners)
    above = are_above_roofs(corners, surface.moved[chosen], row, buildings, dtm, rules)
    centres = corners.mean(axis=1)
    lean = f"{width.max(initial=0):.3g} m wide in plan; {at_most(SIDE_TOLERANCE)}"
    faults = [
        *find_faults("wall-not-vertical", centres[leaning], lean),
        *find_faults(
            "wall-off-outline",
            centres[astray],
            f"off its building's outline; {at_most(OUTLINE_TOLERANCE)}",
        ),
        *find_faults("wall-above-roof", centres[above], f"above its building's roof; {at_most(HEIGHT_TOLERANCE)}"),
    ]
    return Finding(tuple(faults), {"facets": len(chosen)})


def prove_walls(found: Finding) -> Proof:
    """Tell how many wall facets are right."""
    claim = f"{found.sums['facets']} wall facets are vertical, on their building's outline, below its roof"
    return Proof(f"{claim}; {at_most(OUTLINE_TOLERANCE)}", found.faults)


@dataclass(frozen=True, eq=False)
class Built:
    """What pieces have of each building of the city model."""

    roof_area: NDArray[np.float64]  #: (n,): plan area of its roof facets (m²)
    #: (n,): roof and wall facets
    n_roofs: NDArray[np.int32]
    n_walls: NDArray[np.int32]
    plan_area: NDArray[np.float64]  #: (n,): how much of its footprint lies in the plan of the pieces (m²)


def find_built(surface: Surface, buildings: Buildings, outline: Vertices) -> Built:
    """Measure what a piece has of each building; `outline` (k, 2, 2) is the edges of its plan."""
    n = len(buildings)
    roofs, roof_row, _ = _facets_of(surface, buildings, Marker.ROOF)
    _, wall_row, _ = _facets_of(surface, buildings, Marker.WALL)
    plan_area = np.zeros(n)
    for face in shapely.polygonize(shapely.linestrings(outline)).geoms:
        near = buildings.tree.query(face, predicate="intersects")
        plan_area[near] += shapely.area(shapely.intersection(buildings.footprints[near], face))
    return Built(
        np.bincount(roof_row, -surface.area[roofs], n).astype(np.float64),
        np.bincount(roof_row, minlength=n).astype(np.int32),
        np.bincount(wall_row, minlength=n).astype(np.int32),
        plan_area,
    )


def start_built(n: int) -> Built:
    """Give what no piece has of n buildings."""
    return Built(np.zeros(n), np.zeros(n, np.int32), np.zeros(n, np.int32), np.zeros(n))


def add_built(total: Built, rows: NDArray[np.int64], part: Built) -> None:
    """Add what a piece has of some buildings, of these rows, to what is known of all."""
    for name in ("roof_area", "n_roofs", "n_walls", "plan_area"):
        getattr(total, name)[rows] += getattr(part, name)


def prove_buildings(
    built: Built, index: BuildingIndex, bounds: Bounds, *, rules: RoofRules = FLAT_ROOFS, partial: bool
) -> Proof:
    """Every building of the city model has its walls, and a roof as large as its footprint.

    Notes
    -----
    A roof may differ from the footprint by `OUTLINE_TOLERANCE` along its whole outline. A building
    needs no wall of its own where its outline runs along the region's border or a house that is as high, or, if
    roofs are sloped, lower by no more than the step by which roofs are parted.
    If pieces are missing (`partial`), what counts of a footprint is what lies in the others' plan.
    """
    n = len(index)
    full_area, slack = _measure_footprints(index)
    wanted = built.plan_area if partial else full_area
    whole = wanted >= full_area - slack
    has_roof, has_wall = built.n_roofs > 0, built.n_walls > 0
    error = np.abs(built.roof_area - wanted)
    uneven = has_roof & ~(error <= slack)
    bare = ~has_wall & has_roof & whole
    bare[bare] = [_needs_wall(row, index, bounds, rules) for row in np.flatnonzero(bare).tolist()]
    expected = wanted > (slack if partial else -1)
    faults = [
        *_find_faults(
            "building-missing", index, expected & ~has_roof & ~has_wall, "in the city model, not in the mesh"
        ),
        *_find_faults("building-without-roof", index, expected & ~has_roof & has_wall, "it has walls but no roof"),
        *_find_faults("building-without-wall", index, bare, "it has a roof but no wall"),
        *_find_faults(
            "roof-area",
            index,
            uneven,
            f"{error[uneven].max(initial=0):.3g} m² off its footprint; bound: {OUTLINE_TOLERANCE:g} m along its"
            " outline",
        ),
    ]
    total = f"roofs {built.roof_area.sum():.2f} m², footprints {wanted.sum():.2f} m²"
    n_whole = f"{n}" if not partial else f"{np.count_nonzero(whole)} whole and {np.count_nonzero(~whole)} other"
    return Proof(
        f"the {n_whole} building parts of the city model have their walls and roofs; {total}", tuple(faults)
    )


def _measure_footprints(index: BuildingIndex) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Measure each footprint's area (m²), and how far a roof's may be off; some footprints at a time."""
    area, slack = np.empty(len(index)), np.empty(len(index))
    for start in range(0, len(index), LOADED):
        rows = np.arange(start, min(start + LOADED, len(index)))
        footprints = index.take(rows).footprints
        area[rows], slack[rows] = shapely.area(footprints), OUTLINE_TOLERANCE * shapely.length(footprints)
    return area, slack


def _find_faults(kind: str, index: BuildingIndex, wrong: Mask, detail: str) -> list[Fault]:
    """Make one fault of all buildings that are wrong; the places of the first are looked up."""
    rows = np.flatnonzero(wrong)
    some = index.take(rows[:N_PLACES])
    inside = shapely.get_coordinates(shapely.point_on_surface(some.footprints)).reshape(-1, 2)
    faults = find_faults(kind, np.column_stack([inside, some.roof]), detail)
    return [replace(fault, count=len(rows)) for fault in faults]


def _first(values: NDArray[Any]) -> str:
    return str(values[0]) if len(values) else ""


def _rows_of(owner: NDArray[np.int64], buildings: Buildings) -> NDArray[np.int64]:
    """Return the row of each building number, -1 where the city model has none."""
    if not len(buildings):
        return np.full(len(owner), -1)
    row = np.searchsorted(buildings.numbers, owner).clip(max=len(buildings) - 1)
    return np.where(buildings.numbers[row] == owner, row, -1)


def _facets_of(
    surface: Surface, buildings: Buildings, marker: Marker
) -> tuple[NDArray[np.int64], NDArray[np.int64], Vertices]:
    """Return the facets with a marker and a known building, their building's rows, their vertices."""
    row = _rows_of(surface.boundary.building, buildings)
    chosen = np.flatnonzero(surface.marked(marker) & (row >= 0))
    return chosen, row[chosen], surface.corners[chosen]


def _all_near(shapes: NDArray[np.object_], row: NDArray[np.int64], corners: Vertices) -> Mask:
    """Tell whether a facet's vertices and centre are within `OUTLINE_TOLERANCE` of its building's shape.

    Many facets of a wall have the same plan: each is looked at once.
    """
    shapely.prepare(shapes[np.unique(row)])

    def are_near(row: NDArray[np.int64], xy: Vertices) -> Mask:
        return shapely.dwithin(shapes[row], shapely.points(xy), OUTLINE_TOLERANCE)  # type: ignore[no-any-return]

    places, number = group_places(corners.reshape(-1, 3))
    plan = np.sort(number.reshape(-1, 3), axis=1)
    first, group = _find_distinct(np.column_stack((row, plan)))
    row, plan = row[first], plan[first]
    corner, of = _find_distinct(np.column_stack((np.repeat(row, 3), plan.ravel())))
    near = are_near(np.repeat(row, 3)[corner], places[plan.ravel()[corner]])[of].reshape(-1, 3).all(axis=1)
    near &= are_near(row, places[plan].mean(axis=1))
    found: Mask = near[group]
    return found


def _find_distinct(rows: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Find a row of each group of equal rows, and the group of each row."""
    group, n_groups = group_rows(rows)
    first = np.empty(n_groups, np.int64)
    first[group] = np.arange(len(rows))
    return first, group


def _needs_wall(row: int, index: BuildingIndex, bounds: Bounds, rules: RoofRules) -> bool:
    """Tell whether air must touch the outline of a building below its roof."""
    own = index.take(np.array([row]))
    outline = shapely.boundary(own.footprints[0])
    west, south, east, north = shapely.buffer(outline, OUTLINE_TOLERANCE).bounds
    others = index.find_near((west, south, east, north))
    near = index.take(others[others != row])
    lower = np.array([_rises_above(own, near, k, rules) for k in range(len(near))], np.bool_)
    hides = shapely.dwithin(near.footprints, outline, OUTLINE_TOLERANCE) & ~lower
    hidden = [*near.footprints[hides], shapely.boundary(shapely.box(*bounds))]
    cover = shapely.union_all(shapely.buffer(hidden, OUTLINE_TOLERANCE))
    return bool(shapely.length(shapely.difference(outline, cover)) > OUTLINE_TOLERANCE)


def _rises_above(own: Buildings, near: Buildings, k: int, rules: RoofRules) -> bool:
    """Tell whether a roof is the higher one where it meets another, so that there must be a wall."""
    common = shapely.intersection(
        shapely.boundary(own.footprints[0]), shapely.buffer(near.footprints[k], OUTLINE_TOLERANCE)
    )
    xy = shapely.get_coordinates(common)
    if not len(xy):
        return True
    zeros = np.zeros(len(xy), np.int64)
    rise = roof_heights(own.roofs, zeros, xy) - roof_heights(near.roofs, zeros + k, xy)
    least = rules.step if rules.sloped else HEIGHT_TOLERANCE
    return bool((rise > least).any())
