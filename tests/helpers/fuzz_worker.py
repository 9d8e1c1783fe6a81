"""The command line in a process apart, one call a line: a crash or a hang of a library ends that process alone."""

import contextlib
import faulthandler
import io
import json
import os
import select
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryFile
from types import TracebackType
from typing import Any, Self


@dataclass(frozen=True)
class Outcome:
    """What a call came to."""

    code: int  #: exit code; minus the signal's number where the process was ended by one; -1000 where it hung
    #: what was printed
    out: str
    err: str
    seconds: float  #: how long it took


HUNG = -1000


class Worker:
    """A process that calls the command line again and again, and is started anew where one call ended it.

    Parameters
    ----------
    folder : Path
        Where it works: an empty folder, which should stay so.
    limit : float
        Seconds that a call may take.
    """

    def __init__(self, folder: Path, *, limit: float) -> None:
        self.folder, self.limit = folder, limit
        self._process: subprocess.Popen[str] | None = None
        self._said = TemporaryFile()  # noqa: SIM115  # closed with this

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._end()
        self._said.close()

    def call(self, *arguments: str) -> Outcome:
        """Call the command line; the time that a new process takes to start does not count."""
        process = self._process or self._start()
        assert process.stdin is not None
        assert process.stdout is not None
        with contextlib.suppress(BrokenPipeError):  # it has ended already, which its silence tells
            process.stdin.write(json.dumps(arguments) + "\n")
            process.stdin.flush()
        begin = time.monotonic()
        ready, _, _ = select.select([process.stdout], [], [], self.limit)
        seconds = time.monotonic() - begin
        if not ready:
            self._said.seek(0)
            where = self._said.read().decode(errors="replace")[-5000:]
            self._end()
            return Outcome(HUNG, "", f"no answer in {self.limit:g} s\n{where}", seconds)
        answer = process.stdout.readline()
        if not answer:
            code = process.wait()
            self._end()
            return Outcome(code, "", f"the process ended with {code}", seconds)
        return Outcome(**json.loads(answer), seconds=seconds)

    def _start(self) -> "subprocess.Popen[str]":
        places = os.pathsep.join((str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH", "")))
        self._process = subprocess.Popen(
            [sys.executable, "-m", "tests.helpers.fuzz_worker", f"{self.limit * 0.9}"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._said,
            text=True,
            cwd=self.folder,
            env=os.environ | {"PYTHONPATH": places, "PYTHONDONTWRITEBYTECODE": "1"},
        )
        assert self._process.stdout is not None
        self._process.stdout.readline()
        return self._process

    def _end(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.communicate()
            self._process = None


def serve() -> None:
    """Answer calls, one JSON list of arguments a line, until there are no more."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what libraries print by themselves is none of the answers
    from tiler.cli.main import main

    print("ready", file=answers, flush=True)
    for line in sys.stdin:
        faulthandler.dump_traceback_later(float(sys.argv[1]))  # where a call hangs
        print(json.dumps(answer(main, json.loads(line))), file=answers, flush=True)
        faulthandler.cancel_dump_traceback_later()


def answer(main: Any, arguments: list[str]) -> dict[str, Any]:
    """Call the command line, and tell its exit code and what it printed."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = main(arguments)
        except SystemExit as stop:  # of argparse
            code = int(stop.code or 0)
        except BaseException as error:
            code, _ = 70, print(f"Traceback: {type(error).__name__}: {error}", file=sys.stderr)
    return {"code": code, "out": out.getvalue()[:10_000], "err": err.getvalue()[:10_000]}


if __name__ == "__main__":
    serve()
