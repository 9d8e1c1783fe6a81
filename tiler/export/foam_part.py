"""One polyMesh of OpenFOAM: the whole mesh, or the part of one process."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stitch.pieces.cell_faces import CellFaces
from tiler.export.cell_parts import CellParts
from tiler.export.foam_files import POLY_MESH, FoamFaces, FoamList, FoamPolygons, foam_header, write_at
from tiler.export.foam_patches import (
    FIRST_LEAVES,
    GROUND_ZONE,
    ZonesFile,
    add_all_leaves,
    cell_zone_name,
    face_zone_name,
    patch_of_key,
    runs_of,
    write_boundary,
    write_volumes,
)
from tiler.export.pieces import Pieces
from tiler.export.region_faces import (
    FacetSets,
    Ints,
    OwnFaces,
    RegionFaces,
    faces_of_piece,
    find_ground,
    find_inner_ground,
    find_outer,
    lowest_first,
    number_corners,
    own_faces,
    wrong_ground,
)
from tiler.mesh_files.mesh_pieces import MeshPiece
from tiler.mesh_files.prisms import find_centres
from tiler.mesh_files.threads import map_threads
from tiler.mesh_files.transitions import fill_corners, turn_over

DISTANCES = np.logspace(-4, 3, 281)  # m; bins of 6 %
_Patch = tuple[str, float, float, Ints | None]  # lowest and highest point, and distances, as `PartCounts` has them


def no_keys(_: MeshPiece) -> Ints:
    """Give no key of cells."""
    return np.empty(0, np.int64)


def leaves_beside(heights: Path) -> Path:
    """Name the file of the leaf area density of cells (m2/m3), float64, beside that of their heights."""
    return heights.with_name(f"leaves.{heights.name}")


@dataclass(frozen=True)
class PartCounts:
    """What was written of a mesh, or of one part of it."""

    #: their numbers
    cells: int
    points: int
    faces: int
    inner_faces: int
    patches: Mapping[str, int]  #: faces of each patch, processor patches included
    #: lowest and highest point (m) of each patch of the region's boundary that has faces here
    lowest: Mapping[str, float]
    highest: Mapping[str, float]
    #: of each patch that is a wall, for how many faces the centre of their cell is within `DISTANCES` of their
    #: plane
    near: Mapping[str, Ints]
    leaves: Mapping[str, int] = field(default_factory=dict)  #: cells of each zone of cells between leaves


@dataclass(frozen=True, eq=False)
class FoamPlan:
    """What all parts are written from."""

    pieces: Pieces  #: the mesh
    region: RegionFaces  #: numbers of cells and faces
    #: patches by key (`patch_of_key`) and cell zones by region, of the whole mesh. `parts` has those of each part,
    #: in this order: patches, face zones by key (`face_zone_name`), cell zones
    patches: FacetSets
    volumes: FacetSets
    zoned: bool  #: whether face zones are written
    #: give the key of each facet of a piece, -1 for none
    patch_keys: Callable[[MeshPiece], Ints]
    zone_keys: Callable[[MeshPiece], Ints]
    parts: CellParts  #: part of each cell
    label: int  #: bits of an integer
    #: a folder for the heights of the centres of cells (m), float64: a file for each part by its number, and for
    #: two parts ``a`` and ``b`` that meet a file ``a-b`` of the cells of ``a`` at their faces, in their order
    heights: Path | None = None
    volume_keys: Callable[[MeshPiece], Ints] = no_keys  #: gives the key of each cell of a piece, or none at all
    polygons: bool = False  #: whether faces may have four corners


class PointPlaces:
    """Numbers of points within a part; a file with holes, 8 bytes a point of the part.

    Parameters
    ----------
    path : Path
        The file.
    n_points : int
        Points of the region.
    """

    def __init__(self, path: Path, n_points: int) -> None:
        self._place = np.memmap(path, np.int64, "w+", shape=(max(n_points, 1),))
        self._end = 0

    def add(self, ids: Ints) -> tuple[Ints, NDArray[np.bool_]]:
        """Number the points of a piece in the order in which they come; tell also which of them are new."""
        fresh = self._place[ids] == 0
        n = int(fresh.sum())
        self._place[ids[fresh]] = self._end + 1 + np.arange(n)
        self._end += n
        return self._place[ids] - 1, fresh


@dataclass(frozen=True, eq=False)
class _Numbers:
    """The numbers of a part: its cells, where faces of each patch begin, faces towards other parts."""

    number: int
    pieces: Sequence[int]
    n_cells: int
    n_inner: int
    others: dict[int, int]
    first: dict[int, dict[int, int]]
    patch_n: Ints
    patch_start: Ints

    @property
    def n_faces(self) -> int:
        return self.n_inner + int(self.patch_n.sum()) + sum(self.others.values())


@dataclass(frozen=True, eq=False)
class _Across:
    """Faces towards other parts: which, number over the region, whether turned, owner and vertices here."""

    other: Ints
    face: Ints
    turned: NDArray[np.bool_]
    owner: Ints
    corners: Ints


def write_part(
    folder: Path, plan: FoamPlan, number: int, places: PointPlaces | None, *, threads: int = 0
) -> PartCounts:
    """Write the polyMesh of one part.

    Parameters
    ----------
    folder : Path
        The case, or the folder of the process; made if it is missing.
    plan : FoamPlan
        The region's numbers.
    number : int
        Which part.
    places : PointPlaces, optional
        Numbers of points in parts. If not given, there is one part, the whole mesh, and points keep the region's
        numbers.
    threads : int
        How many write pieces of the whole mesh; with less than 2 this one does.
    """
    (folder / POLY_MESH).mkdir(parents=True)
    with ExitStack() as stack:
        writer = _PartWriter(folder / POLY_MESH, plan, number, places, stack)
        for found in map_threads(writer.add, writer.numbers.pieces, 0 if places else threads):
            writer.count(*found)
        return writer.finish()


class _PartWriter:
    """The open files of a part."""

    def __init__(
        self, folder: Path, plan: FoamPlan, number: int, places: PointPlaces | None, stack: ExitStack
    ) -> None:
        self._folder, self._plan, self._places, self._stack = folder, plan, places, stack
        self.numbers = numbers = _number_part(plan, number)
        self._row = 0
        self._across: list[_Across] = []
        self._lowest: dict[str, float] = {}
        self._highest: dict[str, float] = {}
        self._near: dict[str, Ints] = {}
        self._leaves: Counter[int] = Counter()
        n = numbers.n_faces
        self._faces: FoamFaces | FoamPolygons
        if plan.polygons:
            self._faces = stack.enter_context(FoamPolygons(folder / "faces", label=plan.label, n=n))
        else:
            self._faces = stack.enter_context(FoamFaces(folder / "faces", label=plan.label, n=n))
        n_points = plan.pieces.n_points if places is None else None
        self._points = self._open("points", n=n_points, kind="vectorField", dtype="f8", width=3)
        self._owner, self._neighbour = self._open("owner", n=n), self._open("neighbour", n=numbers.n_inner)
        if places is not None:
            self._point_to, self._cell_to = self._open("pointProcAddressing"), self._open("cellProcAddressing")
            self._face_to = self._open("faceProcAddressing", n=n)
            self._whole = _number_facets(plan.patches, range(len(plan.pieces.names)), plan.region.n_inner)
        _, zones, volumes = (sets[number] for sets in plan.parts.sets)
        self._zones = None
        if plan.zoned:
            faces = ZonesFile(folder / "faceZones", zones, numbers.pieces, face_zone_name)
            self._zones = stack.enter_context(faces)
        self._volumes = None
        if len(plan.volumes.keys):
            cells = ZonesFile(folder / "cellZones", add_all_leaves(volumes), numbers.pieces, cell_zone_name)
            self._volumes = stack.enter_context(cells)
        self._heights = None
        if plan.heights is not None:
            self._heights = stack.enter_context((plan.heights / str(number)).open("wb"))

    def add(self, k: int) -> tuple[list[_Patch], Counter[int]]:
        """Write what is in the part of piece `k`; returns what `count` takes."""
        piece = self._plan.pieces.read(k)
        faces = faces_of_piece(piece)
        start = int(self._plan.region.cell_start[k])
        cells: slice | Ints = slice(start, start + len(piece.cells))
        if self._places is not None and self._plan.parts.part is not None:
            cells = start + np.flatnonzero(self._plan.parts.part[cells] == self.numbers.number)
        local = self._add_points(k, piece, cells)
        self._add_inner(k, piece, faces, local)
        patches, leaves = self._add_facets(k, piece, faces, local), Counter[int]()
        if self._volumes is not None:
            number = np.arange(cells.start, cells.stop) if isinstance(cells, slice) else cells
            keys = self._plan.volume_keys(piece)[number - start]
            write_volumes(self._volumes, k, keys, self._plan.parts.place_of(number))
            leaves.update(keys[keys >= FIRST_LEAVES].tolist())
        rows = slice(0, len(piece.cells)) if isinstance(cells, slice) else cells - start
        if self._heights is not None and len(mine := piece.cells[rows]):
            first = cells.start if isinstance(cells, slice) else int(self._plan.parts.place_of(cells[:1])[0])
            write_at(self._heights, 8 * first, find_centres(piece.points[:, 2:], mine))
            if piece.leaves is not None and self._plan.heights is not None:
                path = leaves_beside(self._plan.heights / str(self.numbers.number))
                path.touch()
                with path.open("r+b") as file:
                    write_at(file, 8 * first, piece.leaves[rows].astype("<f8"))
        return patches, leaves

    def count(self, patches: list[_Patch], leaves: Counter[int]) -> None:
        """Count what a piece has, piece after piece."""
        self._leaves.update(leaves)
        for name, low, high, near in patches:
            self._lowest[name] = min(self._lowest.get(name, np.inf), low)
            self._highest[name] = max(self._highest.get(name, -np.inf), high)
            if near is not None:
                self._near[name] = self._near.get(name, 0) + near

    def finish(self) -> PartCounts:
        """Write what stands behind the pieces."""
        plan, numbers = self._plan, self.numbers
        if self._places is not None:
            self._add_across()
            rows = [*range(len(plan.patches.keys)), *(-1 for _ in numbers.others)]
            self._open("boundaryProcAddressing").append(np.array(rows, np.int64))
        patches = {
            patch_of_key(key, plan.pieces.ground): n
            for key, n in zip(plan.patches.keys.tolist(), numbers.patch_n.tolist(), strict=True)
        }
        counts = write_boundary(
            self._folder / "boundary", patches, start=numbers.n_inner, number=numbers.number, others=numbers.others
        )
        n_points = self._points.n
        return PartCounts(
            numbers.n_cells,
            n_points,
            numbers.n_faces,
            numbers.n_inner,
            counts,
            self._lowest,
            self._highest,
            self._near,
            {cell_zone_name(key): n for key, n in sorted(self._leaves.items())},
        )

    def _open(
        self, name: str, *, n: int | None = None, kind: str = "labelList", dtype: str = "", width: int = 1
    ) -> FoamList:
        header = foam_header(name, kind, location=POLY_MESH, binary=True, label=self._plan.label)
        file = FoamList(self._folder / name, header, dtype or f"i{self._plan.label // 8}", width=width, n=n)
        return self._stack.enter_context(file)

    def _add_points(self, k: int, piece: MeshPiece, cells: slice | Ints) -> Ints:
        """Write the points of a piece; returns their numbers in this part, -1 for those that it has not."""
        if self._places is None:
            self._points.scatter(piece.ids, piece.points)
            return piece.ids
        start = self._plan.region.cell_start[k]
        if isinstance(cells, slice):
            cells = np.arange(cells.start, cells.stop)
        is_used = np.zeros(len(piece.points), np.bool_)
        is_used[fill_corners(piece.cells[cells - start])] = True
        used = np.flatnonzero(is_used)
        number, fresh = self._places.add(piece.ids[used])
        self._points.append(piece.points[used[fresh]])
        self._point_to.append(piece.ids[used[fresh]])
        self._cell_to.append(cells)
        local = np.full(len(piece.points), -1, np.int64)
        local[used] = number
        return local

    def _add_inner(self, k: int, piece: MeshPiece, faces: CellFaces, local: Ints) -> None:
        """Write the faces whose lower cell is in the piece and one of whose cells is in the part."""
        region, number = self._plan.region, self.numbers.number
        part_of, end = self._plan.parts.part_of, region.cell_start[k + 1]

        def is_mine(owner: Ints, neighbour: Ints) -> NDArray[np.bool_]:
            # Turned ones between two pieces are found in the piece of their upper cell.
            turned = (part_of(neighbour) == number) & (neighbour < end)
            mine: NDArray[np.bool_] = (part_of(owner) == number) | turned
            return mine

        ground = [np.empty(0, np.int64)]
        start = self._row if self._places is not None else int(region.face_start[k])
        for own in own_faces(region, k, piece, faces, None if self._places is None else is_mine):
            is_ground = find_ground(region, k, piece, own)
            inside = self._add_block(own, local, start)
            ground.append(start + np.cumsum(inside)[is_ground] - 1)
            start += int(inside.sum())
        self._row = start
        if self._places is not None:
            self._across.append(self._find_turned(k, piece, faces, local))
        if piece.region is None:
            return
        rows = np.concatenate(ground)
        if self._places is None and len(rows) != int(find_inner_ground(piece).sum()):
            raise wrong_ground(piece)
        if self._zones is not None and len(rows):
            self._zones.write(k, np.full(len(rows), GROUND_ZONE), rows)

    def _add_block(self, own: OwnFaces, local: Ints, start: int) -> NDArray[np.bool_]:
        """Write faces of a piece from number `start` on; returns which are inside the part."""
        parts, number = self._plan.parts, self.numbers.number
        low, high = parts.part_of(own.owner), parts.part_of(own.neighbour)
        corners = number_corners(local, own.corners)
        inside: NDArray[np.bool_] = (low == number) & (high == number)
        self._faces.write(start, corners[inside])
        self._owner.write(start, parts.place_of(own.owner[inside]))
        self._neighbour.write(start, parts.place_of(own.neighbour[inside]))
        if self._places is not None:
            self._face_to.write(start, own.number[inside] + 1)
            out = ~inside
            # Of a face whose lower cell is in another part the upper one is the owner here, so it is turned.
            turned = high[out] == number
            corners = np.where(turned[:, None], turn_over(corners[out]), corners[out])
            owner = parts.place_of(np.where(turned, own.neighbour[out], own.owner[out]))
            other = np.where(turned, low[out], high[out]).astype(np.int64)
            self._across.append(_Across(other, own.number[out], turned, owner, corners))
        return inside

    def _find_turned(self, k: int, piece: MeshPiece, faces: CellFaces, local: Ints) -> _Across:
        """Find the faces of the part's cells in a piece whose lower cell is in another part, and another piece."""
        region, parts, number = self._plan.region, self._plan.parts, self.numbers.number
        rows = np.arange(*region.shared_start[k : k + 2])
        cell, lower = np.asarray(region.cell[rows]), np.asarray(region.cell[np.asarray(region.mate[rows])])
        turned = np.flatnonzero(lower < cell)
        other = parts.part_of(lower[turned])
        chosen = (parts.part_of(cell[turned]) == number) & (other != number)
        turned, other = turned[chosen], other[chosen].astype(np.int64)
        corners = number_corners(local, lowest_first(faces.shared[turned], piece.ids))
        face = np.asarray(region.face[rows[turned]])
        return _Across(other, face, np.ones(len(face), np.bool_), parts.place_of(cell[turned]), corners)

    def _add_facets(self, k: int, piece: MeshPiece, faces: CellFaces, local: Ints) -> list[_Patch]:
        """Write the facets of the part's cells in a piece, each where its patch has room for them."""
        found: list[_Patch] = []
        numbers, keys = self.numbers, self._plan.patches.keys
        outer = find_outer(piece)
        facets, cell = piece.facets[outer], faces.facet_cell + self._plan.region.cell_start[k]
        mine = self._plan.parts.part_of(cell) == numbers.number
        owner, corners = self._plan.parts.place_of(cell), number_corners(local, facets)
        face = np.full(len(owner), -1, np.int64)
        for row, of_patch in runs_of(keys, self._plan.patch_keys(piece)[outer]):
            in_piece = np.flatnonzero(mine[of_patch])
            if not len(in_piece):
                continue
            chosen = of_patch[in_piece]
            at = int(numbers.patch_start[row]) + numbers.first[k][row]
            self._faces.write(at, corners[chosen])
            self._owner.write(at, owner[chosen])
            face[chosen] = at + np.arange(len(chosen))
            if self._places is not None:
                first, _, start = self._whole
                self._face_to.write(at, int(start[row]) + first[k][row] + 1 + in_piece)
            patch, faced = patch_of_key(int(keys[row]), self._plan.pieces.ground), facets[chosen]
            name, height = patch.name, piece.points[fill_corners(faced), 2]
            near = None
            if patch.kind == "wall":
                centres = find_centres(piece.points, piece.cells[faces.facet_cell[chosen]])
                near = count_distances(centres, piece.points, faced)
            found.append((name, float(height.min()), float(height.max()), near))
        if self._zones is not None:
            self._zones.write(k, np.where(mine, self._plan.zone_keys(piece)[outer], -1), face)
        return found

    def _add_across(self) -> None:
        """Write the faces towards other parts: by part, then by number over the region, so in its order too."""
        names = ("other", "face", "turned", "owner", "corners")
        other, face, turned, owner, corners = (
            np.concatenate([getattr(across, name) for across in self._across]) for name in names
        )
        order = np.lexsort((face, other))
        at = self.numbers.n_inner + int(self.numbers.patch_n.sum())
        self._faces.write(at, corners[order])
        self._owner.write(at, owner[order])
        self._face_to.write(at, (np.where(turned, -1, 1) * (face + 1))[order])
        if self._heights is not None and self._plan.heights is not None:
            height = np.fromfile(self._plan.heights / str(self.numbers.number))[owner[order]]
            for beyond in self.numbers.others:
                place = self._plan.heights / f"{self.numbers.number}-{beyond}"
                height[other[order] == beyond].tofile(place)


