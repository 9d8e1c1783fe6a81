"""Patches and zones of OpenFOAM: their names, and the files `boundary`, `faceZones` and `cellZones`."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, Self

import numpy as np
from numpy.typing import NDArray

from pipeline.data.mesh import GROUND_PATCHES, Marker
from pipeline.data.regions import Region
from tiler.export.foam_files import POLY_MESH, foam_header, write_at
from tiler.export.region_faces import FacetSets, Ints

PATCHES = {
    Marker.GROUND: "ground",
    Marker.WALL: "walls",
    Marker.ROOF: "roofs",
    Marker.TOP: "top",
    Marker.WEST: "west",
    Marker.EAST: "east",
    Marker.SOUTH: "south",
    Marker.NORTH: "north",
    Marker.MISSING: "missing",
    Marker.BOTTOM: "bottom",
    Marker.FOUNDATION: "foundations",
}
HOUSE = (Marker.WALL, Marker.ROOF)
SOLID = (Marker.GROUND, *HOUSE, Marker.FOUNDATION)
FIRST_BUILDING = 100  # keys of patches from here on are buildings, those below are markers
GROUND_ZONE = 1 << 62  # key of the face zone of the ground, where it is inside; those below are buildings
VEGETATION = "vegetation"  # begins the names of the zones of cells between leaves
FIRST_LEAVES, LEAF_KEYS = 100, 1000  # keys of these: from the first on, so many to 1 m2/m3
ALL_LEAVES = 1 << 40  # key of the zone of all of them
WIDTH = 20  # characters of a face's number in a zone, its line break among them


@dataclass(frozen=True)
class Patch:
    """A patch of the region's boundary."""

    #: its name and type
    name: str
    kind: str
    groups: tuple[str, ...]  #: names under which boundary conditions can take it together with others


def patch_of_key(key: int, ground: Sequence[str] = ()) -> Patch:
    """Return the patch of a key: a marker, or `FIRST_BUILDING` and the number of a building.

    `ground` has the names of the patches of the ground, whose keys are `GROUND_PATCHES` and their number.

    Examples
    --------
    >>> patch_of_key(4).name, patch_of_key(107)
    ('top', Patch(name='building_7', kind='wall', groups=('wall', 'buildings')))
    >>> patch_of_key(32, ["ground", "ground_water", "ground_street"])
    Patch(name='ground_street', kind='wall', groups=('wall', 'grounds'))
    """
    if key >= FIRST_BUILDING:
        return Patch(building_name(key - FIRST_BUILDING), "wall", ("wall", "buildings"))
    if key > GROUND_PATCHES:
        return Patch(ground[key - GROUND_PATCHES], "wall", ("wall", "grounds"))
    marker = Marker(key)
    if marker not in SOLID:
        return Patch(PATCHES[marker], "patch", ())
    return Patch(PATCHES[marker], "wall", ("wall", "buildings") if marker in HOUSE else ("wall",))


def patch_keys(marker: NDArray[np.int32], building: NDArray[np.int64], *, by_building: bool) -> Ints:
    """Give the key of each facet's patch.

    Parameters
    ----------
    marker : int32, (f,)
        `pipeline.data.mesh.Marker` of each facet.
    building : int64, (f,)
        Number of its building, -1 where there is none.
    by_building : bool
        Whether walls and roofs belong to a patch of their building.

    Examples
    --------
    >>> patch_keys(np.array([1, 2, 3], np.int32), np.array([-1, 7, -1]), by_building=True).tolist()
    [1, 107, 3]
    """
    if not by_building:
        return marker.astype(np.int64)
    keys: Ints = np.where(is_house(marker, building), building + FIRST_BUILDING, marker)
    return keys


def facets_by_key(keys: Iterable[int], of_facet: Ints) -> list[tuple[int, Ints]]:
    """Group facets by key of `patch_keys`: each key that there is among `keys`, ascending, and its facets.

    Examples
    --------
    >>> facets_by_key([1, 4, 9], np.array([9, 1, 9]))
    [(1, array([1])), (9, array([0, 2]))]
    """
    known = np.fromiter(keys, np.int64)
    return [(int(known[row]), rows) for row, rows in runs_of(known, of_facet)]


