"""The buildings of tiles: as the city model has them, and in fewer and fewer triangles from level to level.

In the smallest cells each building, or part of one, has the most detailed solid of the city model. In those
above, a distance from these is allowed. What is lower than half of that is left out; parts of a house whose
roofs are within it of one height become a block, of an outline with fewer vertices; parts that are not stay. So
a house is of LoD2.2, then 1.3, then 1.2. Where blocks are given (LoD0C, 0B, 0A), the highest that is within that
distance of the houses in it takes their place, as far as it lies in the cell.
"""

import json
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

import numpy as np
import shapely

from pipeline.city_model.sloped_solids import ROOF, WALL
from pipeline.data.errors import InputError
from pipeline.data.mesh import Marker
from tiler.cityinput.face_planes import cut_face
from tiler.citymodels.building_index import (
    BuildingRow,
    Vertices,
    check_indices,
    copy_vertices,
    has_parts,
    read_building,
    read_objects,
)
from tiler.stages.blocks import LAYERS
from tiler.store.run_folder import WRONG_FIELD
from tiler.tiles3d.blocks import Block, Pieces, take_areas
from tiler.tiles3d.content import Ints, Layer, Surface, join_surfaces
from tiler.tiles3d.globe import Array
from tiler.tiles3d.metadata import NO_NUMBER, Column

TEXTS = ("roof_method", "roof_source")
NUMBERS = ("ground_height", "roof_height", "height", "roof_rmse", "roof_within")
BLOCKS = "1.2", "1.3"  # levels of detail of a house's only block, and of one of several
LOW = 0.5  # of the distance that a level allows: what is lower is left out
PLAN_SHARE = 0.5  # of the distance that a level allows: for outlines, the rest is for those of levels below
SIDE_SHARE = 0.2  # of the side of a square of its area: by more an outline loses its shape
STEP = 0.001  # of coordinates of the city model (m)


@dataclass(frozen=True, eq=False)
class Part:
    """A building, or part of one, at its most detailed level."""

    #: its id, and that of the building that it is a part of
    id: str
    house: str
    lod: str  #: level of detail
    attributes: dict[str, Any]  #: those of `TEXTS` and `NUMBERS` that it has
    footprint: str  #: its outline, as WKB in hexadecimal digits
    xyz: list[list[float]]  #: vertices (m); those at the bottom are at the lowest ground beside it
    triangles: list[list[int]]  #: their corners
    roof: list[bool]  #: whether each triangle is of the roof
    blocks: list[str] = field(default_factory=list)  #: ids of the blocks that it is in, the lowest level first


@dataclass(frozen=True, eq=False)
class Unit:
    """A part as it is, or a block that stands for parts of a house or for several houses."""

    house: str  #: id of the house; ``""`` of several
    outline: Any  #: outline in the CRS (m)
    #: lowest ground beside it, and lowest and highest place of the roofs that it stands for (m)
    bottom: float
    low: float
    high: float
    attributes: dict[str, Any]  #: those of `TEXTS` and `NUMBERS` that it has
    moved: float = 0.0  #: how far its outline is from that of the parts (m), at most
    part: Part | None = None  #: the part itself; None for a block
    blocks: Sequence[str] = ()  #: ids of the blocks that it is in, the lowest level first
    block: Block | None = None  #: what stands for several houses

    @property
    def top(self) -> float:
        """Height of the roof of a block (m): without one of its own, the middle of the roofs."""
        return (self.low + self.high) / 2 if self.block is None else self.block.top

    @property
    def rise(self) -> float:
        """Distance of its roofs from one height (m)."""
        return max(self.top - self.low, self.high - self.top)

    @property
    def error(self) -> float:
        """Distance from the parts that it stands for (m)."""
        return max(self.rise, self.moved) if self.part is None else 0.0


def read_parts(model: Path, lowest: Mapping[int, float], told: Counter[str]) -> Iterator[Part]:
    """Read the buildings of a run's city model that have a solid.

    Parameters
    ----------
    model : Path
        CityJSON file of the run.
    lowest : mapping of int to float
        Lowest place of the walls in the mesh (m), by number of building.
    told : Counter of str
        What must be known of them is counted here.

    Raises
    ------
    InputError
        If the file is missing or damaged.

    Notes
    -----
    The file is read twice, an object at a time.
    """
    with TemporaryFile() as vertex_file:
        vertices = copy_vertices(model, vertex_file)
        for name, thing in read_objects(model):
            if has_parts(model, thing):
                continue
            row = read_building(model, name, thing, vertices)
            try:
                part = _read_part(name, thing, vertices, row, lowest, told)
            except WRONG_FIELD as error:
                raise InputError(
                    f"{model}: building {name!r}: a field is missing or wrong ({error!r}); run again"
                ) from None
            if part is not None:
                yield part


