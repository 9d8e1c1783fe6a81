"""Step 3.3, the fast way: Laplace's equation on the slab as a low-pass filter of the terrain.

On a slab of constant thickness H with the terrain g given at its bottom and free sides and top, the
solution of the paper's equations 4-6 is known mode by mode: a cosine of wave number k is damped by
cosh(k (H - z)) / cosh(k H) at height z. One discrete cosine transform does what the finite elements do.

What the terrain at some place adds fades with the distance d like exp(-pi d / (2 H)), so a window around a
tile is as good as the region: `slab_window` for a mesh, `lift_places` for places that belong to none.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import scipy  # what is asked of it is imported then
from numpy.typing import NDArray

from pipeline.data.kernel import kernel
from pipeline.points_terrain.raster import node_window
from pipeline.points_terrain.terrain import Dtm, cut_terrain, sample_dtm, sample_grid

REACH = 3.0  # domain heights; terrain farther from a mesh counts for nothing
BLOCK = 1.0  # domain heights; side of the squares that `lift_places` works in
STEEPEST = 300.0  # exponent by which a mode fades from a level to the next at most; what is left is nothing
UNDAMPED = np.ones((1, 1, 1))  # one level at which all modes are whole
SUMS = 0.25  # of the grid's shorter side; for fewer rows or columns, sums are faster than a transform

Bounds = tuple[float, float, float, float]
Nodes = tuple[int, int, int, int]


@dataclass(frozen=True, eq=False)
class SlabShape:
    """How the layers of a slab differ from equal ones that all follow the terrain by Laplace's equation."""

    #: (n_layers + 1,): heights of the levels on flat ground (m), from 0 to the slab's thickness
    levels: NDArray[np.float64]
    #: height (m) below which the equation's levels turn, with its square, into those that stand at their heights
    #: above the terrain; 0 if none do. Thin layers would otherwise follow the slope, and cross small bumps
    calm: float
    #: absolute height of a flat top (m), to which levels are drawn with the square of their height; None leaves
    #: the top as the equation has it
    top: float | None


def slab_reach(domain_height: float, *, grid_spacing: float) -> float:
    """How far beyond a mesh, or a place, terrain counts for its levels (m), within the region."""
    return REACH * domain_height + grid_spacing


def slab_window(xy: NDArray[np.float64], region: Bounds, *, domain_height: float, grid_spacing: float) -> Bounds:
    """Choose the area of the slab for a mesh: as far around it as terrain counts, within the region.

    Parameters
    ----------
    xy : float64, (n, 2)
        Vertices of the mesh (m).
    region : (xmin, ymin, xmax, ymax)
        The region (m).
    domain_height, grid_spacing : float
        As in `smooth_slab`.

    Returns
    -------
    (xmin, ymin, xmax, ymax)
        The window (m). Its sides are multiples of the grid's spacing, or the region's: windows of neighbours
        have the same nodes, and no window depends on the region unless it reaches to its border.

    Examples
    --------
    >>> corners = np.array([[102.0, 7.0], [140.0, 39.0]])
    >>> slab_window(corners, (0.0, 0.0, 500.0, 500.0), domain_height=20.0, grid_spacing=10.0)
    (40.0, 0.0, 200.0, 100.0)
    """
    reach = REACH * domain_height
    low = np.floor((xy.min(axis=0) - reach) / grid_spacing) * grid_spacing
    high = np.ceil((xy.max(axis=0) + reach) / grid_spacing) * grid_spacing
    return _clip(low, high, region)


