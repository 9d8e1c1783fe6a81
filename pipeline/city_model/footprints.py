"""Clean footprints: valid, oriented, canonical polygons without needless vertices (steps 1.4 and 2.2)."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.data.citymodel import Footprints
from pipeline.data.notes import Note
from pipeline.geometry.holes import fill_holes, list_holes
from pipeline.geometry.rings import drop_needless_vertices, make_canonical, sort_canonically

# A building or courtyard thinner than this in the mean, 2 area / perimeter (m), is a wall or a gap: no room
# for a person, and no shape for a mesh of metres.
SLIVER_WIDTH = 0.25
# Coordinates beyond this (m) are none of a metric CRS on this planet.
FARTHEST = 1e8
# Rounds of "repair, then drop needless vertices" before a part becomes its convex hull. One is the rule.
MAX_ROUNDS = 8


def clean_footprints(
    footprints: Footprints, *, min_area: float, tolerance: float
) -> tuple[Footprints, tuple[Note, ...]]:
    """Make footprints valid and canonical; drop those that are none (steps 1.4 and 2.2).

    Parameters
    ----------
    footprints : Footprints
        Geometries of any kind: None, empty, invalid, with Z or NaN, of several parts.
    min_area : float
        Smaller buildings are dropped, smaller courtyards filled (m²).
    tolerance : float
        A vertex goes if it makes a triangle thinner than this with its two neighbours (m): repeated,
        collinear, or the tip of a spike.

    Returns
    -------
    footprints : Footprints
        Valid Polygons without Z in canonical form (`make_canonical`), unique, with unique ids, sorted by id.
    notes : tuple of Note
        What was dropped, repaired, split, filled or renamed, with the input's id, sorted by kind and id.

    Raises
    ------
    ValueError
        If `min_area` or `tolerance` is negative or no number.

    Notes
    -----
    Does not depend on the order of the input, and a second call changes nothing. A footprint ``A`` of several
    parts becomes ``A-1``, ``A-2``, ... in canonical order of the parts, and so do several footprints of one
    id; names that are taken are left out. Of equal polygons the one with the smallest id stays (then height,
    then form). Empty input gives empty output. O(n log n) in the vertices.

    References
    ----------
    The paper's sections 4.2 (step 1.4) and 4.3 (step 2.2); rules of our own where it has none.
    """
    if not (min_area >= 0 and tolerance >= 0):
        raise ValueError(f"min_area {min_area} and tolerance {tolerance} must not be negative")
    notes: list[Note] = []
    parts = _read(footprints, notes)
    parts = _make_simple(parts, tolerance, notes)
    parts = _fill_courtyards(parts, min_area, notes)
    parts = _drop_small(parts, min_area, notes)
    parts = _drop_duplicates(parts, notes)
    parts = _rename(parts, notes)
    parts = parts.take(np.argsort(parts.ids, kind="stable"))
    clean = Footprints(parts.polygons, parts.ids, parts.given_height, parts.forms)
    return clean, tuple(sorted(notes, key=lambda note: (note.kind, note.subject, note.detail, str(note))))


@dataclass(frozen=True, eq=False)
class _Parts:
    """Polygons with their footprint's row, id, height, form of the roof and place: one row a polygon."""

    polygons: NDArray[np.object_]
    row: NDArray[np.int64]
    ids: NDArray[np.str_]
    given_height: NDArray[np.float64]
    forms: NDArray[np.float64]
    place: NDArray[np.float64]

    def take(self, rows: NDArray[np.int64] | NDArray[np.bool_]) -> "_Parts":
        return _Parts(
            self.polygons[rows],
            self.row[rows],
            self.ids[rows],
            self.given_height[rows],
            self.forms[rows],
            self.place[rows],
        )

    def with_polygons(self, polygons: NDArray[np.object_]) -> "_Parts":
        return replace(self, polygons=polygons)

    def note(self, kind: str, rows: NDArray[np.int64], details: Iterable[str]) -> Iterable[Note]:
        for i, detail in zip(rows, details, strict=True):
            yield Note(kind, str(self.ids[i]), float(self.place[i, 0]), float(self.place[i, 1]), detail)


