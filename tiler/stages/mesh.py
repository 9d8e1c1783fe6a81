"""Stages 3.1 to 3.5: the seams between tiles, and the columns of each tile between its seams."""

from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.columns.adaptive import AdaptiveOptions, AdaptiveReport, mesh_adaptive
from pipeline.columns.columns import lowest_gap
from pipeline.columns.layered import mesh_layers
from pipeline.columns.nodes import Levels, SeamColumns, join_levels, take_columns
from pipeline.columns.underground import RegionMesh, SoilOptions, add_soil, count_regions
from pipeline.data.errors import GeometryError
from pipeline.data.mesh import ColumnMesh, PlaneMesh, SeamEdges
from pipeline.data.notes import Note
from pipeline.data.regions import Region
from pipeline.data.roofs import is_flat
from pipeline.plane_mesh.plane import signed_areas
from pipeline.plane_mesh.sizes import SizeField
from pipeline.points_terrain.raster import Dtm, sample_dtm, window_of
from pipeline.points_terrain.terrain import cut_terrain
from stitch.pieces.numbering import corner_part, first_id, seam_ids
from stitch.seams.facets import Side, find_seam_edges
from stitch.seams.layered_seams import fill_corner_layers, fill_seam_layers
from stitch.seams.seam_columns import fill_corner, fill_seam, tile_columns
from stitch.seams.seams import SURROUNDINGS, Seam, find_vertices, trace_seam
from stitch.seams.soil_columns import fill_corner_soil, fill_seam_soil, join_seam
from stitch.seams.tiles import Sides, mesh_tile
from stitch.tiling.corners import Corner, place_corner
from stitch.tiling.grid import Bounds, Key, SeamKey, ends_of_seam, is_pinched, seams_of_tile
from stitch.tiling.land_cover import LandCover, find_patches
from stitch.tiling.patches import mesh_patch
from stitch.tiling.strips import centres
from tiler.citymodels.tables import NearBuildings
from tiler.config.config import Config
from tiler.config.domain_height import Domain
from tiler.config.step_options import (
    COVER_PARAMETERS,
    PAD_PARAMETERS,
    PLANE_PARAMETERS,
    REFINE_PARAMETERS,
    SIZE_PARAMETERS,
    SOIL_PARAMETERS,
    layer_parameters,
    mesh_options,
    plane_options,
    soil_options,
)
from tiler.engine.run_context import seam_key, seam_name, tile_key
from tiler.engine.stage import Facts, Read, Scope, Stage
from tiler.engine.task import Task
from tiler.stages.approach import terrain_stage
from tiler.stages.city import chooses_layers_later
from tiler.stages.seam_tables import (
    pack_columns,
    pack_levels,
    pack_seam,
    unpack_levels,
    unpack_pinched,
    unpack_pinched_soil,
    unpack_seam,
    unpack_soil,
)
from tiler.stages.surroundings import (
    COVERED,
    find_walls,
    halos,
    read_cover,
    read_surroundings,
    terrain_around,
    terrain_halo,
)
from tiler.store.run_folder import EASED, PATCH_OF_GROUND


def mesh_stages(config: Config, domain: Domain | None = None) -> list[Stage]:
    """Stages of seams and columns, with the halos of a domain as it is settled; as it is expected without one."""
    halo, see = halos(config, config.graded_size, around_walls=config.open_size > 0)
    domain = domain or Domain(config.expected_height, None)
    reads = [
        Read("model", see, by_extent=True, within=True),
        Read(terrain_stage(config), halo + terrain_halo(config, domain)),
    ]
    reads += [Read("layers", see, by_extent=True)] if chooses_layers_later(config) else []
    parameters = (*PLANE_PARAMETERS, *layer_parameters(config), "dtm_spacing", "tile_size_or_default")
    parameters += SIZE_PARAMETERS if config.graded_size or config.refined else ()
    parameters += REFINE_PARAMETERS if config.refined else ()
    parameters += PAD_PARAMETERS if config.padded else ()
    parameters += SOIL_PARAMETERS if config.underground else ()
    parameters += COVER_PARAMETERS if config.covered else ()
    reads += [Read(COVERED)] if config.covered else []
    version = 8 if config.mesher == "layered" else 6
    return [
        Stage("seams", Scope.SEAM, make_seam, tuple(reads), parameters, version=version),
        Stage(
            "columns", Scope.TILE, make_columns, (*reads, Read("seams", beside=True)), parameters, version=version
        ),
    ]


