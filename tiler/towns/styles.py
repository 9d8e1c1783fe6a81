"""Styles of towns: rules, placement and lots that go together, and the houses of a town by tile."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from pipeline.architecture.draw import draw_house
from pipeline.architecture.lots import list_lots
from pipeline.architecture.parameters import House
from pipeline.architecture.rules import Distribution, make_rules

Box = tuple[float, float, float, float]

_WAVES = ((1100.0, 700.0, 0.5), (310.0, -450.0, 0.3), (-170.0, 230.0, 0.2))  # lengths in x and y (m), share


@dataclass(frozen=True)
class Style:
    """How a town is laid out.

    Attributes
    ----------
    preset : str
        One of `pipeline.architecture.rules.PRESETS`.
    placement : str
        One of `pipeline.architecture.lots.PLACEMENTS`.
    lot : float
        Size of a lot (m).
    """

    preset: str
    placement: str
    lot: float


STYLES = {
    "detached": Style("detached", "random", 24.0),
    "grid": Style("detached", "grid", 22.0),
    "terraces": Style("terraces", "rows", 6.5),
    "apartments": Style("apartments", "random", 60.0),
    "towers": Style("towers", "grid", 55.0),
}


@dataclass(frozen=True, eq=False)
class Town:
    """A town, as little as all of it follows from.

    Attributes
    ----------
    bounds : tuple of 4 floats
        West, south, east, north (m).
    style : Style
        Its layout.
    rules : mapping of str to Distribution
        What its houses are drawn by.
    seed : int
        Not negative.
    relief : float
        Highest minus lowest ground, about (m).
    """

    bounds: Box
    style: Style
    rules: Mapping[str, Distribution]
    seed: int
    relief: float

    def houses(self, box: Box) -> Iterator[House]:
        """Draw the houses whose lot has its centre in a box (m), and in the town: they depend on no others."""
        west, south, east, north = self.bounds
        inner = max(box[0], west), max(box[1], south), min(box[2], east), min(box[3], north)
        depth = self.rules["width"].limits()[1]
        lots = list_lots(inner, self.style.placement, self.style.lot, seed=self.seed, depth=depth)
        for lot in lots:
            yield draw_house(self.rules, lot, self.ground, seed=self.seed)

    @cached_property
    def _phases(self) -> list[float]:
        phases: list[float] = (np.random.default_rng([self.seed, 7]).random(len(_WAVES)) * 2 * np.pi).tolist()
        return phases

    def ground(self, x: Any, y: Any) -> Any:
        """Give the height of the ground (m) at places x, y: a number, or as many as there are of these."""
        waves = (
            share * np.sin(2 * np.pi * (x / east + y / north) + turn)
            for (east, north, share), turn in zip(_WAVES, self._phases, strict=True)
        )
        return 10.0 + self.relief / 2 * (1 + sum(waves))


def make_town(bounds: Box, style: str, given: Mapping[str, Any], *, seed: int, relief: float) -> Town:
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
    return Town(bounds, STYLES[style], make_rules(given, preset=STYLES[style].preset), seed, relief)