def lift_places(
    dtm: Dtm,
    xy: NDArray[np.float64],
    region: Bounds,
    *,
    domain_height: float,
    n_layers: int,
    grid_spacing: float,
    shape: SlabShape | None = None,
) -> NDArray[np.float64]:
    """Give the levels of single places (step 3.3): each depends on its place and the terrain in reach alone.

    Parameters and result as in `smooth_slab`, with the region instead of an area of the slab; the terrain may be
    NaN at nodes of tiles that are absent.

    Notes
    -----
    The plane is divided into squares as wide as the domain is high, aligned to the CRS; all places of one have
    a common window, which ends a domain height short of `slab_reach` beyond the square; nodes of tiles that are
    absent are filled from that window alone. Levels jump between squares by what that leaves out, some 4 % of the
    relief's changes there: good for choosing a layer, not for a mesh. Cost is one small transform a square, and
    a sum of its modes at the square's nodes for each level.
    """
    side, margin = BLOCK * domain_height, (REACH - BLOCK) * domain_height
    levels, rises = _find_levels(domain_height, n_layers, shape)
    complete = not np.isnan(dtm.z).any()
    within = np.clip(xy, region[:2], region[2:])
    block, member = np.unique(np.floor(within / side), axis=0, return_inverse=True)
    z = np.empty((len(xy), n_layers + 1))
    order = np.argsort(member.reshape(-1), kind="stable")
    ends = np.searchsorted(member.reshape(-1)[order], np.arange(len(block) + 1))
    lifts: dict[tuple[Bounds, Bounds], _SquareLift] = {}
    for corner, begin, end in zip(block, ends[:-1], ends[1:], strict=True):
        rows = order[begin:end]
        square = _clip(corner * side, (corner + 1) * side, region)
        window = _clip(corner * side - margin, (corner + 1) * side + margin, region)
        kind = _seen_from(square, window), _seen_from(window, window)
        if kind not in lifts:
            lifts[kind] = _prepare_lift(*kind, rises, domain_height, grid_spacing)
        terrain = dtm if complete else cut_terrain(dtm, node_window(window, dtm.spacing))
        z[rows, 0] = sample_dtm(terrain, within[rows])
        z[rows, 1:] = levels[1:] + lifts[kind](terrain, within[rows], window)
    return z if shape is None else shape_levels(z, shape)


