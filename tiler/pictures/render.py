"""Pictures of a run's boundary, volume mesh and city model, drawn by VTK without a display (step 3.6)."""

import math
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.data.errors import ConfigError
from pipeline.data.mesh import Marker
from tiler.pictures.picture_data import City, find_middle, load_air, load_city, load_levels, take_near
from tiler.pictures.picture_parts import add_air, add_city, add_sizes, blend, plan_edges
from tiler.pictures.plain_picture import PlainPlotter, has_graphics
from tiler.store.atomic import replacing
from tiler.store.kept import IN_PIECES, IN_STORE, need

# Compass direction that the camera stands in, and its angle over the horizon (degrees).
VIEW = (215.0, 35.0)
# The cut through the volume, which looks south, is seen more squarely.
CUT_VIEW = (200.0, 27.0)
VIEW_ANGLE = 22.0
MARGIN = 1.04
SKY = ("#ffffff", "#c9dff0")
# Pictures, and their sizes (pixels) where nothing else is asked for.
SIZES = {
    "boundary": (1600, 1000),
    "mesh": (1600, 1000),
    "overview": (2000, 640),
    "tiles": (1600, 1000),
    "sizes": (1000, 1046),
    "quality": (1600, 1000),
    "citymodel": (1600, 1000),
    "levels": (1600, 1000),
}
CELL_BY_CELL = ("mesh", "overview", "sizes")  # pictures that show each cell or triangle
COLOURS = {"tiles": "tile", "quality": "quality", "levels": "level"}
# Length up to which one surface darkens another (m), in regions below 2 km.
OCCLUSION_RADIUS = 20.0
MOST_SHADED = 10_000.0  # m; in a larger region a house is below a pixel, and the shade is of the terrain's slope
CLOSE = 240.0  # m of a cut that are shown close by, so that its cells are seen
SAMPLES = 2  # pixels drawn along each pixel shown
AT_ONCE = 370  # pixels along each side of what is drawn at a time, or as many as darken each other
BLURRED = 4  # rows of the shade that VTK makes one
SHADE = 16  # places around each pixel drawn that may darken it
LEGEND = 0.1  # share of the picture of sizes that its legend takes
LEAST_TRIANGLE = 3.0  # pixels that the middle triangle's edges need in the picture of sizes for lines to be drawn
NEED_GRAPHICS = ("quality", "sizes")  # pictures with a legend
NO_GRAPHICS = (
    "VTK finds no OpenGL; Mesa needs no graphics card (Debian, Ubuntu: apt install libegl1 libgl1-mesa-dri; "
    "Fedora: dnf install mesa-libEGL; conda: mesalib)"
)
Image = NDArray[np.uint8]


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
        Output of a run: ``boundary.pvtp``, for ``"mesh"``, ``"overview"`` and ``"quality"`` ``mesh.pvtu`` too.
    output : Path
        The PNG file; it appears whole or not at all.
    what : str
        ``"boundary"``: terrain and buildings from the south-west. ``"mesh"``: the same, and behind a cut
        through the middle the tetrahedra of the northern half. ``"overview"``: both side by side.
        ``"tiles"``: as ``"boundary"``, but coloured by tile: neighbours differ.
        ``"sizes"``: triangles from above, coloured by the length of their edges, and by tile.
        ``"quality"``: as ``"boundary"``, but coloured by the radius ratio of the cell behind each facet.
        ``"citymodel"``: the city model with its roofs on its terrain, from the run's store.
        ``"levels"``: as ``"boundary"``, but coloured by level of detail, of a run with zones.
    size : (int, int), optional
        Width and height (pixels), at least 2; `SIZES` by default.
    say : callable, optional
        Called with what is not drawn as it is, since the region is large.

    Raises
    ------
    ValueError
        If `what` is none of these, or `size` is less than 2 x 2.
    ConfigError
        If pyvista is not installed; for ``"quality"`` and ``"sizes"``, if VTK finds no OpenGL.
    OutputError
        If the picture cannot be written.
    InputError
        If a file of the run is missing, damaged, or has no ground; if, for ``"tiles"`` and ``"sizes"``, or in a
        large region, a piece is not named after a tile.

    Notes
    -----
    The camera follows from the region alone, but VTK samples the shade between buildings at random: two pictures
    of one run differ in some pixels.
    Memory is bounded: 300 MiB for libraries, and some 100 bytes for each pixel drawn at a time. Facets beyond
    `picture_data.MOST_FACETS` are made coarser, and what is shown cell by cell, ``"mesh"``, ``"overview"`` and
    ``"sizes"``, is the middle of a larger region (`find_middle`).
    Edges fade out as triangles get small on the picture. Everything is moved to the origin first,
    since graphics cards compute in single precision.
    """
    if what not in SIZES:
        raise ValueError(f"picture {what!r} must be one of {', '.join(SIZES)}")
    columns, rows = size or SIZES[what]
    if columns < 2 or rows < 2:
        raise ValueError(f"size {columns} x {rows} must be at least 2 x 2")
    need(directory, *{"citymodel": [IN_STORE], "levels": [IN_STORE, IN_PIECES]}.get(what, [IN_PIECES]))
    with ThreadPoolExecutor(1) as pool:  # which asks another process, while pyvista is imported here
        asked = pool.submit(has_graphics)
        need_pictures()
    if not asked.result():
        if what in NEED_GRAPHICS:
            raise ConfigError(f"picture {what}: {NO_GRAPHICS}")
        say(f"the picture is plain: {NO_GRAPHICS}")
    image = _draw(directory, what, (columns, rows), say)
    from PIL import Image as Pictures

    with replacing(output) as part:
        Pictures.fromarray(image).save(part, format="png")


def need_pictures() -> None:
    """Raise ConfigError if pyvista is not installed."""
    try:
        import pyvista  # noqa: F401
    except ImportError as error:
        raise ConfigError("pictures need pyvista: pip install citystitch[pictures]") from error


def need_graphics() -> None:
    """Raise ConfigError if pyvista is not installed, or VTK finds no OpenGL."""
    need_pictures()
    if not has_graphics():
        raise ConfigError(NO_GRAPHICS)


def draw_city(
    city: City,
    size: tuple[int, int],
    *,
    colours: str = "height",
    edges: bool = True,
    air: Any = None,
    close: bool = False,
    at_once: int = AT_ONCE,
) -> Image:
    """Draw ground, walls and roofs from the south-west, and the air behind a cut.

    Parameters
    ----------
    city : City
        The boundary or the city model.
    size : (int, int)
        Width and height (pixels).
    colours, edges
        As for `picture_parts.add_city`.
    air : pyvista.PolyData, optional
        From `load_air`.
    close : bool
        Show no more than `CLOSE` of the cut, in its middle.
    at_once : int
        Pixels along each side of what is drawn at a time: more take less time, and 100 bytes each.

    Returns
    -------
    uint8, (height, width, 3)
        The picture.
    """
    if close:
        city = take_near(city, 2 * CLOSE)  # what lies farther off is beside the picture
    if not has_graphics():
        return _draw_plainly(city, size, colours=colours, edges=edges, air=air)
    extent = float(np.ptp(city.points[:, :2], axis=0).max())
    zoom = max(1.0, extent / CLOSE) if close else 1.0
    # The legend of quality gives the colours as they are.
    dark = max(OCCLUSION_RADIUS, extent / 100) if extent < MOST_SHADED and colours != "quality" else 0.0
    beside = SAMPLES * math.ceil(dark / extent * zoom * size[0]) + 2 * BLURRED if dark else 0
    with _plotter(size, most=0 if colours == "quality" else max(at_once, 4 * beside)) as plotter:
        full = round(size[0] * zoom), round(size[1] * zoom)  # pixels that all of it would have
        shown = add_city(plotter, city, full, colours=colours, edges=edges)
        if air is not None:
            add_air(plotter, air, full)
            shown = np.vstack([shown, air.points])
        if close:
            half = min(CLOSE, float(np.ptp(shown[:, 0]))) / 2
            low, top = shown[:, 2].min(), shown[:, 2].max()
            shown = np.array([(i * half, j * half, z) for i in (-1, 1) for j in (-0.5, 0) for z in (low, top)])
        _light(plotter)
        plotter.camera.view_angle = VIEW_ANGLE
        plotter.camera.position, plotter.camera.focal_point = _aim(shown, size, cut=air is not None)
        del shown, air
        plotter.camera.up = (0.0, 0.0, 1.0)
        plotter.reset_camera_clipping_range()
        if dark:
            plotter.enable_ssao(radius=dark, bias=extent / 1500, kernel_size=SHADE)
        return _shoot_blocks(plotter, size, beside)


def _draw_plainly(city: City, size: tuple[int, int], *, colours: str, edges: bool, air: Any) -> Image:
    """Paint the same without OpenGL, all of a cut."""
    plotter = PlainPlotter()
    shown = add_city(plotter, city, size, colours=colours, edges=edges)
    if air is not None:
        add_air(plotter, air, size)
        shown = np.vstack([shown, air.points])
    return plotter.paint(*_aim(shown, size, cut=air is not None), view_angle=VIEW_ANGLE, size=size, sky=SKY)


def _aim(
    shown: NDArray[np.float64], size: tuple[int, int], *, cut: bool
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Place of the camera, and the point that it looks at, so that the picture holds all that is shown."""
    azimuth, elevation = CUT_VIEW if cut else VIEW
    aspect, view_angle = size[0] / size[1], VIEW_ANGLE / MARGIN
    return fit_camera(shown, azimuth=azimuth, elevation=elevation, view_angle=view_angle, aspect=aspect)


