"""The proofs of `citystitch check` that hold the mesh against its city model: marks, walls, roofs."""

from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.mesh import Marker
from tiler.proofs import (
    HEIGHT_TOLERANCE,
    SIDE_TOLERANCE,
    Mask,
    Proof,
    Surface,
    Vertices,
    at_most,
    find_faults,
)
from tiler.run_folder import Buildings

OUTLINE_TOLERANCE = 2e-3  # m, in the plane: CityJSON rounds coordinates to 1 mm


def prove_marks(surface: Surface, buildings: Buildings) -> Proof:
    """Every facet has one marker, and walls and roofs alone have a building, a known one."""
    marker, owner = surface.boundary.marker, surface.boundary.building
    unmarked = ~surface.marked(*Marker)
    built = surface.marked(Marker.WALL, Marker.ROOF)
    unknown = built & (_rows_of(owner, buildings) < 0)
    astray = ~built & (owner != -1)
    centres = surface.corners.mean(axis=1)
    counts = ", ".join(f"{np.count_nonzero(marker == mark)} {mark.name.lower()}" for mark in Marker)
    faults = [
        *find_faults("marker-unknown", centres[unmarked], f"marker {_first(marker[unmarked])}; bound: 1 to 9"),
        *find_faults(
            "building-unknown",
            centres[unknown],
            f"building {_first(owner[unknown])} of a wall or roof is not in the city model",
        ),
        *find_faults(
            "building-astray",
            centres[astray],
            f"building {_first(owner[astray])} on a facet that is no wall or roof; expected -1",
        ),
    ]
    return Proof(f"every facet has one marker: {counts}", tuple(faults))


def prove_roofs(surface: Surface, buildings: Buildings) -> Proof:
    """Roofs lie at the height of their building and inside its footprint."""
    chosen, row, corners = _facets_of(surface, buildings, Marker.ROOF)
    error = np.abs(corners[:, :, 2] - buildings.roof[row][:, None]).max(axis=1)
    off = ~(error <= HEIGHT_TOLERANCE)
    outside = ~_all_near(buildings.footprints, row, corners)
    centres, worst = corners.mean(axis=1), error.max(initial=0)
    faults = [
        *find_faults("roof-height", centres[off], f"{worst:.3g} m off; {at_most(HEIGHT_TOLERANCE)}"),
        *find_faults("roof-off-footprint", centres[outside], f"not inside; {at_most(OUTLINE_TOLERANCE)}"),
    ]
    claim = f"{len(chosen)} roof facets lie at their building's height and in its footprint, worst {worst:.2g} m"
    return Proof(f"{claim}; {at_most(HEIGHT_TOLERANCE)} up, {OUTLINE_TOLERANCE:g} m across", tuple(faults))


def prove_walls(surface: Surface, buildings: Buildings) -> Proof:
    """Walls are vertical, on the outline of their building and not above its roof."""
    chosen, row, corners = _facets_of(surface, buildings, Marker.WALL)
    width = _plan_widths(corners, surface.area[chosen])
    leaning = ~(width <= SIDE_TOLERANCE)
    astray = ~_all_near(shapely.boundary(buildings.footprints), row, corners)
    above = ~(corners[:, :, 2].max(axis=1) <= buildings.roof[row] + HEIGHT_TOLERANCE)
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
    claim = f"{len(chosen)} wall facets are vertical, on their building's outline, below its roof"
    return Proof(f"{claim}; {at_most(OUTLINE_TOLERANCE)}", tuple(faults))


def prove_buildings(surface: Surface, buildings: Buildings, bounds: tuple[float, float, float, float]) -> Proof:
    """Every building of the city model has its walls, and a roof as large as its footprint.

    Notes
    -----
    A roof may differ from the footprint by `OUTLINE_TOLERANCE` along its whole outline. A building
    needs no wall of its own where its outline runs along the region's border or a house that is as high.
    """
    n = len(buildings)
    roofs, roof_row, _ = _facets_of(surface, buildings, Marker.ROOF)
    _, wall_row, _ = _facets_of(surface, buildings, Marker.WALL)
    roof_area = np.bincount(roof_row, -surface.area[roofs], n)
    has_roof, has_wall = np.bincount(roof_row, minlength=n) > 0, np.bincount(wall_row, minlength=n) > 0
    footprint_area, perimeter = shapely.area(buildings.footprints), shapely.length(buildings.footprints)
    error = np.abs(roof_area - footprint_area)
    uneven = has_roof & ~(error <= OUTLINE_TOLERANCE * perimeter)
    bare = ~has_wall & has_roof
    bare[bare] = [_needs_wall(i, buildings, bounds) for i in np.flatnonzero(bare).tolist()]
    places = np.column_stack(
        [
            shapely.get_coordinates(shapely.point_on_surface(buildings.footprints)).reshape(n, 2),
            buildings.roof,
        ]
    )
    worst = error[uneven].max(initial=0)
    faults = [
        *find_faults("building-missing", places[~has_roof & ~has_wall], "in the city model, not in the mesh"),
        *find_faults("building-without-roof", places[~has_roof & has_wall], "it has walls but no roof"),
        *find_faults("building-without-wall", places[bare], "it has a roof but no wall"),
        *find_faults(
            "roof-area",
            places[uneven],
            f"{worst:.3g} m² off its footprint; bound: {OUTLINE_TOLERANCE:g} m along its outline",
        ),
    ]
    total = f"roofs {roof_area.sum():.2f} m², footprints {footprint_area.sum():.2f} m²"
    return Proof(f"the {n} buildings of the city model have their walls and roofs; {total}", tuple(faults))


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
    """Tell whether a facet's vertices and centre are within `OUTLINE_TOLERANCE` of its building's shape."""
    shapely.prepare(shapes)
    places = np.concatenate([corners, corners.mean(axis=1, keepdims=True)], axis=1)
    points = shapely.points(places[:, :, 0], places[:, :, 1])
    near: Mask = shapely.dwithin(shapes[row][:, None], points, OUTLINE_TOLERANCE).all(axis=1)
    return near


def _plan_widths(corners: Vertices, area: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the height of each facet's plan over its longest edge: 0 when the facet is vertical."""
    edges = np.roll(corners, -1, axis=1)[:, :, :2] - corners[:, :, :2]
    longest = np.hypot(edges[:, :, 0], edges[:, :, 1]).max(axis=1, initial=0)
    width: NDArray[np.float64] = np.divide(2 * np.abs(area), longest, out=np.zeros(len(area)), where=longest > 0)
    return width


def _needs_wall(i: int, buildings: Buildings, bounds: tuple[float, float, float, float]) -> bool:
    """Tell whether air must touch the outline of building `i` below its roof."""
    outline = shapely.boundary(buildings.footprints[i])
    near = shapely.dwithin(buildings.footprints, outline, OUTLINE_TOLERANCE)
    near &= buildings.roof >= buildings.roof[i] - HEIGHT_TOLERANCE
    near[i] = False
    hidden = [*buildings.footprints[near], shapely.boundary(shapely.box(*bounds))]
    cover = shapely.union_all(shapely.buffer(hidden, OUTLINE_TOLERANCE))
    return bool(shapely.length(shapely.difference(outline, cover)) > OUTLINE_TOLERANCE)
