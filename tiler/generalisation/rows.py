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
    """Objects of one level.

    Attributes
    ----------
    outlines : object, (n,)
        Polygons and multipolygons (m).
    id, parent, cell : object, (n,)
        Text: of the object, of what stands for it one level up (``""`` for none), and of its cell.
    height, ground_height : float64, (n,)
        Above ground, and of the ground (m; NaN where unknown).
    members : int64, (n,)
        Buildings that it stands for.
    landmark : int64, (n,)
        1 for a building that is left out of generalisation.
    """

    outlines: NDArray[np.object_]
    id: NDArray[np.object_]
    parent: NDArray[np.object_]
    cell: NDArray[np.object_]
    height: Array
    ground_height: Array
    members: NDArray[np.int64]
    landmark: NDArray[np.int64]

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
    """Cells: what the layer of cells holds.

    Attributes
    ----------
    outlines : object, (n,)
        Polygons (m).
    id, parent : object, (n,)
        Text: of the cell, and of its object of LoD0A, ``""`` where its land use is Other.
    use : bool, (n,)
        Whether its land use is Building.
    free, built : float64, (n,)
        A - A_other and A_bldg of equation (1) (m2).
    members : int64, (n,)
        Buildings that are registered to it.
    """

    outlines: NDArray[np.object_]
    id: NDArray[np.object_]
    use: NDArray[np.bool_]
    free: Array
    built: Array
    members: NDArray[np.int64]
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
