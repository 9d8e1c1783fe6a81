"""Stage 3.6: a piece of the mesh and of its boundary a tile, quality, parts and seams of the region."""

import hashlib
from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.columns.cell_blocks import CellBlocks, QualityMeter, UsedPoints, number_used
from pipeline.columns.columns import find_used_points, split_boundary
from pipeline.columns.underground import RegionMesh, expand_regions, find_used, split_regions
from pipeline.data.classes import BUILDING, GROUND, WATER
from pipeline.data.errors import GeometryError
from pipeline.data.mesh import ColumnMesh, SeamEdges
from pipeline.points_terrain.canopy import Canopy, densities_at
from pipeline.quality.building_facts import fidelity_table
from pipeline.quality.histograms import (
    QUALITY_BINS,
    Histogram,
    histogram_percentiles,
    merge_histograms,
)
from pipeline.quality.point_fidelity import (
    KINDS,
    FidelitySums,
    conclude_fidelity,
    index_model,
    merge_fidelity,
    sum_fidelity,
)
from pipeline.quality.residuals import HISTOGRAM_LIMITS, ResidualSums
from stitch.pieces.numbering import (
    PartCounts,
    count_all_points,
    count_by_part,
    first_id,
    number_columns,
    tile_part,
)
from stitch.seams.tiles import tile_halo
from stitch.tiling.grid import Key, seams_of_tile
from tiler.citymodels.tables import unpack_polygons
from tiler.config.config import Config
from tiler.engine.run_context import find_owned, seam_name, tile_key, tile_name
from tiler.engine.stage import Facts, Read, Scope, Stage
from tiler.engine.task import Result, Task
from tiler.mesh_files.merged import VERTEX_ID
from tiler.mesh_files.mesh_parts import find_tile_parts, join_tiles, read_tile_parts
from tiler.mesh_files.vtk_files import Rows, Values, write_vtp_blocks, write_vtu_blocks
from tiler.stages.inputs import halo_of_points
from tiler.stages.left_out import read_polygons
from tiler.stages.readers import facts_of_clouds, read_bands, read_buildings, read_terrain
from tiler.store.checksums import FILES, state_files
from tiler.store.results import COLUMN_ARRAYS, unpack_columns
from tiler.store.run_folder import LEAVES, PATCH_OF_GROUND, REGION, ROOF_MOVED

CANOPY = "leaves"  # stage that has the leaves around a tile in columns
EDGE_ARRAYS = ("edge", "edge_bottom", "edge_building", "edge_missing", "edge_seam")
ID_ARRAYS = ("shared", "shared_id")
FIT_CLASSES = (BUILDING, GROUND, WATER)


def fit_stage(config: Config) -> Stage:
    """Stage that holds the points against the city model: with a pad, that of the tiles of the region alone."""
    reads = (
        Read("points", halo_of_points(config, 0.0)),
        Read("terrain", 2 * config.dtm_spacing),
        Read("model", by_extent=True, within=True),
        Read("outlines", own=True),
    )
    parameters = ("dtm_spacing", "ground_filter")
    return Stage("fit", Scope.TILE, measure_fit, reads, parameters, version=2, after="alignment")


def piece_stages(config: Config) -> list[Stage]:
    """Stages from columns to files; the last reads the fit, too."""
    # A tile reaches beyond its box as far as its seams may.
    reach = tile_halo(config.tile_size_or_default, config.largest_size) if config.has_trees else 0.0
    leaves = (Read(CANOPY, reach),) if config.has_trees else ()
    of_leaves = ("leaf_column",) if config.has_trees else ()
    beside = (Read("columns", beside=True, others_by_name=True, optional=True),)
    return [
        # Of the tiles around it a piece asks only which of them there are.
        Stage("pieces", Scope.TILE, write_piece, (*beside, *leaves), of_leaves, version=7),
        Stage(
            "report", Scope.REGION, sum_up, (Read("pieces", optional=True), Read("fit", optional=True)), version=4
        ),
    ]


