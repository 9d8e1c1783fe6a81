"""Surfaces in space as they are seen from above: the plan outline of a building's faces (step 1.2)."""

import numpy as np
import shapely
from numpy.typing import NDArray

GRID = 0.001  # m; faces that meet within this are joined
GAP = 0.01  # m; gaps between faces up to twice this wide are closed
STEEP = 0.002  # a face whose plan area is a smaller share of its area is vertical


def outline_faces(faces: NDArray[np.object_], *, metre: float = 1.0) -> shapely.Geometry:
    """Give the outline of faces in plan.

    Parameters
    ----------
    faces : object, (n,)
        Polygons, with Z or without.
    metre : float
        Length of a metre in units of the coordinates.

    Returns
    -------
    shapely.Geometry
        Polygon or multipolygon without Z: the union of the faces that are not vertical, on a grid of `GRID`, with
        gaps up to twice `GAP` closed. An empty polygon if all are vertical.

    Examples
    --------
    >>> roof = shapely.Polygon([(0, 0, 3), (2, 0, 5), (2, 4, 5), (0, 4, 3)])
    >>> wall = shapely.Polygon([(2, 0, 5), (2, 4, 5), (2, 4, 0), (2, 0, 0)])
    >>> outline_faces(np.array([roof, wall])).normalize().wkt
    'POLYGON ((0 0, 0 4, 2 4, 2 0, 0 0))'
    """
    seen = faces[_is_seen(faces)]
    if not len(seen):
        return shapely.Polygon()
    flat = shapely.make_valid(shapely.force_2d(seen), method="structure", keep_collapsed=False)
    outline = _polygonal(shapely.union_all(flat, grid_size=GRID * metre))
    if _count_rings(outline) > 1:
        gap = {"join_style": "mitre", "mitre_limit": 5.0}
        closed = _polygonal(outline.buffer(GAP * metre, **gap).buffer(-GAP * metre, **gap))
        if not closed.is_empty and _count_rings(closed) < _count_rings(outline):
            return closed
    return outline


def is_surface(geometry: NDArray[np.object_]) -> NDArray[np.bool_]:
    """Tell the multipolygons with Z that are faces of a body rather than parts of an outline.

    Parameters
    ----------
    geometry : object, (n,)
        Polygons and multipolygons.

    Returns
    -------
    bool, (n,)
        True where several faces have Z and are, seen from above, no valid multipolygon: they are vertical, lie
        over one another, or meet along edges.
    """
    several = shapely.has_z(geometry) & (shapely.get_num_geometries(geometry) > 1)
    found = np.zeros(len(geometry), np.bool_)
    with np.errstate(invalid="ignore"):
        found[several] = ~shapely.is_valid(shapely.force_2d(geometry[several]))
    return found


def _is_seen(faces: NDArray[np.object_]) -> NDArray[np.bool_]:
    """Compare the plan area of each face with its area, by the normals of Newell."""
    xyz, face = shapely.get_coordinates(shapely.get_exterior_ring(faces), include_z=True, return_index=True)
    first = np.unique(face, return_index=True)[1]
    low = np.zeros((len(faces), 3))
    low[face[first]] = xyz[first]
    arm = np.where(np.isnan(xyz), 0.0, xyz - low[face])
    same = face[1:] == face[:-1]
    cross = np.cross(arm[:-1][same], arm[1:][same])
    normal = np.stack([np.bincount(face[1:][same], side, minlength=len(faces)) for side in cross.T], axis=1)
    seen: NDArray[np.bool_] = np.abs(normal[:, 2]) > STEEP * np.linalg.norm(normal, axis=1)
    return seen


def _polygonal(geometry: shapely.Geometry) -> shapely.Geometry:
    parts = [part for part in shapely.get_parts(geometry) if part.geom_type == "Polygon" and not part.is_empty]
    return parts[0] if len(parts) == 1 else shapely.MultiPolygon(parts)


def _count_rings(geometry: shapely.Geometry) -> int:
    return len(shapely.get_rings(shapely.get_parts(geometry)))
