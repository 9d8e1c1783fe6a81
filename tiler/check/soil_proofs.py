"""The proofs of `citystitch check` below ground: the ground inside, bottom, foundations, volume of the soil."""

import numpy as np
from numpy.typing import NDArray

from pipeline.data.mesh import Marker
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


def check_between(points: Vertices, ground: NDArray[np.int32], between: NDArray[np.int32]) -> Finding:
    """The ground is what cells of air and of soil share.

    Parameters
    ----------
    points : float64, (n, 3)
        Points of a piece's surface (m).
    ground : int32, (g, 3)
        Facets marked as ground in the boundary file.
    between : int32, (k, 3)
        Faces that a cell of air and one of soil have, pointing out of the air.
    """
    match = conformity.match_facets(between, ground)
    lists = [
        ("ground-missing", between[match.missing], "a face between air and soil that is not marked as ground"),
        ("ground-one-sided", ground[match.extra], "a ground facet without air on one side and soil on the other"),
        ("ground-flipped", ground[match.flipped], "a ground facet that points out of the soil"),
        ("ground-duplicate", ground[match.duplicate], "a ground facet is there twice"),
    ]
    faults = [fault for kind, rows, why in lists for fault in find_faults(kind, centres_of(points, rows), why)]
    return Finding(merge_faults(faults), {"ground": len(ground), "between": len(between)})


def prove_between(found: Finding) -> Proof:
    """Tell whether air and soil meet in the ground alone."""
    ground, between = int(found.sums["ground"]), int(found.sums["between"])
    claim = (
        f"the {ground} ground facets are the {between} faces between air and soil, air above, soil below, bitwise"
    )
    return Proof(claim, found.faults)


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


def check_foundations(surface: Surface, dtm: Dtm) -> Finding:
    """Foundations lie under the roofs of their buildings, on the terrain or below it."""
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
    faults += _find_turned(surface, chosen & ~(surface.area > 0), "foundation", "up")
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


def _find_turned(surface: Surface, wrong: Mask, name: str, way: str) -> list[Fault]:
    places = surface.corners[wrong].mean(axis=1)
    return find_faults("facet-direction", places, f"a {name} facet that does not face {way}")