def _read(footprints: Footprints, notes: list[Note]) -> _Parts:
    """Leave out rows without geometry or with coordinates that are no place."""
    geometries = shapely.force_2d(np.asarray(footprints.polygons, dtype=object))
    xy, row = shapely.get_coordinates(geometries, return_index=True)
    bad = np.unique(row[~(np.abs(xy) < FARTHEST).all(axis=1)])
    place = np.full((len(geometries), 2), np.nan)
    fine = np.setdiff1d(np.flatnonzero(~(shapely.is_missing(geometries) | shapely.is_empty(geometries))), bad)
    bounds = shapely.bounds(geometries[fine]).reshape(-1, 4)
    place[fine] = (bounds[:, :2] + bounds[:, 2:]) / 2
    ids = np.asarray(footprints.ids, dtype=np.str_)
    rows = _Parts(geometries, np.arange(len(geometries)), ids, footprints.given_height, footprints.forms, place)
    empty = np.setdiff1d(np.arange(len(geometries)), np.concatenate([fine, bad]))
    notes.extend(rows.note("footprint-empty", empty, ["no geometry"] * len(empty)))
    detail = f"a coordinate is no number below {FARTHEST:g} m"
    notes.extend(rows.note("footprint-not-finite", bad, [detail] * len(bad)))
    return rows.take(fine)


def _make_simple(parts: _Parts, tolerance: float, notes: list[Note]) -> _Parts:
    """Repair, split and simplify until nothing changes: valid canonical Polygons."""
    invalid = np.flatnonzero(~shapely.is_valid(parts.polygons))
    reasons = [str(reason) for reason in shapely.is_valid_reason(parts.polygons[invalid])]
    notes.extend(parts.note("footprint-repaired", invalid, reasons))
    done: list[_Parts] = []
    left, rounds, spiked = parts, 0, np.zeros(0, np.int64)
    while len(left.polygons):
        rounds += 1
        left = _split(left)
        if rounds > MAX_ROUNDS:
            left = left.with_polygons(make_canonical(shapely.convex_hull(left.polygons)))
        polygons, tips = drop_needless_vertices(left.polygons, tolerance)
        spiked = np.union1d(spiked, left.row[tips])
        left = left.with_polygons(polygons).take(~shapely.is_missing(polygons))
        valid = shapely.is_valid(left.polygons)
        whole = left.take(valid)
        done.append(whole.with_polygons(make_canonical(whole.polygons)))
        left = left.take(~valid)
    simple = _concatenate(done, parts)
    vanished = np.flatnonzero(~np.isin(parts.row, simple.row))
    notes.extend(
        parts.note("footprint-empty", vanished, [f"no area at tolerance {tolerance:g} m"] * len(vanished))
    )
    tipped = np.flatnonzero(np.isin(parts.row, np.setdiff1d(spiked, parts.row[vanished])))
    notes.extend(
        parts.note("footprint-spike", tipped, [f"spike or slit thinner than {tolerance:g} m"] * len(tipped))
    )
    return simple


def _split(parts: _Parts) -> _Parts:
    """Make all geometries valid and take their polygons apart."""
    geometries = parts.polygons.copy()
    bad = ~shapely.is_valid(geometries)
    geometries[bad] = shapely.make_valid(geometries[bad], method="structure", keep_collapsed=False)
    rows = np.arange(len(geometries))
    while (shapely.get_type_id(geometries) > shapely.GeometryType.POLYGON).any():
        geometries, index = shapely.get_parts(geometries, return_index=True)
        rows = rows[index]
    area = (shapely.get_type_id(geometries) == shapely.GeometryType.POLYGON) & ~shapely.is_empty(geometries)
    return parts.take(rows[area]).with_polygons(make_canonical(geometries[area]))


