"""The proofs of `citystitch check` of soil and buildings: what is between regions, bottom, foundations, cells."""

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.data.mesh import INTERFACES, Marker
from pipeline.data.regions import Region
from stitch.pieces import conformity
from stitch.pieces.frontier import as_places
from tiler.check.proofs import (
    HEIGHT_TOLERANCE,
    RELATIVE_TOLERANCE,
    Dtm,
    Fault,
    Finding,
    Mask,
    Proof,
    Surface,
    Vertices,
    at_most,
    centres_of,
    find_faults,
    merge_faults,
    unless_equal,
)
from tiler.check.roof_proofs import OUTLINE_TOLERANCE
from tiler.store.run_folder import Buildings


def name_interface(sides: tuple[Region, Region]) -> str:
    """Name the facets between two regions.

    Examples
    --------
    >>> name_interface((Region.AIR, Region.BUILDING))
    'wall or roof'
    """
    return " or ".join(marker.name.lower() for marker in INTERFACES[sides])


def check_between(
    points: Vertices, marked: NDArray[np.int32], between: NDArray[np.int32], sides: tuple[Region, Region]
) -> Finding:
    """The facets between two regions are what cells of both share.

    Parameters
    ----------
    points : float64, (n, 3)
        Points of a piece's surface (m).
    marked : int32, (g, 3)
        Facets with the markers of `INTERFACES` in the boundary file.
    between : int32, (k, 3)
        Faces that a cell of either region has, pointing out of the first.
    sides : (Region, Region)
        The regions.
    """
    match = conformity.match_facets(between, marked)
    name, (one, two) = name_interface(sides), (side.name.lower() for side in sides)
    lists = [
        ("missing", between[match.missing], f"a face between {one} and {two} that is not marked as {name}"),
        ("one-sided", marked[match.extra], f"a {name} facet without {one} on one side and {two} on the other"),
        ("flipped", marked[match.flipped], f"a {name} facet that points out of the {two}"),
        ("duplicate", marked[match.duplicate], f"a {name} facet is there twice"),
    ]
    kind = name.replace(" ", "-")
    faults = [f for word, rows, why in lists for f in find_faults(f"{kind}-{word}", centres_of(points, rows), why)]
    return Finding(merge_faults(faults), {"marked": len(marked), "between": len(between)})


def prove_between(found: Finding, sides: tuple[Region, Region]) -> Proof:
    """Tell whether two regions meet in the facets between them alone."""
    marked, between = int(found.sums["marked"]), int(found.sums["between"])
    one, two = (side.name.lower() for side in sides)
    way = ", air above, soil below" if two == "soil" else f", out of the {one}"
    claim = f"the {marked} {name_interface(sides)} facets are the {between} faces between {one} and {two}{way}"
    return Proof(f"{claim}, bitwise", found.faults)


def check_bottom(surface: Surface, depth: float) -> Finding:
    """The bottom lies `depth` (m) below the soil's top, everywhere."""
    facets = surface.boundary.facets
    tops = surface.points[np.unique(facets[surface.marked(Marker.GROUND, Marker.FOUNDATION)])]
    bottom = surface.points[np.unique(facets[surface.marked(Marker.BOTTOM)])]
    place, first = np.unique(as_places(tops), return_index=True)
    row = np.searchsorted(place, as_places(bottom)).clip(max=max(len(place) - 1, 0))
    above = np.full(len(bottom), np.nan)
    if len(place):
        same = place[row] == as_places(bottom)
        above[same] = tops[first[row[same]], 2]
    twice = len(tops) - len(place)
    error = np.abs(above - depth - bottom[:, 2])
    worst = float(np.nan_to_num(error, nan=np.inf).max(initial=0))
    detail = f"{worst:.3g} m off {depth:g} m below the soil's top; {at_most(HEIGHT_TOLERANCE)}"
    faults = find_faults("bottom-depth", bottom[~(error <= HEIGHT_TOLERANCE)], detail)
    if twice:
        repeated = np.delete(tops, first, axis=0)
        faults += find_faults("soil-top-twice", repeated, "a second top of the soil over one place")
    faults += _find_turned(surface, surface.marked(Marker.BOTTOM) & ~(surface.area < 0), "bottom", "down")
    return Finding(tuple(faults), {"vertices": len(bottom)}, {"worst": worst})


def prove_bottom(found: Finding, depth: float) -> Proof:
    """Tell how far the bottom is off its depth at most."""
    claim = f"the bottom lies {depth:g} m below the soil's top, worst {found.largest['worst']:.2g} m"
    return Proof(f"{claim}; {at_most(HEIGHT_TOLERANCE)}", found.faults)


