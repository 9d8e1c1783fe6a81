"""Between the city model and the seams: height and top of the domain become parameters of all that follows."""

import math
from pathlib import Path

from pipeline.data.errors import InputError
from tiler.config.config import Config, check_height
from tiler.config.domain_height import Domain, settle
from tiler.config.step_options import needs_region
from tiler.engine.engine import Engine
from tiler.engine.stage import REGION_ITEM
from tiler.planning.pad import Pad
from tiler.planning.region import find_pad
from tiler.stages.domain import domain_stages, layer_stages
from tiler.store.out_folder import STORE
from tiler.store.store import Store
from tiler.workflow.failed_tiles import stop_at_holes
from tiler.workflow.padded_layout import lay_pad


def settle_domain(engine: Engine, config: Config) -> Domain:
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
    engine.run(*domain_stages(config))
    stop_at_holes(engine)
    found = engine.records["domain", REGION_ITEM].facts
    domain = settle(config.domain_height, config.top, found)
    pad = find_pad(engine.context.grid, config, float(found["tallest"])) if config.padded else None
    take_domain(engine, config, domain, pad)
    return domain


def take_domain(
    engine: Engine, config: Config, domain: Domain, pad: Pad | None = None, rim_store: Path | None = None
) -> None:
    """Give the stages after the city model the height and top of the domain, and choose the layers that need them.

    Where the region has a pad, the engine goes on over both. Other parameters and errors as for `settle_domain`
    and `lay_pad`.
    """
    check_height(config, domain.height)
    engine.add_parameters(domain_height=domain.height, top_elevation=domain.top)
    if pad is not None:
        lay_pad(engine, config, domain, pad, rim_store)
        return
    engine.run(*layer_stages(config, domain))
    stop_at_holes(engine)


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
    return settle(config.domain_height, config.top, facts), float(facts["tallest"])
