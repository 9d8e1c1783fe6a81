"""The plan of a run: region, tiles and files, from headers alone."""

import math
import re
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from itertools import count

from pipeline.data.errors import ConfigError, InputError
from pipeline.data.notes import Note
from stitch.tiling.grid import TileGrid, make_grid, tiles_present
from tiler.cityinput.sources import CLOUD
from tiler.config.config import Config, idle_parameters
from tiler.config.zones import Zones
from tiler.engine.run_context import choose_tiles, make_layout, tile_key
from tiler.engine.stage import FileItem, Layout
from tiler.georeference.crs import boxes_meet, crs_text
from tiler.georeference.operation import Operation
from tiler.landcover.cover_table import read_table
from tiler.objects.places import is_missing, place
from tiler.objects.requests import trust_addresses
from tiler.planning.establish_georeference import FOOTPRINTS, Georeference, establish_georeference, find_inexact
from tiler.planning.lod_zones import check_generalised, describe_absent, read_zones
from tiler.planning.model_inputs import (
    describe_others,
    headers_of_region,
    headers_of_tiles,
    identify_file,
    order_headers,
    read_headers,
    read_other_headers,
    turn_frames,
)
from tiler.planning.region import (
    Region,
    check_points,
    check_region,
    check_sizes,
    choose_bounds,
    describe_overhang,
    describe_pad,
    foresee_pad,
)
from tiler.pointclouds.clouds import CloudHeader, count_shares, find_clouds, read_header
from tiler.vectors.layers import describe_layer


@dataclass(frozen=True)
class Survey:
    """What headers alone tell of a run, before anything is listed by name."""

    region: Region  # what is meshed
    headers: list[CloudHeader]  # all point-cloud files that can be read
    clouds: list[CloudHeader]  # those of them that have points and meet the region
    messages: list[str]  # sentences that the user should read
    unreadable: dict[str, str]  # files left out, with the reason
    grid: TileGrid  # tiles, those without any point cloud left out
    georeference: Georeference  # where the region lies, and how coordinates of its input get there
    # The same, and those of the pad where there is one; where its width follows from the tallest building, that of
    # an expected one counts.
    meshed: TileGrid
    zones: Zones  # of detail, in the region's CRS; none where none are asked for


@dataclass(frozen=True)
class Plan(Survey):
    """What is known before any point is read: a survey, and the items of every scope by name."""

    layout: Layout


def check_sources(config: Config) -> None:
    """Raise ConfigError if neither a point cloud nor a city model nor terrain is named."""
    if not config.sources:
        raise ConfigError(
            "no point cloud: give files, globs or folders, as in `citystitch run tiles/*.laz`, or a city model "
            "with --buildings, or rasters with --terrain"
        )


def _refuse_missing(config: Config) -> None:
    """Raise InputError if a file that only a later stage reads is not there."""
    given = {"land_cover": config.land_cover, "trees": (config.trees,), "generalised": (config.generalised,)}
    for parameter, names in given.items():
        for path in map(place, filter(None, names)):
            if is_missing(path):
                raise InputError(f"{path}: no such file; check the path of {parameter}")


def make_plan(config: Config, say: Callable[[str], None]) -> Plan:
    """Find out what a run has to do, from headers alone; `say` is called with sentences that the user should read.

    Raises
    ------
    CityError
        If an input is missing or unreadable, or does not fit the others.
    """
    trust_addresses(False)  # whatever this process did before
    table = read_table(config)  # refuses one that is wrong before anything is read
    found = survey_inputs(config, say)
    if table:
        say(f"land cover makes patches of the ground, in this order: {', '.join(row.patch for row in table)}")
    layout = make_layout(found.grid, file_items(found.clouds), identity=found.region.crs)
    return Plan(**vars(found), layout=layout)


def leave_out(plan: Plan, tiles: Collection[str], files: Collection[str]) -> Plan:
    """Plan the same run without some tiles and files, by name: the others keep their results."""
    present = tiles_present(plan.grid).copy()
    for tile in tiles:
        key = tile_key(tile)
        present[key.i - plan.grid.first.i, key.j - plan.grid.first.j] = False
    grid = replace(plan.grid, present=present)
    kept = {name: item for name, item in plan.layout.files.items() if name not in files}
    return replace(plan, grid=grid, layout=make_layout(grid, kept, identity=plan.layout.identity))


