"""CityJSON 2.0 of all levels in one hierarchy: groups of LoD0A, cells, objects of LoD0C, buildings."""

from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from typing import IO, Any

import numpy as np
import pyproj
import shapely
from numpy.typing import NDArray

from pipeline.city_model.solids import Levels, build_solids
from pipeline.data.citymodel import CityModel
from pipeline.data.roofs import flat_roofs
from tiler.citymodels.cityjson_text import ObjectLines, compact, reference_system
from tiler.generalisation.rows import LEVELS, Rows, level_word

STEP = 0.001  # m; coordinates are whole multiples of it
LODS = {"lod1": "1.2", "lod0c": "1.0", "lod0b": "1.0", "lod0a": "1.0"}  # CityJSON has no LoD0A, 0B, 0C
SURFACES = [{"type": name} for name in ("GroundSurface", "RoofSurface", "WallSurface")]


class HierarchyWriter:
    """Writes objects, an object a line, while vertices wait in another file."""

    def __init__(self, file: IO[bytes], vertex_file: IO[bytes], crs: pyproj.CRS, origin: Sequence[float]) -> None:
        self.origin = np.array([*origin, 0.0])
        self.file, self.without_solid = file, 0
        head: dict[str, Any] = {
            "type": "CityJSON",
            "version": "2.0",
            "transform": {"scale": [STEP] * 3, "translate": self.origin.tolist()},
        }
        if name := reference_system(crs):
            head["metadata"] = {"referenceSystem": name}
        file.write(f"{compact(head)[:-1]},".encode("ascii"))
        self.lines = ObjectLines(file.write, vertex_file)

    def add(self, rows: Mapping[str, Rows], children: Mapping[str, Sequence[str]]) -> None:
        """Add what a tile has; `children` are the cells of each object of LoD0A.

        An object that stands unchanged at several levels is written once, at the lowest of them.
        """
        below = {name: list(cells) for name, cells in children.items()}
        for level in ("lod0c", "lod1"):
            for name, parent in zip(rows[level].id.tolist(), rows[level].parent.tolist(), strict=True):
                if name != parent:
                    below.setdefault(parent, []).append(name)
        for level in reversed(LEVELS):
            own = rows[level]
            chosen = own.landmark == 0
            if level == "lod1":
                chosen = np.ones(len(own), np.bool_)
            elif level != "lod0c":
                chosen &= np.array([name in below for name in own.id.tolist()], np.bool_) & ~np.isin(
                    own.id.astype(str), rows["lod0c"].id.astype(str)
                )
            self._add(level, own.take(np.flatnonzero(chosen)), below)

    def finish(self) -> None:
        """Write the vertices."""
        self.lines.finish()
        self.file.write(b"}\n")

    def _add(self, level: str, rows: Rows, below: Mapping[str, Sequence[str]]) -> None:
        if not len(rows):
            return
        solids, vertices = self._solids(rows)
        for k, (name, parent) in enumerate(zip(rows.id.tolist(), rows.parent.tolist(), strict=True)):
            thing: dict[str, Any] = {"type": "Building" if level == "lod1" else "CityObjectGroup"}
            if name in below:
                thing["children"] = list(below[name])
            if parent and parent != name:
                thing["parents"] = [parent]
            thing["attributes"] = {
                "level": level_word(level),
                "height": float(rows.height[k]),
                "cell": rows.cell[k],
                "members": int(rows.members[k]),
                "landmark": int(rows.landmark[k]),
            }
            if np.isfinite(rows.ground_height[k]):
                thing["attributes"]["ground_height"] = float(rows.ground_height[k])
            thing["geometry"] = [_geometry(solids[k], LODS[level])] if solids[k] else []
            self.without_solid += not solids[k]
            self.lines.add_objects([f"{compact(name)}:{compact(thing)}"])
        self.lines.add_vertices(vertices)

    def _solids(self, rows: Rows) -> tuple[list[list[Any]], NDArray[np.int64]]:
        """Give the solids of each object, as shells of faces by kind, and the vertices that they count."""
        parts, owner = shapely.get_parts(rows.outlines, return_index=True)
        ground = np.nan_to_num(rows.ground_height)[owner]
        ids = np.arange(len(parts)).astype(str)
        model = CityModel(
            parts, ids, np.arange(len(parts)), ground, flat_roofs(ground + rows.height[owner]),
            tuple((name,) for name in ids.tolist()), ids,
        )  # fmt: skip
        levels, _ = build_solids(model, self.origin, grid=STEP)
        solids: list[list[Any]] = [[] for _ in range(len(rows))]
        for of, faces in zip(owner.tolist(), _faces(levels, self.lines.n_vertices), strict=True):
            if faces:
                solids[of].append(faces)
        return solids, levels.vertices


def _faces(levels: Levels, first: int) -> Iterator[list[tuple[int, list[list[int]]]]]:
    """Give the faces of each prism: kind, then rings of vertices, counted from `first`."""
    (solids,) = levels.solids
    for k, (begin, end) in enumerate(pairwise(solids.building_start.tolist())):
        if not solids.has_solid[k] or begin == end:
            yield []
            continue
        corners = [slice(*solids.ring_start[ring : ring + 2]) for ring in range(begin, end)]
        low = [(solids.low[rows][::-1] + first).tolist() for rows in corners]
        high = [(solids.high[rows] + first).tolist() for rows in corners]
        walls = [(2, [wall]) for rows in corners for wall in (solids.walls[rows] + first).tolist()]
        yield [(0, low), (1, high), *walls]


def _geometry(solids: list[Any], lod: str) -> dict[str, Any]:
    shells: list[Any] = [[[rings for _, rings in faces]] for faces in solids]
    values: list[Any] = [[[kind for kind, _ in faces]] for faces in solids]
    one = len(solids) == 1
    return {
        "type": "Solid" if one else "MultiSolid",
        "lod": lod,
        "boundaries": shells[0] if one else shells,
        "semantics": {"surfaces": SURFACES, "values": values[0] if one else values},
    }
