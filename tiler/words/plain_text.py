"""Text from files and paths, made safe to print and to store as a name."""

import hashlib
import unicodedata
from collections.abc import Iterable, Mapping, Sequence
from difflib import get_close_matches
from typing import Any

# Unicode categories that move a cursor, hide or reorder text, or cannot be written as UTF-8: control, format,
# surrogate, line and paragraph separators. A terminal obeys the first, a reader is misled by the second.
_UNSAFE = {"Cc", "Cf", "Cs", "Zl", "Zp"}

CLOSE = 0.6  # likeness from which on a name is suggested
ID_LENGTH = 200  # characters of a building's id; registers have some 20, a URI some 100


def printable(text: str) -> str:
    r"""Write control characters as escapes, so that text is one line and no terminal obeys it.

    Parameters
    ----------
    text : str
        Anything: paths, attributes, what a library said.

    Returns
    -------
    str
        The same where there are none; others as ``\n``, ``\x1b``, ``\u202e``.

    Examples
    --------
    >>> printable("red \x1b[31m\nhouse")
    'red \\x1b[31m\\nhouse'
    """
    if text.isprintable():
        return text
    return "".join(_escape(sign) if unicodedata.category(sign) in _UNSAFE else sign for sign in text)


def shorten(text: str, length: int) -> str:
    """Cut text to a length; what is cut shows as a hash of the whole, so that different texts stay different.

    Parameters
    ----------
    text : str
        Anything.
    length : int
        Characters to keep at most, at least 18.

    Examples
    --------
    >>> shorten("a" * 30, 20)
    'aaa~71fab4a212af99bb'
    """
    if len(text) <= length:
        return text
    mark = "~" + hashlib.blake2b(text.encode(errors="surrogatepass"), digest_size=8).hexdigest()
    return text[: length - len(mark)] + mark


def say_nothing(_: str) -> None:
    """Take a line for a user who wants none."""


def _escape(sign: str) -> str:
    return sign.encode("unicode_escape", errors="surrogatepass").decode("ascii")


def format_box(box: Sequence[float]) -> str:
    """Write a box as its ranges of x and y, without a comma within a number.

    Examples
    --------
    >>> format_box((120000.0, 487200.5, 120624.0, 487786.0))
    '120000 to 120624, 487200.5 to 487786'
    """
    west, south, east, north = (f"{value:.10g}" for value in box)
    return f"{west} to {east}, {south} to {north}"


def replace_surrogates(value: Any) -> Any:
    r"""Write bytes of paths that are no text as escapes, in whatever JSON has: not every JSON parser takes them.

    Examples
    --------
    >>> replace_surrogates({"out": ["a" + chr(0xDCC3), 1]})
    {'out': ['a\\udcc3', 1]}
    """
    if isinstance(value, str):
        return value.encode(errors="backslashreplace").decode()
    if isinstance(value, Mapping):
        return {name: replace_surrogates(one) for name, one in value.items()}
    return [replace_surrogates(one) for one in value] if isinstance(value, (list, tuple)) else value


def suggest(name: str, known: Iterable[str]) -> str:
    """Offer the known name that is most like one that is not; an empty text where none is.

    Examples
    --------
    >>> suggest("--meshsize", ["--mesh-size", "--mesher"]), suggest("--colour", ["--mesh-size"])
    ('; did you mean --mesh-size?', '')
    """
    found = get_close_matches(name, list(known), n=1, cutoff=CLOSE)
    return f"; did you mean {found[0]}?" if found else ""
