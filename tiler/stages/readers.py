"""What stages read of each other's results: points, terrain, houses and buildings in a box."""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.data.citymodel import Footprints
from pipeline.data.classes import BUILDING, NEVER_ROOF
from pipeline.data.notes import Note
from pipeline.data.pointcloud import PointCloud
from pipeline.geometry.inside import Cover, are_covered
from pipeline.points_terrain.ground_filter import FILTER_REACH, classify_above, find_terrain
from pipeline.points_terrain.las_points import LEFT_OUT, Triple, UnitPoints, cut_units
from pipeline.points_terrain.raster import (
    Dtm,
    NodeWindow,
    grow_window,
    join_dtm,
    node_window,
)
from pipeline.points_terrain.terrain import cut_terrain, join_terrain
from stitch.tiling.grid import Bounds
from tiler.citymodels.tables import NEAR_ARRAYS, NearBuildings, join_near, take_near, unpack_polygons
from tiler.engine.run_context import find_owned
from tiler.engine.stage import Box, Facts, whole_file
from tiler.engine.task import Task
from tiler.footprints.footprint_index import FootprintBlock, FootprintRows, join_footprints
from tiler.pointclouds.cells import ranges_near, select_cells
from tiler.pointclouds.ingest import CELL
from tiler.store.result_file import CHUNK_BYTES

CHUNK_ROWS = CHUNK_BYTES // 12  # of coordinates in the store, three units of 4 bytes each
BAND = CHUNK_ROWS  # rows of points that are read at a time, 0.35 million
CLASSES = 256  # that a point may have

Ranges = list[tuple[int, int]]  # first row and the one behind the last, ascending and apart from each other


def grow(box: Box, by: float) -> Box:
    """Grow a box on all sides (m)."""
    return box[0] - by, box[1] - by, box[2] + by, box[3] + by


def clip(box: Box, bounds: Box) -> Box:
    """Cut a box to another one."""
    return max(box[0], bounds[0]), max(box[1], bounds[1]), min(box[2], bounds[2]), min(box[3], bounds[3])


def extent_of(polygons: NDArray[np.object_]) -> Box | None:
    """Box of polygons (m); None without any."""
    if len(polygons) == 0:
        return None
    xmin, ymin, xmax, ymax = shapely.total_bounds(polygons).tolist()
    return xmin, ymin, xmax, ymax


def hull(one: Box, other: Box | None) -> Box:
    """Box around two boxes; the first where there is no other one."""
    if other is None:
        return one
    return min(one[0], other[0]), min(one[1], other[1]), max(one[2], other[2]), max(one[3], other[3])


def read_cloud(
    task: Task,
    box: Box,
    *,
    classes: Sequence[int] | None = None,
    ground_filter: bool = False,
    cover: Cover | None = None,
) -> PointCloud:
    """Read the points of some classes within a box, from the stage ``points``.

    Parameters
    ----------
    task, box, classes, ground_filter, cover
        As for `read_bands`.

    Returns
    -------
    PointCloud
        As from `read_bands`, in one; memory is 25 bytes for each point that is kept, and a band.
    """
    xyz, found = np.empty((0, 3)), np.empty(0, np.uint8)
    for band in read_bands(task, box, classes=classes, ground_filter=ground_filter, cover=cover):
        _extend(xyz, band.xyz)
        _extend(found, band.classification)
    return PointCloud(xyz, found)


def _extend(array: NDArray[Any], rows: NDArray[Any]) -> None:
    """Add rows to an array in its place: the system moves pages where it can, and nothing is there twice."""
    n = len(array)
    array.resize((n + len(rows), *array.shape[1:]), refcheck=False)
    array[n:] = rows


