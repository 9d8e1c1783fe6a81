"""CGNS in an HDF5 file: one unstructured zone, with a section of elements, a condition and a family a patch.

The nodes of CGNS's file mapping are HDF5 groups with the attributes ``name``, ``label``, ``type`` and ``flags``,
their values a data set named " data" with the axes in Fortran's order. h5py writes them, without a CGNS library.

References
----------
CGNS Standard Interface Data Structures (AIAA R-101A-2005) and its HDF5 file mapping, cgns.github.io.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from tiler.export.export import CELLS as CELL_KINDS
from tiler.export.export import PER_BUILDING, Format
from tiler.export.foam_patches import Patch, facets_by_key, patch_keys, patch_of_key
from tiler.export.pieces import Pieces, blocks_of
from tiler.export.region_faces import find_outer
from tiler.mesh_files.mesh_pieces import open_pieces
from tiler.mesh_files.prisms import PrismMesh, read_prisms
from tiler.mesh_files.run_files import RunSource, crs_of
from tiler.store.atomic import disk_errors, replacing
from tiler.store.run_folder import LEAVES, REGION

VERSION = 3.3  # of CGNS, the first in which all that is written has today's meaning
# CGNS's types of elements by corners: TRI_3 and QUAD_4, TETRA_4, PYRA_5 and PENTA_6.
FACETS = {3: 5, 4: 7}
SOLIDS = {4: 10, 5: 12, 6: 14}
QUADRILATERALS = "_quadrilaterals"  # behind the name of a patch, in that of their section
BASE, AIR, REGIONS, CELLS = "city", "air", "regions", "cells"  # the base; the zone, of air alone or of several
OTHERS = {4: "tetrahedra", 5: "pyramids"}  # sections of cells behind that of prisms
Ints = NDArray[np.int64]
INT32_LIMIT = 2**31 - 1
NAME_BYTES, TYPE_BYTES = 33, 3  # of attributes and the strings at the root, their last byte zero
UNITS = ("Null", "Meter", "Null", "Null", "Null")  # mass, length, time, temperature, angle: 32 characters each
LENGTH = (0, 1, 0, 0, 0)  # its exponents in these
FIELDS = {LEAVES: ("Leaves", "f4"), REGION: ("Regions", "i4")}  # of cells: the solution of each, and its type
TYPES = {"i4": "I4", "i8": "I8", "f4": "R4", "f8": "R8", "i1": "C1"}


@dataclass(frozen=True, eq=False)
class _Survey:
    """After reading all pieces once: cells, and facets by key of patch, ascending, then by corners."""

    n_points: int
    cells: dict[int, int]  # by corners
    facets: dict[int, dict[int, int]]
    ground: tuple[str, ...]  # names of its patches
    fields: tuple[str, ...]  # what cells tell, of `FIELDS`
    inside: frozenset[int]  # patches with cells on both sides

    @property
    def n_cells(self) -> int:
        """Number of all cells."""
        return sum(self.cells.values())

    @property
    def sections(self) -> dict[int, str]:
        """Name of the section of cells with so many corners, in their order."""
        return {width: OTHERS[width] if k else CELLS for k, width in enumerate(self.cells)}

    @property
    def integer(self) -> str:
        """Type of all numbers of points and elements: 64 bits only where a length does not fit in 32."""
        n_elements = self.n_cells + sum(sum(counts.values()) for counts in self.facets.values())
        return (
            "i4"
            if max(self.n_points, n_elements, *(width * n for width, n in self.cells.items())) <= INT32_LIMIT
            else "i8"
        )


def export_cgns(
    output: Path,
    source: RunSource,
    *,
    buildings: str | None = None,
    cells: str | None = None,
    prism_layers: int | None = None,
) -> None:
    """Write the mesh of a finished run as CGNS.

    Parameters
    ----------
    output : Path
        The file; it appears whole or not at all.
    source : Path or RunFiles
        Folder of the run.
    buildings : {"patches"}, optional
        See `write_cgns`.
    cells, prism_layers
        See `tiler.mesh_files.prisms.read_prisms`, also for memory; tetrahedra by default.

    Raises
    ------
    InputError
        If the run is not finished, or a file of it is missing or damaged.
    OutputError
        If the file cannot be written.
    """
    pieces = open_pieces(source)
    crs = crs_of(source)
    if origin := pieces.files.origin_words:
        crs += f"; coordinates count from {origin} m"
    with replacing(output) as part, disk_errors(output):
        if cells is not None:
            mesh = read_prisms(pieces, cells, prism_layers)
            _write_prisms(part, mesh, crs, by_building=buildings is not None)
        else:
            write_cgns(part, pieces, crs=crs, buildings=buildings)


def _write_prisms(path: Path, mesh: PrismMesh, crs: str, *, by_building: bool) -> None:
    """Write prisms and others, a section each; a patch may have two, of triangles and quadrilaterals."""
    facets: dict[int, dict[int, Ints]] = {}
    for width in (3, 4):
        corners, marker, building = mesh.facets(width)
        keys = patch_keys(marker, building, by_building=by_building)
        for key, rows in facets_by_key(np.unique(keys).tolist(), keys):
            facets.setdefault(key, {})[width] = corners[rows]
    counts = {key: {width: len(rows) for width, rows in facets[key].items()} for key in sorted(facets)}
    kinds = mesh.by_width()
    fields = {LEAVES: mesh.leaves, REGION: mesh.region}
    inside = patch_keys(mesh.between_marker, mesh.between_building, by_building=by_building)
    survey = _Survey(
        len(mesh.points),
        {width: len(rows) for width, rows in kinds},
        counts,
        mesh.ground,
        tuple(name for name, values in fields.items() if values is not None),
        frozenset(inside.tolist()),
    )
    with h5py.File(path, "w", libver=("earliest", "v108"), track_order=True) as file:
        zone = _write_tree(file, survey, crs)
        for axis, name in enumerate("XYZ"):
            zone[f"GridCoordinates/Coordinate{name}/ data"][:] = mesh.points[:, axis]
        for width, rows in kinds:
            data = zone[f"{survey.sections[width]}/ElementConnectivity/ data"]
            data[:] = mesh.cells[rows, :width].ravel() + 1
        for name, values in fields.items():
            if values is not None:
                zone[_data_of(name)][:] = values[np.concatenate([rows for _, rows in kinds])]
        for key, parts in facets.items():
            for width, rows in parts.items():
                zone[f"{_section(patch_of_key(key, mesh.ground), width)}/ElementConnectivity/ data"][:] = (
                    rows.ravel() + 1
                )


def write_cgns(path: Path, pieces: Pieces, *, crs: str, buildings: str | None = None) -> None:
    """Write a mesh as CGNS.

    Parameters
    ----------
    path : Path
        The file.
    pieces : Pieces
        The mesh.
    crs : str
        CRS of its coordinates, kept as a descriptor.
    buildings : {"patches"}, optional
        Give each building, walls and roofs, a patch of its own instead of the two.

    Notes
    -----
    Points are in the order of their numbers, elements cells first, then patch by patch, each piece by piece.
    Memory: one piece and some kilobytes a patch. Each piece is read twice.
    """
    survey = _survey(pieces, by_building=buildings is not None)
    with h5py.File(path, "w", libver=("earliest", "v108"), track_order=True) as file:
        zone = _write_tree(file, survey, crs)
        coordinates = [zone[f"GridCoordinates/Coordinate{axis}/ data"] for axis in "XYZ"]
        sections = {0: CELLS} | {key: _section(patch_of_key(key, survey.ground), 3) for key in survey.facets}
        seen = dict.fromkeys(sections, 0)
        for k in range(len(pieces.names)):
            piece = pieces.read(k)
            for start, rows in blocks_of(piece.ids):
                for axis, data in enumerate(coordinates):
                    data[start : start + len(rows)] = piece.points[rows, axis]
            found = patch_keys(piece.marker, piece.building, by_building=buildings is not None)
            patches = [(key, piece.facets[rows]) for key, rows in facets_by_key(survey.facets, found)]
            first = seen[0] // piece.cells.shape[1]
            for name in survey.fields:
                values = piece.leaves if name == LEAVES else piece.region
                zone[_data_of(name)][first : first + len(piece.cells)] = values
            for key, corners in [(0, piece.cells), *patches]:
                nodes = piece.ids[corners].ravel() + 1
                # Not kept open: each open data set that was written has a buffer of 64 kB.
                zone[f"{sections[key]}/ElementConnectivity/ data"][seen[key] : seen[key] + len(nodes)] = nodes
                seen[key] += len(nodes)


def _survey(pieces: Pieces, *, by_building: bool) -> _Survey:
    n_cells, facets, inside = 0, dict[int, int](), set[int]()
    fields: tuple[str, ...] = ()
    for k in range(len(pieces.names)):
        piece = pieces.read(k)
        found = {LEAVES: piece.leaves, REGION: piece.region}
        fields = tuple(name for name, values in found.items() if values is not None)
        n_cells += len(piece.cells)
        of_facet = patch_keys(piece.marker, piece.building, by_building=by_building)
        inside.update(of_facet[~find_outer(piece)].tolist())
        keys, counts = np.unique(of_facet, return_counts=True)
        for key, n in zip(keys.tolist(), counts.tolist(), strict=True):
            facets[key] = facets.get(key, 0) + n
    by_key = {key: {3: n} for key, n in sorted(facets.items())}
    return _Survey(pieces.n_points, {4: n_cells}, by_key, pieces.ground, fields, frozenset(inside))


def _data_of(name: str) -> str:
    """Say where the numbers of a field of cells stand in the zone."""
    return f"{FIELDS[name][0]}/{name}/ data"


def _section(patch: Patch, width: int) -> str:
    """Name the section of a patch's facets with so many corners."""
    return patch.name + (QUADRILATERALS if width == 4 else "")