def check_foundations(surface: Surface, dtm: Dtm, *, up: bool = True) -> Finding:
    """Foundations lie under the roofs of their buildings, on the terrain or below it; they face up, or down."""
    chosen = surface.marked(Marker.FOUNDATION)
    points = surface.points[np.unique(surface.boundary.facets[chosen])]
    over = points[:, 2] - dtm.sample(points[:, :2])
    worst = float(over.max(initial=-np.inf))
    numbers, row = np.unique(surface.boundary.building, return_inverse=True)
    area, roof = (
        np.bincount(row[marked], np.abs(surface.area[marked]), len(numbers))
        for marked in (chosen, surface.marked(Marker.ROOF))
    )
    uneven = np.abs(area - roof) > RELATIVE_TOLERANCE * np.maximum(area, roof)
    middle = surface.corners.mean(axis=1)[np.isin(row, np.flatnonzero(uneven)) & chosen]
    faults = [
        *find_faults(
            "foundation-over-terrain", points[~(over <= HEIGHT_TOLERANCE)], f"{worst:.3g} m above the terrain"
        ),
        *find_faults(
            "foundation-area", middle, "the plan area of a building's foundation is not that of its roof"
        ),
    ]
    if uneven.any() and not len(middle):
        roofs = surface.corners.mean(axis=1)[np.isin(row, np.flatnonzero(uneven))]
        faults += find_faults("foundation-area", roofs[:1], "a building with a roof, but without a foundation")
    wrong = ~(surface.area > 0) if up else ~(surface.area < 0)
    faults += _find_turned(surface, chosen & wrong, "foundation", "up" if up else "down")
    lowered = int((over < -HEIGHT_TOLERANCE).sum())
    return Finding(tuple(faults), {"facets": int(chosen.sum()), "area": float(area.sum()), "lowered": lowered})


def prove_foundations(found: Finding) -> Proof:
    """Tell how large foundations are, and in how many places roofs press them below the terrain."""
    facets, lowered = int(found.sums["facets"]), int(found.sums["lowered"])
    claim = (
        f"{facets} foundation facets, {found.sums['area']:.2f} m², lie on the terrain under their buildings' roofs"
    )
    if lowered:
        claim += f", in {lowered} places below it, as it reaches a roof there"
    return Proof(claim, found.faults)


def check_soil_sizes(surface: Surface, cells: float) -> Finding:
    """Measure plan areas and volumes of the soil; `cells` is the volume of its cells (m³)."""
    ground, foundation, bottom = (
        surface.marked(marker) for marker in (Marker.GROUND, Marker.FOUNDATION, Marker.BOTTOM)
    )
    area, volume = surface.area, surface.volume
    sums = {
        "tops": area[foundation].sum() - area[ground].sum(),
        "bottom": -area[bottom].sum(),
        "soil": volume[foundation].sum() - volume[ground].sum() + volume[bottom].sum(),
        "cells": cells,
    }
    return Finding(sums={name: float(value) for name, value in sums.items()})


def prove_soil_sizes(found: Finding, air: Finding) -> Proof:
    """The soil fills what is below ground and foundations; these and the bottom cover what the top covers."""
    tops, bottom, soil, cells = (found.sums[name] for name in ("tops", "bottom", "soil", "cells"))
    top, total = air.sums["top"], air.sums["cells"] + cells
    claim = (
        f"soil: plan areas of ground and foundations {tops:.6f}, bottom {bottom:.6f} m²; volumes: "
        f"cells {cells:.6f}, between its top and bottom {soil:.6f} m³, with the air {total:.6f} m³"
    )
    faults = (
        *unless_equal("soil-area", claim, top, tops, bottom),
        *unless_equal("soil-volume", claim, soil, cells),
    )
    return Proof(claim, faults)


def check_building_cells(surface: Surface, cells: float, places: Vertices, buildings: Buildings) -> Finding:
    """Measure the volume under roofs, and find cells of buildings beyond all footprints.

    Parameters
    ----------
    cells : float
        Volume of its cells of buildings (m³).
    places : float64, (k, 3)
        Where these are: one place in the plan for all that stand over one triangle of it (m).
    buildings : Buildings
        The city model's buildings around the piece.
    """
    height = np.sign(surface.area) * surface.volume
    under = height[surface.marked(Marker.ROOF)].sum() - height[surface.marked(Marker.FOUNDATION)].sum()
    within = np.zeros(len(places), np.bool_)
    points = shapely.points(places[:, :2])
    within[buildings.tree.query(points, predicate="dwithin", distance=OUTLINE_TOLERANCE)[0]] = True
    faults = find_faults("building-cell-astray", places[~within], "a cell of a building beyond all footprints")
    return Finding(tuple(faults), {"cells": cells, "under": float(under), "places": len(places)})


def prove_building_cells(found: Finding) -> Proof:
    """The cells of buildings fill what is between roofs and foundations, within footprints."""
    cells, under = found.sums["cells"], found.sums["under"]
    claim = (
        f"buildings: cells over {int(found.sums['places'])} triangles of the plan, all in footprints; volumes: "
        f"cells {cells:.6f}, under roofs and above foundations {under:.6f} m³"
    )
    return Proof(claim, (*found.faults, *unless_equal("building-volume", claim, under, cells)))


def _find_turned(surface: Surface, wrong: Mask, name: str, way: str) -> list[Fault]:
    places = surface.corners[wrong].mean(axis=1)
    return find_faults("facet-direction", places, f"a {name} facet that does not face {way}")