def read_bands(
    task: Task,
    box: Box,
    *,
    classes: Sequence[int] | None = None,
    ground_filter: bool = False,
    cover: Cover | None = None,
) -> Iterator[PointCloud]:
    """Read the points of some classes within a box in bands, one after the other, from the stage ``points``.

    Parameters
    ----------
    task : Task
        A task that reads that stage.
    box : (xmin, ymin, xmax, ymax)
        Box (m); its borders belong to it.
    classes : sequence of int, optional
        ASPRS classes that are wanted; all by default.
    ground_filter : bool
        Find ground by our own filter.
    cover : Cover, optional
        Cells to which points are cut; by default none, all of the box are read.

    Yields
    ------
    PointCloud
        At least one. Points that may lie on a roof have class 6: in a file that marks no building at all, these
        are all that are not ground, water, vegetation or noise.

    Notes
    -----
    A band is `BAND` rows of the files at most, in the order of files and rows: it depends on the files and the box
    alone. Memory is 45 bytes for each of them and a chunk of the store, some 50 MB, however many points the box
    has. The ground filter reads all points within its reach a first time, and keeps the surface: 40 bytes a square
    metre.
    """
    if not ground_filter:
        for files in _cut_bands(_find_files(task, box)):
            become = [_reclassify(classes, file.marks_buildings) for file in files]
            yield _read_files(task, files, box, become, cover)[0]
        return
    wide = clip(grow(box, FILTER_REACH), task.context.bounds)
    terrain = find_terrain((cloud for cloud, _ in _read_all(task, wide)), wide)
    for cloud, marked in _read_all(task, clip(box, wide)):
        found = classify_above(cloud, terrain, wide).classification
        new = np.where(marked, _reclassify(classes, True)[found], _reclassify(classes, False)[found])
        kept = new != LEFT_OUT
        if cover is not None:
            kept &= are_covered(cover, cloud.xyz)
        yield PointCloud(cloud.xyz[kept], new[kept].astype(np.uint8))


def read_units(task: Task, box: Box) -> Iterator[UnitPoints]:
    """Read the points of a box's cells in bands, as files have them, from the stage ``points``.

    Bands are those of `read_bands`, file by file. Points of these cells that lie outside the box are among them.
    """
    for files in _cut_bands(_find_files(task, box)):
        for file in files:
            yield _read_units(task, file)


def read_units_of(task: Task, name: str, box: Box) -> Iterator[UnitPoints]:
    """Read the points of a box's cells of one file of the stage ``points``, as `read_units`."""
    facts = task.store.attributes("points", name)["facts"]
    for files in _cut_bands([] if facts["unreadable"] else [_find_rows(task, name, facts, box)]):
        for file in files:
            yield _read_units(task, file)


def _read_all(task: Task, box: Box) -> Iterator[tuple[PointCloud, NDArray[np.bool_]]]:
    """Read the points of all classes within a box, as files have them; and whether their file marks buildings."""
    for files in _cut_bands(_find_files(task, box)):
        cloud, count = _read_files(task, files, box, [np.arange(CLASSES, dtype=np.int16)] * len(files))
        yield cloud, np.repeat(np.array([file.marks_buildings for file in files], np.bool_), count)


def read_terrain(task: Task, box: Box, *, spacing: float, bounds: Bounds) -> Dtm:
    """Read the terrain of a box within the region, from the stage ``terrain``.

    Nodes of tiles that are absent are filled from those in the box: tasks with other boxes see others there.
    """
    window = region_window(box, spacing, bounds)
    return cut_terrain(read_known_terrain(task, box, spacing=spacing, bounds=bounds), window)


def read_known_terrain(task: Task, box: Box, *, spacing: float, bounds: Bounds) -> Dtm:
    """Read the terrain of a box within the region, NaN at nodes of tiles that are absent (see `cut_terrain`).

    Where the task reads the stage ``approach``, it is that of region and pad; ``levelled`` has level water.
    """
    stage = next(name for name in ("levelled", "approach", "terrain") if name in task.refs)
    window = region_window(box, spacing, bounds)
    return join_terrain(_read_rasters(task, stage, window), window)


def join_rasters(task: Task, stage: str, window: NodeWindow, spacing: float) -> Dtm:
    """Read the nodes of a window from the rasters of a stage; NaN where none has them, there may be no raster."""
    parts = _read_rasters(task, stage, window)
    if not parts:
        return Dtm(np.full((window.ny, window.nx), np.nan), window.i0, window.j0, spacing)
    return join_dtm(parts, window)


