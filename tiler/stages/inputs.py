"""Stages 1.1 to 1.3: points of each file, footprints, and the terrain of each tile."""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pyproj
import shapely
from numpy.typing import NDArray

from pipeline.data.citymodel import Footprints, number_ids, take_footprints
from pipeline.data.classes import GROUND, KEY_POINT, WATER
from pipeline.data.errors import InputError
from pipeline.data.pointcloud import rename_classes
from pipeline.data.roof_forms import N_COLUMNS
from pipeline.points_terrain.alignment import REACH
from pipeline.points_terrain.ground_check import LEAST_STEP, compare_ground, is_upside_down
from pipeline.points_terrain.raster import Dtm, NodeWindow, grow_window, node_window
from pipeline.points_terrain.terrain import bin_nodes, bin_units
from pipeline.points_terrain.terrain_fill import (
    FILL_RINGS,
    CoarseSums,
    FloodedDtm,
    coarse_around,
    coarse_terrain,
    coarsen,
    count_coarse,
    fill_terrain,
    flood_terrain,
    merge_coarse,
)
from stitch.tiling.grid import Key, has_tile
from tiler.cityinput.rasters import REACH as RASTER_REACH
from tiler.cityinput.sources import CLOUD, MODEL, kind_of
from tiler.citymodels.tables import pack_polygons, unpack_polygons
from tiler.config.config import Config
from tiler.engine.run_context import tile_key
from tiler.engine.stage import Box, Facts, Read, Scope, Stage, boxes_touch
from tiler.engine.task import Task
from tiler.footprints.footprint_index import FootprintBlock, block_footprints, scan_footprints
from tiler.footprints.footprint_source import open_source
from tiler.footprints.model_places import ModelPlaces, give_way
from tiler.georeference.frame import Frame
from tiler.objects.places import is_url, place
from tiler.pointclouds.ingest import CELL, KEY_POINTS, read_cells
from tiler.stages.blocks import BLOCK_ROWS, block_stages, replace_by_blocks
from tiler.stages.city_files import (
    MODEL_PARAMETERS,
    UPLOADED,
    list_kind,
    pack_uploads,
    read_model_bands,
    read_model_file,
    read_terrain_file,
    sample_rasters,
)
from tiler.stages.readers import (
    clip,
    extent_of,
    grow,
    hull,
    join_rasters,
    own_notes,
    put_rows,
    read_bands,
    read_outlines,
    read_units,
)
from tiler.store.edit_journal import Edits, Outline

MODEL_OUTLINES = "model-outlines"  # stage of the buildings of city models, where there are footprints, too
EDITED = "edits"  # stage of what edits changed in a tile, for these tiles alone


def input_stages(config: Config, *, edited: bool = False) -> list[Stage]:
    """Stages from the files to the coarse level of the terrain; `edited`: the run folder has edits."""
    spacing = config.dtm_spacing
    ground: tuple[str, ...] = ("dtm_spacing", "ground_filter")
    of_models = MODEL_PARAMETERS if config.buildings else ()
    around = halo_of_points(config, spacing)
    if config.terrain:
        ground, around = (*ground, "terrain_given"), max(around, RASTER_REACH)
    both = bool(config.buildings and config.footprints)
    blocks = block_stages(config)
    outlines = (
        Read("footprints"),
        *([Read(MODEL_OUTLINES)] if both else []),
        *(Read(stage.name) for stage in blocks),
    )
    edits = (Read(EDITED, own=True, optional=True, silent=True),) if edited else ()
    return [
        *blocks,
        Stage(
            "points",
            Scope.FILE,
            read_point_file,
            parameters=("skip_unreadable", "building_classes", "ground_filter", *of_models),
            version=4,
        ),
        *([Stage(MODEL_OUTLINES, Scope.REGION, read_models_beside, (Read("points"),))] if both else []),
        Stage("footprints", Scope.REGION, read_model_footprints, (Read("points"),))
        if config.buildings and not both
        else Stage(
            "footprints",
            Scope.REGION,
            read_footprint_file,
            parameters=(
                *("footprints", "footprints_identity", "footprints_frame", "align"),
                *("layer", "id_attribute", "height_attribute", "roof_attribute"),
                *(("buildings_given",) if both else ()),
            ),
            version=4,
        ),
        *([Stage(EDITED, Scope.TILE, take_edits, (), ("edits",))] if edited else []),
        # What a tile needs of the footprints: it does not run again when others change.
        Stage(
            *("outlines", Scope.TILE, take_outlines, (*outlines, *edits), ("footprints_shift",)),
            version=4,
            after="ground",
        ),
        Stage("reserved", Scope.REGION, list_reserved, outlines),
        Stage(*("ground", Scope.TILE, bin_tile, (Read("points", around),), ground), version=2),
        Stage(
            "flooded",
            Scope.TILE,
            flood_tile,
            (Read("ground", (FILL_RINGS + 2) * spacing),),
            ("dtm_spacing",),
            version=4,
        ),
        Stage("coarse", Scope.REGION, join_coarse, (Read("flooded"),), ("dtm_spacing",), version=3),
    ]


