"""Stages 1.4 to 2.3: houses of each tile, clusters of close ones across tiles, and the simplified city model."""

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.city_model.building_points import reach_of_points
from pipeline.city_model.city import City, CityOptions, find_places
from pipeline.city_model.city_steps import measure_city, prepare_footprints
from pipeline.city_model.full_model import divide_city
from pipeline.city_model.groups import adjacent_houses
from pipeline.city_model.houses import (
    Houses,
    divide_houses,
    find_model_roofs,
    join_houses,
    leave_out_points,
    take_houses,
)
from pipeline.city_model.model_roofs import MODEL
from pipeline.city_model.unmarked_roofs import MAY_BE_ROOF
from pipeline.columns.adaptive import AdaptiveOptions
from pipeline.columns.layered import LayeredOptions, choose_layers, terrain_reach
from pipeline.data.citymodel import Footprints, take_footprints
from pipeline.data.classes import BUILDING, GROUND, WATER
from pipeline.data.notes import Note
from pipeline.data.roof_forms import POINTS_TELL, find_blocks
from pipeline.geometry.components import join_pairs
from pipeline.points_terrain.raster import Dtm, window_of
from pipeline.points_terrain.terrain import cut_terrain
from pipeline.quality.point_fidelity import measure_houses
from pipeline.roofs.roof_points import (
    RoofPoints,
    add_roof_points,
    keep_roof_points,
    locate_roof_points,
    merge_roof_points,
)
from pipeline.roofs.roof_surfaces import RoofSurfaces
from pipeline.simplification.house_clusters import (
    Shapes,
    find_close,
    join_shapes,
    keep_shapes,
    leave_out,
    shape_clusters,
)
from pipeline.simplification.reduced_detail import BLOCK, reduce_detail
from pipeline.simplification.simplify import raise_buildings
from stitch.tiling.grid import Key
from tiler.cityinput.rows import ModelRows
from tiler.citymodels.clusters import pack_clusters, place_in_grid, unpack_clusters
from tiler.citymodels.tables import (
    ARRAYS_TO_RAISE,
    ARRAYS_TO_SHAPE,
    make_buildings,
    pack_buildings,
    pack_houses,
    pack_model,
    pack_polygons,
    unpack_houses,
    unpack_polygons,
)
from tiler.config.config import Config
from tiler.config.step_options import (
    BLOCK_PARAMETERS,
    CITY_PARAMETERS,
    FINER_PARAMETERS,
    ZONE_PARAMETERS,
    city_options,
    layer_parameters,
    mesh_options,
    needs_region,
)
from tiler.config.zone_levels import find_levels
from tiler.config.zones import LEVELS, Zones
from tiler.engine.run_context import find_owned, region_around, tile_key
from tiler.engine.stage import Box, Facts, Read, Scope, Stage
from tiler.engine.task import Result, Task
from tiler.stages.city_files import (
    count_feet,
    find_rows,
    note_feet,
    read_surfaces,
    read_uploads,
    take_surfaces,
)
from tiler.stages.house_points import add_unmarked, find_surfaces, points_near
from tiler.stages.inputs import halo_of_points
from tiler.stages.readers import extent_of, grow, hull, read_known_terrain, read_own_outlines
from tiler.store.run_folder import PARTS

TERRAIN = ("dtm_spacing", "ground_filter")
OF_UPLOADS = "uploads"  # fact of the houses of a tile where uploads tell some roofs, of which ``told`` is an array
OF_BLOCKS = ("block", "block_place")  # arrays of the houses: level and point of those that are blocks