def _read_rasters(task: Task, stage: str, window: NodeWindow) -> list[Dtm]:
    """Read what the rasters of a stage have of a window, each that has any."""
    parts = []
    for result in task.read(stage, ()):
        i0, j0, nx, ny, spacing = (result.facts[name] for name in ("i0", "j0", "nx", "ny", "spacing"))
        common = grow_window(NodeWindow(i0, j0, nx, ny), 0, within=window)
        if common.nx and common.ny:
            rows, columns = common.j0 - j0, common.i0 - i0
            z = task.read_window(stage, result.name, "z", (rows, rows + common.ny), (columns, columns + common.nx))
            parts.append(Dtm(z, common.i0, common.j0, spacing))
    return parts


def region_window(box: Box, spacing: float, bounds: Bounds) -> NodeWindow:
    """Nodes of a box, and the next ones around it, within the region."""
    return grow_window(node_window(box, spacing), 0, within=node_window(bounds, spacing))


def read_outlines(
    task: Task, box: Box | None = None, *, stage: str = "footprints", shift: tuple[float, float] = (0.0, 0.0)
) -> Footprints:
    """Read the footprints that meet a box, by default the task's, from a stage: the rows of its cells alone.

    They are moved by a shift (m) before.
    """
    xmin, ymin, xmax, ymax = box or task.box
    if any(shift):
        found = read_rows(task, (xmin - shift[0], ymin - shift[1], xmax - shift[0], ymax - shift[1]), stage=stage)
        return replace(found, polygons=shapely.transform(found.polygons, lambda xy: xy + shift))
    return read_rows(task, (xmin, ymin, xmax, ymax), stage=stage)


def read_own_outlines(task: Task) -> Footprints:
    """Take the footprints that meet a tile, from the stage ``outlines`` for the same tile."""
    (found,) = (result.arrays for result in task.read("outlines"))
    return Footprints(unpack_polygons(found, "outline"), found["ids"], found["given_height"], found["forms"])


def read_rows(task: Task, box: Box, *, stage: str = "footprints") -> Footprints:
    """Read the polygons that meet a box, from a stage of the region that has them as `put_rows` does."""
    (found,) = task.read(stage, ())
    if found.facts["n"] == 0:
        return join_footprints([], box)
    arrays, _ = task.store.read(stage, found.name, names=("cell_box", "cell_start", "end"))
    ranges = ranges_near(arrays["cell_box"], np.append(arrays["cell_start"], arrays["end"]), box)

    def read(ranges: Ranges, *names: str) -> dict[str, NDArray[Any]]:
        return task.read_ranges(stage, found.name, names, ranges)

    # A row begins where the one before it ends.
    ends = read([(max(first - 1, 0), last) for first, last in ranges], "wkb_end", "id_end")
    wkb_ranges, byte = _cut_ranges(ends["wkb_end"], ranges)
    id_ranges, letter = _cut_ranges(ends["id_end"], ranges)
    wkb, text = read(wkb_ranges, "wkb")["wkb"], read(id_ranges, "id")["id"].tobytes()
    ids = np.array([text[first:last].decode() for first, last in pairwise(letter.tolist())], np.str_)
    rest = read(ranges, "given_height", "forms", "box")
    return join_footprints([FootprintRows(wkb, byte, ids, rest["given_height"], rest["forms"], rest["box"])], box)


def _cut_ranges(ends: NDArray[np.int64], ranges: Ranges) -> tuple[Ranges, NDArray[np.int64]]:
    """Where ranges of rows are in an array that has one row behind the other, and where each begins in them.

    Parameters
    ----------
    ends : int64
        Where rows end in that array: those of the ranges, and the one before each but for the first of all.
    ranges : list of (first, last)
        Rows.

    Examples
    --------
    >>> _cut_ranges(np.array([2, 3, 7, 9, 12]), [(0, 2), (4, 6)])
    ([(0, 3), (7, 12)], array([0, 2, 3, 5, 8]))
    """
    spans, sizes, row = list[tuple[int, int]](), [np.zeros(1, np.int64)], 0
    for first, last in ranges:
        count = last - first + (first > 0)
        found = ends[row : row + count] if first else np.append(0, ends[:count])
        row += count
        spans.append((int(found[0]), int(found[-1])))
        sizes.append(np.diff(found))
    return spans, np.cumsum(np.concatenate(sizes))