def survey_inputs(config: Config, say: Callable[[str], None]) -> Survey:
    """Read headers, and choose region and tiles; parameters and errors as for `make_plan`.

    Notes
    -----
    Tiles stay arrays: a country of half a million tiles takes no longer than its headers.
    """
    check_sources(config)
    _refuse_missing(config)
    paths = find_clouds(config.pointcloud) if config.pointcloud else []
    headers, unreadable = read_headers(paths, read_header, skip=config.skip_unreadable)
    others, unread = read_other_headers(config)
    unreadable |= unread
    found = find_georeference(config, order_headers([*headers, *others]))
    headers, messages = found.clouds, list(found.messages)
    extent = headers_of_region(headers)
    region = Region(choose_bounds(config.bounds, extent), crs_text(found.crs), config.tile_size_or_default)
    with_points = [header for header in headers if header.kind == CLOUD]
    check_region(region, config.largest_size, with_points, kind="open" if config.open_size else "mesh")
    check_sizes(region, config)
    clouds = [header for header in headers if header.n_points and boxes_meet(header.bounds, region.bounds)]
    whole = make_grid(
        region.bounds,
        tile_size=config.tile_size_or_default,
        mesh_size=config.mesh_size,
        open_size=config.open_size,
    )
    grid = choose_tiles(whole, [header.bounds[:4] for header in headers_of_tiles(clouds)])
    present = tiles_present(grid)
    n_tiles, n_absent = int(present.sum()), int((~present).sum())
    if config.smoother == "fem" and config.mesher == "layered" and n_tiles > 1:
        side = math.ceil(max(region.bounds[2] - region.bounds[0], region.bounds[3] - region.bounds[1]))
        raise ConfigError(
            f"smoother = fem knows nothing of seams, and the region has {n_tiles} tiles; take smoother = columns, "
            f"or --tile-size {2 * side}"
        )
    messages += [*describe_overhang(region.bounds, headers_of_tiles(headers)), *idle_parameters(config)]
    zones = read_zones(config, region, messages.append)
    check_generalised(config, zones)
    messages += describe_absent(zones, region) if zones else []
    messages += describe_pad(region.bounds, with_points) if config.padded else []
    if n_absent:
        messages.append(f"{n_absent} of {n_absent + n_tiles} tiles have no point cloud and are left out")
    if not config.has_buildings:
        messages.append("no footprints given: the mesh has terrain only")
    for message in messages:
        say(message)
    return Survey(region, headers, clouds, messages, unreadable, grid, found, foresee_pad(grid, config), zones)


def find_georeference(config: Config, headers: Sequence[CloudHeader]) -> Georeference:
    """Establish where the region lies, of headers of clouds and of the footprints' layer."""
    check_points(headers)
    layer = describe_layer(place(config.footprints), config.layer) if config.footprints else None
    crs, extent = (None, None) if layer is None else (layer.crs, layer.extent)
    found = establish_georeference(config, headers, crs, extent)
    inexact = find_inexact(found, config.clearance)
    words = [_describe_inexact(found.operations[note.subject], note.subject, config) for note in inexact]
    void = [
        Note("cloud-void-header-box", header.path.name, detail="the box in the header is void; that of the points")
        for header in headers
        if header.box_of_points
    ]
    if void:
        who, its = ("1 point cloud has", "its") if len(void) == 1 else (f"{len(void)} point clouds have", "their")
        words.append(f"{who} no sound box in {its} header; the points were read for it")
    others, told = describe_others(found.clouds, config)
    notes = [*found.notes, *void, *inexact, *told]
    messages = [*found.messages, *words, *others]
    return replace(found, clouds=turn_frames(found.clouds), messages=messages, notes=notes)


def _describe_inexact(operation: Operation, subject: str, config: Config) -> str:
    aligned = config.align and subject == FOOTPRINTS
    end = "--align moves them by what the points show" if aligned else "the run ends with exit code 3"
    return f"{subject}: {operation.exact}, worse than the clearance of {config.clearance:g} m; {end}"


def file_items(clouds: Sequence[CloudHeader]) -> dict[str, FileItem]:
    """Name files by their stem, those of one stem by a number behind it, and shares by one behind a full stop."""
    items, taken = dict[str, FileItem](), set[str]()
    for header in clouds:
        stem = re.sub(r"[^\w-]", "_", header.path.stem)
        name = next(name for k in count(1) if (name := f"{stem}-{k}" if k > 1 else stem) not in taken)
        taken.add(name)
        n = count_shares(header)
        for k in range(n):
            share = name if n == 1 else f"{name}.{k:0{len(str(n - 1))}d}"
            whole = str(header.path), header.bounds[:4], identify_file(header), header.frame
            items[share] = FileItem(*whole, (k, n))
    return items