def _write_tree(file: h5py.File, survey: _Survey, crs: str) -> h5py.Group:
    """Write all nodes, without the numbers of points and elements; returns that of the zone."""
    kind = survey.integer
    _describe(file, "HDF5 MotherNode", "Root Node of HDF5 File", "MT")
    for name, text in ((" format", "IEEE_LITTLE_32"), (" hdf5version", "HDF5 Version 1.8.0")):
        file.create_dataset(name, data=_characters(text.ljust(NAME_BYTES, "\0")))
    _node(file, "CGNSLibraryVersion", "CGNSLibraryVersion_t", np.array([VERSION], "<f4"))
    base = _node(file, BASE, "CGNSBase_t", np.array([3, 3], "<i4"))
    _node(base, "DataClass", "DataClass_t", "Dimensional")
    units = np.stack([_characters(unit.ljust(32)) for unit in UNITS])
    _node(base, "DimensionalUnits", "DimensionalUnits_t", units)
    _node(base, "CRS", "Descriptor_t", crs)
    patches = {key: patch_of_key(key, survey.ground) for key in survey.facets}
    for key, patch in patches.items():
        if key not in survey.inside:
            _write_family(base, patch)
    size = np.array([[survey.n_points], [survey.n_cells], [0]], f"<{kind}")
    zone = _node(base, REGIONS if REGION in survey.fields else AIR, "Zone_t", size)
    _node(zone, "ZoneType", "ZoneType_t", "Unstructured")
    grid = _node(zone, "GridCoordinates", "GridCoordinates_t")
    for axis in "XYZ":
        coordinate = _array(grid, f"Coordinate{axis}", survey.n_points, "f8")
        _node(coordinate, "DimensionalExponents", "DimensionalExponents_t", np.array(LENGTH, "<f4"))
    first = 1
    for width, n in survey.cells.items():
        _write_section(zone, survey.sections[width], (SOLIDS[width], width), first, n, kind)
        first += n
    for name in survey.fields:
        solution = _node(zone, FIELDS[name][0], "FlowSolution_t")
        _node(solution, "GridLocation", "GridLocation_t", "CellCenter")
        values = _array(solution, name, survey.n_cells, FIELDS[name][1])
        if name == LEAVES:
            _node(values, "DimensionalExponents", "DimensionalExponents_t", np.array(-np.array(LENGTH), "<f4"))
        else:
            _node(values, "DataClass", "DataClass_t", "DimensionlessConstant")
    conditions = _node(zone, "ZoneBC", "ZoneBC_t") if patches else None
    for key, patch in patches.items():
        begin = first
        for width, n in survey.facets[key].items():
            _write_section(zone, _section(patch, width), (FACETS[width], width), first, n, kind)
            first += n
        if key in survey.inside:
            continue
        condition = _node(conditions, patch.name, "BC_t", "FamilySpecified")
        _node(condition, "PointRange", "IndexRange_t", np.array([[begin], [first - 1]], f"<{kind}"))
        _node(condition, "GridLocation", "GridLocation_t", "FaceCenter")
        _node(condition, "FamilyName", "FamilyName_t", patch.name)
    return zone


