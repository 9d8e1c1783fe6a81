"""From the city model to the seams of a padded region: the larger layout, and the ground of the pad."""

from dataclasses import dataclass, replace
from pathlib import Path

from pipeline.errors import InputError
from stitch.grid import Bounds, TileGrid
from tiler.config import Config
from tiler.context import make_layout, pack_tiles
from tiler.domain import Domain
from tiler.engine import Engine
from tiler.out_folder import STORE
from tiler.pad import Pad, pad_grid
from tiler.planning import Plan
from tiler.quarantine import as_error, stop_at_holes
from tiler.stage import REGION_ITEM
from tiler.stages.approach import RIM, approach_stages, known_rim
from tiler.stages.domain import layer_stages
from tiler.store import Store

CORE_STAGE = "model"  # one that has the items of the region without its pad


@dataclass(frozen=True)
class Alone:
    """What a tile that is run alone takes of the run of the whole region.

    Attributes
    ----------
    pad : Pad
        The region in its pad, with the tiles around the one alone.
    store : Path
        Store of the whole run, which has the rim.
    """

    pad: Pad
    store: Path


def lay_pad(engine: Engine, config: Config, domain: Domain, pad: Pad, alone: Alone | None = None) -> None:
    """Go on over region and pad: lay the ground of the pad, and choose the layers of roofs over it.

    Parameters
    ----------
    engine : Engine
        Engine, the city model done, over the region.
    config : Config
        Parameters of the run.
    domain : Domain
        Height and top of the domain.
    pad : Pad
        The region in its pad.
    alone : Alone, optional
        For a tile that is run alone: the rim is that of the whole run.

    Raises
    ------
    HolesError
        If layers could not be chosen.
    CityError
        What the ground of the pad fails of: all of the mesh would go without it.
    """
    core, context = engine.layout, engine.context
    layout = make_layout(pad.grid, dict(core.files), identity=core.identity)
    wider = replace(context, bounds=pad.grid.bounds, present=pack_tiles(pad.grid), open_size=config.graded_size)
    engine.add_parameters(core_bounds=pad.core)
    engine.lay_out(layout, wider)
    stages = approach_stages(config)
    if alone is not None:
        engine.add_parameters(rim_store=str(alone.store), rim_digest=_digest_rim(alone.store))
        stages = [known_rim() if stage.name == RIM else stage for stage in stages]
    engine.run(*stages)
    if engine.set_aside:
        raise as_error(engine.failed()[0])
    engine.lay_out(replace(layout, tiles=core.tiles), wider)
    engine.run(*layer_stages(config, domain))
    stop_at_holes(engine)
    engine.lay_out(layout, wider)


def pad_plan(plan: Plan, pad: Pad) -> Plan:
    """Put the pad into the plan of a run: its region, tiles and layout are those of the mesh."""
    layout = make_layout(pad.grid, dict(plan.layout.files), identity=plan.layout.identity)
    return replace(plan, region=replace(plan.region, bounds=pad.grid.bounds), grid=pad.grid, layout=layout)


def pad_around(pad: Pad, core: TileGrid, box: Bounds, config: Config) -> Pad:
    """Take the part of a padded region within a box on lines of its tiles, for a tile alone."""
    grid = pad_grid(core, box, mesh_size=config.mesh_size, open_size=config.graded_size)
    return Pad(pad.core, grid)


def core_part(box: Bounds, core: Bounds, tile_size: float) -> Bounds:
    """Part of a region that a tile alone needs, given the box around it; some of the region is always taken.

    Examples
    --------
    >>> core_part((0.0, 0.0, 500.0, 500.0), (-900.0, 300.0, 400.0, 900.0), 100.0)
    (0.0, 300.0, 400.0, 500.0)
    >>> core_part((0.0, 0.0, 500.0, 500.0), (700.0, 0.0, 1900.0, 900.0), 100.0)
    (700.0, 0.0, 800.0, 500.0)
    """
    low, high = [], []
    for k in range(2):
        first, last = max(box[k], core[k]), min(box[k + 2], core[k + 2])
        if last - first < tile_size / 2:
            before = box[k] + box[k + 2] < core[k] + core[k + 2]
            first = core[k] if before else max(core[k + 2] - tile_size, core[k])
            last = min(core[k] + tile_size, core[k + 2]) if before else core[k + 2]
        low.append(first)
        high.append(last)
    return low[0], low[1], high[0], high[1]


def store_of_run(config: Config) -> Path:
    """Store of the run of the whole region."""
    return Path(config.out) / STORE


def _digest_rim(store: Path) -> str:
    try:
        return Store(store).describe(RIM, REGION_ITEM)[1]
    except InputError as error:
        raise InputError(
            f"{store}: the ground of the pad follows from the whole region, and its run has not come that far "
            f"({error}); run it without --only first"
        ) from None
