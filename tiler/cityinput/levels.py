"""Which level of detail of a building is taken, and what comes after it where it has no roof."""

from collections.abc import Iterator, Sequence

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
    known = sorted({level for level in levels if level >= 1})
    none = [NO_LOD] if NO_LOD in levels else []
    if asked == "auto":
        roofs = [level for level in known if ROOFS <= level < OPENINGS]
        fine = [level for level in known if level >= OPENINGS]
        blocks = [level for level in known if level < ROOFS]
        return [*roofs[::-1], *fine, *none, *blocks[::-1]]
    most = float(asked)
    return [*[level for level in known if level <= most][::-1], *[level for level in known if level > most], *none]


def list_attempts(building: ModelBuilding, asked: str) -> list[tuple[float, list[Shape]]]:
    """List what may be taken for a building, the best first: the best level among the shapes, and these.

    Each part has its best level; from one attempt to the next the best of all is left out. A building's own faces
    count where its parts have none that is better. None where the building has no level from 1 on.
    """
    return list(_choose_shapes(building, asked))


def best_shapes(building: ModelBuilding, asked: str) -> tuple[Shape, ...]:
    """Give the shapes of the first attempt of `list_attempts`; none where there is none."""
    return next((tuple(chosen) for _, chosen in _choose_shapes(building, asked)), ())


def _choose_shapes(building: ModelBuilding, asked: str) -> Iterator[tuple[float, list[Shape]]]:
    """Give the best level and the shapes of each attempt."""
    shapes = [shape for shape in building.shapes if len(shape.faces) and (shape.lod >= 1 or shape.lod == NO_LOD)]
    ranked = rank_levels([shape.lod for shape in shapes], asked)
    for first in range(len(ranked)):
        chosen: list[Shape] = []
        best: dict[str, int] = {}
        for owner in dict.fromkeys(shape.owner for shape in shapes):
            own = {ranked.index(s.lod) for s in shapes if s.owner == owner and ranked.index(s.lod) >= first}
            if own:
                best[owner] = min(own)
        others = [rank for owner, rank in best.items() if owner != building.id]
        for owner, rank in best.items():
            if owner == building.id and others and min(others) < rank:
                continue
            chosen += _of_one_kind([s for s in shapes if s.owner == owner and s.lod == ranked[rank]])
        if chosen:
            yield ranked[min(best.values())], chosen


def find_outline(building: ModelBuilding) -> Faces:
    """Give faces that say where a building without roofs stands: those of the level 0, else with the ground's."""
    found = join_faces(shape.faces for shape in building.shapes if 0 <= shape.lod < 1)
    if len(found) and (found.kind == OUTLINE).all():
        return found
    return join_faces(shape.faces for shape in building.shapes if (shape.faces.kind == GROUND).any())


def _of_one_kind(shapes: list[Shape]) -> list[Shape]:
    """Leave out shapes without named roofs where another one at the level has some: they are the same house."""
    named = [shape for shape in shapes if (shape.faces.kind == ROOF).any()]
    return (
        named + [s for s in shapes if not (s.faces.kind == UNKNOWN).all() and s not in named] if named else shapes
    )
