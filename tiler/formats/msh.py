"""Gmsh's mesh files: MSH 4.1 binary, and MSH 2.2 as text for programs that read no other.

Surfaces are one entity a marker, volumes one a region, air, soil and building: each has a physical group with a
name. The number of a group is that of the marker, those of volumes stand in `VOLUMES`.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from pipeline.data.mesh import Marker
from pipeline.data.regions import Region
from tiler.export.export import CELLS, PER_BUILDING, Format
from tiler.export.foam_patches import FIRST_BUILDING, facets_by_key, patch_keys, patch_of_key
from tiler.export.pieces import Pieces, blocks_of, slices, write_lines
from tiler.mesh_files.mesh_pieces import MeshPiece, open_pieces
from tiler.mesh_files.prisms import PrismMesh, read_prisms
from tiler.mesh_files.run_files import RunSource
from tiler.store.atomic import replacing
from tiler.store.run_folder import LEAVES

# No marker has one of these numbers: some programs know groups by number alone.
VOLUMES = {Region.AIR: 10, Region.SOIL: 20, Region.BUILDING: 21}
AIR = VOLUMES[Region.AIR]
NAMES = {number: region.name.lower() for region, number in VOLUMES.items()}
# Markers of facets that do not bound the air, and the soil; those of facets that may bound buildings.
NOT_OF_AIR = (Marker.BOTTOM, Marker.FOUNDATION)
NOT_OF_SOIL = (Marker.WALL, Marker.ROOF, Marker.TOP)
OF_BUILDING = (Marker.WALL, Marker.ROOF, Marker.MISSING, Marker.FOUNDATION)
TRIANGLE, QUADRILATERAL, TETRAHEDRON = 2, 3, 4  # Gmsh's types of elements
SOLIDS = {4: TETRAHEDRON, 5: 7, 6: 6}  # those of cells, by their corners: pyramids and prisms, too
LEAF_ROW = np.dtype([("tag", "<i4"), ("density", "<f8")])
TEXT_FLOAT = "%24.16e"  # 17 digits, enough for any float64; each has the same width

_Box = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class _Survey:
    """What is known after reading all pieces once: boxes (xmin, ymin, zmin, xmax, ..., m) and counts by key."""

    n_points: int
    cells: dict[int, int]
    facets: dict[int, int]
    boxes: dict[int, _Box]
    ground: tuple[str, ...]
    leaves: bool  # whether cells have a leaf area density

    @property
    def n_elements(self) -> int:
        """Number of all facets and cells."""
        return sum(self.facets.values()) + sum(self.cells.values())

    @property
    def groups(self) -> list[tuple[int, int, str]]:
        """Dimension, number and name of each physical group."""
        names = [(2, number, patch_of_key(key, self.ground).name) for key, number in self.numbers.items()]
        return sorted([*names, *((3, group, NAMES[group]) for group in self.cells)])

    @property
    def numbers(self) -> dict[int, int]:
        """Numbers of surfaces by key: the marker, and from 100 on for buildings in the order of theirs."""
        n_markers = sum(key < FIRST_BUILDING for key in self.facets)
        return {
            key: key if key < FIRST_BUILDING else FIRST_BUILDING + i - n_markers
            for i, key in enumerate(self.facets)
        }


def export_msh(
    output: Path,
    source: RunSource,
    *,
    buildings: str | None = None,
    cells: str | None = None,
    prism_layers: int | None = None,
) -> None:
    """Write the mesh of a finished run as MSH 4.1, binary.

    Parameters
    ----------
    output : Path
        The file; it appears whole or not at all.
    source : Path or RunFiles
        Folder of the run.
    buildings : {"patches"}, optional
        Give each building, walls and roofs, a physical group of its own instead of the two.
    cells, prism_layers
        See `tiler.mesh_files.prisms.read_prisms`, also for memory; tetrahedra by default.

    Raises
    ------
    InputError
        If the run is not finished, or a file of it is missing or damaged.
    OutputError
        If the file cannot be written.

    Notes
    -----
    Memory: one piece. Nodes are in the order of their numbers, which begin with 1. Each piece is read twice. All
    nodes belong to the air.
    """
    pieces = open_pieces(source)
    by_building = buildings is not None
    if cells is not None:
        mesh = read_prisms(pieces, cells, prism_layers)
        _export_prisms(output, mesh, pieces.files.origin_words, by_building=by_building)
        return
    survey = _survey(pieces, by_building=by_building)
    with replacing(output) as part, part.open("wb") as file:
        _write_head(file, pieces.files.origin_words)
        _write_names(file, survey)
        _write_entities(file, survey)
        nodes = _begin_nodes(file, survey.n_points)
        elements = _begin_elements(file, survey)
        leaves = _begin_leaves(file, survey.n_elements) if survey.leaves else 0
        seen = dict.fromkeys(elements, 0)
        for k in range(len(pieces.names)):
            piece = pieces.read(k)
            for start, rows in blocks_of(piece.ids):
                file.seek(nodes + 24 * start)
                file.write(np.ascontiguousarray(piece.points[rows], "<f8").data)
            found = patch_keys(piece.marker, piece.building, by_building=by_building)
            none = np.zeros(len(piece.facets), np.float32)
            patches = [(key, piece.facets[rows], none[rows]) for key, rows in facets_by_key(survey.facets, found)]
            volumes = _groups(piece)
            density = np.zeros(len(piece.cells), np.float32) if piece.leaves is None else piece.leaves
            patches += [
                (group, piece.cells[volumes == group], density[volumes == group]) for group in survey.cells
            ]
            for group, rows_of_group, lad in patches:
                place, first = elements[group]
                place += 8 * (1 + rows_of_group.shape[1]) * seen[group]
                for some in slices(len(rows_of_group)):
                    corners = piece.ids[rows_of_group[some]]
                    tags = first + seen[group] + np.arange(len(corners))
                    file.seek(place)
                    place += file.write(np.ascontiguousarray(np.column_stack((tags, corners + 1)), "<u8").data)
                    if piece.leaves is not None:
                        file.seek(leaves + LEAF_ROW.itemsize * int(tags[0] - 1))
                        file.write(_leaf_rows(tags, lad[some]))
                    seen[group] += len(corners)


def _export_prisms(output: Path, mesh: PrismMesh, origin: str, *, by_building: bool) -> None:
    """Write prisms and others; a surface may have two blocks of elements, and the volume one a kind of cells."""
    blocks: list[tuple[int, int, Ints]] = []
    counts: dict[int, int] = {}
    boxes: dict[int, _Box] = {}
    for width, kind in ((3, TRIANGLE), (4, QUADRILATERAL)):
        corners, marker, building = mesh.facets(width)
        keys = patch_keys(marker, building, by_building=by_building)
        for key, rows in facets_by_key(np.unique(keys).tolist(), keys):
            blocks.append((key, kind, corners[rows]))
            counts[key] = counts.get(key, 0) + len(rows)
            boxes[key] = _grown(boxes.get(key, _no_box()), mesh.points[corners[rows].ravel()])
    volumes, cells = _groups(mesh), dict[int, int]()
    for width, of_width in mesh.by_width():
        for group in np.unique(volumes[of_width]).tolist():
            corners = mesh.cells[of_width[volumes[of_width] == group], :width]
            blocks.append((group, SOLIDS[width], corners))
            cells[group] = cells.get(group, 0) + len(corners)
            boxes[group] = _grown(boxes.get(group, _no_box()), mesh.points[corners.ravel()])
    cells, counts = dict(sorted(cells.items())), dict(sorted(counts.items()))
    survey = _Survey(len(mesh.points), cells, counts, boxes, mesh.ground, mesh.leaves is not None)
    numbers = survey.numbers | {group: group for group in cells}
    with replacing(output) as part, part.open("wb") as file:
        _write_head(file, origin)
        _write_names(file, survey)
        _write_entities(file, survey)
        file.seek(_begin_nodes(file, survey.n_points))
        file.write(np.ascontiguousarray(mesh.points, "<f8").data)
        file.seek(0, 2)
        n = survey.n_elements
        file.write(b"$Elements\n" + _packed("u8", [len(blocks), n, 1, n]))
        tag = 1
        for key, kind, corners in blocks:
            file.write(_packed("i4", [2 if kind in (TRIANGLE, QUADRILATERAL) else 3, numbers[key], kind]))
            file.write(_packed("u8", [len(corners)]))
            tags = tag + np.arange(len(corners))
            file.write(np.ascontiguousarray(np.column_stack((tags, corners + 1)), "<u8").data)
            tag += len(corners)
        file.write(b"\n$EndElements\n")
        if mesh.leaves is not None:
            cells_first = n - len(mesh.cells)
            order = [
                rows[volumes[rows] == g] for _, rows in mesh.by_width() for g in np.unique(volumes[rows]).tolist()
            ]
            lad = np.concatenate((np.zeros(cells_first, np.float32), mesh.leaves[np.concatenate(order)]))
            file.seek(_begin_leaves(file, n))
            file.write(_leaf_rows(np.arange(1, n + 1), lad))


def export_msh2(output: Path, source: RunSource, *, buildings: str | None = None) -> None:
    """Write the mesh of a finished run as MSH 2.2, text; see `export_msh`."""
    pieces = open_pieces(source)
    by_building = buildings is not None
    survey = _survey(pieces, by_building=by_building)
    keys, numbers = (np.array(list(some), np.int64) for some in (survey.numbers, survey.numbers.values()))
    with replacing(output) as part, part.open("wb") as file:
        file.write(b"$MeshFormat\n2.2 0 8\n$EndMeshFormat\n" + _comment(pieces.files.origin_words))
        _write_names(file, survey)
        digits = len(str(survey.n_points))
        file.write(f"$Nodes\n{survey.n_points}\n".encode())
        nodes, width = file.tell(), digits + 3 * 25 + 1
        file.seek(nodes + survey.n_points * width)
        file.write(f"$EndNodes\n$Elements\n{survey.n_elements}\n".encode())
        tag = 1
        for k in range(len(pieces.names)):
            piece = pieces.read(k)
            found = patch_keys(piece.marker, piece.building, by_building=by_building)
            groups = numbers[np.searchsorted(keys, found)]
            kinds = ((TRIANGLE, piece.facets, groups), (TETRAHEDRON, piece.cells, _groups(piece)))
            for kind, rows, groups_of_rows in kinds:
                for some in slices(len(rows)):
                    lines = _numbered(tag, piece.ids[rows[some]] + 1, kind, groups_of_rows[some])
                    write_lines(file, " ".join(["%d"] * lines.shape[1]) + "\n", lines)
                    tag += len(lines)
            end = file.tell()
            line = f"%{digits}d {TEXT_FLOAT} {TEXT_FLOAT} {TEXT_FLOAT}\n"
            for start, chosen in blocks_of(piece.ids):
                file.seek(nodes + start * width)
                write_lines(file, line, np.column_stack((piece.ids[chosen] + 1, piece.points[chosen])))
            file.seek(end)
        file.write(b"$EndElements\n")


def _write_head(file: BinaryIO, origin: str) -> None:
    one = np.array([1], "<i4").tobytes()
    file.write(b"$MeshFormat\n4.1 1 8\n" + one + b"\n$EndMeshFormat\n" + _comment(origin))


def _comment(origin: str) -> bytes:
    """Make the section that tells the origin; nothing for that of the CRS."""
    return f"$Comments\norigin {origin}\n$EndComments\n".encode() if origin else b""


def _survey(pieces: Pieces, *, by_building: bool) -> _Survey:
    cells: dict[int, int] = {}
    facets: dict[int, int] = {}
    boxes: dict[int, _Box] = {}
    leaves = False
    for k in range(len(pieces.names)):
        piece = pieces.read(k)
        leaves = piece.leaves is not None
        volumes = _groups(piece)
        found = patch_keys(piece.marker, piece.building, by_building=by_building)
        parts = [(cells, group, piece.cells[volumes == group]) for group in np.unique(volumes).tolist()]
        keys = facets_by_key(np.unique(found).tolist(), found)
        parts += [(facets, key, piece.facets[rows]) for key, rows in keys]
        for counts, group, corners in parts:
            counts[group] = counts.get(group, 0) + len(corners)
            used = np.zeros(len(piece.points), np.bool_)
            used[corners] = True
            boxes[group] = _grown(boxes.get(group, _no_box()), piece.points[used])
    cells, facets = dict(sorted(cells.items())), dict(sorted(facets.items()))
    return _Survey(pieces.n_points, cells, facets, boxes, pieces.ground, leaves)


def _groups(piece: MeshPiece | PrismMesh) -> NDArray[np.int64]:
    """Give the number of each cell's group."""
    region = np.zeros(len(piece.cells), np.int8) if piece.region is None else piece.region
    return np.array([VOLUMES[value] for value in Region], np.int64)[region]


