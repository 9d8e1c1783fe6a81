"""OpenFOAM's polyMesh of prisms and other cells, whole or decomposed: faces of three and of four corners."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.data.errors import ConfigError
from pipeline.data.mesh import is_ground
from stitch.pieces.conformity import group_rows
from tiler.export.bisection import bisect_columns, column_centres, count_columns
from tiler.export.foam_files import LABEL_LIMIT, FoamList, foam_header
from tiler.export.foam_part import PartCounts, count_distances, leaves_beside
from tiler.export.foam_patches import (
    FIRST_LEAVES,
    GROUND_ZONE,
    POLY_MESH,
    ZonesFile,
    add_all_leaves,
    cell_zone_name,
    face_zone_name,
    is_house,
    leaf_key,
    patch_keys,
    patch_of_key,
    write_boundary,
    write_volumes,
)
from tiler.export.region_faces import FacetSets, Ints
from tiler.mesh_files.prisms import PrismMesh
from tiler.mesh_files.transitions import NO_CORNER


@dataclass(frozen=True, eq=False)
class _Part:
    """The cells of one process, or the whole mesh.

    Attributes
    ----------
    number : int
        Which it is.
    mesh : PrismMesh
        Its cells, points and faces but those towards other parts; the boundary patch by patch.
    keys : int64, (f,)
        Key of the patch of each face of the boundary.
    zones : int64, (i + f,), or None
        Key of the face zone of each inner face and of each of the boundary, -1 for none; None without
        zones.
    others : mapping of int to int
        Faces towards each other part.
    across, across_cell : int64, (a, 4) and (a,)
        These faces, part by part, out of their cells.
    addressing : mapping of str to int64
        Numbers of points, cells, faces (turned if negative) and patches in the whole mesh, for `reconstructPar`.
    """

    number: int
    mesh: PrismMesh
    keys: Ints
    zones: Ints | None
    others: Mapping[int, int]
    across: Ints
    across_cell: Ints
    addressing: Mapping[str, Ints]


def write_foam_prisms(
    folder: Path,
    mesh: PrismMesh,
    *,
    by_building: bool = False,
    by_zone: bool = False,
    heights: Path | None = None,
    parts: int | None = None,
) -> list[PartCounts]:
    """Write a mesh of prisms as OpenFOAM reads it.

    Parameters
    ----------
    folder : Path
        An existing folder: that of the case.
    mesh : PrismMesh
        The mesh.
    by_building : bool
        Whether each building has a patch of its own.
    by_zone : bool
        Whether each building has a face zone beside the patches.
    heights : Path, optional
        An existing folder for the heights of the centres of cells (m), as `tiler.export.foam_part.FoamPlan`.
    parts : int, optional
        Write ``processor0`` to ``processorN-1`` instead of the whole mesh.

    Raises
    ------
    ConfigError
        If there are too few columns for so many parts.

    Notes
    -----
    Faces stand in upper triangular order, then patch by patch.
    """
    keys = patch_keys(mesh.marker, mesh.building, by_building=by_building)
    order = np.argsort(keys, kind="stable")
    whole = replace(mesh, outer=mesh.outer[order], outer_cell=mesh.outer_cell[order])
    keys = keys[order]
    zones = _zones_of(whole, order, by_zone=by_zone)
    zone_keys = np.empty(0, np.int64) if zones is None else np.unique(zones[zones >= 0])
    n_corners = int((mesh.inner != NO_CORNER).sum() + (mesh.outer != NO_CORNER).sum())
    label = 32 if max(n_corners, len(mesh.points), len(mesh.cells)) <= LABEL_LIMIT else 64
    if parts is None:
        alone = _Part(0, whole, keys, zones, {}, np.empty((0, 4), np.int64), np.empty(0, np.int64), {})
        return [_write_part(folder / POLY_MESH, alone, np.unique(keys), zone_keys, heights, label)]
    part = _divide(whole, parts)
    return [
        _write_part(
            folder / f"processor{number}" / POLY_MESH,
            _take_part(whole, keys, zones, part, number),
            np.unique(keys),
            zone_keys,
            heights,
            label,
        )
        for number in range(parts)
    ]


def _zones_of(mesh: PrismMesh, order: Ints, *, by_zone: bool) -> Ints | None:
    """Give the face zones, as `_Part` has them; `order` is that in which the boundary stands."""
    ground = np.sort(mesh.between[is_ground(mesh.between_marker)], axis=1)
    if not by_zone and not len(ground):
        return None
    inner, n = group_rows(np.concatenate((np.sort(mesh.inner[:, :3], axis=1), ground)))
    known = np.zeros(n, np.bool_)
    known[inner[len(mesh.inner) :]] = True
    inside = np.where(known[inner[: len(mesh.inner)]] & (mesh.inner[:, 3] == NO_CORNER), GROUND_ZONE, -1)
    houses = by_zone & is_house(mesh.marker, mesh.building)
    return np.concatenate((inside, np.where(houses, mesh.building, -1)[order]))


def _divide(mesh: PrismMesh, n_parts: int) -> Ints:
    """Give the part of each cell: columns as `tiler.export.cell_parts.divide_cells` deals them out."""
    corners = np.where(mesh.cells == NO_CORNER, mesh.cells[:, :1], mesh.cells)
    cuts = bisect_columns(count_columns(mesh.points, corners), n_parts) if n_parts > 0 else None
    part = np.empty(0, np.int64) if cuts is None else cuts.part_of(column_centres(mesh.points, corners))
    if len(np.unique(part)) != n_parts or not n_parts:
        raise ConfigError(
            f"--parts {n_parts}: must be 1 or more, and no more than the columns that {len(mesh.cells):,} cells "
            "stand in"
        )
    return part


def _take_part(mesh: PrismMesh, keys: Ints, zones: Ints | None, part: Ints, number: int) -> _Part:
    """Take the cells of a part, and number points, cells and faces anew, in their order."""
    cells = np.flatnonzero(part == number)
    place = np.empty(len(part), np.int64)
    place[cells] = np.arange(len(cells))
    used = np.unique(mesh.cells[cells])
    used = used[used != NO_CORNER]

    def local(rows: Ints) -> Ints:
        return np.where(rows == NO_CORNER, NO_CORNER, np.searchsorted(used, rows))

    low, high = part[mesh.owner] == number, part[mesh.neighbour] == number
    inside, mine = np.flatnonzero(low & high), np.flatnonzero(part[mesh.outer_cell] == number)
    across = np.flatnonzero(low != high)
    other = part[np.where(low, mesh.neighbour, mesh.owner)[across]]
    order = np.argsort(other, kind="stable")
    across, other = across[order], other[order]
    turned = high[across]
    rows = mesh.inner[across]
    back = np.where(rows[:, 3:] == NO_CORNER, rows[:, [0, 2, 1, 3]], rows[:, [0, 3, 2, 1]])
    beyond, count = np.unique(other, return_counts=True)
    faces = (inside + 1, len(mesh.inner) + mine + 1, np.where(turned, -1, 1) * (across + 1))
    n_patches = len(np.unique(keys))
    own = replace(
        mesh,
        points=mesh.points[used],
        cells=local(mesh.cells[cells]),
        inner=local(mesh.inner[inside]),
        owner=place[mesh.owner[inside]],
        neighbour=place[mesh.neighbour[inside]],
        outer=local(mesh.outer[mine]),
        outer_cell=place[mesh.outer_cell[mine]],
        leaves=None if mesh.leaves is None else mesh.leaves[cells],
        region=None if mesh.region is None else mesh.region[cells],
    )
    return _Part(
        number,
        own,
        keys[mine],
        None if zones is None else zones[np.concatenate((inside, len(mesh.inner) + mine))],
        dict(zip(beyond.tolist(), count.tolist(), strict=True)),
        local(np.where(turned[:, None], back, rows)),
        place[np.where(turned, mesh.neighbour[across], mesh.owner[across])],
        {
            "point": used,
            "cell": cells,
            "face": np.concatenate(faces),
            "boundary": np.concatenate((np.arange(n_patches), np.full(len(beyond), -1))),
        },
    )


def _write_part(
    place: Path, part: _Part, patch_of_all: Ints, zone_of_all: Ints, heights: Path | None, label: int
) -> PartCounts:
    """Write the polyMesh of a part, which has the patches of the whole mesh."""
    place.mkdir(parents=True)
    mesh = part.mesh
    faces = np.concatenate((mesh.inner, mesh.outer, part.across))
    _write_faces(place / "faces", faces, label)
    number = f"i{label // 8}"
    lists = [
        ("points", "vectorField", "f8", mesh.points),
        ("owner", "labelList", number, np.concatenate((mesh.owner, mesh.outer_cell, part.across_cell))),
        ("neighbour", "labelList", number, mesh.neighbour),
        *((f"{name}ProcAddressing", "labelList", number, rows) for name, rows in part.addressing.items()),
    ]
    for name, kind, dtype, rows in lists:
        header = foam_header(name, kind, location=POLY_MESH, binary=True, label=label)
        with FoamList(place / name, header, dtype, width=rows[:1].size or 1, n=len(rows)) as file:
            file.write(0, rows)
    lowest, highest, near, patches = {}, {}, {}, {}
    first, last = (np.searchsorted(part.keys, patch_of_all, side) for side in ("left", "right"))
    for key, begin, end in zip(patch_of_all.tolist(), first.tolist(), last.tolist(), strict=True):
        patch = patch_of_key(key, mesh.ground)
        patches[patch] = end - begin
        if end == begin:
            continue
        rows, cell = mesh.outer[begin:end], mesh.outer_cell[begin:end]
        z = mesh.points[np.where(rows == NO_CORNER, rows[:, :1], rows), 2]
        lowest[patch.name], highest[patch.name] = float(z.min()), float(z.max())
        if patch.kind == "wall":
            near[patch.name] = count_distances(mesh.centres(cell), mesh.points, rows)
    counts = write_boundary(
        place / "boundary", patches, start=len(mesh.inner), number=part.number, others=part.others
    )
    if heights is not None:
        height = mesh.centres()[:, 2]
        height.tofile(heights / f"{part.number}")
        ends = np.cumsum(list(part.others.values()))[:-1]
        for other, cell in zip(part.others, np.split(part.across_cell, ends), strict=False):
            height[cell].tofile(heights / f"{part.number}-{other}")
    own = heights / f"{part.number}" if heights is not None else None
    if part.zones is not None:
        keys = np.concatenate((part.zones, np.full(len(part.across), -1)))
        _write_zones(place / "faceZones", keys, zone_of_all, face_zone_name)
    leaves = _write_volumes(place / "cellZones", mesh, own)
    return PartCounts(
        len(mesh.cells), len(mesh.points), len(faces), len(mesh.inner), counts, lowest, highest, near, leaves
    )


def _write_zones(path: Path, keys: Ints, known: Ints, name_of: Callable[[int], str]) -> None:
    count = [int((keys == key).sum()) for key in known.tolist()]
    sets = FacetSets(known, {0: dict(enumerate(count))})
    with ZonesFile(path, sets, [0], name_of) as file:
        file.write(0, keys, np.arange(len(keys)))


def _write_volumes(path: Path, mesh: PrismMesh, heights: Path | None) -> dict[str, int]:
    """Write the zones of regions and leaves, and the density beside the heights; gives cells between leaves."""
    if mesh.leaves is None and mesh.region is None:
        return {}
    keys = np.full(len(mesh.cells), -1) if mesh.region is None else mesh.region.astype(np.int64)
    if mesh.leaves is not None:
        keys = np.where(mesh.leaves > 0, leaf_key(mesh.leaves), keys)
    present, count = np.unique(keys[keys >= 0], return_counts=True)
    sets = FacetSets(present, {0: dict(enumerate(count.tolist()))})
    with ZonesFile(path, add_all_leaves(sets), [0], cell_zone_name) as file:
        write_volumes(file, 0, keys, np.arange(len(keys)))
    if heights is not None and mesh.leaves is not None:
        mesh.leaves.astype("<f8").tofile(leaves_beside(heights))
    leafy = present >= FIRST_LEAVES
    return dict(zip(map(cell_zone_name, present[leafy].tolist()), count[leafy].tolist(), strict=True))


def _write_faces(path: Path, faces: NDArray[np.int64], label: int) -> None:
    """Write where each face begins, then the corners of all."""
    dtype = np.dtype(f"<i{label // 8}")
    start = np.concatenate(([0], np.cumsum((faces != NO_CORNER).sum(axis=1))))
    corners = faces[faces != NO_CORNER]
    header = foam_header("faces", "faceCompactList", location=POLY_MESH, binary=True, label=label)
    with path.open("wb") as file:
        file.write(header.encode())
        for rows in (start, corners):
            file.write(f"{len(rows)}\n(".encode())
            file.write(rows.astype(dtype).data)
            file.write(b")\n")
