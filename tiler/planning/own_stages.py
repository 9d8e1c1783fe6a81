"""Stages of the user's own in a run: what they may be called, and what they may declare."""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from tiler.config.config import Config
from tiler.config.domain_height import Domain
from tiler.config.step_options import derived_parameters
from tiler.engine.engine import Engine
from tiler.engine.stage import Stage
from tiler.landcover.canopy_stages import canopy_stages, tree_file_stages
from tiler.landcover.cover_stages import cover_file_stages, cover_stages
from tiler.landcover.water_points import water_point_stages
from tiler.stages.alignment import alignment_stages
from tiler.stages.approach import approach_stages
from tiler.stages.city import first_round, house_stage, later_round, model_stage, shape_stage
from tiler.stages.citymodel import city_model_stages
from tiler.stages.domain import domain_stages, layer_stages
from tiler.stages.inputs import EDITED, fill_stage, input_stages, lake_stage
from tiler.stages.mesh import mesh_stages
from tiler.stages.pieces import fit_stage, piece_stages

CORE_STAGE = "model"  # one that has the items of the region without its pad


@dataclass(frozen=True)
class OwnStages:
    """Stages and parameters that a run has besides ours."""

    stages: tuple[Stage, ...] = ()  # run after ours
    # What they may declare besides the parameters of the run.
    parameters: Mapping[str, Any] = dataclasses.field(default_factory=dict)


def list_stages(config: Config) -> list[Stage]:
    """List the stages of a run in their order, as if it had no lakes, and simplified clusters of houses once."""
    stages = [
        *input_stages(config),
        fill_stage(),
        house_stage(config),
        *first_round(config),
        shape_stage(config, 0),
    ]
    stages += [*later_round(config, 1), model_stage(config, 0), *domain_stages(config)]
    stages += [*approach_stages(config), *layer_stages(config, Domain(config.expected_height, None))]
    stages += [*city_model_stages(config), fit_stage(config)]
    stages += alignment_stages(config) if config.footprints else []
    return [*stages, *of_cover(config), *mesh_stages(config), *piece_stages(config)]


def of_cover(config: Config) -> list[Stage]:
    """List the stages of land cover and trees."""
    files = [*water_point_stages(config), *cover_file_stages(config), *tree_file_stages(config)]
    return [*files, *canopy_stages(config), *cover_stages(config)]


def stages_of_pad(config: Config) -> set[str]:
    """Names of the stages that are run over region and pad; none without a pad."""
    if not config.padded:
        return set()
    stages = [*approach_stages(config), *cover_stages(config), *mesh_stages(config), *piece_stages(config)]
    return {stage.name for stage in stages}


def check_own(config: Config, stages: Sequence[Stage], parameters: Mapping[str, Any] | None) -> OwnStages:
    """Take stages and parameters of the user's own; ValueError if one has the name of one of ours."""
    own = OwnStages(tuple(stages), dict(parameters or {}))
    # Rounds of simplification are numbered: near-0, near-1, and so on.
    names = {stage.name.rstrip("0123456789") for stage in [*list_stages(config), lake_stage()]} | {EDITED}
    taken = sorted(stage.name for stage in own.stages if stage.name.rstrip("0123456789") in names)
    if taken:
        raise ValueError(f"stage {', '.join(taken)}: a stage of citystitch has such a name; name yours otherwise")
    given = {*dataclasses.asdict(config), *derived_parameters(config), "footprints_identity", "top_elevation"}
    given |= {"footprints_frame", "footprints_shift", "refinements", "zones", "edits"}
    given |= {"core_bounds", "rim_store", "rim_digest", "land_cover_identity", "cover_table", "cover_reach"}
    given |= {"levels_store", "levels_digest", "trees_identity", "generalised_identity"}
    clash = sorted(own.parameters.keys() & given)
    if clash:
        raise ValueError(f"parameter {', '.join(clash)}: the run has one of this name; name yours otherwise")
    return own


def run_own_stages(engine: Engine, own: OwnStages, config: Config) -> None:
    """Run them; all of ours were run.

    Where the region has a pad, those that read what is made of both, or another one that does, are run over both;
    the others, which may read points and terrain, over the region alone.
    """
    wide = stages_of_pad(config)
    if not wide:
        engine.run(*own.stages)
        return
    names: set[str] = set()
    while more := {s.name for s in own.stages if wide & {read.stage for read in s.reads}} - names:
        names |= more
        wide |= more
    both = engine.layout, engine.context
    engine.lay_out(*engine.laid_out(CORE_STAGE))
    engine.run(*(stage for stage in own.stages if stage.name not in names))
    engine.lay_out(*both)
    engine.run(*(stage for stage in own.stages if stage.name in names))
