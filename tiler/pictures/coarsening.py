"""Facets made fewer for a picture: vertices that share a cell of a grid become one."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tiler.mesh_files.facet_quality import name_facets


@dataclass(frozen=True, eq=False)
class Facets:
    """Marked triangles.

    Attributes
    ----------
    points : float64, (n, 3)
        Vertices in the CRS (m).
    corners : int64, (k, 3)
        Rows of `points`.
    marker, piece : int32, (k,)
        `pipeline.data.mesh.Marker`, and row of the piece that each is of.
    building : int64, (k,)
        Number of the building, -1 on the ground.
    quality : float32, (k,)
        Radius ratio of the cell behind each; NaN where nobody asked.
    """

    points: NDArray[np.float64]
    corners: NDArray[np.int64]
    marker: NDArray[np.int32]
    piece: NDArray[np.int32]
    building: NDArray[np.int64]
    quality: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.corners)


def join_facets(parts: list[Facets]) -> Facets:
    """Put parts together, at least one; equal points stay apart."""
    first = np.cumsum([0, *(len(part.points) for part in parts)])
    return Facets(
        np.concatenate([part.points for part in parts]),
        np.concatenate([part.corners + begin for part, begin in zip(parts, first, strict=False)]),
        *(
            np.concatenate([getattr(part, name) for part in parts])
            for name in ("marker", "piece", "building", "quality")
        ),
    )


def coarsen(facets: Facets, size: float) -> Facets:
    """Make the vertices in each cell of a grid one, and drop triangles that lose their area or are there already.

    Parameters
    ----------
    facets : Facets
        Triangles.
    size : float
        Side of a cell (m). The grid is that of the CRS, so that tiles agree, and a grid twice as wide contains it.

    Returns
    -------
    Facets
        Vertices stand in the middle of their cell, as high as the mean of those in it. Of equal triangles the one
        with the worst quality stays.

    Examples
    --------
    >>> points = np.array([[0.0, 0, 0], [4, 0, 0], [4, 4, 0], [4.5, 4.5, 0]])
    >>> mark = np.ones(2, np.int32)
    >>> part = Facets(points, np.array([[0, 1, 2], [0, 2, 3]]), mark, mark, np.arange(2), np.zeros(2, np.float32))
    >>> coarse = coarsen(part, 2.0)
    >>> coarse.points.tolist(), coarse.building.tolist()
    ([[1.0, 1.0, 0.0], [5.0, 1.0, 0.0], [5.0, 5.0, 0.0]], [0])
    """
    cell = np.floor(facets.points / size).astype(np.int64)
    low = cell.min(axis=0)
    extent = cell.max(axis=0) - low + 1
    key = ((cell - low) * (1, extent[0], extent[0] * extent[1])).sum(axis=1)
    _, first, row = np.unique(key, return_index=True, return_inverse=True)
    row = row.reshape(-1)
    points: NDArray[np.float64] = ((cell[first] + 0.5) * size).astype(np.float64)
    points[:, 2] = np.bincount(row, facets.points[:, 2]) / np.bincount(row)
    corners = row[facets.corners]
    a, b, c = corners.T
    kept = np.flatnonzero((a != b) & (b != c) & (c != a))
    name = name_facets(corners[kept], len(points))
    order = np.lexsort((facets.quality[kept], facets.marker[kept], name))
    same = (np.diff(name[order]) == 0) & (np.diff(facets.marker[kept][order]) == 0)
    kept = np.sort(kept[order[np.concatenate([[True], ~same])[: len(order)]]])
    used, corners = np.unique(corners[kept], return_inverse=True)
    return Facets(
        points[used],
        corners.reshape(-1, 3),
        facets.marker[kept],
        facets.piece[kept],
        facets.building[kept],
        facets.quality[kept],
    )
