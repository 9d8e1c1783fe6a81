"""The stages of a run in their order, over an engine."""

import dataclasses
from collections.abc import Collection
from pathlib import Path
from types import SimpleNamespace

from tiler.citymodels.tables import NEAR_ARRAYS, find_changed
from tiler.config.config import Config
from tiler.config.step_options import derived_parameters
from tiler.engine.engine import Engine
from tiler.engine.executor import Executor
from tiler.engine.failures import Policy
from tiler.engine.run_context import RunContext, pack_tiles
from tiler.engine.stage import REGION_ITEM, Box
from tiler.engine.watcher import Watcher
from tiler.landcover.canopy_stages import canopy_stages, tree_file_stages
from tiler.landcover.cover_stages import cover_file_stages, cover_stages
from tiler.landcover.cover_table import read_table
from tiler.landcover.water_points import water_point_stages
from tiler.objects.places import identify, place
from tiler.planning.own_stages import CORE_STAGE, OwnStages
from tiler.planning.plan import Plan
from tiler.planning.refinements import read_refinements
from tiler.stages.alignment import alignment_stages, shift_of
from tiler.stages.city import first_round, house_stage, later_round, member_stage, model_stage, shape_stage
from tiler.stages.citymodel import city_model_stages
from tiler.stages.inputs import EDITED, edited_tiles, fill_stage, input_stages, lake_stage
from tiler.stages.mesh import mesh_stages
from tiler.stages.pieces import fit_stage, piece_stages
from tiler.stages.surroundings import cover_reach
from tiler.store.edit_journal import Edits
from tiler.store.out_folder import STORE
from tiler.store.store import Store
from tiler.workflow.failed_tiles import run_whole
from tiler.workflow.resolved_domain import resolve_domain

NO_EDITS = Edits()
MODEL = "model"


def run_stages(
    engine: Engine,
    config: Config,
    edits: Edits = NO_EDITS,
    *,
    former: Path | None = None,
    city_files: bool = True,
) -> int:
    """Run all stages in their order; returns how often clusters of houses were simplified.

    Parameters
    ----------
    engine : Engine
        Engine over the region's items.
    config : Config
        Parameters of the run.
    edits : Edits
        What edits of its folder come to.
    former : Path, optional
        Store of which that of the engine was a copy when the run began.
    city_files : bool
        Whether the files of the city models are written.
    """
    rounds = run_city_stages(engine, config, edits)
    if former is not None:
        engine.changes = _find_changes(engine, Store(former))
    domain = resolve_domain(engine, config)
    # Nothing waits for these: first in a call, so last of what may run, they fill the time in which others wait.
    of_model = [fit_stage(config), *(city_model_stages(config) if city_files else ()), *canopy_stages(config)]
    if config.footprints and not config.align:
        of_model = [*alignment_stages(config), *of_model]
    meshed = [*cover_stages(config), *mesh_stages(config, domain), *piece_stages(config)]
    if config.padded:
        engine.watcher.laid_out(engine.layout)
        both = engine.layout, engine.context
        engine.lay_out(*engine.laid_out(CORE_STAGE))
        engine.run(*of_model)
        engine.lay_out(*both)
        engine.run(*meshed)
    else:
        engine.run(*of_model, *meshed)
    # Beside a tile without a piece, others were written as if they had a neighbour.
    while lost := [name for stage, name in engine.set_aside if stage == "pieces"]:
        for tile in lost:
            engine.give_up(("pieces", tile), ("columns", tile))
        engine.run(*piece_stages(config))
    return rounds


def _find_changes(engine: Engine, former: Store) -> dict[tuple[str, str], tuple[str, list[Box]]]:
    """Find where the city models of tiles that were made anew differ from those of another store."""
    found = {}
    for tile in engine.items[MODEL][1].names:
        if (MODEL, tile) in engine.records and engine.records.made(MODEL, tile)[1] and former.has(MODEL, tile):
            old, new = (store.read(MODEL, tile, names=NEAR_ARRAYS)[0] for store in (former, engine.store))
            found[MODEL, tile] = former.describe(MODEL, tile)[1], find_changed(old, new)
    return found


