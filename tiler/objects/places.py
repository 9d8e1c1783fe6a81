"""Places of inputs and results: paths on a disk, objects of a bucket (``s3://``), files of a server (``http://``)."""

import re
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, TypeGuard, cast

from pipeline.errors import ConfigError, OutputError

if TYPE_CHECKING:
    from tiler.objects.path import ObjectPath

PATIENCE = 600.0  # s that a request is repeated for where nothing sound answers
_URL = re.compile(r"(s3|https?)://", re.IGNORECASE)
_OTHER = re.compile(r"([A-Za-z][A-Za-z0-9+.-]*)://")


class StoreUnreachableError(OutputError):
    """A bucket or server has not answered for all of a run's patience: the run ends, and may be resumed."""


def is_url(text: str) -> bool:
    """Tell whether a text names an object or a file of a server.

    Examples
    --------
    >>> [is_url(text) for text in ("s3://bucket/run", "https://host/a.laz", "s3:/a", "C://a")]
    [True, True, False, False]
    """
    return _URL.match(text) is not None


def in_bucket(path: object) -> "TypeGuard[ObjectPath]":
    """Tell whether a place is an `ObjectPath`: what is written there is put whole, and nothing is renamed."""
    return getattr(path, "is_remote", False)


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
        Of a URL an `ObjectPath`, which has the part of `Path` that runs and readers use.

    Raises
    ------
    ConfigError
        As `check_url`.
    """
    if not is_url(text):
        return Path(text)
    from tiler.objects.path import ObjectPath

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
        return path.read_bytes(n_bytes)
    with path.open("rb") as file:
        return file.read(n_bytes)


def refuse_bucket(path: str | Path, what: str) -> None:
    """Raise ConfigError with the next move where a command needs files on a disk."""
    if in_bucket(path) or (isinstance(path, str) and is_url(path)):
        raise ConfigError(f"{path}: {what} needs a folder of a disk; `citystitch fetch {path} DIR` makes one")
