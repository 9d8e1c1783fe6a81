"""`citystitch facade-rules`: rules of a façade from its rectified image."""

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.data.errors import ConfigError, InputError
from pipeline.facades.rhythm import Rhythm, find_rhythm
from tiler.convert.convert import refuse_output
from tiler.detail.rule_files import load_graph
from tiler.store.atomic import replacing
from tiler.textures.images import read_pixels

LEAST_STRIP = 0.1  # m, of a margin that is stated
GROUND_FLOOR = 2.2  # m, of a lower margin from which on it is a storey of its own


@dataclass(frozen=True)
class RulesAsked:
    """What is asked of rules from an image, as the command line has it: its width and height in metres."""

    size: str
    overwrite: bool = False


def write_facade_rules(image: Path, output: Path, asked: RulesAsked) -> list[str]:
    """Write the rules of a façade, as `citystitch detail` takes them; gives what was found, a line each.

    Parameters
    ----------
    image : Path
        Rectified image of the façade alone.
    output : Path
        JSON file of rules; it appears whole or not at all.
    asked : RulesAsked
        What is asked.

    Raises
    ------
    ConfigError
        If the size is none, or the file exists.
    InputError
        If the image cannot be read, or nothing repeats in it.
    OutputError
        If the file cannot be written.
    """
    width, height = _size(asked.size)
    refuse_output(output, [image], overwrite=asked.overwrite)
    try:
        found = find_rhythm(read_pixels(image).astype(np.float64).mean(axis=2), width, height)
    except ValueError as error:
        raise InputError(f"{image}: {error}; give the image of one façade, rectified, and its --size") from None
    with replacing(output) as part:
        part.write_text(json.dumps(make_rules(found, width, height), indent=2) + "\n", encoding="utf-8")
        load_graph(str(part))  # as `citystitch detail` will
    wide, tall, sill = found.window
    ground = [f"ground floor of {found.storeys.start:.2f} m: left plain; add a node to it"] * (
        found.storeys.start >= GROUND_FLOOR
    )
    return [
        f"{found.storeys.n} storeys of {found.storeys.size:.2f} m from {found.storeys.start:.2f} m on "
        f"(match {found.storeys.match:.2f})",
        f"{found.bays.n} bays of {found.bays.size:.2f} m from {found.bays.start:.2f} m on "
        f"(match {found.bays.match:.2f})",
        f"windows of {wide:.2f} by {tall:.2f} m, {sill:.2f} m above the floor",
        *ground,
    ]


def _size(text: str) -> tuple[float, float]:
    try:
        width, height = (float(word) for word in text.split(","))
    except ValueError:
        width = height = math.nan
    if not (0 < width < math.inf and 0 < height < math.inf):
        raise ConfigError(f"--size {text}: is not WIDTH,HEIGHT of the façade: two numbers above 0, in metres")
    return width, height


def make_rules(found: Rhythm, width: float, height: float) -> dict[str, Any]:
    """Make the document of rules: storeys between the margins above and below, bays between those at the sides."""
    storeys, bays = found.storeys, found.bays
    up = _parts(storeys.start, height - storeys.start - storeys.n * storeys.size, "storeys")
    if storeys.start >= GROUND_FLOOR:
        up[0]["to"] = "ground"
    wide, tall, sill = (round(value, 2) for value in found.window)
    nodes: dict[str, Any] = {
        "facade": {"op": "split", "axis": "v", "parts": up},
        "storeys": {
            "op": "repeat", "axis": "v", "size": round(storeys.size, 3), "semantics": "floor", "to": "storey",
        },
        "storey": {"op": "split", "axis": "u", "parts": _parts(
            bays.start, width - bays.start - bays.n * bays.size, "bays"
        )},
        "bays": {"op": "repeat", "axis": "u", "size": round(bays.size, 3), "to": "window"},
        "window": {"op": "insert", "asset": "window", "width": wide, "height": tall, "sill": max(sill, 0.0)},
    }  # fmt: skip
    if storeys.start >= GROUND_FLOOR:
        nodes["ground"] = {"op": "split", "axis": "u", "semantics": "floor", "parts": [{"share": 1}]}
    return {"front": "facade", "other": "facade", "nodes": nodes}


def _parts(before: float, after: float, to: str) -> list[dict[str, Any]]:
    ends = [[{"size": round(one, 3)}] if one >= LEAST_STRIP else [] for one in (before, after)]
    return [*ends[0], {"share": 1, "to": to}, *ends[1]]