def write_piece(task: Task) -> Facts:
    """Write a tile's cells and its boundary as files, and measure the cells as they pass by (step 3.6)."""
    key = tile_key(task.name)
    arrays, attributes = task.store.read("columns", task.name, names=(*COLUMN_ARRAYS, *EDGE_ARRAYS, *ID_ARRAYS))
    mesh, numbers = unpack_columns(arrays, attributes["facts"]["order"])
    edges = SeamEdges(
        arrays["edge"],
        arrays["edge_bottom"],
        arrays["edge_building"],
        arrays["edge_missing"] | ~_there(task, key)[arrays["edge_seam"]],
    )
    # A column of a seam has levels that only the tile beyond uses, below a roof whose wall is the seam.
    region: dict[str, NDArray[np.int8]] = {}
    soil, solids = (name in attributes["facts"] for name in ("soil", "solids"))
    if soil or solids:
        top = np.zeros(len(mesh.plane.xy), np.int32)
        if soil:
            top = task.store.read("columns", task.name, names=("soil",))[0]["soil"]
        whole = RegionMesh(mesh, top, solids)
        used = find_used(whole)
        cells, region[REGION] = expand_regions(whole)
        boundary, shared = split_regions(whole, numbers, task.context.bounds, edges)
    else:
        used = find_used_points(mesh)
        cells = CellBlocks([(mesh, None)])
        boundary, shared = split_boundary(mesh, numbers, task.context.bounds, edges)
    seams = _digest_seams(mesh, shared, arrays["edge"], arrays["edge_seam"], key)
    there = ~edges.missing
    parts, found = find_tile_parts(mesh, arrays["edge"][there], arrays["edge_seam"][there])
    if found:
        task.put(**found)
    points, meter = UsedPoints(mesh, used), QualityMeter()
    counted = count_by_part(mesh, used, arrays["shared"], arrays["shared_id"])
    task.put(part=counted.part, part_levels=counted.levels, unused=counted.unused)
    lowest = number_columns(mesh, arrays["shared"], arrays["shared_id"], first_id(tile_part(key)))

    def make_ids(levels: NDArray[np.int64]) -> NDArray[np.int64]:
        column = points.column[levels]
        return lowest[column] + (levels - mesh.z_start[column])

    leaves = _leaf_rows(task, cells, points) if CANOPY in task.refs else {}
    places, ids = Values(3, np.dtype(np.float64), points.place), Values(1, np.dtype(np.int64), make_ids)
    vertex = Values(1, np.dtype(np.int64), points.numbers)
    with task.step("3.6 write pieces"), task.output() as out:
        files = out / "mesh" / f"{task.name}.vtu", out / "boundary" / f"{task.name}.vtp"
        write_vtu_blocks(
            files[0],
            places.rows(points.n_points, points.levels),
            _measured_rows(task, cells, points, number_used(used), meter),
            point_data={VERTEX_ID: ids.rows(points.n_points, points.levels)},
            cell_data={name: Rows.of(array) for name, array in region.items()} | leaves,
        )
        of_facets: dict[str, NDArray[np.int8]] = {}
        if PATCH_OF_GROUND in attributes["facts"]:
            of_facets[PATCH_OF_GROUND] = _mark_ground(task, mesh, len(boundary.facets))
        data = {"vertex": vertex, VERTEX_ID: ids}
        if (moved := mesh.moved) is not None:
            data[ROOF_MOVED] = Values(1, np.dtype(np.float64), lambda levels: moved[levels])
        write_vtp_blocks(files[1], len(mesh.z), boundary, places, point_data=data, cell_data=of_facets)
        written = state_files(out, files)
    for name, histogram in meter.histograms.items():
        task.put(**{name: histogram.counts, f"{name}_range": _range(histogram)})
    return {
        "counts": {"cells": cells.n_cells, "facets": len(boundary.facets), "seam faces": len(shared)},
        "points": counted.own,
        "seams": seams,
        "parts": parts,
        FILES: written,
    }


def _mark_ground(task: Task, mesh: ColumnMesh, n_facets: int) -> NDArray[np.int8]:
    """Give the patch of the ground of each facet, -1 elsewhere: the first ones are what stands under triangles."""
    patch = task.store.read("columns", task.name, names=(PATCH_OF_GROUND,))[0][PATCH_OF_GROUND]
    marks = np.full(n_facets, -1, np.int8)
    marks[: len(patch)] = np.where(mesh.plane.building < 0, patch, -1)
    return marks