def _write_family(base: h5py.Group, patch: Patch) -> None:
    family = _node(base, patch.name, "Family_t")
    _node(family, "FamilyBC", "FamilyBC_t", "BCWall" if patch.kind == "wall" else "UserDefined")


def _write_section(
    zone: h5py.Group, name: str, element_width: tuple[int, int], first: int, n: int, kind: str
) -> None:
    """Write a section of `n` elements of a type and with so many corners."""
    element, width = element_width
    section = _node(zone, name, "Elements_t", np.array([element, 0], "<i4"))
    _node(section, "ElementRange", "IndexRange_t", np.array([first, first + n - 1], f"<{kind}"))
    _array(section, "ElementConnectivity", n * width, kind)


def _node(parent: h5py.Group, name: str, label: str, value: NDArray[Any] | str | None = None) -> h5py.Group:
    """Make a node; a value has its axes in the file's order, the reverse of Fortran's."""
    data = _characters(value) if isinstance(value, str) else value
    group = parent.create_group(name, track_order=True)
    _describe(group, name, label, "MT" if data is None else TYPES[data.dtype.str[1:]])
    group.attrs.create("flags", np.array([1], "<i4"))
    if data is not None:
        group.create_dataset(" data", data=data)
    return group


def _array(parent: h5py.Group, name: str, n: int, kind: str) -> h5py.Group:
    """Make a node with `n` numbers that are to be written."""
    group = parent.create_group(name, track_order=True)
    _describe(group, name, "DataArray_t", TYPES[kind])
    group.attrs.create("flags", np.array([1], "<i4"))
    group.create_dataset(" data", (n,), f"<{kind}")
    return group


