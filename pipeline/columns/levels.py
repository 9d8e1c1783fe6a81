"""The levels between the nodes of a column: evenly spaced, shifted against the neighbours (our steps 3.2-3.4)."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pipeline.columns.growth import Growth, count_steps, height_of_steps, stagger_weight
from pipeline.columns.nodes import TOP_LEVEL, Levels, Nodes, SeamColumns, bare_levels
from pipeline.data.kernel import kernel

N_PHASES = 3
PHASE_SWEEPS = 12


def fill_levels(
    nodes: Nodes,
    top: NDArray[np.float64],
    spacing: NDArray[np.float64],
    shift: NDArray[np.float64],
    seam: SeamColumns,
    *,
    ground: NDArray[np.float64] | None = None,
    growth: Growth | None = None,
) -> tuple[Levels, NDArray[np.int32]]:
    """Space levels evenly between the nodes of each column and up to its top.

    Parameters
    ----------
    nodes : Nodes
        Given heights.
    top : float64, (n,)
        Top of the domain (m), above the last node.
    spacing : float64, (n,)
        Wanted distance of levels (m); the closest whole number of steps is made, at least one.
    shift : float64, (n,)
        By which part of a step, between -1/2 and 1/2, the levels between two nodes are shifted.
    seam : SeamColumns
        Columns that are given: copied bit for bit.
    ground : float64, (n,), optional
        Terrain in each column (m), under buildings too; needed with `growth`.
    growth : Growth, optional
        Levels follow the steps that grow with the height above the ground, up to `spacing`; between two nodes all
        are stretched or squeezed by the same part of a step. Shifts fade out towards the ground.

    Returns
    -------
    Levels
        The columns, without their surfaces.
    int32, (m, 3)
        For each corner of a triangle, the level of its column where its cells begin.
    """
    given = np.full(len(top), -1, np.int64)
    given[seam.vertex] = np.arange(len(seam.vertex))
    # Heights count from the ground, or from the lowest node where that is still lower.
    base = nodes.z[nodes.start[:-1]] if ground is None else np.minimum(ground, nodes.z[nodes.start[:-1]])
    first, ratio = (growth.first, growth.ratio) if growth else (0.0, 1.0)
    law = (base, first, ratio)
    steps, start = _count_levels(nodes.start, nodes.z, top, spacing, *law, given, seam.levels.start)
    z, kind = np.empty(start[-1]), np.zeros(start[-1], np.int8)
    level = nodes.level.copy()
    _fill(
        nodes.start, nodes.kind, nodes.z, top, spacing, *law, shift, steps,
        given, seam.levels.start, seam.levels.z, seam.levels.kind,
        start, z, kind, level,
    )  # fmt: skip
    return replace(bare_levels(start, z), kind=kind), level[nodes.of_corner]


def stagger_columns(n: int, edges: NDArray[np.int32]) -> NDArray[np.float64]:
    """Give neighbouring columns different thirds of a step, as far as three values can.

    Parameters
    ----------
    n : int
        Number of columns.
    edges : int32, (e, 2)
        Edges of the plane mesh.

    Returns
    -------
    float64, (n,)
        -1/3, 0 or 1/3.

    Notes
    -----
    A vertex takes, in turns, the value that the fewest of its neighbours have. Whole numbers only: the
    result is the same on every machine.
    """
    both = np.concatenate((edges, edges[:, ::-1]))
    both = both[np.argsort(both[:, 0], kind="stable")]
    start = np.searchsorted(both[:, 0], np.arange(n + 1)).astype(np.int64)
    phase = (np.arange(n) % N_PHASES).astype(np.int8)
    _repel_phases(start, np.ascontiguousarray(both[:, 1]), phase, PHASE_SWEEPS)
    shift: NDArray[np.float64] = (phase - 1.0) / N_PHASES
    return shift


@kernel
def _count_levels(
    node_start: NDArray[np.int64],
    node_z: NDArray[np.float64],
    top: NDArray[np.float64],
    spacing: NDArray[np.float64],
    base: NDArray[np.float64],
    first: float,
    ratio: float,
    given: NDArray[np.int64],
    seam_start: NDArray[np.int64],
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Steps above each node, and the first level of each column. A `first` layer of 0 stands for no growth."""
    n = len(top)
    steps = np.zeros(len(node_z), np.int64)
    start = np.zeros(n + 1, np.int64)
    for i in range(n):
        count = 1
        for k in range(node_start[i], node_start[i + 1]):
            above = node_z[k + 1] if k + 1 < node_start[i + 1] else top[i]
            wanted = (above - node_z[k]) / spacing[i]
            if first > 0:
                wanted = count_steps(above - base[i], spacing[i], first, ratio)
                wanted -= count_steps(node_z[k] - base[i], spacing[i], first, ratio)
            steps[k] = max(1, int(np.floor(wanted + 0.5)))
            count += steps[k]
        if given[i] >= 0:
            count = seam_start[given[i] + 1] - seam_start[given[i]]
        start[i + 1] = start[i] + count
    return steps, start


@kernel
def _fill(
    node_start: NDArray[np.int64],
    node_kind: NDArray[np.int8],
    node_z: NDArray[np.float64],
    top: NDArray[np.float64],
    spacing: NDArray[np.float64],
    base: NDArray[np.float64],
    first: float,
    ratio: float,
    shift: NDArray[np.float64],
    steps: NDArray[np.int64],
    given: NDArray[np.int64],
    seam_start: NDArray[np.int64],
    seam_z: NDArray[np.float64],
    seam_kind: NDArray[np.int8],
    start: NDArray[np.int64],
    z: NDArray[np.float64],
    kind: NDArray[np.int8],
    level: NDArray[np.int32],
) -> None:
    for i in range(len(top)):
        if given[i] >= 0:
            row = seam_start[given[i]]
            for k in range(start[i + 1] - start[i]):
                z[start[i] + k] = seam_z[row + k]
                kind[start[i] + k] = seam_kind[row + k]
            continue
        at = start[i]
        for node in range(node_start[i], node_start[i + 1]):
            level[node] = at - start[i]
            below = node_z[node]
            above = node_z[node + 1] if node + 1 < node_start[i + 1] else top[i]
            step = (above - below) / steps[node]
            z[at] = below
            kind[at] = node_kind[node]
            if first > 0:
                low = count_steps(below - base[i], spacing[i], first, ratio)
                part = (count_steps(above - base[i], spacing[i], first, ratio) - low) / steps[node]
                for k in range(1, steps[node]):
                    height = height_of_steps(low + k * part, spacing[i], first, ratio)
                    moved = k + shift[i] * stagger_weight(height, spacing[i], first, ratio)
                    z[at + k] = base[i] + height_of_steps(low + moved * part, spacing[i], first, ratio)
            else:
                for k in range(1, steps[node]):
                    z[at + k] = below + (k + shift[i]) * step
            at += steps[node]
        z[at] = top[i]
        kind[at] = TOP_LEVEL


@kernel
def _repel_phases(
    start: NDArray[np.int64], neighbour: NDArray[np.int32], phase: NDArray[np.int8], sweeps: int
) -> None:
    count = np.zeros(N_PHASES, np.int64)
    for _ in range(sweeps):
        changed = False
        for i in range(len(phase)):
            count[:] = 0
            for k in range(start[i], start[i + 1]):
                count[phase[neighbour[k]]] += 1
            best = phase[i]
            for candidate in range(N_PHASES):
                if count[candidate] < count[best]:
                    best = candidate
            changed |= best != phase[i]
            phase[i] = best
        if not changed:
            return
