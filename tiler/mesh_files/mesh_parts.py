"""Parts of a mesh that share no face with each other: of each tile's columns, and of the region's tiles.

A domain in two parts has no flow between them: most solvers take it without a word, and go wrong.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.columns.columns import count_by_triangle
from pipeline.data.mesh import ColumnMesh
from pipeline.data.notes import Note
from pipeline.geometry.components import join_pairs

MESH_IN_PARTS = "mesh-in-parts"  # kind of the note
LISTED_PARTS = 20  # that the record lists, largest first


@dataclass(frozen=True, eq=False)
class TileParts:
    """Parts of one tile's air."""

    name: str  #: the tile
    cells: Sequence[int]  #: cells of each part
    seams: Mapping[str, int]  #: seams that it shares with a tile that is there
    #: of a tile of several parts: by seam, the plan edges over which it shares faces, x and y of both ends (m),
    #: the lesser one first, and the part that each belongs to
    edges: Mapping[str, Sequence[tuple[tuple[float, ...], int]]] = field(default_factory=dict)


def label_triangles(triangles: NDArray[np.int32], n_points: int) -> NDArray[np.int64]:
    """Number the parts of a plane mesh whose triangles share no edge with those of another one.

    The air over two triangles that share an edge shares a face below the top, so these are the parts of the air,
    and likewise those of the soil.

    Returns
    -------
    int64, (m,)
        Part of each triangle, from 0.

    Examples
    --------
    Two triangles on one edge, and a third that touches them in a point:

    >>> label_triangles(np.array([[0, 1, 2], [1, 3, 2], [3, 4, 5]], np.int32), 6).tolist()
    [0, 0, 1]
    """
    start, end = triangles.ravel().astype(np.int64), np.roll(triangles, -1, axis=1).ravel().astype(np.int64)
    key = np.minimum(start, end) * n_points + np.maximum(start, end)
    order = np.argsort(key, kind="stable")
    same = np.flatnonzero(key[order[1:]] == key[order[:-1]])
    pairs = np.column_stack((order[same] // 3, order[same + 1] // 3))
    _, label = np.unique(join_pairs(len(triangles), pairs), return_inverse=True)
    return label.reshape(-1)


def find_tile_parts(
    mesh: ColumnMesh, edge: NDArray[np.int32], side: NDArray[np.integer[Any]]
) -> tuple[list[int], dict[str, NDArray[Any]]]:
    """Find the parts of a tile's air.

    Parameters
    ----------
    mesh : ColumnMesh
        Its columns.
    edge : int32, (e, 2)
        Plan edges on seams beyond which there is a tile, as rows of its vertices.
    side : int, (e,)
        The seam of each.

    Returns
    -------
    list of int
        Cells of each part.
    dict of str to array
        Where there are several: ``part_edge`` (e, 4), ``part_of`` and ``part_side`` (e,), see `TileParts`.
    """
    triangles = mesh.plane.triangles
    label = label_triangles(triangles, len(mesh.plane.xy))
    cells = np.bincount(label, count_by_triangle(mesh)).astype(np.int64)
    if len(cells) <= 1:
        return cells.tolist(), {}
    n = len(mesh.plane.xy)
    start, end = triangles.ravel().astype(np.int64), np.roll(triangles, -1, axis=1).ravel().astype(np.int64)
    key = np.minimum(start, end) * n + np.maximum(start, end)
    order = np.argsort(key, kind="stable")
    ends = np.sort(edge.astype(np.int64), axis=1)
    row = order[np.searchsorted(key[order], ends[:, 0] * n + ends[:, 1]).clip(max=len(key) - 1)]
    edges = _as_edges(mesh.plane.xy[ends])
    return cells.tolist(), {"part_edge": edges, "part_of": label[row // 3], "part_side": side.astype(np.int64)}


def read_tile_parts(
    name: str,
    cells: Sequence[int],
    seams: Mapping[str, int],
    arrays: Mapping[str, NDArray[Any]],
    sides: Sequence[str],
) -> TileParts:
    """Read what `find_tile_parts` gave; `sides` are the names of the tile's seams in their order."""
    edges: dict[str, list[tuple[tuple[float, ...], int]]] = {}
    if "part_edge" in arrays:
        rows = zip(*(arrays[key].tolist() for key in ("part_edge", "part_of", "part_side")), strict=True)
        for edge, part, side in rows:
            edges.setdefault(sides[side], []).append((tuple(edge), part))
    return TileParts(name, cells, seams, edges)


def join_tiles(tiles: Iterable[TileParts]) -> list[dict[str, Any]]:
    """Join the parts of tiles over their seams.

    Returns
    -------
    list of dict
        Parts of the mesh, that of the most cells first: ``cells``, ``tiles`` (names), and ``divided``: those of
        these tiles that have cells of another part too.
    """
    known = list(tiles)
    first = np.concatenate(([0], np.cumsum([len(tile.cells) for tile in known]))).astype(np.int64)
    pairs: list[tuple[int, int]] = []
    by_seam: dict[str, list[int]] = {}
    for k, tile in enumerate(known):
        for seam, faces in tile.seams.items():
            if faces:
                by_seam.setdefault(seam, []).append(k)
    for seam, beside in by_seam.items():
        if len(beside) == 2:
            a, b = beside
            pairs += [
                (int(first[a]) + one, int(first[b]) + other) for one, other in _join_pair(known[a], known[b], seam)
            ]
    name = join_pairs(int(first[-1]), np.array(pairs, np.int64).reshape(-1, 2))
    cells = np.concatenate([np.empty(0, np.int64), *(np.array(tile.cells, np.int64) for tile in known)])
    parts: dict[int, dict[str, Any]] = {}
    for k, tile in enumerate(known):
        for row in range(first[k], first[k + 1]):
            part = parts.setdefault(int(name[row]), {"cells": 0, "tiles": [], "divided": []})
            part["cells"] += int(cells[row])
            if not part["tiles"] or part["tiles"][-1] != tile.name:
                part["tiles"].append(tile.name)
                if len({int(other) for other in name[first[k] : first[k + 1]]}) > 1:
                    part["divided"].append(tile.name)
    return sorted(parts.values(), key=lambda part: (-part["cells"], part["tiles"]))


def _join_pair(one: TileParts, other: TileParts, seam: str) -> set[tuple[int, int]]:
    """Pairs of parts of two tiles that share faces over their seam."""
    if len(one.cells) == 1:
        return {(0, part) for _, part in other.edges.get(seam, ())} if len(other.cells) > 1 else {(0, 0)}
    if len(other.cells) == 1:
        return {(part, 0) for _, part in one.edges.get(seam, ())}
    parts = dict(one.edges.get(seam, ()))
    return {(parts[edge], part) for edge, part in other.edges.get(seam, ()) if edge in parts}


def _as_edges(ends: NDArray[np.float64]) -> NDArray[np.float64]:
    """Write edges (k, 2, 2) as x, y of the lesser end and of the greater, (k, 4)."""
    swapped = (ends[:, 0, 0] > ends[:, 1, 0]) | (
        (ends[:, 0, 0] == ends[:, 1, 0]) & (ends[:, 0, 1] > ends[:, 1, 1])
    )
    ordered = np.where(swapped[:, None, None], ends[:, ::-1], ends)
    return ordered.reshape(-1, 4)


def describe_parts(parts: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the parts of a mesh for its record: their number, and of several the largest with their tiles."""
    return {"n": len(parts)} | ({"largest": list(parts[:LISTED_PARTS])} if len(parts) > 1 else {})


def report_parts(cells: Sequence[int], n: int | None = None) -> str:
    """Write in how many parts a mesh is, given the cells of the largest, and their number where there are more.

    Examples
    --------
    >>> report_parts([700])
    'the mesh is one part: all cells hang together by faces'
    >>> report_parts([2000, 700, 10])
    'the mesh is 3 parts that share no face: of 2,000, 700 and 10 cells'
    """
    n = len(cells) if n is None else n
    if n <= 1:
        return "the mesh is one part: all cells hang together by faces"
    shown = [f"{n:,}" for n in cells[:3]] if n <= 3 else [f"{n:,}" for n in cells[:3]] + ["fewer"]
    return f"the mesh is {n:,} parts that share no face: of {', '.join(shown[:-1])} and {shown[-1]} cells"


def note_parts(parts: Sequence[Mapping[str, Any]]) -> list[Note]:
    """Make the note on a mesh in several parts; none where it is one."""
    if len(parts) <= 1:
        return []
    told = report_parts([part["cells"] for part in parts])
    tiles = parts[1]["tiles"]
    smaller = f"tiles of the second one: {', '.join(tiles[:3])}{' and more' if len(tiles) > 3 else ''}"
    move = "no flow passes between them: close the gap, mesh them apart by --bounds, or export --largest-part"
    return [Note(MESH_IN_PARTS, detail=f"{told}; {smaller}; {move}")]
