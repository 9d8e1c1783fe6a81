"""One run a folder: live owners refused, dead ones taken over, with locks of the system and without."""

import errno
import fcntl
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest

from pipeline.data.errors import ConfigError, InputError, OutputError
from tiler.store import folder_lock
from tiler.store.folder_lock import LOCK, Owner, is_held, only_run

ROOT = Path(__file__).resolve().parents[3]
NO_LOCKS = """
import errno, fcntl
def refuse(*_):
    raise OSError(errno.ENOLCK, "No locks available")
fcntl.flock = refuse
"""
HOLDER = """
import sys, time
from pathlib import Path
from tiler.store.folder_lock import only_run
with only_run(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(600)
"""


@pytest.fixture(params=["locks", "no locks"])
def locks(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> bool:
    """Whether the file system has locks; where not, asking for one is an error, as on some network mounts."""
    if request.param == "no locks":

        def refuse(*_: Any) -> None:
            raise OSError(errno.ENOLCK, "No locks available")

        monkeypatch.setattr(fcntl, "flock", refuse)
    return bool(request.param == "locks")


@pytest.fixture(autouse=True)
def fast(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(folder_lock, "BEAT", 0.1)
    monkeypatch.setattr(folder_lock, "SILENCE", 2.0)


@contextmanager
def holder(folder: Path, *, locks: bool) -> Iterator["subprocess.Popen[str]"]:
    """Another process that holds a folder."""
    code = HOLDER if locks else NO_LOCKS + HOLDER
    command = [sys.executable, "-c", code, str(folder)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT)
    assert process.stdout is not None
    try:
        assert process.stdout.readline() == "held\n"
        yield process
    finally:
        process.kill()
        process.communicate()


def elsewhere(folder: Path, **others: Any) -> Owner:
    """Put the lock file of an owner on another machine into a folder."""
    owner = replace(folder_lock.this_process(), host="far", place="other boot", **others)
    (folder / LOCK).write_text(json.dumps(asdict(owner)))
    return owner


def test_a_live_owner_is_refused_and_a_killed_one_taken_over(tmp_path: Path, locks: bool) -> None:
    with holder(tmp_path, locks=locks) as process:
        assert is_held(tmp_path)
        with (
            pytest.raises(ConfigError, match=rf"another run is at work there \(process {process.pid} on "),
            only_run(tmp_path),
        ):
            pass
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
        assert (tmp_path / LOCK).exists()
        assert not is_held(tmp_path)
        said: list[str] = []
        begin = time.monotonic()
        with only_run(tmp_path, said.append):
            assert is_held(tmp_path)
        assert time.monotonic() - begin < 1.5  # not listened for
    assert not is_held(tmp_path)
    assert list(tmp_path.iterdir()) == []
    assert any("has no locks; a second run is kept out by the heartbeat" in words for words in said) is not locks
    assert any("which is dead" in words for words in said) is not locks


def test_a_process_of_the_same_number_is_another_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any) -> None:
        raise OSError(errno.EOPNOTSUPP, "Operation not supported")

    monkeypatch.setattr(fcntl, "flock", refuse)
    here = folder_lock.this_process()
    (tmp_path / LOCK).write_text(json.dumps(asdict(here)))
    assert is_held(tmp_path)
    (tmp_path / LOCK).write_text(json.dumps(asdict(replace(here, began="1"))))
    assert not is_held(tmp_path)
    with only_run(tmp_path):
        pass


def test_an_owner_elsewhere_is_listened_to(tmp_path: Path, locks: bool) -> None:
    """Locks of a mount may hold for one machine only."""
    elsewhere(tmp_path)
    assert is_held(tmp_path)
    stop = threading.Event()

    def touch() -> None:
        while not stop.wait(0.1):
            os.utime(tmp_path / LOCK)

    beat = threading.Thread(target=touch)
    beat.start()
    with pytest.raises(ConfigError, match=r"at work there \(process \d+ on far\)"), only_run(tmp_path):
        pass
    stop.set()
    beat.join()
    said: list[str] = []
    with only_run(tmp_path, said.append):
        pass
    assert "listening for 2 s" in said[0]
    assert "taken over from process" in said[1]
    assert "on far, which is dead" in said[1]


def test_an_owner_elsewhere_that_is_silent_holds_nothing(tmp_path: Path, locks: bool) -> None:
    elsewhere(tmp_path)
    os.utime(tmp_path / LOCK, (time.time() - 3, time.time() - 3))
    assert not is_held(tmp_path)


def test_of_two_at_the_same_moment_one_goes_on(tmp_path: Path, locks: bool) -> None:
    refused, ran = [], []
    start, end = threading.Barrier(2), threading.Barrier(2)

    def take() -> None:
        start.wait()
        try:
            with only_run(tmp_path):
                ran.append(1)
                end.wait(20)
        except ConfigError as error:
            refused.append(error)
            end.wait(20)

    threads = [threading.Thread(target=take) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert (len(ran), len(refused)) == (1, 1)


def test_the_heart_beats(tmp_path: Path, locks: bool) -> None:
    with only_run(tmp_path):
        first = (tmp_path / LOCK).stat().st_mtime_ns
        end = time.monotonic() + 60
        while (tmp_path / LOCK).stat().st_mtime_ns <= first:
            assert time.monotonic() < end
            time.sleep(0.01)


def test_a_lock_file_that_says_nothing_is_free(tmp_path: Path, locks: bool) -> None:
    for text in ("", "{", "[]", '{"host": 3}'):
        (tmp_path / LOCK).write_text(text)
        assert not is_held(tmp_path)
        with only_run(tmp_path):
            pass


def test_what_is_no_lock_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / LOCK).symlink_to(tmp_path / "other")
    with pytest.raises(ConfigError, match="is a symbolic link"), only_run(tmp_path):
        pass
    with pytest.raises(InputError, match="cannot be read"):
        is_held(tmp_path)
    assert not (tmp_path / "other").exists()
    (tmp_path / LOCK).unlink()
    (tmp_path / LOCK).mkdir()
    with pytest.raises(OutputError, match="cannot be written"), only_run(tmp_path):
        pass