def put_rows(task: Task, found: Iterable[FootprintBlock], source: str, empty: str = "terrain only") -> Facts:
    """Write footprints or other polygons one behind the other.

    A note says what it means that there is none, unless `source` is empty.
    """
    n = first = n_bytes = n_letters = 0
    blocks, part_like = [0], set[str]()
    for block in found:
        task.notes(block.notes)
        rows = block.rows
        names = [name.encode() for name in rows.ids.tolist()]
        letters = np.frombuffer(b"".join(names), np.uint8)
        # Where rows end in the whole: a tile finds its own without those before them.
        task.append(
            wkb=rows.wkb,
            wkb_end=n_bytes + rows.wkb_start[1:] - rows.wkb_start[0],
            id=letters,
            id_end=n_letters + np.cumsum([len(name) for name in names], dtype=np.int64),
            given_height=rows.given_height,
            forms=rows.forms,
            box=rows.box.reshape(-1, 4),
            cell_box=block.cell_box.reshape(-1, 4),
            cell_start=block.start[:-1] + n,
        )
        n, n_bytes, n_letters = n + len(rows), n_bytes + len(rows.wkb), n_letters + len(letters)
        first += len(block.cell)
        blocks.append(first)
        part_like |= {name for name in rows.ids.tolist() if "-part" in name}
    if n == 0 and source:
        task.note(Note("no-footprints-in-region", source, detail=empty))
    task.put(block=np.array(blocks), end=np.array([n]))
    return {"n": n, "part_like": sorted(part_like)}


def own_notes(task: Task, notes: Sequence[Note]) -> list[Note]:
    """Take the notes whose place is the tile's."""
    places = np.array([(note.x, note.y) for note in notes]).reshape(-1, 2)
    mine = find_owned(task.box, task.context.bounds, places)
    return [note for note, own in zip(notes, mine.tolist(), strict=True) if own]


def read_buildings(task: Task, box: Box) -> NearBuildings:
    """Read the buildings of the simplified city model that meet a box, by ascending id.

    Their layers are those of the stage ``layers``, where the task reads it.
    """
    here = shapely.box(*box)
    shapely.prepare(here)
    later = task.read("layers") if "layers" in task.refs else iter(())
    layers = {result.name: result.arrays["layers"] for result in later}
    return join_near(
        [take_near(result.arrays, here, layers.get(result.name)) for result in task.read("model", NEAR_ARRAYS)]
    )


@dataclass(frozen=True, eq=False)
class _FileRows:
    """Rows of a file to read, as ranges, and what it says of their units and classes."""

    name: str
    ranges: Ranges
    scale: Triple
    offset: Triple
    marks_buildings: bool


def _find_files(task: Task, box: Box) -> list[_FileRows]:
    """Find the rows to read of all files."""
    shares = _read_facts(task)
    files = join_shares(shares)
    return [
        replace(_find_rows(task, name, facts, box), marks_buildings=files[whole_file(name)]["marks_buildings"])
        for name, facts in shares.items()
        if not files[whole_file(name)]["unreadable"]
    ]


def facts_of_clouds(task: Task) -> dict[str, Facts]:
    """Give the facts of the files of the stage ``points`` that a task reads, as `join_shares`."""
    return join_shares(_read_facts(task))


def _read_facts(task: Task) -> dict[str, Facts]:
    return {name: task.store.attributes("points", name)["facts"] for name in task.refs["points"]}


