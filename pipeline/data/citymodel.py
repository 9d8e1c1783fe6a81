"""The city model: footprints, and buildings as prisms between the ground and a roof."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.data.errors import InputError
from pipeline.data.roof_forms import N_COLUMNS, no_forms
from pipeline.data.roofs import Roofs, highest_roofs, join_roofs, take_roofs


@dataclass(frozen=True, eq=False)
class Footprints:
    """Building footprints, one polygon a row."""

    #: (n,): shapely Polygons in the region's CRS (m), without Z, courtyards as holes
    polygons: NDArray[np.object_]
    ids: NDArray[np.str_]  #: (n,): region-wide building id: the input's own, else made from the geometry
    #: (n,): height above ground (m) from an attribute of the input; NaN where there is none
    given_height: NDArray[np.float64]
    #: (n, 6): what attributes say of their roofs, by the columns of `roof_forms`; nothing by default
    forms: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, N_COLUMNS)))

    def __post_init__(self) -> None:
        """Give no form to any footprint where none is stated."""
        if not len(self.forms):
            object.__setattr__(self, "forms", no_forms(len(self.polygons)))


def take_footprints(footprints: Footprints, rows: NDArray[np.integer[Any]] | NDArray[np.bool_]) -> Footprints:
    """Take some footprints, in the order of the rows."""
    return Footprints(
        footprints.polygons[rows], footprints.ids[rows], footprints.given_height[rows], footprints.forms[rows]
    )


@dataclass(frozen=True, eq=False)
class Prisms:
    """Buildings, or parts of them, as prisms from the ground to a roof: what a mesh is made around."""

    #: (n,): shapely Polygons in the region's CRS (m): oriented (shell counter-clockwise), without Z
    polygons: NDArray[np.object_]
    ids: NDArray[np.str_]  #: (n,): ids of the rows, each once; a merged building has the id of its largest member
    #: (n,): the same ids as numbers below 2**53, for formats without strings; see `number_ids`
    numbers: NDArray[np.int64]
    ground: NDArray[np.float64]  #: (n,): absolute ground height (m)
    roofs: Roofs  #: roofs, absolute heights (m)

    def __len__(self) -> int:
        return len(self.polygons)

    @property
    def roof(self) -> NDArray[np.float64]:
        """Highest place of each roof (m), float64 (n,)."""
        return highest_roofs(self.roofs, self.polygons)


@dataclass(frozen=True, eq=False)
class CityModel(Prisms):
    """Buildings with what they were made of (paper, section 4.2).

    A house of several heights has a row for each part; all others have one row.

    Attributes
    ----------
    polygons, ids, numbers, ground, roofs
        As of `Prisms`.
    members : tuple of n tuples of str
        Ids of the input footprints that each building was made of, ascending, itself included.
    house : str, (n,)
        Id of the building that the row is a part of; the row's own id where it is the whole.
    """

    members: tuple[tuple[str, ...], ...]
    house: NDArray[np.str_]


def take_model(model: CityModel, rows: NDArray[np.integer[Any]] | slice) -> CityModel:
    """Take some buildings, in the order of the rows."""
    chosen = np.arange(len(model))[rows]
    return CityModel(
        model.polygons[chosen],
        model.ids[chosen],
        model.numbers[chosen],
        model.ground[chosen],
        take_roofs(model.roofs, chosen),
        tuple(model.members[row] for row in chosen.tolist()),
        model.house[chosen],
    )


def join_models(models: Sequence[CityModel]) -> CityModel:
    """Put the buildings of one or more models one after the other."""
    return CityModel(
        np.concatenate([model.polygons for model in models]),
        np.concatenate([model.ids for model in models]),
        np.concatenate([model.numbers for model in models]),
        np.concatenate([model.ground for model in models]),
        join_roofs([model.roofs for model in models]),
        tuple(names for model in models for names in model.members),
        np.concatenate([model.house for model in models]),
    )


def number_ids(ids: NDArray[np.str_]) -> NDArray[np.int64]:
    """Give each building id a number that depends on that id alone.

    Parameters
    ----------
    ids : str, (n,)
        Building ids.

    Returns
    -------
    int64, (n,)
        The id itself where it is a decimal number below 2**53, else 52 bits of its BLAKE2b hash.

    Raises
    ------
    InputError
        If two different ids get the same number.

    Examples
    --------
    >>> number_ids(np.array(["0363100012078463"]))
    array([363100012078463])
    """
    numbers = np.fromiter((_number(str(name)) for name in ids), np.int64, len(ids))
    order = np.lexsort((ids, numbers))
    clash = np.flatnonzero((np.diff(numbers[order]) == 0) & (ids[order][1:] != ids[order][:-1]))
    if len(clash):
        one, two = ids[order][clash[0]], ids[order][clash[0] + 1]
        raise InputError(
            f"building ids {str(one)!r} and {str(two)!r} both have the number {numbers[order][clash[0]]}; "
            "rename one, or name another --id-attribute"
        )
    return numbers


def make_ids(polygons: NDArray[np.object_]) -> NDArray[np.str_]:
    """Make ids from geometry alone: equal polygons get equal ids, whatever file, row or start vertex.

    Parameters
    ----------
    polygons : object, (n,)
        shapely Polygons.

    Returns
    -------
    str, (n,)
        ``"g"`` and 13 hexadecimal digits.
    """
    blobs = shapely.to_wkb(shapely.normalize(shapely.force_2d(polygons)), byte_order=1)
    return np.array(["g" + hashlib.blake2b(blob, digest_size=7).hexdigest()[:13] for blob in blobs], dtype=np.str_)


def _number(name: str) -> int:
    if name.isascii() and name.isdigit() and int(name) < 2**53:
        return int(name)
    return int.from_bytes(hashlib.blake2b(name.encode(), digest_size=8).digest()) >> 12
