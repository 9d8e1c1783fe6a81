"""What the job of a run's driver does: run, hand over to a next job before its time is up, know when to end."""

import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from types import FrameType

from pipeline.errors import CityError
from tiler.jobs.jobqueue import JOB
from tiler.jobs.queues import QUEUES, STOP_SIGNAL, QueueError
from tiler.jobs.submission import (
    SCRIPT,
    TABLE,
    JobRecord,
    count_results,
    now,
    read_record,
    run_words,
    write_record,
)
from tiler.jobs.table import Cluster, read_cluster

FINAL = {0: "done", 2: "wrong configuration", 3: "done but for parts"}  # exit codes after which none follows
POLL = 1.0  # s
FAILED, STOPPED = 1, 130  # exit codes; a driver ends with the second where it was asked to stop


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the job of the run in a folder; returns the exit code of the job.

    Parameters
    ----------
    arguments : sequence of str, optional
        The folder; those of the process if not given.
    """
    (place,) = sys.argv[1:] if arguments is None else arguments
    try:
        return Controller(Path(place)).run()
    except CityError as error:
        print(f"citystitch: {error}", file=sys.stderr)
        return error.exit_code


class Controller:
    """The job of a driver.

    The next job is submitted before the driver is asked to stop, to begin when this one has ended: a driver that
    stops too slowly, and is killed, has its successor in the queue already.

    Parameters
    ----------
    out : Path
        Folder of the run.
    """

    def __init__(self, out: Path) -> None:
        self._out = out
        self._table: Cluster = read_cluster(out / JOB / TABLE)
        record = read_record(out)
        if record is None:
            raise CityError(f"{out}: has no job; citystitch submit begins one")
        self._record: JobRecord = record
        self._queue = QUEUES[self._table.type]
        self._warned = self._told_to_end = False

    def run(self) -> int:
        """Run to the end of the run, or of the time of this job."""
        end = time.monotonic() + self._table.controller.walltime - self._table.controller.margin
        for number in (getattr(signal, f"SIG{STOP_SIGNAL}"), signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._handle)
        if self._is_cancelled() or not self._makes_progress():
            return FAILED
        driver = subprocess.Popen([sys.executable, "-m", "tiler.cli.main", *run_words(self._out)])
        handed_over = False
        while driver.poll() is None:
            if self._told_to_end:
                driver.terminate()
                self._told_to_end = False
            if not handed_over and (self._warned or time.monotonic() >= end):
                _say("the time of this job is nearly up; the next one goes on")
                handed_over = self._submit_next(after=True)
                driver.terminate()
                end = float("inf")
            time.sleep(POLL)
        return self._finish(driver.wait(), handed_over=handed_over)

    def _finish(self, code: int, *, handed_over: bool) -> int:
        if code in FINAL:
            return self._end(FINAL[code], code, handed_over=handed_over)
        if self._is_cancelled() or (code == STOPPED and not handed_over):
            return self._end("cancelled", code, handed_over=handed_over)
        if not handed_over:
            _say(f"the driver ended with {code}")
            if not self._submit_next(after=False):
                return self._end("failed", FAILED, handed_over=False)
        return 0

    def _end(self, state: str, code: int, *, handed_over: bool) -> int:
        if handed_over:
            self._queue.cancel([self._record.job])
        self._write(state=state)
        _say(f"{state}; no job follows")
        return code if code >= 0 else FAILED

    def _makes_progress(self) -> bool:
        """Count the jobs in a row that add nothing; tell whether there may be one more."""
        results = count_results(self._out)
        again = bool(self._record.earlier)
        idle = self._record.idle + 1 if again and results <= self._record.best else 0
        self._write(state="running", best=max(results, self._record.best), idle=idle)
        bound = self._table.controller.resubmissions
        if idle <= bound:
            return True
        _say(f"{idle} jobs in a row added no result, bound {bound}; look at their logs, then submit again")
        self._write(state="given up")
        return False

    def _submit_next(self, *, after: bool) -> bool:
        """Submit the next job, to begin after the end of this one or at once; tell whether that was done."""
        if self._is_cancelled():
            return False
        this = self._record.job
        try:
            job = self._queue.submit(self._out / JOB / SCRIPT, after=this if after else "")
        except QueueError as error:
            _say(f"no next job: {error}")
            return False
        _say(f"the next job is {job}")
        self._write(job=job, earlier=(*self._record.earlier, this), state="handed over")
        return True

    def _is_cancelled(self) -> bool:
        record = read_record(self._out)
        return record is not None and record.state == "cancelled"

    def _write(self, **values: object) -> None:
        self._record = self._record.change(**values)
        write_record(self._out, self._record)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if number in (signal.SIGTERM, signal.SIGINT):
            self._told_to_end = True
        else:
            self._warned = True


def _say(text: str) -> None:
    print(f"citystitch: {now()}: {text}", flush=True)


if __name__ == "__main__":
    sys.exit(main())
