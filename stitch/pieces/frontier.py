"""The frontier: what pieces of a mesh share, followed from piece to piece in bounded memory (conformity).

A piece meets the others over its rim: the edges of its plan outline that are not on the region's border. What it
has there, faces, boundary edges and points, waits in the frontier until all pieces around have come; then it is
settled and let go. A plan edge is done when it has come from both sides, a place in the plan when all edges there
are done.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.data.regions import Region
from stitch.pieces.conformity import group_rows

MARKED = 8  # added to the region of a face, see `Rim`
Bounds = tuple[float, float, float, float]
Vertices = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Rim:
    """What a piece has over its rim."""

    edges: Vertices  #: (k, 2, 2): plan edges (m), from start to end with the piece on the left
    faces: Vertices  #: (f, 3, 3): exterior faces of the piece over these edges, pointing out of it
    is_boundary: Mask  #: (f,): whether the piece says that a face is the boundary of the whole mesh
    #: (f,): number of the part of the mesh that the cell behind a face belongs to, no two pieces have one in
    #: common
    part: NDArray[np.int64]
    #: (f,): `pipeline.data.mesh.Region` of that cell; `MARKED` more where the piece says that the face is what air
    #: and a building share
    side: NDArray[np.int8]
    #: (l, 2, 3): edges of boundary facets, from start to end, each as often as it occurs, with both ends over the
    #: rim
    lines: Vertices
    #: (p, 4): points over the rim, with the number of a kind: what is counted once of each place and kind
    points: Vertices


@dataclass(frozen=True, eq=False)
class Settled:
    """What has been found out about places that no further piece can meet."""

    n_matched: int  #: faces that two pieces have, in opposite orientations
    #: (s, 2): numbers of the pieces that share them, and of the parts that hang together by them, each pair once
    seams: NDArray[np.int64]
    joined: NDArray[np.int64]
    open: Vertices  #: (k, 3, 3): faces that are not on the boundary and that no other piece has
    extra: Vertices  #: (e, 3, 3): faces that a piece says are on the boundary although another piece has them too
    #: (t, 3, 3): faces of two pieces in the same orientation, and of more than two
    same_side: Vertices
    shared: Vertices
    #: (m, 3, 3): faces of cells that are not of one region, or are air and building, but not marked as such, or
    #: are marked and something else
    mixed: Vertices
    #: (l, 2, 3): boundary edges that facets do not use equally often in both directions, and others of more than
    #: two facets; each once
    open_lines: Vertices
    crowded_lines: Vertices
    n_walls: int = 0  #: how many of the matched faces are walls between air and a building with cells


@dataclass(frozen=True, eq=False)
class Frontier:
    """What waits: as in `Rim`, and `piece`, the number of the piece that a face came with."""

    rim: Rim
    piece: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.rim.faces) + len(self.rim.lines) + len(self.rim.points)


def start_frontier() -> Frontier:
    """Return the frontier before the first piece."""
    none = np.empty(0, np.bool_)
    number, side = np.empty(0, np.int64), np.empty(0, np.int8)
    faces, lines = np.empty((0, 3, 3)), np.empty((0, 2, 3))
    rim = Rim(np.empty((0, 2, 2)), faces, none, number, side, lines, np.empty((0, 4)))
    return Frontier(rim, number)


def find_outline(points: Vertices, facets: NDArray[np.int32]) -> Vertices:
    """Find the outline of a piece in the plan.

    Parameters
    ----------
    points : float64, (n, 3)
        Points (m).
    facets : int32, (k, 3)
        Exterior faces of the piece that face up.

    Returns
    -------
    float64, (e, 2, 2)
        Plan edges (m) that one facet alone has, with the facet on the left.
    """
    start, end = facets.ravel().astype(np.int64), np.roll(facets, -1, axis=1).ravel().astype(np.int64)
    n = len(points)
    alone = ~_are_among(start * n + end, end * n + start)
    edges: Vertices = points[np.stack((start, end), axis=1)[alone], :2]
    return edges


def find_border(edges: Vertices, bounds: Bounds, *, tolerance: float) -> Mask:
    """Tell which plan edges (e, 2, 2) lie on the border of the region, closer than `tolerance` (m)."""
    on = [(np.abs(edges - np.array(corner)) <= tolerance).all(axis=1) for corner in (bounds[:2], bounds[2:])]
    border: Mask = (on[0] | on[1]).any(axis=1)
    return border


def find_edges_below(corners: Vertices, edges: Vertices) -> NDArray[np.int64]:
    """Find the plan edge over which each facet stands upright.

    Parameters
    ----------
    corners : float64, (k, 3, 3)
        Vertices of the facets.
    edges : float64, (e, 2, 2)
        Edges in the plan, in either direction.

    Returns
    -------
    int64, (k,)
        An edge with the same ends, bit for bit; -1 where there is none.
    """
    places = as_places(corners)
    low, high = np.sort(places, axis=1)[:, [0, 2]].T
    upright = (low != high) & ((places == low[:, None]) | (places == high[:, None])).all(axis=1)
    ends = np.sort(as_places(edges), axis=1)
    known = np.unique(np.concatenate((low, high, ends.ravel())))
    facet_key = np.searchsorted(known, low) * len(known) + np.searchsorted(known, high)
    edge_key = np.searchsorted(known, ends[:, 0]) * len(known) + np.searchsorted(known, ends[:, 1])
    key, first = np.unique(edge_key, return_index=True)
    row = np.searchsorted(key, facet_key).clip(max=max(len(key) - 1, 0))
    found = upright.copy()
    found[upright] = key[row[upright]] == facet_key[upright] if len(key) else False
    edge = np.full(len(corners), -1)
    edge[found] = first[row[found]]
    return edge


def as_places(xy: Vertices) -> NDArray[np.complex128]:
    """Make one number of each x and y, (..., 2 or more) to (...): equal where both are."""
    places: NDArray[np.complex128] = xy[..., 0] + 1j * xy[..., 1]
    return places


def _are_among(values: NDArray[Any], others: NDArray[Any]) -> Mask:
    """Tell which values are among others, as `numpy.isin`, which hashes them and takes twice as long."""
    ordered = np.sort(others)
    row = np.searchsorted(ordered, values).clip(max=max(len(ordered) - 1, 0))
    found: Mask = ordered[row] == values if len(ordered) else np.zeros(values.shape, np.bool_)
    return found


def group_places(xy: Vertices) -> tuple[Vertices, NDArray[np.int64]]:
    """Number the distinct places among some (n, 2 or more): places (k, 2), ascending, and the number of each."""
    places, number = np.unique(as_places(xy), return_inverse=True)
    return np.column_stack((places.real, places.imag)), number.reshape(-1)


def find_points_over(points: Vertices, edges: Vertices) -> Mask:
    """Tell which points (n, 3) stand over an end of edges (e, 2, 2) in the plan, bit for bit."""
    return _are_among(as_places(points), as_places(edges).ravel())


def add_rim(frontier: Frontier, rim: Rim, piece: int) -> tuple[Frontier, Settled, Mask]:
    """Let a further piece meet those before it.

    Parameters
    ----------
    frontier : Frontier
        What waits.
    rim : Rim
        What the piece has.
    piece : int
        Its number.

    Returns
    -------
    Frontier
        What waits now.
    Settled
        What is settled by this.
    bool, (p,)
        Which of the piece's points no earlier piece had.

    Notes
    -----
    Only what touches the box around the piece's rim is looked at closely; the rest of the frontier costs one
    comparison a number, and a sort of its plan edges.
    """
    old = frontier.rim
    edges = _pair_edges(np.concatenate((old.edges, rim.edges)))
    open_places = np.unique(as_places(edges))
    low, high = rim.edges.min(axis=(0, 1), initial=np.inf), rim.edges.max(axis=(0, 1), initial=-np.inf)

    def is_done(waiting: Vertices, new: Vertices) -> Mask:
        """Tell which rows of vertices (n, v, 2 or more) are settled; of those that waited, what is touched."""
        xy = np.concatenate((waiting, new))[..., :2]
        touched = ((xy >= low) & (xy <= high)).all(axis=2).any(axis=1)
        touched[len(waiting) :] = True
        done: Mask = touched.copy()
        done[touched] = ~np.isin(as_places(xy[touched]), open_places).any(axis=1)
        return done

    faces = np.concatenate((old.faces, rim.faces))
    is_boundary = np.concatenate((old.is_boundary, rim.is_boundary))
    pieces = np.concatenate((frontier.piece, np.full(len(rim.faces), piece)))
    part, side = np.concatenate((old.part, rim.part)), np.concatenate((old.side, rim.side))
    face_done = is_done(old.faces, rim.faces)
    lines = np.concatenate((old.lines, rim.lines))
    line_done = is_done(old.lines, rim.lines)
    fresh = _find_fresh(old.points, rim.points, low, high)
    points = np.concatenate((old.points, rim.points[fresh]))
    point_done = is_done(old.points[:, None], rim.points[fresh][:, None])
    left, of_done = ~face_done, (pieces[face_done], part[face_done], side[face_done])
    settled = _settle(faces[face_done], is_boundary[face_done], *of_done, lines[line_done])
    waiting = Rim(
        edges, faces[left], is_boundary[left], part[left], side[left], lines[~line_done], points[~point_done]
    )
    return Frontier(waiting, pieces[left]), settled, fresh


def close_frontier(frontier: Frontier) -> Settled:
    """Settle what still waits after the last piece."""
    rim = frontier.rim
    return _settle(rim.faces, rim.is_boundary, frontier.piece, rim.part, rim.side, rim.lines)


def _pair_edges(edges: Vertices) -> Vertices:
    """Take out the plan edges that have come from both sides."""
    ends = as_places(edges)
    forward = ends[:, 0] < ends[:, 1]
    low, high = np.where(forward[:, None], ends, ends[:, ::-1]).T
    group, n_groups = group_rows(np.column_stack((low.real, low.imag, high.real, high.imag)))
    n_forward, count = np.bincount(group, forward, n_groups), np.bincount(group, minlength=n_groups)
    left: Vertices = edges[((n_forward != 1) | (count != 2))[group]]
    return left


def _find_fresh(old: Vertices, new: Vertices, low: Vertices, high: Vertices) -> Mask:
    """Tell which rows are new, and the first of their kind among the new."""
    near = old[((old[:, :2] >= low) & (old[:, :2] <= high)).all(axis=1)]
    group, n_groups = group_rows(np.concatenate((near, new)))
    first = np.full(n_groups, len(group))
    np.minimum.at(first, group, np.arange(len(group)))
    fresh: Mask = first[group[len(near) :]] == np.arange(len(near), len(group))
    return fresh


def _settle(
    faces: Vertices,
    is_boundary: Mask,
    piece: NDArray[np.int64],
    part: NDArray[np.int64],
    side: NDArray[np.int8],
    lines: Vertices,
) -> Settled:
    corner, _ = group_rows(faces.reshape(-1, 3))
    order = np.argsort(corner.reshape(-1, 3), axis=1)
    group, n_groups = group_rows(np.sort(corner.reshape(-1, 3), axis=1))
    count = np.bincount(group, minlength=n_groups)[group]
    n_even = np.bincount(group, (order[:, 1] - order[:, 0]) % 3 == 1, n_groups)[group]
    n_boundary = np.bincount(group, is_boundary, n_groups)[group]
    opposite = (count == 2) & (n_even == 1)
    matched = opposite & (n_boundary == 0)
    # Rows of one face stand together, so its two pieces are neighbours in this order.
    rows = np.flatnonzero(matched)
    two = rows[np.argsort(group[rows], kind="stable")].reshape(-1, 2)
    low, high = np.sort(side[two], axis=1).T
    same = (low == high) & (high < MARKED)
    wall = (low == Region.BUILDING) & (high == Region.AIR + MARKED)
    open_lines, crowded_lines = _settle_lines(lines)
    return Settled(
        n_matched=len(two),
        seams=np.unique(np.sort(piece[two], axis=1), axis=0),
        joined=np.unique(np.sort(part[two], axis=1), axis=0),
        open=faces[(count == 1) & ~is_boundary],
        extra=faces[opposite & is_boundary],
        same_side=faces[(count == 2) & ~opposite],
        shared=faces[count > 2],
        mixed=faces[two[~(same | wall), 0]],
        open_lines=open_lines,
        crowded_lines=crowded_lines,
        n_walls=int(wall.sum()),
    )


def _settle_lines(lines: Vertices) -> tuple[Vertices, Vertices]:
    end, n_points = group_rows(lines.reshape(-1, 3))
    start, stop = end.reshape(-1, 2).T
    key = np.minimum(start, stop) * n_points + np.maximum(start, stop)
    _, first, group = np.unique(key, return_index=True, return_inverse=True)
    count = np.bincount(group, minlength=len(first))
    is_open = 2 * np.bincount(group, start < stop, len(first)) != count
    return lines[first[is_open]], lines[first[~is_open & (count > 2)]]
