"""Proofs of a padded region: the ground is level along the outer sides, and no house stands in the pad."""

import numpy as np

from pipeline.data.mesh import Marker
from tiler.check.proofs import (
    HEIGHT_TOLERANCE,
    SIDE_TOLERANCE,
    Bounds,
    Finding,
    Proof,
    Surface,
    Vertices,
    at_most,
    find_faults,
)


def check_level(ground: Vertices, bounds: Bounds, core: Bounds, rim: float) -> Finding:
    """The ground's vertices (n, 3) on the outer sides of the pad lie at one height.

    Parameters
    ----------
    ground : float64, (n, 3)
        Vertices of the ground (m).
    bounds, core : (west, south, east, north)
        Region with and without its pad (m).
    rim : float
        Height that the run states (m).
    """
    outer = np.zeros(len(ground), np.bool_)
    for k, (side, inner) in enumerate(zip(bounds, core, strict=True)):
        if abs(side - inner) > SIDE_TOLERANCE:
            outer |= np.abs(ground[:, k % 2] - side) <= SIDE_TOLERANCE
    error = np.where(outer, np.abs(ground[:, 2] - rim), 0.0)
    worst = float(error.max(initial=0.0))
    off = ~(error <= HEIGHT_TOLERANCE)
    detail = f"{worst:.3g} m off the height of the rim, {rim:.6f} m; {at_most(HEIGHT_TOLERANCE)}"
    faults = find_faults("rim-uneven", ground[off], detail)
    return Finding(tuple(faults), {"vertices": int(outer.sum())}, {"worst": worst})


def check_houses(surface: Surface, core: Bounds) -> Finding:
    """No house of a piece's boundary is in the pad, outside of `core` (m)."""
    corners = surface.corners[surface.marked(Marker.ROOF, Marker.WALL)]
    low, high = np.array(core[:2]) - SIDE_TOLERANCE, np.array(core[2:]) + SIDE_TOLERANCE
    beyond = ((corners[:, :, :2] < low) | (corners[:, :, :2] > high)).any(axis=(1, 2))
    return Finding(tuple(find_faults("house-in-pad", corners[beyond].mean(axis=1), f"outside the region {core}")))


def prove_pad(found: Finding, core: Bounds, rim: float) -> Proof:
    """Tell how level the ground is along the outer sides of the pad."""
    count, worst = int(found.sums["vertices"]), found.largest["worst"]
    west, south, east, north = core
    claim = (
        f"{count} ground vertices on the outer sides of the pad lie at {rim:.6f} m, worst {worst:.2g} m; no roof "
        f"or wall outside the region {west:.3f} {south:.3f} {east:.3f} {north:.3f}"
    )
    return Proof(claim, found.faults)