def lake_stage() -> Stage:
    """Stage of what a tile needs of the coarse level, for the tiles alone that the facts of ``"coarse"`` list.

    Such a tile does not run again when the coarse level of others changes.
    """
    reads = (Read("flooded", own=True), Read("coarse"))
    return Stage("lakes", Scope.TILE, take_coarse, reads, ("dtm_spacing",))


def fill_stage() -> Stage:
    """Stage of the whole terrain of each tile."""
    reads = (Read("flooded", own=True), Read("lakes", own=True, optional=True))
    return Stage("terrain", Scope.TILE, fill_tile, reads, ("dtm_spacing",), version=3)


def halo_of_points(config: Config, reach: float) -> float:
    """How far around a tile files are read for points within `reach` (m)."""
    from pipeline.points_terrain.ground_filter import FILTER_REACH

    return reach + (FILTER_REACH if config.ground_filter else 0.0)


def read_point_file(task: Task) -> Facts:
    """Read a point cloud file and deal its points out to cells (step 1.1); a city model or a raster likewise."""
    path = place(task.file)
    kind = kind_of(path) if not is_url(task.file) else CLOUD
    if kind != CLOUD:
        try:
            return read_model_file(task, path) if kind == MODEL else read_terrain_file(task, path)
        except InputError as error:
            if not task.parameters.skip_unreadable:
                raise
            return _leave_out(task, error)
    counts: Counter[str] = Counter()
    classes: set[int] = set()
    become = rename_classes(task.parameters.building_classes)
    row = n_cells = 0
    blocks = [0]
    steps = [np.empty(0)]
    try:
        for block in read_cells(task.file, task.context.bounds, frame=task.frame, share=task.share):
            task.append(
                units=block.units,
                classification=become[block.classification],
                cell=block.cell,
                cell_row=block.start[:-1] + row,
            )
            counts.update(block.counts)
            classes |= set(block.classes.tolist())
            row += len(block.units)
            n_cells += len(block.cell)
            blocks.append(n_cells)
            scaling = {"scale": block.scale, "offset": block.offset}
            z = np.asarray(block.units[:, 2] * block.scale[2] + block.offset[2], np.float64)
            steps.append(compare_ground(z, block.classification, block.start))
        _check_classes(task, np.concatenate(steps), counts[KEY_POINTS])
    except InputError as error:
        if not task.parameters.skip_unreadable:
            raise
        return _leave_out(task, error)
    task.put(block=np.array(blocks), end=np.array([row]))
    return {
        "counts": dict(counts),
        "classes": sorted(classes),
        "marks_buildings": bool(classes & set(task.parameters.building_classes)),
        "unreadable": None,
        **scaling,
    }


def _leave_out(task: Task, error: InputError) -> Facts:
    """Forget a file that cannot be read; gives its facts."""
    task.discard()
    return {"counts": {}, "classes": [], "marks_buildings": True, "unreadable": str(error)}


