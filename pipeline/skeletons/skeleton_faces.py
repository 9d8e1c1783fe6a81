"""Faces of a straight skeleton: one polygon for each edge of the outline, and the checks that they pass."""

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import shapely

from pipeline.data.errors import GeometryError
from pipeline.skeletons.wavefront import CONTACT, Point, Wavefront

AREA_TOLERANCE = 1e-9  # of the area of the polygon, by which the sum of the faces may differ from it
UPRIGHT = 1e-4  # m², area that the upright part of a face may have by rounding
SAME_TIME = 4 * CONTACT
PLACE_TOLERANCE = 1e-5  # m, by which nodes may be off the planes of their edges where none were joined


def follow_faces(front: Wavefront) -> list[list[int]]:
    """Collect the nodes of each face, counter-clockwise, the two ends of its edge first.

    A wavefront that has come to its end has noted what follows on what around each face.

    Raises
    ------
    GeometryError
        If a face does not close.
    """
    faces = []
    n_lines = 2 * len(front.birth)
    for e, start in enumerate(front.first):
        end = front.end[e]
        nodes = [front.birth[start], front.birth[end]]
        line, left = 2 * end, n_lines
        while line >= 0 and left:
            v, down = divmod(line, 2)
            nodes += (front.death[v], front.birth[v]) if down else (front.birth[v], front.death[v])
            line = (front.after_down if down else front.after_up)[v]
            left -= 1
        if line >= 0 or nodes[-1] != nodes[0]:
            raise GeometryError(f"the face of the edge{describe_edge(front, e)} does not close")
        faces.append(drop_repeated(nodes))
    return faces


def drop_repeated(nodes: Sequence[int]) -> list[int]:
    """Drop nodes that follow on themselves, and the last one if it is the first."""
    kept = [node for k, node in enumerate(nodes) if k == 0 or node != nodes[k - 1]]
    while len(kept) > 1 and kept[-1] == kept[0]:
        kept.pop()
    return kept


def describe_edge(front: Wavefront, e: int) -> str:
    """Name an edge by its ends."""
    (x, y), (to_x, to_y) = (front.node_xy[front.birth[v]] for v in (front.first[e], front.end[e]))
    return f" from ({x:.3f}, {y:.3f}) to ({to_x:.3f}, {to_y:.3f})"


def join_close_nodes(front: Wavefront, faces: list[list[int]], tolerance: float) -> list[list[int]]:
    """Make one node of those at both ends of a ridge, hip or valley that is shorter than a tolerance.

    Parameters
    ----------
    front : Wavefront
        Nodes.
    faces : list of list of int
        Nodes of each face.
    tolerance : float
        Length below which a line between two nodes is none (m).

    Returns
    -------
    list of list of int
        Nodes of each face, no node farther than the tolerance from the one that it became. Nodes whose joining
        would break a face stay as they were: faces narrower than the tolerance are as true as wide ones.
    """
    same = _find_joined(front, faces, tolerance)
    if all(node == to for node, to in enumerate(same)):
        return faces
    while True:
        joined = [drop_repeated([same[node] for node in face]) for face in faces]
        faults = find_faults(front, joined, tolerance)
        broken = {same[node] for e in faults for node in faces[e]}
        apart = [node for node, to in enumerate(same) if to in broken and to != node]
        if not apart:
            return joined
        for node in apart:
            same[node] = node


def _find_joined(front: Wavefront, faces: list[list[int]], tolerance: float) -> list[int]:
    """Give the node that each node becomes, the first of those that are one, shortest lines first."""
    xy, n_edges = front.node_xy, len(faces)
    lines = {tuple(sorted(pair)) for face in faces for pair in pairwise([*face[1:], face[0]])}
    short = sorted((math.dist(xy[a], xy[b]), a, b) for a, b in lines)
    same = list(range(len(xy)))
    members = {node: [node] for node in same}
    for length, a, b in short:
        low, high = sorted((same[a], same[b]))
        if length >= tolerance:
            break
        if low != high and high >= n_edges and all(math.dist(xy[low], xy[k]) < tolerance for k in members[high]):
            for node in members[high]:
                same[node] = low
            members[low] += members.pop(high)
    return same


def face_area(xy: Sequence[Point]) -> float:
    """Area of a polygon, positive if it is counter-clockwise."""
    x0, y0 = xy[0]
    from_first = [(x - x0, y - y0) for x, y in xy]
    return 0.5 * sum(ax * by - ay * bx for (ax, ay), (bx, by) in pairwise(from_first))


