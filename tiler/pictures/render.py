"""Pictures of a run's boundary and volume mesh, drawn off-screen (step 3.6)."""

from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import ConfigError
from tiler.pictures.camera import CUT_VIEW, MARGIN, SKY, VIEW, VIEW_ANGLE, fit_camera
from tiler.pictures.painted_pictures import LEGEND, PAINTED, paint_blocks, paint_city
from tiler.pictures.picture_data import City, find_middle, load_air, load_city
from tiler.pictures.picture_parts import add_air, add_houses, add_terrain
from tiler.pictures.plain_picture import PlainPlotter, has_graphics
from tiler.pictures.sizes_picture import draw_sizes
from tiler.store.atomic import replacing

# Pictures, and their sizes (pixels) where nothing else is asked for.
SIZES = {
    "boundary": (1600, 1000),
    "mesh": (1600, 1000),
    "overview": (2000, 640),
    "tiles": (1600, 1000),
    "sizes": (1000, 1046),
    "quality": (1600, 1000),
    "citymodel": (1600, 1000),
}
CELL_BY_CELL = ("mesh", "overview", "sizes")  # pictures that show each cell or triangle
# Length up to which one surface darkens another (m), in regions below 2 km.
OCCLUSION_RADIUS = 20.0


def render_run(
    directory: Path,
    output: Path,
    *,
    what: str = "boundary",
    size: tuple[int, int] | None = None,
    say: Callable[[str], object] = str,
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
        ``"quality"``: as ``"boundary"``, but coloured by the radius ratio of the cell behind each facet.
        ``"citymodel"``: the city model as blocks on its terrain, from the run's store.
    size : (int, int), optional
        Width and height (pixels); 1600 x 1000, for the overview 2000 x 640, for the sizes 1000 x 1046.
    say : callable, optional
        Called with what is not drawn as it is, since the region is large.

    Raises
    ------
    ValueError
        If `what` is none of these, or `size` is less than 2 x 2.
    ConfigError
        If pyvista or, for ``"quality"`` and ``"citymodel"``, pillow is not installed.
    OutputError
        If the picture cannot be written.
    InputError
        If a file of the run is missing, damaged, or has no ground; if, for ``"tiles"`` and ``"sizes"``, or in a
        large region, a piece is not named after a tile.

    Notes
    -----
    The camera follows from the region alone, but VTK samples the shade between houses at random: two
    pictures of one run differ by more than 3 of 255 grey levels in some 6 % of the pixels, so their bytes
    differ. Where VTK has no OpenGL to draw with, the same is painted facet by facet (`plain_picture`).
    ``"quality"`` and ``"citymodel"`` are painted without VTK (`paint`) and have the same bytes every time.
    Memory is bounded: facets beyond `picture_data.MOST_FACETS` are made coarser, and what is shown cell by
    cell, ``"mesh"``, ``"overview"`` and ``"sizes"``, is the middle of a larger region (`find_middle`).
    Edges fade out as triangles get small on the picture. Everything is moved to the origin first,
    since graphics cards compute in single precision.
    """
    if what not in SIZES:
        raise ValueError(f"picture {what!r} must be one of {', '.join(SIZES)}")
    columns, rows = size or SIZES[what]
    least = LEGEND + 2 if what == "quality" else 2
    if columns < 2 or rows < least:
        raise ValueError(f"size {columns} x {rows} must be at least 2 x {least}")
    if what in PAINTED:
        _save(_paint(directory, what, (columns, rows), say), output)
        return
    pv = _pyvista()
    left = columns // 2
    panels = (("boundary", left), ("mesh", columns - left)) if what == "overview" else ((what, columns),)
    # VTK says aloud that there is no display before it takes the way without one.
    with pv.vtk_verbosity("off"):
        middle = find_middle(directory) if what in CELL_BY_CELL else None
        if middle is not None:
            say(f"of this large region, {len(middle)} tiles around the middle are drawn")
        city = load_city(directory, only=middle)
        _tell_step(city, say)
        if what == "sizes":
            _save(draw_sizes(city, (columns, rows)), output)
            return
        images = [_draw(pv, directory, city, part, (width, rows)) for part, width in panels]
    _save(np.hstack(images), output)


def _paint(directory: Path, what: str, size: tuple[int, int], say: Callable[[str], object]) -> NDArray[np.uint8]:
    _need_pillow()
    if what == "citymodel":
        image, left_out = paint_blocks(directory, size)
        if left_out:
            say(left_out)
        return image
    city = load_city(directory, quality=True)
    _tell_step(city, say)
    return paint_city(city, size, quality=True)


def _tell_step(city: City, say: Callable[[str], object]) -> None:
    if city.step:
        say(f"of this large region, vertices within {city.step:g} m are drawn as one")


def _need_pillow() -> None:
    try:
        import PIL  # noqa: F401
    except ImportError as error:
        raise ConfigError("pictures need pillow: pip install citystitch[pictures]") from error


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
        shown.append(add_air(plotter, load_air(directory, city.origin, only=frozenset(city.names)), size))
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
