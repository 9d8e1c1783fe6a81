"""The proof of `citystitch check` that the city model agrees with itself: solids, heights, houses and parts."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import shapely
from numpy.typing import NDArray

from pipeline.city_model.roof_areas import measure_roof_areas
from pipeline.city_model.sloped_solids import LEVEL_TOLERANCE, ROOM, STRAIGHT
from pipeline.city_model.solids import repeated_corners
from pipeline.data.errors import InputError
from pipeline.data.roofs import Roofs, roof_heights, take_roofs
from stitch.pieces.conformity import group_rows
from tiler.check.proofs import N_PLACES, Fault, Mask, Proof, Vertices
from tiler.citymodels.building_index import (
    BuildingRow,
    check_indices,
    has_parts,
    read_building,
    read_objects,
)
from tiler.citymodels.building_index import Vertices as ModelVertices
from tiler.citymodels.cityjson import BLOCK_HEIGHTS
from tiler.citymodels.cityjson_text import reference_system
from tiler.citymodels.tables import unpack_polygons
from tiler.store.store import Store

TOGETHER = 1024  # buildings that are looked at together
HEIGHT_STEP = 1e-3  # m: CityJSON rounds coordinates to 1 mm, the heights among the attributes are not rounded
ROOF_TOLERANCE = LEVEL_TOLERANCE + HEIGHT_STEP  # m, up or down, of a corner of a sloped roof
PLAN_TOLERANCE = STRAIGHT + HEIGHT_STEP  # m, in the plane, of a corner under a sloped roof
PLANARITY = 0.01  # m, of the corners of a face along its normal: what val3dity takes by default
PARTING = 0.008  # m, from a place where rings of a footprint meet, within which its solid is parted
ANGLE_STEP = 0.051  # degrees: angles among the attributes are rounded to a tenth
ROOF_NUMBERS = ("roof_slope", "roof_azimuth", "roof_clipped", "roof_density", "roof_points")
FLOOR, ROOF, SIDE = KINDS = ("GroundSurface", "RoofSurface", "WallSurface")
LOD12, LOD13 = BLOCK_HEIGHTS["1.2"], BLOCK_HEIGHTS["1.3"]
DETAILS = {
    "solid-missing": "a building with a height has no solid",
    "solid-open": "an edge of the solid is not used once in each direction",
    "solid-height": f"a vertex of the solid is not at its building's ground or roof; bound: {HEIGHT_STEP:g} m",
    "solid-plan": "floor or roof of the solid is not the footprint",
    "solid-volume": "the solid's volume is not that of its footprint times its height",
    "solid-roof": f"a corner of a roof is not on the plane of its building; bound: {ROOF_TOLERANCE:g} m",
    "solid-bent": f"a face of the solid is not plane; bound: {PLANARITY:g} m",
    "solid-semantics": "a face does not look down, up or aside as its semantic surface says",
    "block-height": f"lod13_height is not the mean height of the roof; bound: {ROOF_TOLERANCE:g} m",
    "roof-attribute": "slope, azimuth, clipped share or density are not those of the roof over its footprint",
    "house-attribute": "roof_parts, roof_planes or lod12_height of a house is not that of its parts",
    "parts-overlap": "parts of a house overlap",
    "parts-outline": "the parts of a house do not cover its outline",
    "height-attribute": f"height is not roof_height less ground_height; bound: {HEIGHT_STEP:g} m",
}


def check_crs(found: Mapping[str, ModelVertices], crs: str) -> Proof:
    """Hold the CRS that city models name, by file, against that of the run; without EPSG code it has none."""
    wanted = reference_system(pyproj.CRS(crs))
    stated = {
        file: (vertices.head.get("metadata") or {}).get("referenceSystem") for file, vertices in found.items()
    }
    faults = tuple(
        Fault("model-crs", 1, (), f"{file} names {name}, expected {wanted}")
        for file, name in stated.items()
        if name != wanted
    )
    return Proof(f"the {len(stated)} city models name the CRS of run.json, {crs}", faults)


@dataclass(frozen=True, eq=False)
class Outlines:
    """Outlines of ``n`` houses before they were divided: hashes of ids, ascending, areas (m2) and boxes (m)."""

    key: NDArray[np.int64]
    size: NDArray[np.float64]

    def find(self, house: str) -> NDArray[np.float64]:
        """Area and box of a house; NaN for an unknown one."""
        row = int(np.searchsorted(self.key, _hash_pair(house)))
        known = row < len(self.key) and self.key[row] == _hash_pair(house)
        return self.size[row] if known else np.full(5, np.nan)


def read_outlines(path: Path) -> Outlines | None:
    """Read the outlines of houses from the store of a run, tile by tile; None where it has not kept them."""
    store = Store(path)
    keys, sizes = [np.empty(0, np.int64)], [np.empty((0, 5))]
    names = store.names("houses")
    for name in names:
        arrays, _ = store.read("houses", name, names=("ids", "outline", "outline_start"))
        polygons = unpack_polygons(arrays, "outline")
        keys.append(np.array([_hash_pair(house) for house in arrays["ids"].tolist()], np.int64))
        sizes.append(np.column_stack((shapely.area(polygons), shapely.bounds(polygons).reshape(-1, 4))))
    key = np.concatenate(keys)
    order = np.argsort(key)
    return Outlines(key[order], np.concatenate(sizes)[order]) if names else None


def check_solids(
    path: Path, vertices: ModelVertices, *, title: str = "the city model", outlines: Outlines | None = None
) -> Proof:
    """Read the objects of a city model, some at a time, and tell how many solids are right.

    Parameters
    ----------
    vertices : Vertices
        Its vertices.
    title : str
        What the claim calls it.
    outlines : Outlines, optional
        What the parts of each house must cover.

    Raises
    ------
    InputError
        If the file is missing or damaged, or a field of a solid is missing or wrong.

    Notes
    -----
    The solid is held against the attributes and the LoD 0 footprint, and these against the mesh by the proofs of
    `tiler.check.city_proofs`: what one of them has otherwise is found.
    """
    proofs, batch = _Found(outlines), _Batch()
    for name, thing in read_objects(path):
        building = None if has_parts(path, thing) else read_building(path, name, thing, vertices)
        try:
            proofs.add_kin(name, thing)
            if building is not None:
                batch.add(thing, len(vertices), building)
                proofs.add_part(name, thing, building)
        except (KeyError, TypeError, ValueError, IndexError, OverflowError) as error:
            raise InputError(
                f"city model: building {name!r}: its solid is damaged ({error!r}); run again"
            ) from None
        if len(batch.buildings) == TOGETHER:
            proofs.add(batch, vertices)
            batch = _Batch()
    proofs.add(batch, vertices)
    return proofs.prove(title)


class _Found:
    """What is wrong with the solids of a city model."""

    def __init__(self, outlines: Outlines | None) -> None:
        self._outlines = outlines
        self._parts: dict[str, list[tuple[BuildingRow, Mapping[str, Any]]]] = {}  # of houses, until all are there
        self._n_houses = self._n_solids = self._n_sloped = self._n_flat = 0
        self._places: dict[str, list[tuple[float, float, float]]] = {}
        self._count: dict[str, int] = {}
        self._kin = [0, 0]  # sums of hashes of (house, part), as houses and as parts have them

    def add_kin(self, name: str, thing: Mapping[str, Any]) -> None:
        self._kin[0] += sum(_hash_pair(name, part) for part in thing.get("children", ()))
        self._kin[1] += sum(_hash_pair(house, name) for house in thing.get("parents", ()))

    def add_part(self, name: str, thing: Mapping[str, Any], building: BuildingRow) -> None:
        """Take a building or part; where all parts of its house are there, look at the house."""
        values = thing["attributes"]
        if "parents" in thing and "roof_parts" not in values:
            return
        house = thing.get("parents", [name])[0]
        parts = self._parts.setdefault(house, [])
        parts.append((building, values))
        if len(parts) == values.get("roof_parts", 1):
            self._look_at_house(house, self._parts.pop(house))

    def _look_at_house(self, house: str, parts: list[tuple[BuildingRow, Mapping[str, Any]]]) -> None:
        self._n_houses += 1
        shapes = np.array([building.footprint for building, _ in parts], np.object_)
        area, whole = shapely.area(shapes), shapely.union_all(shapes)
        slack = HEIGHT_STEP * float(shapely.length(shapes).sum())
        self._fault("parts-overlap", parts[0][0], whole.area < area.sum() - slack)
        if self._outlines is not None:
            wanted = self._outlines.find(house)
            near = np.abs(np.array(whole.bounds) - wanted[1:]) <= 2 * HEIGHT_STEP
            wrong = not (abs(whole.area - wanted[0]) <= slack and near.all())
            self._fault("parts-outline", parts[0][0], wrong)
        if "roof_parts" in parts[0][1]:
            sloped = {building.plane for building, _ in parts if any(building.plane[:2])}
            sloped_planes = {plane[:5] for plane in sloped}
            flat = [building.roof for building, _ in parts if not any(building.plane[:2])]
            least, most = len(sloped_planes) + len(set(flat)), len(sloped_planes) + len(flat)
            mean = (area * [values[LOD13] for _, values in parts]).sum() / area.sum()
            for building, values in parts:
                right = values["roof_parts"] == len(parts) and least <= values["roof_planes"] <= most
                right &= abs(values[LOD12] - mean) <= ROOF_TOLERANCE
                self._fault("house-attribute", building, not right)

    def _fault(self, kind: str, building: BuildingRow, wrong: bool) -> None:
        """Count a fault at a building."""
        places = self._places.setdefault(kind, [])
        self._count[kind] = self._count.get(kind, 0) + int(wrong)
        if wrong and len(places) < N_PLACES:
            place = building.footprint.representative_point()
            places.append((place.x, place.y, building.roof))

    def add(self, batch: "_Batch", vertices: ModelVertices) -> None:
        self._n_flat += batch.n_flat
        self._n_solids += batch.n_solids
        self._n_sloped += sum(batch.sloped)
        for kind, wrong in batch.find_faults(vertices).items():
            for k in np.flatnonzero(wrong).tolist():
                self._fault(kind, batch.buildings[k], True)

    def prove(self, title: str) -> Proof:
        for parts in self._parts.values():
            self._fault("house-attribute", parts[0][0], True)
        faults = [
            Fault(kind, n, tuple(self._places[kind]), DETAILS[kind])
            for kind, n in sorted(self._count.items())
            if n
        ]
        if self._kin[0] != self._kin[1]:
            faults.append(Fault("parts", 1, (), "children of houses and parents of parts differ"))
        flat = f", {self._n_flat} flat buildings have none" if self._n_flat else ""
        claim = f"{self._n_solids} solids of {title} are closed and stand from ground to roof{flat}"
        if self._outlines is not None:
            claim += f"; the parts of {self._n_houses} houses cover their outlines without overlap"
        bound = f"bound: {HEIGHT_STEP:g} m"
        if self._n_sloped:
            bound += f", {ROOF_TOLERANCE:g} m of the {self._n_sloped} with sloped roofs"
        return Proof(f"{claim}; {bound}", tuple(faults))


class _Batch:
    """Some buildings of a city model, with the solids that have to be right, gathered to be looked at together."""

    def __init__(self) -> None:
        self.buildings: list[BuildingRow] = []
        self.n_solids = self.n_flat = 0  # solids of all levels of detail, and buildings without any
        self.sloped: list[bool] = []  # of each solid that must be there
        self._height: list[float] = []  # of each building: its attribute
        self._block: list[float] = []  # of each building: its attribute for LoD1.3, or NaN
        # Of each building: its attributes `ROOF_NUMBERS`, NaN for none
        self._told: list[tuple[float, ...]] = []
        self._missing: list[bool] = []  # of each building
        self._building: list[int] = []  # of each solid: its building,
        self._top: list[float] = []  # and how high it must be
        self._corners: list[NDArray[np.int64]] = []  # of each solid
        self._sizes: list[int] = []  # of each ring
        self._face: list[int] = []  # of each ring
        self._kinds: list[int] = []  # of each face
        self._solid: list[int] = []  # of each face

    def add(self, thing: Mapping[str, Any], n_vertices: int, building: BuildingRow) -> None:
        """Take a building and its solids; KeyError and the like if a field is missing or wrong."""
        ground, roof, attributes = building.ground, building.roof, thing["attributes"]
        flat, tops = building.plane[5] == building.plane[6], {"1.2": roof}
        self._height.append(float(attributes.get("height", roof - ground)))
        self._block.append(np.nan)
        told = (attributes.get(name) for name in ROOF_NUMBERS)
        self._told.append(tuple(np.nan if value is None else float(value) for value in told))
        if LOD12 in attributes:
            tops = {"1.2": float(attributes[LOD12]), "1.3": float(attributes[LOD13]), "2.2": roof}
            self._block[-1] = tops["1.3"]
        solids = {str(solid["lod"]): solid for solid in thing["geometry"] if solid["type"] == "Solid"}
        self.n_flat += not solids
        self.n_solids += len(solids)
        self._missing.append(False)
        for lod, top in tops.items():
            if lod not in solids:
                self._missing[-1] |= top - ground > 2 * HEIGHT_STEP
                continue
            self._add_solid(solids[lod], n_vertices)
            self._building.append(len(self.buildings))
            self._top.append(top)
            self.sloped.append(lod == "2.2" and not flat)
        self.buildings.append(building)

    def _add_solid(self, solid: Mapping[str, Any], n_vertices: int) -> None:
        (faces,) = solid["boundaries"]
        (values,) = solid["semantics"]["values"]
        kinds = [KINDS.index(surface["type"]) for surface in solid["semantics"]["surfaces"]]
        if len(values) != len(faces):
            raise ValueError(f"{len(values)} values for {len(faces)} faces")
        rings = [ring for face in faces for ring in face]
        sizes = [len(ring) for ring in rings]
        if 0 in sizes or not all(faces):
            raise ValueError("a face without corners")
        first = len(self._kinds)
        self._corners.append(check_indices([vertex for ring in rings for vertex in ring], n_vertices))
        self._sizes += sizes
        self._face += [first + k for k, face in enumerate(faces) for _ in face]
        self._kinds += [kinds[value] for value in values]
        self._solid += [len(self._top)] * len(faces)

    def find_faults(self, vertices: ModelVertices) -> dict[str, Mask]:
        """Tell by the kind of a fault which buildings have it."""
        rows, n = self.buildings, len(self.buildings)
        if not n:
            return {}
        footprint = np.empty(n, np.object_)
        footprint[:] = [row.footprint for row in rows]
        ground, roof = (np.array([getattr(row, name) for row in rows]) for name in ("ground", "roof"))
        plane = np.array([row.plane for row in rows])
        roofs = Roofs(plane[:, :3], plane[:, 3:5], plane[:, 5:7])
        # As solids have them: nowhere in the ground, but for flat ones.
        least = np.where(plane[:, 5] < plane[:, 6], ground + ROOM, plane[:, 5])
        over = replace(roofs, limits=np.maximum(roofs.limits, least[:, None]))
        block, mean, clipped = roof.copy(), roof.copy(), np.zeros(n)
        area = shapely.area(footprint)
        uneven = np.flatnonzero((plane[:, 5] != plane[:, 6]) & (area > 0))
        for heights, kind in ((mean, over), (block, roofs)):
            measured = measure_roof_areas(footprint[uneven], take_roofs(kind, uneven))
            heights[uneven], clipped[uneven] = measured.mean, measured.at_low + measured.at_high
        blocks = np.array(self._block)
        found = {
            "height-attribute": ~(np.abs(np.array(self._height) - (roof - ground)) <= HEIGHT_STEP),
            "block-height": ~np.isnan(blocks) & ~(np.abs(blocks - block) <= ROOF_TOLERANCE),
            "roof-attribute": self._find_other_roofs(plane, clipped, area, shapely.length(footprint)),
            "solid-missing": np.array(self._missing),
        }
        if self._top:
            building = np.array(self._building)
            shell = _Shells(footprint, building, ground[building], np.array(self._top), np.array(self.sloped))
            faults = _find_faults(self._read(vertices), shell, over, mean[building])
            found |= {kind: _any(building[wrong], n) for kind, wrong in faults.items()}
        return found

    def _find_other_roofs(
        self,
        plane: NDArray[np.float64],
        clipped: NDArray[np.float64],
        area: NDArray[np.float64],
        length: NDArray[np.float64],
    ) -> Mask:
        """Tell which buildings state other numbers of their roof than their plane and footprint give."""
        slope, azimuth, share, density, points = np.array(self._told).T
        east, north = plane[:, :2].T
        rounded, slack = 0.5 * HEIGHT_STEP, HEIGHT_STEP * length
        around = (np.degrees(np.arctan2(-east, -north)) - azimuth + 180) % 360 - 180
        wrong = np.abs(np.degrees(np.arctan(np.hypot(east, north))) - slope) > ANGLE_STEP
        wrong |= np.where(plane[:, :2].any(axis=1), ~(np.abs(around) <= ANGLE_STEP), ~np.isnan(azimuth))
        wrong |= np.abs(share * area - clipped) > rounded * area + slack
        wrong |= np.abs(density * area - points) > (rounded * area + density * slack)
        found: Mask = wrong & ~np.isnan(slope)
        return found

    def _read(self, vertices: ModelVertices) -> "_Solids":
        corner, size = np.concatenate(self._corners), np.array(self._sizes)
        after = np.arange(1, len(corner) + 1)
        after[np.cumsum(size) - 1] -= size
        face = np.repeat(np.array(self._face), size)
        place = vertices.take(corner)
        return _Solids(corner, after, place, face, np.array(self._kinds), np.array(self._solid))


@dataclass(frozen=True, eq=False)
class _Shells:
    """What ``s`` solids must be: footprints of buildings, and of each solid its building, heights (m) and form."""

    footprint: NDArray[np.object_]
    building: NDArray[np.int64]
    ground: NDArray[np.float64]
    top: NDArray[np.float64]
    sloped: Mask


@dataclass(frozen=True, eq=False)
class _Solids:
    """The ``c`` corners of the ``f`` faces of solids, ring after ring.

    Vertex, row of the next corner of the ring, place (m) and face of each corner; kind and solid of each face.
    """

    corner: NDArray[np.int64]
    after: NDArray[np.int64]
    place: Vertices
    face: NDArray[np.int64]
    kind: NDArray[np.int64]
    solid: NDArray[np.int64]

    def measure_areas(self) -> Vertices:
        """Area times normal of each face, outwards (m²): half the sum of the cross products of its edges."""
        first = self.place[np.searchsorted(self.face, self.face)]
        twice = np.cross(self.place - first, self.place[self.after] - first)
        return np.column_stack([np.bincount(self.face, axis) for axis in twice.T]) / 2

    def measure_volumes(self) -> NDArray[np.float64]:
        """Volume of each solid (m³), by the edges of rings and the first corner of each face."""
        solid = self.solid[self.face]
        at = self.place[np.searchsorted(solid, solid)]
        first = self.place[np.searchsorted(self.face, self.face)]
        part = np.einsum("ij,ij->i", first - at, np.cross(self.place - at, self.place[self.after] - at))
        return np.bincount(solid, part) / 6

    def find_open(self) -> NDArray[np.int64]:
        """Find the solids with an edge that is not used as often in one direction as in the other."""
        vertex = np.unique(self.corner, return_inverse=True)[1].astype(np.int64)
        n, solid = int(vertex.max()) + 1, self.solid[self.face]
        after = vertex[self.after]
        forth, back = np.sort((solid * n + vertex) * n + after), np.sort((solid * n + after) * n + vertex)
        return np.unique(forth[forth != back] // n**2)


def _find_faults(solids: _Solids, shell: _Shells, roofs: Roofs, mean: NDArray[np.float64]) -> dict[str, Mask]:
    """Name what is wrong with each solid: of prisms, and of those under sloped roofs of these mean heights."""
    n, solid, kind = len(shell.top), solids.solid[solids.face], solids.kind[solids.face]
    sloped, z, floor, roof = shell.sloped[solid], solids.place[:, 2], kind == 0, kind == 1
    building = shell.building[solid]
    top = np.where(sloped, roof_heights(roofs, building, solids.place[:, :2]), shell.top[solid])
    off_ground = ~(np.abs(z - shell.ground[solid]) <= HEIGHT_STEP)
    off_top = ~(np.abs(z - top) <= np.where(sloped, ROOF_TOLERANCE, HEIGHT_STEP))
    met = _find_meetings(shell.footprint)
    near = _are_near(met, building, solids.place[:, :2])
    plan = _find_other_plans(solids, shell, met, near)
    found = {
        "solid-height": _any(solid[np.where(roof, off_top & ~sloped, off_ground & (floor | off_top))], n),
        "solid-roof": _any(solid[roof & off_top & sloped], n),
        "solid-open": _any(solids.find_open(), n),
        "solid-plan": plan & ~shell.sloped,
    }
    area, length = (measure(shell.footprint)[shell.building] for measure in (shapely.area, shapely.length))
    parted = np.isin(shell.building, list(met))
    slack = np.where(parted, PARTING, np.where(shell.sloped, PLAN_TOLERANCE, 0.0)) * length
    wanted = area * (np.where(shell.sloped, mean, shell.top) - shell.ground)
    least = np.where(shell.sloped, ROOF_TOLERANCE + HEIGHT_STEP, 2 * HEIGHT_STEP) * area
    least += np.where(shell.sloped, 0.0, 1e-6 * np.abs(wanted))
    high = np.where(shell.sloped, roofs.limits[shell.building, 1], shell.top)
    error = np.abs(solids.measure_volumes() - wanted)
    found["solid-volume"] = ~(error <= least + slack * (high - shell.ground))
    if shell.sloped.any():
        for name, wrong in _find_sloped_faults(solids, shell, ~near & floor & sloped, area, slack).items():
            found[name] = found.get(name, False) | (wrong & shell.sloped)
    return found


def _find_sloped_faults(
    solids: _Solids, shell: _Shells, on_floor: Mask, area: NDArray[np.float64], slack: NDArray[np.float64]
) -> dict[str, Mask]:
    """Name what is wrong with solids under sloped roofs besides; `on_floor` are corners that are on an outline."""
    n, areas = len(shell.top), solids.measure_areas()
    size = np.linalg.norm(areas, axis=1)
    normal = areas / np.maximum(size, 1e-12)[:, None]
    first = np.flatnonzero(np.diff(solids.face, prepend=-1))
    apart = np.einsum("ij,ij->i", solids.place - solids.place[first[solids.face]], normal[solids.face])
    spread = np.maximum.reduceat(apart, first) - np.minimum.reduceat(apart, first)
    length = np.bincount(solids.face, np.linalg.norm(solids.place[solids.after] - solids.place, axis=1))
    upright = np.abs(areas[:, 2]) <= HEIGHT_STEP * HEIGHT_STEP * length
    turned = np.where(upright, 2, (areas[:, 2] > 0).astype(int))
    sums = [np.bincount(solids.solid, areas[:, 2] * (solids.kind == kind), n) for kind in (0, 1)]
    uneven = (np.abs(sums[0] + area) > slack) | (np.abs(sums[1] - area) > slack)
    owner = solids.solid[solids.face[on_floor]]
    outline = shapely.boundary(shell.footprint)
    away = shapely.distance(outline[shell.building[owner]], shapely.points(solids.place[on_floor, :2]))
    return {
        "solid-bent": _any(solids.solid[spread > PLANARITY], n),
        "solid-semantics": _any(solids.solid[turned != solids.kind], n),
        "solid-plan": uneven | _any(owner[away > PLAN_TOLERANCE], n),
    }


def _find_other_plans(solids: _Solids, shell: _Shells, met: Mapping[int, Vertices], near: Mask) -> Mask:
    """Tell of which solids floor or roof have other corners than the footprint."""
    n, solid, kind = len(shell.top), solids.solid[solids.face], solids.kind[solids.face]
    xy, building = shapely.get_coordinates(shell.footprint, return_index=True)
    kept = ~_are_near(met, building, xy)
    xy, building = xy[kept], building[kept]
    # The corners of the footprint once for each solid of a building: these stand together.
    first, last = (np.searchsorted(building, shell.building, side=side) for side in ("left", "right"))
    owner = np.repeat(np.arange(n), last - first)
    row = np.arange(len(owner)) + np.repeat(first - np.cumsum(last - first) + (last - first), last - first)
    other = np.zeros(n, np.bool_)
    for wanted in (0, 1):
        chosen = (kind == wanted) & ~near
        places = np.concatenate((solids.place[chosen, :2], xy[row]))
        of = np.concatenate((solid[chosen], owner))
        group, n_groups = group_rows(np.column_stack((of, places)))
        seen = np.zeros((2, n_groups), np.bool_)
        seen[0, group[: chosen.sum()]] = seen[1, group[chosen.sum() :]] = True
        alone = seen[0] != seen[1]
        other[of[alone[group]]] = True
    return other


def _any(rows: NDArray[np.int64], n: int) -> Mask:
    """Tell which of n things are among the rows."""
    found = np.zeros(n, np.bool_)
    found[rows] = True
    return found


def _find_meetings(footprint: NDArray[np.object_]) -> dict[int, Vertices]:
    """Places (k, 2) where rings of a footprint meet, by its row: solids are parted there."""
    found = {}
    parts, row = shapely.get_parts(footprint, return_index=True)
    for k in np.unique(row[shapely.get_num_interior_rings(parts) > 0]).tolist():
        places = np.concatenate([repeated_corners(polygon) for polygon in parts[row == k]])
        if len(places):
            found[k] = places
    return found


def _are_near(met: Mapping[int, Vertices], row: NDArray[np.int64], places: Vertices) -> Mask:
    """Tell which places (n, 2) of footprints of these rows are within `PARTING` of where rings meet."""
    near = np.zeros(len(places), np.bool_)
    for k, corners in met.items():
        own = np.flatnonzero(row == k)
        near[own] = shapely.dwithin(shapely.points(places[own]), shapely.multipoints(corners), PARTING)
    return near


def _hash_pair(house: str, part: str = "") -> int:
    digest = hashlib.blake2b(f"{house}\n{part}".encode(), digest_size=8).digest()
    return int.from_bytes(digest, "big", signed=True)
