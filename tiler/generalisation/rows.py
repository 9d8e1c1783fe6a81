"""Objects of a level as rows: what a layer of the output holds."""

from collections.abc import Iterable
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

LEVELS = ("lod1", "lod0c", "lod0b", "lod0a")

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Rows:
    """Objects of one level."""

    outlines: NDArray[np.object_]  # (n,): polygons and multipolygons (m)
    # (n,): text: of the object, of what stands for it one level up (``""`` for none), and of its cell
    id: NDArray[np.object_]
    parent: NDArray[np.object_]
    cell: NDArray[np.object_]
    # (n,): above ground, and of the ground (m; NaN where unknown)
    height: Array
    ground_height: Array
    members: NDArray[np.int64]  # (n,): buildings that it stands for
    landmark: NDArray[np.int64]  # (n,): 1 for a building that is left out of generalisation

    def __len__(self) -> int:
        return len(self.id)

    @property
    def area(self) -> Array:
        """Of the outlines (m2)."""
        found: Array = shapely.area(self.outlines)
        return found

    def take(self, rows: NDArray[Any]) -> "Rows":
        """Take some, in the order of the rows."""
        return Rows(*(getattr(self, one.name)[rows] for one in fields(self)))


@dataclass(frozen=True, eq=False)
class CellRows:
    """Cells: what the layer of cells holds."""

    outlines: NDArray[np.object_]  # (n,): polygons (m)
    # (n,): text: of the cell, and of its object of LoD0A, ``""`` where its land use is Other
    id: NDArray[np.object_]
    use: NDArray[np.bool_]  # (n,): whether its land use is Building
    # (n,): A - A_other and A_bldg of equation (1) (m2)
    free: Array
    built: Array
    members: NDArray[np.int64]  # (n,): buildings that are registered to it
    parent: NDArray[np.object_]


def join_rows(parts: Iterable[Rows]) -> Rows:
    """Put rows one after the other; none gives none."""
    text, none = np.empty(0, object), np.empty(0)
    number = np.empty(0, np.int64)
    several = [Rows(text, text, text, text, none, none, number, number), *parts]
    return Rows(*(np.concatenate([getattr(part, one.name) for part in several]) for one in fields(Rows)))


def level_word(level: str) -> str:
    """Name the level of a layer: 1, 0C, 0B, 0A."""
    return level.removeprefix("lod").upper()
