"""Which level of detail of a building is taken, and what comes after it where it has no roof."""

from collections.abc import Iterator, Sequence
from functools import lru_cache

from tiler.cityinput.faces import GROUND, NO_LOD, OUTLINE, ROOF, UNKNOWN, Faces, ModelBuilding, Shape, join_faces

ROOFS = 2.0  # from this level on, roofs have their shapes
OPENINGS = 3.0  # from this level on, surfaces have openings and details
CHOICES = ("auto", "1.2", "1.3", "2.1", "2.2")


def rank_levels(levels: Sequence[float], asked: str) -> list[float]:
    """Order levels of detail, from 1 on and `NO_LOD`, the one that is wanted most first.

    ``"auto"`` takes the best roofs; a number of `CHOICES` the best level up to it, then the next above.

    Examples
    --------
    >>> rank_levels([1.2, 1.3, 2.2, 3.0], "auto"), rank_levels([1.2, 2.2, 3.0], "1.3")
    ([2.2, 3.0, 1.3, 1.2], [1.2, 2.2, 3.0])
    """
    return list(_rank_levels(frozenset(levels), asked))


@lru_cache
def _rank_levels(levels: frozenset[float], asked: str) -> list[float]:
    known = sorted(level for level in levels if level >= 1)
    none = [NO_LOD] if NO_LOD in levels else []
    if asked == "auto":
        roofs = [level for level in known if ROOFS <= level < OPENINGS]
        fine = [level for level in known if level >= OPENINGS]
        blocks = [level for level in known if level < ROOFS]
        return [*roofs[::-1], *fine, *none, *blocks[::-1]]
    most = float(asked)
    return [*[level for level in known if level <= most][::-1], *[level for level in known if level > most], *none]


def choose_shapes(building: ModelBuilding, asked: str) -> Iterator[tuple[float, list[Shape]]]:
    """Give what may be taken for a building, the best first: the best level among the shapes, and these.

    Each part has its best level; from one attempt to the next the best of all is left out. A building's own faces
    count where its parts have none that is better. None where the building has no level from 1 on.
    """
    shapes = [shape for shape in building.shapes if (shape.lod >= 1 or shape.lod == NO_LOD) and len(shape.faces)]
    levels = _rank_levels(frozenset(shape.lod for shape in shapes), asked)
    ranked = [(levels.index(shape.lod), shape) for shape in shapes]
    for first in range(len(levels)):
        chosen: list[Shape] = []
        best: dict[str, int] = {}
        for rank, shape in ranked:
            if first <= rank < best.get(shape.owner, len(levels)):
                best[shape.owner] = rank
        others = min((rank for owner, rank in best.items() if owner != building.id), default=len(levels))
        for owner in dict.fromkeys(shape.owner for shape in shapes):
            if owner in best and (owner != building.id or best[owner] <= others):
                chosen += _of_one_kind(
                    [shape for rank, shape in ranked if rank == best[owner] and shape.owner == owner]
                )
        if chosen:
            yield levels[min(best.values())], chosen


def best_shapes(building: ModelBuilding, asked: str) -> tuple[Shape, ...]:
    """Give the shapes of the first attempt of `choose_shapes`; none where there is none."""
    return next((tuple(chosen) for _, chosen in choose_shapes(building, asked)), ())


def find_outline(building: ModelBuilding) -> Faces:
    """Give faces that say where a building without roofs stands: those of the level 0, else with the ground's."""
    found = join_faces(shape.faces for shape in building.shapes if 0 <= shape.lod < 1)
    if len(found) and (found.kind == OUTLINE).all():
        return found
    return join_faces(shape.faces for shape in building.shapes if (shape.faces.kind == GROUND).any())


def _of_one_kind(shapes: list[Shape]) -> list[Shape]:
    """Leave out shapes without named roofs where another one at the level has some: they are the same house."""
    if len(shapes) == 1:
        return shapes
    named = [shape for shape in shapes if (shape.faces.kind == ROOF).any()]
    return (
        named + [s for s in shapes if not (s.faces.kind == UNKNOWN).all() and s not in named] if named else shapes
    )
