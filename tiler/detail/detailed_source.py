"""Buildings of a city model with façades by rules, one at a time, as a source that the writers of formats take."""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import accumulate, pairwise

import numpy as np
from numpy.typing import NDArray

from pipeline.architecture import surfaces
from pipeline.facades.assets import Made, reach
from pipeline.facades.criteria import Criteria
from pipeline.facades.facade import (
    Frame,
    Obstacles,
    Product,
    count_polygons,
    execute,
    find_frame,
    find_free,
    keep_in_wall,
    make_facade,
)
from pipeline.facades.graph import Graph, InsertLod
from pipeline.facades.pictures import Picture
from tiler.cityinput.face_planes import area_vectors, find_planes
from tiler.cityinput.faces import (
    DOOR,
    INSTALLATION,
    PICTURED,
    UNKNOWN,
    WALL,
    WINDOW,
    FaceList,
    Faces,
    ModelBuilding,
    Shape,
    join_faces,
)
from tiler.cityinput.levels import OPENINGS, best_shapes
from tiler.convert.inputs import ModelSource

LEVEL = 3.0
MOST_OFF = 0.005  # m, of a vertex from the vertical plane of its wall
LEAST_WIDTH = 0.6  # m, of a façade
KINDS = {surfaces.WALL: WALL, surfaces.WINDOW: WINDOW, surfaces.DOOR: DOOR}
Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Facade:
    """A wall of a building: number of its shape and face, its frame, rings (n, 3) and size in the frame (m)."""

    shape: int
    face: int
    frame: Frame
    rings: list[Array]
    width: float
    height: float


@dataclass(frozen=True, eq=False)
class DetailedSource(ModelSource):
    """City models whose walls have façades by rules."""

    graph: Graph  # rewritten rules
    # The first keeps everything, the second is what is made; others are counted alone.
    criteria: tuple[Criteria, ...]
    lod: str = "auto"  # which level buildings are taken at: see `tiler.cityinput.levels.CHOICES`
    # Buildings, façades, assets, and polygons by criterion (``"polygons 0"`` and so on), ``"low assets"``, ``"low
    # facades"``; each reading counts anew.
    counts: Counter[str] = field(default_factory=Counter)

    @property
    def step(self) -> NDArray[np.float64]:
        """Tenths of millimetres (m): at whole ones thin triangles between panes bend by more than 10 degrees."""
        return np.full(3, 0.0001)

    def buildings(self) -> Iterator[ModelBuilding]:
        """Give each building at level 3: walls with openings, all else as it is."""
        self.counts.clear()
        for building in super().buildings():
            yield self._detail(building)

    def _detail(self, building: ModelBuilding) -> ModelBuilding:
        shapes = best_shapes(building, self.lod)
        self.counts["buildings"] += 1
        if any(shape.lod >= OPENINGS for shape in shapes):
            self.told["buildings that have level 3 themselves, as they are"] += 1
            return replace(building, shapes=shapes)
        walls = [wall for k, shape in enumerate(shapes) for wall in self._find_facades(k, shape)]
        front = max(walls, key=lambda wall: round(wall.width, 3), default=None)
        faces = join_faces(shape.faces for shape in shapes)
        obstacles, first = _obstacles(faces), np.cumsum([0, *(len(shape.faces) for shape in shapes)]).tolist()
        made: dict[tuple[int, int], tuple[Facade, list[Product], Made]] = {}
        for wall in walls:
            start = self.graph.front if wall is front else self.graph.other
            products = self._execute(wall, start, obstacles, first[wall.shape] + wall.face)
            made[wall.shape, wall.face] = wall, products, self._make(products)
        self._count_plain(len(faces) - len(walls))
        pictures: list[Picture] = []
        detailed: list[Shape] = []
        installations: dict[str, str] = {}
        attributes = dict(building.attributes)
        for k, shape in enumerate(shapes):
            done = FaceList()
            for j, (rings, kind) in enumerate(zip(_rings(shape.faces), shape.faces.kind.tolist(), strict=True)):
                if (k, j) not in made:
                    done.add(rings, kind)
                    continue
                wall, products, found = made[k, j]
                frame = wall.frame
                shown = _find_pictures(wall, products, found)
                pictures += shown.values()
                done.add([*rings, *_place(frame, [found.wall])[0]], PICTURED if -1 in shown else WALL)
                for n, own in enumerate(_place(frame, found.surfaces)):
                    done.add(own, PICTURED if n in shown else KINDS[found.surfaces[n].kind])
                for parts in found.installations:
                    name = f"{shape.owner}-balcony-{len(installations) + 1}"
                    installations[name] = shape.owner
                    attributes[name] = {"function": "balcony"}
                    balcony = FaceList()
                    for own in _place(frame, parts):
                        balcony.add(own, INSTALLATION)
                    detailed.append(Shape(name, LEVEL, True, balcony.done()))
            detailed.append(replace(shape, lod=LEVEL, faces=done.done()))
        return replace(
            building,
            shapes=tuple(detailed),
            attributes=attributes,
            kinds=dict.fromkeys(installations, "BuildingInstallation"),
            parents=installations,
            pictures=pictures,
        )

    def _find_facades(self, number: int, shape: Shape) -> Iterator[Facade]:
        areas = area_vectors(shape.faces.xyz, shape.faces.ring_start)[shape.faces.face_start[:-1]]
        for k, (rings, kind) in enumerate(zip(_rings(shape.faces), shape.faces.kind.tolist(), strict=True)):
            if kind not in (WALL, UNKNOWN):
                continue
            frame = find_frame(rings, areas[k], most_off=MOST_OFF)
            if frame is None:
                self.told["walls that lean or are not flat, left plain"] += kind == WALL
                continue
            local = frame.to_local(rings[0])
            width, height = float(local[:, 0].max()), float(local[:, 2].max())
            if width >= LEAST_WIDTH:
                yield Facade(number, k, frame, rings, width, height)

    def _execute(self, wall: Facade, start: str, faces: Obstacles, number: int) -> list[Product]:
        normal = (float(wall.frame.normal[0]), float(wall.frame.normal[1]), 0.0)

        def decide(middle: tuple[float, float], labels: frozenset[str]) -> tuple[int, ...]:
            x, y, z = wall.frame.place(np.array([[middle[0], 0.0, middle[1]]]))[0].tolist()
            return tuple(one.share((x, y, z), normal, labels) for one in self.criteria)

        products = list(execute(self.graph, start, (wall.width, wall.height), decide))
        kept = keep_in_wall(products, wall.frame, wall.rings)
        self.told["assets that reach out of their wall, left out"] += len(products) - len(kept)
        free = find_free(kept, wall.frame, faces, number)
        self.told["assets that stay flat, as another face of the building is near"] += free.count(False)
        flat = (0,) * len(self.criteria)
        return [one if room else replace(one, shares=flat) for one, room in zip(kept, free, strict=True)]

    def _make(self, products: list[Product]) -> Made:
        self.counts["facades"] += 1
        self.counts["facades replaced by one polygon"] += not any(one.shares[1] for one in products)
        for k in range(len(self.criteria)):
            self.counts[f"polygons {k}"] += 1
            if any(one.shares[k] for one in products):
                self.counts[f"polygons {k}"] += count_polygons(products, k)
        self.counts["low assets"] += 1 + len(products)
        self.counts["low facades"] += 1
        for one in products:
            share = one.shares[1]
            self.counts["assets full" if share == 100 else "assets reduced" if share else "assets flat"] += 1
        return make_facade(products, 1)

    def _count_plain(self, number: int) -> None:
        keys = [*(f"polygons {k}" for k in range(len(self.criteria))), "low assets", "low facades"]
        self.counts.update(dict.fromkeys(keys, number))


