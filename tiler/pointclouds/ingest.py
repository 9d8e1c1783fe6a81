"""Point cloud files read once, and dealt out to the cells of a fixed grid (step 1.1)."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.data.errors import InputError
from pipeline.points_terrain.las_points import KEPT, REASONS, Triple, count_values, judge_points
from tiler.georeference.frame import AS_IT_IS, Frame
from tiler.objects.places import as_place
from tiler.pointclouds.cells import Box, order_by_cell
from tiler.pointclouds.las_chunks import PointChunk, nodes_near, plan_of, read_chunks, take_share
from tiler.pointclouds.las_header import read_las_header

COUNTED = ("read", "outside", "withheld", "noise", "absurd", "kept")
KEY_POINTS = "key points"

# Side of a cell (m). A box of 250 m reads 1.25, 1.54 and 2.14 times its points in cells of 32, 64 and 128 m, in
# 21, 14 and 10 ranges of rows: 64 m is between many small reads and much that is read in vain.
CELL = 64.0
# Points in one cell of a file, 10,000 a square metre: the densest surveys from the air have some 1,000. What
# is read of a store is at least a cell, and a small LAZ file may hold any number of copies of one point.
MOST_POINTS = 40_960_000


@dataclass(frozen=True, eq=False)
class PointBlock:
    """Usable points of a part of a file, sorted by cell."""

    # (n, 3): coordinates in the region's CRS in units of the file, by ascending cell (j, then i); in a cell in the
    # order of the file
    units: NDArray[np.int32]
    # Size of a unit along each axis, and place of unit 0 (m).
    scale: Triple
    offset: Triple
    classification: NDArray[np.uint8]  # (n,): ASPRS class of each point
    cell: NDArray[np.int64]  # (c, 2): cells (i, j) that have points, ascending by j, then i
    start: NDArray[np.int64]  # (c + 1,): the points of cell k are the rows ``start[k]`` to ``start[k + 1]``
    # (k,): classes that occur among all points that were looked at, inside the box or not, usable or not
    classes: NDArray[np.uint8]
    # ``read`` = ``outside`` + ``withheld`` + ``noise`` + ``absurd`` + ``kept``; each point counts once. Where
    # there are any, ``key points`` are those of ``read`` with the class of model key points: ground. Counts add up
    # over the blocks of a file.
    counts: dict[str, int]


def read_cells(
    path: str | Path, bounds: Box, *, size: float = CELL, frame: Frame = AS_IT_IS, share: tuple[int, int] = (0, 1)
) -> Iterator[PointBlock]:
    """Read the usable points of a file within a box, dealt out to cells (step 1.1).

    Parameters
    ----------
    path : str or Path
        LAS, LAZ or COPC file.
    bounds : tuple of 4 floats
        xmin, ymin, xmax, ymax in the region's CRS (m); the borders belong to the box.
    size : float
        Side of a cell (m); cells have their corners at multiples of it.
    frame : Frame
        How coordinates of the file become those of the region.
    share : (int, int)
        Which of how many equal shares of its points, in the order of the file: whole chunks of a LAZ file.

    Yields
    ------
    PointBlock
        One for each million points that are read, also where none of them is kept; at least one a file.

    Raises
    ------
    InputError
        If the file cannot be read or is damaged, see `read_las_header` and `read_chunks`, and if a cell has more
        than `MOST_POINTS`.

    Notes
    -----
    Dropped are, in this order: points outside the box, withheld points, the noise classes 7 and 18, and points
    with a height that is not within ±10 km.

    A COPC file is read by its octree where the box covers less than half of the file: nodes away from the box are
    not read, and their points count as outside. `PointBlock.classes` is then of the nodes that were read. The
    octree's upper nodes, a thinned copy of the whole file, are always among them, so that a class missing there is
    rare in the file.

    Memory is that of one chunk, some 60 bytes a point, whatever the size of the file.
    """
    path = as_place(path)
    header = read_las_header(path)
    nodes = nodes_near(path, header, bounds, frame)
    n_skipped = 0 if nodes is None or share[0] else header.point_count - int(nodes.count.sum())
    total: Counter[tuple[int, int]] = Counter()
    for chunk in read_chunks(path, header, take_share(path, header, nodes, share), frame):
        counts = dict.fromkeys(COUNTED, 0)
        kept = select_usable(chunk, bounds, counts)
        counts["read"] += n_skipped
        counts["outside"] += n_skipped
        n_skipped = 0
        found = order_by_cell(plan_of(chunk).T, float(size), among=kept)
        total.update(dict(zip(map(tuple, found.cell.tolist()), np.diff(found.start).tolist(), strict=True)))
        _check_density(path, total, size)
        units = np.column_stack([chunk.x, chunk.y, chunk.z]).take(found.order, axis=0)
        classes = chunk.classification[found.order]
        there = np.flatnonzero(count_values(chunk.classification)).astype(np.uint8)
        yield PointBlock(units, chunk.scale, chunk.offset, classes, found.cell, found.start, there, counts)


def select_usable(chunk: PointChunk, bounds: Box, counts: dict[str, int]) -> NDArray[np.bool_]:
    """Return the usable points of a chunk in a box (m), bool (n,), and add to the counts of a `PointBlock`."""
    verdict = judge_points(
        chunk.x, chunk.y, chunk.z, chunk.scale, chunk.offset, chunk.classification, chunk.withheld, bounds
    )
    for reason, number in zip(REASONS, count_values(verdict)[: len(REASONS)].tolist(), strict=True):
        counts[reason] += number
    counts["read"] += len(chunk)
    if chunk.n_key_points:
        counts[KEY_POINTS] = counts.get(KEY_POINTS, 0) + chunk.n_key_points
    return np.asarray(verdict == KEPT)


def _check_density(path: Path, total: Counter[tuple[int, int]], size: float) -> None:
    worst = max(total.values(), default=0)
    if worst > MOST_POINTS:
        (i, j), _ = max(total.items(), key=lambda item: item[1])
        raise InputError(
            f"{path}: more than {worst} points in the square of {size:g} m at ({i * size:g}, {j * size:g}), "
            f"at most {MOST_POINTS} are taken; thin the file: pdal translate {path.name} thin.laz sample"
        )
