"""Rectangles of texels packed into pages."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

PAGE = 4096  # texels along a side of a page, at most
GUTTER = 2  # texels around a rectangle that repeat its border


@dataclass(frozen=True)
class Slot:
    """Where a rectangle is: page, and column and row of its upper left texel."""

    page: int
    x: int
    y: int


def pack(sizes: Sequence[tuple[int, int]]) -> tuple[list[Slot], list[tuple[int, int]]]:
    """Pack rectangles (width, height) on shelves, the highest first; gives a slot each, and the pages' sizes.

    Examples
    --------
    >>> pack([(10, 5), (3, 8)])
    ([Slot(page=0, x=2, y=14), Slot(page=0, x=2, y=2)], [(14, 21)])
    """
    border = 2 * GUTTER
    area = sum((w + border) * (h + border) for w, h in sizes)
    width = min(PAGE, max([int(area**0.5 * 1.1), *(w + border for w, _ in sizes), 1]))
    slots = [Slot(0, 0, 0)] * len(sizes)
    pages: list[tuple[int, int]] = []
    page = x = y = shelf = used = 0
    for k in sorted(range(len(sizes)), key=lambda k: (-sizes[k][1], -sizes[k][0], k)):
        w, h = sizes[k][0] + border, sizes[k][1] + border
        if x + w > width:
            x, y, shelf = 0, y + shelf, 0
        if y + h > PAGE:
            pages.append((used, y))
            page, x, y, shelf, used = page + 1, 0, 0, 0, 0
        slots[k] = Slot(page, x + GUTTER, y + GUTTER)
        x, shelf, used = x + w, max(shelf, h), max(used, x + w)
    return slots, [*pages, (used, y + shelf)] if sizes else []


def draw_pages(
    slots: Sequence[Slot], pages: Sequence[tuple[int, int]], parts: Sequence[NDArray[np.uint8]]
) -> list[NDArray[np.uint8]]:
    """Copy rectangles (h, w, 3) into pages, with their gutters."""
    drawn = [np.zeros((h, w, 3), np.uint8) for w, h in pages]
    for slot, part in zip(slots, parts, strict=True):
        wide = np.pad(part, ((GUTTER, GUTTER), (GUTTER, GUTTER), (0, 0)), mode="edge")
        y, x = slot.y - GUTTER, slot.x - GUTTER
        drawn[slot.page][y : y + wide.shape[0], x : x + wide.shape[1]] = wide
    return drawn