def draw_sizes(city: City, size: tuple[int, int]) -> Image:
    """Draw ground and roofs from above, north upwards, coloured by the length of edges, with a legend under them.

    Raises
    ------
    InputError
        If a piece is not named after a tile.
    """
    low, high = city.points.min(axis=0), city.points.max(axis=0)
    height = size[1] * (1 - LEGEND)  # pixels of the map
    pixel = float(max((high - low)[0] / size[0], (high - low)[1] / height))
    edges = float(np.median(plan_edges(city)[city.marker != Marker.WALL])) > LEAST_TRIANGLE * pixel
    with _plotter(size) as plotter:
        plotter.set_background("white")
        add_sizes(plotter, city, edges=edges)
        focal = (low + high) / 2 - [0, (size[1] - height) / 2 * pixel, 0]
        plotter.camera.parallel_projection = True
        plotter.camera.parallel_scale = size[1] / 2 * pixel
        above = np.array([0.0, 0.0, high[2] - low[2] + 1])
        plotter.camera.position, plotter.camera.focal_point = focal + above, focal
        plotter.camera.up = (0.0, 1.0, 0.0)
        plotter.reset_camera_clipping_range()
        return _shoot(plotter)


def _draw(directory: Path, what: str, size: tuple[int, int], say: Callable[[str], object]) -> Image:
    if what == "citymodel":
        from tiler.pictures.city_model_data import load_blocks  # with all that reads a store

        blocks, n_buildings, n_shown = load_blocks(directory)
        if n_shown < n_buildings:
            say(f"the largest {n_shown:,} of {n_buildings:,} building parts are drawn")
        return draw_city(blocks, size, edges=False)
    middle = find_middle(directory) if what in CELL_BY_CELL else None
    if middle is not None:
        say(f"of this large region, {len(middle)} tiles around the middle are drawn")
    city = load_city(directory, only=middle, quality=what == "quality")
    if city.step:
        say(f"of this large region, vertices within {city.step:g} m are drawn as one")
    if what == "sizes":
        return draw_sizes(city, size)
    if what == "levels":
        city = replace(city, level=load_levels(directory, city))
    if what not in CELL_BY_CELL:
        return draw_city(city, size, colours=COLOURS.get(what, "height"))
    left = size[0] // 2 if what == "overview" else 0
    cut = draw_city(
        city, (size[0] - left, size[1]), air=load_air(directory, city.origin, only=frozenset(city.names))
    )
    return np.hstack([draw_city(city, (left, size[1])), cut]) if left else cut