def _no_box() -> _Box:
    return np.repeat([np.inf, -np.inf], 3)


def _grown(box: _Box, points: NDArray[np.float64]) -> _Box:
    if not len(points):
        return box
    return np.concatenate((np.minimum(box[:3], points.min(axis=0)), np.maximum(box[3:], points.max(axis=0))))


def _write_names(file: BinaryIO, survey: _Survey) -> None:
    lines = [f'{dimension} {number} "{name}"' for dimension, number, name in survey.groups]
    file.write("\n".join(["$PhysicalNames", str(len(lines)), *lines, "$EndPhysicalNames", ""]).encode())


def _write_entities(file: BinaryIO, survey: _Survey) -> None:
    file.write(b"$Entities\n" + _packed("u8", [0, 0, len(survey.facets), len(survey.cells)]))
    for key, number in survey.numbers.items():
        file.write(_packed("i4", [number]) + _packed("f8", survey.boxes[key]))
        file.write(_packed("u8", [1]) + _packed("i4", [number]) + _packed("u8", [0]))
    for group in survey.cells:
        file.write(_packed("i4", [group]) + _packed("f8", survey.boxes[group]))
        file.write(_packed("u8", [1]) + _packed("i4", [group]))
        bounding = [number for key, number in survey.numbers.items() if _bounds(key, group)]
        file.write(_packed("u8", [len(bounding)]) + _packed("i4", bounding))
    file.write(b"\n$EndEntities\n")