def is_house(marker: NDArray[np.int32], building: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return which facets (f,) are walls and roofs of a building that has a number; see `patch_keys`."""
    return np.isin(marker, HOUSE) & (building >= 0)


def building_name(number: int) -> str:
    """Name the patch or zone of a building."""
    return f"building_{number}"


def face_zone_name(key: int) -> str:
    """Name a face zone: that of a building, or of the ground where it is inside.

    Examples
    --------
    >>> face_zone_name(7), face_zone_name(GROUND_ZONE)
    ('building_7', 'ground')
    """
    return PATCHES[Marker.GROUND] if key == GROUND_ZONE else building_name(key)


def cell_zone_name(key: int) -> str:
    """Name a cell zone: that of a region, or of cells between leaves of one density.

    Examples
    --------
    >>> cell_zone_name(1), cell_zone_name(leaf_key(np.array([0.538]))[0])
    ('soil', 'vegetation_0.538')
    """
    if key == ALL_LEAVES:
        return VEGETATION
    if key >= FIRST_LEAVES:
        return f"{VEGETATION}_{(key - FIRST_LEAVES) / LEAF_KEYS:g}"
    return Region(key).name.lower()


def leaf_key(density: NDArray[np.floating[Any]]) -> Ints:
    """Give the key of the cell zone of leaf area densities above 0 (m2/m3)."""
    return FIRST_LEAVES + np.rint(density.astype(np.float64) * LEAF_KEYS).astype(np.int64)


def add_all_leaves(sets: FacetSets) -> FacetSets:
    """Add the zone of all cells between leaves, if there are any, to the zones of one density.

    Examples
    --------
    >>> found = add_all_leaves(FacetSets(np.array([1, 638, 853]), {0: {0: 9, 1: 2, 2: 3}}))
    >>> found.keys.tolist(), found.counts
    ([1, 638, 853, 1099511627776], {0: {0: 9, 1: 2, 2: 3, 3: 5}})
    """
    leaves = sets.keys >= FIRST_LEAVES
    if not leaves.any():
        return sets
    row = len(sets.keys)
    counts = {
        k: {**found, row: n} if (n := sum(count for key, count in found.items() if leaves[key])) else found
        for k, found in sets.counts.items()
    }
    return FacetSets(np.append(sets.keys, ALL_LEAVES), counts)


def write_volumes(file: "ZonesFile", k: int, keys: Ints, numbers: Ints) -> None:
    """Write which cells of piece `k` are in the zones `keys`, and in that of all leaves."""
    file.write(k, keys, numbers)
    if (leafy := keys >= FIRST_LEAVES).any():
        file.write(k, np.where(leafy, ALL_LEAVES, -1), numbers)


def interface_name(number: int, other: int) -> str:
    """Name the processor patch that a part has towards another one."""
    return f"procBoundary{number}to{other}"


def write_boundary(
    path: Path, patches: Mapping[Patch, int], *, start: int, number: int, others: Mapping[int, int]
) -> dict[str, int]:
    """Write the file ``boundary``.

    Parameters
    ----------
    path : Path
        The file.
    patches : mapping of Patch to int
        Faces of each, in their order.
    start : int
        Number of the first of these faces.
    number : int
        Which part this is.
    others : mapping of int to int
        Faces towards each other part.

    Returns
    -------
    dict of str to int
        Faces by name of patch.
    """
    entries, counts = [], {}
    for patch, n in patches.items():
        groups = f"inGroups        {len(patch.groups)}({' '.join(patch.groups)});" if patch.groups else ""
        entries.append((patch.name, patch.kind, n, [groups] if groups else []))
    for other, n in others.items():
        words = [
            "inGroups        1(processor);",
            "matchTolerance  0.0001;",
            "transform       unknown;",
            f"myProcNo        {number};",
            f"neighbProcNo    {other};",
        ]
        entries.append((interface_name(number, other), "processor", n, words))
    lines = [str(len(entries)), "("]
    for name, kind, n, words in entries:
        own = [f"type            {kind};", *words, f"nFaces          {n};", f"startFace       {start};"]
        lines += [f"    {name}", "    {", *(f"        {word}" for word in own), "    }"]
        counts[name] = n
        start += n
    header = foam_header("boundary", "polyBoundaryMesh", location=POLY_MESH)
    path.write_text("\n".join([header, *lines, ")", ""]))
    return counts


class ZonesFile:
    """The file ``faceZones`` or ``cellZones``, filled piece by piece.

    Parameters
    ----------
    path : Path
        The file; its name says what is in the zones.
    sets : FacetSets
        Zones by key.
    pieces : sequence of int
        The pieces that will be written.
    name_of : callable
        Gives the name of a key.

    Notes
    -----
    Numbers are text of a fixed width, so that each place is known before; memory holds names and places.
    """

    def __init__(self, path: Path, sets: FacetSets, pieces: Sequence[int], name_of: Callable[[int], str]) -> None:
        self._keys = sets.keys
        self._first, count = sets.first(pieces)
        self._file: BinaryIO = path.open("wb")
        of = path.name.removesuffix("Zones")
        self._file.write(f"{foam_header(path.name, 'regIOobject', location=POLY_MESH)}{len(count)}\n(\n".encode())
        self._start = np.empty(len(count), np.int64)
        for row, (key, n) in enumerate(zip(self._keys.tolist(), count.tolist(), strict=True)):
            words = f"{name_of(key)}\n{{\n    type {of}Zone;\n    {of}Labels List<label>\n{n}\n(\n"
            self._file.write(words.encode())
            self._start[row] = self._file.tell()
            self._file.seek(n * WIDTH, 1)
            flips = f"{n}{{0}}" if n else "0()"  # OpenFOAM cannot read 0{0}
            turned = f"    flipMap List<bool> {flips};\n" if of == "face" else ""
            self._file.write(f")\n    ;\n{turned}}}\n".encode())
        self._file.write(b")\n")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()

    def write(self, k: int, keys: Ints, numbers: Ints) -> None:
        """Write which faces or cells of piece `k` are in the zones `keys`, -1 for none."""
        for row, chosen in runs_of(self._keys, keys):
            lines = "".join(f"{number:>{WIDTH - 1}d}\n" for number in numbers[chosen].tolist())
            write_at(self._file, int(self._start[row]) + self._first[k][row] * WIDTH, lines.encode())


def runs_of(keys: Ints, of_facet: Ints) -> list[tuple[int, NDArray[np.int64]]]:
    """Group facets by key: the row of each key that there is, and its facets in their order.

    Examples
    --------
    >>> runs_of(np.array([1, 4, 9]), np.array([9, -1, 1, 9]))
    [(0, array([2])), (2, array([0, 3]))]
    """
    order = np.argsort(of_facet, kind="stable")
    order = order[np.searchsorted(of_facet[order], 0) :]
    present, begin = np.unique(of_facet[order], return_index=True)
    groups = np.split(order, begin[1:])
    return list(zip(np.searchsorted(keys, present).tolist(), groups, strict=False))
