"""Conjugate gradients on a stencil, in single precision, preconditioned by sweeps over the columns (SSOR).

With the unknowns scaled so that the matrix is L + L' + omega I, L strictly lower in the order of columns and,
within each, of levels, the preconditioner is (I + L)(I + L'). Eisenstat's form iterates on its two factors'
inverses around the matrix, which take one sweep down and one up: the matrix itself is never multiplied.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.data.kernel import kernel
from pipeline.smoothing.stencil import Stencil

RELAXATION = 1.6  # omega; 1.3 to 1.7 take about the same iterations, the smooth error is least at the upper end


@dataclass(frozen=True, eq=False)
class Sweeps:
    """Strictly lower part of the scaled matrix of ``n`` columns of ``l`` levels over ``e`` plane edges."""

    edges: NDArray[np.int32]  #: (e, 2): columns of each edge, ascending and sorted
    start: NDArray[np.int64]  #: (n + 1,): first edge of each column, as its lower one
    #: (n, l): root of omega over the diagonal; 0 where the unknown is given, which takes it out of the couplings
    scale: NDArray[np.float32]
    #: (n, l - 1), (e, l) and (e, l - 1): scaled couplings, as in `Stencil`
    up: NDArray[np.float32]
    level: NDArray[np.float32]
    slant: NDArray[np.float32]


def scale_stencil(stencil: Stencil, edges: NDArray[np.int32], inverse: NDArray[np.float64]) -> Sweeps:
    """Scale a matrix for `solve_sweeps`.

    Parameters
    ----------
    stencil : Stencil
        Matrix, symmetric and positive definite.
    edges : int32, (e, 2)
        Edges as from `plane_edges`.
    inverse : float64, (n, l)
        One over the diagonal; 0 where the unknown is given.
    """
    scale = np.sqrt(RELAXATION * inverse)
    start = np.searchsorted(edges[:, 0], np.arange(len(scale) + 1))
    up, level, slant = (np.empty(of.shape, np.float32) for of in (stencil.up, stencil.level, stencil.slant))
    _scale(edges, stencil.up, stencil.level, stencil.slant, scale, up, level, slant)
    return Sweeps(edges, start, scale.astype(np.float32), up, level, slant)


def solve_sweeps(
    sweeps: Sweeps,
    right: NDArray[np.float64],
    tolerance: float,
    max_iterations: int,
) -> tuple[NDArray[np.float64], int]:
    """Solve with the matrix in single precision, from a guess of zero.

    Parameters
    ----------
    sweeps : Sweeps
        Scaled matrix.
    right : float64, (n, l)
        Right-hand side; what it has where unknowns are given does not count.
    tolerance : float
        Largest entry of the residual over the diagonal at which to stop; some 1e-6 of the right-hand side's is
        the least that the precision allows for.
    max_iterations : int
        Iterations after which to stop anyway.

    Returns
    -------
    float64, (n, l)
        Solution, 0 where it is given.
    int
        Iterations.

    Notes
    -----
    The residual is that of the recursion, which drifts from the true one by rounding: compute that anew.

    References
    ----------
    S. C. Eisenstat, Efficient implementation of a class of preconditioned conjugate gradient methods, SIAM J. Sci.
    Stat. Comput. 2 (1981) 1-4.
    """
    residual = (right * sweeps.scale).astype(np.float32)
    x = np.zeros_like(residual)
    iterations: int = _conjugate_gradients(
        sweeps.edges,
        sweeps.start,
        sweeps.scale,
        sweeps.up,
        sweeps.level,
        sweeps.slant,
        residual,
        x,
        tolerance * RELAXATION,
        max_iterations,
    )
    return x.astype(np.float64) * sweeps.scale, iterations


@kernel
def _scale(
    edges: NDArray[np.int32],
    up: NDArray[np.float64],
    level: NDArray[np.float64],
    slant: NDArray[np.float64],
    scale: NDArray[np.float64],
    scaled_up: NDArray[np.float32],
    scaled_level: NDArray[np.float32],
    scaled_slant: NDArray[np.float32],
) -> None:
    n, last = len(scale), scale.shape[1] - 1
    for i in range(n):
        for k in range(last):
            scaled_up[i, k] = up[i, k] * scale[i, k] * scale[i, k + 1]
    for e in range(len(edges)):
        i, j = edges[e, 0], edges[e, 1]
        for k in range(last):
            scaled_level[e, k] = level[e, k] * scale[i, k] * scale[j, k]
            scaled_slant[e, k] = slant[e, k] * scale[i, k] * scale[j, k + 1]
        scaled_level[e, last] = level[e, last] * scale[i, last] * scale[j, last]


@kernel
def _conjugate_gradients(
    edges: NDArray[np.int32],
    start: NDArray[np.int64],
    scale: NDArray[np.float32],
    up: NDArray[np.float32],
    level: NDArray[np.float32],
    slant: NDArray[np.float32],
    r: NDArray[np.float32],
    x: NDArray[np.float32],
    tolerance: float,
    max_iterations: int,
) -> int:
    """Solve on top of x for the residual r, which is overwritten; the tolerance is that of r times `scale`."""
    p, t, q = np.zeros_like(r), np.zeros_like(r), np.empty_like(r)
    _solve_lower(edges, start, up, level, slant, r)
    rho, beta, iteration = 0.0, np.float32(0.0), 0
    for i in range(len(r)):
        for k in range(r.shape[1]):
            rho += r[i, k] * r[i, k]
    while iteration < max_iterations:
        _sweep_down(edges, start, up, level, slant, beta, r, p, t)
        energy = _sweep_up(edges, start, up, level, slant, p, t, q)
        if not energy > 0.0:
            break
        new_rho, largest = _step(np.float32(rho / energy), scale, t, q, x, r)
        iteration += 1
        # The residual before (I + L)^-1 takes a walk over the couplings: ask when it may be small enough.
        if largest <= tolerance and _largest_residual(edges, start, scale, up, level, slant, r, q) <= tolerance:
            break
        beta = np.float32(new_rho / rho)
        rho = new_rho
    return iteration


@kernel
def _sweep_down(
    edges: NDArray[np.int32],
    start: NDArray[np.int64],
    up: NDArray[np.float32],
    level: NDArray[np.float32],
    slant: NDArray[np.float32],
    beta: np.float32,
    r: NDArray[np.float32],
    p: NDArray[np.float32],
    t: NDArray[np.float32],
) -> None:
    """Make p the next direction, r + beta p, and t = (I + L')^-1 p."""
    n, last = len(p), p.shape[1] - 1
    column = np.empty(last + 1, np.float32)
    for i in range(n - 1, -1, -1):
        for k in range(last + 1):
            p[i, k] = r[i, k] + beta * p[i, k]
            column[k] = p[i, k]
        for e in range(start[i], start[i + 1]):
            j = edges[e, 1]
            for k in range(last):
                column[k] -= level[e, k] * t[j, k] + slant[e, k] * t[j, k + 1]
            column[last] -= level[e, last] * t[j, last]
        above = column[last]
        t[i, last] = above
        for k in range(last - 1, -1, -1):
            above = column[k] - up[i, k] * above
            t[i, k] = above


@kernel
def _sweep_up(
    edges: NDArray[np.int32],
    start: NDArray[np.int64],
    up: NDArray[np.float32],
    level: NDArray[np.float32],
    slant: NDArray[np.float32],
    p: NDArray[np.float32],
    t: NDArray[np.float32],
    q: NDArray[np.float32],
) -> float:
    """Make q the product of the preconditioned matrix and p, and return that of p and q."""
    excess = np.float32(2.0 - RELAXATION)  # L + L' + omega I = (I + L) + (I + L') - (2 - omega) I
    n, levels = p.shape
    column = np.empty(levels, np.float32)
    for i in range(n):
        for k in range(levels):
            q[i, k] = p[i, k] - excess * t[i, k]
    energy = 0.0
    for i in range(n):
        _finish_column(edges, start, up, level, slant, i, column, q)
        for k in range(levels):
            q[i, k] = column[k] + t[i, k]
            energy += p[i, k] * q[i, k]
    return energy


@kernel
def _solve_lower(
    edges: NDArray[np.int32],
    start: NDArray[np.int64],
    up: NDArray[np.float32],
    level: NDArray[np.float32],
    slant: NDArray[np.float32],
    r: NDArray[np.float32],
) -> None:
    """Put (I + L)^-1 r in the place of r."""
    column = np.empty(r.shape[1], np.float32)
    for i in range(len(r)):
        _finish_column(edges, start, up, level, slant, i, column, r)
        for k in range(len(column)):
            r[i, k] = column[k]


@kernel
def _finish_column(
    edges: NDArray[np.int32],
    start: NDArray[np.int64],
    up: NDArray[np.float32],
    level: NDArray[np.float32],
    slant: NDArray[np.float32],
    i: int,
    column: NDArray[np.float32],
    q: NDArray[np.float32],
) -> None:
    """Solve with I + L in column i of q, which has lost what is due to columns before, and tell those after."""
    levels = len(column)
    below = q[i, 0]
    column[0] = below
    for k in range(1, levels):
        below = q[i, k] - up[i, k - 1] * below
        column[k] = below
    for e in range(start[i], start[i + 1]):
        j = edges[e, 1]
        q[j, 0] -= level[e, 0] * column[0]
        for k in range(1, levels):
            q[j, k] -= level[e, k] * column[k] + slant[e, k - 1] * column[k - 1]


@kernel
def _step(
    alpha: np.float32,
    scale: NDArray[np.float32],
    t: NDArray[np.float32],
    q: NDArray[np.float32],
    x: NDArray[np.float32],
    r: NDArray[np.float32],
) -> tuple[float, float]:
    """Step along t; returns the sum of squares of the next r, and the largest entry of r times `scale`."""
    rho, largest = 0.0, np.float32(0.0)
    n, levels = r.shape
    for i in range(n):
        for k in range(levels):
            x[i, k] += alpha * t[i, k]
            value = r[i, k] - alpha * q[i, k]
            r[i, k] = value
            rho += value * value
            largest = max(largest, abs(value * scale[i, k]))
    return rho, float(largest)


@kernel
def _largest_residual(
    edges: NDArray[np.int32],
    start: NDArray[np.int64],
    scale: NDArray[np.float32],
    up: NDArray[np.float32],
    level: NDArray[np.float32],
    slant: NDArray[np.float32],
    r: NDArray[np.float32],
    y: NDArray[np.float32],
) -> float:
    """Largest entry of y = (I + L) r times `scale`."""
    n, levels = r.shape
    for i in range(n):
        y[i, 0] = r[i, 0]
        for k in range(1, levels):
            y[i, k] = r[i, k] + up[i, k - 1] * r[i, k - 1]
    largest = np.float32(0.0)
    for i in range(n):
        for e in range(start[i], start[i + 1]):
            j = edges[e, 1]
            y[j, 0] += level[e, 0] * r[i, 0]
            for k in range(1, levels):
                y[j, k] += level[e, k] * r[i, k] + slant[e, k - 1] * r[i, k - 1]
        for k in range(levels):
            largest = max(largest, abs(y[i, k] * scale[i, k]))
    return float(largest)
