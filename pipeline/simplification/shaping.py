"""Shape clusters of houses: rounds, labels, corners, the check, and what follows a failure (step 2.1, our way)."""

from collections import Counter
from dataclasses import dataclass, replace

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.data.roofs import Roofs
from pipeline.simplification.corners import find_touches, mend_corners
from pipeline.simplification.graph import (
    Faces,
    WallGraph,
    find_close,
    find_crossings,
    find_near,
    node_walls,
    trace_faces,
)
from pipeline.simplification.labels import OPEN, Territories, claim_ground, dissolve, drop_small_faces, label_faces
from pipeline.simplification.snap import settle
from pipeline.simplification.square_cells import draw_cells

# Clearances to try, as multiples of the one asked for; square cells come after the last.
RUNGS = {"snapped": 1.0, "snapped-wider": 1.5}
LAST_RUNG = "cells"
# How often a cluster may settle, be labelled and have its corners mended.
MAX_PASSES = 6


@dataclass(frozen=True)
class Rules:
    """What `shape_clusters` has to keep."""

    #: lengths (mm), see `pipeline.simplification.snap.settle`
    clearance: float
    chain_tolerance: float
    #: areas (mm²), see `pipeline.simplification.labels.drop_small_faces`
    min_area: float
    min_courtyard_area: float
    manifold: bool  #: whether corners in which houses only touch are opened or closed
    least_moved: bool = False  #: whether the walls that stay are those that others reach over least ground


@dataclass(frozen=True, eq=False)
class Shaped:
    """Clusters with clearance."""

    polygons: NDArray[np.object_]  #: (k,): faces that belong to houses (mm)
    #: (k,): house and cluster of each
    house: NDArray[np.int64]
    cluster: NDArray[np.int64]
    touches: NDArray[np.int64]  #: (t,): cluster of each vertex in which houses only touch
    method: dict[int, str]  #: the rung that each cluster ended on

    def leave_out(self, clusters: NDArray[np.int64]) -> "Shaped":
        """Forget some clusters."""
        stays = ~np.isin(self.cluster, clusters)
        return Shaped(
            self.polygons[stays],
            self.house[stays],
            self.cluster[stays],
            self.touches[~np.isin(self.touches, clusters)],
            {name: how for name, how in self.method.items() if name not in clusters},
        )


def join_shaped(pieces: list[Shaped]) -> Shaped:
    """Put pieces of different clusters together."""
    nothing = np.zeros(0, np.int64)
    return Shaped(
        np.concatenate([np.zeros(0, object), *(piece.polygons for piece in pieces)]),
        np.concatenate([nothing, *(piece.house for piece in pieces)]),
        np.concatenate([nothing, *(piece.cluster for piece in pieces)]),
        np.concatenate([nothing, *(piece.touches for piece in pieces)]),
        {name: how for piece in pieces for name, how in piece.method.items()},
    )


def shape_clusters(
    houses: NDArray[np.object_], cluster: NDArray[np.int64], rules: Rules, roofs: Roofs | None = None
) -> tuple[Shaped, Territories, Counter[str]]:
    """Shape the houses of some clusters, each by the first rung that keeps the rules.

    Parameters
    ----------
    houses : object, (n,)
        Valid shapely Polygons (mm), in an order that depends on them alone.
    cluster : int64, (n,)
        Their clusters, -1 for houses to leave out.
    roofs : Roofs, optional
        Known roofs of the houses, as for `claim_ground`.

    Returns
    -------
    shaped : Shaped
        All clusters named in ``cluster``.
    territories : Territories
        The ground of each house before walls are moved.
    counts : Counter
        What `settle` and `mend_corners` did, and ``"small-faces"`` given away.

    Notes
    -----
    A cluster fails on a rung if it does not settle, or if the check of its final walls finds a distance below the
    clearance, a crossing, an invalid face, a corner in which houses only touch where there must be none, or
    more area gained or lost than a clearance along all walls and a small courtyard a house. The last rung
    cannot fail.
    """
    mine = cluster >= 0
    walls, territories = claim_ground(node_walls(houses[mine], cluster[mine]), houses, cluster, roofs)
    left = np.unique(cluster[mine])
    pieces: list[Shaped] = []
    counts = Counter[str]()
    for method, factor in RUNGS.items():
        wider = replace(rules, clearance=rules.clearance * factor)
        outcomes, restless = _run_passes(
            walls.keep(np.isin(walls.edge_clusters(), left)), territories, wider, counts
        )
        broken = [restless, *(_find_broken(outcome, territories, rules) for outcome in outcomes)]
        failed = np.unique(np.concatenate(broken))
        pieces.extend(_collect(outcome).leave_out(failed) for outcome in outcomes)
        pieces.append(_name(np.setdiff1d(left, failed), method))
        left = failed
    size = float(np.ceil(rules.clearance))
    pieces.extend(_collect(Outcome(*draw_cells(territories, int(name), size))) for name in left)
    return join_shaped([*pieces, _name(left, LAST_RUNG)]), territories, counts


