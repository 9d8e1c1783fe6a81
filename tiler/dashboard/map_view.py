"""The map of a run as the page asks for it: tiles and seams, or cells of many tiles where there are too many."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tiler.monitoring.items import Codes, Items, State, combine, tally
from tiler.monitoring.run_state import SEAM, TILE, RunState

KEPT_VIEWS = 8
MOST_SHOWN = 4096  # tiles, or cells of tiles, that a map has at most
LOWEST = re.compile("quality|ratio|angle|worst|least|smallest")  # values of which the worst is the lowest
Box = tuple[float, float, float, float]


@dataclass(frozen=True)
class Question:
    """What a page wants to see."""

    stage: str = ""  #: states and values of this step or stage alone; of all where it is empty
    value: str = ""  #: value to colour by, as of `Items.values`; none where it is empty
    view: Box | None = None  #: (xmin, ymin, xmax, ymax): the part of the region (m); all of it where it is None
    since: int = 0  #: version that the page has; it gets what changed after it
    key: str = ""  #: ``key`` of the answer that it has; another one makes it get everything


def describe_map(model: RunState, run: str, question: Question) -> dict[str, Any]:
    """Describe a map for the page.

    Parameters
    ----------
    run : str
        Name of the run's file, part of the key.

    Returns
    -------
    dict
        - ``key``: what the rows are rows of; ``whole``: whether all rows are there, or those that changed;
        - ``level``: tiles along the side of a cell, 1 where tiles are themselves;
        - ``bounds``: box of all tiles (m); ``tiles``: number of tiles in each state, in the view;
        - ``range``: least and largest value of all tiles in the view, or None;
        - ``boxes``, ``names`` of what is shown and ``seam_boxes``, ``seam_names``, where ``whole``;
        - ``rows``: index, state, value or None, and for cells the number of tiles in each state;
        - ``seams``: index, state, value or None; none where cells are shown.

    Notes
    -----
    A cell has the state of `combine`, and the mean of its tiles' values, or the lowest where low is bad.
    """
    tiles = model.items[TILE]
    part = _choose_part(tiles, question.view)
    codes, changed = tiles.codes(question.stage)[part.inside], tiles.changed()[part.inside]
    if model.status == "done":  # not every tile has work in every step
        codes[codes == State.BEGUN] = State.DONE
    values = tiles.values(question.value, question.stage)[part.inside]
    # A stage that is new changes the state of tiles that nothing happened to.
    layout = ".".join(f"{items.layout}.{len(items.stages)}" for items in model.items.values())
    key = "|".join([run, layout, str(part.level), question.stage, question.value, str(question.view)])
    whole = key != question.key
    since = 0 if whole else question.since
    answer: dict[str, Any] = {
        "key": key,
        "whole": whole,
        "level": part.level,
        "bounds": _outline(tiles.boxes()),
        "tiles": np.bincount(codes, minlength=len(State)).tolist(),
        "range": _range(values),
    }
    if part.level == 1:
        rows, names = _rows(codes, values, changed >= since), [tiles.names[k] for k in part.inside.tolist()]
        answer |= _describe_seams(model.items[SEAM], question, since, whole=whole)
    else:
        names = []
        counts = tally(codes, part.group, len(part.first))
        last = np.maximum.reduceat(changed[part.order], part.first)
        rows = _rows(combine(counts), _gather(part, values, question.value), last >= since)
        for one in rows:
            one.append(counts[one[0]].tolist())
    if whole:
        answer |= {"boxes": _rounded(part.boxes), "names": names}
    return answer | {"rows": rows}


def _describe_seams(seams: Items, question: Question, since: int, *, whole: bool) -> dict[str, Any]:
    boxes = seams.boxes()
    inside = _find_inside(boxes, question.view)
    if question.stage and not seams.members(question.stage):
        return {"seams": [], "seam_boxes": [], "seam_names": []} if whole else {"seams": []}
    values = seams.values(question.value, question.stage)[inside]
    told: dict[str, Any] = {
        "seams": _rows(seams.codes(question.stage)[inside], values, seams.changed()[inside] >= since)
    }
    if whole:
        names = [seams.names[k] for k in inside.tolist()]
        told |= {"seam_boxes": _rounded(boxes[inside]), "seam_names": names, "seam_range": _range(values)}
    return told


@dataclass(frozen=True, eq=False)
class _Part:
    """A part of the region, and its cells; `group`, `order` and `first` only where there are cells."""

    inside: NDArray[np.intp]  # (n,) its tiles
    level: int  # tiles along the side of a cell; 1 where tiles are themselves
    boxes: NDArray[np.float64]  # (n or m, 4) of tiles or cells (m)
    group: NDArray[np.int64]  # (n,) cell of each tile
    order: NDArray[np.intp]  # (n,) tiles by cell
    first: NDArray[np.intp]  # (m,) where each cell begins in `order`


def _choose_part(tiles: Items, view: Box | None) -> _Part:
    """Choose tiles or cells for a view; kept until a tile is added, as a page asks again and again."""
    found: _Part | None = tiles.views.get(view)
    if found is None:
        if len(tiles.views) >= KEPT_VIEWS:
            tiles.views.clear()
        found = tiles.views[view] = _make_part(tiles.boxes(), view)
    return found


def _make_part(boxes: NDArray[np.float64], view: Box | None) -> _Part:
    inside = _find_inside(boxes, view)
    none = np.empty(0, np.intp)
    if len(inside) <= MOST_SHOWN:
        return _Part(inside, 1, boxes[inside], none.astype(np.int64), none, none)
    column, row = (axis[inside] for axis in _place_in_grid(boxes))
    level = math.ceil(math.sqrt(len(inside) / MOST_SHOWN)) - 1
    cells = none
    while not 0 < len(cells) <= MOST_SHOWN:
        level += 1
        cells, group = np.unique(column // level * (row.max() + 1) + row // level, return_inverse=True)
    group = group.reshape(-1).astype(np.int64)
    order = np.argsort(group, kind="stable")
    first = np.searchsorted(group[order], np.arange(len(cells)))
    low = np.minimum.reduceat(boxes[inside][order, :2], first, axis=0)
    high = np.maximum.reduceat(boxes[inside][order, 2:], first, axis=0)
    return _Part(inside, level, np.hstack([low, high]), group, order, first)


def _gather(part: _Part, values: NDArray[np.float64], value: str) -> NDArray[np.float64]:
    """Value of each cell: the mean of its tiles, or the lowest where low is bad; NaN where none is known."""
    known, n = np.isfinite(values), len(part.first)
    if LOWEST.search(value):
        found = np.minimum.reduceat(np.where(known, values, np.inf)[part.order], part.first)
        return np.where(np.isfinite(found), found, np.nan)
    number = np.bincount(part.group[known], minlength=n)
    total = np.bincount(part.group[known], values[known], minlength=n)
    means: NDArray[np.float64] = np.divide(total, number, out=np.full(n, np.nan), where=number > 0)
    return means


def _place_in_grid(boxes: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Column and row of each box, by the order of their lower left corners: sides of tiles are lines of a grid."""
    places = [np.unique(boxes[:, axis].round(3), return_inverse=True)[1].reshape(-1) for axis in (0, 1)]
    return places[0].astype(np.int64), places[1].astype(np.int64)