def house_stage(config: Config) -> Stage:
    """Stage of the houses of each tile."""
    reads = (
        Read("outlines", own=True),
        Read("points", halo_of_points(config, config.ground_margin), around="outlines"),
        Read("terrain", 2 * config.dtm_spacing, around="outlines"),
        Read("reserved"),
    )
    models = ("buildings_given", "ground_of_models", "prefer") if config.buildings else ()
    finer = FINER_PARAMETERS if config.keeps_model_roofs else ()
    blocks = BLOCK_PARAMETERS if config.has_blocks else ()
    parameters = (*CITY_PARAMETERS, "full_parts", *TERRAIN, *models, *finer, *blocks)
    return Stage("houses", Scope.TILE, make_houses, reads, parameters, version=7)


def first_round(config: Config) -> list[Stage]:
    """Stages that find the clusters of close houses, and simplify each by itself."""
    return [
        Stage(
            "near-0",
            Scope.TILE,
            find_near_houses,
            (Read("houses", config.clearance, by_extent=True),),
            ("clearance",),
            small=True,
        ),
        Stage("join-0", Scope.REGION, join_houses_in_clusters, (Read("houses"), Read("near-0")), version=2),
        member_stage(0),
    ]


def member_stage(number: int) -> Stage:
    """Stage that lists the clusters of a round which a tile owns; where none were joined, nothing asks for it."""
    return Stage(f"members-{number}", Scope.TILE, list_members, (Read(f"join-{number}"),), version=2)


def shape_stage(config: Config, number: int) -> Stage:
    """Stage that simplifies the clusters of a round, each in the tile that owns it."""
    reads = [Read(f"members-{number}", own=True), Read("houses", named_by=f"members-{number}")]
    reads += [Read(f"shapes-{number - 1}", own=True)] if number else []
    finer = FINER_PARAMETERS if config.keeps_model_roofs else ()
    parameters = (*CITY_PARAMETERS, *finer)
    return Stage(
        f"shapes-{number}", Scope.TILE, shape_members, tuple(reads), parameters, version=2 if finer else 1
    )


def later_round(config: Config, number: int) -> list[Stage]:
    """Stages that join the clusters whose results came too close in the round before, if any did."""
    before, after = number - 1, number
    return [
        Stage(
            f"near-{after}",
            Scope.TILE,
            find_near_shapes,
            (Read(f"shapes-{before}", config.clearance, by_extent=True),),
            ("clearance",),
            small=True,
        ),
        Stage(
            f"join-{after}",
            Scope.REGION,
            join_close_clusters,
            (Read(f"join-{before}"), Read(f"near-{after}")),
            version=2,
        ),
    ]


def model_stage(config: Config, last: int) -> Stage:
    """Stage of the buildings of the clusters that a tile owns, with their heights."""
    shapes, members = f"shapes-{last}", f"members-{last}"
    layered = config.mesher == "layered" and not chooses_layers_later(config)
    options = mesh_options(config) if layered else None
    reach = terrain_reach(options) if isinstance(options, LayeredOptions) else 0.0
    reads = (
        Read("reserved"),
        Read(shapes, own=True),
        Read(members, own=True),
        Read("houses", named_by=members),
        Read("points", halo_of_points(config, 2 * config.ground_margin), around=shapes),
        Read("terrain", reach + 2 * config.dtm_spacing, around=shapes),
    )
    mesh = layer_parameters(config) if layered else ("mesher",)
    make = make_model if config.mesher == "adaptive" or layered else make_model_without_layers
    version = 9 if layered else 7
    zones = (*(ZONE_PARAMETERS if config.zoned else ()), *(BLOCK_PARAMETERS if config.has_blocks else ()))
    finer = FINER_PARAMETERS if config.keeps_model_roofs else ()
    parameters = (*CITY_PARAMETERS, *TERRAIN, *mesh, *finer, *zones)
    return Stage("model", Scope.TILE, make, reads, parameters, version=version)


def chooses_layers_later(config: Config) -> bool:
    """Whether the layers of roofs wait for the height of the domain, which follows from the city model."""
    return config.mesher == "layered" and needs_region(config)


