"""Steps 3.3 and 3.5 to the letter: linear finite elements on the tetrahedra, Krylov and multigrid.

The oracle that the fast path is tested against (`--smoother fem`). The paper uses BiCGSTAB; the matrix
is symmetric and positive definite, so conjugate gradients reach the same solution at half the cost.
"""

import numpy as np
import scipy  # what is asked of it is imported then
from numpy.typing import NDArray

from pipeline.data.errors import SolverError
from pipeline.data.mesh import TetMesh

MAX_ITERATIONS = 500


def stiffness_matrix(mesh: TetMesh) -> "scipy.sparse.csr_array":
    """Assemble the stiffness matrix of linear elements for Laplace's equation.

    Parameters
    ----------
    mesh : TetMesh
        Cells of positive volume.

    Returns
    -------
    csr_array, (n, n)
        Symmetric; its rows sum to zero.
    """
    corners = mesh.points[mesh.cells]
    edges = np.transpose(corners[:, 1:] - corners[:, :1], (0, 2, 1))
    volume = np.abs(np.linalg.det(edges)) / 6
    gradient = np.empty((len(mesh.cells), 4, 3))
    gradient[:, 1:] = np.linalg.inv(edges)
    gradient[:, 0] = -gradient[:, 1:].sum(axis=1)
    local = np.einsum("cik,cjk,c->cij", gradient, gradient, volume)
    rows = np.repeat(mesh.cells, 4, axis=1).ravel()
    columns = np.tile(mesh.cells, (1, 4)).ravel()
    n = len(mesh.points)
    return scipy.sparse.coo_array((local.ravel(), (rows, columns)), shape=(n, n)).tocsr()


def solve_laplace(
    mesh: TetMesh,
    fixed: NDArray[np.bool_],
    values: NDArray[np.float64],
    *,
    relative_tolerance: float,
    step: str,
) -> tuple[NDArray[np.float64], int, float]:
    """Solve Laplace's equation with given values at some vertices, free elsewhere.

    Parameters
    ----------
    mesh : TetMesh
        Cells of positive volume; a vertex that no cell uses must be fixed.
    fixed : bool, (n,)
        Vertices with a given value.
    values : float64, (n,)
        The given values; a first guess elsewhere.
    relative_tolerance : float
        Bound on the Euclidean norm of the residual, relative to the right-hand side's.
    step : str
        The paper's number of the step, for messages.

    Returns
    -------
    float64, (n,)
        The solution; given values bit for bit.
    int
        Iterations.
    float
        Relative residual, computed from the solution.

    Raises
    ------
    SolverError
        If the residual is not finite or above its bound.
    """
    import pyamg  # here, as hardly a run needs either
    from scipy.sparse.linalg import cg

    matrix = stiffness_matrix(mesh)
    free = np.flatnonzero(~fixed)
    given = np.where(fixed, values, 0.0)
    right = -(matrix[free] @ given)
    inner = scipy.sparse.csr_matrix(matrix[free][:, free])  # pyamg knows the older type only
    hierarchy = pyamg.smoothed_aggregation_solver(inner, max_coarse=100)
    count = 0

    def tick(_: NDArray[np.float64]) -> None:
        nonlocal count
        count += 1

    preconditioner = hierarchy.aspreconditioner(cycle="V")
    solution, _ = cg(
        inner,
        right,
        x0=values[free],
        rtol=relative_tolerance,
        maxiter=MAX_ITERATIONS,
        M=preconditioner,
        callback=tick,
    )
    scale = float(np.linalg.norm(right)) or 1.0
    residual = float(np.linalg.norm(right - inner @ solution)) / scale
    # What the solver says of itself is not looked at.
    if not np.isfinite(residual) or residual > 2 * relative_tolerance:
        raise SolverError(
            f"step {step}: relative residual {residual:.1e} > {relative_tolerance:.1e} after {count} "
            f"iterations on {len(free)} unknowns; raise --fem-tolerance or lower --layer-height"
        )
    result = given.copy()
    result[free] = solution
    return result, count, residual