def join_shares(facts: Mapping[str, Facts]) -> dict[str, Facts]:
    """Join the facts of shares of a file, by the name of the file.

    It marks buildings where one share does, and cannot be read where one cannot: it has no points then.

    Examples
    --------
    >>> one = {"counts": {"read": 2}, "marks_buildings": False, "unreadable": None}
    >>> join_shares({"a.0": one, "a.1": one | {"marks_buildings": True}})
    {'a': {'counts': {'read': 4}, 'marks_buildings': True, 'unreadable': None}}
    """
    files: dict[str, Facts] = {}
    for name, share in facts.items():
        whole = files.setdefault(whole_file(name), share)
        if whole is not share:
            unreadable = whole["unreadable"] or share["unreadable"]
            counts = Counter[str](whole["counts"])
            counts.update(share["counts"])
            files[whole_file(name)] = {
                "counts": {} if unreadable else dict(counts),
                "marks_buildings": whole["marks_buildings"] or share["marks_buildings"],
                "unreadable": unreadable,
            }
    return files


def _cut_bands(files: Sequence[_FileRows]) -> Iterator[list[_FileRows]]:
    """Part rows of files into bands of at most `BAND` rows; at least one, which may be empty.

    A range is cut between chunks of the store, so that no chunk is read for two bands.
    """
    band: list[_FileRows] = []
    room = BAND
    for file in files:
        ranges: Ranges = []
        for begin, stop in file.ranges:
            first = begin
            while stop - first > room:
                cut = max((first + room) // CHUNK_ROWS * CHUNK_ROWS, first)
                ranges += [(first, cut)] if cut > first else []
                yield [*band, replace(file, ranges=ranges)] if ranges else band
                first, band, ranges, room = cut, [], [], BAND
            ranges.append((first, stop))
            room -= stop - first
        band += [replace(file, ranges=ranges)] if ranges else []
    yield band


def _find_rows(task: Task, name: str, facts: Facts, box: Box) -> _FileRows:
    """Find the rows of a file in cells that meet a box."""
    arrays, _ = task.store.read("points", name, names=("cell", "cell_row", "block", "end"))
    ranges = _ranges_of_blocks(arrays["cell"], np.append(arrays["cell_row"], arrays["end"]), arrays["block"], box)
    return _FileRows(name, ranges, tuple(facts["scale"]), tuple(facts["offset"]), facts["marks_buildings"])


def _reclassify(classes: Sequence[int] | None, marked: bool) -> NDArray[np.int16]:
    """Class that each class becomes in a file that marks buildings, or not; `LEFT_OUT` for unwanted ones."""
    become = np.arange(CLASSES, dtype=np.int16)
    if not marked:
        become[~np.isin(become, NEVER_ROOF)] = BUILDING
    if classes is not None:
        become[~np.isin(become, classes)] = LEFT_OUT
    return become


def _read_files(
    task: Task,
    files: Sequence[_FileRows],
    box: Box,
    become: Sequence[NDArray[np.int16]],
    cover: Cover | None = None,
) -> tuple[PointCloud, list[int]]:
    """Read points of files, cropped to a box and a cover, one file after the other; also their number in each."""
    room = sum(stop - first for file in files for first, stop in file.ranges)
    xyz, classes = np.empty((room, 3)), np.empty(room, np.uint8)
    count: list[int] = []
    cells = None if cover is None else (cover.i0, cover.j0, cover.marked)
    for file, table in zip(files, become, strict=True):
        found, n = _read_units(task, file), sum(count)
        rows = found.units, found.classification, found.scale, found.offset
        count.append(cut_units(*rows, box, table, cells, xyz[n:], classes[n:]))
    return PointCloud(xyz[: sum(count)], classes[: sum(count)]), count


def _read_units(task: Task, file: _FileRows) -> UnitPoints:
    rows = task.read_ranges("points", file.name, ("units", "classification"), file.ranges)
    return UnitPoints(rows["units"], file.scale, file.offset, rows["classification"])


def _ranges_of_blocks(
    cell: NDArray[np.int64], row: NDArray[np.int64], block: NDArray[np.int64], box: Box
) -> Ranges:
    """Ranges of rows to read, ascending."""
    blocks = pairwise(block.tolist())
    return [
        found
        for first, last in blocks
        for found in select_cells(cell[first:last], row[first : last + 1], box, size=CELL)
    ]
