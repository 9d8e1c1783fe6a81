"""Buildings of city models as rows: outlines, heights, and the roof surfaces over them with their planes."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.data.citymodel import make_ids
from pipeline.data.notes import Note
from pipeline.data.roofs import Roofs, join_roofs, take_roofs
from tiler.cityinput.face_planes import FacePlanes, find_planes
from tiler.cityinput.faces import GROUND, NO_LOD, OUTLINE, ROOF, WALL, Faces, ModelBuilding, Shape, join_faces
from tiler.cityinput.levels import choose_shapes, find_outline
from tiler.georeference.frame import Frame, to_region

ROUNDING = 0.001  # m; coordinates in plan are whole multiples of it
STEEPEST = 10.0  # slope from which a face is a wall
STEEP_ROOF = 3.0  # area of a roof over its area in plan, 70 degrees, from which it is one beside flatter roofs
LEAST_FACE = 0.01  # m2 in plan; smaller faces are no roofs
ROOM = 0.5  # m, that a roof may reach beyond the heights of its surface
CROSSING_SHARE = 0.05  # of its area in plan, by which a face that crosses itself has less within its border
NOT_PLANAR = 0.1  # m; vertices farther than this from the plane of their roof are told

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Placing = tuple[Frame, float]  # how coordinates of a file become those of the region, and what is added to heights


@dataclass(frozen=True, eq=False)
class ModelRows:
    """Buildings of city models, one row each, and their roof surfaces."""

    # (n,): polygons and multipolygons in the region's CRS (m): where each building stands
    outlines: NDArray[np.object_]
    ids: NDArray[np.str_]
    given_height: Array  # (n,): height above ground by an attribute (m), NaN where there is none
    lod: Array  # (n,): level of detail that the surfaces are of; NaN without any
    base: Array  # (n,): lowest height of the building's faces (m), NaN without any
    start: Index  # (n + 1,): the surfaces of row k are ``start[k]`` to ``start[k + 1]``
    surfaces: NDArray[np.object_]  # (s,): roof surfaces in plan, shapely polygons
    roofs: Roofs  # their planes

    def __len__(self) -> int:
        return len(self.ids)


_COLUMNS = ("outlines", "ids", "given_height", "lod", "base")  # that have a value a building


def no_rows() -> ModelRows:
    """Give no building at all."""
    nothing = np.empty(0)
    return ModelRows(
        nothing.astype(object), nothing.astype(np.str_), nothing, nothing, nothing, np.zeros(1, np.int64),
        nothing.astype(object), join_roofs([]),
    )  # fmt: skip


def take_rows(rows: ModelRows, chosen: Index) -> ModelRows:
    """Take some buildings, in the order of `chosen`, int64 (k,)."""
    count = np.diff(rows.start)[chosen]
    start = np.concatenate(([0], np.cumsum(count)))
    surface = np.repeat(rows.start[chosen] - start[:-1], count) + np.arange(start[-1])
    columns: dict[str, Any] = {name: getattr(rows, name)[chosen] for name in _COLUMNS}
    roofs = take_roofs(rows.roofs, surface)
    return ModelRows(**columns, start=start, surfaces=rows.surfaces[surface], roofs=roofs)


def join_rows(several: Sequence[ModelRows]) -> ModelRows:
    """Put rows one after the other; none gives none."""
    parts = [no_rows(), *several]
    n = np.cumsum([0, *(len(rows.surfaces) for rows in parts)])
    start = np.concatenate([[0], *(rows.start[1:] + k for rows, k in zip(parts, n, strict=False))])
    joined: dict[str, Any] = {
        name: np.concatenate([getattr(rows, name) for rows in parts]) for name in (*_COLUMNS, "surfaces")
    }
    roofs = join_roofs([rows.roofs for rows in parts])
    return ModelRows(**joined, start=start.astype(np.int64), roofs=roofs)


def mean_roofs(rows: ModelRows) -> Array:
    """Give the mean height of each roof above the building's lowest place (m): its volume over its area.

    Where there is no roof it is the height that an attribute gives, NaN without one.
    """
    owner = np.repeat(np.arange(len(rows)), np.diff(rows.start))
    area = shapely.area(rows.surfaces)
    middle = shapely.get_coordinates(shapely.centroid(rows.surfaces)).reshape(-1, 2)
    top = rows.roofs.plane[:, 2] + (rows.roofs.plane[:, :2] * (middle - rows.roofs.origin)).sum(axis=1)
    total = np.bincount(owner, area, minlength=len(rows))
    with np.errstate(invalid="ignore"):
        mean = np.bincount(owner, area * top, minlength=len(rows)) / total - rows.base
    return np.where(total > 0, mean, rows.given_height)


def make_rows(
    buildings: Sequence[ModelBuilding], frame: Frame, asked: str, counts: Counter[str], shift: float = 0.0
) -> tuple[ModelRows, list[Note]]:
    """Make rows of the buildings of a file that stand somewhere, in their order.

    Parameters
    ----------
    buildings : sequence of ModelBuilding
        As a file has them.
    frame : Frame
        How its coordinates become those of the region.
    asked : str
        Which level of detail is wanted, one of `levels.CHOICES`.
    counts : Counter of str
        Numbers for the record are added, by name.
    shift : float
        Added to all heights (m).

    Returns
    -------
    ModelRows
    list of Note
        ``model-fault`` for what could not be read, ``model-lower-level`` where a level without roofs was left for
        a lower one, ``model-no-roof`` where none has any, ``model-self-crossing``, ``model-steep-roof``,
        ``model-not-planar``, and ``model-without-place``.

    Notes
    -----
    Roof surfaces are those that the file calls so, else all faces but walls and the ground: where several lie over
    each other, the highest counts. A plane passes through the middle of its border, at right angles to the area
    vector.
    """
    attempts = [choose_shapes(building, asked) for building in buildings]
    left = {k: first for k, tries in enumerate(attempts) if (first := next(tries, None)) is not None}
    best = {k: level for k, (level, _) in left.items()}
    done: dict[int, _Found] = {}
    while left:
        tried = _find_roofs([(k, *one) for k, one in left.items()], (frame, shift))
        done |= {k: found for k, found in tried.items() if len(found.surfaces)}
        later = ((k, next(attempts[k], None)) for k in left if k not in done)
        left = {k: one for k, one in later if one is not None}
    outlines = [(k, 0.0, find_outline(one)) for k, one in enumerate(buildings) if k not in done]
    places = _find_outlines([each for each in outlines if len(each[2])], (frame, shift))
    notes: list[Note] = []
    kept = [k for k in range(len(buildings)) if k in done or k in places]
    _count(len(buildings), best, (done, places), counts)
    rows = _assemble(buildings, kept, done, places)
    xy = shapely.get_coordinates(shapely.point_on_surface(rows.outlines)).reshape(-1, 2)
    where = dict(zip(kept, xy.tolist(), strict=True))
    for k, building in enumerate(buildings):
        notes += _note(building, best.get(k, NO_LOD), done.get(k), where.get(k))
    return rows, notes


@dataclass(frozen=True, eq=False)
class _Found:
    """Outline, level and roof surfaces of one building.

    `residual` (m) is that of each surface, `crossing` the number of faces that cross themselves,
    `steep` that of roofs which are taken for walls.
    """

    outline: shapely.Geometry
    lod: float
    base: float
    surfaces: NDArray[np.object_]
    roofs: Roofs
    residual: Array
    crossing: int
    steep: int


def _to_region(faces: Faces, placing: Placing) -> Faces:
    frame, shift = placing
    xy = np.round(to_region(frame, faces.xyz[:, :2]) / ROUNDING) * ROUNDING
    # A whole number of millimetres as the nearest float, whatever the multiplication gave.
    xyz = np.column_stack((np.round(xy, 3), faces.xyz[:, 2] * frame.height + shift))
    return Faces(xyz, faces.ring_start, faces.face_start, faces.kind)


def _find_roofs(tries: Sequence[tuple[int, float, list[Shape]]], placing: Placing) -> dict[int, _Found]:
    """Find outlines and roofs of buildings, all faces at a time; none for those without roof surfaces."""
    faces = _to_region(join_faces(shape.faces for _, _, shapes in tries for shape in shapes), placing)
    owner = np.repeat(np.arange(len(tries)), [sum(len(s.faces) for s in shapes) for _, _, shapes in tries])
    planes = find_planes(faces)
    up = np.abs(planes.normal[:, 2])
    whole = np.linalg.norm(planes.normal, axis=1)
    lying = (up * STEEPEST > whole) & (up > LEAST_FACE)
    named = np.bincount(owner[lying & (faces.kind == ROOF)], minlength=len(tries)) > 0
    roof = lying & np.where(named[owner], faces.kind == ROOF, (faces.kind != GROUND) & (faces.kind != WALL))
    # Columns cannot follow steeper ones exactly: of a building that has others, these are walls.
    steep = roof & (up * STEEP_ROOF <= whole)
    steep &= np.bincount(owner[roof & ~steep], minlength=len(tries))[owner] > 0
    roof &= ~steep
    ground = lying & (faces.kind == GROUND)
    polygons = np.full(len(faces), None, object)
    polygons[lying] = _make_polygons(faces, np.flatnonzero(lying))
    # The area vector of a face that crosses itself is too short: it says not where a building stands.
    area = np.zeros(len(faces))
    area[lying] = shapely.area(polygons[lying])
    crossing = area - up > np.maximum(CROSSING_SHARE * area, LEAST_FACE)
    by_ground = np.bincount(owner[ground], minlength=len(tries)) > 0
    by_ground &= np.bincount(owner[ground & crossing], minlength=len(tries)) == 0
    outer = np.where(by_ground[owner], ground, lying)
    base = np.full(len(tries), np.inf)
    np.minimum.at(base, owner, planes.low)
    limits, of_roof = np.flatnonzero(np.diff(owner, prepend=-1, append=len(tries))), np.flatnonzero(roof)
    roofs = _make_roofs(planes, of_roof)
    first = np.searchsorted(of_roof, limits)
    found = {}
    for begin, end, low, high in zip(limits[:-1], limits[1:], first[:-1], first[1:], strict=True):
        which = int(owner[begin])
        if low == high:
            continue
        outline = shapely.union_all(polygons[begin:end][outer[begin:end]])
        own = np.arange(low, high)
        found[tries[which][0]] = _Found(
            _areas_of(outline), tries[which][1], float(base[which]), polygons[of_roof[own]],
            take_roofs(roofs, own), planes.residual[of_roof[own]], int(crossing[begin:end].sum()),
            int(steep[begin:end].sum()),
        )  # fmt: skip
    return {k: each for k, each in found.items() if not each.outline.is_empty}


def _find_outlines(tries: Sequence[tuple[int, float, Faces]], placing: Placing) -> dict[int, shapely.Geometry]:
    found = {}
    for k, _, faces in tries:
        placed = _to_region(faces, placing)
        lying = np.flatnonzero(np.isin(faces.kind, (OUTLINE, GROUND)))
        outline = _areas_of(shapely.union_all(_make_polygons(placed, lying)))
        if not outline.is_empty:
            found[k] = outline
    return found


def _make_polygons(faces: Faces, chosen: Index) -> NDArray[np.object_]:
    """Polygons of faces in plan, made valid: a part without area is gone."""
    rings = np.diff(faces.face_start)
    ring_face = np.repeat(np.arange(len(faces)), rings)
    ring = np.flatnonzero(np.isin(ring_face, chosen))
    count = np.diff(faces.ring_start)
    vertex = np.repeat(np.isin(np.arange(len(count)), ring), count)
    number = np.cumsum(np.isin(np.arange(len(count)), ring)) - 1
    index = np.repeat(number, count)[vertex]
    lines = shapely.linearrings(faces.xyz[vertex, :2], indices=index) if len(index) else np.empty(0, object)
    face = np.searchsorted(chosen, ring_face[ring])
    polygons = shapely.polygons(lines, indices=face) if len(face) else np.empty(0, object)
    bad = ~shapely.is_valid(polygons)
    polygons[bad] = [_areas_of(one) for one in shapely.make_valid(polygons[bad])]
    made: NDArray[np.object_] = polygons
    return made


def _areas_of(geometry: shapely.Geometry) -> shapely.Geometry:
    """Give what of a geometry has an area."""
    if geometry.geom_type in ("Polygon", "MultiPolygon"):
        return geometry
    parts = shapely.get_parts(geometry)
    return shapely.union_all([part for part in parts if part.geom_type in ("Polygon", "MultiPolygon")])


def _make_roofs(planes: FacePlanes, rows: Index) -> Roofs:
    normal, centre = planes.normal[rows], planes.centre[rows]
    slope = -normal[:, :2] / normal[:, 2:]
    origin = np.floor(centre[:, :2])
    height = centre[:, 2] + ((origin - centre[:, :2]) * slope).sum(axis=1)
    level = np.abs(slope).max(axis=1, initial=0.0) < 1e-6  # a millionth: rounding of coordinates
    slope[level], height[level] = 0.0, centre[level, 2]
    limits = np.column_stack((planes.low[rows] - ROOM, planes.high[rows] + ROOM))
    limits[level] = height[level, np.newaxis]
    return Roofs(np.column_stack((slope, height)), origin, limits)


def _assemble(
    buildings: Sequence[ModelBuilding],
    kept: Sequence[int],
    done: dict[int, _Found],
    places: dict[int, shapely.Geometry],
) -> ModelRows:
    outlines = np.empty(len(kept), object)
    outlines[:] = [done[k].outline if k in done else places[k] for k in kept]
    ids = np.array([buildings[k].id for k in kept], np.str_)
    missing = ids == ""
    if missing.any():
        ids = ids.astype(object)
        ids[missing] = make_ids(outlines[missing])
        ids = ids.astype(np.str_)
    n_surfaces = [len(done[k].surfaces) if k in done else 0 for k in kept]
    nothing = np.empty(0, object)
    return ModelRows(
        outlines,
        ids,
        np.array([buildings[k].height for k in kept], np.float64),
        np.array([done[k].lod if k in done else np.nan for k in kept], np.float64),
        np.array([done[k].base if k in done else np.nan for k in kept], np.float64),
        np.concatenate(([0], np.cumsum(n_surfaces))).astype(np.int64),
        np.concatenate([nothing, *(done[k].surfaces for k in kept if k in done)]),
        join_roofs([done[k].roofs for k in kept if k in done]),
    )


def _count(
    n: int,
    best: dict[int, float],
    found: tuple[dict[int, _Found], dict[int, shapely.Geometry]],
    counts: Counter[str],
) -> None:
    done, places = found
    counts["model buildings"] += n
    for k in range(n):
        if k in done:
            level = done[k].lod
            counts[f"model buildings at level {level:g}" if level >= 0 else "model buildings without level"] += 1
            counts["model buildings at a lower level"] += int(level != best[k])
            counts["model roof surfaces"] += len(done[k].surfaces)
        elif k in places:
            counts["model buildings with an outline alone"] += 1
        else:
            counts["model buildings without a place"] += 1


def _note(
    building: ModelBuilding,
    best: float,
    found: _Found | None,
    place: Sequence[float] | None,
) -> list[Note]:
    """Tell of a building what could not be read of it, or not as it is."""
    x, y = place if place is not None else (float("nan"), float("nan"))
    tell = partial(Note, subject=building.id, x=x, y=y)
    notes = [tell("model-fault", detail=fault) for fault in building.faults]
    if found is not None:
        if best != found.lod:
            notes.append(tell("model-lower-level", detail=f"level {best:g} has no roof; {found.lod:g}"))
        if found.crossing:
            detail = f"{found.crossing} of its surfaces cross themselves; taken as they lie in plan"
            notes.append(tell("model-self-crossing", detail=detail))
        if found.steep:
            detail = f"{found.steep} roof surfaces steeper than 70 degrees are taken for walls"
            notes.append(tell("model-steep-roof", detail=detail))
        worst = float(found.residual.max())
        if worst > NOT_PLANAR:
            n = int((found.residual > NOT_PLANAR).sum())
            detail = f"{n} of {len(found.surfaces)} roof surfaces are not planar, by {worst:.2f} m at most"
            notes.append(tell("model-not-planar", detail=detail))
    elif place is not None:
        known = f"its height of {building.height:g} m" if building.height > 0 else "the default height"
        notes.append(tell("model-no-roof", detail=f"no level has a roof; {known} is taken over its outline"))
    else:
        notes.append(tell("model-without-place", detail="it has neither faces that lie nor an outline; left out"))
    return notes
