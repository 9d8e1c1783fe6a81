"""JSON files larger than memory, read member by member."""

import json
import re
from collections.abc import Iterator
from typing import Any, TextIO

READ_CHARACTERS = 1 << 20
MOST_CHARACTERS = 1 << 26  # of one value
_SPACE = " \t\r\n"
_NUMBER = re.compile(r"[-+.eE0-9]*")


class NoJsonError(ValueError):
    """The document is no JSON."""


class JsonStream:
    """Reads one JSON document from its beginning to its end, in any layout.

    The caller goes into objects by `members` and into arrays by `elements`, and takes by `value` what is small.
    Values are those of `json.loads`.

    Parameters
    ----------
    file : text file
        Open for reading.

    Raises
    ------
    NoJsonError, JSONDecodeError
        From all methods: if the document is no JSON there, or a value has more than `MOST_CHARACTERS`.

    Notes
    -----
    Memory holds the value that is read, and a megabyte.

    Examples
    --------
    >>> from io import StringIO
    >>> stream = JsonStream(StringIO('{"n": 3, "rows": [[1, 2], [3, 4]]}'))
    >>> [list(stream.elements()) if key == "rows" else stream.value() for key in stream.members()]
    [3, [[1, 2], [3, 4]]]
    >>> stream.finish()
    """

    def __init__(self, file: TextIO) -> None:
        self._file = file
        self._text = ""
        self._at = 0
        self._ended = False
        self._decoder = json.JSONDecoder()

    def peek(self) -> str:
        """Give the next character that is no space, and leave it; an empty string at the end."""
        while True:
            while self._at < len(self._text):
                if self._text[self._at] not in _SPACE:
                    return self._text[self._at]
                self._at += 1
            if not self._fill():
                return ""

    def value(self) -> Any:
        """Take the next value whole."""
        self.peek()
        while True:
            try:
                found, end = self._decoder.raw_decode(self._text, self._at)
                # A number at the end of what was read may go on.
                if self._ended or _NUMBER.match(self._text, end).end() < len(self._text):  # type: ignore[union-attr]
                    self._at = end
                    return found
            except json.JSONDecodeError:
                if self._ended or len(self._text) - self._at > MOST_CHARACTERS:
                    raise
            self._fill()

    def members(self) -> Iterator[str]:
        """Go into an object: after each key its value must be taken, or gone into."""
        self._take("{")
        if self.peek() == "}":
            self._at += 1
            return
        while True:
            key = self.value()
            if not isinstance(key, str):
                raise NoJsonError(f"key {key!r} is no string")
            self._take(":")
            yield key
            if self._take(",}") == "}":
                return

    def elements(self) -> Iterator[Any]:
        """Go into an array, and take its values one after the other."""
        self._take("[")
        if self.peek() == "]":
            self._at += 1
            return
        while True:
            yield self.value()
            if self._take(",]") == "]":
                return

    def skip(self) -> None:
        """Leave out the next value; of an object or an array one member is held at a time."""
        first = self.peek()
        if first == "{":
            for _ in self.members():
                self.value()
        elif first == "[":
            for _ in self.elements():
                pass
        else:
            self.value()

    def finish(self) -> None:
        """Make sure that nothing is left."""
        if self.peek():
            raise NoJsonError(f"{self.peek()!r} after the end")

    def _take(self, expected: str) -> str:
        found = self.peek()
        if not found or found not in expected:
            raise NoJsonError(f"{found!r} instead of {' or '.join(expected)}" if found else "it ends too early")
        self._at += 1
        return found

    def _fill(self) -> bool:
        """Read on, twice as much while one value takes more and more; False at the end."""
        self._text = self._text[self._at :]
        self._at = 0
        more = self._file.read(max(READ_CHARACTERS, len(self._text)))
        self._text += more
        self._ended = not more
        return bool(more)