def make_houses(task: Task) -> Facts:
    """Clean the footprints of a tile, and give its houses their points, heights and parts (steps 1.4 to 2.0).

    Memory grows with the points on and around its houses, not with all points of the tile.
    """
    options, spacing = city_options(task.parameters), task.parameters.dtm_spacing
    grid, bounds = task.context.grid, task.context.bounds
    with task.step("1.4 clean footprints"):
        read = read_own_outlines(task)
        around = hull(task.box, extent_of(read.polygons))
        inner, notes = prepare_footprints(read, region_around(grid, around), options)
        own = _owned(task, inner)
        uploads = read_uploads(task)
        told = find_rows(uploads, own.polygons, own.ids) >= 0  # roof points there are of what stood there before
    places = np.array([(note.x, note.y) for note in notes]).reshape(-1, 2)
    task.notes(note for note, mine in zip(notes, find_owned(task.box, bounds, places), strict=True) if mine)
    extent = extent_of(own.polygons)
    near = reach_of_points(own.polygons, options.ground_margin)
    dtm = _terrain_around(task, extent, 2 * spacing)
    cloud = points_near(task, extent, options.ground_margin, near, (BUILDING, GROUND, WATER))
    terrain = cut_terrain(dtm, window_of(dtm))
    with task.step("1.5 extract building points"):
        roofs = locate_roof_points(cloud, own.polygons, building_class=True)
        roofs, unmarked = add_unmarked(task, own, roofs, cloud, terrain, told=told)
        blocks = task.parameters.get("blocks_given", False)
        roofs, stated = _leave_out_stated(task, own, roofs, told, blocks=blocks)
    city = measure_city(cloud, own, terrain, options, building_class=True, roofs=roofs, trace=task.step)
    task.notes(_of_buildings(city.notes, own.ids[stated]))
    roofs = keep_roof_points(roofs, np.isin(own.ids, city.model.ids))
    others = np.isin(city.model.ids, own.ids[unmarked])
    told = told[np.isin(own.ids, city.model.ids)]
    surfaces, facts = _find_surfaces(task, city, uploads)
    with task.step("2.0 split levels"):
        houses = divide_houses(
            city,
            cloud,
            options,
            building_class=True,
            roofs=roofs,
            unmarked=others | told,
            surfaces=surfaces,
            prefer_points=task.parameters.get("prefer", "model") == "points",
            full=task.parameters.full_parts,
        )
    del cloud  # large, and no longer needed
    with task.step("1.7 full city model"):
        divided, roofs = divide_city(city, houses, roofs, reserved=_reserved(task))
        fidelity = measure_houses(roofs, divided.model.polygons, divided.model.roofs)
        full = make_buildings(divided, fidelity, np.zeros(len(divided.model), np.int32))
    task.notes(houses.notes)
    task.put(**pack_houses(houses), **pack_buildings(full, "full_"), unmarked=others)
    if blocks:
        level, place = find_blocks(city.forms)
        task.put(block=level, block_place=place)
    if told.any():
        task.put(told=told)
        facts[OF_UPLOADS] = True
    parts = {"house parts": len(houses.parts.polygons)}
    counts = {"buildings before merging": len(houses), **parts, **_count_forms(houses)}
    counts |= {"roofs from other classes": int(others.sum())} if others.any() else {}
    counts |= {"roofs of uploads": int(told.sum())} if told.any() else {}
    return {"n": len(houses), "extent": extent_of(houses.polygons), "counts": counts, **facts}


def _leave_out_stated(
    task: Task, own: Footprints, roofs: RoofPoints, told: NDArray[np.bool_], *, blocks: bool
) -> tuple[RoofPoints, NDArray[np.bool_]]:
    """Leave out the roof points of blocks, and of houses whose upload tells the roof; gives these, too."""
    n = np.diff(roofs.start)
    task.notes(
        Note("upload-instead-of-points", *place, f"{n[k]} roof points in the cloud do not count")
        for k, place in find_places(own, told & (n > 0))
    )
    stated = told | (find_blocks(own.forms)[0] >= 0)
    return leave_out_points(roofs, stated if blocks else told), stated


