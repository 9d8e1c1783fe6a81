"""Objects of a bucket, and files of a web server, by the part of `pathlib.Path` that runs and readers use.

There are no folders: one is there where an object lies below it. Nothing is renamed: an object is put whole, or
not at all.
"""

import stat
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path, PurePosixPath
from typing import Any, BinaryIO, TypeVar, cast

from tiler.objects.range_file import RangeFile
from tiler.objects.requests import ask

T = TypeVar("T")
FILE, FOLDER = "file", "folder"


@dataclass(frozen=True)
class ObjectState:
    """What a store says of an object, named as by `os.stat`.

    Attributes
    ----------
    st_size : int
        Bytes.
    st_mtime_ns : int
        When it was put (ns since 1970).
    e_tag : str
        Changes with the content; empty where the server has none.
    """

    st_size: int
    st_mtime_ns: int
    e_tag: str
    st_mode: int = stat.S_IFREG | 0o644


class ObjectPath:
    """An object, or all that lie below a name.

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

    __slots__ = ("_kind", "key", "patience", "root")
    is_remote = True

    def __init__(self, root: str, key: str, patience: float, kind: str = "") -> None:
        self.root, self.key, self.patience, self._kind = root, key, patience, kind

    def __str__(self) -> str:
        """Give the URL."""
        return f"{self.root}/{self.key}"

    def __repr__(self) -> str:
        """Give the URL as an expression."""
        return f"ObjectPath({str(self)!r})"

    def __eq__(self, other: object) -> bool:
        """Compare URLs."""
        return isinstance(other, ObjectPath) and str(self) == str(other)

    def __lt__(self, other: "ObjectPath") -> bool:
        """Sort by URL."""
        return str(self) < str(other)

    def __hash__(self) -> int:
        """Hash the URL."""
        return hash((self.root, self.key))

    def __truediv__(self, name: str | Path) -> "ObjectPath":
        """Go below."""
        return ObjectPath(self.root, f"{self.key}/{name}".strip("/"), self.patience)

    @property
    def name(self) -> str:
        """Last part of the name."""
        return self.key.rpartition("/")[2]

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
        return ObjectPath(self.root, self.key.rpartition("/")[0], self.patience)

    def relative_to(self, other: "ObjectPath") -> PurePosixPath:
        """Name below another one; ValueError if it does not lie there."""
        return PurePosixPath("/" + self.key).relative_to("/" + other.key)

    def is_relative_to(self, other: "ObjectPath") -> bool:
        """Whether it is another one or lies below it."""
        return self.root == other.root and PurePosixPath("/" + self.key).is_relative_to("/" + other.key)

    def stat(self) -> ObjectState:
        """Ask for size, time and tag."""
        import obstore

        found: Any = self._ask(lambda store: obstore.head(store, self.key))
        return ObjectState(
            found["size"], int(found["last_modified"].timestamp() * 1e9), str(found.get("e_tag") or "")
        )

    def is_file(self) -> bool:
        """Whether there is such an object."""
        if self._kind:
            return self._kind == FILE
        try:
            self.stat()
        except FileNotFoundError:
            return False
        return True

    def is_dir(self) -> bool:
        """Whether an object lies below."""
        if self._kind or not self.root.startswith("s3://"):
            return self._kind == FOLDER
        try:
            return next(iter(self._list(1)), None) is not None
        except FileNotFoundError:
            return False

    def is_symlink(self) -> bool:
        """Tell that it is none."""
        return False

    def exists(self) -> bool:
        """Whether there is such an object, or one below."""
        return self.is_dir() or self.is_file()

    def read_bytes(self, at_most: int | None = None) -> bytes:
        """Read the object; of one that is larger than `at_most`, so many bytes. OSError for an empty one then."""
        import obstore

        options: Any = {} if at_most is None else {"range": (0, at_most)}
        return self._ask(lambda store: bytes(obstore.get(store, self.key, options=options).bytes()))

    def read_range(self, start: int, stop: int, e_tag: str = "") -> bytes:
        """Read some bytes; ChangedError if the object has another tag by now."""
        import obstore

        options: Any = {"range": (start, stop)} | ({"if_match": e_tag} if e_tag else {})
        return self._ask(lambda store: bytes(obstore.get(store, self.key, options=options).bytes()))

    def open(self, mode: str = "rb") -> BinaryIO:
        """Open it for reading by ranges; ValueError for another mode."""
        if mode != "rb":
            raise ValueError(f"{self}: opened as {mode!r}; an object is read as bytes, and put whole")
        return cast(BinaryIO, RangeFile(self))

    def write_bytes(self, data: bytes) -> None:
        """Put the object."""
        import obstore

        self._ask(lambda store: obstore.put(store, self.key, data))

    def put_file(self, path: Path) -> None:
        """Put the content of a file, in parts where it is large."""
        import obstore

        self._ask(lambda store: obstore.put(store, self.key, path))

    def put_if(self, data: bytes, e_tag: str | None) -> str:
        """Put the object where there is none, or in place of the one with a tag; ChangedError otherwise.

        Returns
        -------
        str
            Its tag.
        """
        import obstore

        mode: Any = "create" if e_tag is None else {"e_tag": e_tag}
        found: Any = self._ask(lambda store: obstore.put(store, self.key, data, mode=mode, use_multipart=False))
        return str(found["e_tag"])

    def unlink(self, missing_ok: bool = True) -> None:
        """Delete the object; stores do not tell whether there was one."""
        import obstore

        self._ask(lambda store: obstore.delete(store, self.key))

    def delete(self, paths: "list[ObjectPath]") -> None:
        """Delete objects of the same bucket, a thousand a request."""
        import obstore

        if paths:
            keys = [path.key for path in paths]
            self._ask(lambda store: obstore.delete(store, keys))

    def mkdir(self, parents: bool = False, exist_ok: bool = False) -> None:
        """Do nothing: there are no folders."""

    def absolute(self) -> "ObjectPath":
        """Give itself."""
        return self

    resolve = absolute

    def iterdir(self) -> Iterator["ObjectPath"]:
        """List what lies directly below, sorted by kind and name."""
        import obstore

        prefix = self._prefix()
        found: Any = self._ask(lambda store: obstore.list_with_delimiter(store, prefix))
        for folder in sorted(found["common_prefixes"]):
            yield ObjectPath(self.root, folder, self.patience, FOLDER)
        for key in sorted(meta["path"] for meta in found["objects"]):
            yield ObjectPath(self.root, key, self.patience, FILE)

    def glob(self, pattern: str) -> Iterator["ObjectPath"]:
        """List what lies directly below and fits a pattern without slashes."""
        return (path for path in self.iterdir() if fnmatchcase(path.name, pattern))

    def rglob(self, pattern: str = "*") -> Iterator["ObjectPath"]:
        """List all objects below that fit a pattern, by name."""
        for meta in self._list():
            path = ObjectPath(self.root, meta["path"], self.patience, FILE)
            if fnmatchcase(path.name, pattern):
                yield path

    def list_sizes(self) -> dict[str, int]:
        """List all objects below: size (bytes) by name below this one."""
        skip = len(self._prefix() or "")
        return {meta["path"][skip:]: meta["size"] for meta in self._list()}

    def _prefix(self) -> str | None:
        return f"{self.key}/" if self.key else None

    def _list(self, at_most: int = 0) -> list[Any]:
        import obstore

        def collect(store: Any) -> list[Any]:
            found: list[Any] = []
            for part in obstore.list(store, self._prefix(), chunk_size=at_most or 1000):
                found += part
                if at_most and len(found) >= at_most:
                    break
            return found

        return sorted(self._ask(collect), key=lambda meta: str(meta["path"]))

    def _ask(self, request: Callable[[Any], T]) -> T:
        return ask(self, self.patience, request, self.root)


def delete_below(path: ObjectPath, first: str = "") -> None:
    """Delete an object and all below it; those named `first` before the others."""
    paths = [*path.rglob(), ObjectPath(path.root, path.key, path.patience)]
    path.delete([one for one in paths if one.name == first])
    path.delete([one for one in paths if one.name != first])
