"""What a stage declares, and the layout: the items of every scope with their boxes."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import TYPE_CHECKING, Any

from tiler.georeference.frame import AS_IT_IS, Frame

if TYPE_CHECKING:
    from tiler.engine.task import Task

Box = tuple[float, float, float, float]
Facts = dict[str, Any]
Share = tuple[int, int]

WHOLE: Share = 0, 1  # the only one of a file

REGION_ITEM = "region"


class Scope(Enum):
    """What a stage is computed for, one result each."""

    FILE = "file"
    TILE = "tile"
    SEAM = "seam"
    REGION = "region"


@dataclass(frozen=True)
class Read:
    """What a stage reads of another one.

    All items of that stage are read whose box meets the reader's own box grown by the halo; boxes are closed, so
    touching counts. A stage of the whole region reads all, and is read by all.

    Attributes
    ----------
    stage : str
        Name of the stage that is read.
    halo : float
        How far around the reader's box (m).
    by_extent : bool
        Use, instead of the box of a read item, the ``"extent"`` among the facts of its result: four numbers, or
        None for an item that holds nothing and is never read. Such a stage must have run in an earlier call.
    around : str
        A stage of an earlier call: the ``"extent"`` that its result for the same item states takes the place of
        the reader's box; nothing is read where it is None.
    own : bool
        Read the item of the reader's own name alone.
    named_by : str
        A stage of an earlier call: read the items listed as ``"names"`` among the facts of its result for the
        same item.
    optional : bool
        An item that was set aside is left out. Otherwise, and where it is the item of the reader's own name, the
        reader is not run either. With `own`, an item that the stage was not run for is left out, too.
    beside : bool
        Leave out the items that meet the reader's box in a corner only: of the tiles around a tile the four beside
        it and itself are read, of the seams its own four.
    others_by_name : bool
        Of all items but the one of the reader's own name it counts only that they are there, not what they hold:
        their content is in no key, and the reader must not look at it. It does not wait for them either: they are
        taken to be there, and the reader runs again in the end if one of them failed.
    within : bool
        Of each result the function looks only at what lies at the reader's box grown by the halo: a change
        elsewhere in it, as `Engine.changes` knows of one, leaves the reader's result as it is.
    silent : bool
        With `own` and `optional`: where there is no such item, the key is as if the stage was not read.
    """

    stage: str
    halo: float = 0.0
    by_extent: bool = False
    around: str = ""
    own: bool = False
    named_by: str = ""
    optional: bool = False
    beside: bool = False
    others_by_name: bool = False
    within: bool = False
    silent: bool = False

    def __post_init__(self) -> None:
        if not (math.isfinite(self.halo) and self.halo >= 0):
            raise ValueError(f"read of {self.stage}: halo {self.halo} m, expected 0 or more")


@dataclass(frozen=True)
class Stage:
    """A step of a run: a pure function, and all that its result depends on.

    Attributes
    ----------
    name : str
        Name, and the folder in the store.
    scope : Scope
        What it is computed for.
    function : callable
        Top-level function of a `Task`; it gives back facts: a small dict of plain JSON values. Where it gives back
        None, nothing of the item is kept, and a later call must run it.
    reads : tuple of Read
        The stages whose results it may read.
    parameters : tuple of str
        The attributes of the run's parameters that it may use; a change of another one does not touch its results.
    version : int
        Raise it when the function computes something else.
    after : str
        A stage of the same scope: where it is run in the same call, an item is not begun before that stage's item
        of its name, and then in one submission with it. It reads nothing of it by that.
    small : bool
        An item takes some milliseconds: where many may run, several are submitted together.
    """

    name: str
    scope: Scope
    function: "Callable[[Task], Facts | None]"
    reads: tuple[Read, ...] = ()
    parameters: tuple[str, ...] = ()
    version: int = 1
    after: str = ""
    small: bool = False


@dataclass(frozen=True)
class FileItem:
    """An input file, or a share of one.

    Attributes
    ----------
    path : str
        Where it is; no part of any key.
    box : tuple of float
        xmin, ymin, xmax, ymax of its content (m).
    identity : str
        Changes when the content does: path, size and time of change, say.
    frame : Frame
        How its coordinates become those of the region.
    share : (int, int)
        Which of the equal shares of its points it has, and of how many; each is a task of its own.
    """

    path: str
    box: Box
    identity: str
    frame: Frame = AS_IT_IS
    share: Share = WHOLE


def whole_file(name: str) -> str:
    """Name of the file that an item is a share of: what is before a full stop.

    Examples
    --------
    >>> whole_file("tile.03"), whole_file("tile")
    ('tile', 'tile')
    """
    return name.partition(".")[0]


@dataclass(frozen=True)
class Layout:
    """The items of every scope, by name.

    Attributes
    ----------
    files : mapping of str to FileItem
        Input files.
    tiles, seams : mapping of str to tuple of float
        Boxes of tiles and seams: xmin, ymin, xmax, ymax (m).
    bounds : tuple of float
        Box of the region (m), the box of its one item ``"region"``.
    identity : str
        What else all results depend on, such as the CRS; part of every key.
    absent : tuple of tuple of float
        Boxes within the region that no tile covers (m); part of the keys of tiles and seams near them.
    near : float
        How far from its extent a tile or seam may look whether there is a tile (m).
    owners : mapping of str to str
        The tile that owns each seam: the seams of one are submitted together. One without an owner goes alone.

    Raises
    ------
    ValueError
        If a box is not finite or upside down.
    """

    files: Mapping[str, FileItem] = field(default_factory=dict)
    tiles: Mapping[str, Box] = field(default_factory=dict)
    seams: Mapping[str, Box] = field(default_factory=dict)
    bounds: Box = (0.0, 0.0, 0.0, 0.0)
    identity: str = ""
    absent: tuple[Box, ...] = ()
    near: float = 0.0
    owners: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for scope in Scope:
            for name, box in self.boxes(scope).items():
                check_box(f"{scope.value} {name}", box)

    def boxes(self, scope: Scope) -> Mapping[str, Box]:
        """Give the items of a scope with their boxes."""
        match scope:
            case Scope.FILE:
                return {name: item.box for name, item in self.files.items()}
            case Scope.TILE:
                return self.tiles
            case Scope.SEAM:
                return self.seams
            case Scope.REGION:
                return {REGION_ITEM: self.bounds}


def boxes_touch(one: Box, other: Box) -> bool:
    """Return whether two boxes have a point in common; their borders belong to them."""
    return one[0] <= other[2] and other[0] <= one[2] and one[1] <= other[3] and other[1] <= one[3]


def check_box(name: str, box: Box) -> None:
    """Raise ValueError unless a box is four finite numbers, low before high."""
    if len(box) != 4 or not all(math.isfinite(v) for v in box) or box[0] > box[2] or box[1] > box[3]:
        raise ValueError(f"{name}: box {tuple(box)}, expected finite xmin, ymin, xmax, ymax")