def _find_surfaces(task: Task, city: City, uploads: ModelRows) -> tuple[RoofSurfaces | None, Facts]:
    """Find the roof surfaces of houses in city models or uploads, and note feet that are off the ground."""
    of_models = task.parameters.get("buildings_given", False)
    with task.step("1.2 roof surfaces") if of_models or len(uploads) else nullcontext():
        if of_models:
            surfaces, base = read_surfaces(task, city.model.polygons, city.model.ids, uploads)
        elif len(uploads):
            rows = find_rows(uploads, city.model.polygons, city.model.ids)
            surfaces, base = take_surfaces(uploads, rows)
        else:
            return None, {}
    if of_models and task.parameters.ground_of_models:
        return surfaces, {}
    houses_of = Footprints(city.model.polygons, city.model.ids, city.given_height)
    task.notes(note_feet(houses_of, base, city.model.ground))
    return surfaces, {"feet": count_feet(base, city.model.ground)} if of_models else {}


def _of_buildings(notes: Sequence[Note], blocks: NDArray[np.str_]) -> list[Note]:
    """Leave out that blocks have the height of their attribute: they never have another one."""
    names = set(blocks.tolist())
    return [note for note in notes if not (note.kind.endswith("-roof-from-attribute") and note.subject in names)]


def find_near_houses(task: Task) -> Facts:
    """Find the pairs of houses that are close in a tile (step 2.1)."""
    polygons, owner = [np.empty(0, object)], [np.empty((0, 3), np.int64)]
    for result in task.read("houses", ("outline", "outline_start")):
        outlines = unpack_polygons(result.arrays, "outline")
        rows = _near_rows(task, outlines)
        polygons.append(outlines[rows])
        owner.append(_in_tile(result.name, rows))
    close = find_close(np.concatenate(polygons), task.parameters.clearance)
    task.put(pairs=np.concatenate(owner)[close].reshape(-1, 6))
    return {"n": len(close)}


def join_houses_in_clusters(task: Task) -> Facts:
    """Chain close houses to clusters, over the whole region (step 2.1)."""
    tiles = [(tile_key(result.name), result.facts["n"]) for result in task.read("houses", ())]
    tiles.sort()
    first = {
        key: begin for (key, _), begin in zip(tiles, np.cumsum([0, *(n for _, n in tiles)]).tolist(), strict=False)
    }
    house = np.concatenate(
        [np.empty((0, 3), np.int64)] + [np.column_stack((np.tile(key, (n, 1)), np.arange(n))) for key, n in tiles]
    )
    pairs = np.concatenate([np.empty((0, 6), np.int64)] + [r.arrays["pairs"] for r in task.read("near-0")])
    begin = np.array([[first[Key(i, j)] for i, j in pairs[:, [a, a + 1]].tolist()] for a in (0, 3)], np.int64)
    index = np.column_stack((begin[0] + pairs[:, 2], begin[1] + pairs[:, 5])) if len(pairs) else pairs[:, :2]
    cluster = join_pairs(len(house), index)
    task.put(**pack_clusters(house, cluster, np.ones(len(house), np.bool_)))
    return {"joined": 0, "clusters": len(np.unique(cluster))}


def find_near_shapes(task: Task) -> Facts:
    """Find the clusters whose results came close in a tile (step 2.1)."""
    (stage,) = task.refs
    polygons, cluster = [np.empty(0, object)], [np.empty((0, 3), np.int64)]
    for result in task.read(stage, ("polygon", "polygon_start", "cluster")):
        shapes = unpack_polygons(result.arrays, "polygon")
        rows = _near_rows(task, shapes)
        polygons.append(shapes[rows])
        cluster.append(_in_tile(result.name, result.arrays["cluster"][rows]))
    label = np.concatenate(cluster)
    close = label[find_close(np.concatenate(polygons), task.parameters.clearance)].reshape(-1, 6)
    task.put(pairs=np.unique(close[(close[:, :3] != close[:, 3:]).any(axis=1)], axis=0))
    return {"n": len(close)}


