"""City models cut into tiles: a sequence of the buildings of each, written in one pass through the source."""

from pathlib import Path

import numpy as np

from tiler.convert.cityjson_files import feature_line, head_line
from tiler.convert.features import iter_features, origin_of
from tiler.convert.inputs import ModelSource

HELD_BYTES = 64 * 2**20  # of features that wait in memory, of all tiles together


def split_source(source: ModelSource, size: float, folder: Path) -> list[Path]:
    """Write CityJSONSeq by tile: a building is in that of the middle of its box, whole.

    Tiles of `size` (m) begin at multiples of it in the CRS. Files ``i_j.jsonl`` are given for tiles with
    buildings, in an empty folder; i and j are whole numbers, eastwards and northwards. Memory is `HELD_BYTES` and
    what an id takes (`features.iter_features`), whatever the number of buildings.
    """
    origin, step = origin_of(source)[:2], source.step[:2]
    waiting: dict[Path, list[bytes]] = {}
    found: set[Path] = set()
    held = 0
    for feature in iter_features(source):
        if not len(feature.vertices):
            source.told["buildings without surfaces, which are in no tile"] += 1
            continue
        xy = feature.vertices[:, :2]
        i, j = np.floor(((xy.min(axis=0) + xy.max(axis=0)) / 2 * step + origin) / size).astype(int).tolist()
        line = feature_line(feature, source)
        waiting.setdefault(folder / f"{i}_{j}.jsonl", []).append(line)
        held += len(line)
        if held > HELD_BYTES:
            _append(waiting, found, source)
            held = 0
    _append(waiting, found, source)
    return sorted(found)


def _append(waiting: dict[Path, list[bytes]], begun: set[Path], source: ModelSource) -> None:
    for path, lines in waiting.items():
        with path.open("ab") as file:
            if path not in begun:
                file.write(head_line(source))
            file.writelines(lines)
    begun.update(waiting)
    waiting.clear()
