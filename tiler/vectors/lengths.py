"""Lengths written as text, with units or without, in metres."""

import re
from typing import Any

FOOT, INCH = 0.3048, 0.0254  # m; the international foot: that of the US survey is 2e-6 longer
_NUMBER = r"(\d+(?:[.,]\d+)?|[.,]\d+)"
_UNITS = {
    **dict.fromkeys(("", "m", "m.", "meter", "meters", "metre", "metres", "mtr"), 1.0),
    **dict.fromkeys(("cm",), 0.01),
    **dict.fromkeys(("mm",), 0.001),
    **dict.fromkeys(("ft", "ft.", "foot", "feet", "'"), FOOT),
    **dict.fromkeys(("in", "in.", "inch", "inches", '"'), INCH),
}
_LENGTH = re.compile(rf"([+-]?){_NUMBER}\s*([a-z]*\.?|'|\")")
_FEET_AND_INCHES = re.compile(rf"{_NUMBER}\s*(?:'|ft\.?|feet|foot)\s*{_NUMBER}\s*(?:\"|in\.?|inch|inches)?")
# Primes, quotation marks and an accent that stand for feet and inches; spaces that do not break.
_SIGNS = str.maketrans(
    {
        **dict.fromkeys(("\u2032", "\u2019", "\u2018", "\u00b4", "`"), "'"),
        **dict.fromkeys(("\u2033", "\u201d", "\u201c"), '"'),
        **dict.fromkeys(("\u00a0", "\u202f"), " "),
    }
)


def metres_of(value: Any) -> float:
    """Read a length (m).

    A number, or text with a point or comma before its decimals and a unit, or feet and inches, behind it; NaN
    where it cannot be read, as text with thousands marks, ranges or other units.

    Examples
    --------
    >>> [metres_of(value) for value in (6, "6 m", "9m", "7,5", "10 ft", "1.5e1")]
    [6.0, 6.0, 9.0, 7.5, 3.048, 15.0]
    >>> [round(metres_of(value), 4) for value in ("21'", "65'7\\"", "3 ft 6 in", "12 storeys", "1,234.5", None)]
    [6.4008, 19.9898, 1.0668, nan, nan, nan]
    """
    if isinstance(value, str):
        return _metres_of_text(value.translate(_SIGNS).replace("''", '"').strip().lower())
    if isinstance(value, bool):
        return float("nan")
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError):
        return float("nan")


def number_of(value: Any) -> float:
    """Read a number, as of storeys: text with a point or a comma before its decimals; NaN where it is none."""
    if isinstance(value, str):
        found = re.fullmatch(_NUMBER, value.strip())
        return float(found[1].replace(",", ".")) if found else float("nan")
    return metres_of(value)


def _metres_of_text(text: str) -> float:
    both = _FEET_AND_INCHES.fullmatch(text)
    if both:
        feet, inches = (float(part.replace(",", ".")) for part in both.groups())
        return feet * FOOT + inches * INCH
    single = _LENGTH.fullmatch(text)
    if single:
        sign, number, unit = single.groups()
        size = float(number.replace(",", "."))
        return (-size if sign == "-" else size) * _UNITS.get(unit, float("nan"))
    try:
        return float(text)
    except ValueError:
        return float("nan")