def join_close_clusters(task: Task) -> Facts:
    """Join the clusters whose results came close, over the whole region (step 2.1)."""
    before, near = sorted(task.refs)
    (clusters,) = task.read(before)
    house, cluster = unpack_clusters(clusters.arrays)
    pairs = np.concatenate([np.empty((0, 6), np.int64)] + [result.arrays["pairs"] for result in task.read(near)])
    joined = join_pairs(len(cluster), _find_rows(house, pairs.reshape(-1, 3)).reshape(-1, 2))[cluster]
    touched = np.isin(joined, joined[joined != cluster])
    task.put(**pack_clusters(house, joined, touched))
    fewer = len(np.unique(cluster)) - len(np.unique(joined))
    return {"joined": fewer, "clusters": len(np.unique(joined))}


def list_members(task: Task) -> Facts:
    """List the houses of the clusters that a tile owns: those whose first house is the tile's.

    A cluster is called by the row of that house in its tile: other houses elsewhere change nothing here. Of the
    region's rows a tile reads its own alone.
    """
    (stage,) = task.refs
    (found,) = task.read(stage, ("grid",))
    place = place_in_grid(found.arrays["grid"], tile_key(task.name))
    start, stop = (0, 0) if place < 0 else task.read_rows(stage, found.name, "start", place, place + 2).tolist()
    mine = task.read_rows(stage, found.name, "owned", start, stop)
    task.put(house=mine[:, :3].copy(), cluster=mine[:, 3].copy(), changed=mine[:, 4].astype(np.bool_))
    tiles = np.unique(mine[:, :2], axis=0).tolist()
    return {"n": len(mine), "names": sorted(f"{i}_{j}" for i, j in tiles)}


def shape_members(task: Task) -> Facts:
    """Simplify the clusters that a tile owns and that are new (step 2.1)."""
    gathered = _gather(task, _members(task), ARRAYS_TO_SHAPE)
    houses, fresh = gathered.houses, np.where(gathered.changed, gathered.cluster, -1)
    with task.step("2.1 simplify"):
        shapes = shape_clusters(houses.parts, fresh, city_options(task.parameters), find_model_roofs(houses))
    counts = shapes.counts
    shapes = join_shapes([_earlier_shapes(task, gathered), shapes])
    task.put(
        **pack_polygons(shapes.polygons, "polygon"),
        cluster=shapes.cluster,
        member_start=shapes.member_start,
        member=gathered.place[shapes.member],
        closed=gathered.place[shapes.closed[:, 0]],
        closed_cluster=shapes.closed[:, 1],
    )
    if task.parameters.get("finer_clearance", 0.0):
        task.put(clearance=shapes.clearance)
    return {"n": len(shapes), "extent": extent_of(shapes.polygons), "counts": dict(sorted(counts.items()))}


def make_model(task: Task) -> Facts:
    """Give the buildings of the clusters that a tile owns their ids, heights and layers (steps 2.3 and 3.4)."""
    return _make_model(task, mesh_options(task.parameters) if task.parameters.mesher == "layered" else None)


def make_model_without_layers(task: Task) -> Facts:
    """Give the buildings of the clusters that a tile owns their ids and heights; their layers are chosen later."""
    return _make_model(task, None)


