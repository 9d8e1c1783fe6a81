"""Straight skeleton of a polygon with courtyards, edges of any speed (step 2.0, ours)."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.data.errors import GeometryError
from pipeline.geometry.rings import make_canonical
from pipeline.skeletons.skeleton_faces import check_faces, follow_faces, join_close_nodes
from pipeline.skeletons.wavefront import CONTACT, Point, Wavefront

MIN_EDGE = 1e-4  # m, a polygon with a shorter edge is refused
MAX_EXTENT = 1e5  # m
TOLERANCE = 0.005  # m, lines of the skeleton that are shorter are one node

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Skeleton:
    """Straight skeleton of a polygon of ``m`` edges.

    Edges are numbered along the rings of the polygon in canonical form (`make_canonical`): the outline
    counter-clockwise, then courtyards clockwise, so that the polygon is on their left. Where the vertex of a
    courtyard lies on an edge of another ring, it divides that edge in two.
    """

    nodes: Array  #: (n, 2): places (m) in the CRS of the polygon: its vertices, to the bit, then the nodes inside
    #: (n,): when the wavefront reaches each node: its distance from each of its edges, divided by their speed
    time: Array
    edges: Index  #: (m, 2): nodes where each edge starts and ends
    speed: Array  #: (m,): distance that each edge moves in a unit of time
    start: Array  #: (m,): time when each edge sets off
    #: (m + 1,): the face of edge ``e`` has the nodes ``face_node[face_start[e]:face_start[e + 1]]``
    face_start: Index
    #: (k,): nodes of each face, counter-clockwise, the two ends of its edge first. An edge of speed 0 has a face
    #: without area, one that sets off later a part without area below its other nodes
    face_node: Index
    origin: Array  #: (2,): whole metres near the polygon; the work is done in coordinates relative to it

    def __len__(self) -> int:
        return len(self.edges)

    def face(self, e: int) -> Index:
        """Nodes of the face of an edge, int64 (k,)."""
        return self.face_node[self.face_start[e] : self.face_start[e + 1]]


def outline_edges(polygon: shapely.Polygon) -> Array:
    """Give the edges of a polygon in the order in which skeletons number them.

    Returns
    -------
    float64, (m, 2, 2)
        From and to of each edge (m).

    Examples
    --------
    >>> outline_edges(shapely.box(0, 0, 2, 1))[:, 0].tolist()
    [[0.0, 0.0], [2.0, 0.0], [2.0, 1.0], [0.0, 1.0]]
    """
    rings, _ = _read_rings(polygon)
    return np.concatenate([np.stack((ring, np.roll(ring, -1, axis=0)), axis=1) for ring in rings])


def straight_skeleton(
    polygon: shapely.Polygon,
    speed: Sequence[float] | Array | None = None,
    *,
    start: Sequence[float] | Array | None = None,
    tolerance: float = TOLERANCE,
) -> Skeleton:
    """Compute the straight skeleton of a polygon.

    Parameters
    ----------
    polygon : shapely.Polygon
        A valid polygon (m), with or without courtyards, in any orientation and order.
    speed : float64, (m,), optional
        Speed of each edge in the order of `outline_edges`, not negative: 1 if none are given. The roof of an
        edge of speed 2 is half as steep, an edge of speed 0 stays where it is: a gable.
    start : float64, (m,), optional
        Time when each edge sets off, not negative: 0 if none are given. Until then it stays, a gable under a hip.
    tolerance : float
        Lines of the skeleton that are shorter are one node (m).

    Returns
    -------
    Skeleton
        One face for each edge.

    Raises
    ------
    GeometryError
        If the polygon is not valid, has an edge shorter than `MIN_EDGE` or no skeleton with these speeds, or
        the result fails a check (`check_faces`). It names the place.
    ValueError
        If there is not one finite speed ≥ 0 for each edge, or all are 0; likewise for starts.

    Notes
    -----
    Edges move inwards, and vertices along the bisectors between them. Events come from a queue in the order of
    time: an edge has no length any more, or a vertex runs into an edge. Whatever else is within 1e-6 m of the
    place at that time takes part: the event ends all these vertices in one node and joins the edges around it
    anew, in the order of their directions. So edge, split and vertex events are one, of any number of edges.
    Where two edges come to lie on each other (line-segment event) the part that they share ends at once as a
    ridge. At last nodes are joined whose line is shorter than `tolerance`.

    O(n²) for n edges; about 1.5 ms for 8 edges.

    References
    ----------
    Aichholzer et al. (1995), A novel type of skeleton for polygons; Sugihara and Shen, Straight skeleton
    computation optimized for automatic generation of 3D roof model (events with several edges, line-segment
    events, faces); Kelly and Wonka (2011), Interactive architectural modeling with procedural extrusions (edges
    around an event joined by direction); Biedl et al. (2015), Weighted straight skeletons in the plane.

    Examples
    --------
    >>> skeleton = straight_skeleton(shapely.box(0, 0, 6, 4))
    >>> skeleton.nodes[4:].tolist(), skeleton.time[4:].tolist()
    ([[2.0, 2.0], [4.0, 2.0]], [2.0, 2.0])
    >>> skeleton.face(0).tolist()
    [0, 1, 5, 4]
    """
    rings, origin = _read_rings(polygon)
    n_edges = sum(map(len, rings))
    speeds = _check_values("speeds", [1.0] * n_edges if speed is None else speed, n_edges)
    starts = _check_values("starts", [0.0] * n_edges if start is None else start, n_edges)
    if not any(speeds):
        raise ValueError("not all speeds may be 0")
    local = [[(float(x), float(y)) for x, y in (ring - origin).tolist()] for ring in rings]
    try:
        _check_edges(local, list(zip(speeds, starts, strict=True)))
        front = Wavefront(local, speeds, starts)
        front.run()
        faces = follow_faces(front)
        check_faces(front, faces, polygon.area, 0.0)
        joined = join_close_nodes(front, faces, tolerance)
    except GeometryError as error:
        x, y = origin.tolist()
        raise GeometryError(
            f"straight skeleton of the polygon of {n_edges} edges at ({x:.0f}, {y:.0f}): {error} (places "
            "relative to that); simplify the polygon there, or give it a flat roof"
        ) from None
    return _make_skeleton(front, joined, np.concatenate(rings), origin)


def _read_rings(polygon: shapely.Polygon) -> tuple[list[Array], Array]:
    """Give the open rings of a polygon in canonical form, and the whole metres near it."""
    if not (isinstance(polygon, shapely.Polygon) and shapely.is_valid(polygon) and polygon.area > 0):
        place = shapely.get_coordinates(polygon)[:1].tolist()
        raise GeometryError(
            f"straight skeleton: no valid polygon with an area at {place}: {shapely.is_valid_reason(polygon)}"
        )
    canonical = make_canonical(np.array([polygon], dtype=object))
    xy, ring = shapely.get_coordinates(shapely.get_rings(canonical), return_index=True)
    stays = np.ones(len(xy), np.bool_)
    stays[1:] = (ring[1:] != ring[:-1]) | (xy[1:] != xy[:-1]).any(axis=1)
    xy, ring = xy[stays], ring[stays]
    rings = [part[:-1] for part in np.split(xy, np.flatnonzero(np.diff(ring)) + 1)]
    if len(rings) > 1:
        rings = [_divide(ring, np.concatenate(rings[:k] + rings[k + 1 :])) for k, ring in enumerate(rings)]
    return rings, np.floor(rings[0].min(axis=0))


def _divide(ring: Array, vertices: Array) -> Array:
    """Put the vertices of other rings that lie on edges of a ring between the ends of these."""
    along = np.roll(ring, -1, axis=0) - ring
    square = (along**2).sum(axis=1)
    to = vertices[:, np.newaxis] - ring
    place = (to * along).sum(axis=2) / square
    across = np.abs(along[:, 0] * to[..., 1] - along[:, 1] * to[..., 0]) / np.sqrt(square)
    apart = CONTACT / np.sqrt(square)
    vertex, edge = np.nonzero((across <= CONTACT) & (place > apart) & (place < 1 - apart))
    if not len(edge):
        return ring
    order = np.lexsort((place[vertex, edge], edge))
    divided: Array = np.insert(ring, edge[order] + 1, vertices[vertex[order]], axis=0)
    distinct: Array = divided[(divided != np.roll(divided, 1, axis=0)).any(axis=1)]
    return distinct


def _check_values(name: str, given: Sequence[float] | Array, n_edges: int) -> list[float]:
    values: list[float] = np.asarray(given, np.float64).tolist()
    if len(values) != n_edges or not all(0 <= value < math.inf for value in values):
        raise ValueError(f"{n_edges} edges need as many finite {name} ≥ 0: {values}")
    return values


def _check_edges(rings: list[list[Point]], motion: list[tuple[float, float]]) -> None:
    """Refuse edges that are too short, and those on one line with different speeds or starts."""
    start = 0
    for ring in rings:
        n = len(ring)
        for k in range(n):
            (ax, ay), (bx, by), (cx, cy) = ring[k], ring[(k + 1) % n], ring[(k + 2) % n]
            length, following = math.hypot(bx - ax, by - ay), math.hypot(cx - bx, cy - by)
            if not MIN_EDGE <= length <= MAX_EXTENT:
                bounds = f"{MIN_EDGE} to {MAX_EXTENT:.0f} m"
                raise GeometryError(f"the edge at ({ax:.3f}, {ay:.3f}) is {length:.2g} m long, not {bounds}")
            one, other = motion[start + k], motion[start + (k + 1) % n]
            turn = (bx - ax) * (cy - by) - (by - ay) * (cx - bx)
            ahead = (bx - ax) * (cx - bx) + (by - ay) * (cy - by)
            if one != other and ahead > 0 and abs(turn) <= CONTACT * length * following:
                raise GeometryError(
                    f"edges on one line have speeds and starts {one} and {other} at ({bx:.3f}, {by:.3f})"
                )
        start += n


def _make_skeleton(front: Wavefront, faces: list[list[int]], outline: Array, origin: Array) -> Skeleton:
    """Put the nodes that are left in the order of their place, after those of the outline."""
    n_edges = len(faces)
    inside = sorted(
        {node for face in faces for node in face if node >= n_edges},
        key=lambda node: (front.node_time[node], front.node_xy[node]),
    )
    kept = [*range(n_edges), *inside]
    place = {node: k for k, node in enumerate(kept)}
    count = np.array([0, *map(len, faces)], np.int64)
    nodes = np.array([front.node_xy[node] for node in kept]) + origin
    # To the bit: also those inside that lie over a vertex, as at the top of a wall between two gables.
    vertex = {front.node_xy[node]: node for node in range(n_edges)}
    for k, node in enumerate(kept):
        if front.node_xy[node] in vertex:
            nodes[k] = outline[vertex[front.node_xy[node]]]
    return Skeleton(
        nodes=nodes,
        time=np.array([front.node_time[node] for node in kept]),
        edges=np.array([face[:2] for face in faces], np.int64),
        speed=np.array(front.speed),
        start=np.array(front.start),
        face_start=np.cumsum(count),
        face_node=np.array([place[node] for face in faces for node in face], np.int64),
        origin=origin,
    )