def _read_part(
    name: str,
    thing: Mapping[str, Any],
    vertices: Vertices,
    row: BuildingRow,
    lowest: Mapping[int, float],
    told: Counter[str],
) -> Part | None:
    solids = [item for item in thing["geometry"] if item["type"] == "Solid"]
    told["buildings without a solid, which are left out"] += not solids
    if not solids:
        return None
    solid = max(solids, key=lambda item: float(item["lod"]))
    (shell,) = solid["boundaries"]
    (kinds,) = solid["semantics"]["values"]
    used = np.unique(np.concatenate([check_indices(ring, len(vertices)) for face in shell for ring in face]))
    xyz = vertices.take(used)
    # By place: the numbers of vertices depend on the other buildings of the file.
    order = np.lexsort(xyz.T[::-1])
    used, xyz = used[order], xyz[order]
    places = dict(zip(used.tolist(), range(len(used)), strict=True))
    floor = xyz[:, 2].min()
    xyz[xyz[:, 2] == floor, 2] = min(floor, lowest.get(row.number, floor))
    out: list[int] = []
    triangles: list[list[int]] = []
    roof: list[bool] = []
    for face, kind in zip(shell, kinds, strict=True):
        if kind not in (ROOF, WALL):
            continue
        rings = [[places[vertex] for vertex in ring] for ring in face]
        own = _cut(rings, xyz, told, wall=kind == WALL)
        # A face has vertices of its own, as its normal is its own.
        corners = sorted({corner for one in own for corner in one})
        number = {corner: len(out) + k for k, corner in enumerate(corners)}
        out += corners
        triangles += [[number[corner] for corner in one] for one in own]
        roof += [kind == ROOF] * len(own)
    if not triangles:
        return None
    values = thing["attributes"]
    return Part(
        name,
        thing["parents"][0] if thing.get("parents") else name,
        str(solid["lod"]),
        {key: values[key] for key in (*TEXTS, *NUMBERS) if values.get(key) is not None},
        shapely.to_wkb(row.footprint, hex=True),
        (np.round(xyz[out] / STEP) * STEP).tolist(),
        triangles,
        roof,
    )


def _cut(rings: list[list[int]], xyz: Array, told: Counter[str], *, wall: bool) -> list[list[int]]:
    """Cut a face into triangles."""
    ring = rings[0]
    if len(rings) == 1 and (len(ring) == 3 or (wall and len(ring) == 4)):
        return [[ring[0], a, b] for a, b in pairwise(ring[1:])]
    found = cut_face(rings, xyz)
    told["faces that cross themselves, cut into triangles around a corner"] += found is None
    return [[ring[0], a, b] for a, b in pairwise(ring[1:])] if found is None else found


def write_part(part: Part) -> bytes:
    """Write a part as a line."""
    return (json.dumps(vars(part), separators=(",", ":")) + "\n").encode()


def load_parts(data: bytes) -> list[Part]:
    """Read lines of `write_part`."""
    return [Part(**json.loads(line)) for line in data.splitlines()]


def make_units(parts: Sequence[Part]) -> list[Unit]:
    """Make a unit of each part, in the order of their ids."""
    found = []
    for part in sorted(parts, key=lambda part: part.id):
        roofs = [
            part.xyz[k][2] for one, is_roof in zip(part.triangles, part.roof, strict=True) if is_roof for k in one
        ]
        top = part.attributes["roof_height"]
        low, high = (min(roofs), max(roofs)) if roofs else (top, top)
        bottom = min(z for _, _, z in part.xyz)
        outline = shapely.from_wkb(part.footprint)
        found.append(Unit(part.house, outline, bottom, low, high, part.attributes, part=part, blocks=part.blocks))
    return found


