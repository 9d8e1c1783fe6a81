"""How well the surfaces of a tile are textured: of each building, and of each surface that is not."""

import csv
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tiler.convert.obj_files import GROUPS
from tiler.textures.cameras import Camera
from tiler.textures.paint import NO_IMAGE, Painted
from tiler.textures.surfaces import Tile
from tiler.textures.views import REASONS, Ranking

WHOLE = 0.99  # part of a surface that images show, below which it is listed
BUILDINGS = ("tile", "building", "surfaces", "textured", "area", "visible", "pixels_per_metre", "images")
SURFACES = ("tile", "building", "face", "kind", "area", "visible", "reason")


@dataclass(frozen=True)
class TileQuality:
    """Rows of the tables of a tile: of its buildings, and of its surfaces that are filled with colour."""

    buildings: list[dict[str, Any]]
    surfaces: list[dict[str, Any]]


def judge(
    name: str, tile: Tile, painted: Sequence[Painted | None], ranking: Ranking, cameras: Sequence[Camera]
) -> TileQuality:
    """Make the rows of a tile.

    ``area`` is that of walls and roofs (m²), ``visible`` the part of it that images show, ``pixels_per_metre``
    those of the images there, and ``images`` their names.
    """
    rows: list[dict[str, Any]] = []
    left: list[dict[str, Any]] = []
    for k, building in enumerate(tile.names):
        own = [j for j, surface in enumerate(tile.surfaces) if surface.building == k]
        areas = {j: tile.surfaces[j].area for j in own}
        shown = {j: 0.0 if (one := painted[j]) is None else one.share for j in own}
        seen = sum(areas[j] * shown[j] for j in own)
        scale = sum(areas[j] * shown[j] * one.scale for j in own if (one := painted[j]) is not None)
        used: set[str] = set()
        for j in own:
            if (one := painted[j]) is not None:
                ranks = np.unique(one.rank[one.rank != NO_IMAGE]).tolist()
                used.update(cameras[ranking.best[j][rank]].name for rank in ranks)
            if shown[j] < WHOLE:
                reason = REASONS[ranking.reached[j]] if painted[j] is None else "in part"
                left.append(
                    dict(zip(SURFACES, (
                        name, building, tile.surfaces[j].face, GROUPS[tile.surfaces[j].kind], round(areas[j], 2),
                        round(shown[j], 4), reason,
                    ), strict=True))
                )  # fmt: skip
        whole = sum(areas.values())
        rows.append(
            dict(zip(BUILDINGS, (
                name, building, len(own), sum(share > 0 for share in shown.values()), round(whole, 2),
                round(seen / whole, 4) if whole else 0.0, round(scale / seen, 2) if seen else 0.0,
                " ".join(sorted(used)),
            ), strict=True))
        )  # fmt: skip
    return TileQuality(rows, left)


def write_table(path: Path, columns: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> None:
    """Write rows as CSV."""
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