def _measured_rows(
    task: Task, cells: CellBlocks, points: UsedPoints, number: NDArray[np.int32], meter: QualityMeter
) -> Rows:
    """Make cells as they are written, of numbers of points, and measure them as they pass by."""

    def make(begin: int, end: int) -> NDArray[np.int32]:
        made = cells.make(begin, end)
        with task.step("3.6 measure cells"):
            meter.take(points.place(made.ravel()))
        return number[made]

    return Rows(cells.n_cells, 4, np.dtype(np.int32), make)


def _leaf_rows(task: Task, cells: CellBlocks, points: UsedPoints) -> dict[str, Rows]:
    """Make the leaf area density of cells as they are written: that at the middle of each."""
    size = task.parameters.leaf_column
    canopies = [make_canopy(result.arrays, result.facts, size) for result in task.read(CANOPY)]

    def make(begin: int, end: int) -> NDArray[np.float32]:
        corners = points.place(cells.make(begin, end).ravel()).reshape(-1, 4, 3)
        return densities_at(canopies, (corners[:, 0] + corners[:, 1] + corners[:, 2] + corners[:, 3]) / 4)

    return {LEAVES: Rows(cells.n_cells, 1, np.dtype(np.float32), make)}


def make_canopy(arrays: Mapping[str, NDArray[Any]], facts: Facts, size: float) -> Canopy:
    """Make a canopy of what its stage has; `size` is the side of its columns (m)."""
    return Canopy(arrays["base"], arrays["top"], arrays["density"], facts["i0"], facts["j0"], size)


def prove_seams(sides: Iterable[tuple[str, str, Facts]]) -> Facts:
    """Prove that both tiles of each seam have the same faces on it, bit for bit.

    Parameters
    ----------
    sides : iterable of (str, str, dict)
        A tile, a seam, and number and hash of the faces that the tile has on it.

    Returns
    -------
    dict
        ``seams`` and ``seam faces`` that two tiles share.

    Raises
    ------
    GeometryError
        If two tiles have other faces on their seam.

    Examples
    --------
    >>> here, there = ("0_0", "x1_0", {"faces": 2, "hash": "a"}), ("1_0", "x1_0", {"faces": 2, "hash": "a"})
    >>> prove_seams([here, there, ("1_0", "x2_0", {"faces": 3, "hash": "b"})])
    {'seams': 1, 'seam faces': 2}
    """
    waiting: dict[str, tuple[str, Facts]] = {}
    counts = {"seams": 0, "seam faces": 0}
    for tile, seam, found in sides:
        if seam not in waiting:
            waiting[seam] = tile, found
            continue
        other, first = waiting.pop(seam)
        if first != found:
            raise GeometryError(
                f"seam {seam}: tiles {other} and {tile} have different faces on it: {first} and {found}; "
                "this is a fault of citystitch"
            )
        counts["seams"] += 1
        counts["seam faces"] += found["faces"]
    return counts


def measure_fit(task: Task) -> Facts:
    """Measure how far the points of a tile are from the city model (step 2.4), a band of points at a time."""
    given, bounds = task.parameters, task.context.bounds
    dtm = read_terrain(task, task.box, spacing=given.dtm_spacing, bounds=bounds)
    buildings = read_buildings(task, task.box)
    (found,) = task.read("outlines", ("outline", "outline_start"))
    outlines = unpack_polygons(found.arrays, "outline")
    footprints, _ = read_polygons(outlines, np.arange(len(outlines)))
    model = index_model(buildings.model.polygons, buildings.model.roofs, footprints=footprints, box=task.box)
    parts, n_building = [], 0
    for cloud in read_bands(task, task.box, classes=FIT_CLASSES, ground_filter=given.ground_filter):
        mine = find_owned(task.box, bounds, cloud.xyz[:, :2])
        parts.append(sum_fidelity(cloud, dtm, model, building_class=True, among=mine))
        n_building += int((mine & (cloud.classification == BUILDING)).sum())
    sums = merge_fidelity(parts)
    facts = {}
    for kind in KINDS:
        residual: ResidualSums = getattr(sums, kind)
        facts[kind] = {"n": residual.n, "total": residual.total, "squares": str(residual.squares)}
        task.put(**{kind: residual.absolute.counts, f"{kind}_range": _range(residual.absolute)})
    in_mesh, bare = sums.roof.n, sums.missed.n
    # Where a file marks no buildings, what lies beside all footprints may be anything.
    marked = all(facts["marks_buildings"] for facts in facts_of_clouds(task).values())
    stray = max(n_building - in_mesh - bare, 0) if marked else 0
    return {"fit": facts, "building_points": {"in_mesh": in_mesh, "bare": bare, "stray": stray}}


