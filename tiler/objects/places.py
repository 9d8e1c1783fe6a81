"""Places of inputs and results: paths on a disk, objects of a bucket (``s3://``), files of a server (``http://``).

Which of them a place is, `place` chooses once, by its text. What both do is in `Place`; what they do in different
ways, in the functions here.
"""

import hashlib
import os
import re
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path, PurePath
from typing import BinaryIO, Protocol, Self, TypeGuard, cast

from pipeline.data.errors import ConfigError
from tiler.objects.path import ObjectPath, delete_below

PATIENCE = 600.0  # s that a request is repeated for where nothing sound answers
_URL = re.compile(r"(s3|https?)://", re.IGNORECASE)
_OTHER = re.compile(r"([A-Za-z][A-Za-z0-9+.-]*)://")


class Place(Protocol):
    """What runs and readers do with a path of a disk and with an object of a bucket.

    `pathlib.Path` has all of it, and so has `ObjectPath`. Files are written by `tiler.store.atomic.replacing` and
    `tiler.objects.results`: whole, or not at all.
    """

    @property
    def name(self) -> str: ...
    @property
    def stem(self) -> str: ...
    @property
    def suffix(self) -> str: ...
    @property
    def parent(self) -> Self: ...
    def __truediv__(self, name: str, /) -> Self: ...
    def relative_to(self, other: Self, /) -> PurePath: ...
    def is_file(self) -> bool: ...
    def is_dir(self) -> bool: ...
    def is_symlink(self) -> bool: ...
    def exists(self) -> bool: ...
    def read_bytes(self) -> bytes: ...
    def unlink(self) -> None: ...
    def iterdir(self) -> Iterator[Self]: ...
    def glob(self, pattern: str, /) -> Iterator[Self]: ...
    def rglob(self, pattern: str, /) -> Iterator[Self]: ...


def is_url(text: str) -> bool:
    """Return whether a text names an object or a file of a server.

    Examples
    --------
    >>> [is_url(text) for text in ("s3://bucket/run", "https://host/a.laz", "s3:/a", "C://a")]
    [True, True, False, False]
    """
    return _URL.match(text) is not None


def in_bucket(path: object) -> TypeGuard[ObjectPath]:
    """Return whether a place is an `ObjectPath`: what is written there is put whole, and nothing is renamed."""
    return isinstance(path, ObjectPath)


def place(text: str, patience: float = PATIENCE) -> Path:
    """Give the place that a text names.

    Parameters
    ----------
    text : str
        Path, or URL.
    patience : float
        How long a request is repeated for (s).

    Returns
    -------
    Path
        Of a URL an `ObjectPath`, for all that takes a `Place`.

    Raises
    ------
    ConfigError
        As `check_url`.
    """
    if not is_url(text):
        return Path(text)
    check_url(text)
    scheme, rest = text.split("://", 1)
    host, _, key = rest.partition("/")
    parts = [part for part in key.split("/") if part]
    return cast(Path, ObjectPath(f"{scheme.lower()}://{host}", "/".join(parts), patience))


def as_place(path: str | Path) -> Path:
    """Take a place as it is, or find that of a text."""
    return place(path) if isinstance(path, str) else path


def source_of(path: Path) -> Path | BinaryIO:
    """Give a library what it can read: a path of the disk, or an object opened."""
    return path.open("rb") if in_bucket(path) else path


def absolute(text: str) -> str:
    """Give the text of a place that holds in every folder."""
    return text if is_url(text) else str(Path(text).absolute())


def check_url(text: str) -> None:
    """Refuse a URL that cannot be taken, or that holds what must not be written down.

    Parameters
    ----------
    text : str
        Any text; one that is no URL passes, if it does not look like one of another kind.

    Raises
    ------
    ConfigError
        If it has a user, a password, a query or a fragment, as presigned URLs have; the message leaves these out.
        If it has no bucket or host, or a part ``.`` or ``..``; or if its scheme is none that is known.
    """
    other = _OTHER.match(text)
    if other is None:
        return
    if not is_url(text):
        raise ConfigError(f"{other[1]}://: unknown scheme; give s3://BUCKET/KEY, https://HOST/FILE or a path")
    scheme, rest = text.split("://", 1)
    plain = re.split(r"[?#]", rest, maxsplit=1)[0]
    host, _, key = plain.partition("/")
    shown = f"{scheme}://{host.rpartition('@')[2]}/{key}"
    if plain != rest or "@" in host:
        raise ConfigError(
            f"{shown}: the URL has a user, a password or a query, which would be written down with the parameters "
            "of the run; give it without, and credentials in the environment (AWS_ACCESS_KEY_ID and others)"
        )
    if not host:
        raise ConfigError(f"{shown}: names no bucket or host; give s3://BUCKET/KEY or https://HOST/FILE")
    if any(part in (".", "..") for part in key.split("/")):
        raise ConfigError(f"{shown}: has a part . or ..; write the URL without")


def read_at_most(path: Path, n_bytes: int) -> bytes:
    """Read the first bytes of a file, no more than so many."""
    if in_bucket(path):
        return path.read_range(0, n_bytes)
    with path.open("rb") as file:
        return file.read(n_bytes)


def identify(path: Path | ObjectPath) -> str:
    """Change when a file does: its size and the time of its last change; of an object its tag, if it has one."""
    if in_bucket(path):
        found = path.stat()
        return f"{found.st_size} {found.e_tag or found.st_mtime_ns}"
    state = path.stat()
    return f"{state.st_size} {state.st_mtime_ns}"


def is_missing(path: Path) -> bool:
    """Return whether a path of a disk names nothing; of an object, its first reader tells."""
    return not in_bucket(path) and not os.path.exists(path)  # Path.exists raises where a name is too long


def remove(path: Place) -> None:
    """Remove a file, or a folder and all in it."""
    if in_bucket(path):
        delete_below(path)
    elif path.is_dir() and not path.is_symlink():
        shutil.rmtree(str(path))
    else:
        path.unlink()


def find_within(paths: Iterable[Path], folders: Iterable[Place]) -> Path | None:
    """Find the first place that is one of some others, or lies below one, links followed; None if none does."""
    ends = tuple(f"{_follow(folder)}/" for folder in folders)
    return next((path for path in paths if f"{_follow(path)}/".startswith(ends)), None)


def _follow(path: Place) -> str:
    return str(path) if in_bucket(path) else os.path.realpath(str(path))


def local_folder(folder: Path) -> Path:
    """Give where a machine keeps what is its own of a run: the folder itself, of a bucket one of this user."""
    if not in_bucket(folder):
        return folder
    run = hashlib.blake2b(str(folder).encode(), digest_size=8).hexdigest()
    return Path(tempfile.gettempdir()) / f"citystitch-{os.getuid()}-{run}"


def refuse_bucket(path: str | Path, what: str) -> None:
    """Raise ConfigError with the next move where a command needs files on a disk."""
    if in_bucket(path) or (isinstance(path, str) and is_url(path)):
        raise ConfigError(f"{path}: {what} needs a folder of a disk; `citystitch fetch {path} DIR` makes one")
