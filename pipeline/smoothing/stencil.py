"""Stiffness matrix of linear tetrahedra on columns (paper, equations 7-10), stored as a stencil.

The matrix is that of the mesh of step 3.4, exactly; only its storage knows of columns. A vertex couples to
the next level of its own column, and over a plane edge (i, j), i < j, to the same level of the other column
and from level k of i to level k + 1 of j.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.data.kernel import kernel
from pipeline.data.mesh import PlaneMesh


@dataclass(frozen=True, eq=False)
class Stencil:
    """Stiffness matrix of ``n`` columns of ``l`` levels over ``e`` plane edges."""

    diagonal: NDArray[np.float64]  #: (n, l): diagonal; 0 where no cell uses the vertex
    up: NDArray[np.float64]  #: (n, l - 1): coupling of level k with level k + 1 of the same column
    level: NDArray[np.float64]  #: (e, l): coupling of the same level of the edge's two columns
    #: (e, l - 1): coupling of level k of the edge's first column with level k + 1 of its second
    slant: NDArray[np.float64]


def assemble_stencil(
    plane: PlaneMesh,
    of_triangle: NDArray[np.int32],
    n_edges: int,
    first: NDArray[np.int32],
    z: NDArray[np.float64],
) -> Stencil:
    """Assemble the stiffness matrix of linear elements on the layered cells.

    Parameters
    ----------
    plane : PlaneMesh
        Plane mesh.
    of_triangle : int32, (m, 3)
        Edges between corners 0-1, 0-2 and 1-2 of each triangle (`plane_edges`).
    n_edges : int
        Number of edges.
    first : int32, (m,)
        First level of the cells over each triangle.
    z : float64, (n, l)
        Heights (m), ascending above each triangle's first level.
    """
    n, levels = z.shape
    stencil = Stencil(
        np.zeros((n, levels)),
        np.zeros((n, levels - 1)),
        np.zeros((n_edges, levels)),
        np.zeros((n_edges, levels - 1)),
    )
    _assemble(
        plane.xy, plane.triangles, of_triangle, first, z,
        stencil.diagonal, stencil.up, stencil.level, stencil.slant,
    )  # fmt: skip
    return stencil


def multiply_stencil(stencil: Stencil, edges: NDArray[np.int32], x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Product of the matrix and x, float64 (n, l); edges, int32 (e, 2), as from `plane_edges`."""
    product = np.empty_like(x)
    _multiply(edges, stencil.diagonal, stencil.up, stencil.level, stencil.slant, x, product)
    return product


@kernel
def _assemble(
    xy: NDArray[np.float64],
    triangles: NDArray[np.int32],
    of_triangle: NDArray[np.int32],
    first: NDArray[np.int32],
    z: NDArray[np.float64],
    diagonal: NDArray[np.float64],
    up: NDArray[np.float64],
    level: NDArray[np.float64],
    slant: NDArray[np.float64],
) -> None:
    grad = np.empty((3, 2))
    n_layers = z.shape[1] - 1
    for t in range(len(triangles)):
        v = triangles[t]
        e = of_triangle[t]
        area2 = _gradients(xy, v, grad)
        for k in range(first[t], n_layers):
            # The third column steps up first, then the second, then the first (equations 1-3).
            _add_cell(grad, area2, z, v, e, 2, k, k, k, diagonal, up, level, slant)
            _add_cell(grad, area2, z, v, e, 1, k, k, k + 1, diagonal, up, level, slant)
            _add_cell(grad, area2, z, v, e, 0, k, k + 1, k + 1, diagonal, up, level, slant)


@kernel
def _gradients(xy: NDArray[np.float64], v: NDArray[np.int32], grad: NDArray[np.float64]) -> float:
    """Gradients of the triangle's barycentric coordinates; returns twice its area."""
    x0, y0 = xy[v[0], 0], xy[v[0], 1]
    x1, y1 = xy[v[1], 0], xy[v[1], 1]
    x2, y2 = xy[v[2], 0], xy[v[2], 1]
    det = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
    grad[0, 0], grad[0, 1] = (y1 - y2) / det, (x2 - x1) / det
    grad[1, 0], grad[1, 1] = (y2 - y0) / det, (x0 - x2) / det
    grad[2, 0], grad[2, 1] = (y0 - y1) / det, (x1 - x0) / det
    return float(abs(det))