def _check_classes(task: Task, steps: NDArray[np.float64], n_key_points: int) -> None:
    """Refuse a cloud whose class 2 lies above what has no class, or whose key points are to be buildings."""
    given, file = task.parameters, task.file
    if not given.ground_filter and is_upside_down(steps):
        high = steps[steps > LEAST_STEP]
        raise InputError(
            f"{file}: class {GROUND} lies {np.median(high):.1f} m above classes 0 and 1 in {len(high)} of "
            f"{len(steps)} squares of {CELL:g} m, so it is not ground here: this cloud has classes of its own; "
            "renumber them to those of ASPRS (pdal translate, filters.assign), or find ground anew with "
            "--ground-filter"
        )
    if KEY_POINT in given.building_classes and n_key_points:
        raise InputError(
            f"{file}: --building-classes names {KEY_POINT}, the class of key points of the ground in its point "
            f"format (0 to 5), and {n_key_points} points have it; leave {KEY_POINT} out, and find ground anew if "
            "they are buildings: --ground-filter"
        )


def read_footprint_file(task: Task) -> Facts:
    """Read the footprints of the region and deal them out to cells (step 1.2)."""
    given = task.parameters
    if not given.footprints:
        return {"n": 0, "part_like": []}
    source = open_source(
        place(given.footprints),
        crs=pyproj.CRS.from_user_input(task.context.crs),
        bounds=grow(task.context.bounds, REACH) if given.align else task.context.bounds,
        frame=Frame(*given.footprints_frame),
        layer=given.layer,
        id_attribute=given.id_attribute,
        height_attribute=given.height_attribute,
        roof_attribute=given.roof_attribute,
    )
    return put_rows(
        task,
        scan_footprints(source),
        given.footprints,
        *(["houses are those of the city model"] if given.get("buildings_given", False) else []),
    )


def read_model_footprints(task: Task) -> Facts:
    """Take the outlines of the buildings of all city models as footprints (step 1.2)."""
    return _put_models(task, lambda blocks: blocks)


def _put_models(
    task: Task,
    see: Callable[[Iterable[FootprintBlock]], Iterable[FootprintBlock]],
    empty: str = "terrain only",
) -> Facts:
    counts: Counter[str] = Counter()
    for _, facts in list_kind(task, MODEL):
        counts.update(facts["model"])
    blocks = (block_footprints(*band) for band in read_model_bands(task))
    return put_rows(task, see(blocks), "the city model", empty) | {
        "counts": {k: v for k, v in sorted(counts.items()) if v}
    }


def read_models_beside(task: Task) -> Facts:
    """Take the outlines of the buildings of city models beside footprints, and the numbers of their ids."""
    numbers = [np.empty(0, np.int64)]

    def noted(blocks: Iterable[FootprintBlock]) -> Iterator[FootprintBlock]:
        for block in blocks:
            numbers.append(number_ids(block.rows.ids))
            yield block

    facts = _put_models(task, noted, "houses are those of the footprints")
    task.put(number=np.sort(np.concatenate(numbers)))
    return facts


def edited_tiles(tiles: Mapping[str, Box], edits: Edits) -> list[str]:
    """List the tiles that edits touch."""
    return [name for name, box in tiles.items() if any(boxes_touch(box, other) for other in edits.boxes)]


def take_edits(task: Task) -> Facts:
    """Take what edits changed in a tile: ids that are gone, and footprints that came."""
    removed, outlines = task.parameters.edits["removed"], task.parameters.edits["outlines"]
    mine = [Outline(*outline) for outline, box in outlines if boxes_touch(task.box, box)]
    forms = [[np.nan if v is None else v for v in one.form] or [np.nan] * N_COLUMNS for one in mine]
    task.put(
        removed=np.array([name for name, box in removed if boxes_touch(task.box, box)], np.str_),
        **pack_polygons(shapely.from_wkb([one.polygon for one in mine]).astype(np.object_), "outline"),
        ids=np.array([one.id for one in mine], np.str_),
        given_height=np.array([np.nan if one.height is None else one.height for one in mine], np.float64),
        forms=np.array(forms, np.float64).reshape(-1, N_COLUMNS),
        **pack_uploads(mine),
    )
    return {"n": len(mine)}


