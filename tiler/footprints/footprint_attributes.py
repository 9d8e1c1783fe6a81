"""Ids and heights of footprints by the attributes of a file (step 1.2)."""

from collections.abc import Collection, Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.data.errors import ConfigError
from tiler.vectors.features import Features, text_of
from tiler.vectors.gdal_layer import list_some
from tiler.vectors.layers import Layer
from tiler.vectors.lengths import metres_of, number_of
from tiler.vectors.osm_tags import STOREY, OsmTags, osm_heights, osm_ids, values_of
from tiler.vectors.shapefile import find_wide_columns, is_shapefile
from tiler.words.plain_text import ID_LENGTH, printable, shorten

# Attributes that hold a building's own id, first found first taken, in any case: Dutch BAG (and its
# ten letters in SHP), INSPIRE and GML, OpenStreetMap, then names in general use.
ID_ATTRIBUTES = (
    *("identificatie", "identifica", "gml_id", "inspireid", "localid", "uuid", "full_id", "osm_id", "@id"),
    *("building_id", "buildingid", "bldg_id", "id", "gid", "fid", "objectid", "osmid"),
)

_WHOLE_FLOATS = 2.0**53  # below it each whole number is a float


def find_attribute(info: Layer, asked: str) -> str:
    """Check that an attribute, or a tag of OSM of that name, exists, as `known_attribute`."""
    tags = info.tags
    known = {*info.fields, info.fid_name} | ({"height", "building:levels"} if tags else set())
    return known_attribute(info, asked, known)


def known_attribute(info: Layer, asked: str, known: Collection[str]) -> str:
    """Give the attribute asked for; ``""`` for a layer without features; ConfigError if it is no known one."""
    if asked and asked not in known:
        if info.n_features == 0:
            return ""
        raise ConfigError(
            f"{info.path}: has no attribute {asked!r}; it has: {list_some(info.fields)}; name one of these"
        )
    return asked


def find_id_attribute(info: Layer, asked: str) -> str:
    """Give the attribute that is asked for, else the first of `ID_ATTRIBUTES`, else ``""``."""
    if asked:
        return find_attribute(info, asked)
    lower = {field.lower(): field for field in info.fields}
    return next((lower[name] for name in ID_ATTRIBUTES if name in lower), "")


def id_columns(layer: Layer, id_name: str) -> list[str]:
    """List the attributes that ids are made of: two for OSM data with ids of relations and of ways."""
    tags = _pair_of_ids(layer, id_name)
    return [tags.relation_id, tags.way_id] if tags else [id_name] * bool(id_name)


def read_ids(layer: Layer, id_name: str, features: Features) -> list[str]:
    """Give the ids of features as text, ``""`` where there is none."""
    tags = _pair_of_ids(layer, id_name)
    values = osm_ids(tags, features.columns) if tags else features.columns[id_name]
    return [id_text(value) for value in values]


def height_columns(layer: Layer, height_name: str) -> list[str]:
    """List the attributes that heights are read from."""
    tags = layer.tags
    own = [height_name] if height_name in layer.fields or height_name == layer.fid_name else []
    return list(dict.fromkeys([*own, *(tags.fields if tags else ())])) if height_name or tags else []


def read_heights(
    layer: Layer, height_name: str, features: Features
) -> tuple[NDArray[np.float64], NDArray[np.bool_], list[str]]:
    """Give the heights of features above ground, by an attribute, or by the tags of OSM data.

    Parameters
    ----------
    height_name : str
        Attribute with heights; ``""`` for none, or for the tags of OSM data.
    features : Features
        With the attributes of `height_columns`.

    Returns
    -------
    height : float64, (n,)
        Height (m); NaN where there is none above 0.
    by_levels : bool, (n,)
        True where it is the number of levels, of `STOREY` each.
    wrong : list of str
        What is wrong with each, ``""`` where nothing is: where an attribute is asked for, a height that is missing
        is wrong too.
    """
    tags = layer.tags
    n = len(features.wkb)
    if not height_name and tags is None:
        return np.full(n, np.nan), np.zeros(n, np.bool_), [""] * n
    if tags is not None and height_name in ("", "height", tags.column.get("height", "")):
        height, by_levels, unread = osm_heights(tags, features.columns)
        told = np.array([value is not None for value in unread.tolist()], np.bool_)
        told |= bool(height_name) & np.isnan(height)
        return height, by_levels, _not_heights(unread, told)
    if tags is not None and height_name in ("building:levels", tags.column.get("building:levels", "")):
        values = values_of(tags, "building:levels", features.columns)
        height = STOREY * np.array([number_of(value) for value in values], np.float64)
        by_levels = np.ones(n, np.bool_)
    else:
        values = list(features.columns[height_name])
        height = np.array([metres_of(value) for value in values], np.float64)
        by_levels = np.zeros(n, np.bool_)
    bad = ~(np.isfinite(height) & (height > 0))
    height[bad] = np.nan
    return height, by_levels & ~bad, _not_heights(values, bad)


def explain_repeated(layer: Layer, id_name: str, name: str) -> str:
    """Say how an id that several footprints carry is made unique, and where the format is to blame for it."""
    plain = "completed by its geometry"
    if layer.gdal is None or layer.gdal.dtype_of(id_name) != "float64" or metres_of(name) < _WHOLE_FLOATS:
        return plain
    width = find_wide_columns(layer.path).get(id_name) if is_shapefile(layer.path) else None
    column = (
        f"the table of a Shapefile holds {id_name} as a number of {width} digits, read"
        if width
        else f"{id_name} is read"
    )
    return (
        f"{plain}; {column} as a float, which keeps 15 to 17 digits: ids that differ in the last ones became "
        "equal. Export the ids as text, or as whole numbers of a GPKG"
    )


def id_text(value: Any) -> str:
    """Write an id as text, whole floats as integers (a column with nulls may be read as float), ``""`` for none.

    Control characters are escaped, and what is longer than `ID_LENGTH` ends in a hash: an id becomes a key of
    files and part of messages.

    Examples
    --------
    >>> id_text(12.0), id_text(" a1 "), id_text(None), id_text(float("nan"))
    ('12', 'a1', '', '')
    """
    return shorten(printable(text_of(value)), ID_LENGTH)


def _pair_of_ids(layer: Layer, id_name: str) -> OsmTags | None:
    """Give the tags of a layer whose ids are those of relations and of ways, where one of these is asked for."""
    tags = layer.tags
    return tags if tags is not None and tags.way_id and id_name in (tags.relation_id, tags.way_id) else None


def _not_heights(values: Iterable[Any], bad: NDArray[np.bool_]) -> list[str]:
    return [
        f"{shorten(repr(value), ID_LENGTH)} is no height above 0 m" if wrong else ""
        for value, wrong in zip(values, bad, strict=True)
    ]