def _make_model(task: Task, mesh: LayeredOptions | AdaptiveOptions | None) -> Facts:
    given, bounds = task.parameters, task.context.bounds
    options = city_options(given)
    blocks = OF_BLOCKS if given.get("blocks_given", False) else ()
    gathered = _gather(task, _members(task), (*ARRAYS_TO_RAISE, *blocks))
    shapes = _earlier_shapes(task, replace(gathered, changed=np.zeros(len(gathered.houses), np.bool_)))
    reach = terrain_reach(mesh) if isinstance(mesh, LayeredOptions) else 0.0
    shapes = _keep_within(task, shapes, gathered.houses)
    extent = extent_of(shapes.polygons)
    dtm = _terrain_around(task, extent, reach + 2 * given.dtm_spacing)
    terrain = cut_terrain(dtm, window_of(dtm))
    cloud = points_near(task, extent, options.ground_margin, shapes.polygons, (BUILDING,))
    with task.step("2.3 roof points"):
        roofs = locate_roof_points(cloud, shapes.polygons, building_class=True)
        del cloud
        rows = _find_of_all(shapes, gathered, gathered.unmarked)
        others = find_surfaces(task, shapes.polygons[rows], terrain, MAY_BE_ROOF)
        roofs = add_roof_points(roofs, rows, others.points)
        told = np.zeros(len(shapes), np.bool_)
        told[_find_of_all(shapes, gathered, gathered.told)] = True
        roofs = leave_out_points(roofs, told)
    city = raise_buildings(
        gathered.houses, shapes, terrain, options, reserved=_reserved(task), roof_points=roofs, trace=task.step
    )
    stated = gathered.houses.ids[gathered.told | (gathered.block >= 0)]
    task.notes(_of_buildings(city.notes, city.model.ids[np.isin(city.model.house, stated)]))
    kept = np.zeros(len(shapes), np.bool_)
    kept[city.row] = True
    roofs = keep_roof_points(roofs, kept)
    zoned = bool(given.get("zones", ()))
    level, place = np.empty(0, np.int8), np.empty((0, 2))
    if zoned:
        with task.step("2.3 zones of detail"):
            city, roofs, level, place = _lower_detail(city, roofs, gathered, given.zones, options)
    model = city.model
    layers, parted = np.zeros(len(model), np.int32), 0
    if isinstance(mesh, LayeredOptions):
        with task.step("3.4 choose layers"):
            pairs = adjacent_houses(model.polygons)
            layers, parted = choose_layers(
                model.polygons, model.roof, city.wall_ground, city.group, pairs, dtm, bounds, mesh
            )
    with task.step("2.4 fit of roofs"):
        fidelity = measure_houses(roofs, model.polygons, model.roofs)
    buildings = replace(make_buildings(city, fidelity, layers), level=level, place=place)
    task.put(**pack_model(buildings, zoned=zoned))
    counts = {"buildings": len(np.unique(model.house)), PARTS: len(model)}
    counts |= {name: n for name, n in city.counts.items() if name not in shapes.counts}
    counts |= {"roofs on another layer": parted} if parted else {}
    counts |= {f"parts at level {LEVELS[k]}": int((level == k).sum()) for k in np.unique(level).tolist()}
    return {"n": len(model), "extent": extent, "counts": counts, "outline": city.outline}


def _lower_detail(
    city: City, roofs: RoofPoints, gathered: "_Gathered", zones: Zones, options: CityOptions
) -> tuple[City, RoofPoints, NDArray[np.int8], NDArray[np.float64]]:
    """Give each house the level of the zone that its point lies in, and tell levels and points.

    A block has its own level, and its cell's point. In a zone of blocks, what is in no cell there is at 1.2.
    """
    houses = gathered.houses
    house = np.searchsorted(houses.ids, city.model.house)  # ascending, see `_gather`
    place = shapely.get_coordinates(shapely.point_on_surface(houses.polygons)).reshape(-1, 2)
    block = gathered.block >= 0
    level = np.where(block, gathered.block, np.minimum(find_levels(zones, place), BLOCK)).astype(np.int8)[house]
    place = np.where(block[:, None], gathered.block_place, place)[house]
    if not len(level):
        return city, roofs, level, place
    detail = np.minimum(level, BLOCK)
    city, row = reduce_detail(
        city,
        detail,
        step=options.roof_group,
        clearance=options.roof_clearance,
        tolerance=options.vertex_tolerance,
    )
    _, first = np.unique(row, return_index=True)
    return city, merge_roof_points(roofs, row), level[first], place[first]


