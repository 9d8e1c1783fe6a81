"""Pictures of a run's boundary and volume mesh, drawn off-screen (step 3.6)."""

from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import ConfigError
from tiler.atomic import replacing
from tiler.picture_data import City, load_air, load_city
from tiler.picture_parts import add_air, add_houses, add_terrain
from tiler.plain_picture import PlainPlotter, has_graphics
from tiler.sizes_picture import draw_sizes

# Pictures, and their sizes (pixels) where nothing else is asked for.
SIZES = {
    "boundary": (1600, 1000),
    "mesh": (1600, 1000),
    "overview": (2000, 640),
    "tiles": (1600, 1000),
    "sizes": (1000, 1046),
}
# Compass direction that the camera stands in, and its angle over the horizon (degrees).
VIEW = (215.0, 35.0)
# The cut through the volume, which looks south, is seen more squarely.
CUT_VIEW = (200.0, 27.0)
VIEW_ANGLE = 22.0
MARGIN = 1.04
# Length up to which one surface darkens another (m), in regions below 2 km.
OCCLUSION_RADIUS = 20.0
SKY = ("#ffffff", "#c9dff0")


def render_run(
    directory: Path,
    output: Path,
    *,
    what: str = "boundary",
    size: tuple[int, int] | None = None,
) -> None:
    """Draw a run to a PNG file, without a display.

    Parameters
    ----------
    directory : Path
        Output of a run: ``boundary.pvtp`` and, for ``"mesh"`` and ``"overview"``, ``mesh.pvtu``.
    output : Path
        The PNG file; it appears whole or not at all.
    what : str
        ``"boundary"``: terrain and houses from the south-west. ``"mesh"``: the same, and behind a cut
        through the middle the tetrahedra of the northern half. ``"overview"``: both side by side.
        ``"tiles"``: as ``"boundary"``, but coloured by tile: neighbours differ.
        ``"sizes"``: triangles from above, coloured by the length of their edges, and by tile.
    size : (int, int), optional
        Width and height (pixels); 1600 x 1000, for the overview 2000 x 640, for the sizes 1000 x 1046.

    Raises
    ------
    ValueError
        If `what` is none of these, or `size` is less than 2 x 2.
    ConfigError
        If pyvista is not installed.
    OutputError
        If the picture cannot be written.
    InputError
        If a file of the run is missing, damaged, or has no ground; if there are more facets than a picture may
        have (`tiler.picture_data.MOST_FACETS`); if, for ``"tiles"`` and ``"sizes"``, a piece is not named after a
        tile.

    Notes
    -----
    The camera follows from the region alone, but VTK samples the shade between houses at random: two
    pictures of one run differ by more than 3 of 255 grey levels in some 6 % of the pixels, so their bytes
    differ. Where VTK has no OpenGL to draw with, the same is painted facet by facet (`tiler.plain_picture`).
    Edges fade out as triangles get small on the picture. Everything is moved to the origin first,
    since graphics cards compute in single precision.
    """
    if what not in SIZES:
        raise ValueError(f"picture {what!r} must be one of {', '.join(SIZES)}")
    columns, rows = size or SIZES[what]
    if min(columns, rows) < 2:
        raise ValueError(f"size {columns} x {rows} must be at least 2 x 2")
    pv = _pyvista()
    left = columns // 2
    panels = (("boundary", left), ("mesh", columns - left)) if what == "overview" else ((what, columns),)
    # VTK says aloud that there is no display before it takes the way without one.
    with pv.vtk_verbosity("off"):
        city = load_city(directory)
        if what == "sizes":
            _save(draw_sizes(city, (columns, rows)), output)
            return
        images = [_draw(pv, directory, city, part, (width, rows)) for part, width in panels]
    _save(np.hstack(images), output)


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


def _pyvista() -> ModuleType:
    try:
        import pyvista
    except ImportError as error:
        raise ConfigError("pictures need pyvista: pip install citystitch[pictures]") from error
    module: ModuleType = pyvista
    return module


def _draw(pv: ModuleType, directory: Path, city: City, what: str, size: tuple[int, int]) -> NDArray[np.uint8]:
    if not has_graphics():
        return _draw_plainly(directory, city, what, size)
    plotter = pv.Plotter(off_screen=True, window_size=list(size), lighting="none")
    try:
        plotter.set_background(SKY[0], top=SKY[1])
        shown = _add_parts(plotter, directory, city, what, size)
        _light(pv, plotter)
        _aim(plotter, *_camera(shown, what, size))
        extent = float(np.ptp(city.points[:, :2], axis=0).max())
        plotter.enable_ssao(radius=max(OCCLUSION_RADIUS, extent / 100), bias=extent / 1500, kernel_size=128)
        plotter.enable_anti_aliasing("ssaa")
        image: NDArray[np.uint8] = plotter.screenshot(return_img=True)
    finally:
        plotter.close()
    return image


def _draw_plainly(directory: Path, city: City, what: str, size: tuple[int, int]) -> NDArray[np.uint8]:
    plotter = PlainPlotter()
    shown = _add_parts(plotter, directory, city, what, size)
    position, focal = _camera(shown, what, size)
    return plotter.paint(position, focal, view_angle=VIEW_ANGLE, size=size, sky=SKY)


def _add_parts(plotter: Any, directory: Path, city: City, what: str, size: tuple[int, int]) -> NDArray[np.float64]:
    """Add what a picture shows; returns the points that it has to hold."""
    by_tile = what == "tiles"
    add_houses(plotter, city, size, by_tile=by_tile)
    shown = [city.points, add_terrain(plotter, city, size, by_tile=by_tile)]
    if what == "mesh":
        shown.append(add_air(plotter, load_air(directory, city.origin), size))
    return np.vstack(shown)


def _light(pv: ModuleType, plotter: Any) -> None:
    """Sun from the south-east, softer sky light from the west and from above."""
    for place, strength, colour in (
        ((0.55, -0.85, 1.0), 0.8, "#fff4e0"),
        ((-1.0, -0.3, 0.5), 0.4, "#dfe9f5"),
        ((0.0, 0.0, 1.0), 0.15, "#ffffff"),
    ):
        light = pv.Light(position=place, focal_point=(0, 0, 0), color=colour, intensity=strength)
        light.positional = False
        plotter.add_light(light)


def _camera(
    points: NDArray[np.float64], what: str, size: tuple[int, int]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    azimuth, elevation = CUT_VIEW if what == "mesh" else VIEW
    return fit_camera(
        points,
        azimuth=azimuth,
        elevation=elevation,
        view_angle=VIEW_ANGLE / MARGIN,
        aspect=size[0] / size[1],
    )


def _aim(plotter: Any, position: NDArray[np.float64], focal: NDArray[np.float64]) -> None:
    camera = plotter.camera
    camera.view_angle = VIEW_ANGLE
    camera.position, camera.focal_point, camera.up = position, focal, (0.0, 0.0, 1.0)
    plotter.reset_camera_clipping_range()


def _save(image: NDArray[np.uint8], output: Path) -> None:
    from PIL import Image

    with replacing(output) as part:
        Image.fromarray(image).save(part, format="png", optimize=True)
