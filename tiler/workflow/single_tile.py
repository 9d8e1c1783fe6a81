"""One tile of a run meshed alone, to look into a failure."""

from collections.abc import Callable
from pathlib import Path

from pipeline.data.errors import ConfigError
from stitch.tiling.grid import seams_of_tile
from tiler.config.config import Config
from tiler.engine.executor import Serial
from tiler.engine.run_context import seam_name, tile_key
from tiler.landcover.canopy_stages import canopy_stages
from tiler.landcover.cover_stages import cover_stages
from tiler.landcover.water import LEVELS, known_levels
from tiler.objects.places import refuse_bucket
from tiler.planning.model_shift import resolve_shift
from tiler.planning.own_stages import OwnStages
from tiler.planning.plan import check_sources, make_plan
from tiler.stages.alignment import shift_of_run
from tiler.stages.mesh import mesh_stages
from tiler.stages.pieces import piece_stages
from tiler.store.edit_journal import add_up, read_journal
from tiler.store.folder_lock import only_run
from tiler.store.kept import IN_STORE, need
from tiler.store.out_folder import PIECES, STORE
from tiler.words.plain_text import say_nothing
from tiler.workflow.failed_tiles import config_alone
from tiler.workflow.resolved_domain import digest_of, domain_of_run, plan_alone, take_domain
from tiler.workflow.stage_sequence import make_engine, run_city_stages


def run_alone(config: Config, tile: str, *, say: Callable[[str], None] | None = None) -> Path:
    """Mesh one tile alone, with those around it that its halo needs, in this process: to look into a failure.

    Parameters
    ----------
    config : Config
        Parameters of the whole run.
    tile : str
        Name of the tile.
    say : callable, optional
        Called with sentences that the user should read.

    Returns
    -------
    Path
        Its VTU piece, in a folder below that of the run. The cells are those of the whole run, bit for bit.

    Raises
    ------
    CityError
        What its stages raise; any other error likewise, its type kept.
    """
    check_sources(config)
    if config.water_points:
        raise ConfigError("--only with --water-points: water at the sides of its part of the region would differ")
    refuse_bucket(config.out, "--only")
    need(Path(config.out), IN_STORE)
    config, whole = resolve_shift(config, make_plan(config, say_nothing), say_nothing)
    domain, tallest = domain_of_run(config)
    shift = shift_of_run(config) if config.align and config.footprints else None
    pad, store = None, None
    if config.padded:
        alone, pad, store = plan_alone(config, whole, tile, tallest)
    else:
        alone = config_alone(config, whole, tile)
    out = Path(alone.out)
    out.mkdir(parents=True, exist_ok=True)
    with only_run(out, say or say_nothing):
        plan = make_plan(alone, say or say_nothing)
        for folder in PIECES:
            (out / folder).mkdir(exist_ok=True)
        engine = make_engine(alone, out, plan, Serial(), OwnStages(), set_aside=False)
        run_city_stages(engine, alone, add_up(read_journal(Path(config.out))), shift=shift)
        seams = [seam_name(key) for key in seams_of_tile(tile_key(tile))]
        take_domain(engine, alone, domain, pad, store)
        stages = cover_stages(alone)
        if config.covered:
            whole_store = Path(config.out) / STORE
            engine.add_parameters(levels_store=str(whole_store), levels_digest=digest_of(whole_store, LEVELS))
            stages = [known_levels() if stage.name == LEVELS else stage for stage in stages]
        engine.run(*stages, *mesh_stages(alone, domain), items={"seams": seams, "columns": [tile]})
        (pieces,) = (stage for stage in piece_stages(alone) if stage.name == "pieces")
        engine.run(*canopy_stages(alone), pieces, items={"pieces": [tile]})
    return out / "mesh" / f"{tile}.vtu"
