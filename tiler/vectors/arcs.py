"""Circular arcs as chains of straight segments, the same from either end (step 1.2)."""

import numpy as np
from numpy.typing import NDArray

SAGITTA = 0.01  # m; how far a segment may lie from its arc
LARGEST_ANGLE = np.pi / 8  # that one segment spans, whatever the radius: a circle has 16 at least
MAX_SEGMENTS = 10_000  # of one arc


def linearise_arcs(points: NDArray[np.float64], tolerance: float) -> NDArray[np.float64]:
    """Replace the arcs of a circular string by segments.

    Parameters
    ----------
    points : float64, (2 k + 1, 2 or more)
        Start, a point between and end of the first arc; each further arc begins where the last one ends. Columns
        beyond the second go from start to end evenly.
    tolerance : float
        Largest distance of a segment from its arc, in units of the coordinates.

    Returns
    -------
    float64, (n, columns of points)
        Vertices on the arcs, with the start and the end of each as they came.

    Raises
    ------
    ValueError
        If there are no arcs: the number of points is even, or below 3.

    Notes
    -----
    Three points on a line stay two segments. Where start and end are the same the arc is a circle, whose centre
    is half-way to the point between (ISO 19107, SQL/MM part 3). An arc that is run through from the other end
    gives the same vertices bit for bit, so that two houses with a round wall between them still share it.

    Examples
    --------
    >>> linearise_arcs(np.array([[0.0, 0], [1, 1], [2, 0]]), 0.1).round(3)[:5].tolist()
    [[0.0, 0.0], [0.076, 0.383], [0.293, 0.707], [0.617, 0.924], [1.0, 1.0]]
    """
    if len(points) < 3 or len(points) % 2 == 0:
        raise ValueError(f"a circular string of {len(points)} points has no whole number of arcs")
    arcs = zip(points[:-2:2], points[1:-1:2], points[2::2], strict=True)
    return np.concatenate([points[:1], *(_linearise_arc(*arc, tolerance=tolerance)[1:] for arc in arcs)])


def _linearise_arc(
    start: NDArray[np.float64], middle: NDArray[np.float64], end: NDArray[np.float64], *, tolerance: float
) -> NDArray[np.float64]:
    if tuple(end[:2]) < tuple(start[:2]):
        return _linearise_arc(end, middle, start, tolerance=tolerance)[::-1]
    centre = _centre(start[:2], middle[:2], end[:2])
    if centre is None:
        return np.stack([start, middle, end])
    arms = np.stack([start[:2], middle[:2], end[:2]]) - centre
    angle = np.arctan2(arms[:, 1], arms[:, 0])
    sweep = (angle[2] - angle[0]) % (2 * np.pi) or 2 * np.pi
    if (angle[1] - angle[0]) % (2 * np.pi) > sweep:
        sweep -= 2 * np.pi
    radius = float(np.hypot(*arms[0]))
    step = min(2 * np.arccos(max(1 - tolerance / radius, 0.0)), LARGEST_ANGLE)
    n = int(min(np.ceil(abs(sweep) / step - 1e-9), MAX_SEGMENTS)) if step > 0 else MAX_SEGMENTS
    share = np.arange(n + 1) / n
    turned = angle[0] + share * sweep
    chain = start + share[:, None] * (end - start)
    chain[:, :2] = centre + radius * np.stack([np.cos(turned), np.sin(turned)], axis=1)
    chain[0], chain[-1] = start, end
    return chain


def _centre(
    start: NDArray[np.float64], middle: NDArray[np.float64], end: NDArray[np.float64]
) -> NDArray[np.float64] | None:
    """Centre of the circle through three points; None where they are on a line or not finite."""
    if (start == end).all():
        return None if (start == middle).all() else (start + middle) / 2
    (ax, ay), (bx, by) = middle - start, end - start
    twice = 2 * (ax * by - ay * bx)
    longest = max(ax * ax + ay * ay, bx * bx + by * by)
    if not abs(twice) > 1e-12 * longest:  # NaN too
        return None
    a, b = ax * ax + ay * ay, bx * bx + by * by
    centre = start + np.array([by * a - ay * b, ax * b - bx * a]) / twice
    return centre if np.isfinite(centre).all() else None
