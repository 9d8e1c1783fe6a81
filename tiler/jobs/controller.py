"""The job of a run's driver: it runs the driver, and ends before its walltime; the next job goes on."""

import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from pipeline.data.errors import CityError, InputError
from tiler.jobs.cluster import Cluster, QueueError, read_cluster
from tiler.jobs.submission import DESCRIPTION, JOB, PARAMETERS, SCRIPT, change_record, is_cancelled, read_record
from tiler.monitoring.status import read_status

FINAL = {0: "done", 2: "wrong configuration", 3: "done but for parts"}  # exit codes after which none follows
POLL = 1.0  # s
FAILED, STOPPED = 1, 130  # exit codes; a driver ends with the second where it was asked to stop


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the job of the run in a folder, which is the one argument; returns the exit code of the job."""
    (folder,) = sys.argv[1:] if arguments is None else arguments
    try:
        return run_job(Path(folder))
    except CityError as error:
        print(f"citystitch: {error}", file=sys.stderr)
        return error.exit_code


def run_job(out: Path) -> int:
    """Run to the end of the run, or of the time of this job; returns the exit code of the job.

    The next job is submitted at once, to begin when this one has ended, for whatever reason; it is cancelled when
    there is nothing left to do.
    """
    folder = out / JOB
    cluster = read_cluster(folder / DESCRIPTION)
    end = time.monotonic() + cluster.controller.walltime - cluster.controller.margin
    received: list[int] = []  # signals
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda number, _: received.append(number))
    if is_cancelled(out) or not _makes_progress(out, cluster.controller.resubmissions):
        return FAILED
    _submit_next(out, cluster)
    words = ["run", folder / PARAMETERS, "--out", out, "--cluster", folder / DESCRIPTION]
    driver = subprocess.Popen([sys.executable, "-m", "tiler.cli.main", *map(str, words)])
    reason = ""  # why the driver was asked to stop
    while driver.poll() is None:
        if not reason and (received or time.monotonic() >= end):
            reason = "signal" if received else "time"
            if received:
                _cancel_next(out, cluster)  # now: a system that kills this job soon must not begin the next one
            driver.terminate()
        time.sleep(POLL)
    code = driver.returncode
    if code in FINAL:
        return _end(out, cluster, FINAL[code], code)
    if is_cancelled(out) or (code == STOPPED and reason != "time"):
        return _end(out, cluster, "cancelled", code)
    _say("the time of this job is nearly up" if reason == "time" else f"the driver ended with {code}")
    if not read_record(out).following and not _submit_next(out, cluster):
        return _end(out, cluster, "failed", FAILED)
    change_record(out, state="handed over")
    return 0


def count_results(out: Path) -> int:
    """Count the results of the run in a folder; 0 where none is known."""
    try:
        return sum(int(stage["done"]) for stage in read_status(out)["stages"].values())
    except InputError:
        return 0


def _makes_progress(out: Path, bound: int) -> bool:
    """Note that this job begins, and with how many results; tell whether one of the last jobs has added any."""
    results = (*read_record(out).results, count_results(out))
    change_record(out, state="running", results=results)
    earlier, last = results[: -bound - 1], results[-bound - 1 :]
    if not earlier or max(last) > max(earlier):
        return True
    _say(f"{bound + 1} jobs in a row added no result, bound {bound}; look at their logs, then submit again")
    change_record(out, state="given up")
    return False


def _submit_next(out: Path, cluster: Cluster) -> bool:
    """Submit the next job, to begin after the end of this one; tell whether that was done."""
    record = read_record(out)
    try:
        job = cluster.system.submit(out / JOB / SCRIPT, after=record.job)
    except QueueError as error:
        _say(f"no next job: {error}")
        return False
    change_record(out, jobs=(*record.jobs, job))
    if is_cancelled(out):  # meanwhile
        _cancel_next(out, cluster)
        return False
    _say(f"the next job is {job}")
    return True


def _cancel_next(out: Path, cluster: Cluster) -> None:
    record = read_record(out)
    if record.following:
        cluster.system.cancel([record.following])
        change_record(out, jobs=record.jobs[:-1])


def _end(out: Path, cluster: Cluster, state: str, code: int) -> int:
    _cancel_next(out, cluster)
    change_record(out, state=state)
    _say(f"{state}; no job follows")
    return code if code >= 0 else FAILED


def _say(text: str) -> None:
    print(f"citystitch: {time.strftime('%Y-%m-%d %H:%M:%S')}: {text}", flush=True)


if __name__ == "__main__":
    sys.exit(main())
