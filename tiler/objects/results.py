"""Files of a disk that become objects, the one that names them last, and objects that only a file will do for."""

import hashlib
import os
import shutil
import tempfile
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pipeline.data.errors import InputError
from tiler.objects.path import ObjectPath
from tiler.objects.places import identify, in_bucket

PREFIX = "citystitch-"  # of temporary folders
READ_BYTES = 1 << 23  # of one request


@contextmanager
def files_for(target: Path) -> Iterator[Path]:
    """Give a folder to write files into: that of a disk itself, of a bucket an empty one, whose files are put.

    The folders ``mesh`` and ``boundary`` of pieces are there.
    """
    if not in_bucket(target):
        yield target
        return
    with tempfile.TemporaryDirectory(prefix=PREFIX, ignore_cleanup_errors=True) as name:
        folder = Path(name)
        for part in ("mesh", "boundary"):
            (folder / part).mkdir()
        yield folder
        for path in sorted(folder.rglob("*")):
            if path.is_file():
                (target / path.relative_to(folder).as_posix()).put_file(path)


def local_copy(path: Path) -> Path:
    """Give a file on a disk with the content of an object, under the object's own name.

    Parameters
    ----------
    path : Path
        A path of a disk is given back as it is.

    Raises
    ------
    InputError
        If the object cannot be read, or the disk refuses.

    Notes
    -----
    The folder is named by URL, size and tag, and is this user's alone: all processes of a machine share the copy,
    and an object that was changed is fetched again. It stays for further runs; whoever cleans the temporary
    folder removes it.
    """
    if not in_bucket(path):
        return path
    try:
        state = identify(path)
        name = hashlib.blake2b(f"{path} {state}".encode(), digest_size=16).hexdigest()
        folder = _own_folder() / name
        copy = folder / path.name
        if copy.is_file() and copy.stat().st_size == int(state.split()[0]):
            return copy
        folder.mkdir(mode=0o700, exist_ok=True)
        part = folder / f".{uuid.uuid4().hex}.part"
        try:
            copy_object(path, part)
            os.replace(part, copy)
        finally:
            part.unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f"{path}: cannot be fetched ({error.strerror}); check the URL and free space") from error
    return copy


def copy_object(source: ObjectPath, path: Path) -> None:
    """Copy an object to a new file, by ranges; OSError if either refuses."""
    with source.open() as data, path.open("xb") as file:
        shutil.copyfileobj(data, file, READ_BYTES)


def _own_folder() -> Path:
    """Make the folder of all copies; InputError where it is somebody else's."""
    folder = Path(tempfile.gettempdir()) / f"citystitch-inputs-{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    state = folder.stat(follow_symlinks=False)
    if folder.is_symlink() or state.st_uid != os.getuid() or state.st_mode & 0o022:
        raise InputError(f"{folder}: is not this user's alone; remove it, or set TMPDIR to another folder")
    return folder