def _concatenate(pieces: list[_Parts], like: _Parts) -> _Parts:
    if not pieces:
        return like
    return _Parts(
        np.concatenate([piece.polygons for piece in pieces]),
        np.concatenate([piece.row for piece in pieces]),
        np.concatenate([piece.ids for piece in pieces]),
        np.concatenate([piece.given_height for piece in pieces]),
        np.concatenate([piece.forms for piece in pieces]),
        np.concatenate([piece.place for piece in pieces]),
    )


def _mean_width(polygons: NDArray[np.object_]) -> NDArray[np.float64]:
    width: NDArray[np.float64] = 2 * shapely.area(polygons) / shapely.length(polygons)
    return width


def _fill_courtyards(parts: _Parts, min_area: float, notes: list[Note]) -> _Parts:
    holes, owner = list_holes(parts.polygons)
    small = (shapely.area(holes) < min_area) | (_mean_width(holes) < SLIVER_WIDTH)
    details = [
        f"{area:.3f} m² (least {min_area:g}), mean width {width:.3f} m (least {SLIVER_WIDTH:g})"
        for area, width in zip(shapely.area(holes[small]), _mean_width(holes[small]), strict=True)
    ]
    notes.extend(parts.note("courtyard-filled", owner[small], details))
    return parts.with_polygons(fill_holes(parts.polygons, small))


def _drop_small(parts: _Parts, min_area: float, notes: list[Note]) -> _Parts:
    area, width = shapely.area(parts.polygons), _mean_width(parts.polygons)
    small = area < min_area
    thin = ~small & (width < SLIVER_WIDTH)
    details = [f"{value:.3f} m² < {min_area:g} m²" for value in area[small]]
    notes.extend(parts.note("footprint-too-small", np.flatnonzero(small), details))
    details = [f"mean width {value:.3f} m < {SLIVER_WIDTH:g} m" for value in width[thin]]
    notes.extend(parts.note("footprint-sliver", np.flatnonzero(thin), details))
    return parts.take(~small & ~thin)


def _drop_duplicates(parts: _Parts, notes: list[Note]) -> _Parts:
    """Keep of bitwise equal polygons the one with the smallest id, then the smallest known height and form."""
    ordered = parts.take(np.lexsort((*parts.forms.T, parts.given_height, parts.ids)))
    blobs = np.array(shapely.to_wkb(ordered.polygons, byte_order=1), dtype=object)
    _, first, group = (
        np.unique(blobs, return_index=True, return_inverse=True) if len(blobs) else 3 * (np.zeros(0, int),)
    )
    again = np.setdiff1d(np.arange(len(blobs)), first)
    details = [f"same polygon as {ordered.ids[first[group[i]]]}" for i in again]
    notes.extend(ordered.note("footprint-duplicate", again, details))
    return ordered.take(np.sort(first))


def _rename(parts: _Parts, notes: list[Note]) -> _Parts:
    """Number the polygons of one id in canonical order."""
    by_shape = parts.take(sort_canonically(parts.polygons))
    ordered = by_shape.take(np.argsort(by_shape.ids, kind="stable"))
    names = [str(name) for name in ordered.ids]
    known, start, count = np.unique(ordered.ids, return_index=True, return_counts=True)
    taken = {str(name) for name in known}
    for first, size in zip(start[count > 1], count[count > 1], strict=True):
        group = np.arange(first, first + size)
        for i, name in zip(group, _free_names(names[first], int(size), taken), strict=True):
            names[i] = name
        taken.update(names[first : first + size])
        split = len(np.unique(ordered.row[group])) == 1
        kind = "footprint-split" if split else "footprint-id-repeated"
        detail = f"{size} polygons, named {names[first]} to {names[first + size - 1]}"
        notes.extend(ordered.note(kind, group[:1], [detail]))
    renamed = np.array(names, dtype=np.str_)
    return replace(ordered, ids=renamed)


def _free_names(base: str, size: int, taken: set[str]) -> list[str]:
    names: list[str] = []
    number = 0
    while len(names) < size:
        number += 1
        name = f"{base}-{number}"
        if name not in taken:
            names.append(name)
    return names
