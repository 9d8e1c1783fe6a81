"""Roofs of a shape over any outline, by straight skeletons: hipped, gabled and others (step 2.0, ours)."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.data.roof_forms import ROOF_SHAPES
from pipeline.data.roofs import Roofs
from pipeline.geometry.rings import make_canonical
from pipeline.skeletons.part_cycles import LevelCuts, join_cycles
from pipeline.skeletons.skeleton_faces import face_area, sloped_part
from pipeline.skeletons.straight_skeleton import TOLERANCE, Skeleton, outline_edges, straight_skeleton

DEFAULT_SLOPE = 0.7  # m per m, about 35 degrees
BREAK_TIME = 0.3  # share of the way from the eaves to the highest ridge where a mansard roof becomes less steep
BREAK_HEIGHT = 0.6  # share of its height that it has there
HALF_HIP = 0.5  # share of its height that the gable of a half-hipped roof has below its hip
MIN_DISTANCE = 0.01  # m, distance from each edge of the apex of a pyramidal roof
GABLE_BETWEEN = -0.7  # cosine of the angle between the two edges beside a gable, above which there is none

STRAIGHT = 0.17  # sine of the angle between edges of one side, about 10 degrees
LEAST_CORNER = 0.5  # sine of the turn at both ends of a gable: from 30 to 150 degrees
TRIANGLE_OFF = 0.05  # share of its area by which the hip over a gable may differ from a triangle

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True)
class RoofForm:
    """The roof that is wanted, as by ``roof:shape``, ``roof:height``, ``roof:angle``, ``roof:direction``."""

    shape: str = "hipped"  #: one of `ROOF_SHAPES`
    #: slope of the steepest part (m per m), of a mansard roof on the whole; not used if a height is given
    slope: float = DEFAULT_SLOPE
    height: float | None = None  #: height of the highest ridge above the eaves (m)
    #: where a skillion roof looks, downhill: degrees clockwise from north. If none is given, towards the longest
    #: edge. A gabled, half-hipped or gambrel roof over four sides has its gables where it looks least
    direction: float | None = None
    #: whether the ridge of such a roof over four sides runs along the shorter ones, where no direction is given
    across: bool = False
    #: edges, numbered as by `outline_edges`, that are gables of a gabled, half-hipped or gambrel roof. If none are
    #: given, those that `find_gables` finds
    gables: Sequence[int] | None = None


@dataclass(frozen=True, eq=False)
class ShapedRoof:
    """A roof of ``p`` parts over one polygon."""

    shape: str  #: the shape that was made: "hipped" where a pyramidal one was wanted over an outline that has none
    nodes: Array  #: (n, 2): places of all vertices (m) in the CRS of the polygon, its own to the bit
    height: Array  #: (n,): height of the roof there (m)
    part_start: Index  #: (p + 1,): part ``i`` has the nodes ``part_node[part_start[i]:part_start[i + 1]]``
    #: (k,): nodes around each part, counter-clockwise. Parts beside each other have all nodes between them in
    #: common. None for a flat or skillion roof
    part_node: Index
    edge: Index  #: (p,): edge of the outline that each part rises from; -1 for a flat or skillion roof
    roofs: Roofs  #: plane and limits of each part
    polygon: shapely.Polygon  #: the outline in canonical form

    def __len__(self) -> int:
        return len(self.edge)

    def cycle(self, i: int) -> Index:
        """Nodes around part ``i``, int64 (k,)."""
        return self.part_node[self.part_start[i] : self.part_start[i + 1]]

    @cached_property
    def parts(self) -> NDArray[np.object_]:
        """The parts as canonical shapely Polygons, object (p,), of these nodes to the bit."""
        if not len(self.part_node):
            return np.array([self.polygon], dtype=object)
        ring = np.repeat(np.arange(len(self)), np.diff(self.part_start))
        return make_canonical(shapely.polygons(shapely.linearrings(self.nodes[self.part_node], indices=ring)))


def skeleton_roofs(
    polygon: shapely.Polygon,
    eaves: float,
    form: RoofForm = RoofForm(),
    *,
    min_area: float = 0.0,
    tolerance: float = TOLERANCE,
) -> ShapedRoof:
    """Make a roof of a shape over a polygon.

    Parameters
    ----------
    polygon : shapely.Polygon
        A valid polygon (m), with or without courtyards.
    eaves : float
        Height of the eaves, the lowest of the roof (m).
    form : RoofForm
        The roof that is wanted.
    min_area : float
        Least area of a part (m²). A smaller one is joined to the neighbour whose plane is closest to it.
    tolerance : float
        As for `straight_skeleton`.

    Returns
    -------
    ShapedRoof
        Parts that cover the polygon without overlap, and their planes.

    Raises
    ------
    GeometryError
        If there is no straight skeleton of the polygon with these gables (`straight_skeleton`).
    ValueError
        If the form is none.

    Notes
    -----
    A gable is an edge of speed 0, a half hip one that sets off when it is half as high as a gable. The roof of a
    mansard is the hipped one, that of a gambrel the gabled one, with a steep lower part: as all edges that move
    have one speed, both have one plan. The edges of a pyramidal roof meet in one place, the centroid; where an
    edge does not face it the roof is hipped.

    Examples
    --------
    >>> roof = skeleton_roofs(shapely.box(0, 0, 6, 4), 10.0, RoofForm("gabled", height=3.0))
    >>> [part.area for part in roof.parts], roof.height.tolist()
    ([12.0, 12.0], [10.0, 10.0, 10.0, 10.0, 13.0, 13.0])
    """
    _check_form(form)
    if form.shape in ("flat", "skillion"):
        return _one_plane(polygon, eaves, form)
    shape, skeleton = _shaped_skeleton(polygon, form, tolerance)
    top = float(skeleton.time.max())
    steepest = float(skeleton.speed[skeleton.speed > 0].min())
    height = form.height if form.height is not None else form.slope * steepest * top
    plan = _Plan.of(skeleton, eaves, height / top)
    if shape in ("mansard", "gambrel"):
        plan = _break_slopes(plan, skeleton, eaves, height)
    if min_area > 0:
        _join_small_parts(plan, skeleton, min_area)
    return _make_roof(shape, plan, skeleton, polygon)


def find_gables(skeleton: Skeleton) -> list[int]:
    """Find the edges of a hipped roof that may be gables.

    Parameters
    ----------
    skeleton : Skeleton
        Of the outline, all edges with one speed.

    Returns
    -------
    list of int
        The edges of sides whose hip is a triangle between two convex corners, and whose neighbours run in about
        opposite directions: the ends of the wings of a house. Shorter sides come first; none is beside another
        one.

    Notes
    -----
    A side is a run of edges that turn by less than 10 degrees from one to the next: outlines have vertices within
    their walls, where they touch others.
    """
    xy, edges = (skeleton.nodes - skeleton.origin).tolist(), skeleton.edges.tolist()
    before = {stop: e for e, (_, stop) in enumerate(edges)}
    after = {start: e for e, (start, _) in enumerate(edges)}
    along = [_direction(xy, edge) for edge in edges]
    found = []
    for side in _straight_sides(edges, along, after):
        start, stop = edges[side[0]][0], edges[side[-1]][1]
        one, other = before[start], after[stop]
        corners = min(_cross(along[one], along[side[0]]), _cross(along[side[-1]], along[other]))
        opposite = along[one][0] * along[other][0] + along[one][1] * along[other][1] < GABLE_BETWEEN
        if corners > LEAST_CORNER and opposite and _is_triangle(skeleton, side, (start, stop)):
            found.append((round(math.dist(xy[start], xy[stop]), 3), side, one, other))
    gables: list[int] = []
    for _, side, one, other in sorted(found):
        if one not in gables and other not in gables:
            gables += side
    return gables


def _straight_sides(
    edges: list[list[int]], along: list[tuple[float, float]], after: dict[int, int]
) -> list[list[int]]:
    """Put edges together that turn little from one to the next; a ring without a corner has no sides."""
    following = [after[stop] for _, stop in edges]
    bends = [abs(_cross(along[e], along[k])) > STRAIGHT for e, k in enumerate(following)]
    sides = []
    for e, bend in enumerate(bends):
        if bend:
            side = [following[e]]
            while not bends[side[-1]]:
                side.append(following[side[-1]])
            sides.append(side)
    return sides


def _is_triangle(skeleton: Skeleton, side: list[int], ends: tuple[int, int]) -> bool:
    """Tell whether the faces of a side make about a triangle whose tip lies between its ends."""
    xy = skeleton.nodes - skeleton.origin
    faces = [skeleton.face(e) for e in side]
    nodes = np.concatenate(faces)
    tip = nodes[np.argmax(skeleton.time[nodes])]
    (x, y), (to_x, to_y), (tip_x, tip_y) = ((float(p[0]), float(p[1])) for p in xy[[*ends, tip]])
    square = (to_x - x) ** 2 + (to_y - y) ** 2
    place = ((to_x - x) * (tip_x - x) + (to_y - y) * (tip_y - y)) / square
    triangle = face_area([(x, y), (to_x, to_y), (tip_x, tip_y)])
    area = sum(face_area([(float(p[0]), float(p[1])) for p in xy[face]]) for face in faces)
    return 0 < place < 1 and abs(area - triangle) <= TRIANGLE_OFF * triangle


def roof_solid(roof: ShapedRoof, floor: float) -> tuple[Array, list[list[int]]]:
    """Close a roof of parts with walls down to a level floor.

    Parameters
    ----------
    roof : ShapedRoof
        A roof of parts, of any shape but flat and skillion.
    floor : float
        Height of the floor, below the eaves (m).

    Returns
    -------
    points : float64, (n, 3)
        Vertices (m).
    facets : list of list of int
        Vertices around each facet, counter-clockwise from outside: roofs, floors and walls, all plane.
    """
    n = len(roof.nodes)
    low = np.column_stack((roof.nodes, np.full(n, floor)))
    points = np.concatenate((low, np.column_stack((roof.nodes, roof.height))))
    cycles = [roof.cycle(i).tolist() for i in range(len(roof))]
    sides = {(a, b) for cycle in cycles for a, b in zip(cycle, [*cycle[1:], cycle[0]], strict=True)}
    tops = [[n + node for node in cycle] for cycle in cycles]
    floors = [cycle[::-1] for cycle in cycles]
    walls = [[a, b, n + b, n + a] for a, b in sorted(sides) if (b, a) not in sides]
    return points, tops + floors + walls


@dataclass
class _Plan:
    """Parts while they are made: cycles of nodes, and height as ``base + rise * time`` on the plane of an edge."""

    xy: list[tuple[float, float]]
    height: list[float]
    cycles: list[list[int]]
    edge: list[int]
    base: list[float]
    rise: list[float]

    @classmethod
    def of(cls, skeleton: Skeleton, eaves: float, rise: float) -> "_Plan":
        """Take the faces of all edges that move."""
        moving = np.flatnonzero(skeleton.speed > 0).tolist()
        xy = [(x, y) for x, y in (skeleton.nodes - skeleton.origin).tolist()]
        height = (eaves + rise * skeleton.time).tolist()
        starts, time = skeleton.start[moving].tolist(), skeleton.time.tolist()
        cycles = [sloped_part(skeleton.face(e).tolist(), time, t) for e, t in zip(moving, starts, strict=True)]
        return cls(xy, height, cycles, moving, [eaves + rise * t for t in starts], [rise] * len(moving))


def _shaped_skeleton(polygon: shapely.Polygon, form: RoofForm, tolerance: float) -> tuple[str, Skeleton]:
    """Compute the skeleton with the speeds of a shape, and tell the shape."""
    shape = form.shape
    if shape == "pyramidal":
        pyramid = _pyramid(polygon)
        if pyramid is not None:
            return shape, pyramid
        shape = "hipped"
    skeleton = straight_skeleton(polygon, tolerance=tolerance)
    gables = []
    if shape in ("gabled", "gambrel", "half-hipped"):
        gables = list(_choose_gables(skeleton, form) if form.gables is None else form.gables)
    if gables:
        speed = np.ones(len(skeleton))
        speed[gables] = 0.0
        skeleton = straight_skeleton(polygon, speed, tolerance=tolerance)
    if gables and shape == "half-hipped":
        skeleton = straight_skeleton(polygon, start=HALF_HIP * _gable_tips(skeleton), tolerance=tolerance)
    return shape, skeleton


def _choose_gables(skeleton: Skeleton, form: RoofForm) -> list[int]:
    """Find the gables; over four sides those that the form asks for."""
    if not form.across and form.direction is None:
        return find_gables(skeleton)
    xy, edges = (skeleton.nodes - skeleton.origin).tolist(), skeleton.edges.tolist()
    along = [_direction(xy, edge) for edge in edges]
    sides = _straight_sides(edges, along, {start: e for e, (start, _) in enumerate(edges)})
    if len(sides) != 4 or sum(map(len, sides)) != len(edges):
        return find_gables(skeleton)
    length, facing = [], []
    for side in sides:
        x, y = (xy[edges[side[-1]][1]][k] - xy[edges[side[0]][0]][k] for k in range(2))
        length.append(math.hypot(x, y))
        angle = math.radians(form.direction or 0.0)
        facing.append(abs(y * math.sin(angle) - x * math.cos(angle)) / length[-1])
    if form.direction is not None:
        odd = facing[0] + facing[2] > facing[1] + facing[3]  # the even sides look there: the odd ones are gables
    else:
        odd = length[0] + length[2] < length[1] + length[3]
    return sides[1] + sides[3] if odd else sides[0] + sides[2]


def _gable_tips(skeleton: Skeleton) -> Array:
    """Time of the highest node of each gable, the same for all edges of one side; 0 for edges that move."""
    gables = np.flatnonzero(skeleton.speed == 0).tolist()
    tips = np.zeros(len(skeleton))
    for e in gables:
        tips[e] = skeleton.time[skeleton.face(e)].max()
    beside = [(e, k) for e in gables for k in gables if skeleton.edges[e, 1] == skeleton.edges[k, 0]]
    for e, k in [*beside, *beside[::-1]]:
        tips[[e, k]] = tips[[e, k]].max()
    return tips


def _pyramid(polygon: shapely.Polygon) -> Skeleton | None:
    """Give the skeleton whose edges all reach the centroid at the time 1; None if an edge does not face it."""
    a, b = outline_edges(polygon).transpose(1, 0, 2)
    apex = shapely.get_coordinates(shapely.centroid(polygon))[0]
    along, to_apex = b - a, apex - a
    cross = along[:, 0] * to_apex[:, 1] - along[:, 1] * to_apex[:, 0]
    distance = cross / np.hypot(along[:, 0], along[:, 1])
    if not (distance > MIN_DISTANCE).all():
        return None
    n = len(a)
    edges = np.column_stack((np.arange(n), (np.arange(n) + 1) % n))
    return Skeleton(
        nodes=np.concatenate((a, apex[np.newaxis])),
        time=np.append(np.zeros(n), 1.0),
        edges=edges,
        speed=distance,
        start=np.zeros(n),
        face_start=np.arange(n + 1) * 3,
        face_node=np.column_stack((edges, np.full(n, n))).ravel(),
        origin=np.floor(a.min(axis=0)),
    )


def _break_slopes(plan: _Plan, skeleton: Skeleton, eaves: float, height: float) -> _Plan:
    """Cut all parts where the roof becomes less steep."""
    top = float(skeleton.time.max())
    level = BREAK_TIME * top
    steep, flat = BREAK_HEIGHT * height / level, (1 - BREAK_HEIGHT) * height / (top - level)
    bend = eaves + (steep - flat) * level
    cuts = LevelCuts(plan.xy, skeleton.time.tolist(), level)
    broken = _Plan([], [], [], [], [], [])
    for cycle, e in zip(plan.cycles, plan.edge, strict=True):
        below, above = cuts.cut(cycle, _direction(plan.xy, skeleton.edges[e].tolist()))
        broken.cycles += below + above
        broken.edge += [e] * (len(below) + len(above))
        broken.base += [eaves] * len(below) + [bend] * len(above)
        broken.rise += [steep] * len(below) + [flat] * len(above)
    broken.xy = cuts.xy
    broken.height = [eaves + steep * t if t <= level else bend + flat * t for t in cuts.time]
    return broken


def _join_small_parts(plan: _Plan, skeleton: Skeleton, min_area: float) -> None:
    """Join parts that are too small, the smallest first, with the neighbour whose plane is closest to them."""
    kept: set[int] = set()
    while True:
        areas = [(face_area([plan.xy[node] for node in cycle]), i) for i, cycle in enumerate(plan.cycles)]
        small = min(((area, i) for area, i in areas if area < min_area and i not in kept), default=None)
        if small is None:
            return
        i = small[1]
        choices = []
        for k, cycle in enumerate(plan.cycles):
            joined = join_cycles(cycle, plan.cycles[i]) if k != i else None
            if joined:
                choices.append((_farthest(plan, skeleton, plan.cycles[i], k), k, joined))
        if not choices:
            kept.add(i)  # an island in one part, or the only part
            continue
        _, k, plan.cycles[k] = min(choices)
        for values in (plan.cycles, plan.edge, plan.base, plan.rise):
            del values[i]
        kept = {j - (j > i) for j in kept}


def _farthest(plan: _Plan, skeleton: Skeleton, cycle: list[int], k: int) -> float:
    """Largest height between the nodes of a cycle and the plane of part ``k``."""
    a, b, c = _plane(plan, skeleton, k)
    return max(abs(a * plan.xy[node][0] + b * plan.xy[node][1] + c - plan.height[node]) for node in cycle)


def _plane(plan: _Plan, skeleton: Skeleton, k: int) -> tuple[float, float, float]:
    """Slopes of part ``k`` eastwards and northwards, and its height at the origin of the skeleton."""
    e = plan.edge[k]
    start, stop = skeleton.edges[e].tolist()
    (x, y), (ux, uy) = plan.xy[start], _direction(plan.xy, (start, stop))
    slope = plan.rise[k] / float(skeleton.speed[e])
    a, b = -uy * slope, ux * slope
    return a, b, plan.base[k] - a * x - b * y


def _make_roof(shape: str, plan: _Plan, skeleton: Skeleton, polygon: shapely.Polygon) -> ShapedRoof:
    limits = [[f([plan.height[node] for node in cycle]) for f in (min, max)] for cycle in plan.cycles]
    n = len(plan.cycles)
    added = np.array(plan.xy[len(skeleton.nodes) :]).reshape(-1, 2) + skeleton.origin
    return ShapedRoof(
        shape=shape,
        nodes=np.concatenate((skeleton.nodes, added)),
        height=np.array(plan.height),
        part_start=np.cumsum([0, *map(len, plan.cycles)]),
        part_node=np.array([node for cycle in plan.cycles for node in cycle], np.int64),
        edge=np.array(plan.edge, np.int64),
        roofs=Roofs(
            np.array([_plane(plan, skeleton, k) for k in range(n)]),
            np.tile(skeleton.origin, (n, 1)),
            np.array(limits),
        ),
        polygon=make_canonical(np.array([polygon], dtype=object))[0],
    )


def _one_plane(polygon: shapely.Polygon, eaves: float, form: RoofForm) -> ShapedRoof:
    """Make a flat roof or a skillion one of one plane."""
    edges = outline_edges(polygon)
    origin = np.floor(edges[:, 0].min(axis=0))
    xy = edges[:, 0] - origin
    a = b = 0.0
    if form.shape == "skillion":
        a, b = _uphill(xy, edges[:, 1] - origin, form.direction)
    ahead = xy[:, 0] * a + xy[:, 1] * b
    low, extent = float(ahead.min()), float(np.ptp(ahead))
    slope = 0.0 if not extent else form.height / extent if form.height is not None else form.slope
    height = eaves + slope * (ahead - low)
    return ShapedRoof(
        shape=form.shape,
        nodes=edges[:, 0],
        height=height,
        part_start=np.zeros(2, np.int64),
        part_node=np.empty(0, np.int64),
        edge=np.array([-1]),
        roofs=Roofs(
            np.array([[slope * a, slope * b, eaves - slope * low]]),
            origin[np.newaxis],
            np.array([[eaves, float(height.max())]]),
        ),
        polygon=make_canonical(np.array([polygon], dtype=object))[0],
    )


def _uphill(start: Array, stop: Array, direction: float | None) -> tuple[float, float]:
    """Unit vector uphill of a skillion roof."""
    if direction is not None:
        return -math.sin(math.radians(direction)), -math.cos(math.radians(direction))
    ux, uy = (stop - start).T
    length = np.hypot(ux, uy)
    e = int(np.argmax(np.round(length, 3)))
    return float(-uy[e] / length[e]), float(ux[e] / length[e])


def _direction(xy: Sequence[tuple[float, float]], edge: Sequence[int]) -> tuple[float, float]:
    (x, y), (to_x, to_y) = xy[edge[0]], xy[edge[1]]
    length = math.hypot(to_x - x, to_y - y)
    return (to_x - x) / length, (to_y - y) / length


def _cross(a: tuple[float, float], b: tuple[float, float]) -> float:
    return a[0] * b[1] - a[1] * b[0]


def _check_form(form: RoofForm) -> None:
    if form.shape not in ROOF_SHAPES:
        raise ValueError(f"roof shape {form.shape!r} is none of {', '.join(ROOF_SHAPES)}")
    if not form.slope > 0 or (form.height is not None and not form.height > 0):
        raise ValueError(f"slope and height of a roof must be positive: {form}")