def _keep_within(task: Task, shapes: Shapes, houses: Houses) -> Shapes:
    """Leave out the buildings that leave the region: where its border turns inwards, a hull of several may."""
    extent = extent_of(shapes.polygons)
    if extent is None:
        return shapes
    region = region_around(task.context.grid, extent)
    shapely.prepare(region)
    within = shapely.contains_properly(region, shapes.polygons)
    for row in np.flatnonzero(~within).tolist():
        members = shapes.member[shapes.member_start[row] : shapes.member_start[row + 1]]
        ids = sorted(set(houses.ids[houses.parts.house[members]].tolist()))
        x, y = shapely.get_coordinates(shapely.point_on_surface(shapes.polygons[row]))[0].tolist()
        task.note(Note("building-beyond-region", ", ".join(ids), x, y, "its simplified outline leaves the region"))
    return keep_shapes(shapes, within)


def _reserved(task: Task) -> set[str]:
    """Read the ids that no part of a house may get."""
    return {name for result in task.read("reserved", ()) for name in result.facts["names"]}


def _owned(task: Task, footprints: Footprints) -> Footprints:
    """Take the footprints whose representative point is the tile's."""
    xy = shapely.get_coordinates(shapely.point_on_surface(footprints.polygons))
    mine = find_owned(task.box, task.context.bounds, xy.reshape(-1, 2))
    return take_footprints(footprints, mine)