def make_seam(task: Task) -> Facts:
    """Find a seam, and fill its columns; with soil below them where that is asked for."""
    given, grid, soil = task.parameters, task.context.grid, soil_options(task.parameters)
    key = seam_key(task.name)
    buildings, dtm = read_surroundings(task)
    polygons = buildings.model.polygons
    walls, sizes = find_walls(polygons, task)
    _, edges = read_cover(task, walls)
    fixed = np.concatenate((walls, edges))
    with task.step("3.1 seams"):
        start, end = (
            place_corner(grid, corner, polygons, fixed, mesh_size=given.mesh_size, sizes=sizes)
            for corner in ends_of_seam(key)
        )
        plane = plane_options(given)
        seam = trace_seam(
            grid,
            key,
            (start, end),
            polygons,
            walls,
            mesh_size=given.mesh_size,
            min_angle=plane["min_angle"],
            passes=plane["passes"],
            sizes=sizes,
            surroundings=SURROUNDINGS if given.mesher == "layered" else 0.0,
            edges=edges,
        )
    task.put(**pack_seam(seam, buildings.model.numbers))
    facts = {"border": seam.border, "vertices": len(seam.xy)}
    if seam.border:
        pinched = _fill_pinched(key, (start, end), dtm, buildings, fixed, sizes, soil, task)
        return facts | {"pinched": pinched}
    with task.step("3.2-3.5 columns of seams"):
        first, last = (
            _fill_corner(place, corner, dtm, buildings, fixed, sizes, task)
            for place, corner in zip((start, end), ends_of_seam(key), strict=True)
        )
        terrain = cut_terrain(dtm, window_of(dtm))
        levels = _fill(seam, (first, last), terrain, buildings, sizes, task)
    task.put(**pack_levels(levels, buildings.model.numbers, "level"))
    if soil is not None:
        with task.step("soil of seams"):
            low, high = (
                fill_corner_soil(place, air, terrain_around(corner, dtm, task), soil, sizes=sizes)
                for place, air, corner in zip((start, end), (first, last), ends_of_seam(key), strict=True)
            )
            below = fill_seam_soil(seam, (low, high), levels, terrain, soil, sizes=sizes)
        task.put(soil_start=below.start, soil_z=below.z)
    return facts


def make_columns(task: Task) -> Facts:
    """Mesh a tile between its seams, and fill its columns (steps 3.1 to 3.5), and its soil if any."""
    given, soil = task.parameters, soil_options(task.parameters)
    options = mesh_options(given)
    buildings, dtm = read_surroundings(task)
    model = buildings.model
    walls, sizes = find_walls(model.polygons, task)
    cover, further = read_cover(task, walls)
    names = [seam_name(key) for key in seams_of_tile(tile_key(task.name))]
    found = {result.name: result for result in task.read("seams") if result.name in names}
    sides = tuple(unpack_seam(found[name].arrays, model.numbers) for name in names)
    with task.step("3.1 plane mesh"):
        plane, complete = mesh_tile(
            _four(sides),
            model.polygons,
            walls,
            mesh_size=given.mesh_size,
            sizes=sizes,
            divide_chords=not is_flat(model.roofs).all(),
            edges=further,
            **plane_options(given),
        )
    inner = [k for k, seam in enumerate(sides) if not seam.border]
    given_columns = [(sides[k], unpack_levels(found[names[k]].arrays, model.numbers, "level")) for k in inner]
    pinched = [
        part for k, name in enumerate(names) for part in unpack_pinched(sides[k], found[name], model.numbers)
    ]
    seam_columns = tile_columns(plane, [*given_columns, *pinched])
    # A tile is on the left of its southern and its eastern seam.
    edges = find_seam_edges(plane, [Side(sides[k], left=k < 2) for k in inner], seam_columns, model.numbers)
    with task.step("3.2-3.5 columns"):
        terrain = cut_terrain(dtm, window_of(dtm))
        columns, report = _mesh(plane, terrain, buildings, options, seam_columns, sizes, task)
    _check(columns, report, solids=options.solids)
    shared = [find_vertices(plane.xy, seam.xy) for seam, _ in (*given_columns, *pinched)]
    mesh = RegionMesh(columns, np.zeros(len(plane.xy), np.int32), options.solids)
    ground, lowered = sample_dtm(terrain, plane.xy), np.empty(0, np.int64)
    if soil is not None:
        below = [unpack_soil(found[names[k]].arrays) for k in inner]
        below += [part for name in names for part in unpack_pinched_soil(found[name])]
        with task.step("soil"):
            mesh, edges, lowered = _lay_soil(mesh, ground, edges, shared, seam_columns, below, soil, sizes)
        task.put(soil=mesh.top)
        columns = mesh.columns
        given_columns = [
            (seam, join_seam(part, levels))
            for (seam, levels), part in zip(given_columns, below[: len(inner)], strict=True)
        ]
    if mesh.solids:
        lowered = np.flatnonzero(columns.z[columns.z_start[:-1] + mesh.top] < ground)
    for x, y in plane.xy[lowered].tolist():
        detail = "the terrain inside the house reaches its roof"
        task.note(Note("soil-lowered-under-roof", task.name, x, y, detail))
    edges, edge_seam = _add_straight_borders(plane, edges, sides, inner, task)
    if not complete:
        middle = (task.box[0] + task.box[2]) / 2, (task.box[1] + task.box[3]) / 2
        task.note(Note("plane-refinement-stopped", task.name, *middle, "limit on added vertices reached"))
    task.put(
        **pack_columns(columns, model.numbers),
        edge=edges.vertices,
        edge_bottom=edges.bottom,
        edge_building=edges.building,
        edge_missing=edges.missing,
        edge_seam=edge_seam,
    )
    keys = [seam_key(name) for name in names]
    lowest = [seam_ids(keys[k], levels) for k, (_, levels) in zip(inner, given_columns, strict=True)]
    for key, name in zip(keys, names, strict=True):
        ends = [ends_of_seam(key)[k] for k in found[name].facts.get("pinched", [])]
        lowest += [np.array([first_id(corner_part(corner))]) for corner in ends]
    task.put(
        shared=np.concatenate([np.empty(0, np.int32), *shared]),
        shared_id=np.concatenate([np.empty(0, np.int64), *lowest]),
    )
    cells = count_regions(mesh)
    regions = {} if soil is None else {"soil": {"depth (m)": soil.depth, "cells": cells[Region.SOIL]}}
    regions |= {"solids": {"cells": cells[Region.BUILDING]}} if options.solids else {}
    eased = {EASED: report.eased_nodes} if isinstance(report, AdaptiveReport) and report.eased_nodes else {}
    return (
        regions
        | _put_patches(task, plane, cover)
        | {
            "order": columns.order,
            "facts": {"smallest gap (m)": round(lowest_gap(columns)[0], 4)} | asdict(report),
            "counts": {
                "cells": sum(cells.values()),
                **eased,
                "triangles": len(plane.triangles),
                "columns": len(plane.xy),
            },
        }
    )


