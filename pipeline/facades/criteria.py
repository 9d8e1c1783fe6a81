"""Criteria of reduction: how many per cent of an asset's polygons are kept (He et al., 4.2.1)."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from pipeline.architecture.roof_sides import Point

FULL, FLAT = 100, 0


@dataclass(frozen=True)
class Criteria:
    """What decides; a criterion that is not given keeps everything."""

    #: (float, float, float): where from a city is seen (m); None leaves out distance and orientation
    viewpoint: Point | None = None
    #: distances to the viewpoint (m) up to which all is kept, and from which on nothing; None for no criterion
    full: float | None = None
    reduced: float | None = None
    #: angle between the normal of a façade and the direction to the viewpoint (degrees) from which on nothing is
    #: kept; up to its half all is
    facing: float | None = None
    keep: Mapping[str, int] = field(default_factory=dict)  #: per cent that are kept at least, by label

    def share(self, place: Point, normal: Point, labels: Iterable[str]) -> int:
        """Evaluate a product: per cent of polygons that are kept, 0 to 100.

        Parameters
        ----------
        place, normal : (float, float, float)
            Its middle (m), and the unit normal of its façade, outwards.
        labels : iterable of str
            Semantics of the nodes that it comes from.

        Notes
        -----
        The least of distance and orientation, but no less than the most that `keep` has for a label; with `keep`
        alone all else is flat.

        Examples
        --------
        >>> seen = Criteria((0, 0, 0), 50, 150, keep={"door": 40})
        >>> [seen.share((0, y, 0), (0, -1, 0), labels) for y, labels in ((50, ()), (100, ()), (150, ("door",)))]
        [100, 50, 40]
        """
        kept = max((self.keep.get(label, FLAT) for label in labels), default=FLAT)
        found = []
        if self.viewpoint is not None:
            away = [there - here for there, here in zip(self.viewpoint, place, strict=True)]
            distance = math.hypot(*away)
            if self.full is not None and self.reduced is not None:
                found.append(_fall(distance, self.full, self.reduced))
            if self.facing is not None:
                dot = sum(a * b for a, b in zip(away, normal, strict=True))
                angle = math.degrees(math.acos(max(-1.0, min(1.0, dot / distance)))) if distance else 0.0
                found.append(_fall(angle, self.facing / 2, self.facing))
        if not found:
            return kept if self.keep else FULL
        return max(min(found), kept)


def _fall(value: float, low: float, high: float) -> int:
    """Give 100 up to `low`, 0 from `high` on, and whole numbers in between."""
    if value <= low:
        return FULL
    return FLAT if value >= high else round(FULL * (high - value) / (high - low))