def sum_up(task: Task) -> Facts:
    """Add up quality, fit and points over the region, join the parts of tiles, and prove the seams (step 3.6)."""
    quality: dict[str, Histogram] = {}
    tiles, points, sides = [], [], []
    for result in task.read("pieces"):
        sides += [(result.name, seam, found) for seam, found in result.facts["seams"].items()]
        arrays = result.arrays
        points.append(PartCounts(result.facts["points"], arrays["part"], arrays["part_levels"], arrays["unused"]))
        faces = {seam: found["faces"] for seam, found in result.facts["seams"].items()}
        names = [seam_name(seam) for seam in seams_of_tile(tile_key(result.name))]
        tiles.append(read_tile_parts(result.name, result.facts["parts"], faces, result.arrays, names))
        for name, (limits, _) in QUALITY_BINS.items():
            part = _histogram(result.arrays, name, limits)
            quality[name] = merge_histograms([quality[name], part]) if name in quality else part
    total: FidelitySums | None = None
    building_points: Counter[str] = Counter()
    for result in task.read("fit"):
        building_points.update(result.facts["building_points"])
        sums = FidelitySums(**{kind: _residuals(result, kind) for kind in KINDS})
        total = merge_fidelity([total, sums]) if total is not None else sums
    facts: Facts = {"quality": histogram_percentiles(quality), "building_points": dict(building_points)}
    facts |= {"parts": join_tiles(tiles), "points": count_all_points(points), "counts": prove_seams(sides)}
    return facts | {"fidelity": fidelity_table(conclude_fidelity(total)) if total is not None else {}}


def _range(histogram: Histogram) -> NDArray[np.float64]:
    return np.array([histogram.minimum, histogram.maximum])


def _histogram(arrays: dict[str, NDArray[Any]], name: str, limits: tuple[float, float]) -> Histogram:
    low, high = arrays[f"{name}_range"].tolist()
    return Histogram(*limits, arrays[name], low, high)


def _residuals(result: Result, kind: str) -> ResidualSums:
    facts = result.facts["fit"][kind]
    absolute = _histogram(result.arrays, kind, HISTOGRAM_LIMITS)
    return ResidualSums(facts["n"], facts["total"], int(facts["squares"]), absolute)


def _there(task: Task, key: Key) -> NDArray[np.bool_]:
    """Return beyond which sides of a tile there is another one: south, east, north, west."""
    around = set(task.refs["columns"])
    i, j = key
    return np.array(
        [tile_name(tile) in around for tile in (Key(i, j - 1), Key(i + 1, j), Key(i, j + 1), Key(i - 1, j))]
    )


def _digest_seams(
    mesh: ColumnMesh,
    shared: NDArray[np.int32],
    edge: NDArray[np.int32],
    edge_seam: NDArray[np.int32],
    key: Key,
) -> Facts:
    """Number and hash of the faces that a tile has on each of its seams, whatever their order and orientation."""
    column = np.searchsorted(mesh.z_start, shared, side="right") - 1
    n = len(mesh.plane.xy)
    code = column.min(axis=1) * n + column.max(axis=1)
    wanted = edge[:, 0].astype(np.int64) * n + edge[:, 1]
    order = np.argsort(wanted)
    side = edge_seam[order[np.searchsorted(wanted, code, sorter=order)]]
    found = {}
    for k, seam in enumerate(seams_of_tile(key)):
        here = side == k
        if here.any():
            corners = np.dstack((mesh.plane.xy[column[here]], mesh.z[shared[here]]))
            found[seam_name(seam)] = {"faces": len(corners), "hash": _hash_faces(corners)}
    return found


def _hash_faces(corners: NDArray[np.float64]) -> str:
    """Hash faces (f, 3, 3) by their coordinates: their corners sorted, then they themselves."""
    rows = corners.reshape(-1, 3)
    face = np.repeat(np.arange(len(corners)), 3)
    flat = rows[np.lexsort((rows[:, 2], rows[:, 1], rows[:, 0], face))].reshape(-1, 9)
    return hashlib.blake2b(flat[np.lexsort(flat.T[::-1])].tobytes(), digest_size=16).hexdigest()