def _bounds(key: int, group: int) -> bool:
    """Return whether a surface bounds a volume."""
    if group == AIR:
        return key not in NOT_OF_AIR
    of_building = key >= FIRST_BUILDING
    if group == VOLUMES[Region.BUILDING]:
        return of_building or key in OF_BUILDING
    return not of_building and key not in NOT_OF_SOIL


def _begin_nodes(file: BinaryIO, n: int) -> int:
    """Write all of the section but coordinates; returns where they begin."""
    file.write(b"$Nodes\n" + _packed("u8", [1, n, 1, n]) + _packed("i4", [3, AIR, 0]) + _packed("u8", [n]))
    for some in slices(n):
        file.write(_packed("u8", np.arange(some.start + 1, some.stop + 1)))
    start = file.tell()
    file.seek(start + 24 * n)
    file.write(b"\n$EndNodes\n")
    return start


def _begin_elements(file: BinaryIO, survey: _Survey) -> dict[int, tuple[int, int]]:
    """Write all of the section but elements; returns by key where they begin, and the first one's number."""
    n = survey.n_elements
    file.write(b"$Elements\n" + _packed("u8", [len(survey.facets) + len(survey.cells), n, 1, n]))
    places, tag = {}, 1
    numbers = survey.numbers | {group: group for group in survey.cells}
    for group, count in {**survey.facets, **survey.cells}.items():
        dimension, kind = (3, TETRAHEDRON) if group in NAMES else (2, TRIANGLE)
        file.write(_packed("i4", [dimension, numbers[group], kind]) + _packed("u8", [count]))
        places[group] = file.tell(), tag
        file.seek(count * 8 * (2 + dimension), 1)
        tag += count
    file.write(b"\n$EndElements\n")
    return places


