"""Styles of towns: rules, placement and lots that go together, and the houses of a town by tile."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np

from pipeline.architecture.draw import draw_house
from pipeline.architecture.lots import Lot, list_lots, list_open_lots, lot_steps
from pipeline.architecture.parameters import House
from pipeline.architecture.plants import Tree, draw_trees
from pipeline.architecture.rules import Distribution, make_rules

Box = tuple[float, float, float, float]

LOWEST = 10.0  # m, of the ground
FREEBOARD = 0.5  # m, of houses above the water
_WAVES = ((1100.0, 700.0, 0.5), (310.0, -450.0, 0.3), (-170.0, 230.0, 0.2))  # lengths in x and y (m), share


@dataclass(frozen=True)
class Style:
    """How a town is laid out."""

    preset: str  # one of `pipeline.architecture.rules.PRESETS`
    placement: str  # one of `pipeline.architecture.lots.PLACEMENTS`
    lot: float  # size of a lot (m)


STYLES = {
    "detached": Style("detached", "random", 24.0),
    "grid": Style("detached", "grid", 22.0),
    "terraces": Style("terraces", "rows", 6.5),
    "blocks": Style("terraces", "blocks", 10.0),
    "apartments": Style("apartments", "random", 60.0),
    "towers": Style("towers", "grid", 55.0),
    "wings": Style("wings", "random", 44.0),
    "mixed": Style("detached", "quarters", 24.0),
}
QUARTER = 240.0  # m, side of the quarters of a mixed town, on whole multiples
QUARTERS = {"detached": 0.35, "terraces": 0.2, "blocks": 0.15, "wings": 0.1, "apartments": 0.15, "towers": 0.05}
_FAR = 10**8  # between numbers of trees of different styles


@dataclass(frozen=True, eq=False)
class Town:
    """A town, as little as all of it follows from."""

    bounds: Box  # west, south, east, north (m)
    style: Style  # its layout
    rules: Mapping[str, Distribution]  # what its houses are drawn by
    seed: int  # not negative
    relief: float  # highest minus lowest ground, about (m)
    trees: float = 0.0  # share of the corners of lots that have a tree
    water: float = 0.0  # share of the relief that lakes fill; no house stands in them
    highest: float = 0.0  # height of given houses (m), where those drawn by rules are no measure
    ground_seed: int = -1  # what the ground is drawn from; negative for `seed`

    def lots(self, box: Box) -> Iterator[Lot]:
        """List the lots whose centre lies in a box (m), and in the town."""
        placement, size = self.style.placement, self.style.lot
        return list_lots(self._inner(box), placement, size, seed=self.seed, depth=self._depth)

    def draw(self, lot: Lot) -> House | None:
        """Draw the house of a lot: it depends on no others. None where it would stand in water."""
        house = draw_house(self.rules, lot, self.ground, seed=self.seed)
        return house if house.z >= self.water_level + FREEBOARD else None

    def houses(self, box: Box) -> Iterator[House]:
        """Draw the houses of the lots of a box."""
        return (house for house in map(self.draw, self.lots(box)) if house is not None)

    @property
    def reach(self) -> float:
        """How far from the centre of a lot its house may reach (m), at most."""
        return self.style.lot + self._depth

    def plants(self, box: Box) -> Iterator[Tree]:
        """Draw the trees of a box (m), as `houses`; none stands in water."""
        lot, seed = self.style.lot, self.seed
        inner = self._inner(box)
        for tree in draw_trees(
            inner, self.style.placement, lot, self.ground, share=self.trees, seed=seed, depth=self._depth
        ):
            if tree.z > self.water_level:
                yield tree

    def open_lots(self, box: Box) -> Iterator[Lot]:
        """List the lots of streets and courtyards of a box (m)."""
        return list_open_lots(self._inner(box), self.style.placement, self.style.lot)

    def _inner(self, box: Box) -> Box:
        west, south, east, north = self.bounds
        return max(box[0], west), max(box[1], south), min(box[2], east), min(box[3], north)

    @property
    def spacing(self) -> tuple[float, float]:
        """From a lot to the next one eastwards and northwards (m)."""
        return lot_steps(self.style.placement, self.style.lot, self._depth)

    @property
    def _depth(self) -> float:
        return self.rules["width"].limits()[1]

    @property
    def water_level(self) -> float:
        """Height of the water (m); minus infinity without any."""
        return LOWEST + self.water * self.relief if self.water > 0 else -math.inf

    @property
    def top(self) -> float:
        """Height (m) that nothing of the town is above."""
        most = {name: self.rules[name].limits()[1] for name in ("storeys", "storey_height", "roof_pitch")}
        rise = self._depth * math.tan(math.radians(most["roof_pitch"]))
        drawn = LOWEST + self.relief + most["storeys"] * most["storey_height"] + rise
        return max(drawn, self.highest) + 2.0

    @property
    def steepest(self) -> float:
        """Slope that the ground has nowhere more of."""
        return math.pi * self.relief * sum(share * math.hypot(1 / x, 1 / y) for x, y, share in _WAVES)

    @cached_property
    def _phases(self) -> list[float]:
        seed = self.seed if self.ground_seed < 0 else self.ground_seed
        phases: list[float] = (np.random.default_rng([seed, 7]).random(len(_WAVES)) * 2 * np.pi).tolist()
        return phases

    def ground(self, x: Any, y: Any) -> Any:
        """Give the height of the ground (m) at places x, y: a number, or as many as there are of these."""
        waves = (
            share * np.sin(2 * np.pi * (x / east + y / north) + turn)
            for (east, north, share), turn in zip(_WAVES, self._phases, strict=True)
        )
        return LOWEST + self.relief / 2 * (1 + sum(waves))


@dataclass(frozen=True, eq=False)
class MixedTown(Town):
    """A town whose quarters are of other styles, drawn by their place; lots lie within their quarter."""

    parts: tuple[Town, ...] = ()  # towns of the styles of `QUARTERS`, on the ground of this one

    def lots(self, box: Box) -> Iterator[Lot]:
        """List the lots of all quarters, as of `Town`."""
        return (lot for k, inner in self._quarters(box) for lot in self.parts[k].lots(inner))

    def draw(self, lot: Lot) -> House | None:
        """Draw the house of a lot by the rules of its quarter."""
        return self.parts[self._style_of(int(lot.x // QUARTER), int(lot.y // QUARTER))].draw(lot)

    def plants(self, box: Box) -> Iterator[Tree]:
        """Draw the trees of all quarters, as of `Town`."""
        for k, inner in self._quarters(box):
            for tree in self.parts[k].plants(inner):
                yield replace(tree, i=tree.i + k * _FAR)

    def open_lots(self, box: Box) -> Iterator[Lot]:
        """List the lots of streets and courtyards of all quarters, as of `Town`."""
        return (lot for k, inner in self._quarters(box) for lot in self.parts[k].open_lots(inner))

    @property
    def reach(self) -> float:
        """How far from the centre of a lot its house may reach (m), at most."""
        return max(part.reach for part in self.parts)

    @property
    def top(self) -> float:
        """Height (m) that nothing of the town is above."""
        return max(self.highest, *(part.top for part in self.parts))

    def _quarters(self, box: Box) -> Iterator[tuple[int, Box]]:
        """List the quarters in a box: style, and what of the box centres of whole lots may lie in."""
        columns, rows = (range(math.floor(box[k] / QUARTER), math.ceil(box[k + 2] / QUARTER)) for k in (0, 1))
        for b, a in product(rows, columns):
            k = self._style_of(a, b)
            x, y = (step / 2 for step in self.parts[k].spacing)
            west, south = max(box[0], a * QUARTER + x), max(box[1], b * QUARTER + y)
            yield k, (west, south, min(box[2], (a + 1) * QUARTER - x), min(box[3], (b + 1) * QUARTER - y))

    def _style_of(self, a: int, b: int) -> int:
        rng = np.random.default_rng([self.seed, 12, a % 2**32, b % 2**32])
        return int(rng.choice(len(QUARTERS), p=list(QUARTERS.values())))


def make_town(
    bounds: Box,
    style: str,
    given: Mapping[str, Any],
    *,
    seed: int,
    relief: float,
    trees: float = 0.0,
    water: float = 0.0,
) -> Town:
    """Make a town of a style, with some rules other than those of its preset.

    Raises
    ------
    ValueError
        If the style or a rule is not known or out of range, or the town has no area.
    """
    if style not in STYLES:
        raise ValueError(f"style {style!r}; one of {', '.join(STYLES)}")
    west, south, east, north = bounds
    if not (west < east and south < north and seed >= 0 and 0 <= relief < 1000):
        raise ValueError(f"bounds {bounds}, seed {seed}, relief {relief}")
    if not (0 <= trees <= 1 and 0 <= water < 1):
        raise ValueError(f"trees {trees:g}, water {water:g}; expected shares from 0 to 1")
    town = Town(bounds, STYLES[style], make_rules(given, preset=STYLES[style].preset), seed, relief, trees, water)
    if style != "mixed":
        return town
    parts = []
    for k, name in enumerate(QUARTERS):
        own, rules = STYLES[name], make_rules(given, preset=STYLES[name].preset)
        # Another seed for each style: lots of different styles may have the same numbers.
        parts.append(replace(town, style=own, rules=rules, seed=seed * len(QUARTERS) + k, ground_seed=seed))
    return MixedTown(bounds, town.style, town.rules, seed, relief, trees, water, parts=tuple(parts))
