"""One tile of a run meshed alone, to look into a failure."""

from collections.abc import Callable
from pathlib import Path

from stitch.tiling.grid import seams_of_tile
from tiler.config.config import Config
from tiler.engine.executor import Serial
from tiler.engine.run_context import seam_name, tile_key
from tiler.objects.places import refuse_bucket
from tiler.planning.model_shift import settle_shift
from tiler.planning.plan import check_sources, make_plan
from tiler.stages.alignment import shift_of_run
from tiler.stages.mesh import mesh_stages
from tiler.stages.own_stages import OwnStages
from tiler.stages.pieces import piece_stages
from tiler.store.folder_lock import only_run
from tiler.store.out_folder import PIECES
from tiler.words.plain_text import say_nothing
from tiler.workflow.failed_tiles import config_alone
from tiler.workflow.settled_domain import domain_of_run, plan_alone, take_domain
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
    refuse_bucket(config.out, "--only")
    config, whole = settle_shift(config, make_plan(config, say_nothing), say_nothing)
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
        run_city_stages(engine, alone, shift=shift)
        seams = [seam_name(key) for key in seams_of_tile(tile_key(tile))]
        take_domain(engine, alone, domain, pad, store)
        engine.run(*mesh_stages(alone, domain), items={"seams": seams, "columns": [tile]})
        (pieces,) = (stage for stage in piece_stages() if stage.name == "pieces")
        engine.run(pieces, items={"pieces": [tile]})
    return out / "mesh" / f"{tile}.vtu"