@contextmanager
def _plotter(size: tuple[int, int], *, most: int = 0) -> Iterator[Any]:
    """Open a plotter that draws a picture of a size (pixels), in blocks of at most so many drawn a side."""
    import pyvista

    # VTK says aloud that there is no display before it takes the way without one.
    with pyvista.vtk_verbosity("off"):
        window = [min(SAMPLES * n, most or SAMPLES * n) for n in size]
        plotter = pyvista.Plotter(off_screen=True, window_size=window, lighting="none")
        plotter.disable_anti_aliasing()  # `SAMPLES` is that; VTK would draw each of its pixels several times
        try:
            yield plotter
        finally:
            plotter.close()


def _shoot(plotter: Any) -> Image:
    from PIL import Image as Pictures

    return np.asarray(Pictures.fromarray(plotter.screenshot(return_img=True)).reduce(SAMPLES))


def _shoot_blocks(plotter: Any, size: tuple[int, int], beside: int) -> Image:
    """Draw a picture in blocks: VTK takes some 100 bytes for each pixel that it draws at a time.

    `beside`: pixels drawn around each block, which darken it. VTK blurs the shade, and takes what is at the other
    end of what it draws for what is beyond an end: so `BLURRED` rows are drawn beyond the picture.
    """
    camera, (width, height) = plotter.camera, plotter.window_size
    camera.view_angle = np.degrees(
        2 * np.arctan(np.tan(np.radians(camera.view_angle) / 2) * height / (SAMPLES * size[1]))
    )
    strips = []
    for skipped, foot, top, middle in _cut(SAMPLES * size[1], height, beside):
        below, above = blend(np.array([1 - top, 1 - foot]), SKY)
        plotter.set_background(below, top=above)
        blocks = []
        for left, _, _, centre in _cut(SAMPLES * size[0], width, beside):
            camera.SetWindowCenter(centre, -middle)
            plotter.render()
            blocks.append(_shoot(plotter)[skipped, left])
        strips.append(np.hstack(blocks))
    return np.vstack(strips)


