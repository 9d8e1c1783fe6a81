"""Between the city model and the seams: height and top of the domain become parameters of all that follows."""

import math
from dataclasses import replace
from pathlib import Path

from pipeline.data.errors import InputError
from stitch.tiling.grid import Bounds
from tiler.config.config import Config, check_height
from tiler.config.domain_height import Domain, resolve_height
from tiler.config.step_options import needs_region
from tiler.engine.engine import Engine
from tiler.engine.run_context import make_layout, pack_tiles
from tiler.engine.stage import REGION_ITEM
from tiler.planning.plan import Plan
from tiler.planning.region import Pad, find_pad, pad_grid
from tiler.stages.approach import RIM, approach_stages, known_rim
from tiler.stages.domain import domain_stages, layer_stages
from tiler.store.out_folder import STORE
from tiler.store.store import Store
from tiler.workflow.failed_tiles import as_error, bounds_around, config_alone, run_whole


def resolve_domain(engine: Engine, config: Config) -> Domain:
    """Measure the city model, and decide height and top of the domain, which later stages take as parameters.

    Parameters
    ----------
    engine : Engine
        Engine, `run_city_stages` done.
    config : Config
        Parameters of the run.

    Raises
    ------
    ConfigError
        If the height follows from buildings and there are none, or it is too low for the vertical spacing.
    HolesError
        If an item was set aside.
    """
    run_whole(engine, *domain_stages(config))
    found = engine.records["domain", REGION_ITEM].facts
    domain = resolve_height(config.domain_height, config.top, found)
    pad = find_pad(engine.context.grid, config, float(found["tallest"])) if config.padded else None
    take_domain(engine, config, domain, pad)
    return domain


def take_domain(
    engine: Engine, config: Config, domain: Domain, pad: Pad | None = None, rim_store: Path | None = None
) -> None:
    """Give the stages after the city model the height and top of the domain, and choose the layers that need them.

    Where the region has a pad, the engine goes on over both. Other parameters and errors as for `resolve_domain`
    and `lay_pad`.
    """
    check_height(config, domain.height)
    engine.add_parameters(domain_height=domain.height, top_elevation=domain.top)
    if pad is not None:
        lay_pad(engine, config, domain, pad, rim_store)
        return
    run_whole(engine, *layer_stages(config, domain))


def domain_of_run(config: Config) -> tuple[Domain, float]:
    """Take height and top of the domain of a whole run, for one of its tiles alone.

    Parameters
    ----------
    config : Config
        Parameters of the whole run; where height and top follow from all of the region, its store has them.

    Returns
    -------
    Domain
        Height and top.
    float
        Height of the tallest building (m); NaN where nothing follows from it.

    Raises
    ------
    InputError
        If it has not.
    """
    if not needs_region(config):
        return Domain(config.expected_height, None), math.nan
    try:
        facts = Store(Path(config.out) / STORE).attributes("domain", REGION_ITEM)["facts"]
    except InputError as error:
        raise InputError(
            f"{config.out}: the height of the domain follows from the whole region, and its run has not come that "
            f"far ({error}); run it without --only first"
        ) from None
    return resolve_height(config.domain_height, config.top, facts), float(facts["tallest"])


def lay_pad(engine: Engine, config: Config, domain: Domain, pad: Pad, rim_store: Path | None = None) -> None:
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
    rim_store : Path, optional
        For a tile that is run alone: the store of the whole run, whose rim it takes.

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
    if rim_store is not None:
        engine.add_parameters(rim_store=str(rim_store), rim_digest=digest_of(rim_store, RIM))
        stages = [known_rim() if stage.name == RIM else stage for stage in stages]
    engine.run(*stages)
    if engine.set_aside:
        raise as_error(engine.failed()[0])
    engine.lay_out(replace(layout, tiles=core.tiles), wider)
    run_whole(engine, *layer_stages(config, domain))
    engine.lay_out(layout, wider)


def pad_plan(plan: Plan, pad: Pad) -> Plan:
    """Put the pad into the plan of a run: its region, tiles and layout are those of the mesh."""
    layout = make_layout(pad.grid, dict(plan.layout.files), identity=plan.layout.identity)
    return replace(plan, region=replace(plan.region, bounds=pad.grid.bounds), grid=pad.grid, layout=layout)


def plan_alone(config: Config, whole: Plan, tile: str, tallest: float) -> tuple[Config, Pad, Path]:
    """Plan a run of the tiles around one of a padded region.

    Parameters
    ----------
    config : Config
        Parameters of the whole run.
    whole : Plan
        Its plan, of the region without its pad.
    tile : str
        Name of the tile.
    tallest : float
        Height of the tallest building (m).

    Returns
    -------
    Config
        Parameters of that run: its bounds are the part of the region that is needed.
    Pad
        The region in its pad, with the tiles around the one.
    Path
        Store of the whole run.

    Raises
    ------
    ConfigError
        If there is no such tile.
    """
    pad = find_pad(whole.grid, config, tallest)
    wide = pad_plan(whole, pad)
    alone = config_alone(config, wide, tile)
    box = bounds_around(wide, tile)
    grid = pad_grid(whole.grid, box, mesh_size=config.mesh_size, open_size=config.graded_size)
    alone = replace(alone, bounds=core_part(box, pad.core, config.tile_size_or_default))
    return alone, Pad(pad.core, grid), Path(config.out) / STORE


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


def digest_of(store: Path, stage: str) -> str:
    """Digest of the result of a stage of the region in a run's store; InputError where there is none yet."""
    try:
        return Store(store).describe(stage, REGION_ITEM)[1]
    except InputError as error:
        what = "the ground of the pad" if stage == RIM else f"the stage {stage}"
        raise InputError(
            f"{store}: {what} follows from the whole region, and its run has not come that far ({error}); run it "
            "without --only first"
        ) from None