def _find_of_all(shapes: Shapes, gathered: "_Gathered", house: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Rows of the buildings for all of whose houses something holds, (h,)."""
    holds = house[gathered.houses.parts.house[shapes.member]]
    building = np.repeat(np.arange(len(shapes)), np.diff(shapes.member_start))
    return np.flatnonzero(np.bincount(building[~holds], minlength=len(shapes)) == 0)


def _terrain_around(task: Task, extent: Box | None, reach: float) -> Dtm:
    """Terrain around an extent, NaN at nodes of tiles that are absent; any where there is no extent."""
    spacing = task.parameters.dtm_spacing
    if extent is None:
        return Dtm(np.zeros((1, 1)), 0, 0, spacing)
    return read_known_terrain(task, grow(extent, reach), spacing=spacing, bounds=task.context.bounds)


def _near_rows(task: Task, polygons: NDArray[np.object_]) -> NDArray[np.int64]:
    """Polygons that meet the tile, or are closer to it than the clearance: each close pair is so in some tile."""
    box = shapely.box(*grow(task.box, task.parameters.clearance))
    return np.flatnonzero(shapely.intersects(box, polygons))


def _in_tile(name: str, rows: NDArray[np.int64]) -> NDArray[np.int64]:
    """Rows of a tile as column and row of the tile and the row, (n, 3)."""
    return np.column_stack((np.tile(tile_key(name), (len(rows), 1)), rows))


def _members(task: Task) -> Result:
    (stage,) = (name for name in task.refs if name.startswith("members-"))
    (members,) = task.read(stage)
    return members


def _gather(task: Task, members: Result, arrays: Sequence[str]) -> "_Gathered":
    """Read some arrays of the houses of the tile's clusters, by ascending id."""
    house, cluster, changed = (members.arrays[name] for name in ("house", "cluster", "changed"))
    several, order, other = [], [], [np.empty(0, np.bool_)]
    level, at, told = [np.empty(0, np.int8)], [np.empty((0, 2))], [np.empty(0, np.bool_)]
    for result in task.read("houses", (*arrays, "unmarked")):
        mine = np.flatnonzero((house[:, :2] == tile_key(result.name)).all(axis=1))
        several.append(take_houses(unpack_houses(result.arrays), house[mine, 2]))
        order.append(mine)
        other.append(result.arrays["unmarked"][house[mine, 2]])
        n = len(result.arrays["unmarked"])
        level.append(result.arrays.get("block", np.full(n, -1, np.int8))[house[mine, 2]])
        at.append(result.arrays.get("block_place", np.full((n, 2), np.nan))[house[mine, 2]])
        uploads = result.facts.get(OF_UPLOADS, False)
        by_upload = task.read_rows("houses", result.name, "told", 0, n) if uploads else np.zeros(n, np.bool_)
        told.append(by_upload[house[mine, 2]])
    rows = np.concatenate([np.empty(0, np.int64), *order])
    joined = join_houses(several)
    by_id = np.argsort(joined.ids, kind="stable")
    houses, rows = take_houses(joined, by_id), rows[by_id]
    of_part = houses.parts.house
    number = np.arange(len(of_part)) - np.searchsorted(of_part, of_part)
    place = np.column_stack((house[rows].reshape(-1, 3)[of_part], number)).astype(np.int64)
    return _Gathered(
        houses,
        cluster[rows],
        changed[rows],
        place.reshape(-1, 4),
        np.concatenate(other)[by_id],
        np.concatenate(level)[by_id],
        np.concatenate(at)[by_id],
        np.concatenate(told)[by_id],
    )


@dataclass(frozen=True, eq=False)
class _Gathered:
    """Houses of a tile's clusters, and whether roofs are of other classes than that of buildings.

    ``place`` (p, 4) holds of each part its house's tile, row there, and number; ``block`` (h,) and ``block_place``
    (h, 2) level and point (m) of the houses that are blocks, -1 and NaN for others; ``told`` (h,) those whose
    upload tells their roof.
    """

    houses: Houses
    cluster: NDArray[np.int64]
    changed: NDArray[np.bool_]
    place: NDArray[np.int64]
    unmarked: NDArray[np.bool_]
    block: NDArray[np.int8]
    block_place: NDArray[np.float64]
    told: NDArray[np.bool_]


def _earlier_shapes(task: Task, gathered: _Gathered) -> Shapes:
    """Read the shapes of the clusters that are as they were before; none in the first round."""
    names = [name for name in task.refs if name.startswith("shapes-")]
    if not names:
        return join_shapes([])
    (result,) = task.read(names[0])
    arrays = result.arrays
    found = Shapes(
        unpack_polygons(arrays, "polygon"),
        arrays["member_start"],
        np.arange(len(arrays["member"])),
        arrays["cluster"],
        np.column_stack((np.arange(len(arrays["closed"])), arrays["closed_cluster"])),
        arrays.get("clearance", np.full(len(arrays["cluster"]), task.parameters.clearance)),
        {},
    )
    kept = leave_out(found, np.setdiff1d(arrays["cluster"], gathered.cluster[~gathered.changed]))
    member = _find_rows(gathered.place, arrays["member"][kept.member])
    closed = _find_rows(gathered.place, arrays["closed"][kept.closed[:, 0]])
    return replace(kept, member=member, closed=np.column_stack((closed, kept.closed[:, 1])))


def _find_rows(among: NDArray[np.int64], rows: NDArray[np.int64]) -> NDArray[np.int64]:
    """Find rows (k, c) among the rows (n, c), which hold each of them once."""
    _, index = np.unique(np.concatenate((among, rows)), axis=0, return_inverse=True)
    index = index.reshape(-1)
    position = np.full(len(among) + len(rows), -1)
    position[index[: len(among)]] = np.arange(len(among))
    found: NDArray[np.int64] = position[index[len(among) :]]
    return found


def _count_forms(houses: Houses) -> dict[str, int]:
    """Houses with the roof of a given form, and those whose points tell it instead; nothing without any."""
    counts = {
        "roofs of a given form": int((houses.form >= 0).sum()),
        "given forms of roofs with points": int((houses.form == POINTS_TELL).sum()),
        "roofs of a city model": int((houses.method == MODEL).sum()),
    }
    return {name: n for name, n in counts.items() if n}
