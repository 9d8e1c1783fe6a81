"""The proof of `citystitch check` on land cover: each ground facet is of the patch that polygons have there."""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from pipeline.data.mesh import Marker
from tiler.check.proofs import (
    CELLS_AT_ONCE,
    HEIGHT_TOLERANCE,
    Finding,
    Proof,
    Surface,
    Vertices,
    at_most,
    find_faults,
    join_findings,
    merge_faults,
)
from tiler.store.run_folder import PATCH_OF_GROUND, GroundPatch

PatchesAt = Callable[[NDArray[np.float64]], NDArray[np.int8]]  # patch of the ground at places (n, 2)
DensityAt = Callable[[NDArray[np.float64]], NDArray[np.float32]]  # leaf area density (m2/m3) at places (n, 3)


def check_cover(
    surface: Surface, patch: NDArray[np.int8] | None, ground: Sequence[GroundPatch], patches_at: PatchesAt
) -> Finding:
    """Each ground facet has the patch of its centre, one of the record's, and no other facet has one.

    Parameters
    ----------
    patch : int8, (k,), or None
        Patch of each facet as the piece's file has it.
    ground : sequence of GroundPatch
        Patches of the record, by number.
    patches_at : callable
        Gives the patch at places by the polygons of all tiles, so that both sides of a seam are held to the same.
    """
    is_ground, centre = surface.marked(Marker.GROUND), surface.corners.mean(axis=1)
    if patch is None or patch.dtype != np.int8 or patch.shape != is_ground.shape:
        detail = f"the boundary has no cell array {PATCH_OF_GROUND} of int8"
        return Finding(merge_faults(find_faults("patch-missing", centre[:1], detail)))
    known = (patch >= 0) & (patch < len(ground))
    wanted = np.full(len(patch), -1, np.int8)
    # The centre as the mesher has it: of vertices that ascend by (x, y), added in that order.
    corners = surface.corners[is_ground, :, :2]
    order = np.lexsort((corners[:, :, 1], corners[:, :, 0]))
    a, b, c = (np.take_along_axis(corners, order[:, k, None, None], axis=1)[:, 0] for k in range(3))
    wanted[is_ground] = patches_at((a + b + c) / 3)
    faults = [
        *find_faults("patch-unknown", centre[is_ground & ~known], f"numbers are 0 to {len(ground) - 1}"),
        *find_faults(
            "patch-elsewhere", centre[~is_ground & (patch != -1)], "a facet that is no ground has a patch"
        ),
        *find_faults(
            "patch-wrong", centre[is_ground & known & (patch != wanted)], "the polygons have another here"
        ),
    ]
    area = np.bincount(patch[is_ground & known], np.abs(surface.area)[is_ground & known], len(ground))
    return Finding(
        merge_faults(faults),
        {"facets": int(is_ground.sum())} | {row.name: float(area[k]) for k, row in enumerate(ground)},
    )


def check_levels(ground: Vertices, level: NDArray[np.float64]) -> Finding:
    """The ground's vertices (n, 3) in a body of water are at its level (m), one for all tiles; NaN is no water."""
    error = np.abs(ground[:, 2] - level)
    wrong = ~np.isnan(level) & ~(error <= HEIGHT_TOLERANCE)
    worst = float(np.nanmax(error, initial=0.0))
    detail = f"{worst:.3g} m off the level of its body of water; {at_most(HEIGHT_TOLERANCE)}"
    faults = find_faults("water-uneven", ground[wrong], detail)
    return Finding(merge_faults(faults), {"vertices": int((~np.isnan(level)).sum())}, {"worst": worst})


def prove_levels(found: Finding) -> Proof:
    """Tell how level water is."""
    claim = f"{int(found.sums['vertices'])} ground vertices in water are at the one level of their body, worst "
    return Proof(claim + f"{found.largest['worst']:.2g} m", found.faults)


def check_leaves(
    points: Vertices, cells: NDArray[np.int32], leaves: NDArray[np.float32], density_at: DensityAt
) -> Finding:
    """Each cell (m, 4) has the leaf area density of the canopy at its middle, 0 where there is none."""
    found = Finding(sums={"cells": 0, "volume": 0.0})
    for start in range(0, len(cells), CELLS_AT_ONCE):
        rows = slice(start, start + CELLS_AT_ONCE)
        found = join_findings(found, _check_leaves(points, cells[rows], leaves[rows], density_at))
    return found


def _check_leaves(
    points: Vertices, cells: NDArray[np.int32], leaves: NDArray[np.float32], density_at: DensityAt
) -> Finding:
    a, b, c, d = (points[cells[:, k]] for k in range(4))
    middle = (a + b + c + d) / 4
    wrong = leaves != density_at(middle)
    faults = find_faults("leaves-elsewhere", middle[wrong], "the canopy has another leaf area density here")
    volume = np.abs(np.linalg.det(np.stack((b - a, c - a, d - a), axis=1)[leaves > 0])).sum() / 6
    return Finding(merge_faults(faults), {"cells": int((leaves > 0).sum()), "volume": float(volume)})


def prove_leaves(found: Finding) -> Proof:
    """Tell how much of the air is between leaves."""
    cells, volume = int(found.sums["cells"]), found.sums["volume"]
    claim = (
        f"{cells} cells of {volume:.1f} m³ are between leaves: all have the density of the canopy at their middle"
    )
    return Proof(claim, found.faults)


def prove_cover(found: Finding, ground: Sequence[GroundPatch]) -> Proof:
    """Tell how much ground is of each patch."""
    areas = [f"{row.name} {found.sums[row.name]:.1f} m²" for row in ground if found.sums.get(row.name)]
    claim = f"each of {int(found.sums.get('facets', 0))} ground facets is of the patch at its centre: "
    return Proof(claim + ", ".join(areas), found.faults)
