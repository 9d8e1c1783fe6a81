"""The camera of pictures: where it stands, and how it holds all that is shown."""

import numpy as np
from numpy.typing import NDArray

# Compass direction that the camera stands in, and its angle over the horizon (degrees).
VIEW = (215.0, 35.0)
# The cut through the volume, which looks south, is seen more squarely.
CUT_VIEW = (200.0, 27.0)
VIEW_ANGLE = 22.0
MARGIN = 1.04
SKY = ("#ffffff", "#c9dff0")


def fit_camera(
    points: NDArray[np.float64], *, azimuth: float, elevation: float, view_angle: float, aspect: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Place a camera such that points just fill the picture.

    Parameters
    ----------
    points : float64, (n, 3)
        What to show (m); corners of its box will do.
    azimuth, elevation : float
        Compass direction in which the camera stands, and its angle over the horizon (degrees).
    view_angle : float
        Vertical opening angle (degrees).
    aspect : float
        Width over height of the picture.

    Returns
    -------
    position, focal_point : float64, (3,)
        Of the camera (m); up is up.

    Examples
    --------
    >>> corners = np.array([(x, 0.0, z) for x in (-1, 1) for z in (-1, 1)])
    >>> fit_camera(corners, azimuth=180, elevation=0, view_angle=90, aspect=1)[0].round(6)
    array([ 0., -1.,  0.])
    """
    turn, rise = np.radians(azimuth), np.radians(elevation)
    towards = np.array([np.sin(turn) * np.cos(rise), np.cos(turn) * np.cos(rise), np.sin(rise)])
    right = np.array([-np.cos(turn), np.sin(turn), 0.0])
    up = np.cross(towards, right)
    slope = np.tan(np.radians(view_angle) / 2) * np.array([aspect, 1.0])
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    depth, seen = (points - middle) @ towards, (points - middle) @ np.column_stack([right, up])
    # A point is inside if |seen - centre| <= slope * (distance - depth), for both signs and axes.
    least, most = (seen - slope * depth[:, None]), (seen + slope * depth[:, None])
    low, high = least.min(axis=0), most.max(axis=0)
    distance = float(((high - low) / (2 * slope)).max())
    centre = (high + low) / 2
    focal = middle + centre[0] * right + centre[1] * up
    return focal + distance * towards, focal
