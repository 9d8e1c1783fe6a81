"""Loss of power: what is left of files that no disk had yet is found by its checksums, and made anew."""

import errno
import os
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.data.errors import OutputError
from tests.helpers.campaigns import keep_outcome, rounds
from tests.helpers.towns import Town, make_town
from tests.runs.test_run import hashes
from tiler.store.atomic import replacing
from tiler.store.out_folder import MANIFEST_PATH, RUN_RECORD
from tiler.workflow.run import run

SYNCED = {RUN_RECORD, MANIFEST_PATH}  # these the disk has before anything goes on
SEEDS = [0, *(pytest.param(seed, marks=pytest.mark.long) for seed in rounds(range(1, 2), range(2, 10)))]


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Town:
    return make_town(tmp_path_factory.mktemp("town"))


def lose(path: Path, rng: np.random.Generator) -> None:
    """Leave of a file what journals do: its length in zeros, nothing, or its beginning and zeros."""
    size = path.stat().st_size
    kept = (0, int(rng.integers(size // 4096 + 1)) * 4096)[rng.integers(2)]
    path.write_bytes(b"" if rng.random() < 0.4 else path.read_bytes()[:kept] + bytes(max(size - kept, 0)))


@pytest.mark.parametrize("finished", [True, False])
@pytest.mark.parametrize("seed", SEEDS)
def test_files_that_no_disk_had_are_made_anew(town: Town, tmp_path: Path, seed: int, finished: bool) -> None:
    rng = np.random.default_rng(seed)
    out = town.copy(tmp_path / "out")
    if not finished:
        (out / RUN_RECORD).write_text('{"schema": 1, "status": "running"}')
        (out / MANIFEST_PATH).unlink()
    files = [path for path in out.rglob("*") if path.is_file() and str(path.relative_to(out)) not in SYNCED]
    files.sort(key=lambda path: (path.stat().st_mtime_ns, str(path)))
    last = files[-int(rng.integers(40, len(files) + 1)) :]
    gone = [path for path in last if rng.random() < 0.5]  # the disk takes files in an order of its own
    for path in gone:
        lose(path, rng)
    record = run(town.config(out))
    assert record["exit_code"] == 0
    assert hashes(out) == hashes(town.out)
    keep_outcome("damage", what="loss of power", seed=seed, kinds={"last written files": len(gone)})
    if finished:
        assert record["notes"]["damaged-artefact"]["count"] > 0


def test_the_record_and_the_manifest_wait_for_the_disk(
    town: Town, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In this order: the bytes, the name, the folder's names."""
    done: list[str] = []
    meanwhile: list[str] = []
    sync, move = os.fsync, os.replace

    def fsync(file: int) -> None:
        listed = done if threading.current_thread() is threading.main_thread() else meanwhile
        listed.append(f"sync {Path(os.readlink(f'/proc/self/fd/{file}')).name}")
        sync(file)

    def replace(source: Any, target: Any) -> None:
        done.append(f"name {Path(target).name}")
        move(source, target)

    monkeypatch.setattr(os, "fsync", fsync)
    monkeypatch.setattr(os, "replace", replace)
    out = tmp_path / "out"
    run(town.config(out))
    for name, folder in ((RUN_RECORD, "out"), (Path(MANIFEST_PATH).name, "store.zarr")):
        last = max(k for k, what in enumerate(done) if what == f"name {name}")
        assert done[last - 1].startswith(f"sync .{Path(name).stem}.")
        assert done[last + 1] == f"sync {folder}"
    assert not any(what.startswith("sync .progress") for what in done)
    # In a new folder nothing can belie the first record: the disk takes it while the run goes on.
    assert meanwhile == ["sync run.json", "sync out"]
    assert done.count("sync out") == 1
    run(town.config(out))
    assert meanwhile == ["sync run.json", "sync out"]
    assert done.count("sync out") == 3


def test_a_disk_that_does_not_take_it_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "file"
    path.write_text("old")

    def refuse(_: int) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr(os, "fsync", refuse)
    with pytest.raises(OutputError, match="cannot be written"), replacing(path, durable=True) as part:
        part.write_text("new")
    assert path.read_text() == "old"
    assert [entry.name for entry in tmp_path.iterdir()] == ["file"]
    with replacing(path) as part:
        part.write_text("new")
    assert path.read_text() == "new"
