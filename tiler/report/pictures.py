"""Pictures of the mesh for the report: drawn, compressed, and put into the page."""

import base64
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.data.errors import ConfigError
from tiler.pictures.picture_data import find_middle, load_air, load_city
from tiler.pictures.render import CLOSE, draw_city, need_graphics
from tiler.report.page import figure, paragraph, text

SIZE = (1120, 700)
QUALITY = 84  # of JPEG
AT_ONCE = 1200  # pixels along each side of what is drawn at a time: the report takes more memory before


def describe_pictures(directory: Path) -> Iterator[str]:
    """Show the city, the mesh cut open, and the quality of cells at the boundary.

    Parameters
    ----------
    directory : Path
        Folder of a run that is done.

    Raises
    ------
    InputError
        If a file of the run is missing or damaged.
    """
    try:
        need_graphics()
    except ConfigError as error:
        yield paragraph(f"There are no pictures: {error}.", "bad")
        return
    middle = find_middle(directory)
    part = load_city(directory, only=middle, quality=True)
    city = part if middle is None else load_city(directory)
    coarse, some = (
        f" Vertices within {one.step:g} m are drawn as one." if one.step else "" for one in (city, part)
    )
    where = "" if middle is None else " in the middle of the region"
    yield _embed(
        draw_city(city, SIZE, at_once=AT_ONCE),
        f"The boundary from the south-west: ground by height, roofs by height above ground.{coarse}",
    )
    air = load_air(directory, part.origin, only=frozenset(part.names), within=2 * CLOSE)
    yield _embed(
        draw_city(part, SIZE, air=air, close=True, at_once=AT_ONCE),
        "The mesh in the middle of the region, cut open from west to east.",
    )
    yield _embed(
        draw_city(part, SIZE, colours="quality"),
        f"Radius ratio of the cell behind each facet of the boundary{where}, the darker the worse.{some}",
    )


def _embed(image: NDArray[np.uint8], words: str) -> str:
    from PIL import Image

    file = BytesIO()
    Image.fromarray(image).save(file, format="JPEG", quality=QUALITY, optimize=True)
    data = base64.b64encode(file.getvalue()).decode()
    height, width = image.shape[:2]
    return figure(
        f'<img alt="{text(words)}" width="{width}" height="{height}" src="data:image/jpeg;base64,{data}">', words
    )