def _find_pictures(wall: Facade, products: list[Product], made: Made) -> dict[int, Picture]:
    """Give the pictures of the flat surfaces of a façade, by their number; of a plain wall with assets as -1."""
    if products and not made.surfaces:
        assets = [(one.insert, one.corner) for one in products]
        return {-1: Picture(wall.frame, (wall.width, wall.height), assets, surfaces.WALL)}
    corners = wall.frame.place(np.array([(u, 0.0, v) for _, (u, v) in made.flat.values()]).reshape(-1, 3))
    found = {}
    for (n, (insert, _)), origin in zip(made.flat.items(), corners, strict=True):
        size, kind = (insert.width, insert.height), made.surfaces[n].kind
        found[n] = Picture(replace(wall.frame, origin=origin), size, [(insert, (0.0, 0.0))], kind)
    return found


def detail_source(
    source: ModelSource,
    graph: Graph,
    criteria: tuple[Criteria, ...],
    *,
    lod: str = "auto",
) -> DetailedSource:
    """Detail a source; its box grows by how far assets reach out of walls."""
    out = max((reach(node.insert)[0] for node in graph.nodes.values() if isinstance(node, InsertLod)), default=0.0)
    grown = np.array([out, out, 0.0])
    return DetailedSource(
        source.files, source.crs, source.low - grown, source.high + grown, source.notes, Counter(),
        graph, criteria, lod,
    )  # fmt: skip


def _obstacles(faces: Faces) -> Obstacles:
    """Give the borders of faces, without their holes."""
    planes = find_planes(faces)
    border = faces.face_start[:-1]
    first, last = faces.ring_start[border], faces.ring_start[border + 1]
    start = np.cumsum(last - first) - (last - first)
    rows = np.arange(int((last - first).sum())) + np.repeat(first - start, last - first)
    length = np.sqrt((planes.normal * planes.normal).sum(axis=1))[:, np.newaxis]
    return Obstacles(faces.xyz[rows], start, planes.normal / np.where(length > 0, length, 1.0), planes.centre)


def _rings(faces: Faces) -> Iterator[list[Array]]:
    rings = [faces.xyz[first:last] for first, last in pairwise(faces.ring_start.tolist())]
    for first, last in pairwise(faces.face_start.tolist()):
        yield rings[first:last]


def _place(frame: Frame, parts: Sequence[surfaces.Surface]) -> list[list[Array]]:
    """Give the rings of surfaces in the CRS; an empty border is left out."""
    rings = [[ring for ring in (one.border, *one.holes) if ring] for one in parts]
    local = [point for of_one in rings for ring in of_one for point in ring]
    if not local:
        return [[] for _ in parts]
    placed, ends = frame.place(np.array(local)), accumulate(len(ring) for of_one in rings for ring in of_one)
    return [[placed[end - len(ring) : end] for ring, end in zip(of_one, ends, strict=False)] for of_one in rings]
