"""Disks that refuse: full, over quota, read-only, broken; the run ends with one clear line and is gone on with."""

import errno
import io
import json
import os
import subprocess
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.helpers.campaigns import rounds
from tests.helpers.sparse_city import SparseCity, make_city, start
from tests.runs.test_run import hashes
from tiler.cli.main import main
from tiler.workflow.run import run

ERRORS = (errno.ENOSPC, errno.EROFS, errno.EDQUOT, errno.EIO)
CALLS = ("open", "mkdir", "replace")  # what a run writes with: each is counted
MB = 2**20


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> SparseCity:
    return make_city(tmp_path_factory.mktemp("small"), 2, buildings=12)


class Disk:
    """A folder whose disk refuses all from the nth call of a kind on."""

    def __init__(self, folder: Path, kind: str, n: int, number: int) -> None:
        self._folder, self._kind, self._n, self._error = str(folder), kind, n, number
        self.calls: Counter[str] = Counter()
        self.refused = False

    def check(self, kind: str, path: Any) -> None:
        if not isinstance(path, (str, os.PathLike)) or not os.fspath(path).startswith(self._folder):
            return
        self.calls[kind] += 1
        self.refused |= kind == self._kind and self.calls[kind] > self._n
        if self.refused:
            raise OSError(self._error, os.strerror(self._error), os.fspath(path))


@contextmanager
def refusing(disk: Disk) -> Iterator[None]:
    """Put a disk between this process and the system."""
    original: dict[str, Callable[..., Any]] = {"open": io.open, "mkdir": os.mkdir, "replace": os.replace}

    def open_file(file: Any, mode: str = "r", *others: Any, **named: Any) -> Any:
        if set(mode) & set("wax+"):
            disk.check("open", file)
        return original["open"](file, mode, *others, **named)

    def mkdir(path: Any, *others: Any, **named: Any) -> None:
        disk.check("mkdir", path)
        original["mkdir"](path, *others, **named)

    def replace(source: Any, target: Any, **named: Any) -> None:
        disk.check("replace", target)
        original["replace"](source, target, **named)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(io, "open", open_file)
        patch.setattr("builtins.open", open_file)
        patch.setattr(os, "mkdir", mkdir)
        patch.setattr(os, "replace", replace)
        yield


def command(city: SparseCity, out: Path) -> list[str]:
    return city.command(out)[3:]


@pytest.fixture(scope="module")
def calls(small: SparseCity, tmp_path_factory: pytest.TempPathFactory) -> Counter[str]:
    """Calls of a run to the disk, by kind."""
    out = tmp_path_factory.mktemp("count") / "out"
    disk = Disk(out, "none", 0, 0)
    with refusing(disk):
        run(small.config(out))
    assert set(CALLS) <= set(disk.calls)
    return disk.calls


SEEDS = [0, *(pytest.param(seed, marks=pytest.mark.long) for seed in rounds([1], range(2, 6)))]


@pytest.mark.timeout(600)
@pytest.mark.parametrize("seed", SEEDS)
def test_a_disk_that_refuses_ends_the_run_with_one_line(
    small: SparseCity, calls: Counter[str], tmp_path: Path, seed: int, capsys: pytest.CaptureFixture[str]
) -> None:
    rng = np.random.default_rng(seed)
    out = tmp_path / "out"
    for number in ERRORS:
        kind = CALLS[rng.integers(len(CALLS))]
        # The first calls make the folder itself: then it is refused as --out.
        disk = Disk(out, kind, int(rng.integers(12, calls[kind])), number)
        capsys.readouterr()
        with refusing(disk):
            code = main(command(small, out))
        if not disk.refused:  # what was done before left fewer calls
            assert code == 0
            continue
        words = capsys.readouterr().err
        assert code == 1, words
        (line,) = words.splitlines()
        assert line.startswith("citystitch: ")
        assert os.strerror(number) in line
        assert "free" in line or "permissions" in line
    assert main(command(small, out)) == 0
    assert hashes(out) == small.hashes


def test_a_disk_that_is_full_at_once_is_told(small: SparseCity, tmp_path: Path) -> None:
    """Nothing was left out of the region for it: a full disk is not a fault of tiles."""
    for kind in CALLS:
        out = tmp_path / kind
        with refusing(Disk(out, kind, 20, errno.ENOSPC)):
            assert main(command(small, out)) == 1
        record = json.loads((out / "run.json").read_text())
        assert record["status"] == "running"  # which it could no longer change
        assert "missing" not in record
        assert main(command(small, out)) == 0
        assert hashes(out) == small.hashes


@contextmanager
def small_disk(place: Path) -> Iterator[Callable[[int], None]]:
    """Mount a file system in memory; gives a function that sets its size (bytes)."""
    place.mkdir()
    made = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=1m", "none", str(place)], check=False, capture_output=True
    )
    if made.returncode:
        pytest.skip("mounting a file system needs rights that this user has not")
    try:
        yield lambda size: _resize(place, size)
    finally:
        subprocess.run(["umount", "-l", str(place)], check=True)


def _resize(place: Path, size: int) -> None:
    subprocess.run(["mount", "-o", f"remount,size={size}", str(place)], check=True)


@pytest.mark.long
@pytest.mark.timeout(900)
def test_a_disk_that_fills_up_under_workers(small: SparseCity, tmp_path: Path) -> None:
    size = sum(-(-path.stat().st_size // 4096) * 4096 for path in small.out.rglob("*") if path.is_file())
    with small_disk(tmp_path / "disk") as resize:
        out = tmp_path / "disk" / "out"
        for share in (0.1, 0.4, 0.7, 0.95):
            resize(int(share * size))
            log = tmp_path / "log.txt"
            process = start(small.command(out, "--workers", "2"), log)
            assert process.wait(300) == 1, log.read_text()
            words = log.read_text()
            assert "Traceback" not in words
            last = words.splitlines()[-1]
            assert last.startswith("citystitch: ")
            assert "No space left on device" in last
        resize(4 * size)
        assert start(small.command(out, "--workers", "2"), log).wait(300) == 0, log.read_text()
        assert hashes(out) == small.hashes
