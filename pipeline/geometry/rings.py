"""Rings of polygons as flat arrays: canonical form, needless vertices, corners (steps 1.4, 2.1)."""

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray


def make_canonical(polygons: NDArray[np.object_]) -> NDArray[np.object_]:
    """Write each polygon in the one form that depends on its point set and vertices alone.

    Parameters
    ----------
    polygons : object, (n,)
        shapely Polygons.

    Returns
    -------
    object, (n,)
        Without Z, shell counter-clockwise, holes clockwise and sorted, each ring from its vertex that is
        smallest in (x, y); no negative zero.

    Examples
    --------
    >>> print(make_canonical(np.array([shapely.box(0, 0, 1, 2)]))[0])
    POLYGON ((0 0, 1 0, 1 2, 0 2, 0 0))
    """
    flat = shapely.transform(shapely.force_2d(polygons), lambda xy: xy + 0.0)
    oriented: NDArray[np.object_] = shapely.orient_polygons(shapely.normalize(flat))
    return oriented


def sort_canonically(polygons: NDArray[np.object_]) -> NDArray[np.int64]:
    """Order polygons by geometry alone: by their bounds, then by their bytes.

    Parameters
    ----------
    polygons : object, (n,)
        Canonical shapely Polygons.

    Returns
    -------
    int64, (n,)
        Indices that sort them. Bitwise equal polygons keep their input order.
    """
    blobs = np.array(shapely.to_wkb(polygons, byte_order=1), dtype=object)
    ranks = np.unique(blobs, return_inverse=True)[1] if len(blobs) else np.zeros(0, np.int64)
    return np.lexsort((ranks, *shapely.bounds(polygons).reshape(-1, 4).T[::-1]))


def drop_needless_vertices(
    polygons: NDArray[np.object_], tolerance: float
) -> tuple[NDArray[np.object_], NDArray[np.bool_]]:
    """Remove the vertices that make no shape: repeated, collinear, or the tip of a spike or a slit.

    A vertex is needless if the triangle that it makes with its two neighbours is thinner than the tolerance.
    The thinnest one of each neighbourhood goes first, until none is left, so a second call changes nothing.

    Parameters
    ----------
    polygons : object, (n,)
        Canonical shapely Polygons, none empty.
    tolerance : float
        Least altitude of a triangle that counts as shape (m).

    Returns
    -------
    polygons : object, (n,)
        The polygons; None where the shell vanished. A removal may make a ring cross
        another one: test validity.
    spiked : bool, (n,)
        True where a vertex went that was farther than the tolerance from both its neighbours and did not lie
        between them.

    Notes
    -----
    O(vertices) for each of a few rounds. Ties are broken by (x, y).

    Examples
    --------
    >>> house = shapely.Polygon([(0, 0), (5, 0.001), (9, 0), (9, 7), (9, 8), (9.001, 7), (0, 7)])
    >>> cleaned, spiked = drop_needless_vertices(np.array([house]), 0.01)
    >>> print(cleaned[0], spiked[0])
    POLYGON ((0 0, 9 0, 9.001 7, 0 7, 0 0)) True
    """
    left = _open_rings(polygons)
    changed, spiked = np.zeros((2, len(polygons)), np.bool_)
    while len(drop := _choose_needless(left, tolerance)):
        owner = left.owner[left.ring[drop]]
        changed[owner] = True
        spiked[owner[_is_tip(left, drop, tolerance)]] = True
        left = left.leave_out(drop)
    result = polygons.copy()
    if changed.any():
        result[changed] = _build(left, np.flatnonzero(changed))
    return result, spiked


def compute_sharpest_corners(polygons: NDArray[np.object_]) -> NDArray[np.float64]:
    """Compute the smallest angle between two consecutive edges of each polygon, inside or outside.

    Parameters
    ----------
    polygons : object, (n,)
        shapely Polygons, none empty.

    Returns
    -------
    float64, (n,)
        Angles in degrees, 0 to 180.

    Examples
    --------
    >>> compute_sharpest_corners(np.array([shapely.box(0, 0, 1, 2)]))
    array([90.])
    """
    rings = _open_rings(polygons)
    back = rings.xy[rings.before] - rings.xy
    ahead = rings.xy[rings.after] - rings.xy
    cross = back[:, 0] * ahead[:, 1] - back[:, 1] * ahead[:, 0]
    angle = np.degrees(np.arctan2(np.abs(cross), (back * ahead).sum(axis=1)))
    sharpest = np.full(len(polygons), 180.0)
    np.minimum.at(sharpest, rings.owner[rings.ring], angle)
    return sharpest


