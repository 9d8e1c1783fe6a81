"""Pictures painted without OpenGL: the city, the mesh cut open, its quality, and the city model as blocks."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tiler.pictures.camera import CUT_VIEW, MARGIN, SKY, VIEW, VIEW_ANGLE, fit_camera
from tiler.pictures.paint import SAMPLES, Lighting, Scene, View, cast_lights, join_scenes, paint
from tiler.pictures.picture_data import City
from tiler.pictures.scenes import QUALITY_COLOURS, QUALITY_LIMITS, block_scene, city_scene, cut_scene
from tiler.workflow.out_folder import RUN_RECORD
from tiler.workflow.run_folder import read_run_record

PAINTED = ("quality", "citymodel")  # pictures of `render` that are painted
CLOSE = 240.0  # m of a cut that are shown, so that its cells are seen
LEGEND = 46  # pixels below a picture of quality
Image = NDArray[np.uint8]


def paint_city(
    city: City, size: tuple[int, int], *, quality: bool = False, lighting: Lighting | None = None
) -> Image:
    """Paint ground, walls and roofs, coloured by height or by the quality of the cells behind them.

    Parameters
    ----------
    city : City
        The boundary, with quality if it is asked for.
    size : (int, int)
        Width and height (pixels); with quality, the legend takes `LEGEND` of these.
    quality : bool
        Colour by the radius ratio of cells, with a legend.
    lighting : Lighting, optional
        From `light_city`, for several pictures.
    """
    if not quality:
        return _paint(city_scene(city), size, lighting=lighting)
    image = _paint(city_scene(city, quality=True), (size[0], size[1] - LEGEND), lighting=lighting)
    return np.vstack([image, _draw_legend(city, size[0])])


def light_city(city: City) -> Lighting:
    """Find what throws shadows in pictures of a city."""
    return cast_lights(city_scene(city))


def paint_cut(directory: Path, city: City, size: tuple[int, int], *, lighting: Lighting | None = None) -> Image:
    """Paint the middle of the mesh, cut open from west to east; errors as of `cut_scene`."""
    cut = cut_scene(directory, city)
    rows = cut.corners.reshape(-1, 3)
    side = min(CLOSE, float(np.ptp(rows[:, 0]))) / 2
    x, (low, top) = float(rows[:, 0].min() + rows[:, 0].max()) / 2, np.percentile(rows[:, 2], (0, 100))
    framed = np.array([(x + i * side, j * side, z) for i in (-1, 1) for j in (-0.5, 0.0) for z in (low, top)])
    return _paint(
        join_scenes([city_scene(city), cut]),
        size,
        view=CUT_VIEW,
        lighting=lighting or light_city(city),
        framed=framed,
    )


def paint_blocks(directory: Path, size: tuple[int, int]) -> tuple[Image, str]:
    """Paint the city model as blocks on its terrain; also what is left out of the picture, or an empty text."""
    found = block_scene(directory, read_run_record(directory / RUN_RECORD).bounds)
    left_out = ""
    if found.n_shown < found.n_buildings:
        left_out = f"the largest {found.n_shown:,} of {found.n_buildings:,} building parts are drawn"
    return _paint(found.scene, size), left_out


def _paint(
    scene: Scene,
    size: tuple[int, int],
    *,
    view: tuple[float, float] = VIEW,
    lighting: Lighting | None = None,
    framed: NDArray[np.float64] | None = None,
) -> Image:
    position, focal = fit_camera(
        scene.corners.reshape(-1, 3) if framed is None else framed,
        azimuth=view[0],
        elevation=view[1],
        view_angle=VIEW_ANGLE / MARGIN,
        aspect=size[0] / size[1],
    )
    return paint(scene, View(position, focal, VIEW_ANGLE, size), sky=SKY, lighting=lighting)


def _draw_legend(city: City, width: int) -> Image:
    """Draw the colours of radius ratios, the worst one marked, with words where pillow has letters."""
    from PIL import Image as Pictures
    from PIL import ImageDraw, ImageFont

    from tiler.pictures.picture_parts import blend

    large = (width * SAMPLES, LEGEND * SAMPLES)
    image = Pictures.new("RGB", large, "white")
    draw, font = ImageDraw.Draw(image), ImageFont.load_default(14 * SAMPLES)
    left, right, top, foot = large[0] // 4, 3 * large[0] // 4, 8 * SAMPLES, 22 * SAMPLES
    for k, colour in enumerate(blend(np.linspace(0, 1, right - left), QUALITY_COLOURS).tolist()):
        draw.line([(left + k, top), (left + k, foot)], fill=tuple(colour))
    low, high = QUALITY_LIMITS
    for value in np.linspace(low, high, 7).tolist():
        at = left + (value - low) / (high - low) * (right - left)
        draw.line([(at, foot), (at, foot + 4 * SAMPLES)], fill="black", width=SAMPLES)
        draw.text((at, foot + 5 * SAMPLES), f"{value:.1f}", fill="black", font=font, anchor="ma")
    worst = float(np.nanmin(city.quality, initial=1.0))
    words = (
        (left - 10 * SAMPLES, f"radius ratio, worst {worst:.3f}", "ra"),
        (right + 10 * SAMPLES, "1 is best", "la"),
    )
    for x, text, anchor in words:
        draw.text((x, top - SAMPLES), text, fill="black", font=font, anchor=anchor)
    return np.asarray(image.resize((width, LEGEND), Pictures.Resampling.BOX))