def _describe(group: h5py.Group, name: str, label: str, kind: str) -> None:
    for key, text, length in (
        ("name", name, NAME_BYTES),
        ("label", label, NAME_BYTES),
        ("type", kind, TYPE_BYTES),
    ):
        string = h5py.h5t.C_S1.copy()
        string.set_size(length)
        space = h5py.h5s.create(h5py.h5s.SCALAR)
        h5py.h5a.create(group.id, key.encode(), string, space).write(np.array(text.encode(), f"S{length}"))


def _characters(text: str) -> NDArray[np.int8]:
    return np.frombuffer(text.encode(), np.int8)


def read_cgns(path: Path) -> tuple[NDArray[np.float64], list[tuple[int, Ints]]]:
    """Read the points of an exported mesh, and its cells by number of corners; errors of h5py."""
    with h5py.File(path) as file:
        (zone,) = (node for node in file[BASE].values() if node.attrs.get("label") == b"Zone_t")
        points = np.stack([zone[f"GridCoordinates/Coordinate{axis}/ data"][:] for axis in "XYZ"], axis=1)
        sections = [node for node in zone.values() if node.attrs.get("label") == b"Elements_t"]
        kinds = {element: n for n, element in SOLIDS.items()}
        cells = [(kinds.get(int(node[" data"][0]), 0), node["ElementConnectivity/ data"]) for node in sections]
        return points, [(n, rows[:].reshape(-1, n).astype(np.int64) - 1) for n, rows in cells if n]


FORMAT = Format(
    "mesh and named patches as CGNS in HDF5", export_cgns, options=(*PER_BUILDING, *CELL_KINDS), suffix=".cgns"
)