def generalise(units: Sequence[Unit], allowed: float, pieces: Pieces) -> tuple[list[Unit], float]:
    """Make what stands for the units of the level below.

    Parameters
    ----------
    units : sequence of Unit
        Those of the level below.
    allowed : float
        Distance from the buildings that the level allows (m).
    pieces : mapping of str to (Block, shapely geometry)
        Blocks in the cell, by id.

    Returns
    -------
    list of Unit
        What is left. Of a block that is wider than the distance, its height does not count: it is seen from above.
    float
        The largest distance of these from the buildings (m); of one that is left out its height.
    """
    error = 0.0
    own: dict[str, list[Unit]] = {}
    kept: list[Unit] = []
    for unit in _place_blocks(units, allowed, pieces):
        is_wide = unit.block is not None and unit.block.side > allowed
        if unit.high - unit.bottom <= LOW * allowed and not is_wide:
            error = max(error, unit.high - unit.bottom)
        elif unit.block is not None:
            kept.append(unit)
        else:
            own.setdefault(unit.house, []).append(unit)
    for house in sorted(own):
        group: list[Unit] = []
        for unit in sorted(own[house], key=lambda unit: (unit.low, unit.high)):
            if unit.rise > allowed:
                kept.append(unit)
            elif group and max(unit.high, *(one.high for one in group)) - group[0].low > 2 * allowed:
                kept.append(_merge(group, allowed))
                group = [unit]
            else:
                group.append(unit)
        if group:
            kept.append(_merge(group, allowed))
    return kept, max([error, *(unit.error for unit in kept)])


def _place_blocks(units: Sequence[Unit], allowed: float, pieces: Pieces) -> Sequence[Unit]:
    """Put blocks in the place of the houses that they stand for, where they are near enough: the highest first."""
    for level in reversed(LAYERS):
        groups = defaultdict[str, list[int]](list)
        for k, unit in enumerate(units):
            for below, name in zip(("", *unit.blocks), unit.blocks, strict=False):
                # An object of LoD0A that is one of LoD0B alone stays that.
                same = level == "0A" and below in pieces and pieces[below][0].members == pieces[name][0].members
                if name in pieces and pieces[name][0].level == level and not same:
                    groups[name].append(k)
        found, gone = list[Unit](), set[int]()
        for name in sorted(groups):
            unit = _stand_for([units[k] for k in groups[name]], *pieces[name], allowed)
            if unit.error <= allowed:
                found.append(unit)
                gone.update(groups[name])
        units = [*(unit for k, unit in enumerate(units) if k not in gone), *found]
    return units


def _stand_for(units: list[Unit], block: Block, piece: Any, allowed: float) -> Unit:
    """Make a block of the houses in a cell, of its outline there with fewer vertices.

    Its distance from them in plan is at most its height, as there is ground where it is not.
    """
    whole = shapely.union_all([unit.outline for unit in units], grid_size=STEP)
    outline = shapely.simplify(piece, min(allowed * PLAN_SHARE, piece.area**0.5 * SIDE_SHARE))
    bottom = min(unit.bottom for unit in units)
    moved = max(unit.moved for unit in units) + _distance(whole, outline)
    attributes = {"ground_height": block.ground, "roof_height": block.top, "height": block.top - block.ground}
    chain = units[0].blocks[list(units[0].blocks).index(block.id) :]
    low, high = min(unit.low for unit in units), max(unit.high for unit in units)
    near = min(moved, block.top - bottom)
    return Unit("", outline, bottom, low, high, attributes, near, blocks=chain, block=block)


def _distance(a: Any, b: Any) -> float:
    """Give the distance of two areas in plan: at vertices, and in the middle of the largest gap of the first."""
    corners = (shapely.points(shapely.get_coordinates(one)) for one in (a, b))
    far = [shapely.distance(some, other).max(initial=0.0) for some, other in zip(corners, (b, a), strict=True)]
    gap = take_areas(shapely.difference(b, a, grid_size=STEP))
    if gap.area > 0:
        middle = shapely.get_point(shapely.maximum_inscribed_circle(gap, 100 * STEP), 0)
        far.append(shapely.distance(middle, a))
    return float(max(far))


def _merge(units: list[Unit], allowed: float) -> Unit:
    """Put units of a house that are nearly of one height under one roof, with an outline of fewer vertices."""
    whole = shapely.union_all([unit.outline for unit in units], grid_size=STEP)
    outline = shapely.simplify(whole, min(allowed * PLAN_SHARE, whole.area**0.5 * SIDE_SHARE))
    moved = max(unit.moved for unit in units) + float(shapely.hausdorff_distance(whole, outline))
    largest = units[int(np.argmax(shapely.area([unit.outline for unit in units])))]
    low, high = min(unit.low for unit in units), max(unit.high for unit in units)
    ground = min(unit.attributes["ground_height"] for unit in units)
    attributes = {key: largest.attributes[key] for key in TEXTS if key in largest.attributes}
    attributes |= {"ground_height": ground, "roof_height": high, "height": high - ground}
    bottom = min(unit.bottom for unit in units)
    return Unit(largest.house, outline, bottom, low, high, attributes, moved, blocks=largest.blocks)