def _put_patches(task: Task, plane: PlaneMesh, cover: LandCover | None) -> Facts:
    """Write the patch of the ground of each triangle, and give their areas (m2); nothing without land cover."""
    if cover is None:
        return {}
    patch = find_patches(cover, centres(plane.xy, plane.triangles))
    task.put(**{PATCH_OF_GROUND: patch})
    open_ground = plane.building < 0
    area = np.bincount(
        patch[open_ground], np.abs(signed_areas(plane))[open_ground], len(task.parameters.cover_table) + 2
    )
    return {PATCH_OF_GROUND: np.round(area, 3).tolist()}


def _fill_corner(
    corner: Corner,
    key: Key,
    dtm: Dtm,
    buildings: NearBuildings,
    walls: NDArray[np.float64],
    sizes: SizeField | None,
    task: Task,
) -> Levels:
    """Column of a corner, of the mesher that is chosen: all seams that end there find the same one."""
    given, bounds = task.parameters, task.context.bounds
    options, model = mesh_options(given), buildings.model
    dtm = terrain_around(key, dtm, task)
    if isinstance(options, AdaptiveOptions):
        return fill_corner(corner, dtm, model.roofs, model.ids, options, sizes=sizes)
    angle = plane_options(given)["min_angle"]
    patch = mesh_patch(
        corner, model.polygons, walls, bounds, mesh_size=given.mesh_size, min_angle=angle, sizes=sizes
    )
    return fill_corner_layers(corner, patch, dtm, model.roof, model.ids, buildings.layers, bounds, options)


def _fill(
    seam: Seam,
    ends: tuple[Levels, Levels],
    dtm: Dtm,
    buildings: NearBuildings,
    sizes: SizeField | None,
    task: Task,
) -> Levels:
    """Columns of a seam within the region, of the mesher that is chosen."""
    options, model = mesh_options(task.parameters), buildings.model
    if isinstance(options, AdaptiveOptions):
        return fill_seam(seam, ends, dtm, model.roofs, model.ids, options, sizes=sizes)
    bounds = task.context.bounds
    return fill_seam_layers(seam, ends, dtm, model.roof, model.ids, buildings.layers, bounds, options)