@kernel(inline="always")
def _add_cell(
    grad: NDArray[np.float64],
    area2: float,
    z: NDArray[np.float64],
    v: NDArray[np.int32],
    e: NDArray[np.int32],
    rising: int,
    k0: int,
    k1: int,
    k2: int,
    diagonal: NDArray[np.float64],
    up: NDArray[np.float64],
    level: NDArray[np.float64],
    slant: NDArray[np.float64],
) -> None:
    """Add the cell over corners (0, k0), (1, k1), (2, k2) whose fourth vertex is above corner `rising`.

    The basis function of the upper vertex is (height over the plane of the three) / (length of the edge);
    that of the vertex below takes what it loses; those of the other two do not depend on height.
    """
    k = k0 if rising == 0 else (k1 if rising == 1 else k2)
    c = v[rising]
    rise = z[c, k + 1] - z[c, k]
    weight = area2 * rise / 6
    z0, z1, z2 = z[v[0], k0], z[v[1], k1], z[v[2], k2]
    tx = -(z0 * grad[0, 0] + z1 * grad[1, 0] + z2 * grad[2, 0]) / rise
    ty = -(z0 * grad[0, 1] + z1 * grad[1, 1] + z2 * grad[2, 1]) / rise
    tz = 1 / rise
    lx, ly = grad[rising, 0] - tx, grad[rising, 1] - ty
    diagonal[c, k] += weight * (lx * lx + ly * ly + tz * tz)
    diagonal[c, k + 1] += weight * (tx * tx + ty * ty + tz * tz)
    up[c, k] += weight * (lx * tx + ly * ty - tz * tz)
    for side in range(3):
        if side == rising:
            continue
        gx, gy = grad[side, 0], grad[side, 1]
        ks = k0 if side == 0 else (k1 if side == 1 else k2)
        diagonal[v[side], ks] += weight * (gx * gx + gy * gy)
        edge = e[side + rising - 1]
        # Corner `side` sits at level k if it precedes the rising corner, else at k + 1.
        if ks == k:
            level[edge, k] += weight * (gx * lx + gy * ly)
            slant[edge, k] += weight * (gx * tx + gy * ty)
        else:
            level[edge, k + 1] += weight * (gx * tx + gy * ty)
            slant[edge, k] += weight * (gx * lx + gy * ly)
    p, q = (1, 2) if rising == 0 else ((0, 2) if rising == 1 else (0, 1))
    kp = k0 if p == 0 else k1
    kq = k2 if q == 2 else k1
    value = weight * (grad[p, 0] * grad[q, 0] + grad[p, 1] * grad[q, 1])
    if kp == kq:
        level[e[p + q - 1], kp] += value
    else:
        slant[e[p + q - 1], kp] += value


@kernel
def _multiply(
    edges: NDArray[np.int32],
    diagonal: NDArray[np.float64],
    up: NDArray[np.float64],
    level: NDArray[np.float64],
    slant: NDArray[np.float64],
    x: NDArray[np.float64],
    y: NDArray[np.float64],
) -> None:
    """Write the product of the matrix and x into y.

    Every coupling is read once, for both of its ends; edges are sorted by their first column.
    """
    n, last = len(x), x.shape[1] - 1
    for i in range(n):
        below, coupling_below, here = 0.0, 0.0, x[i, 0]
        for k in range(last):
            above, coupling = x[i, k + 1], up[i, k]
            y[i, k] = diagonal[i, k] * here + coupling * above + coupling_below * below
            below, coupling_below, here = here, coupling, above
        y[i, last] = diagonal[i, last] * here + coupling_below * below
    e = 0
    for i in range(n):
        while e < len(edges) and edges[e, 0] == i:
            j = edges[e, 1]
            below, slant_below, beside = 0.0, 0.0, x[j, 0]
            for k in range(last):
                even, rising, here, above = level[e, k], slant[e, k], x[i, k], x[j, k + 1]
                y[i, k] = y[i, k] + even * beside + rising * above
                y[j, k] = y[j, k] + even * here + slant_below * below
                below, slant_below, beside = here, rising, above
            y[i, last] += level[e, last] * beside
            y[j, last] = y[j, last] + level[e, last] * x[i, last] + slant_below * below
            e += 1
