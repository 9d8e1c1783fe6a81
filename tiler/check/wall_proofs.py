"""The proof of `citystitch check` that no wall is there twice: all facets over an edge of the plan face one way.

Where both sides of a wall have facets above its top edge, these overlap: a baffle in the air. It is closed and
without volume, so that no other proof finds it.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.data.mesh import Marker
from stitch.pieces.conformity import group_rows
from tiler.check.proofs import Finding, Mask, Proof, Surface, Vertices, find_faults

OVERLAP = 1e-9  # of the area of walls over an edge: what may be there twice


@dataclass(frozen=True, eq=False)
class Walls:
    """Walls over ``e`` edges of the plan."""

    ends: NDArray[np.float64]  #: (e, 2, 2): the edges (m), each once, with the smaller end first
    #: (e, 2): area of the facets that face to the left of the edge, and of those that face to the right (m²)
    area: NDArray[np.float64]
    top: NDArray[np.float64]  #: (e,): highest corner (m)


def no_walls() -> Walls:
    """Give no wall."""
    return Walls(np.empty((0, 2, 2)), np.empty((0, 2)), np.empty(0))


def measure_walls(corners: Vertices) -> Walls:
    """Measure wall facets (k, 3, 3) by the edges that they stand on; those that stand on none are left out."""
    xy, z = corners[:, :, :2], corners[:, :, 2]
    order = np.lexsort((xy[:, :, 1], xy[:, :, 0]))
    first, last = (np.take_along_axis(xy, order[:, k, None, None], axis=1)[:, 0] for k in (0, 2))
    at_first, at_last = (xy == first[:, None]).all(axis=2), (xy == last[:, None]).all(axis=2)
    upright = (at_first | at_last).all(axis=1) & (first != last).any(axis=1)
    first, last, at_last, z = first[upright], last[upright], at_last[upright], z[upright]
    along = np.where(at_last, np.hypot(*(last - first).T)[:, None], 0.0)
    across = (along[:, 1] - along[:, 0]) * (z[:, 2] - z[:, 0]) - (along[:, 2] - along[:, 0]) * (z[:, 1] - z[:, 0])
    area = np.column_stack((np.maximum(-across, 0), np.maximum(across, 0))) / 2
    return _group(np.stack((first, last), axis=1), area, z.max(axis=1, initial=-np.inf))


def join_walls(one: Walls, two: Walls) -> Walls:
    """Join the walls of two pieces: over an edge that both have, areas add up."""
    return _group(
        np.concatenate((one.ends, two.ends)), np.concatenate((one.area, two.area)), np.append(one.top, two.top)
    )


def check_overlap(walls: Walls) -> Finding:
    """All walls over an edge face one way."""
    total, twice = walls.area.sum(axis=1), walls.area.min(axis=1)
    wrong = ~(twice <= OVERLAP * total)
    places = np.column_stack((walls.ends[wrong].mean(axis=1), walls.top[wrong]))
    detail = f"{twice[wrong].sum():.3g} m² are there from both sides; bound: none"
    faults = find_faults("wall-twice", places, detail)
    return Finding(tuple(faults), {"edges": len(total), "area": float(total.sum())})


def split_walls(surface: Surface, on_rim: Mask) -> tuple[Walls, Walls]:
    """Measure the walls of a piece: those within it, and those over its rim, where another piece may have more."""
    facets = surface.boundary.facets[surface.marked(Marker.WALL)]
    over = on_rim[facets].all(axis=1)
    return measure_walls(surface.points[facets[~over]]), measure_walls(surface.points[facets[over]])


def prove_overlap(found: Finding) -> Proof:
    """Tell how much wall there is."""
    edges, area = int(found.sums["edges"]), found.sums["area"]
    return Proof(
        f"walls face one way over each of {edges} edges of the plan: {area:.2f} m², none twice", found.faults
    )


def _group(ends: NDArray[np.float64], area: NDArray[np.float64], top: NDArray[np.float64]) -> Walls:
    index, n = group_rows(ends.reshape(-1, 4))
    rows = np.empty((n, 4))
    rows[index] = ends.reshape(-1, 4)
    sums = np.column_stack([np.bincount(index, area[:, k], n) for k in (0, 1)]).astype(np.float64)
    highest = np.full(n, -np.inf)
    np.maximum.at(highest, index, top)
    return Walls(rows.reshape(-1, 2, 2), sums.reshape(-1, 2), highest)
