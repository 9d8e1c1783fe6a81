"""Files and folders that appear whole or not at all."""

import os
import shutil
import tempfile
import threading
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from pipeline.data.errors import OutputError
from tiler.objects.places import in_bucket


@contextmanager
def disk_errors(path: Path) -> Iterator[None]:
    """Make an OutputError of what the system says against writing."""
    try:
        yield
    except OSError as error:
        reason = error.strerror or " ".join(str(error).split())  # HDF5 often gives no reason of the system
        raise OutputError(f"{path}: cannot be written ({reason}); free space or choose another folder") from error


@contextmanager
def replacing(path: Path, *, durable: bool = False) -> Iterator[Path]:
    """Give a path beside `path` to write to; the file takes its place when all went well.

    With `durable`, wait until the disk has it: after a loss of power `path` is the old file or the new one, both
    whole. An object is put whole, from a file in the temporary folder. OutputError if the file cannot be written;
    then `path` is not there, or is the old file.
    """
    if in_bucket(path):
        part = Path(tempfile.gettempdir()) / f"citystitch-{uuid.uuid4().hex}.part{path.suffix}"
    else:
        part = path.with_name(f".{path.stem}.{uuid.uuid4().hex}.part{path.suffix}")
    with disk_errors(path):
        try:
            yield part
            if in_bucket(path):
                path.put_file(part)
                return
            if durable:
                _sync(part)
            os.replace(part, path)
            if durable:
                _sync(path.parent)
        finally:
            part.unlink(missing_ok=True)


def sync_meanwhile(path: Path) -> None:
    """Let the disk take a file and its name, and go on: it may take a second where much else was written.

    A failure is ignored: for a file that is written again, and waited for, in the end.
    """

    def sync() -> None:
        with suppress(OSError):
            _sync(path)
            _sync(path.parent)

    threading.Thread(target=sync, name="sync", daemon=True).start()


def _sync(path: Path) -> None:
    """Wait until the disk has a file, or the names in a folder."""
    file = os.open(path, os.O_RDONLY)
    try:
        os.fsync(file)
    finally:
        os.close(file)


@contextmanager
def replacing_folder(path: Path) -> Iterator[Path]:
    """Give an empty folder beside `path` to write to; it takes its place when all went well.

    OutputError if the folder cannot be written; then `path` is not there, or is the old folder.
    """
    stem = f".{path.name}.{uuid.uuid4().hex}"
    part, old = path.with_name(f"{stem}.part"), path.with_name(f"{stem}.old")
    with disk_errors(path):
        try:
            part.mkdir()
            yield part
            if path.exists():
                os.replace(path, old)
            try:
                os.replace(part, path)
            except OSError:
                if old.exists():
                    os.replace(old, path)
                raise
        finally:
            shutil.rmtree(part, ignore_errors=True)
            shutil.rmtree(old, ignore_errors=True)