def _edit(task: Task, footprints: Footprints) -> tuple[Footprints, dict[str, NDArray[Any]]]:
    """Apply the edits of a tile to its footprints; gives them, and the arrays of those that tell their height."""
    (found,) = (result.arrays for result in task.read(EDITED))
    kept = take_footprints(footprints, ~np.isin(footprints.ids, found["removed"]))
    came = unpack_polygons(found, "outline")
    near = shapely.intersects(came, shapely.box(*task.box))
    ids = np.concatenate((kept.ids, found["ids"][near]))
    both = Footprints(
        np.concatenate((kept.polygons, came[near])),
        ids,
        np.concatenate((kept.given_height, found["given_height"][near])),
        np.concatenate((kept.forms, found["forms"][near])),
    )
    told = {name: values for name, values in found.items() if name.startswith(UPLOADED)}
    return take_footprints(both, np.argsort(ids, kind="stable")), told


def take_outlines(task: Task) -> Facts:
    """Take the footprints that meet a tile (step 1.2); beside a city model, its buildings and what these leave."""
    footprints = read_outlines(task, shift=task.parameters.footprints_shift)
    told: dict[str, NDArray[Any]] = {}
    if task.refs.get(EDITED):
        footprints, told = _edit(task, footprints)
    if MODEL_OUTLINES in task.refs:
        footprints = _join_models(task, footprints)
    counts = {}
    if BLOCK_ROWS in task.refs:
        footprints, n_replaced = replace_by_blocks(task, footprints)
        counts = {"counts": {"footprints replaced by blocks": n_replaced}}
    task.put(
        **pack_polygons(footprints.polygons, "outline"),
        ids=footprints.ids,
        given_height=footprints.given_height,
        forms=footprints.forms,
        **told,
    )
    extent = extent_of(footprints.polygons)
    # A house keeps within its footprint, and within the region.
    inside = None if extent is None else clip(extent, task.context.bounds)
    return {"n": len(footprints.ids), "extent": inside, **counts}


def _join_models(task: Task, footprints: Footprints) -> Footprints:
    """Join the buildings of city models that meet a tile, and what they leave of footprints."""
    bounds = task.context.bounds
    near = read_outlines(task, hull(task.box, extent_of(footprints.polygons)), stage=MODEL_OUTLINES)
    (found,) = task.read(MODEL_OUTLINES, ("number",))
    left, notes = give_way(footprints, ModelPlaces(near.polygons, found.arrays["number"]), bounds)
    task.notes(own_notes(task, notes))
    own = take_footprints(near, shapely.intersects(near.polygons, shapely.box(*task.box)))
    return Footprints(
        np.concatenate((own.polygons, left.polygons)),
        np.concatenate((own.ids, left.ids)),
        np.concatenate((own.given_height, left.given_height)),
        np.concatenate((own.forms, left.forms)),
    )


def list_reserved(task: Task) -> Facts:
    """List the ids of footprints that look like one of a part of a house."""
    return {
        "names": sorted(
            {name for stage in task.refs for one in task.read(stage, ()) for name in one.facts["part_like"]}
        )
    }


def own_window(task: Task, *, spacing: float = 0.0) -> NodeWindow:
    """Nodes that a tile owns: those of the terrain, or of another raster."""
    grid, (i, j) = task.context.grid, tile_key(task.name)
    return node_window(
        task.box,
        spacing or task.parameters.dtm_spacing,
        low_border=(not has_tile(grid, Key(i - 1, j)), not has_tile(grid, Key(i, j - 1))),
        high_border=(not has_tile(grid, Key(i + 1, j)), not has_tile(grid, Key(i, j + 1))),
    )


