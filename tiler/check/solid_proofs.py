"""The proof of `citystitch check` that the city model agrees with itself: solids, heights, houses and parts."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.city_model.roof_areas import measure_roof_areas
from pipeline.city_model.sloped_solids import LEVEL_TOLERANCE, ROOM, STRAIGHT
from pipeline.city_model.solids import repeated_corners
from pipeline.data.errors import InputError
from pipeline.data.roofs import Roofs, roof_heights
from tiler.check.proofs import N_PLACES, Fault, Proof, Vertices
from tiler.citymodels.building_index import BuildingRow, check_indices
from tiler.citymodels.building_index import Vertices as ModelVertices
from tiler.citymodels.cityjson import BLOCK_HEIGHTS

HEIGHT_STEP = 1e-3  # m: CityJSON rounds coordinates to 1 mm, the heights among the attributes are not rounded
ROOF_TOLERANCE = LEVEL_TOLERANCE + HEIGHT_STEP  # m, up or down, of a corner of a sloped roof
PLAN_TOLERANCE = STRAIGHT + HEIGHT_STEP  # m, in the plane, of a corner under a sloped roof
PLANARITY = 0.01  # m, of the corners of a face along its normal: what val3dity takes by default
PARTING = 0.008  # m, from a place where rings of a footprint meet, within which its solid is parted
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
    "height-attribute": f"height is not roof_height less ground_height; bound: {HEIGHT_STEP:g} m",
}


class SolidProofs:
    """Reads the objects of a city model one at a time, and keeps what is wrong with them.

    Notes
    -----
    The solid is held against the attributes and the LoD 0 footprint, and these against the mesh by the proofs of
    `tiler.check.city_proofs`: what one of them has otherwise is found.
    """

    def __init__(self) -> None:
        self.n_solids = self.n_sloped = self.n_flat = 0
        self._places: dict[str, list[tuple[float, float, float]]] = {}
        self._count: dict[str, int] = {}
        self._kin = [0, 0]  # sums of hashes of (house, part), as houses and as parts have them

    def add(
        self,
        name: str,
        thing: Mapping[str, Any],
        vertices: ModelVertices,
        building: BuildingRow | None,
    ) -> None:
        """Look at an object.

        Parameters
        ----------
        name : str
            Its id.
        thing : mapping
            The object.
        vertices : Vertices
            Vertices of the city model.
        building : BuildingRow, optional
            What was read of it; none for a house of parts.

        Raises
        ------
        InputError
            If a field of the solid is missing or wrong.
        """
        try:
            self._kin[0] += sum(_hash_pair(name, part) for part in thing.get("children", ()))
            self._kin[1] += sum(_hash_pair(house, name) for house in thing.get("parents", ()))
            if building is None:
                return
            for kind in self._find(thing, vertices, building):
                place = building.footprint.representative_point()
                self._count[kind] = self._count.get(kind, 0) + 1
                places = self._places.setdefault(kind, [])
                if len(places) < N_PLACES:
                    places.append((place.x, place.y, building.roof))
        except (KeyError, TypeError, ValueError, IndexError, OverflowError) as error:
            raise InputError(
                f"city model: building {name!r}: its solid is damaged ({error!r}); run again"
            ) from None

    def prove(self) -> Proof:
        """Tell how many solids are right."""
        faults = [
            Fault(kind, n, tuple(self._places[kind]), DETAILS[kind]) for kind, n in sorted(self._count.items())
        ]
        if self._kin[0] != self._kin[1]:
            faults.append(Fault("parts", 1, (), "children of houses and parents of parts differ"))
        flat = f", {self.n_flat} flat buildings have none" if self.n_flat else ""
        claim = f"{self.n_solids} solids of the city model are closed and stand from ground to roof{flat}"
        bound = f"bound: {HEIGHT_STEP:g} m"
        if self.n_sloped:
            bound += f", {ROOF_TOLERANCE:g} m of the {self.n_sloped} with sloped roofs"
        return Proof(f"{claim}; {bound}", tuple(faults))

    def _find(self, thing: Mapping[str, Any], vertices: ModelVertices, building: BuildingRow) -> list[str]:
        ground, roof, footprint = building.ground, building.roof, building.footprint
        attributes = thing["attributes"]
        height = attributes.get("height", roof - ground)
        found = [] if abs(height - (roof - ground)) <= HEIGHT_STEP else ["height-attribute"]
        tops, mean = {"1.2": roof}, roof
        roofs, flat = _roof_over_ground(building), building.plane[5] == building.plane[6]
        if LOD12 in attributes:
            tops = {"1.2": float(attributes[LOD12]), "1.3": float(attributes[LOD13]), "2.2": roof}
            block = roof
            if not flat and footprint.area:
                mean = float(measure_roof_areas(np.array([footprint]), roofs).mean[0])
                block = float(measure_roof_areas(np.array([footprint]), _roof_of(building)).mean[0])
            found += [] if abs(tops["1.3"] - block) <= ROOF_TOLERANCE else ["block-height"]
        solids = {str(solid["lod"]): solid for solid in thing["geometry"] if solid["type"] == "Solid"}
        self.n_flat += not solids
        self.n_solids += len(solids)
        for lod, top in tops.items():
            if lod not in solids:
                found += ["solid-missing"] if top - ground > 2 * HEIGHT_STEP else []
            elif lod == "2.2" and not flat:
                self.n_sloped += 1
                found += _find_sloped_faults(_read_solid(solids[lod], vertices), building, roofs, mean)
            else:
                found += _find_faults(_read_solid(solids[lod], vertices), ground, top, footprint)
        return list(dict.fromkeys(found))


@dataclass(frozen=True, eq=False)
class _Solid:
    """Corners of the faces of a solid, ring after ring: vertex, place (m) and those of the next, face, kind."""

    corner: NDArray[np.int64]
    after: NDArray[np.int64]
    place: Vertices
    onward: Vertices
    face: NDArray[np.int64]
    kinds: NDArray[np.int64]

    def measure_volume(self) -> float:
        """Volume (m³), by the edges of rings and the first corner of each face."""
        first = self.place[np.searchsorted(self.face, self.face)]
        at = self.place[0]
        return _volume(first - at, self.place - at, self.onward - at)

    def measure_areas(self) -> Vertices:
        """Area times normal of each face, outwards (m²): half the sum of the cross products of its edges."""
        first = self.place[np.searchsorted(self.face, self.face)]
        twice = np.cross(self.place - first, self.onward - first)
        return np.column_stack([np.bincount(self.face, axis) for axis in twice.T]) / 2


def _read_solid(solid: Mapping[str, Any], vertices: ModelVertices) -> _Solid:
    (faces,) = solid["boundaries"]
    (values,) = solid["semantics"]["values"]
    names = [surface["type"] for surface in solid["semantics"]["surfaces"]]
    if len(values) != len(faces):
        raise ValueError(f"{len(values)} values for {len(faces)} faces")
    rings = [ring for face in faces for ring in face]
    size = np.array([len(ring) for ring in rings])
    corner = check_indices([vertex for ring in rings for vertex in ring], len(vertices))
    place = vertices.take(corner)
    after = np.arange(1, len(corner) + 1)
    after[np.cumsum(size) - 1] -= size
    face = np.repeat(np.repeat(np.arange(len(faces)), [len(face) for face in faces]), size)
    kinds = np.array([KINDS.index(names[value]) for value in values])[face]
    return _Solid(corner, corner[after], place, place[after], face, kinds)


def _find_faults(solid: _Solid, ground: float, roof: float, footprint: Any) -> list[str]:
    """Name what is wrong with a prism."""
    levels = np.array([[ground, ground], [roof, roof], [ground, roof]])[solid.kinds]
    off = np.abs(solid.place[:, 2:] - levels).min(axis=1) > HEIGHT_STEP
    found = ["solid-height"] if off.any() else []
    if not _is_closed(solid.corner, solid.after):
        found.append("solid-open")
    met = _repeated_corners(footprint)
    floor = _away_from(met, shapely.get_coordinates(footprint))
    if any(not _same_places(_away_from(met, solid.place[solid.kinds == k, :2]), floor) for k in (0, 1)):
        found.append("solid-plan")
    wanted = footprint.area * (roof - ground)
    slack = 2 * HEIGHT_STEP * footprint.area + 1e-6 * abs(wanted)
    slack += PARTING * footprint.length * (roof - ground) if len(met) else 0.0
    if abs(solid.measure_volume() - wanted) > slack:
        found.append("solid-volume")
    return found


def _find_sloped_faults(solid: _Solid, building: BuildingRow, roofs: Roofs, mean: float) -> list[str]:
    """Name what is wrong with a solid under a sloped roof, of this mean height."""
    ground, footprint = building.ground, building.footprint
    floor, roof = solid.kinds == KINDS.index(FLOOR), solid.kinds == KINDS.index(ROOF)
    z = solid.place[:, 2]
    expected = roof_heights(roofs, np.zeros(len(z), np.int64), solid.place[:, :2])
    off_ground = np.abs(z - ground) > HEIGHT_STEP
    off_roof = np.abs(z - expected) > ROOF_TOLERANCE
    found = ["solid-height"] if (off_ground & ~roof & (floor | off_roof)).any() else []
    found += ["solid-roof"] if (off_roof & roof).any() else []
    found += [] if _is_closed(solid.corner, solid.after) else ["solid-open"]
    areas = solid.measure_areas()
    size = np.linalg.norm(areas, axis=1)
    normal = areas / np.maximum(size, 1e-12)[:, None]
    first = np.searchsorted(solid.face, solid.face)
    apart = np.einsum("ij,ij->i", solid.place - solid.place[first], normal[solid.face])
    found += ["solid-bent"] if np.ptp(apart) > PLANARITY and _is_bent(apart, solid.face) else []
    kinds = solid.kinds[np.searchsorted(solid.face, np.arange(len(areas)))]
    length = np.bincount(solid.face, np.linalg.norm(solid.onward - solid.place, axis=1))
    turned = np.where(np.abs(areas[:, 2]) <= HEIGHT_STEP * HEIGHT_STEP * length, 2, (areas[:, 2] > 0).astype(int))
    found += ["solid-semantics"] if (turned != kinds).any() else []
    met = _repeated_corners(footprint)
    outline = shapely.boundary(footprint)
    slack = (PARTING if len(met) else PLAN_TOLERANCE) * footprint.length
    plan = np.array([-areas[kinds == 0, 2].sum(), areas[kinds == 1, 2].sum()])
    corners = shapely.points(_away_from(met, solid.place[floor, :2]))
    astray = shapely.distance(outline, corners) > PLAN_TOLERANCE
    found += ["solid-plan"] if astray.any() or (np.abs(plan - footprint.area) > slack).any() else []
    slack = (ROOF_TOLERANCE + HEIGHT_STEP) * footprint.area + slack * (roofs.limits[0, 1] - ground)
    found += ["solid-volume"] if abs(solid.measure_volume() - footprint.area * (mean - ground)) > slack else []
    return found


def _is_bent(apart: NDArray[np.float64], face: NDArray[np.int64]) -> bool:
    """Tell whether corners of a face are farther from each other along its normal than `PLANARITY`."""
    start = np.flatnonzero(np.diff(face, prepend=-1))
    spread = np.maximum.reduceat(apart, start) - np.minimum.reduceat(apart, start)
    return bool((spread > PLANARITY).any())


def _roof_of(building: BuildingRow) -> Roofs:
    """Give the roof of a building, also where its plane is in the ground."""
    return Roofs(*(np.array([part]) for part in (building.plane[:3], building.plane[3:5], building.plane[5:7])))


def _roof_over_ground(building: BuildingRow) -> Roofs:
    """Give the roof of a building as its solid has it: nowhere in the ground."""
    roofs = _roof_of(building)
    low, high = building.plane[5:7]
    least = building.ground + ROOM if low < high else low
    return replace(roofs, limits=np.maximum(roofs.limits, least))


def _is_closed(start: NDArray[np.int64], end: NDArray[np.int64]) -> bool:
    """Tell whether each edge is used as often in one direction as in the other."""
    n = int(max(start.max(), end.max())) + 1
    return np.array_equal(np.sort(start * n + end), np.sort(end * n + start))


def _repeated_corners(footprint: Any) -> Vertices:
    """Places (k, 2) where rings of a footprint meet: solids are parted there."""
    polygons = shapely.get_parts(footprint)
    if not (shapely.get_num_interior_rings(polygons) > 0).any():
        return np.empty((0, 2))
    return np.concatenate([repeated_corners(polygon) for polygon in polygons])


def _away_from(met: Vertices, places: Vertices) -> Vertices:
    """Leave out the places (n, 2) within `PARTING` of some others."""
    if not len(met):
        return places
    near = shapely.dwithin(shapely.points(places), shapely.multipoints(met), PARTING)
    away: Vertices = places[~near]
    return away


def _same_places(one: Vertices, other: Vertices) -> bool:
    return np.array_equal(np.unique(one, axis=0), np.unique(other, axis=0))


def _volume(first: Vertices, start: Vertices, end: Vertices) -> float:
    """Volume (m³) within plane faces, by the edges of their rings and the first vertex of each ring."""
    return float(np.einsum("ij,ij", first, np.cross(start, end)) / 6)


def _hash_pair(house: str, part: str) -> int:
    return int.from_bytes(hashlib.blake2b(f"{house}\n{part}".encode(), digest_size=8).digest(), "big")
