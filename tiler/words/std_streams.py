"""Standard output and error that never end a command: a reader that has gone, or a terminal of ASCII alone."""

import codecs
import io
import os
import sys
from typing import TextIO

PLAIN = "citystitch-plain"  # error handler: signs that a terminal cannot show, in ASCII
SIGNS = {
    **{"\N{SUPERSCRIPT TWO}": "2", "\N{SUPERSCRIPT THREE}": "3", "\N{DEGREE SIGN}": " degrees"},
    **{"\N{MULTIPLICATION SIGN}": "x", "\N{PLUS-MINUS SIGN}": "+/-", "\N{HORIZONTAL ELLIPSIS}": "..."},
    **{"\N{MIDDLE DOT}": "-", "\N{EN DASH}": "-", "\N{MINUS SIGN}": "-"},
}


class _PatientWriter(io.RawIOBase):
    """Writes to a file until nobody reads it any more, and then to nowhere."""

    def __init__(self, file: int) -> None:
        self._file, self._gone = file, False

    def writable(self) -> bool:
        """It is."""
        return True

    def fileno(self) -> int:
        """Give the file's descriptor."""
        return self._file

    def isatty(self) -> bool:
        """Return whether it is a terminal."""
        return os.isatty(self._file)

    def write(self, data: "bytes | bytearray | memoryview", /) -> int:  # type: ignore[override]
        """Write, or let it be where nobody reads."""
        if not self._gone:
            try:
                return os.write(self._file, data)
            except BrokenPipeError:
                self._gone = True
        return len(data)


def write_plainly(error: UnicodeError) -> tuple[str, int]:
    """Write signs that an encoding lacks in ASCII: an error handler of codecs.

    Examples
    --------
    >>> codecs.register_error(PLAIN, write_plainly)
    >>> "12 m², 3°, ß".encode("ascii", PLAIN).decode()
    '12 m2, 3 degrees, \\\\xdf'
    """
    if not isinstance(error, UnicodeEncodeError):
        raise error
    text = error.object[error.start : error.end]
    shown = "".join(SIGNS.get(sign) or sign.encode("ascii", "backslashreplace").decode() for sign in text)
    return shown, error.end


def guard_streams() -> None:
    """Guard standard output and error of this process."""
    codecs.register_error(PLAIN, write_plainly)
    sys.stdout, sys.stderr = _guard(sys.stdout), _guard(sys.stderr)


def _guard(stream: TextIO) -> TextIO:
    """Put a patient writer below a text stream; one that is closed, or no file, stays as it is."""
    try:
        stream.flush()
        file = stream.fileno()
    except (AttributeError, OSError, ValueError):
        return stream
    lines = getattr(stream, "line_buffering", False)
    raw: io.RawIOBase = _PatientWriter(file)
    buffer = io.BufferedWriter(raw)
    return io.TextIOWrapper(buffer, encoding=stream.encoding, errors=PLAIN, newline="\n", line_buffering=lines)