def count_distances(centres: NDArray[np.float64], points: NDArray[np.float64], facets: NDArray[Any]) -> Ints:
    """Count how far centres of cells (k, 3) are from planes of their facets (k, 3 or 4): bins of `DISTANCES`.

    Examples
    --------
    A cell of 4 m over the ground has its centre 1 m above it:

    >>> points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 4]])
    >>> counts = count_distances(points.mean(axis=0, keepdims=True), points, np.array([[0, 2, 1]]))
    >>> bool(DISTANCES[counts.argmax() - 1] <= 1.0 <= DISTANCES[counts.argmax()])
    True
    """
    a, b, c = (points[facets[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    area = np.sqrt((normal**2).sum(axis=1))
    offset = centres - a
    distance = np.abs((offset * normal).sum(axis=1)) / area
    return np.bincount(np.searchsorted(DISTANCES, distance), minlength=len(DISTANCES) + 1)


def _number_part(plan: FoamPlan, number: int) -> _Numbers:
    parts = plan.parts
    others = {a + b - number: n for (a, b), n in parts.between.items() if number in (a, b)}
    n_cells, n_inner, pieces = int(parts.n_cells[number]), int(parts.n_inner[number]), parts.pieces[number]
    first, patch_n, patch_start = _number_facets(parts.sets[0][number], pieces, n_inner)
    return _Numbers(number, pieces, n_cells, n_inner, dict(sorted(others.items())), first, patch_n, patch_start)


def _number_facets(
    patches: FacetSets, pieces: Sequence[int], n_inner: int
) -> tuple[dict[int, dict[int, int]], Ints, Ints]:
    """Where the facets of each piece begin in each patch, how many each patch has, and where it begins."""
    first, n = patches.first(pieces)
    return first, n, n_inner + np.cumsum(n) - n
