"""The second folder in which an edit is worked out, and its move to the first: all of it or nothing."""

import json
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

from tiler.store.atomic import disk_errors, replacing
from tiler.store.checksums import seal
from tiler.store.edit_journal import JOURNAL
from tiler.store.out_folder import CONFIG, EARLIER_REPORT, EVENTS, RESULTS, RUN_RECORD, TASKS

STAGING, DONE = ".edit", ".edit.done"  # folders below that of a run: what an edit leaves that was killed
WORK, COMMIT = "city", "commit.json"  # in it: the city as it will be; what is to be moved, once all is there
DONE_NOW = "the last edit was killed when all of it was there: it is done now"
NOT_DONE = "the last edit was killed before it was done: the city is as before it"
OWN = {EARLIER_REPORT, EVENTS, TASKS, "only"}  # what is of one run alone


def link_folder(source: Path, target: Path) -> None:
    """Make a folder of a run with the results of another, which both share: hard links, no copies.

    A file that a run changes is written beside its place and renamed, so the other folder keeps its own.

    Raises
    ------
    OutputError
        If there are no hard links between the two: they must lie on one disk.
    """
    with disk_errors(target):
        folders = set[str]()
        for name, _ in _files(source):
            if (folder := os.path.dirname(f"{target}/{name}")) not in folders:
                os.makedirs(folder, exist_ok=True)
                folders.add(folder)
            os.link(f"{source}/{name}", f"{target}/{name}")


def begin(directory: Path) -> Path:
    """Make the folder in which the next state of a city is worked out; it begins as the city is."""
    work = directory / STAGING / WORK
    link_folder(directory, work)
    return work


def commit(directory: Path) -> int:
    """Move what has changed in the second folder to the first; gives the number of files.

    Once the list of these is on the disk the edit is done: after a kill `finish_interrupted` does the moves that
    are left.
    """
    work = directory / STAGING / WORK
    new, old = dict(_files(work)), dict(_files(directory))
    changed = [name for name, inode in new.items() if old.get(name) != inode]
    listed = {"move": sorted(set(changed) - {CONFIG}), "remove": sorted(old.keys() - new.keys() - {CONFIG})}
    with disk_errors(directory), replacing(directory / STAGING / COMMIT, durable=True) as part:
        part.write_text(json.dumps(listed))
    _move(directory)
    return len(changed)


def finish_interrupted(directory: Path, say: Callable[[str], None]) -> None:
    """Finish or forget what a killed edit has left, and say which; whoever calls this holds the folder."""
    shutil.rmtree(directory / DONE, ignore_errors=True)
    staging = directory / STAGING
    if not staging.exists():
        return
    if (staging / COMMIT).exists():
        _move(directory)
        say(DONE_NOW)
    else:
        shutil.rmtree(staging)
        say(NOT_DONE)


def forget(directory: Path) -> None:
    """Remove the second folder of an edit that failed before it was done."""
    if not (directory / STAGING / COMMIT).exists():
        shutil.rmtree(directory / STAGING, ignore_errors=True)


def _move(directory: Path) -> None:
    """Do what the list says; what was done already is passed over."""
    work = directory / STAGING / WORK
    listed = json.loads((directory / STAGING / COMMIT).read_bytes())
    with disk_errors(directory):
        if (work / RUN_RECORD).exists():
            # No reader takes files of two states for one city.
            record = json.loads((work / RUN_RECORD).read_bytes()) | {"checksum": "0" * 8, "status": "running"}
            with replacing(directory / RUN_RECORD) as part:
                part.write_bytes(seal(json.dumps(record, indent=1).encode() + b"\n"))
        for name in listed["remove"]:
            (directory / name).unlink(missing_ok=True)
            with suppress(OSError):  # of a stage that has no result any more
                (directory / name).parent.rmdir()
        for name in sorted(listed["move"], key=RUN_RECORD.__eq__):  # the record last
            if (work / name).exists():
                (directory / name).parent.mkdir(parents=True, exist_ok=True)
                os.replace(work / name, directory / name)
        os.rename(directory / STAGING, directory / DONE)
        shutil.rmtree(directory / DONE)


def _files(folder: Path) -> Iterator[tuple[str, int]]:
    """List the files of a run, by their paths below its folder, with their inodes."""
    waiting = [name for name in sorted({*RESULTS, JOURNAL} - OWN) if (folder / name).exists()]
    for name in waiting:  # which grows
        if not os.path.isdir(f"{folder}/{name}"):
            yield name, os.stat(f"{folder}/{name}").st_ino
            continue
        with os.scandir(f"{folder}/{name}") as entries:
            for entry in entries:
                if entry.is_dir():
                    waiting.append(f"{name}/{entry.name}")
                else:
                    yield f"{name}/{entry.name}", entry.inode()
