"""Step 3.5, the fast way: Laplace's equation on columns, matrix in a stencil, solved by sweeps over it."""

import numpy as np
from numpy.typing import NDArray

from pipeline.data.errors import SolverError
from pipeline.data.kernel import kernel
from pipeline.data.mesh import PlaneMesh
from pipeline.plane_mesh.edges import plane_edges
from pipeline.smoothing.ssor_cg import scale_stencil, solve_sweeps
from pipeline.smoothing.stencil import assemble_stencil, multiply_stencil

MAX_ITERATIONS = 2000
MARGIN = 0.9  # of the tolerance: what a round aims at, so that rounding costs no other one
REDUCTION = 1e-4  # of the residual: the least that a round in single precision aims at
ROUNDING = 1e-9  # of heights in double precision (m), with room to spare


def relax_columns(
    plane: PlaneMesh,
    first: NDArray[np.int32],
    z: NDArray[np.float64],
    fixed: NDArray[np.bool_],
    displacement: NDArray[np.float64],
    *,
    tolerance: float,
) -> tuple[NDArray[np.float64], int, float]:
    """Solve for the vertical displacement between ground and roofs (paper, step 3.5).

    Parameters
    ----------
    plane : PlaneMesh
        Plane mesh.
    first : int32, (m,)
        First level of the cells over each triangle.
    z : float64, (n, l)
        Heights after step 3.4 (m).
    fixed : bool, (n, l)
        Levels whose displacement is given: ground, roofs, and those that no cell uses.
    displacement : float64, (n, l)
        Given values (m) where fixed, a first guess elsewhere.
    tolerance : float
        Largest entry of the residual over the diagonal (m) at which to stop.

    Returns
    -------
    float64, (n, l)
        Displacement (m).
    int
        Iterations.
    float
        Largest entry of the true residual over the diagonal (m), computed anew from the result.

    Raises
    ------
    SolverError
        If the residual is not finite or stays above the tolerance.

    Notes
    -----
    Iterative refinement: corrections are solved for in single precision, residuals are of double precision. With
    millimetres asked for one round does.
    """
    edges, of_triangle = plane_edges(plane.triangles)
    stencil = assemble_stencil(plane, of_triangle, len(edges), first, z)
    inverse = np.zeros_like(displacement)
    np.divide(1.0, stencil.diagonal, out=inverse, where=~fixed & (stencil.diagonal > 0))
    sweeps = scale_stencil(stencil, edges, inverse)
    x, iterations = displacement.copy(), 0
    missing = -multiply_stencil(stencil, edges, x)
    residual = float(np.abs(missing * inverse).max())
    while tolerance < residual < np.inf and iterations < MAX_ITERATIONS:
        target = max(MARGIN * tolerance / residual, REDUCTION)
        correction, steps = solve_sweeps(sweeps, missing / residual, target, MAX_ITERATIONS - iterations)
        x += residual * correction
        iterations += steps
        missing = -multiply_stencil(stencil, edges, x)
        before, residual = residual, float(np.abs(missing * inverse).max())
        if residual >= before:
            break
    if not residual <= tolerance + ROUNDING:
        raise SolverError(
            f"step 3.5: residual {residual:.2e} m > {tolerance:.2e} m after {iterations} iterations on "
            f"{x.size} unknowns; raise --layer-height, or --smoothing-tolerance"
        )
    return x, iterations, residual


def guess_displacement(fixed: NDArray[np.bool_], displacement: NDArray[np.float64]) -> NDArray[np.float64]:
    """First guess: linear between the fixed levels of a column, fading above the last one."""
    guess = displacement.copy()
    _interpolate_columns(fixed, guess)
    return guess


@kernel
def _interpolate_columns(fixed: NDArray[np.bool_], u: NDArray[np.float64]) -> None:
    fading = 0.5  # a level's share of the displacement below it
    n, levels = u.shape
    for i in range(n):
        last = -1
        for k in range(levels):
            if fixed[i, k]:
                for m in range(last + 1, k):
                    u[i, m] = (
                        u[i, k] if last < 0 else u[i, last] + (u[i, k] - u[i, last]) * (m - last) / (k - last)
                    )
                last = k
        for m in range(max(last + 1, 1), levels):
            u[i, m] = u[i, m - 1] * fading