def _cut(whole: int, drawn: int, beside: int) -> Iterator[tuple[slice, float, float, float]]:
    """Cut a side of a picture into blocks of pixels drawn.

    Yields
    ------
    slice
        Which pixels shown are of the block, of those that are drawn for it.
    first, last : float
        Where what is drawn begins and ends, in shares of the side.
    middle : float
        How far its middle is from that of the side, in halves of what is drawn.
    """
    beyond = min(beside, BLURRED) if drawn < whole else 0
    own = drawn - 2 * beside if drawn < whole else whole
    for begin in range(0, whole, own):
        first = min(max(begin - beside, -beyond), whole - drawn + beyond)
        skipped = (begin - first) // SAMPLES
        n = min(own, whole - begin) // SAMPLES
        yield (
            slice(skipped, skipped + n),
            first / whole,
            (first + drawn) / whole,
            (2 * first + drawn - whole) / drawn,
        )


def _light(plotter: Any) -> None:
    """Sun from the south-east, softer sky light from the west and from above."""
    import pyvista

    for place, strength, colour in (
        ((0.55, -0.85, 1.0), 0.8, "#fff4e0"),
        ((-1.0, -0.3, 0.5), 0.55, "#dfe9f5"),
        ((0.0, 0.0, 1.0), 0.15, "#ffffff"),
    ):
        light = pyvista.Light(position=place, focal_point=(0, 0, 0), color=colour, intensity=strength)
        light.positional = False
        plotter.add_light(light)