def _fill_pinched(
    key: SeamKey,
    ends: tuple[Corner, Corner],
    dtm: Dtm,
    buildings: NearBuildings,
    walls: NDArray[np.float64],
    sizes: SizeField | None,
    soil: SoilOptions | None,
    task: Task,
) -> list[int]:
    """Fill the columns of the ends of a border in which two tiles meet alone; tell which."""
    pinched = []
    for k, (corner, place) in enumerate(zip(ends_of_seam(key), ends, strict=True)):
        if is_pinched(task.context.grid, corner):
            levels = _fill_corner(place, corner, dtm, buildings, walls, sizes, task)
            task.put(**pack_levels(levels, buildings.model.numbers, f"end{k}"))
            if soil is not None:
                below = fill_corner_soil(place, levels, terrain_around(corner, dtm, task), soil, sizes=sizes)
                task.put(**{f"end{k}_soil_start": below.start, f"end{k}_soil_z": below.z})
            pinched.append(k)
    return pinched


def _mesh(
    plane: PlaneMesh,
    dtm: Dtm,
    buildings: NearBuildings,
    options: Any,
    seam: Any,
    sizes: SizeField | None,
    task: Task,
) -> tuple[ColumnMesh, Any]:
    model = buildings.model
    if isinstance(options, AdaptiveOptions):
        return mesh_adaptive(plane, dtm, model.roofs, model.ids, options, seam=seam, sizes=sizes)
    group: NDArray[np.int32] = np.unique(buildings.group, return_inverse=True)[1].reshape(-1).astype(np.int32)
    return mesh_layers(
        plane,
        dtm,
        model,
        buildings.wall_ground,
        task.context.bounds,
        options,
        group=group,
        removed=buildings.layers,
        seam=seam,
    )


def _lay_soil(
    mesh: RegionMesh,
    terrain: NDArray[np.float64],
    edges: SeamEdges,
    shared: Sequence[NDArray[np.int32]],
    air: SeamColumns,
    soil: Sequence[Levels],
    options: SoilOptions,
    sizes: SizeField | None,
) -> tuple[RegionMesh, SeamEdges, NDArray[np.int64]]:
    """Put a tile's columns of air on columns of soil, as `add_soil` does with those that seams give.

    `shared` has the vertices of each seam, and of each end of one that is given alone; `air` has their columns,
    each once, and `soil` those of soil in the order of `shared`. Gives the columns of both, the seams with levels
    of these, and the vertices at which terrain inside a house was lowered.
    """
    vertex, first = np.unique(np.concatenate([np.empty(0, np.int32), *shared]), return_index=True)
    below = SeamColumns(vertex, take_columns(join_levels(soil), first.astype(np.int32)))
    mesh, raised, lowered = add_soil(mesh.columns, terrain, air, below, options, sizes=sizes, solids=mesh.solids)
    return mesh, replace(edges, bottom=edges.bottom + raised[edges.vertices]), lowered


def _add_straight_borders(
    plane: PlaneMesh, edges: SeamEdges, sides: Sequence[Seam], inner: Sequence[int], task: Task
) -> tuple[SeamEdges, NDArray[np.int32]]:
    """Add the borders towards tiles that are absent; also tell which side of the tile each edge is on."""
    bounds = task.context.bounds
    side = [np.repeat(inner, [len(sides[k].xy) - 1 for k in inner])]
    vertices = [edges.vertices]
    for k, seam in enumerate(sides):
        if seam.border and not _on_sides(seam.xy, bounds):
            at = find_vertices(plane.xy, seam.xy)
            vertices.append(np.sort(np.stack((at[:-1], at[1:]), axis=1), axis=1))
            side.append(np.full(len(at) - 1, k))
    pairs = np.concatenate(vertices)
    more = len(pairs) - len(edges.vertices)
    added = SeamEdges(
        pairs,
        np.concatenate((edges.bottom, np.zeros((more, 2), np.int32))),
        np.concatenate((edges.building, np.full(more, -1))),
        np.concatenate((edges.missing, np.ones(more, np.bool_))),
    )
    return added, np.concatenate(side).astype(np.int32)


def _on_sides(xy: NDArray[np.float64], bounds: Bounds) -> bool:
    """Return whether all places are on one side of the region's box."""
    return any(bool((xy[:, k % 2] == bounds[k]).all()) for k in range(4))


def _check(columns: ColumnMesh, report: Any, *, solids: bool) -> None:
    gap, inverted = lowest_gap(columns)
    if inverted:
        raise GeometryError(
            f"step 3.5: {inverted} levels do not ascend, the worst by {gap:.3g} m; raise --roof-clearance"
        )
    unmet = report.passed_edges + report.crossed_edges if isinstance(report, AdaptiveReport) else 0
    if solids and unmet:
        raise GeometryError(
            f"step 3.5: at {unmet} ends of walls between steep roofs, cells of a building cannot have the faces "
            "of what is beside it; mesh with --roofs flat, or without --solids"
        )


def _four(sides: tuple[Seam, ...]) -> Sides:
    south, east, north, west = sides
    return south, east, north, west
