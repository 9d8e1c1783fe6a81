"""Words and numbers that files use for roofs: shapes, angles, directions, orientations (step 1.2)."""

import re
from typing import Any

from pipeline.data.roof_forms import ROOF_SHAPES
from tiler.vectors.features import text_of
from tiler.vectors.lengths import metres_of

LEAST_ANGLE, MOST_ANGLE = 1.0, 80.0  # degrees, of a roof that is not flat
LEAST_HEIGHT, MOST_HEIGHT = 0.1, 100.0  # m, from its eaves to its ridge
NOTHING, NO_SHAPE = -1, -2  # instead of an index into `ROOF_SHAPES`: none is stated, one that is not made here

_SAME_SHAPE = {
    **dict.fromkeys(("gable", "pitched", "dual pitched"), "gabled"),
    **dict.fromkeys(("hip",), "hipped"),
    **dict.fromkeys(("half hip", "half hipped"), "half-hipped"),
    **dict.fromkeys(("pyramid", "pavilion", "tented", "tent"), "pyramidal"),
    **dict.fromkeys(("monopitch", "mono pitched", "shed", "lean to", "pent", "single slope"), "skillion"),
}
# RoofType of CityGML: codes of SIG3D (1000 to 1130), and of the German surveys (AdV, 1000 and from 2100 on).
_CODES = {
    1000: "flat",
    **{1010: "skillion", 1030: "gabled", 1040: "hipped", 1050: "half-hipped", 1060: "mansard", 1070: "pyramidal"},
    **{2100: "skillion", 3100: "gabled", 3200: "hipped", 3300: "half-hipped", 3400: "mansard", 3500: "pyramidal"},
}
_POINTS = ("n", "nne", "ne", "ene", "e", "ese", "se", "sse", "s", "ssw", "sw", "wsw", "w", "wnw", "nw", "nnw")
_NAMES = {"north": "n", "east": "e", "south": "s", "west": "w"}
_DEGREES = re.compile(r"([+-]?\d+(?:[.,]\d+)?)\s*(?:°|deg|degs|degree|degrees)?")


def shape_of(value: Any) -> int:
    """Read the shape of a roof: a word of ``roof:shape``, also with ``roof`` behind it, or a code of CityGML.

    Gives the index into `ROOF_SHAPES`; `NOTHING` where the value is missing, `NO_SHAPE` for any other.

    Examples
    --------
    >>> [ROOF_SHAPES[shape_of(value)] for value in ("gabled", "Half_Hipped", "hipped roof", 1010, "3100", 1000.0)]
    ['gabled', 'half-hipped', 'hipped', 'skillion', 'gabled', 'flat']
    >>> shape_of("onion") == shape_of(1020) == NO_SHAPE, shape_of(None) == shape_of(" ") == NOTHING
    (True, True)
    """
    text = text_of(value)
    if not text:
        return NOTHING
    number = metres_of(text)
    if number in _CODES:
        return ROOF_SHAPES.index(_CODES[int(number)])
    words = re.sub(r"[\s_-]+", " ", text.lower()).removesuffix(" roof")
    name = _SAME_SHAPE.get(words, words)
    return ROOF_SHAPES.index(name) if name in ROOF_SHAPES else NO_SHAPE


def degrees_of(value: Any) -> float:
    """Read an angle in degrees, a number or text such as ``30``, ``30°`` or ``22.5 deg``; NaN where it is none.

    Examples
    --------
    >>> degrees_of("22,5 °"), degrees_of(30), degrees_of("steep")
    (22.5, 30.0, nan)
    """
    if isinstance(value, str):
        found = _DEGREES.fullmatch(value.strip().lower())
        return float(found[1].replace(",", ".")) if found else float("nan")
    return metres_of(value)


def direction_of(value: Any) -> float:
    """Read a direction, degrees clockwise from north or the word of one of 16; NaN where it is none.

    Examples
    --------
    >>> [direction_of(value) for value in ("S", "north-west", "NNE", "SouthEast", "157", "up")]
    [180.0, 315.0, 22.5, 135.0, 157.0, nan]
    """
    if isinstance(value, str):
        letters = re.sub(r"[\s_-]+", "", value.lower())
        for name, letter in _NAMES.items():
            letters = letters.replace(name, letter)
        if letters in _POINTS:
            return _POINTS.index(letters) * 360.0 / len(_POINTS)
    return degrees_of(value)


def across_of(value: Any) -> float:
    """Read an orientation: 1 for ``across`` (a ridge along the shorter side), 0 for ``along``, NaN for others."""
    return {"across": 1.0, "along": 0.0}.get(text_of(value).lower(), float("nan"))
