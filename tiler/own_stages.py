"""Stages of the user's own in a run: what they may be called, and what they may declare."""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from tiler.config import Config
from tiler.domain import Domain
from tiler.engine import Engine
from tiler.options import derived_parameters
from tiler.stage import Stage
from tiler.stages.city import first_round, house_stage, later_round, model_stage, shape_stage
from tiler.stages.citymodel import city_model_stages
from tiler.stages.domain import domain_stages, layer_stages
from tiler.stages.inputs import input_stages
from tiler.stages.mesh import mesh_stages
from tiler.stages.pieces import piece_stages


@dataclass(frozen=True)
class OwnStages:
    """Stages and parameters that a run has besides ours.

    Attributes
    ----------
    stages : tuple of Stage
        Run after ours.
    parameters : mapping
        What they may declare besides the parameters of the run.
    """

    stages: tuple[Stage, ...] = ()
    parameters: Mapping[str, Any] = dataclasses.field(default_factory=dict)


def list_stages(config: Config) -> list[Stage]:
    """List the stages of a run in their order, as if its clusters of houses were simplified once."""
    stages = [*input_stages(config), house_stage(config), *first_round(config), shape_stage(0)]
    stages += [*later_round(config, 1), model_stage(config, 0), *domain_stages(config)]
    stages += [*layer_stages(config, Domain(config.expected_height, None)), *city_model_stages()]
    return [*stages, *mesh_stages(config), *piece_stages(config)]


def check_own(config: Config, stages: Sequence[Stage], parameters: Mapping[str, Any] | None) -> OwnStages:
    """Take stages and parameters of the user's own.

    Raises
    ------
    ValueError
        If a stage has the name of one of ours, or a parameter that of one of the run.
    """
    own = OwnStages(tuple(stages), dict(parameters or {}))
    # Rounds of simplification are numbered: near-0, near-1, and so on.
    names = {stage.name.rstrip("0123456789") for stage in list_stages(config)}
    taken = sorted(stage.name for stage in own.stages if stage.name.rstrip("0123456789") in names)
    if taken:
        raise ValueError(f"stage {', '.join(taken)}: a stage of citystitch has such a name; name yours otherwise")
    given = {*dataclasses.asdict(config), *derived_parameters(config), "footprints_identity", "top_elevation"}
    clash = sorted(own.parameters.keys() & given)
    if clash:
        raise ValueError(f"parameter {', '.join(clash)}: the run has one of this name; name yours otherwise")
    return own


def run_own_stages(engine: Engine, own: OwnStages) -> None:
    """Run them; all of ours were run."""
    engine.run(*own.stages)
