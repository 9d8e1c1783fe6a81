"""Trees of a town: at the corners of lots, which no house reaches."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from pipeline.architecture.lots import list_corners, lot_random

SIDES = 8  # of the rings of a crown


@dataclass(frozen=True)
class Tree:
    """A tree whose crown is an ellipsoid."""

    #: its numbers: those of the lot whose lower left corner it stands at
    i: int
    j: int
    #: its foot, in the CRS of the town (m)
    x: float
    y: float
    z: float
    height: float  #: from its foot to its top (m)
    radius: float  #: of its crown (m), which begins at a third of the height

    @property
    def middle(self) -> float:
        """Height of the middle of its crown (m)."""
        return self.z + self.height * 2 / 3

    @property
    def half_height(self) -> float:
        """Half of the height of its crown (m)."""
        return self.height / 3


def draw_trees(
    bounds: tuple[float, float, float, float],
    placement: str,
    size: float,
    ground: Callable[[float, float], float],
    *,
    share: float,
    seed: int,
    depth: float = 0.0,
) -> Iterator[Tree]:
    """Draw the trees of a box (m): at a share of the corners of its lots, as of `list_lots`.

    Notes
    -----
    A tree depends on seed and numbers alone. Its crown keeps within 0.15 lots, and 3 m, of the corner, where no
    house is.
    """
    for i, j, x, y in list_corners(bounds, placement, size, depth=depth):
        there, wide, tall = lot_random(seed, i, j, 2).random(3).tolist()
        if there < share:
            radius = round(min(3.0, 0.15 * size) * (0.5 + 0.5 * wide), 3)
            height = round(radius * (2.0 + 2.0 * tall), 3)
            yield Tree(i, j, x, y, round(float(ground(x, y)), 3), height, radius)


def crown_rings(tree: Tree) -> list[list[tuple[float, float, float]]]:
    """Rings of a crown from below, counter-clockwise from above; the first and the last are one place (m)."""
    bottom, top = (tree.x, tree.y, tree.z + tree.height / 3), (tree.x, tree.y, tree.z + tree.height)
    rings = [[bottom]]
    for turn in (-0.25, 0.0, 0.25):  # of pi, from the middle
        far, up = tree.radius * math.cos(math.pi * turn), tree.half_height * math.sin(math.pi * turn)
        angles = [math.tau * k / SIDES for k in range(SIDES)]
        rings.append(
            [
                (tree.x + far * math.cos(angle), tree.y + far * math.sin(angle), tree.middle + up)
                for angle in angles
            ]
        )
    return [*rings, [top]]
