"""Forms of roofs by the attributes of footprints: OpenStreetMap's tags, CityGML's RoofType (step 1.2)."""

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.data.roof_forms import ACROSS, DIRECTION, HEIGHT, ROOF_SHAPES, SHAPE, SLOPE, no_forms
from tiler.footprints.footprint_attributes import known_attribute
from tiler.vectors.features import Features, text_of
from tiler.vectors.layers import Layer
from tiler.vectors.lengths import metres_of, number_of
from tiler.vectors.osm_tags import STOREY, tags_of
from tiler.vectors.roof_words import (
    LEAST_ANGLE,
    LEAST_HEIGHT,
    MOST_ANGLE,
    MOST_HEIGHT,
    NO_SHAPE,
    across_of,
    degrees_of,
    direction_of,
    shape_of,
)
from tiler.words.plain_text import ID_LENGTH, printable, shorten

ROOF_KEYS = ("roof:shape", "roof:height", "roof:angle", "roof:levels", "roof:direction", "roof:orientation")
# Attributes with a code of RoofType, where there is no ``roof:shape``; without marks between words, in any case.
CODE_ATTRIBUTES = ("rooftype", "dachform")
_SHP_NAME = 10  # letters of a name in a Shapefile


@dataclass(frozen=True, eq=False)
class RoofAttributes:
    """What attributes of ``n`` features say of their roofs."""

    forms: NDArray[np.float64]  # (n, 6): by the columns of `roof_forms`, but for that of the eaves
    # (n,): True where the height of the roof is its number of levels, of `STOREY` each
    by_levels: NDArray[np.bool_]
    unknown: list[str]  # the shape that is none of ours, ``""`` elsewhere
    # What cannot be read, or is out of bounds, of a feature with a shape; ``""`` where nothing is.
    wrong: list[str]


def find_roof_attributes(layer: Layer, asked: str) -> dict[str, str]:
    """Find the attribute of each of `ROOF_KEYS` that a layer has one of; none without one of the shape.

    That of the shape is the one asked for, else ``roof:shape``, ``roof_shape`` and the like, else one of
    `CODE_ATTRIBUTES`: that is alone, as other columns beside it do not mean what those of OpenStreetMap do. Tags
    of OSM data without a column are left out. ConfigError if there is no such attribute.
    """
    asked = known_attribute(layer, asked, layer.fields)
    plain = {_plain(field): field for field in reversed(layer.fields)}
    short = {_plain(field): field for field in reversed(layer.fields) if len(field) == _SHP_NAME}
    names = {key: plain.get(_plain(key), short.get(_plain(key[:_SHP_NAME]), "")) for key in ROOF_KEYS}
    found = {key: name for key, name in names.items() if name}
    if asked:
        return found | {"roof:shape": asked}
    if "roof:shape" in found:
        return found
    code = next((plain[name] for name in CODE_ATTRIBUTES if name in plain), "")
    return {"roof:shape": code} if code else {}


def roof_columns(layer: Layer, asked: str) -> list[str]:
    """List the attributes that forms of roofs are read from."""
    tags = layer.tags
    more = [tags.more] if tags is not None and tags.more else []
    return list(dict.fromkeys([*find_roof_attributes(layer, asked).values(), *more]))


def read_roofs(layer: Layer, asked: str, features: Features) -> RoofAttributes:
    """Read the forms of roofs of features that have the attributes which `roof_columns` names.

    A shape that is not ours, or none, is no form, whatever else is said; of a flat one nothing else is read.
    What is out of bounds counts as not said. The height is that of ``roof:height``; without it and without
    ``roof:angle`` that of ``roof:levels``, if these are more than 0.
    """
    n = len(features.wkb)
    values = _read_values(layer, asked, features)
    forms, by_levels = no_forms(n), np.zeros(n, np.bool_)
    unknown, wrong = [""] * n, [""] * n
    for row, value in enumerate(values.get("roof:shape", ())):
        shape = shape_of(value)
        if shape >= 0:
            if ROOF_SHAPES[shape] != "flat":
                tags = {key: of[row] for key, of in values.items()}
                forms[row], by_levels[row], wrong[row] = _read_form(tags)
            forms[row, SHAPE] = shape
        elif shape == NO_SHAPE:
            unknown[row] = printable(shorten(text_of(value), ID_LENGTH))
    return RoofAttributes(forms, by_levels, unknown, wrong)


def _read_values(layer: Layer, asked: str, features: Features) -> Mapping[str, Sequence[Any]]:
    """Give the values of each of `ROOF_KEYS` that may have any: of their own attributes, else of further tags."""
    names = find_roof_attributes(layer, asked)
    values: dict[str, Sequence[Any]] = {key: list(features.columns[name]) for key, name in names.items()}
    tags = layer.tags
    if tags is None or not tags.more:
        return values
    others = tags_of(features.columns[tags.more], ROOF_KEYS)
    for key, of in others.items():
        own = values.get(key, [None] * len(of))
        values[key] = [value if text_of(value) else other for value, other in zip(own, of, strict=True)]
    return values


def _read_form(tags: Mapping[str, Any]) -> tuple[NDArray[np.float64], bool, str]:
    """Read all but the shape; tells whether its height is that of levels, and what is wrong."""
    form, wrong = no_forms(1)[0], list[str]()

    def read(key: str, convert: Callable[[Any], float], low: float, high: float, bounds: str) -> float:
        if not text_of(tags.get(key)):
            return math.nan
        value = convert(tags[key])
        if low <= value <= high:
            return value
        wrong.append(f"{key} {shorten(repr(tags[key]), ID_LENGTH)} is not {bounds}")
        return math.nan

    form[HEIGHT] = read(
        "roof:height", metres_of, LEAST_HEIGHT, MOST_HEIGHT, _between(LEAST_HEIGHT, MOST_HEIGHT, "m")
    )
    angle = read("roof:angle", degrees_of, LEAST_ANGLE, MOST_ANGLE, _between(LEAST_ANGLE, MOST_ANGLE, "degrees"))
    form[SLOPE] = math.tan(math.radians(angle))
    form[DIRECTION] = read(
        "roof:direction", direction_of, 0.0, 360.0, "0 to 360 degrees, nor a word such as N, NNE or south-west"
    )
    form[ACROSS] = read("roof:orientation", across_of, 0.0, 1.0, "along or across")
    most = math.floor(MOST_HEIGHT / STOREY)
    levels = STOREY * read("roof:levels", number_of, 0.0, most, f"a number from 0 to {most}")
    by_levels = math.isnan(form[HEIGHT]) and math.isnan(form[SLOPE]) and levels > 0
    if by_levels:
        form[HEIGHT] = levels
    return form, by_levels, "; ".join(wrong)


def _between(low: float, high: float, unit: str) -> str:
    return f"{low:g} to {high:g} {unit}"


def _plain(name: str) -> str:
    return re.sub(r"[\s:_-]+", "", name).lower()
