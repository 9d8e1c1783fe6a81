"""Who watches every run: ``progress.json`` and ``events.jsonl`` in its folder, and those of its caller."""

import shutil
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from pipeline.data.errors import OutputError
from tiler.config.config import Config
from tiler.engine.run_context import make_layout
from tiler.engine.task import Record
from tiler.engine.watcher import RunStart, Watcher
from tiler.monitoring.event_log import EventLog
from tiler.monitoring.events import begin_file
from tiler.monitoring.progress import ProgressFile, command_line
from tiler.monitoring.watchers import Watchers
from tiler.planning.own_stages import OwnStages, list_stages, stages_of_pad
from tiler.planning.plan import Plan
from tiler.planning.region import foresee_pad
from tiler.store.atomic import replacing
from tiler.store.out_folder import EVENTS

NOT_ALONE = ("fit",)  # stages of tiles and seams that `tiler.workflow.single_tile.run_alone` does without
PUT_EVERY = 60.0  # s between two puts of the events of a run in a bucket
PUT_BYTES = 16 * 2**20  # size up to which they are put before the end


class CopiedEvents(EventLog):
    """`EventLog` of a run in a bucket: a file on a disk, put at the end, and once a minute while it is small.

    Parameters
    ----------
    target : Path
        The object.
    folder : Path
        Where the file is.
    """

    def __init__(self, target: Path, folder: Path) -> None:
        self._local, self._target, self._put = folder / target.name, target, time.monotonic()
        super().__init__(self._local, begin_file(self._local))

    def end(self, status: str, error: str = "") -> None:
        """Write how the run ended, and put the file."""
        super().end(status, error)
        self._copy()

    def _write(self) -> None:
        super()._write()
        if time.monotonic() - self._put >= PUT_EVERY and self._local.stat().st_size <= PUT_BYTES:
            self._put = time.monotonic()
            with suppress(OutputError):  # tried again; the run learns by its results
                self._copy()

    def _copy(self) -> None:
        with replacing(self._target) as part:
            shutil.copyfile(self._local, part)


class LeaseWatch(Watcher):
    """Ends a run that has lost its lease.

    Parameters
    ----------
    check : callable
        Raises OutputError if it has, as `tiler.store.folder_lock.only_run` gives it.
    """

    def __init__(self, check: Callable[[], None]) -> None:
        self._check = check

    def done(self, stage: str, n_done: int, total: int, record: Record) -> None:
        """Look at the lease whenever an item is done."""
        self._check()


def begin_watching(
    config: Config,
    out: Path,
    plan: Plan,
    own: OwnStages,
    watchers: Watchers,
    *,
    shown: Path | None,
) -> None:
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
    shown : Path or None
        Folder on a disk where events are written: that of the run, or another one, of a run in a bucket; None for
        no events.

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
    watchers.add(ProgressFile(out, config, command=command))
    events = out / EVENTS
    if shown == out:
        watchers.add(EventLog(events, begin_file(events)))
    elif shown is not None:
        watchers.add(CopiedEvents(events, shown))
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