def run_city_stages(
    engine: Engine, config: Config, edits: Edits = NO_EDITS, *, shift: tuple[float, float] | None = None
) -> int:
    """Run the stages up to the simplified city model; parameters and result as for `run_stages`.

    A shift of the footprints (m) that is known is taken, and not measured.

    Raises
    ------
    HolesError
        If an item was set aside.
    """
    if shift is not None:
        engine.add_parameters(footprints_shift=shift)
    elif config.align and config.footprints:
        _align(engine, config)
    files = [*water_point_stages(config), *cover_file_stages(config), *tree_file_stages(config)]
    # The terrain of tiles with deep lakes waits for the coarse level, that of all others does not.
    some: dict[str, Collection[str]] = {"lakes": ()}
    if edited := bool(edits.boxes):
        engine.add_parameters(edits=dataclasses.asdict(edits))
        some[EDITED] = edited_tiles(engine.layout.tiles, edits)
    run_whole(engine, *input_stages(config, edited=edited), *files, lake_stage(), fill_stage(), items=some)
    if deep := engine.records["coarse", REGION_ITEM].facts["deep"]:
        run_whole(engine, lake_stage(), fill_stage(), items={"lakes": deep, "terrain": deep})
    run_whole(engine, house_stage(config))
    run_whole(engine, *first_round(config), shape_stage(config, 0))
    last = 0
    while True:
        run_whole(engine, *later_round(config, last + 1))
        if not engine.records[f"join-{last + 1}", REGION_ITEM].facts["joined"]:
            break
        last += 1
        run_whole(engine, member_stage(last), shape_stage(config, last))
    run_whole(engine, model_stage(config, last))
    return last + 1


def _align(engine: Engine, config: Config) -> None:
    """Measure the shift between footprints and roofs before footprints are used, and take it from now on."""
    wanted = {"points", "footprints"}
    before = [stage for stage in input_stages(config) if stage.name in wanted]
    run_whole(engine, *before, *alignment_stages(config))
    engine.add_parameters(footprints_shift=shift_of(engine.records["shift", REGION_ITEM].facts))


def make_engine(
    config: Config,
    out: Path,
    plan: Plan,
    executor: Executor,
    own: OwnStages,
    watcher: Watcher | None = None,
    *,
    set_aside: bool = True,
) -> Engine:
    """Make the engine of a run over the items of its plan; failures are set aside, or end it."""
    context = RunContext(
        plan.region.bounds,
        plan.region.crs,
        config.tile_size_or_default,
        config.mesh_size,
        pack_tiles(plan.grid),
        config.open_size,
    )
    footprints = place(config.footprints) if config.footprints else None
    parameters = SimpleNamespace(
        **dataclasses.asdict(config),
        **own.parameters,
        **derived_parameters(config),
        footprints_identity=identify(footprints) if footprints else "",
        footprints_frame=dataclasses.astuple(plan.georeference.footprints),
        footprints_shift=(0.0, 0.0),
        refinements=read_refinements(config, plan.region, plan.zones),
        zones=plan.zones,
        cover_table=tuple(map(dataclasses.astuple, read_table(config))),
        land_cover_identity=tuple(map(identify, map(place, config.land_cover))),
        trees_identity=identify(place(config.trees)) if config.trees else "",
        generalised_identity=identify(place(config.generalised)) if config.generalised else "",
        cover_reach=cover_reach(config) if config.covered else 0.0,
    )
    return Engine(
        out / STORE,
        plan.layout,
        parameters=parameters,
        context=context,
        executor=executor,
        watcher=watcher,
        policy=Policy(retries=config.retries, set_aside=set_aside),
    )
