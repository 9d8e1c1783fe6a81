"""Who watches every run: ``progress.json`` and ``events.jsonl`` in its folder, and those of its caller."""

from pathlib import Path

from tiler.config.config import Config
from tiler.monitoring.events import EventLog, begin_file
from tiler.monitoring.progress import Announce, RunProgress, command_line
from tiler.monitoring.watchers import RunStart, Watchers
from tiler.objects.places import in_bucket
from tiler.planning.context import make_layout
from tiler.planning.plan import Plan
from tiler.planning.region import foresee_pad
from tiler.workflow.out_folder import EVENTS
from tiler.workflow.own_stages import OwnStages, list_stages, stages_of_pad

NOT_ALONE = ("fit",)  # stages of tiles and seams that `tiler.workflow.single_tile.run_alone` does without


def begin_watching(
    config: Config,
    out: Path,
    plan: Plan,
    own: OwnStages,
    watchers: Watchers,
    *,
    announce: Announce | None = None,
    shown: Path | None = None,
) -> RunProgress:
    """Begin to tell how far a run is, with all stages that are known from the start.

    Parameters
    ----------
    config : Config
        Parameters of the run.
    out : Path
        Its folder.
    plan : Plan
        Its region, tiles and files.
    own : OwnStages
        Stages of the user's own.
    watchers : Watchers
        Those that the caller brings; the files' are added.
    announce : callable, optional
        As for `RunProgress`.
    shown : Path, optional
        Folder on a disk where the events are written first, of a run in a bucket.

    Raises
    ------
    OutputError
        If one of the files cannot be written.
    """
    stages = [*list_stages(config), *own.stages]
    expected = {stage.name: (stage.scope, len(plan.layout.boxes(stage.scope))) for stage in stages}
    layout = plan.layout
    if wide := stages_of_pad(config):
        padded = make_layout(foresee_pad(plan.grid, config), {}, identity="")
        expected |= {s.name: (s.scope, len(padded.boxes(s.scope))) for s in stages if s.name in wide}
        if all(isinstance(width, float) for width in config.pad):  # else it is a guess, and told when it is known
            layout = padded
    command = "" if own.stages else command_line(config)  # stages of the user's own are not given by a command
    totals = {name: total for name, (_, total) in expected.items()}
    progress = RunProgress(out, config, totals, announce=announce, command=command)
    watchers.add(progress)
    if in_bucket(out) and shown is not None:
        from tiler.objects.watch import BucketEvents

        watchers.add(BucketEvents(out / EVENTS, shown))
    else:
        watchers.add(EventLog(out / EVENTS, begin_file(out / EVENTS)))
    start = RunStart(
        out=out,
        command=command,
        bounds=plan.region.bounds,
        crs=plan.region.crs,
        tile_size=config.tile_size_or_default,
        workers=0 if config.on_cluster else max(config.workers, 1),
        tiles=layout.tiles,
        seams=layout.seams,
        expected=expected,
        whole=frozenset({*NOT_ALONE, *(stage.name for stage in own.stages)}),
    )
    watchers.begin(start)
    return progress
