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
    """

    stage: str  #: name of the stage that is read
    halo: float = 0.0  #: how far around the reader's box (m)
    #: use, instead of the box of a read item, the ``"extent"`` among the facts of its result: four numbers, or
    #: None for an item that holds nothing and is never read. Such a stage must have run in an earlier call
    by_extent: bool = False
    #: a stage of an earlier call: the ``"extent"`` that its result for the same item states takes the place of the
    #: reader's box; nothing is read where it is None
    around: str = ""
    own: bool = False  #: read the item of the reader's own name alone
    #: a stage of an earlier call: read the items listed as ``"names"`` among the facts of its result for the same
    #: item
    named_by: str = ""
    #: an item that was set aside is left out. Otherwise, and where it is the item of the reader's own name, the
    #: reader is not run either. With `own`, an item that the stage was not run for is left out, too
    optional: bool = False
    #: leave out the items that meet the reader's box in a corner only: of the tiles around a tile the four beside
    #: it and itself are read, of the seams its own four
    beside: bool = False
    #: of all items but the one of the reader's own name it counts only that they are there, not what they hold:
    #: their content is in no key, and the reader must not look at it. It does not wait for them either: they are
    #: taken to be there, and the reader runs again in the end if one of them failed
    others_by_name: bool = False
    #: of each result the function looks only at what lies at the reader's box grown by the halo: a change
    #: elsewhere in it, as `Engine.changes` knows of one, leaves the reader's result as it is
    within: bool = False
    #: with `own` and `optional`: where there is no such item, the key is as if the stage was not read
    silent: bool = False

    def __post_init__(self) -> None:
        if not (math.isfinite(self.halo) and self.halo >= 0):
            raise ValueError(f"read of {self.stage}: halo {self.halo} m, expected 0 or more")


@dataclass(frozen=True)
class Stage:
    """A step of a run: a pure function, and all that its result depends on."""

    name: str  #: name, and the folder in the store
    scope: Scope  #: what it is computed for
    #: top-level function of a `Task`; it gives back facts: a small dict of plain JSON values. Where it gives back
    #: None, nothing of the item is kept, and a later call must run it
    function: "Callable[[Task], Facts | None]"
    reads: tuple[Read, ...] = ()  #: the stages whose results it may read
    #: the attributes of the run's parameters that it may use; a change of another one does not touch its results
    parameters: tuple[str, ...] = ()
    version: int = 1  #: raise it when the function computes something else
    #: a stage of the same scope: where it is run in the same call, an item is not begun before that stage's item
    #: of its name, and then in one submission with it. It reads nothing of it by that
    after: str = ""
    small: bool = False  #: an item takes some milliseconds: where many may run, several are submitted together


@dataclass(frozen=True)
class FileItem:
    """An input file, or a share of one."""

    path: str  #: where it is; no part of any key
    box: Box  #: xmin, ymin, xmax, ymax of its content (m)
    identity: str  #: changes when the content does: path, size and time of change, say
    frame: Frame = AS_IT_IS  #: how its coordinates become those of the region
    #: (int, int): which of the equal shares of its points it has, and of how many; each is a task of its own
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

    Raises
    ------
    ValueError
        If a box is not finite or upside down.
    """

    files: Mapping[str, FileItem] = field(default_factory=dict)  #: input files
    #: boxes of tiles and seams: xmin, ymin, xmax, ymax (m)
    tiles: Mapping[str, Box] = field(default_factory=dict)
    seams: Mapping[str, Box] = field(default_factory=dict)
    bounds: Box = (0.0, 0.0, 0.0, 0.0)  #: box of the region (m), the box of its one item ``"region"``
    identity: str = ""  #: what else all results depend on, such as the CRS; part of every key
    #: boxes within the region that no tile covers (m); part of the keys of tiles and seams near them
    absent: tuple[Box, ...] = ()
    near: float = 0.0  #: how far from its extent a tile or seam may look whether there is a tile (m)
    #: the tile that owns each seam: the seams of one are submitted together. One without an owner goes alone
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