def bin_tile(task: Task) -> Facts:
    """Average the ground points around the nodes of a tile (step 1.3), a band of points at a time."""
    spacing = task.parameters.dtm_spacing
    window = own_window(task)
    box = (
        window.i0 * spacing,
        window.j0 * spacing,
        (window.i0 + window.nx - 1) * spacing,
        (window.j0 + window.ny - 1) * spacing,
    )
    box = grow(box, spacing / 2)
    if task.parameters.ground_filter:
        bands = read_bands(task, box, classes=(GROUND, WATER), ground_filter=True)
        raster, _ = bin_nodes(bands, window, spacing=spacing)
    else:
        raster = bin_units(read_units(task, box), box, window, spacing=spacing)
    if task.parameters.get("terrain_given", False):
        rasters = sample_rasters(task, window, spacing)
        raster = replace(raster, z=np.where(np.isnan(rasters.z), raster.z, rasters.z))
    task.put_rasters(z=raster.z)
    return _raster_facts(raster)


def flood_tile(task: Task) -> Facts:
    """Fill the small empty areas of a tile's terrain (step 1.3)."""
    spacing = task.parameters.dtm_spacing
    own = own_window(task)
    within = node_window(task.context.bounds, spacing)
    window = grow_window(own, FILL_RINGS, within=within)
    flooded = flood_terrain(join_rasters(task, "ground", window, spacing), own)
    sums, n_deep = coarsen(flooded), count_coarse(flooded)
    task.put(z=flooded.dtm.z, node=sums.node.reshape(-1, 2), total=sums.total, count=sums.count)
    if n_deep:
        task.put(ring=flooded.ring)
    return _raster_facts(flooded.dtm) | {"known": sums.n_known, "deep": n_deep}


def join_coarse(task: Task) -> Facts:
    """Make the coarse level that the middles of large empty areas take (step 1.3)."""
    sums, deep = [], []
    for result in task.read("flooded", ("node", "total", "count")):
        facts, arrays = result.facts, result.arrays
        if facts["deep"]:
            deep.append(result.name)
        window = NodeWindow(facts["i0"], facts["j0"], facts["nx"], facts["ny"])
        sums.append(
            CoarseSums(arrays["node"], arrays["total"], arrays["count"], window, facts["known"], facts["spacing"])
        )
    raster = coarse_terrain(merge_coarse(sums))
    task.put(z=raster.z)
    return _raster_facts(raster) | {"deep": sorted(deep)}


def take_coarse(task: Task) -> Facts:
    """Take the coarse nodes that a tile needs whose middles are empty and deep (step 1.3)."""
    (own,) = (result.facts for result in task.read("flooded", ()))
    (coarse,) = (_raster(result.arrays["z"], result.facts) for result in task.read("coarse"))
    around = coarse_around(coarse, NodeWindow(own["i0"], own["j0"], own["nx"], own["ny"]))
    task.put(z=around.z)
    return _raster_facts(around)


def fill_tile(task: Task) -> Facts | None:
    """Fill the large empty areas of a tile's terrain (step 1.3); nothing yet where that takes the coarse level."""
    (own,) = task.read("flooded")
    terrain, n_deep = _raster(own.arrays["z"], own.facts), own.facts["deep"]
    if n_deep:
        if not task.refs["lakes"]:
            return None
        (lakes,) = task.read("lakes")
        flooded = FloodedDtm(terrain, own.arrays["ring"])
        terrain, _ = fill_terrain(flooded, _raster(lakes.arrays["z"], lakes.facts))
    task.put_rasters(z=terrain.z)
    return _raster_facts(terrain) | {
        "counts": {
            "terrain nodes": terrain.z.size,
            "terrain nodes filled": terrain.z.size - own.facts["known"],
            "terrain nodes from coarse level": n_deep,
        }
    }


def _raster(z: Any, facts: Facts) -> Dtm:
    return Dtm(z, facts["i0"], facts["j0"], facts["spacing"])


def _raster_facts(raster: Dtm) -> Facts:
    ny, nx = raster.z.shape
    return {"i0": raster.i0, "j0": raster.j0, "nx": nx, "ny": ny, "spacing": raster.spacing}
