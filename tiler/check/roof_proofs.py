"""How high roofs and walls may stand, for `citystitch check`: on the planes of the city model, or near them.

Inside its outline a roof lies on its plane, to the bit. At the outline the mesher moves it where it must: roofs
that meet there are joined or parted by a step at most, and a roof stands some way above the terrain at its walls.
At few vertices of outlines it is moved a little for the sake of cells, too: by how much, the boundary file tells.
"""

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.data.roofs import roof_heights
from stitch.pieces.frontier import group_places
from tiler.check.proofs import HEIGHT_TOLERANCE, Dtm, Finding, Mask, Vertices, at_most, find_faults
from tiler.store.run_folder import Buildings, RoofRules

OUTLINE_TOLERANCE = 2e-3  # m, in the plane: CityJSON rounds coordinates to 1 mm


@dataclass(frozen=True, eq=False)
class RoofRange:
    """Between which heights roofs may stand at ``k`` places."""

    #: (k,): heights (m); equal where a roof must lie on its plane. NaN where no building is
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    #: (k,): whether a roof may be moved there by `RoofRules.slack` besides: at outlines, where roofs slope
    edge: NDArray[np.bool_]


def find_roof_range(xy: NDArray[np.float64], buildings: Buildings, dtm: Dtm, rules: RoofRules) -> RoofRange:
    """Find between which heights roofs may stand at places (k, 2).

    Parameters
    ----------
    xy : float64, (k, 2)
        Places (m).
    buildings : Buildings
        All buildings that touch one of them.
    rules : RoofRules
        How far roofs may be moved at outlines.
    """
    low, high, edge = np.full(len(xy), np.nan), np.full(len(xy), np.nan), np.zeros(len(xy), np.bool_)
    points = shapely.points(xy)
    place, row = buildings.tree.query(points, predicate="dwithin", distance=OUTLINE_TOLERANCE)
    if not len(place):
        return RoofRange(low, high, edge)
    z = roof_heights(buildings.roofs, row.astype(np.int64), xy[place])
    np.fmin.at(low, place, z)
    np.fmax.at(high, place, z)
    if not rules.sloped:
        return RoofRange(low, high, edge)
    others = (np.bincount(place, minlength=len(xy)) - 1).astype(np.float64)
    outline = shapely.boundary(buildings.footprints)
    shapely.prepare(outline)
    edge[place[shapely.dwithin(outline[row], points[place], OUTLINE_TOLERANCE)]] = True
    at = np.flatnonzero(edge)
    least = dtm.sample(xy[at]) + rules.clearance + others[at] * rules.step
    down, up = _find_moves(others[at], high[at] - low[at], rules)
    low[at] -= down
    high[at] = np.fmax(high[at] + up, least)
    return RoofRange(low, high, edge)


def _find_moves(
    others: NDArray[np.float64], spread: NDArray[np.float64], rules: RoofRules
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """How far the lowest roof may be moved down, and the highest one up (m), where so many others meet one.

    Roofs within half of the least step become one. Two roofs less than a step apart are parted to it, both by the
    same way; where the least distance of nodes is more than a step may be, the upper one has to give all of it.
    """
    apart = np.where(others == 1, np.maximum(rules.step - spread, 0), others * rules.step)
    apart = np.where((others == 0) | (spread < rules.joined), 0.0, apart)
    return apart / 2, apart if rules.lifts else apart / 2


def check_roof_heights(
    corners: Vertices,
    moved: NDArray[np.float64],
    row: NDArray[np.int64],
    buildings: Buildings,
    dtm: Dtm,
    rules: RoofRules,
) -> Finding:
    """Roof facets lie on the planes of their buildings, or at outlines in the range that is left to the mesher.

    Parameters
    ----------
    corners : float64, (k, 3, 3)
        Roof facets (m).
    moved : float64, (k, 3)
        By how much their corners are said to be moved for the sake of cells (m).
    row : int64, (k,)
        Row of the building of each.
    buildings, dtm, rules
        As in `find_roof_range`.
    """
    places, index = group_places(corners.reshape(-1, 3))
    allowed = find_roof_range(places, buildings, dtm, rules)
    way = moved.ravel()
    z, plane = corners[:, :, 2].ravel() - way, roof_heights(buildings.roofs, np.repeat(row, 3), places[index])
    fixed = allowed.low[index] == allowed.high[index]
    off_plane = ~(np.abs(z - plane) <= HEIGHT_TOLERANCE)
    too_far = ~(np.abs(way) <= np.where(allowed.edge[index], rules.slack, 0.0))
    wrong = too_far | np.where(fixed | (not rules.sloped), off_plane, _is_beyond(z, allowed, index))
    error = np.abs(z + way - plane)
    off = wrong.reshape(-1, 3).any(axis=1)
    centres = corners.mean(axis=1)
    worst = float(error[wrong].max(initial=0))
    faults = find_faults("roof-height", centres[off], f"{worst:.3g} m off; {at_most(HEIGHT_TOLERANCE)}")
    displaced = error > HEIGHT_TOLERANCE
    return Finding(
        tuple(faults),
        {"facets": len(corners), "corners": len(z), "moved": int(displaced.sum())},
        {"worst": worst, "largest move": float(error[~wrong].max(initial=0))},
    )


def are_above_roofs(
    corners: Vertices,
    moved: NDArray[np.float64],
    row: NDArray[np.int64],
    buildings: Buildings,
    dtm: Dtm,
    rules: RoofRules,
) -> Mask:
    """Tell which wall facets (k, 3, 3) rise above the roof of their building, bool (k,).

    Where a roof was `moved` (k, 3) for the sake of cells (m), it counts as if it were not. Beside sloped roofs the
    highest corner at a place is held to them: free levels of the wall below a roof that was moved up are no roof.
    """
    z, way = corners[:, :, 2], np.clip(moved, -rules.slack, rules.slack)
    if rules.sloped:
        places, index = group_places(corners.reshape(-1, 3))
        highest = find_roof_range(places, buildings, dtm, rules).high + HEIGHT_TOLERANCE
        order = np.lexsort((z.ravel(), index))
        top = order[np.searchsorted(index[order], np.arange(len(places)), side="right") - 1]
        fits = z.ravel()[top] - way.ravel()[top] <= highest
        low = (fits[index] | (z.ravel() <= highest[index])).reshape(-1, 3)
    else:
        low = z - way <= buildings.roof[row][:, None] + HEIGHT_TOLERANCE
    above: Mask = ~np.all(low, axis=1)
    return above


def _is_beyond(z: NDArray[np.float64], allowed: RoofRange, index: NDArray[np.int64]) -> Mask:
    within: Mask = (z >= allowed.low[index] - HEIGHT_TOLERANCE) & (z <= allowed.high[index] + HEIGHT_TOLERANCE)
    return ~within