def smooth_slab(
    dtm: Dtm,
    xy: NDArray[np.float64],
    bounds: Bounds,
    *,
    domain_height: float,
    n_layers: int,
    grid_spacing: float,
    shape: SlabShape | None = None,
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
        Number of layers L, of equal thickness unless a shape is given.
    grid_spacing : float
        Distance of the nodes (m) between which the solution is interpolated; the bottom layer is the
        terrain itself.
    shape : SlabShape, optional
        Layers of other heights, and a flat top.

    Returns
    -------
    float64, (n, n_layers + 1)
        Height (m) of every level of every column.

    Notes
    -----
    Memory is that of a few levels of the grid and of the result.
    """
    low, size = np.array(bounds[:2]), np.array(bounds[2:]) - np.array(bounds[:2])
    n_x, n_y = _count_cells(size, grid_spacing)
    spectrum = scipy.fft.dctn(_terrain_on_grid(dtm, bounds, n_x, n_y), type=1)
    position = (xy - low) / size * [n_x, n_y]
    nodes = _nodes_around(position, n_x, n_y)
    node, weight = _bilinear(position, nodes)
    back = _choose_way_back(spectrum.shape, nodes)
    levels, rises = _find_levels(domain_height, n_layers, shape)
    z = np.empty((len(xy), n_layers + 1))
    z[:, 0] = sample_dtm(dtm, xy)
    for level, damped in enumerate(_damp(spectrum, size, rises, domain_height), 1):
        z[:, level] = levels[level] + (back(damped).ravel()[node] * weight).sum(axis=1)
    return z if shape is None else shape_levels(z, shape)


def shape_levels(z: NDArray[np.float64], shape: SlabShape) -> NDArray[np.float64]:
    """Let the lowest levels keep their heights above the terrain, and the highest ones come to a flat top.

    Parameters
    ----------
    z : float64, (n, n_layers + 1)
        Levels after step 3.3 (m), the terrain first.
    shape : SlabShape
        What to make of them.
    """
    share = np.minimum(shape.levels / shape.calm, 1.0) ** 2 if shape.calm > 0 else np.ones(len(shape.levels))
    shaped = share * z + (1 - share) * (z[:, :1] + shape.levels)
    shaped[:, 0] = z[:, 0]
    if shape.top is not None:
        shaped += (shape.levels / shape.levels[-1]) ** 2 * (shape.top - shaped[:, -1:])
        shaped[:, -1] = shape.top
    return shaped


def _clip(low: NDArray[np.float64], high: NDArray[np.float64], region: Bounds) -> Bounds:
    low, high = np.maximum(low, region[:2]), np.minimum(high, region[2:])
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])


@dataclass(frozen=True, eq=False)
class _SquareLift:
    """How the terrain in a window lifts the levels in a square of it: the same for all squares that lie alike."""

    shape: tuple[int, int]  #: (int, int): cells of the window's grid along x and y
    nodes: Nodes  #: (int, int, int, int): nodes around the square, as from `_nodes_around`
    #: (r, ny + 1) and (nx + 1, c): what each mode adds at their rows and at their columns
    along_y: NDArray[np.float64]
    along_x: NDArray[np.float64]
    #: (n_layers, ny + 1, nx + 1): what is left of each mode at every level but the ground
    damping: NDArray[np.float64]

    def __call__(self, dtm: Dtm, xy: NDArray[np.float64], window: Bounds) -> NDArray[np.float64]:
        """Terrain at places in the square, as it is felt at every level but the ground (m); (n, n_layers)."""
        low, size = np.array(window[:2]), np.subtract(window[2:], window[:2])
        spectrum = scipy.fft.dctn(_terrain_on_grid(dtm, window, *self.shape), type=1)
        node, weight = _bilinear((xy - low) / size * self.shape, self.nodes)
        lifted = _sum_damped(spectrum, self.damping, self.along_y, self.along_x)
        felt: NDArray[np.float64] = (lifted.reshape(len(lifted), -1)[:, node] * weight).sum(axis=2).T
        return felt


def _prepare_lift(
    square: Bounds, window: Bounds, rises: NDArray[np.float64], domain_height: float, grid_spacing: float
) -> _SquareLift:
    size = np.array(window[2:])
    n_x, n_y = _count_cells(size, grid_spacing)
    nodes = _nodes_around(np.reshape(square, (2, 2)) / size * [n_x, n_y], n_x, n_y)
    damping = np.array(list(_damp(np.ones((n_y + 1, n_x + 1)), size, rises, domain_height)))
    along_y = _cosines(np.arange(nodes[0], nodes[1] + 1), n_y + 1)
    along_x = _cosines(np.arange(nodes[2], nodes[3] + 1), n_x + 1)
    return _SquareLift((n_x, n_y), nodes, along_y, np.ascontiguousarray(along_x.T), damping)


def _seen_from(area: Bounds, window: Bounds) -> Bounds:
    """An area in coordinates that start at a window's corner, in whole millimetres."""
    west, south, east, north = np.round(np.subtract(area, window[:2] * 2), 3).tolist()
    return west, south, east, north


def _find_levels(
    domain_height: float, n_layers: int, shape: SlabShape | None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Heights of the levels on flat ground, and of the layers: of equal ones, bit for bit the same."""
    if shape is None:
        return domain_height * np.arange(n_layers + 1) / n_layers, np.full(n_layers, domain_height / n_layers)
    return shape.levels, np.diff(shape.levels)


def _count_cells(size: NDArray[np.float64], grid_spacing: float) -> tuple[int, int]:
    """Cells of a grid along x and y."""
    n_x, n_y = (max(int(n), 1) for n in np.rint(size / grid_spacing))
    return n_x, n_y


def _damp(
    spectrum: NDArray[np.float64], size: NDArray[np.float64], rises: NDArray[np.float64], domain_height: float
) -> Iterator[NDArray[np.float64]]:
    """What is left of the modes of a slab's bottom (ny + 1, nx + 1) at each level above it, in turn."""
    n_y, n_x = spectrum.shape
    wave = np.hypot(np.pi / size[0] * np.arange(n_x), np.pi / size[1] * np.arange(n_y)[:, None])
    # cosh(k (H - z)) / cosh(k H) has a part that fades with the height z, and one that grows: exp(k (z - 2 H)).
    fading = spectrum / (1 + np.exp(-2 * wave * domain_height))
    growing = fading * np.exp(-2 * wave * domain_height)
    before = 0.0
    for rise in rises:
        if rise != before:
            fade, before = np.exp(-np.minimum(wave * rise, STEEPEST)), rise
        fading *= fade
        growing /= fade
        yield fading + growing


def _terrain_on_grid(dtm: Dtm, bounds: Bounds, n_x: int, n_y: int) -> NDArray[np.float64]:
    x, y = np.linspace(bounds[0], bounds[2], n_x + 1), np.linspace(bounds[1], bounds[3], n_y + 1)
    return sample_grid(dtm, x, y)


def _nodes_around(position: NDArray[np.float64], n_x: int, n_y: int) -> Nodes:
    """Nodes between which positions are, given in units of the grid: first and last row, first and last column."""
    first = np.clip(np.floor(position.min(axis=0)).astype(np.int64), 0, [n_x - 1, n_y - 1])
    last = np.clip(np.floor(position.max(axis=0)).astype(np.int64), 0, [n_x - 1, n_y - 1]) + 1
    return int(first[1]), int(last[1]), int(first[0]), int(last[0])


def _choose_way_back(shape: tuple[int, ...], nodes: Nodes) -> Callable[[NDArray[np.float64]], NDArray[np.float64]]:
    """Choose how the values at nodes are found of a spectrum: sums for a few rows or columns, else a transform."""
    row, last_row, column, last_column = nodes
    rows, columns = np.arange(row, last_row + 1), np.arange(column, last_column + 1)
    if min(len(rows), len(columns)) > SUMS * min(shape):
        return lambda spectrum: scipy.fft.idctn(spectrum, type=1)[row : last_row + 1, column : last_column + 1]
    along_y, along_x = _cosines(rows, shape[0]), _cosines(columns, shape[1])
    if len(rows) <= len(columns):
        along_x = np.ascontiguousarray(along_x.T)
        return lambda spectrum: _sum_modes(spectrum, along_y, along_x)
    along_y = np.ascontiguousarray(along_y.T)
    return lambda spectrum: _sum_modes(np.ascontiguousarray(spectrum.T), along_x, along_y).T


def _cosines(place: NDArray[np.int64], n: int) -> NDArray[np.float64]:
    """What each mode of a transform of n nodes adds at some of them; float64, (len(place), n)."""
    share = np.full(n, 2.0)
    share[[0, -1]] = 1.0
    # Whole turns are taken off while numbers are whole.
    turn = np.outer(place, np.arange(n)) % (2 * (n - 1))
    cosines: NDArray[np.float64] = np.cos(np.pi / (n - 1) * turn) * (share / (2 * (n - 1)))
    return cosines


def _sum_modes(
    spectrum: NDArray[np.float64], rows: NDArray[np.float64], columns: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Sum the modes of a spectrum at nodes: cosines of a few rows (r, ny), of columns (nx, c); float64, (r, c)."""
    found: NDArray[np.float64] = _sum_damped(spectrum, UNDAMPED, rows, columns)[0]
    return found


@kernel
def _sum_damped(
    spectrum: NDArray[np.float64],
    damping: NDArray[np.float64],
    rows: NDArray[np.float64],
    columns: NDArray[np.float64],
) -> NDArray[np.float64]:
    """`_sum_modes` at every level, damped as there; float64, (n_layers, r, c)."""
    found = np.zeros((len(damping), len(rows), columns.shape[1]))
    for level in range(len(damping)):
        _add_modes(damping[level] * spectrum, rows, columns, found[level])
    return found


@kernel
def _add_modes(
    spectrum: NDArray[np.float64],
    rows: NDArray[np.float64],
    columns: NDArray[np.float64],
    found: NDArray[np.float64],
) -> None:
    """Add the modes of a spectrum to what is found at nodes, as `_sum_modes`."""
    line = np.empty(spectrum.shape[1])
    for r in range(len(rows)):
        line[:] = 0.0
        for j in range(spectrum.shape[0]):
            for i in range(spectrum.shape[1]):
                line[i] += rows[r, j] * spectrum[j, i]
        for i in range(spectrum.shape[1]):
            for c in range(columns.shape[1]):
                found[r, c] += line[i] * columns[i, c]


def _bilinear(position: NDArray[np.float64], nodes: Nodes) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Flat indices among some nodes and weights of the four around each position, given in units of the grid."""
    row, last_row, column, last_column = nodes
    cell = np.clip(np.floor(position).astype(np.int64), [column, row], [last_column - 1, last_row - 1])
    s, t = (position - cell).T
    wide = last_column - column + 1
    first = (cell[:, 1] - row) * wide + cell[:, 0] - column
    node = first[:, None] + np.array([0, 1, wide, wide + 1])
    return node, np.column_stack(((1 - s) * (1 - t), s * (1 - t), (1 - s) * t, s * t))
