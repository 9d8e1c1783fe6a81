"""Values on the command line that begin with a minus sign: tiles and coordinates west and south of the origin."""

import math
import re
from collections.abc import Sequence
from decimal import Decimal

_WORD = re.compile(r"-?\d+_-?\d+|-[\d.eE+-]+(,[\d.eE+-]+|,0[ABC])+")  # a tile, or numbers and levels with commas
_PLAIN = re.compile(r"-\d+|-\d*\.\d+")  # what argparse takes as a number, Python 3.11 to 3.14


def mark_values(arguments: Sequence[str]) -> list[str]:
    """Write values that begin with a minus sign so that argparse does not take them for options.

    Parameters
    ----------
    arguments : sequence of str
        Those of the command line.

    Returns
    -------
    list of str
        A tile's name or a box joined to the option before it, and negative numbers as plain decimals; all else as
        it was.

    Examples
    --------
    >>> mark_values(["run", "x.laz", "--only", "-4953_-6953", "--bounds", "-7.4e5", "-1043060.", "-1_0", "2"])
    ['run', 'x.laz', '--only=-4953_-6953', '--bounds', '-740000.0', '-1043060.0', '-10.0', '2']
    """
    marked: list[str] = []
    for text in arguments:
        before = marked[-1] if marked else ""
        if text.startswith("-") and _WORD.fullmatch(text) and before.startswith("--") and "=" not in before:
            marked[-1] = f"{before}={text}"
        else:
            marked.append(_plain_number(text))
    return marked


def _plain_number(text: str) -> str:
    """Write a negative number that argparse would not know as one."""
    if not text.startswith("-") or _PLAIN.fullmatch(text):
        return text
    try:
        value = float(text)
    except ValueError:
        return text
    return format(Decimal(repr(value)), "f") if math.isfinite(value) else text
