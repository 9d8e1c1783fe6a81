"""Objects that only a file on a disk will do for: fetched once into the temporary folder of a machine."""

import hashlib
import os
import shutil
import tempfile
import uuid
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.errors import InputError
from tiler.objects.places import in_bucket

if TYPE_CHECKING:
    from tiler.objects.path import ObjectPath

READ_BYTES = 1 << 23  # of one request


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
        state = path.stat()
        words = f"{path} {state.st_size} {state.e_tag or state.st_mtime_ns}"
        name = hashlib.blake2b(words.encode(), digest_size=16).hexdigest()
        folder = _own_folder() / name
        copy = folder / path.name
        if copy.is_file() and copy.stat().st_size == state.st_size:
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


def copy_object(source: "ObjectPath", path: Path) -> None:
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
