"""The map of a run as the page asks for it: tiles and seams, or cells of many tiles where there are too many."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tiler.dashboard.codes import Codes, combine, tally
from tiler.dashboard.items import Items
from tiler.dashboard.model import SEAM, TILE, RunModel

MOST_SHOWN = 4096  # tiles, or cells of tiles, that a map has at most
LOWEST = re.compile("quality|ratio|angle|worst|least|smallest")  # values of which the worst is the lowest
Box = tuple[float, float, float, float]


@dataclass(frozen=True)
class Question:
    """What a page wants to see.

    Attributes
    ----------
    stage : str
        States and values of this stage alone; of all where it is empty.
    value : str
        Value to colour by, as of `Items.values`; none where it is empty.
    view : (xmin, ymin, xmax, ymax) or None
        The part of the region (m); all of it where it is None.
    since : int
        Version that the page has; it gets what changed after it.
    key : str
        ``key`` of the answer that it has; another one makes it get everything.
    """

    stage: str = ""
    value: str = ""
    view: Box | None = None
    since: int = 0
    key: str = ""


def tell_map(model: RunModel, run: str, question: Question) -> dict[str, Any]:
    """Tell a map.

    Parameters
    ----------
    model : RunModel
        The run.
    run : str
        Name of the run's file, part of the key.
    question : Question
        What is asked.

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
    boxes = tiles.boxes()
    inside = _find_inside(boxes, question.view)
    codes, changed = tiles.codes(question.stage)[inside], tiles.changed()[inside]
    values = tiles.values(question.value, question.stage)[inside]
    column, row = _place_in_grid(boxes)
    level = _choose_level(column[inside], row[inside])
    layout = f"{tiles.layout}.{model.items[SEAM].layout}"
    key = "|".join([run, layout, str(level), question.stage, question.value, str(question.view)])
    whole = key != question.key
    since = 0 if whole else question.since
    answer: dict[str, Any] = {
        "key": key,
        "whole": whole,
        "level": level,
        "bounds": _outline(boxes),
        "tiles": tally(codes, np.zeros(len(codes), np.int64), 1)[0].tolist(),
        "range": _range(values),
    }
    if level == 1:
        rows, names = _rows(codes, values, changed >= since), [tiles.names[k] for k in inside.tolist()]
        shown = boxes[inside]
        answer |= _tell_seams(model.items[SEAM], question, since, whole=whole)
    else:
        found = _gather(
            column[inside] // level, row[inside] // level, boxes[inside], codes, values, changed, question
        )
        shown, names = found.boxes, []
        rows = _rows(combine(found.counts), found.values, found.changed >= since)
        for one in rows:
            one.append(found.counts[one[0]].tolist())
    if whole:
        answer |= {"boxes": _rounded(shown), "names": names}
    return answer | {"rows": rows}


def _tell_seams(seams: Items, question: Question, since: int, *, whole: bool) -> dict[str, Any]:
    boxes = seams.boxes()
    inside = _find_inside(boxes, question.view)
    if question.stage and question.stage not in seams.stages:
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
class _Cells:
    """Cells of tiles: boxes (m) (n, 4), counts by state (n, 6), values (n,), last versions (n,)."""

    boxes: NDArray[np.float64]
    counts: NDArray[np.int64]
    values: NDArray[np.float64]
    changed: NDArray[np.int64]


def _gather(
    column: NDArray[np.int64],
    row: NDArray[np.int64],
    boxes: NDArray[np.float64],
    codes: Codes,
    values: NDArray[np.float64],
    changed: NDArray[np.int64],
    question: Question,
) -> _Cells:
    """Bring tiles together by the column and row of their cell."""
    _, group = np.unique(column * (row.max() + 1) + row, return_inverse=True)
    group = group.reshape(-1).astype(np.int64)
    n = int(group.max()) + 1
    order = np.argsort(group, kind="stable")
    first = np.searchsorted(group[order], np.arange(n))
    low = np.minimum.reduceat(boxes[order, :2], first, axis=0)
    high = np.maximum.reduceat(boxes[order, 2:], first, axis=0)
    known = np.isfinite(values)
    if LOWEST.search(question.value):
        filled = np.where(known, values, np.inf)
        found = np.minimum.reduceat(filled[order], first)
        found = np.where(np.isfinite(found), found, np.nan)
    else:
        number = np.bincount(group[known], minlength=n)
        total = np.bincount(group[known], values[known], minlength=n)
        found = np.divide(total, number, out=np.full(n, np.nan), where=number > 0)
    last = np.maximum.reduceat(changed[order], first)
    return _Cells(np.hstack([low, high]), tally(codes, group, n), found, last)


def _place_in_grid(boxes: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Column and row of each box, by the order of their lower left corners: sides of tiles are lines of a grid."""
    places = [np.unique(boxes[:, axis].round(3), return_inverse=True)[1].reshape(-1) for axis in (0, 1)]
    return places[0].astype(np.int64), places[1].astype(np.int64)


def _choose_level(column: NDArray[np.int64], row: NDArray[np.int64]) -> int:
    """Smallest number of tiles along the side of a cell, such that there are few enough cells."""
    level = math.ceil(math.sqrt(len(column) / MOST_SHOWN))
    if level <= 1:
        return 1
    while len(np.unique(column // level * (row.max() + 1) + row // level)) > MOST_SHOWN:
        level += 1
    return level


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