@dataclass(frozen=True, eq=False)
class Outcome:
    """Settled walls, their faces, and the house of each face or `OPEN`."""

    graph: WallGraph
    faces: Faces
    label: NDArray[np.int64]

    def select(self, clusters: NDArray[np.int64]) -> "Outcome":
        """Take some clusters."""
        edges = np.isin(self.graph.edge_clusters(), clusters)
        faces = np.isin(self.faces.cluster, clusters)
        number = np.append(np.cumsum(faces) - 1, -1)
        sides = number[self.faces.sides[edges]]
        picked = Faces(self.faces.polygons[faces], self.faces.cluster[faces], sides)
        return Outcome(self.graph.keep(edges), picked, self.label[faces])


def _run_passes(
    graph: WallGraph, territories: Territories, rules: Rules, counts: Counter[str]
) -> tuple[list[Outcome], NDArray[np.int64]]:
    """Settle, label and mend until nothing changes; give the ends of all clusters, and those without one."""
    outcomes = []
    restless = [np.zeros(0, np.int64)]
    for last in [False] * (MAX_PASSES - 1) + [True]:
        graph, unsettled, done = settle(
            graph,
            clearance=rules.clearance,
            chain_tolerance=rules.chain_tolerance,
            least_moved=rules.least_moved,
        )
        add_counts(counts, done)
        restless.append(unsettled)
        graph = graph.keep(~np.isin(graph.edge_clusters(), unsettled))
        dressed = _dress(graph, territories, rules, counts)
        changed = _find_changed(graph, dressed.graph)
        graph = dressed.graph
        if not last:
            graph, cut, done = mend_corners(
                graph, dressed.faces, dressed.label, clearance=rules.clearance, manifold=rules.manifold
            )
            add_counts(counts, done)
            changed = np.union1d(changed, cut)
        else:
            changed = changed[:0]
        outcomes.append(dressed.select(np.setdiff1d(dressed.graph.cluster, changed)))
        graph = graph.keep(np.isin(graph.edge_clusters(), changed))
        if not len(graph.edges):
            break
    return outcomes, np.concatenate(restless)


def _dress(graph: WallGraph, territories: Territories, rules: Rules, counts: Counter[str]) -> Outcome:
    """Label the faces, give small ones away, and drop the walls that this makes needless."""
    faces = trace_faces(graph)
    graph, faces, label = dissolve(graph, faces, label_faces(faces, territories))
    changed = drop_small_faces(
        graph, faces, label, min_area=rules.min_area, min_courtyard_area=rules.min_courtyard_area
    )
    counts["small-faces"] += int((changed != label).sum())
    return Outcome(*dissolve(graph, faces, changed))


def _find_changed(before: WallGraph, after: WallGraph) -> NDArray[np.int64]:
    """Find the clusters that lost a wall."""
    names, count = np.unique(before.edge_clusters(), return_counts=True)
    left, rest = np.unique(after.edge_clusters(), return_counts=True)
    count[np.searchsorted(names, left)] -= rest
    return names[count > 0]


def _find_broken(outcome: Outcome, territories: Territories, rules: Rules) -> NDArray[np.int64]:
    """Find the clusters that break a promise."""
    graph, faces = outcome.graph, outcome.faces
    (near, _), _ = find_near(graph, rules.clearance)
    (vertex, _), _ = find_close(graph, rules.clearance)
    crossing, _ = find_crossings(graph)
    built = outcome.label != OPEN
    n_clusters = 1 + max(territories.cluster.max(initial=-1), faces.cluster.max(initial=-1))
    owned = np.bincount(territories.cluster, shapely.area(territories.polygons), n_clusters)
    length = np.bincount(territories.cluster, shapely.length(territories.polygons), n_clusters)
    got = np.bincount(faces.cluster[built], shapely.area(faces.polygons[built]), n_clusters)
    allowed = rules.clearance * length + rules.min_courtyard_area * np.bincount(
        territories.cluster, minlength=n_clusters
    )
    off = np.flatnonzero(np.abs(got - owned) > allowed)
    broken = (
        graph.cluster[near],
        graph.cluster[vertex],
        graph.edge_clusters()[crossing],
        faces.cluster[built & ~shapely.is_valid(faces.polygons)],
        np.intersect1d(off, faces.cluster),
        graph.cluster[find_touches(graph, faces, outcome.label)] if rules.manifold else off[:0],
    )
    return np.unique(np.concatenate(broken))


def _collect(outcome: Outcome) -> Shaped:
    built = outcome.label != OPEN
    touches = outcome.graph.cluster[find_touches(outcome.graph, outcome.faces, outcome.label)]
    polygons, cluster = outcome.faces.polygons[built], outcome.faces.cluster[built]
    return Shaped(polygons, outcome.label[built], cluster, touches, {})


def _name(clusters: NDArray[np.int64], method: str) -> Shaped:
    nothing = np.zeros(0, np.int64)
    names = {int(cluster): method for cluster in clusters}
    return Shaped(np.zeros(0, object), nothing, nothing, nothing, names)


def add_counts(counts: Counter[str], done: Counter[str]) -> None:
    """Add up what was done; of rounds, the most count."""
    rounds = max(counts["rounds"], done["rounds"])
    counts.update(done)
    counts["rounds"] = rounds
