"""Footprints beside a city model: what they keep where buildings of the model stand (step 1.2)."""

from dataclasses import dataclass, replace

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.data.citymodel import Footprints, make_ids, number_ids, take_footprints
from pipeline.data.notes import Note
from tiler.footprints.building_parts import SEEN, mend_polygons, subtract_polygons
from tiler.vectors.features import Box

DROP_SHARE = 0.5  # of a footprint, from which on the buildings of the model over it stand for it


@dataclass(frozen=True, eq=False)
class ModelPlaces:
    """Where buildings of city models stand."""

    polygons: NDArray[np.object_]  # (n,): their outlines, all that meet the footprints (m)
    # (m,): numbers of the ids of all buildings of the region, ascending: see `number_ids`
    numbers: NDArray[np.int64]


def give_way(footprints: Footprints, places: ModelPlaces, bounds: Box) -> tuple[Footprints, list[Note]]:
    """Take from footprints what buildings of city models stand on: each place belongs to one house.

    What becomes of each depends on the buildings over it alone. Places of notes lie in `bounds`, the region (m).

    Returns
    -------
    Footprints
        Those that are left: without the area that buildings have. Pieces that are too small or too narrow are not
        kept of what something was taken from (`subtract_polygons`). Ids that the model has, too, are completed by
        the geometry.
    list of Note
        ``footprint-in-model`` for those that are gone: buildings of the model cover half of them or more, or leave
        no piece; ``footprint-cut-by-model``; ``footprint-id-repeated``. At most one of each kind a footprint.
    """
    kept, covered = footprints.polygons.copy(), np.zeros(len(footprints.ids))
    row, other = shapely.STRtree(places.polygons).query(kept, predicate="intersects")
    order = np.lexsort((other, row))
    touched, start = np.unique(row[order], return_index=True)
    whole = mend_polygons(kept[touched])
    for k, over in enumerate(np.split(other[order], start[1:]) if len(touched) else []):
        mended = places.polygons[over]
        mended = mend_polygons(mended[np.argsort(shapely.to_wkb(mended), kind="stable")])
        common = float(shapely.area(shapely.intersection(whole[k], shapely.union_all(mended))))
        if common > SEEN:
            covered[touched[k]] = common
            kept[touched[k]] = (
                shapely.Polygon() if common >= DROP_SHARE * whole[k].area else subtract_polygons(whole[k], mended)
            )
    gone = shapely.is_empty(kept) & (covered > 0)
    again = ~gone & np.isin(number_ids(footprints.ids), places.numbers)
    ids = footprints.ids.astype(object)
    ids[again] = [
        f"{name}-{made}" for name, made in zip(ids[again], make_ids(footprints.polygons[again]), strict=True)
    ]
    left = replace(footprints, polygons=kept, ids=ids.astype(np.str_))
    told = (
        ("footprint-in-model", gone, footprints.ids, "left out"),
        ("footprint-cut-by-model", ~gone & (covered > 0), left.ids, "the rest is meshed"),
    )
    notes = [
        Note(
            kind,
            str(names[k]),
            *_place(footprints.polygons[k], bounds),
            f"{covered[k]:.2f} of its {shapely.area(footprints.polygons[k]):.2f} m2 are under buildings of the "
            f"city model or blocks; {end}",
        )
        for kind, chosen, names, end in told
        for k in np.flatnonzero(chosen).tolist()
    ]
    why = "a building of the city model has this id, too"
    notes += [
        Note("footprint-id-repeated", str(left.ids[k]), *_place(footprints.polygons[k], bounds), why)
        for k in np.flatnonzero(again).tolist()
    ]
    return take_footprints(left, ~gone), notes


def _place(polygon: shapely.Geometry, bounds: Box) -> tuple[float, float]:
    """Give a place of a footprint within the region, which it meets."""
    inside = shapely.intersection(mend_polygons(np.array([polygon], object))[0], shapely.box(*bounds))
    point = shapely.point_on_surface(inside)
    return point.x, point.y
