"""A file that is read by ranges of an object: what is asked for, and more where it is read from end to end."""

import errno
import io
import os
from typing import TYPE_CHECKING, Any

from tiler.objects.requests import ChangedError

if TYPE_CHECKING:
    from tiler.objects.path import ObjectPath

LEAST = 1 << 14  # bytes of one request: headers and indexes are read in small pieces
MOST = 1 << 23  # of one that goes on where the last one ended; each is twice the one before


class RangeFile(io.RawIOBase):
    """An object as a file to read and seek in.

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

    def __init__(self, path: "ObjectPath") -> None:
        super().__init__()
        self._path, state = path, path.stat()
        self._size, self._tag = state.st_size, state.e_tag
        self._at, self._start, self._block, self._step = 0, 0, b"", LEAST
        self.n_bytes = self.n_requests = 0

    def readable(self) -> bool:
        """Tell that it can be read."""
        return True

    def seekable(self) -> bool:
        """Tell that it can be sought in."""
        return True

    def tell(self) -> int:
        """Tell the place (byte)."""
        return self._at

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Go to a place; OSError for one before the beginning."""
        base = {os.SEEK_SET: 0, os.SEEK_CUR: self._at, os.SEEK_END: self._size}[whence]
        if base + offset < 0:
            raise OSError(errno.EINVAL, "a place before the beginning")
        self._at = base + offset
        return self._at

    def readinto(self, buffer: Any) -> int:
        """Fill a buffer; gives the number of bytes, fewer only at the end."""
        view = memoryview(buffer).cast("B")
        data = self.read(len(view))
        view[: len(data)] = data
        return len(data)

    def read(self, size: int | None = -1) -> bytes:
        """Read so many bytes, fewer only at the end; all by default."""
        left = max(self._size - self._at, 0)
        left = left if size is None or size < 0 else min(size, left)
        parts = []
        while left:
            parts.append(self._take(left))
            left -= len(parts[-1])
        return b"".join(parts)

    def readline(self, size: int | None = -1) -> bytes:
        """Read to the end of a line."""
        parts: list[bytes] = []
        bound = self._size if size is None or size < 0 else size
        while bound and self._at < self._size and not (parts and parts[-1].endswith(b"\n")):
            begin, part = self._at, self._take(bound)
            part = part[: part.find(b"\n") + 1] or part
            self._at = begin + len(part)
            bound -= len(part)
            parts.append(part)
        return b"".join(parts)

    def _take(self, most: int) -> bytes:
        """Read what is at hand, and fetch if that is nothing."""
        inside = self._at - self._start
        if not 0 <= inside < len(self._block):
            self._fetch(most)
            inside = 0
        part = self._block[inside : inside + most]
        self._at += len(part)
        return part

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
