"""Messages from one process to another through a file that both see: one appends, the other reads on.

Network file systems promise little, but all of them this: whoever opens a file finds what was written before its
writer closed it. Names that come and go, and listings of folders, may be seen a minute late. So a message is
appended to a file that is there already, by its only writer, and its only reader opens that file again and again.
"""

import os
import struct
import time
import zlib
from collections.abc import Iterable
from pathlib import Path

from pipeline.errors import OutputError

HEAD = struct.Struct("<QI")  # bytes of a message, and their CRC-32
NEXT = HEAD.pack(2**64 - 1, 0)  # in place of a head: goes on in the next part
PART = 2**24  # bytes of a part; one that was read to its end is removed by its reader


class GoneError(OSError):
    """A mailbox is no longer there: who made it has ended, or has given its user up."""


class MailWriter:
    """The end of a mailbox that writes; it makes the mailbox.

    Parameters
    ----------
    path : Path
        The mailbox, in an existing folder; its parts are files of that name with a number.
    """

    def __init__(self, path: Path) -> None:
        self._path, self._part, self._size = path, 0, 0
        _part(path, 0).touch()

    def write(self, messages: Iterable[bytes]) -> None:
        """Append messages; all of them can be read on return.

        Raises
        ------
        GoneError
            If the mailbox is no longer there.
        OutputError
            If the disk refuses.
        """
        text = b"".join(HEAD.pack(len(message), zlib.crc32(message)) + message for message in messages)
        if not text:
            return
        try:
            if self._size + len(text) > PART and self._size:
                _part(self._path, self._part + 1).touch()  # there before it is spoken of
                _append(_part(self._path, self._part), NEXT)
                self._part, self._size = self._part + 1, 0
            _append(_part(self._path, self._part), text)
        except FileNotFoundError as error:
            raise GoneError(f"{self._path}: is gone") from error
        except OSError as error:
            raise OutputError(f"{self._path}: cannot be written ({error.strerror}); free space") from error
        self._size += len(text)


class MailReader:
    """The end of a mailbox that reads.

    Parameters
    ----------
    path : Path
        The mailbox.
    """

    def __init__(self, path: Path) -> None:
        self._path, self._part, self._offset = path, 0, 0
        self._waits: float | None = None

    def read(self) -> list[bytes]:
        """Read the messages that have come since, in their order.

        Raises
        ------
        GoneError
            If the mailbox is no longer there.
        """
        messages: list[bytes] = []
        while True:
            try:
                with _part(self._path, self._part).open("rb") as file:
                    if os.fstat(file.fileno()).st_size <= self._offset:
                        return messages
                    file.seek(self._offset)
                    text = file.read()
            except FileNotFoundError as error:
                raise GoneError(f"{self._path}: is gone") from error
            more, used, ended = _take(text)
            messages += more
            self._offset += used
            if not ended:
                # A message may be seen in part: its bytes come in any order.
                whole = used == len(text)
                self._waits = None if whole else self._waits if self._waits and not more else time.monotonic()
                return messages
            _part(self._path, self._part).unlink(missing_ok=True)
            self._part, self._offset, self._waits = self._part + 1, 0, None

    def waits(self) -> float:
        """Tell for how long (s) a message has been there in part, which is damaged if that is long."""
        return 0.0 if self._waits is None else time.monotonic() - self._waits


def _take(text: bytes) -> tuple[list[bytes], int, bool]:
    """Take the whole messages of a text: these, their bytes, and whether the next part follows."""
    messages, start = list[bytes](), 0
    while len(text) - start >= HEAD.size:
        if text[start : start + HEAD.size] == NEXT:
            return messages, start + HEAD.size, True
        size, crc = HEAD.unpack_from(text, start)
        message = text[start + HEAD.size : start + HEAD.size + size]
        if len(message) < size or zlib.crc32(message) != crc:
            break
        messages.append(message)
        start += HEAD.size + size
    return messages, start, False


def _append(path: Path, text: bytes) -> None:
    file = os.open(path, os.O_WRONLY | os.O_APPEND)
    try:
        left = memoryview(text)
        while left:
            left = left[os.write(file, left) :]
    finally:
        os.close(file)


def _part(path: Path, k: int) -> Path:
    return path.with_name(f"{path.name}.{k}")