@dataclass(frozen=True, eq=False)
class _Rings:
    """Vertices of rings, the closing one left out, with their neighbours and the ring they are in.

    ``ring``, ``before`` and ``after`` are by vertex, ``owner`` (the polygon) and ``is_shell`` by ring.
    """

    xy: NDArray[np.float64]
    ring: NDArray[np.int64]
    owner: NDArray[np.int64]
    is_shell: NDArray[np.bool_]
    before: NDArray[np.int64]
    after: NDArray[np.int64]

    @property
    def n_rings(self) -> int:
        return len(self.owner)

    def leave_out(self, vertices: NDArray[np.int64]) -> "_Rings":
        stays = np.ones(len(self.ring), np.bool_)
        stays[vertices] = False
        return _link(self.xy[stays], self.ring[stays], self.owner, self.is_shell)


def _open_rings(polygons: NDArray[np.object_]) -> _Rings:
    rings, owner = shapely.get_rings(polygons, return_index=True)
    xy, ring = shapely.get_coordinates(rings, return_index=True)
    opened = np.ones(len(ring), np.bool_)
    opened[:-1] = ring[1:] == ring[:-1]
    opened[-1:] = False
    return _link(xy[opened], ring[opened], owner, _is_first(owner))


def _link(
    xy: NDArray[np.float64], ring: NDArray[np.int64], owner: NDArray[np.int64], is_shell: NDArray[np.bool_]
) -> _Rings:
    first = _is_first(ring)
    last = np.append(first[1:], first[:1])
    before = np.arange(-1, len(ring) - 1)
    after = np.arange(1, len(ring) + 1)
    before[first] = np.flatnonzero(last)
    after[last] = np.flatnonzero(first)
    return _Rings(xy, ring, owner, is_shell, before, after)


def _is_first(index: NDArray[np.int64]) -> NDArray[np.bool_]:
    first = np.ones(len(index), np.bool_)
    np.not_equal(index[1:], index[:-1], out=first[1:])
    return first


def _choose_needless(rings: _Rings, tolerance: float) -> NDArray[np.int64]:
    """Choose the vertices whose triangle is thinner than the tolerance and than those of both neighbours."""
    back, ahead, base = _sides(rings, slice(None))
    double_area = np.abs(back[:, 0] * ahead[:, 1] - back[:, 1] * ahead[:, 0])
    longest = np.maximum(np.maximum(np.hypot(*back.T), np.hypot(*ahead.T)), base)
    altitude = double_area / np.where(longest > 0, longest, 1.0)
    thin = np.flatnonzero(altitude < tolerance)
    if not len(thin):
        return thin
    order = thin[np.lexsort((thin, rings.xy[thin, 1], rings.xy[thin, 0], altitude[thin]))]
    rank = np.full(len(altitude), len(altitude))
    rank[order] = np.arange(len(order))
    first = (rank[thin] < rank[rings.before[thin]]) & (rank[thin] < rank[rings.after[thin]])
    return thin[first]


def _is_tip(rings: _Rings, vertices: NDArray[np.int64], tolerance: float) -> NDArray[np.bool_]:
    """Tell which vertices lie beyond one of their neighbours, and not close to either."""
    back, ahead, base = _sides(rings, vertices)
    legs = np.stack([np.hypot(*back.T), np.hypot(*ahead.T)])
    tip: NDArray[np.bool_] = (legs.min(axis=0) >= tolerance) & (base < legs.max(axis=0))
    return tip


def _sides(
    rings: _Rings, vertices: NDArray[np.int64] | slice
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Give the vectors from vertices to their neighbours, and the distance of these."""
    back = rings.xy[rings.before[vertices]] - rings.xy[vertices]
    ahead = rings.xy[rings.after[vertices]] - rings.xy[vertices]
    return back, ahead, np.hypot(*(ahead - back).T)


def _build(rings: _Rings, owners: NDArray[np.int64]) -> NDArray[np.object_]:
    """Make the polygons of these owners from what is left of their rings."""
    big_enough = np.bincount(rings.ring, minlength=rings.n_rings) >= 3
    has_shell = np.zeros(rings.owner.max() + 1, np.bool_)
    has_shell[rings.owner[rings.is_shell & big_enough]] = True
    use = big_enough & has_shell[rings.owner] & np.isin(rings.owner, owners)
    of_use = use[rings.ring]
    result = np.full(len(owners), None, dtype=object)
    if use.any():
        closed = shapely.linearrings(rings.xy[of_use], indices=_renumber(rings.ring[of_use]))
        owner = rings.owner[use]
        built = shapely.polygons(closed, indices=_renumber(owner))
        result[np.searchsorted(owners, np.unique(owner))] = built
    return result


def _renumber(ascending: NDArray[np.int64]) -> NDArray[np.int64]:
    return np.cumsum(_is_first(ascending)) - 1