def is_monotone(xy: Sequence[Point], tolerance: float) -> bool:
    """Tell whether a face is monotone to its edge, which goes from its first node to its second.

    Seen along the edge, the nodes after it go forward (around its end), then back, then forward (around its
    start). A step of up to `tolerance` in the other direction counts as none.
    """
    (x0, y0), (x1, y1) = xy[0], xy[1]
    length = math.hypot(x1 - x0, y1 - y0)
    ux, uy = (x1 - x0) / length, (y1 - y0) / length
    places = [ux * (x - x0) + uy * (y - y0) for x, y in [*xy[1:], xy[0]]]
    turns = 0
    extreme = places[0]
    for s in places:
        sign = -1 if turns == 1 else 1
        if (s - extreme) * sign >= 0:
            extreme = s
        elif abs(s - extreme) > tolerance:
            turns += 1
            extreme = s
    return turns <= 2


def find_faults(front: Wavefront, faces: list[list[int]], tolerance: float) -> dict[int, str]:
    """Find the faces that are no faces of a skeleton, and say why.

    A face has an area (where its edge has a speed) and no side that crosses another one. It is monotone to its
    edge (where all edges have one speed from the start). Its nodes are as far from its edge as their time says.
    """
    faults: dict[int, str] = {}
    even = len(set(front.speed)) == 1 and not any(front.start)
    sloped = [sloped_part(face, front.node_time, front.start[e]) for e, face in enumerate(faces)]
    for e, face in enumerate(faces):
        xy = [front.node_xy[node] for node in sloped[e]]
        off = max(_off_plane(front, e, node, tolerance) for node in face)
        if off > PLACE_TOLERANCE:
            faults[e] = f"has a node {off:.3g} m off its plane"
        elif front.speed[e] > 0 and not (len(xy) > 2 and face_area(xy) > 0):
            faults[e] = "has no area"
        elif even and not is_monotone(xy, tolerance + CONTACT):
            faults[e] = "is not monotone"
        elif _upright_area(front, e, face, xy) > UPRIGHT:
            faults[e] = "is not upright below"
    whole = [e for e, face in enumerate(sloped) if len(face) > 3 and front.speed[e] > 0 and e not in faults]
    if whole:
        rings = shapely.linearrings(
            [front.node_xy[node] for e in whole for node in sloped[e]],
            indices=np.repeat(np.arange(len(whole)), [len(sloped[e]) for e in whole]),
        )
        crossed = ~shapely.is_simple(rings)
        faults.update((whole[k], "crosses itself") for k in np.flatnonzero(crossed).tolist())
    return faults


def sloped_part(face: Sequence[int], time: Sequence[float], start: float) -> list[int]:
    """Nodes of a face but for the upright part of an edge that sets off later."""
    return [node for node in face if time[node] > start - SAME_TIME] if start > 0 else list(face)


def _off_plane(front: Wavefront, e: int, node: int, tolerance: float) -> float:
    """How much farther than the tolerance a node is from the plane of an edge; upright parts have no tolerance."""
    start, time = front.start[e], front.node_time[node]
    off = abs(front.ahead(e, front.node_xy[node], max(time, start)))
    return off - tolerance if front.speed[e] > 0 and time > start else off


def _upright_area(front: Wavefront, e: int, face: list[int], sloped: list[Point]) -> float:
    """Area in plan (m²) of the part of a face that should be upright, and have none."""
    if front.speed[e] > 0 and not front.start[e] > 0:
        return 0.0
    rest = face_area(sloped) if front.speed[e] > 0 else 0.0
    return abs(face_area([front.node_xy[node] for node in face]) - rest)


def check_faces(front: Wavefront, faces: list[list[int]], area: float, tolerance: float) -> None:
    """Prove that faces divide the polygon, one for each edge.

    Raises
    ------
    GeometryError
        If an edge has no face, a face has a fault (`find_faults`), or the areas do not sum to that of the polygon.
    """
    if len(faces) != len(front.offset):
        raise GeometryError(f"{len(faces)} faces for {len(front.offset)} edges")
    for e, fault in find_faults(front, faces, tolerance).items():
        raise GeometryError(f"the face of the edge{describe_edge(front, e)} {fault}")
    total = sum(face_area([front.node_xy[node] for node in face]) for face in faces)
    if abs(total - area) > AREA_TOLERANCE * area:
        raise GeometryError(f"faces have {total:.9g} m² of {area:.9g} m²")
