"""The proof of `citystitch check` that the city model agrees with itself: solids, heights, houses and parts."""

import hashlib
from collections.abc import Mapping
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.data.errors import InputError
from tiler.check.proofs import N_PLACES, Fault, Proof, Vertices
from tiler.citymodels.building_index import BuildingRow, check_indices
from tiler.citymodels.building_index import Vertices as ModelVertices

HEIGHT_STEP = 1e-3  # m: CityJSON rounds coordinates to 1 mm, the heights among the attributes are not rounded
KINDS = ("GroundSurface", "RoofSurface", "WallSurface")
DETAILS = {
    "solid-missing": "a building with a height has no solid",
    "solid-open": "an edge of the solid is not used once in each direction",
    "solid-height": f"a vertex of the solid is not at its building's ground or roof; bound: {HEIGHT_STEP:g} m",
    "solid-plan": "floor or roof of the solid is not the footprint",
    "solid-volume": "the solid's volume is not that of its footprint times its height",
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
        self.n_solids = self.n_flat = 0
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
            _, ground, roof, _, footprint = building
            for kind in self._find(thing, vertices, ground, roof, footprint):
                place = footprint.representative_point()
                self._count[kind] = self._count.get(kind, 0) + 1
                places = self._places.setdefault(kind, [])
                if len(places) < N_PLACES:
                    places.append((place.x, place.y, roof))
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
        return Proof(f"{claim}; bound: {HEIGHT_STEP:g} m", tuple(faults))

    def _find(
        self, thing: Mapping[str, Any], vertices: ModelVertices, ground: float, roof: float, footprint: Any
    ) -> list[str]:
        height = thing["attributes"].get("height", roof - ground)
        found = [] if abs(height - (roof - ground)) <= HEIGHT_STEP else ["height-attribute"]
        solids = [geometry for geometry in thing["geometry"] if geometry["type"] == "Solid"]
        if not solids:
            self.n_flat += 1
            return found + (["solid-missing"] if roof - ground > 2 * HEIGHT_STEP else [])
        for solid in solids:
            self.n_solids += 1
            found += _find_faults(solid, vertices, ground, roof, footprint)
        return found


def _find_faults(
    solid: Mapping[str, Any], vertices: ModelVertices, ground: float, roof: float, footprint: Any
) -> list[str]:
    (faces,) = solid["boundaries"]
    (values,) = solid["semantics"]["values"]
    names = [surface["type"] for surface in solid["semantics"]["surfaces"]]
    if len(values) != len(faces):
        raise ValueError(f"{len(values)} values for {len(faces)} faces")
    rings = [ring for face in faces for ring in face]
    kind = np.repeat([KINDS.index(names[value]) for value in values], [len(face) for face in faces])
    size = np.array([len(ring) for ring in rings])
    corner = check_indices([vertex for ring in rings for vertex in ring], len(vertices))
    place = vertices.take(corner)
    after = np.arange(1, len(corner) + 1)
    after[np.cumsum(size) - 1] -= size
    kinds = np.repeat(kind, size)
    levels = np.array([[ground, ground], [roof, roof], [ground, roof]])[kinds]
    off = np.abs(place[:, 2:] - levels).min(axis=1) > HEIGHT_STEP
    found = ["solid-height"] if off.any() else []
    if not _is_closed(corner, corner[after]):
        found.append("solid-open")
    floor = shapely.get_coordinates(footprint)
    if any(not _same_places(place[kinds == k, :2], floor) for k in (0, 1)):
        found.append("solid-plan")
    wanted = footprint.area * (roof - ground)
    slack = 2 * HEIGHT_STEP * footprint.area + 1e-6 * abs(wanted)
    first = np.repeat(place[np.cumsum(size) - size], size, axis=0)
    if abs(_volume(first - place[0], place - place[0], place[after] - place[0]) - wanted) > slack:
        found.append("solid-volume")
    return found


def _is_closed(start: NDArray[np.int64], end: NDArray[np.int64]) -> bool:
    """Tell whether each edge is used as often in one direction as in the other."""
    n = int(max(start.max(), end.max())) + 1
    return np.array_equal(np.sort(start * n + end), np.sort(end * n + start))


def _same_places(one: Vertices, other: Vertices) -> bool:
    return np.array_equal(np.unique(one, axis=0), np.unique(other, axis=0))


def _volume(first: Vertices, start: Vertices, end: Vertices) -> float:
    """Volume (m³) within plane faces, by the edges of their rings and the first vertex of each ring."""
    return float(np.einsum("ij,ij", first, np.cross(start, end)) / 6)


def _hash_pair(house: str, part: str) -> int:
    return int.from_bytes(hashlib.blake2b(f"{house}\n{part}".encode(), digest_size=8).digest(), "big")