def draw_units(units: Sequence[Unit]) -> Layer | None:
    """Make the layer of units; None where there are none."""
    several = Counter(unit.house for unit in units)
    rows: list[dict[str, Any]] = []
    surfaces: list[Surface] = []
    blocks = _extrude([unit for unit in units if unit.part is None])
    for unit in units:
        surface = next(blocks) if unit.part is None else _draw_part(unit.part)
        if surface is None:
            continue
        surfaces.append(replace(surface, feature=np.full(len(surface.xyz), len(rows))))
        name, lod, n = (
            (unit.block.id, unit.block.level, unit.block.members)
            if unit.block
            else (unit.house, BLOCKS[several[unit.house] > 1], 1)
            if unit.part is None
            else (unit.part.id, unit.part.lod, 1)
        )
        rows.append(
            unit.attributes | {"id": name, "house": unit.house, "lod": lod, "error": unit.error, "buildings": n}
        )
    if not rows:
        return None
    columns: dict[str, Column] = {
        key: [str(row.get(key, "")) for row in rows] for key in ("id", "house", "lod", *TEXTS)
    }
    columns |= {
        key: np.array([row.get(key, NO_NUMBER) for row in rows], np.float32)
        for key in (*NUMBERS, "error", *(["buildings"] if any(unit.block for unit in units) else []))
    }
    return Layer("buildings", join_surfaces(surfaces), columns)


def _draw_part(part: Part) -> Surface:
    material = np.where(part.roof, int(Marker.ROOF), int(Marker.WALL))
    return Surface(np.array(part.xyz), np.array(part.triangles, np.int64), material, np.empty(0, np.int64))


def _extrude(units: Sequence[Unit]) -> Iterator[Surface | None]:
    """Make walls and roof of blocks, all at a time; None for one whose outline has no area."""
    outlines = shapely.orient_polygons(np.array([unit.outline for unit in units], np.object_))
    cuts = shapely.orient_polygons(shapely.constrained_delaunay_triangles(outlines))
    xy, owner = shapely.get_coordinates(cuts, return_index=True)
    roof = np.column_stack((owner, xy)).reshape(-1, 4, 3)[:, :3].reshape(-1, 3)
    places, inverse = np.unique(roof, axis=0, return_inverse=True)
    corners: Ints = inverse.reshape(-1, 3).astype(np.int64)
    parts, of_part = shapely.get_parts(outlines, return_index=True)
    rings, of_ring = shapely.get_rings(parts, return_index=True)
    xy, ring = shapely.get_coordinates(rings, return_index=True)
    first = np.flatnonzero(ring[1:] == ring[:-1])
    of_wall = of_part[of_ring[ring[first]]]
    bottom = np.array([unit.bottom for unit in units], np.float64)
    top = np.array([unit.top for unit in units], np.float64)
    a, b, low, high = xy[first], xy[first + 1], bottom[of_wall], top[of_wall]
    ways = (a, low), (b, low), (b, high), (a, high)
    walls = np.stack([np.column_stack(way) for way in ways], axis=1)
    starts = (np.searchsorted(of, np.arange(len(units) + 1)) for of in (places[:, 0], roof[::3, 0], of_wall))
    for k, (place, corner, wall) in enumerate(zip(*(map(slice, some, some[1:]) for some in starts), strict=True)):
        own, n = places[place, 1:], place.stop - place.start
        if not n:
            yield None
            continue
        quad = n + 4 * np.arange(wall.stop - wall.start)[:, np.newaxis]
        halves = np.add(quad, [0, 1, 2]), np.add(quad, [0, 2, 3])
        triangles: Ints = np.concatenate((corners[corner] - place.start, *halves))
        counts = [corner.stop - corner.start, 2 * len(quad)]
        material = np.repeat(np.array([Marker.ROOF, Marker.WALL], np.int64), counts)
        xyz = np.concatenate((np.column_stack((own, np.full(n, top[k]))), walls[wall].reshape(-1, 3)))
        yield Surface(xyz, triangles, material, np.empty(0, np.int64))
