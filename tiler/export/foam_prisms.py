"""OpenFOAM's polyMesh of prisms: polyhedra with two triangles and three quadrilaterals."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tiler.export.foam_files import LABEL_LIMIT, FoamList, foam_header
from tiler.export.foam_part import PartCounts, count_distances, leaves_beside
from tiler.export.foam_patches import (
    POLY_MESH,
    ZonesFile,
    add_all_leaves,
    cell_zone_name,
    leaf_key,
    patch_keys,
    patch_of_key,
    write_boundary,
    write_volumes,
)
from tiler.export.region_faces import FacetSets
from tiler.mesh_files.prisms import NO_CORNER, PrismMesh


def write_foam_prisms(
    folder: Path, mesh: PrismMesh, *, by_building: bool = False, heights: Path | None = None
) -> PartCounts:
    """Write a mesh of prisms as OpenFOAM reads it.

    Parameters
    ----------
    folder : Path
        An existing folder: that of the case.
    mesh : PrismMesh
        The mesh.
    by_building : bool
        Whether each building has a patch of its own.
    heights : Path, optional
        An existing folder for the heights of the centres of cells (m), as `tiler.export.foam_part.FoamPlan`.

    Notes
    -----
    Faces stand in upper triangular order, then patch by patch.
    """
    place = folder / POLY_MESH
    place.mkdir(parents=True)
    keys = patch_keys(mesh.marker, mesh.building, by_building=by_building)
    order = np.argsort(keys, kind="stable")
    outer, outer_cell, keys = mesh.outer[order], mesh.outer_cell[order], keys[order]
    faces = np.concatenate((mesh.inner, outer))
    size = np.where(faces[:, 3] == NO_CORNER, 3, 4)
    n_corners = int(size.sum())
    label = 32 if max(n_corners, len(mesh.points), len(mesh.cells)) <= LABEL_LIMIT else 64
    _write_faces(place / "faces", faces, size, label)
    owner = np.concatenate((mesh.owner, outer_cell))
    for name, kind, dtype, rows in (
        ("points", "vectorField", "f8", mesh.points),
        ("owner", "labelList", f"i{label // 8}", owner),
        ("neighbour", "labelList", f"i{label // 8}", mesh.neighbour),
    ):
        header = foam_header(name, kind, location=POLY_MESH, binary=True, label=label)
        with FoamList(place / name, header, dtype, width=rows[:1].size, n=len(rows)) as file:
            file.write(0, rows)
    present, first, n = np.unique(keys, return_index=True, return_counts=True)
    patches = {patch_of_key(int(key), mesh.ground): int(count) for key, count in zip(present, n, strict=True)}
    counts = write_boundary(place / "boundary", patches, start=len(mesh.inner), number=0, others={})
    lowest, highest, near = {}, {}, {}
    for patch, start, count in zip(patches, first.tolist(), n.tolist(), strict=True):
        mine = slice(start, start + count)
        corners = np.where(outer[mine] == NO_CORNER, outer[mine, :1], outer[mine])
        z = mesh.points[corners, 2]
        lowest[patch.name], highest[patch.name] = float(z.min()), float(z.max())
        if patch.kind == "wall":
            near[patch.name] = count_distances(mesh.points, mesh.cells[outer_cell[mine]], outer[mine])
    if heights is not None:
        mesh.points[mesh.cells, 2].mean(axis=1).tofile(heights / "0")
    leaves = _write_leaves(place / "cellZones", mesh, heights) if mesh.leaves is not None else {}
    return PartCounts(
        len(mesh.cells), len(mesh.points), len(faces), len(mesh.inner), counts, lowest, highest, near, leaves
    )


def _write_leaves(path: Path, mesh: PrismMesh, heights: Path | None) -> dict[str, int]:
    """Write the zones of cells between leaves, and their density beside the heights; gives the cells of each."""
    density = np.zeros(0, np.float32) if mesh.leaves is None else mesh.leaves
    keys = np.where(density > 0, leaf_key(density), -1)
    present, count = np.unique(keys[keys >= 0], return_counts=True)
    sets = FacetSets(present, {0: dict(enumerate(count.tolist()))})
    with ZonesFile(path, add_all_leaves(sets), [0], cell_zone_name) as file:
        write_volumes(file, 0, keys, np.arange(len(keys)))
    if heights is not None:
        density.astype("<f8").tofile(leaves_beside(heights / "0"))
    return dict(zip(map(cell_zone_name, present.tolist()), count.tolist(), strict=True))


def _write_faces(path: Path, faces: NDArray[np.int64], size: NDArray[np.int64], label: int) -> None:
    """Write where each face begins, then the corners of all."""
    dtype = np.dtype(f"<i{label // 8}")
    start = np.concatenate(([0], np.cumsum(size)))
    corners = faces[faces != NO_CORNER]
    header = foam_header("faces", "faceCompactList", location=POLY_MESH, binary=True, label=label)
    with path.open("wb") as file:
        file.write(header.encode())
        for rows in (start, corners):
            file.write(f"{len(rows)}\n(".encode())
            file.write(rows.astype(dtype).data)
            file.write(b")\n")
