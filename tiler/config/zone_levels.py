"""Levels of detail of places, by the zones of a run."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from tiler.config.zones import LEVELS, Zones


def describe_zones(zones: Zones) -> list[dict[str, Any]]:
    """Write zones for ``run.json``: places as well-known binary in hexadecimal digits, none for the rest."""
    return [{"level": level, "size (m)": size, "place": place or None} for level, size, place in zones]


def read_described(rows: Sequence[Mapping[str, Any]]) -> Zones:
    """Read what `describe_zones` wrote; KeyError, TypeError or ValueError if it is something else."""
    zones = tuple((str(row["level"]), float(row["size (m)"]), row["place"] or "") for row in rows)
    if zones and (zones[-1][2] or not {level for level, _, _ in zones} <= set(LEVELS)):
        raise ValueError("zones without the rest, or with another level")
    shapely.from_wkb([place for _, _, place in zones if place])
    return zones


def find_levels(zones: Zones, xy: NDArray[np.float64]) -> NDArray[np.int8]:
    """Find the level of detail of places: the finest of the zones that hold them, their borders included.

    Parameters
    ----------
    xy : float64, (n, 2)
        Places in the region's CRS (m).

    Returns
    -------
    int8, (n,)
        Index into `LEVELS`.

    Examples
    --------
    >>> zones = (("2.2", 5.0, shapely.box(0, 0, 9, 9).wkb_hex), ("1.2", 20.0, ""))
    >>> [LEVELS[level] for level in find_levels(zones, np.array([[9.0, 4.0], [9.1, 4.0]]))]
    ['2.2', '1.2']
    """
    rest = next(level for level, _, place in zones if not place)
    found = np.full(len(xy), len(LEVELS), np.int8)
    for level, _, place in zones:
        if place:
            shape = shapely.from_wkb(place)
            shapely.prepare(shape)
            inside = shapely.intersects_xy(shape, xy[:, 0], xy[:, 1])
            found[inside] = np.minimum(found[inside], LEVELS.index(level))
    return np.where(found < len(LEVELS), found, LEVELS.index(rest)).astype(np.int8)
