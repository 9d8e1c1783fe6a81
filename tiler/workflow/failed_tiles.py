"""What a run does about items that were set aside: which tiles go missing, and how to look into one alone."""

import dataclasses
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.data.errors import CityError, ConfigError
from stitch.tiling.grid import Bounds, Key
from tiler.config.config import Config, with_absolute_inputs
from tiler.config.config_file import write_config
from tiler.engine.engine import Engine
from tiler.engine.failures import SetAside
from tiler.engine.run_context import SHARED, tile_key, tile_name
from tiler.engine.stage import Box, Scope, Stage
from tiler.objects.places import absolute
from tiler.planning.plan import Plan, leave_out
from tiler.store.atomic import replacing
from tiler.store.out_folder import CONFIG, command_alone
from tiler.words.stage_groups import place_of_item

ONLY = "only"  # folder below a run's, for tiles that are run alone
AROUND = 2  # tiles on every side that a tile alone is run with, for clusters of houses and terrain


@dataclass(frozen=True)
class Missing:
    """Tiles that a run has left out, by name, each with what failed."""

    tiles: dict[str, SetAside] = dataclasses.field(default_factory=dict)  #: why each tile is missing
    files: frozenset[str] = frozenset()  #: files that could not be read, by the name of their item
    others: tuple[SetAside, ...] = ()  #: what failed without taking a tile with it: stages of the user's own, fit


class HolesError(Exception):
    """Items of the city model failed: the region must be planned again without their tiles."""


def run_whole(engine: Engine, *stages: Stage, items: Mapping[str, Collection[str]] | None = None) -> None:
    """Run stages as `Engine.run`, and raise `HolesError` if anything was set aside so far."""
    engine.run(*stages, items=items)
    if engine.set_aside:
        raise HolesError


def leave_holes(plan: Plan, missing: Missing, engine: Engine) -> tuple[Plan, Missing]:
    """Plan a region again without the tiles of what was set aside on the way to its city model.

    Notes
    -----
    A file that fails takes the tiles that share area with its box: towards them the region then has a border, as
    towards tiles without any point cloud.

    Raises
    ------
    CityError
        If no tile is left: the first failure.
    """
    failed = engine.failed()
    lost = {one.file for one in failed if one.scope is Scope.FILE}
    files = frozenset(name for name, item in plan.layout.files.items() if item.path in lost)
    tiles = {one.name: one for one in failed if one.scope is Scope.TILE}
    for one in failed:
        if one.scope is Scope.FILE:
            tiles = dict.fromkeys(_tiles_below(plan, plan.layout.files[one.name].box), one) | tiles
    if not plan.layout.tiles.keys() - tiles.keys():
        raise as_error(failed[0])
    found = Missing(missing.tiles | tiles, missing.files | files)
    return leave_out(plan, tiles, files), found


def find_missing(plan: Plan, missing: Missing, engine: Engine) -> Missing:
    """Add the tiles that failed on the way from the city model to their pieces.

    Raises
    ------
    CityError
        If no tile is left: the first failure.
    """
    failed = engine.failed()
    lost = [tile for tile in sorted(plan.layout.tiles) if ("pieces", tile) not in engine.records]
    if len(lost) == len(plan.layout.tiles):
        raise as_error(failed[0])
    tiles = {tile: _cause(engine, tile) for tile in lost}
    causes = set(map(id, tiles.values()))
    others = tuple(one for one in failed if id(one) not in causes)
    return Missing(missing.tiles | tiles, missing.files, others)


def as_error(failed: SetAside) -> CityError:
    """The error of an item that was set aside."""
    return CityError(f"{place_of_item(failed.stage, failed.scope.value, failed.name)}: {failed.reason}")


def describe_missing(missing: Missing, out: Path) -> dict[str, Any]:
    """What ``run.json`` says of it."""
    return {
        "missing": {
            tile: one.as_json() | {"command": command_alone(out, tile)}
            for tile, one in sorted(missing.tiles.items())
        },
        "set_aside": [one.as_json() for one in missing.others],
    }


def save_config(config: Config, out: Path) -> None:
    """Write the parameters of a run into its folder, paths absolute: any place will do to run it from."""
    saved = dataclasses.replace(
        with_absolute_inputs(config),
        out=absolute(config.out),
        scheduler="",  # which no file may name
        tls_ca="",
        tls_cert="",
        tls_key="",
        overwrite=False,
    )
    with replacing(out / CONFIG) as part:
        part.write_text(write_config(saved), encoding="utf-8", errors="surrogateescape")


def config_alone(config: Config, plan: Plan, tile: str) -> Config:
    """Parameters of a run of the tiles around one: in this process, into a folder of its own.

    Raises
    ------
    ConfigError
        If the region has no such tile.
    """
    if tile not in plan.layout.tiles:
        some = ", ".join(sorted(plan.layout.tiles)[:5])
        raise ConfigError(f"--only {tile}: the region has no such tile; its tiles are {some} and so on")
    out = str(Path(config.out) / ONLY / tile)
    return dataclasses.replace(
        config, bounds=bounds_around(plan, tile), out=out, workers=0, scheduler="", overwrite=False
    )


def bounds_around(plan: Plan, tile: str) -> Bounds:
    """Box of a tile and `AROUND` more on every side, within the region (m): on the lines of its grid."""
    grid, key = plan.grid, tile_key(tile)
    low, high = [], []
    for axis, (lines, k) in enumerate(zip(grid.lines, key, strict=True)):
        at = k - grid.first[axis]
        low.append(float(lines[max(at - AROUND, 0)]))
        high.append(float(lines[min(at + 1 + AROUND, len(lines) - 1)]))
    return low[0], low[1], high[0], high[1]


def _cause(engine: Engine, tile: str) -> SetAside:
    """Follow a tile without a piece back to what failed."""
    item = ("pieces", tile)
    while item in engine.blocked:
        item = engine.blocked[item]
    return engine.set_aside[item]


def _tiles_below(plan: Plan, box: Box) -> list[str]:
    """List the tiles that share area with a box, sorted."""
    columns, rows = (
        np.flatnonzero(np.minimum(box[axis + 2], lines[1:]) - np.maximum(box[axis], lines[:-1]) > SHARED)
        for axis, lines in enumerate(plan.grid.lines)
    )
    first = plan.grid.first
    names = [tile_name(Key(first.i + i, first.j + j)) for i in columns.tolist() for j in rows.tolist()]
    return sorted(name for name in names if name in plan.layout.tiles)
