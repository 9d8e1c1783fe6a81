"""Objects of a bucket, and files of a web server, by the part of `pathlib.Path` that runs and readers use.

There are no folders: one is there where an object lies below it. Nothing is renamed: an object is put whole, or
not at all.
"""

import errno
import io
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from pathlib import Path, PurePosixPath
from stat import S_IFREG
from typing import Any, BinaryIO, NamedTuple, TypeVar, cast

from tiler.objects.requests import ChangedError, ask

T = TypeVar("T")
FILE, FOLDER = "file", "folder"
LEAST = 1 << 14  # bytes of one request: headers and indexes are read in small pieces
MOST = 1 << 23  # of one that goes on where the last one ended; each is twice the one before


class ObjectState(NamedTuple):
    """Size (bytes), time (ns since 1970), and a tag that changes with the content; empty where there is none."""

    st_size: int
    st_mtime_ns: int
    e_tag: str
    st_mode: int = S_IFREG | 0o644


@dataclass(frozen=True, order=True, slots=True)
class ObjectPath:
    """An object, or all that lie below a name: a `tiler.objects.places.Place`.

    Parameters
    ----------
    root : str
        ``s3://BUCKET``, ``http://HOST`` or ``https://HOST``.
    key : str
        Name in it, without slashes at its ends.
    patience : float
        How long a request is repeated for (s).
    kind : str
        `FILE` or `FOLDER` where a listing has told; else empty.

    Raises
    ------
    OSError, StoreUnreachableError
        From all methods that ask the store, as `tiler.objects.requests.ask`.
    """

    root: str
    key: str
    patience: float = field(compare=False)
    kind: str = field(default="", compare=False)

    def __str__(self) -> str:
        """Give the URL."""
        return f"{self.root}/{self.key}"

    def __truediv__(self, name: str | Path) -> "ObjectPath":
        """Go below."""
        return self._at(f"{self.key}/{name}".strip("/"))

    @property
    def name(self) -> str:
        """Last part of the name."""
        return PurePosixPath(self.key).name

    @property
    def stem(self) -> str:
        """Last part without its suffix."""
        return PurePosixPath(self.key).stem

    @property
    def suffix(self) -> str:
        """Suffix of the last part."""
        return PurePosixPath(self.key).suffix

    @property
    def parent(self) -> "ObjectPath":
        """What it lies below."""
        return self._at(self.key.rpartition("/")[0])

    def relative_to(self, other: "ObjectPath") -> PurePosixPath:
        """Name below another one; ValueError if it does not lie there."""
        return PurePosixPath("/" + self.key).relative_to("/" + other.key)

    def stat(self) -> ObjectState:
        """Ask for size, time and tag."""
        found = self._ask(lambda store: store.head(self.key))
        when = int(found["last_modified"].timestamp() * 1e9)
        return ObjectState(found["size"], when, str(found.get("e_tag") or ""))

    def is_file(self) -> bool:
        """Whether there is such an object."""
        if self.kind:
            return self.kind == FILE
        try:
            self.stat()
        except FileNotFoundError:
            return False
        return True

    def is_dir(self) -> bool:
        """Whether an object lies below."""
        if self.kind or not self.root.startswith("s3://"):
            return self.kind == FOLDER
        try:
            return bool(self._list(1))
        except FileNotFoundError:
            return False

    def is_symlink(self) -> bool:
        """Return False: there are no links."""
        return False

    def exists(self) -> bool:
        """Whether there is such an object, or one below."""
        return self.is_dir() or self.is_file()

    def read_bytes(self, at_most: int | None = None) -> bytes:
        """Read the object; of one that is larger than `at_most`, so many bytes. OSError for an empty one then."""
        if at_most is not None:
            return self.read_range(0, at_most)
        return self._ask(lambda store: bytes(store.get(self.key).bytes()))

    def read_range(self, start: int, stop: int, e_tag: str = "") -> bytes:
        """Read some bytes; ChangedError if the object has another tag by now."""
        options: Any = {"range": (start, stop)} | ({"if_match": e_tag} if e_tag else {})
        return self._ask(lambda store: bytes(store.get(self.key, options=options).bytes()))

    def open(self, mode: str = "rb") -> BinaryIO:
        """Open it for reading by ranges; ValueError for another mode."""
        if mode != "rb":
            raise ValueError(f"{self}: opened as {mode!r}; an object is read as bytes, and put whole")
        return cast(BinaryIO, RangeFile(self))

    def write_bytes(self, data: bytes) -> None:
        """Put the object."""
        self._ask(lambda store: store.put(self.key, data))

    def put_file(self, path: Path) -> None:
        """Put the content of a file, in parts where it is large."""
        self._ask(lambda store: store.put(self.key, path))

    def put_if(self, data: bytes, e_tag: str | None) -> str:
        """Put the object where there is none, or in place of the one with a tag; gives its own tag.

        Raises
        ------
        ChangedError
            If the condition does not hold: another one has put it, or a try of which no answer came.
        """
        mode: Any = "create" if e_tag is None else {"e_tag": e_tag}
        found = self._ask(lambda store: store.put(self.key, data, mode=mode, use_multipart=False))
        return str(found["e_tag"])

    def unlink(self, missing_ok: bool = True) -> None:
        """Delete the object; stores do not tell whether there was one."""
        self._ask(lambda store: store.delete(self.key))

    def delete(self, paths: "list[ObjectPath]") -> None:
        """Delete objects of the same bucket, a thousand a request."""
        if paths:
            self._ask(lambda store: store.delete([path.key for path in paths]))

    def mkdir(self, parents: bool = False, exist_ok: bool = False) -> None:
        """Do nothing: there are no folders."""

    def iterdir(self) -> Iterator["ObjectPath"]:
        """List what lies directly below, sorted by kind and name."""
        found = self._ask(lambda store: store.list_with_delimiter(self._prefix()))
        yield from (self._at(key, FOLDER) for key in sorted(found["common_prefixes"]))
        yield from (self._at(key, FILE) for key in sorted(meta["path"] for meta in found["objects"]))

    def glob(self, pattern: str) -> Iterator["ObjectPath"]:
        """List what lies directly below and fits a pattern without slashes."""
        return (path for path in self.iterdir() if fnmatchcase(path.name, pattern))

    def rglob(self, pattern: str) -> Iterator["ObjectPath"]:
        """List all objects below that fit a pattern, by name."""
        paths = (self._at(meta["path"], FILE) for meta in self._list())
        return (path for path in paths if fnmatchcase(path.name, pattern))

    def list_sizes(self) -> dict[str, int]:
        """List all objects below: size (bytes) by name below this one."""
        skip = len(self._prefix() or "")
        return {meta["path"][skip:]: meta["size"] for meta in self._list()}

    def _at(self, key: str, kind: str = "") -> "ObjectPath":
        return replace(self, key=key, kind=kind)

    def _prefix(self) -> str | None:
        return f"{self.key}/" if self.key else None

    def _list(self, at_most: int = 0) -> list[Any]:
        def collect(store: Any) -> list[Any]:
            parts = store.list(self._prefix(), chunk_size=at_most or 1000)
            return list(next(parts, ())) if at_most else [meta for part in parts for meta in part]

        return sorted(self._ask(collect), key=lambda meta: str(meta["path"]))

    def _ask(self, request: Callable[[Any], T]) -> T:
        return ask(self, self.patience, request, self.root)


