"""Which operation PROJ takes between two CRSs at a place, how exact it is, and which grid a better one lacks."""

import math
import warnings
from dataclasses import dataclass

import pyproj
from pyproj.transformer import AreaOfInterest, TransformerGroup

from tiler.georeference.crs import Box, crs_name, geographic_box


@dataclass(frozen=True)
class Operation:
    """A coordinate operation as it was used."""

    # Names of the CRSs.
    source: str
    target: str
    description: str  # what PROJ calls it
    accuracy: float | None  # accuracy that the register states (m); None if it is unknown
    # Grids that a more exact operation at this place needs and that are not installed.
    missing_grids: tuple[str, ...] = ()

    @property
    def exact(self) -> str:
        """Describe how exact it is."""
        return "accuracy unknown" if self.accuracy is None else f"accurate to {self.accuracy:g} m"

    def describe(self) -> str:
        """Describe in a sentence which operation it is, how exact, and what a better one needs."""
        text = f"from {self.source} to {self.target} by {self.description!r}, {self.exact}"
        if self.missing_grids:
            grids = ", ".join(self.missing_grids)
            text += f"; a better one needs the grid {grids} (package proj-data, or: pyproj sync --file {grids})"
        return text

    def is_worse_than(self, bound: float) -> bool:
        """Whether the accuracy is unknown, or worse than a bound (m)."""
        return self.accuracy is None or self.accuracy > bound


def find_operation(source: pyproj.CRS, target: pyproj.CRS, box: Box) -> Operation:
    """Find the operation that PROJ uses between two horizontal CRSs at the middle of a box of the target.

    Notes
    -----
    `pyproj.transformer.TransformerGroup` lists operations that a `Transformer` does not take, so the accuracy is
    that of the operation after a transform. Which operations lack a grid is asked of the group, at this place.
    """
    back = pyproj.Transformer.from_crs(target, source, always_xy=True)
    place = back.transform((box[0] + box[2]) / 2, (box[1] + box[3]) / 2)
    forward = pyproj.Transformer.from_crs(source, target, always_xy=True)
    forward.transform(*place)
    try:
        used = forward.get_last_used_operation()
    except pyproj.exceptions.ProjError:  # there is one operation alone
        used = forward
    accuracy = float(used.accuracy) if math.isfinite(used.accuracy) and used.accuracy >= 0 else None
    names = crs_name(source), crs_name(target)
    steps = [step for step in str(used.description).split(" + ") if not step.startswith("axis order change")]
    return Operation(*names, " + ".join(steps), accuracy, _missing_grids(source, target, box, accuracy))


def _missing_grids(source: pyproj.CRS, target: pyproj.CRS, box: Box, accuracy: float | None) -> tuple[str, ...]:
    """Name the grids of the most exact operation at a place that cannot be used, where it is more exact."""
    where = geographic_box(box, target)
    if where is None:
        return ()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # that the best one lacks its grid
        group = TransformerGroup(source, target, always_xy=True, area_of_interest=AreaOfInterest(*where))
    better = [
        operation
        for operation in group.unavailable_operations
        if 0 <= operation.accuracy < (math.inf if accuracy is None else accuracy)
    ]
    if not better:
        return ()
    best = min(better, key=lambda operation: operation.accuracy)
    return tuple(str(grid.short_name) for grid in best.grids if not grid.available)
