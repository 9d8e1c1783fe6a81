"""OpenStreetMap data as footprints: which features are buildings, their ids and their heights (step 1.2).

OSM reaches a run as an extract (``.osm``, ``.osm.pbf``), as what ogr2ogr made of one (``osm_id``, ``osm_way_id``,
``other_tags``), and as GeoJSON or GPKG of Overpass, QuickOSM and OSMnx (``@id``, ``full_id``, ``osmid``).
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tiler.vectors.features import text_of, to_objects
from tiler.vectors.lengths import metres_of, number_of

STOREY = 3.0  # m; height of a level where a building has only their number
# Attributes that only OSM data have, in lower case, with colons for underscores.
_MARKS = ("osm:id", "osm:way:id", "@id", "full:id", "osmid")
_TAGS = ("other:tags", "all:tags")  # all further tags in one text: hstore, or JSON from GDAL 3.7 on
_PAIR = re.compile(r'"((?:[^"\\]|\\.)*)"\s*(?:=>|:)\s*"((?:[^"\\]|\\.)*)"')
_KEYS = ("building", "building:part", "height", "building:levels", "min_height", "building:min_level")


@dataclass(frozen=True)
class OsmTags:
    """Where a layer of OSM data keeps what a run needs."""

    column: Mapping[str, str]  # attribute of each tag that has one of its own
    more: str  # attribute with all further tags as text, ``""`` for none
    # Attributes with the ids of relations and of ways, ``""`` where the layer has not both.
    relation_id: str
    way_id: str

    @property
    def fields(self) -> tuple[str, ...]:
        """Attributes that are read."""
        named = [*self.column.values(), self.more, self.relation_id, self.way_id]
        return tuple(dict.fromkeys(name for name in named if name))


def find_osm_tags(fields: Sequence[str]) -> OsmTags | None:
    """Find the tags of OSM data among the attributes of a layer.

    None for other data: without an id of OSM, or without the tag ``building``.

    Examples
    --------
    >>> find_osm_tags(["osm_id", "osm_way_id", "building", "other_tags"]).fields
    ('building', 'other_tags', 'osm_id', 'osm_way_id')
    >>> find_osm_tags(["id", "building"]) is None
    True
    """
    lower = {_plain(field): field for field in reversed(fields)}
    column = {key: lower[_plain(key)] for key in _KEYS if _plain(key) in lower}
    more = next((lower[name] for name in _TAGS if name in lower), "")
    if not any(mark in lower for mark in _MARKS) or not (more or "building" in column):
        return None
    both = "osm:id" in lower and "osm:way:id" in lower
    ids = (lower["osm:id"], lower["osm:way:id"]) if both else ("", "")
    return OsmTags(column, more, *ids)


def is_building(tags: OsmTags, columns: Mapping[str, NDArray[Any]]) -> NDArray[np.bool_]:
    """Tell the features with ``building=*`` or ``building:part=*``, whose value is not ``no``: bool (n,).

    `columns` has the attributes that `OsmTags.fields` names.
    """
    house, part = (values_of(tags, key, columns) for key in ("building", "building:part"))
    return np.array([_is_set(a) or _is_set(b) for a, b in zip(house, part, strict=True)], np.bool_)


def is_part(tags: OsmTags, columns: Mapping[str, NDArray[Any]]) -> NDArray[np.bool_]:
    """Tell the features with ``building:part=*``, whose value is not ``no``; parameters as of `is_building`."""
    return np.array([_is_set(value) for value in values_of(tags, "building:part", columns)], np.bool_)


def is_raised(tags: OsmTags, columns: Mapping[str, NDArray[Any]]) -> NDArray[np.bool_]:
    """Tell the features that begin above the ground by ``min_height`` or ``building:min_level``."""
    height, level = (values_of(tags, key, columns) for key in ("min_height", "building:min_level"))
    return np.array([metres_of(a) > 0 or number_of(b) > 0 for a, b in zip(height, level, strict=True)], np.bool_)


def osm_ids(tags: OsmTags, columns: Mapping[str, NDArray[Any]]) -> NDArray[np.object_]:
    """Give the ids of ways and relations as ``way/123`` and ``relation/7``; None where there is neither."""
    pairs = zip(columns[tags.relation_id], columns[tags.way_id], strict=True)
    ids = [_prefixed("relation", relation) or _prefixed("way", way) or None for relation, way in pairs]
    return to_objects(ids)


def osm_heights(
    tags: OsmTags, columns: Mapping[str, NDArray[Any]]
) -> tuple[NDArray[np.float64], NDArray[np.bool_], NDArray[np.object_]]:
    """Give the heights by ``height``, else by ``building:levels`` of `STOREY` each.

    Returns
    -------
    height : float64, (n,)
        Height (m), NaN where neither can be read.
    by_levels : bool, (n,)
        True where it is by levels.
    unread : object, (n,)
        Values of the tag ``height`` that are no height above 0 m; None elsewhere.
    """
    given, levels = (values_of(tags, key, columns) for key in ("height", "building:levels"))
    height = np.array([metres_of(value) for value in given], np.float64)
    bad = ~(np.isfinite(height) & (height > 0))
    unread = to_objects([v if wrong and text_of(v) else None for v, wrong in zip(given, bad, strict=True)])
    by_levels = STOREY * np.array([number_of(value) for value in levels], np.float64)
    by_levels[~(np.isfinite(by_levels) & (by_levels > 0))] = np.nan
    return np.where(bad, by_levels, height), bad & np.isfinite(by_levels), unread


def values_of(tags: OsmTags, key: str, columns: Mapping[str, NDArray[Any]]) -> list[Any]:
    """Give the values of a tag: of its own attribute, else of the text with all further tags."""
    n = len(next(iter(columns.values()))) if columns else 0
    own = columns[tags.column[key]] if key in tags.column else [None] * n
    if not tags.more:
        return list(own)
    texts = columns[tags.more]
    return [value if text_of(value) else _parse(text).get(key) for value, text in zip(own, texts, strict=True)]


def tags_of(texts: NDArray[Any], keys: Sequence[str]) -> dict[str, list[str | None]]:
    """Give the values of some tags from texts with all further tags, (n,): each text is parsed once.

    Examples
    --------
    >>> tags_of(np.array(['"roof:shape"=>"gabled","roof:height"=>"3"', None], object), ["roof:shape"])
    {'roof:shape': ['gabled', None]}
    """
    parsed = [_parse(text) for text in texts]
    return {key: [tags.get(key) for tags in parsed] for key in keys}


def _plain(field: str) -> str:
    return field.lower().replace("_", ":")


def _parse(text: Any) -> dict[str, str]:
    if not isinstance(text, str):
        return {}
    return {_unescape(key): _unescape(value) for key, value in _PAIR.findall(text)}


def _unescape(text: str) -> str:
    return re.sub(r"\\(.)", r"\1", text)


def _is_set(value: Any) -> bool:
    return text_of(value).lower() not in ("", "no", "false")


def _prefixed(kind: str, value: Any) -> str:
    text = text_of(value)
    return text if not text or "/" in text else f"{kind}/{text}"
