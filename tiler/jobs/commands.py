"""The command line of runs on clusters: `citystitch submit | cancel | logs`, and what `status` tells of jobs."""

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pipeline.errors import ConfigError, InputError
from tiler.objects.places import in_bucket, place
from tiler.words.plain_text import printable

EVERY = 1.0  # s between two looks at a log that is followed
JOB_HELP = "number of a job, or folder of its run"

Command = Callable[[str, Callable[[argparse.Namespace], int], str], argparse.ArgumentParser]


def add_job_commands(command: Command, add_parameters: Callable[[argparse.ArgumentParser], None]) -> None:
    """Add the commands; `add_parameters` adds point clouds and parameters of a run."""
    submit = command("submit", _submit, "submit a run to a cluster's batch system: SLURM, PBS, SGE or LSF")
    submit.add_argument("--dry-run", action="store_true", help="print the scripts, and submit nothing")
    submit.add_argument(
        "--array",
        type=int,
        default=0,
        metavar="N",
        help="N jobs that share the tiles through the folder alone, instead of a controller and its workers",
    )
    add_parameters(submit)
    cancel = command("cancel", _cancel, "cancel the job of a run and its workers; what is done is kept")
    cancel.add_argument("job", metavar="JOB", help=JOB_HELP)
    logs = command("logs", _logs, "print what the jobs of a run have printed")
    logs.add_argument("job", metavar="JOB", help=JOB_HELP)
    logs.add_argument("--workers", action="store_true", help="those of workers too")
    logs.add_argument("-f", "--follow", action="store_true", help="go on as long as there is more, until Ctrl-C")


def find_run(job: str) -> Path:
    """Folder of a run, by itself or by the number of its job; InputError for an unknown number."""
    if not job[:1].isdigit() or Path(job).is_dir():
        return place(job)
    from tiler.jobs.submission import find_folder

    return find_folder(job)


def describe_job(out: Path) -> dict[str, Any] | None:
    """Tell how the job of a run stands, as `tiler.jobs.submission.tell_job`; None without a job."""
    if in_bucket(out) or not (out / "job").is_dir():  # nothing of clusters is imported for a run without
        return None
    from tiler.jobs.submission import tell_job

    return tell_job(out)


def job_line(job: dict[str, Any]) -> str:
    """Write one line on a job."""
    words = [f"job {job['job']} ({job['type']}): {job['state']}"]
    if job.get("error"):
        words.append(f"its queue does not answer: {job['error']}")
    else:
        words.append(f"in the queue {job['queue'] or 'no more'}")
    words += [f"{job['array']} elements"] if job["array"] else []
    words += [f"{job['workers']} worker jobs"] if job["workers"] and not job["array"] else []
    words += [f"after {', '.join(job['earlier'])}"] if job["earlier"] else []
    return ", ".join(words)


def _submit(options: argparse.Namespace) -> int:
    from tiler.config.config import make_config
    from tiler.interface.api import with_file
    from tiler.jobs.submission import submit

    if options.array < 0 or options.array > 100_000:
        raise ConfigError(f"--array {options.array}: 1 to 100000 elements expected")
    config = make_config(with_file(vars(options)))
    if not options.dry_run:
        from tiler.planning.plan import check_sources

        check_sources(config)
    print(submit(config, array=options.array, dry_run=options.dry_run))
    return 0


def _cancel(options: argparse.Namespace) -> int:
    from tiler.jobs.submission import cancel, find_folder

    print(printable(cancel(find_folder(options.job))))
    return 0


def _logs(options: argparse.Namespace) -> int:
    from tiler.jobs.submission import find_folder, list_logs

    out = find_folder(options.job)
    read: dict[Path, int] = {}
    while True:
        for path in list_logs(out, workers=options.workers):
            _print_new(path, read)
        if not options.follow:
            return 0
        time.sleep(EVERY)


def _print_new(path: Path, read: dict[Path, int]) -> None:
    """Print what a log has gained since it was last read."""
    try:
        with path.open("rb") as file:
            file.seek(read.get(path, 0))
            content = file.read()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check its permissions") from error
    if path not in read:
        print(f"== {printable(str(path))}")
    read[path] = read.get(path, 0) + len(content)
    for line in content.decode(errors="replace").splitlines():
        print(printable(line), flush=True)