def delete_below(path: ObjectPath) -> None:
    """Delete an object and all below it."""
    path.delete([*path.rglob("*"), path])


class RangeFile(io.RawIOBase):
    """An object as a file to read and seek in: ranges of what is asked for, larger ones where it goes on.

    Parameters
    ----------
    path : ObjectPath
        The object: it must stay the same while it is open.

    Attributes
    ----------
    n_bytes, n_requests : int
        What was fetched so far.

    Raises
    ------
    OSError
        If it cannot be read, or changes meanwhile.
    """

    def __init__(self, path: ObjectPath) -> None:
        super().__init__()
        self._path, state = path, path.stat()
        self._size, self._tag = state.st_size, state.e_tag
        self._at, self._start, self._block, self._step = 0, 0, b"", LEAST
        self.n_bytes = self.n_requests = 0

    def readable(self) -> bool:
        """Return True."""
        return True

    def seekable(self) -> bool:
        """Return True."""
        return True

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Go to a place (byte); OSError for one before the beginning."""
        at = offset + {os.SEEK_SET: 0, os.SEEK_CUR: self._at, os.SEEK_END: self._size}[whence]
        if at < 0:
            raise OSError(errno.EINVAL, "a place before the beginning")
        self._at = at
        return at

    def readinto(self, buffer: Any) -> int:
        """Fill a buffer; gives the number of bytes, fewer only at the end."""
        view, done = memoryview(buffer).cast("B"), 0
        while part := self._look(len(view) - done):
            view[done : done + len(part)] = part
            done, self._at = done + len(part), self._at + len(part)
        return done

    def peek(self, size: int = 0) -> bytes:
        """Give some of the next bytes and stay there: `readline` looks for the end of a line in them."""
        return self._look(LEAST)

    def _look(self, most: int) -> bytes:
        """Give the next bytes, none only at the end: what is at hand, or what one request fetches."""
        most = min(most, self._size - self._at)
        if most <= 0:
            return b""
        if not self._start <= self._at < self._start + len(self._block):
            self._fetch(most)
        inside = self._at - self._start
        return self._block[inside : inside + most]

    def _fetch(self, wanted: int) -> None:
        goes_on = self._block and self._at == self._start + len(self._block)
        self._step = min(2 * self._step, MOST) if goes_on else LEAST
        stop = min(self._at + max(wanted, self._step), self._size)
        try:
            self._block = self._path.read_range(self._at, stop, self._tag)
        except ChangedError:
            raise OSError(errno.ESTALE, "the object was changed while it was read") from None
        self._start = self._at
        self.n_requests += 1
        self.n_bytes += len(self._block)
        if len(self._block) != stop - self._at:
            raise OSError(errno.EIO, f"{len(self._block)} bytes instead of {stop - self._at}")