def _begin_leaves(file: BinaryIO, n: int) -> int:
    """Write the section of the leaf area density of all elements but its rows; returns where they begin."""
    file.seek(0, 2)
    file.write(f'$ElementData\n1\n"{LEAVES}"\n1\n0.0\n3\n0\n1\n{n}\n'.encode())
    start = file.tell()
    file.seek(LEAF_ROW.itemsize * n, 1)
    file.write(b"\n$EndElementData\n")
    return start


def _leaf_rows(tags: Ints, density: NDArray[np.float32]) -> bytes:
    rows = np.empty(len(tags), LEAF_ROW)
    rows["tag"], rows["density"] = tags, density
    return rows.tobytes()


def _packed(kind: str, numbers: Iterable[Any]) -> bytes:
    values = numbers if isinstance(numbers, np.ndarray) else list(numbers)
    return np.asarray(values, f"<{kind}").tobytes()


def _numbered(tag: int, nodes: NDArray[np.int64], kind: int, group: NDArray[np.int64]) -> NDArray[np.int64]:
    """Make the lines of elements: number, type, two tags (group and entity), nodes."""
    n = len(nodes)
    return np.column_stack((tag + np.arange(n), np.full(n, kind), np.full(n, 2), group, group, nodes))


FORMAT = Format("Gmsh's MSH 4.1, binary", export_msh, options=(*PER_BUILDING, *CELLS), suffix=".msh")
