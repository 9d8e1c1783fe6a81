"""What a level costs and how true it is: polygons, areas and volumes against the buildings."""

import numpy as np
import shapely
from numpy.typing import NDArray


def count_faces(outlines: NDArray[np.object_]) -> NDArray[np.int64]:
    """Count the faces of prisms: a wall for each side of an outline, a roof and a ground for each part.

    Parameters
    ----------
    outlines : object, (n,)
        Polygons and multipolygons.

    Examples
    --------
    >>> count_faces(np.array([shapely.box(0, 0, 1, 1)]))
    array([6])
    """
    parts, owner = shapely.get_parts(outlines, return_index=True)
    rings = shapely.get_num_interior_rings(parts) + 1
    faces = shapely.get_num_coordinates(parts) - rings + 2  # the first corner of a ring is repeated at its end
    return np.bincount(owner, faces, minlength=len(outlines)).astype(np.int64)


def compare(value: float, truth: float) -> float | None:
    """Give the share by which a value is more than the true one, None where that is 0.

    Examples
    --------
    >>> compare(110.0, 100.0), compare(1.0, 0.0)
    (0.1, None)
    """
    return round(value / truth - 1, 6) if truth else None