def _find_inside(boxes: NDArray[np.float64], view: Box | None) -> NDArray[np.intp]:
    if view is None:
        return np.arange(len(boxes))
    xmin, ymin, xmax, ymax = view
    meets = (boxes[:, 0] <= xmax) & (boxes[:, 2] >= xmin) & (boxes[:, 1] <= ymax) & (boxes[:, 3] >= ymin)
    return np.flatnonzero(meets)


def _rows(codes: Codes, values: NDArray[np.float64], wanted: NDArray[np.bool_]) -> list[list[Any]]:
    chosen = np.flatnonzero(wanted)
    found: list[list[Any]] = []
    for k, code, value in zip(chosen.tolist(), codes[chosen].tolist(), values[chosen].tolist(), strict=True):
        found.append([k, code, None if math.isnan(value) else float(f"{value:.4g}")])
    return found


def _range(values: NDArray[np.float64]) -> Sequence[float] | None:
    known = values[np.isfinite(values)]
    return [float(f"{known.min():.4g}"), float(f"{known.max():.4g}")] if len(known) else None


def _outline(boxes: NDArray[np.float64]) -> list[float] | None:
    if not len(boxes):
        return None
    return [*boxes[:, :2].min(axis=0).tolist(), *boxes[:, 2:].max(axis=0).tolist()]


def _rounded(boxes: NDArray[np.float64]) -> list[list[float]]:
    found: list[list[float]] = boxes.round(1).tolist()
    return found
