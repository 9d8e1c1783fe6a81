"""Step 3.3, the fast way: Laplace's equation on the slab as a low-pass filter of the terrain.

On a slab of constant thickness H with the terrain g given at its bottom and free sides and top, the
solution of the paper's equations 4-6 is known mode by mode: a cosine of wave number k is damped by
cosh(k (H - z)) / cosh(k H) at height z. One discrete cosine transform does what the finite elements do.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.fft import dctn, idctn

from pipeline.terrain import Dtm, sample_dtm


def smooth_slab(
    dtm: Dtm,
    xy: NDArray[np.float64],
    bounds: tuple[float, float, float, float],
    *,
    domain_height: float,
    n_layers: int,
    grid_spacing: float,
) -> NDArray[np.float64]:
    """Lift the layers of a slab so that they follow the terrain, less and less with height (step 3.3).

    Parameters
    ----------
    dtm : Dtm
        Terrain.
    xy : float64, (n, 2)
        Vertices of the plane mesh (m).
    bounds : (xmin, ymin, xmax, ymax)
        Area of the slab (m); its sides are free.
    domain_height : float
        Thickness of the slab H (m).
    n_layers : int
        Number of layers L of equal thickness.
    grid_spacing : float
        Distance of the nodes (m) between which the solution is interpolated; the bottom layer is the
        terrain itself.

    Returns
    -------
    float64, (n, n_layers + 1)
        Height (m) of every level of every column.

    Notes
    -----
    Memory is that of one level of the grid and of the result.
    """
    low, size = np.array(bounds[:2]), np.array(bounds[2:]) - np.array(bounds[:2])
    n_x, n_y = (max(int(n), 1) for n in np.rint(size / grid_spacing))
    spectrum = dctn(_terrain_on_grid(dtm, bounds, n_x, n_y), type=1)
    wave = np.hypot(np.pi / size[0] * np.arange(n_x + 1), np.pi / size[1] * np.arange(n_y + 1)[:, None])
    node, weight = _bilinear((xy - low) / size * [n_x, n_y], n_x, n_y)
    z = np.empty((len(xy), n_layers + 1))
    z[:, 0] = sample_dtm(dtm, xy)
    for level in range(1, n_layers + 1):
        height = domain_height * level / n_layers
        lifted = idctn(spectrum * _damping(wave, height, domain_height), type=1).ravel()
        z[:, level] = height + (lifted[node] * weight).sum(axis=1)
    return z


def _terrain_on_grid(
    dtm: Dtm, bounds: tuple[float, float, float, float], n_x: int, n_y: int
) -> NDArray[np.float64]:
    x, y = np.linspace(bounds[0], bounds[2], n_x + 1), np.linspace(bounds[1], bounds[3], n_y + 1)
    nodes = np.column_stack((np.tile(x, n_y + 1), np.repeat(y, n_x + 1)))
    return sample_dtm(dtm, nodes).reshape(n_y + 1, n_x + 1)


def _damping(wave: NDArray[np.float64], height: float, domain_height: float) -> NDArray[np.float64]:
    """cosh(k (H - z)) / cosh(k H), written so that nothing overflows."""
    above = np.exp(-2 * wave * (domain_height - height))
    damping: NDArray[np.float64] = np.exp(-wave * height) * (1 + above) / (1 + np.exp(-2 * wave * domain_height))
    return damping


def _bilinear(position: NDArray[np.float64], n_x: int, n_y: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Flat indices and weights of the four nodes around each position, given in units of the grid."""
    cell = np.clip(np.floor(position).astype(np.int64), 0, [n_x - 1, n_y - 1])
    s, t = (position - cell).T
    first = cell[:, 1] * (n_x + 1) + cell[:, 0]
    node = first[:, None] + np.array([0, 1, n_x + 1, n_x + 2])
    return node, np.column_stack(((1 - s) * (1 - t), s * (1 - t), (1 - s) * t, s * t))
