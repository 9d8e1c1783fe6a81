"""What a picture of a run shows: terrain, buildings, the air above them, and the colours of all of them."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.data.mesh import Marker
from tiler.pictures.picture_data import City, number_used, read_key

# Edges are drawn while a triangle has this many pixels in the mean, strongest from four times as many.
EDGE_PIXELS = 8.0
EDGE_OPACITY = 0.35
# Facets up to which the outlines of buildings are looked for.
OUTLINE_FACETS = 3_000_000
# Height above ground of the warmest roof colour (m).
TALL = 40.0
# Thickness of the block under the city, as a share of its extent.
THICKNESS = 0.015

MATT = {"ambient": 0.4, "diffuse": 0.75, "specular": 0.0}
AIRY = {"ambient": 0.5, "diffuse": 0.6, "specular": 0.0}
GROUND_COLOURS = ("#93ab86", "#b4c3a0", "#d3d3b6", "#e6dfca")
ROOF_COLOURS = ("#efc294", "#e2935f", "#c9583c", "#93303a")
AIR_COLOURS = ("#8db8d8", "#b9d4e6", "#e6eff4")
WALL_COLOUR = "#fffaf0"
# Neighbouring tiles differ in colour: by odd and even column, then by odd and even row. The four are of Tol's
# medium contrast; any two of them are apart for eyes that miss one kind of cone too.
TILE_COLOURS = (("#6699cc", "#994455"), ("#eecc66", "#ee99aa"))
# How much white is mixed into a tile's colour, so that buildings stand out from the ground.
TILE_WHITE = {Marker.GROUND: 0.3, Marker.WALL: 0.6, Marker.ROOF: 0.0}
# By level of detail, the finest first.
LEVEL_COLOURS = ("#b2182b", "#ef8a62", "#fddbc7", "#92c5de", "#4393c3", "#2166ac")
SKIRT_COLOUR = "#c9bfae"
LINE_COLOUR = "#3c3530"
# From bad to good; lightness rises all the way, so that grey prints tell the same.
QUALITY_COLOURS = ("#3b0f47", "#8c2369", "#d0504f", "#f3a25a", "#f7e3a1", "#f4f6ea")
QUALITY_LIMITS = (0.2, 0.8)  # radius ratios of the first and the last colour
UNKNOWN_COLOUR = "#808080"
# From short to long edges, for tiles whose column and row are both odd or both even, and for the others.
RAMPS = (("#0b2545", "#2f6690", "#7fb2d6", "#e4f1fa"), ("#4a1c05", "#a8501b", "#e8a667", "#fdf0e0"))
EXTREMES = (2.0, 98.0)  # percentiles of edges between which colours change


def heights_above_ground(city: City) -> NDArray[np.float64]:
    """Height (m) of the top of each facet's building over the lowest foot of its walls, 0 on the ground."""
    _, row = np.unique(city.building, return_inverse=True)
    z = city.points[city.facets, 2]
    top = np.full(row.max() + 1, -np.inf)
    foot = np.full(row.max() + 1, np.inf)
    np.maximum.at(top, row, z.max(axis=1))
    np.minimum.at(foot, row, z.min(axis=1))
    return np.where(city.building < 0, 0.0, (top - foot)[row])


def plan_edges(city: City) -> NDArray[np.float64]:
    """Mean length of the edges of each facet in plan (m), float64 (k,)."""
    corners = city.points[city.facets][:, :, :2]
    length: NDArray[np.float64] = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2).mean(axis=1)
    return length


def tile_keys(city: City) -> NDArray[np.int64]:
    """Column and row of the tile of each piece, int64 (p, 2).

    Raises
    ------
    InputError
        If a piece is not named after a tile.
    """
    return np.array([read_key(name) for name in city.names], np.int64)


def height_colours(city: City) -> NDArray[np.uint8]:
    """Colour the ground by its height, and roofs by theirs above the ground; walls are pale."""
    rgb = blend(heights_above_ground(city) / TALL, ROOF_COLOURS)
    rgb[city.marker == Marker.WALL] = blend(np.zeros(1), (WALL_COLOUR, WALL_COLOUR))
    ground = city.marker == Marker.GROUND
    z = city.points[city.facets[ground], 2].mean(axis=1)
    rgb[ground] = blend(z / max(float(np.percentile(z, 98)), 1e-9), GROUND_COLOURS)
    return rgb


def tile_colours(city: City) -> NDArray[np.uint8]:
    """Colour facets by tile: walls paler than the ground, roofs in full colour.

    Raises
    ------
    InputError
        If a piece is not named after a tile.
    """
    odd = (tile_keys(city) % 2)[city.piece]
    colours = np.array([[list(bytes.fromhex(colour[1:])) for colour in row] for row in TILE_COLOURS])
    return _pale(colours[odd[:, 0], odd[:, 1]], city)


def level_colours(city: City) -> NDArray[np.uint8]:
    """Colour facets by level of detail: walls and ground paler than roofs."""
    colours = np.array([list(bytes.fromhex(colour[1:])) for colour in LEVEL_COLOURS])
    return _pale(colours[city.level], city)


def _pale(colours: NDArray[np.int64], city: City) -> NDArray[np.uint8]:
    """Mix white into the colours (k, 3) of walls and of the ground."""
    white = np.zeros(max(Marker) + 1)
    white[list(TILE_WHITE)] = list(TILE_WHITE.values())
    share = white[city.marker][:, None]
    rgb: NDArray[np.uint8] = np.rint(colours * (1 - share) + 255 * share).astype(np.uint8)
    return rgb


def add_city(
    plotter: Any, city: City, size: tuple[int, int], *, colours: str = "height", edges: bool = True
) -> NDArray[np.float64]:
    """Add ground, walls and roofs, outlines of buildings, and the sides of the block below; returns its points.

    Parameters
    ----------
    plotter : pyvista.Plotter
        The picture.
    city : City
        What it shows.
    size : (int, int)
        Width and height of a picture that holds all of it (pixels).
    colours : str
        ``"height"``, ``"tile"``, ``"level"``, or ``"quality"``, with a legend.
    edges : bool
        Whether edges of triangles are drawn where they are long enough.
    """
    lines = _edge_style(len(city.facets), size) if edges else {}
    if colours == "quality":
        shown: Any = city.quality
        table = _make_table(QUALITY_COLOURS, QUALITY_LIMITS)
        painted: dict[str, Any] = {"cmap": table, "show_scalar_bar": False}
        worst = float(np.nanmin(city.quality, initial=1.0))
        add_legend(plotter, table, f"radius ratio, worst {worst:.3f}", (0.68, 0.05))
    else:
        paint = {"tile": tile_colours, "level": level_colours}.get(colours, height_colours)
        shown, painted = paint(city), {"rgb": True}
    built = city.marker != Marker.GROUND
    for part, smooth in ((~built, True), (built, False)):
        if part.any():
            surface = _make_surface(city.points, city.facets[part])
            surface.cell_data["shown"] = shown[part]
            actor = plotter.add_mesh(surface, scalars="shown", smooth_shading=smooth, **painted, **MATT, **lines)
            if actor is not None:  # None without OpenGL, where no lines are drawn
                actor.mapper.resolve = "polygon_offset"  # outlines are in front of what they are on
    if 0 < built.sum() <= OUTLINE_FACETS:
        outlines = surface.extract_feature_edges(feature_angle=25, manifold_edges=False)
        plotter.add_mesh(outlines, color=LINE_COLOUR, line_width=2.0, opacity=0.8)
    skirt = make_skirt(city)
    plotter.add_mesh(skirt, color=SKIRT_COLOUR, **MATT)
    return np.vstack([city.points, skirt.points])


def add_air(plotter: Any, air: Any, size: tuple[int, int]) -> None:
    """Add the surface of the cells behind the cut, a pyvista.PolyData, coloured by height."""
    z = air.cell_centers().points[:, 2]
    air.cell_data["shown"] = blend(z / z.max(), AIR_COLOURS)
    plotter.add_mesh(air, rgb=True, scalars="shown", **AIRY, **_edge_style(air.n_cells, size))


def add_sizes(plotter: Any, city: City, *, edges: bool) -> None:
    """Add ground and roofs coloured by the length of their edges, walls as lines, and legends under them.

    Raises
    ------
    InputError
        If a piece is not named after a tile.
    """
    import pyvista

    flat, lengths = city.marker != Marker.WALL, plan_edges(city)
    limits = tuple(np.percentile(lengths[flat], EXTREMES).tolist())
    odd = (tile_keys(city).sum(axis=1) % 2)[city.piece]
    lines = {"show_edges": True, "edge_color": LINE_COLOUR, "line_width": 1.0} if edges else {}
    for row, ramp in enumerate(RAMPS):
        part, table = flat & (odd == row), _make_table(ramp, limits)
        words = "length of edges (m), neighbouring tiles in blue and brown" if row == 0 else ""
        add_legend(plotter, table, words, (0.36, 0.03 - 0.018 * row), labels=row == 0)
        if part.any():
            surface = pyvista.PolyData.from_regular_faces(city.points, city.facets[part])
            surface.cell_data["shown"] = lengths[part]
            plotter.add_mesh(surface, scalars="shown", cmap=table, show_scalar_bar=False, lighting=False, **lines)
    if not flat.all():
        walls = pyvista.PolyData.from_regular_faces(city.points, city.facets[~flat])
        plotter.add_mesh(walls, style="wireframe", color="black", line_width=3.0, lighting=False)


def add_legend(plotter: Any, table: Any, words: str, place: tuple[float, float], *, labels: bool = True) -> None:
    """Add the colours of a table with its values, at a place given in shares of the picture."""
    import pyvista

    mapper = pyvista.DataSetMapper()
    mapper.lookup_table = table
    mapper.scalar_range = table.scalar_range
    text = max(8, round(plotter.window_size[0] / 80))
    plotter.add_scalar_bar(
        title=f"{words}\n",
        mapper=mapper,
        position_x=place[0],
        position_y=place[1],
        width=0.28,
        height=0.065,
        title_font_size=text,
        label_font_size=text,
        n_labels=4 if labels else 0,
        fmt="%.1f",
        color="black",
        unconstrained_font_size=True,
    )


def blend(share: NDArray[np.float64], colours: tuple[str, ...]) -> NDArray[np.uint8]:
    """Blend colours given as ``"#rrggbb"`` at equal steps.

    Examples
    --------
    >>> blend(np.array([-1.0, 0.25, 2.0]), ("#000000", "#806040", "#ffffff")).tolist()
    [[0, 0, 0], [64, 48, 32], [255, 255, 255]]
    """
    stops = np.array([list(bytes.fromhex(colour[1:])) for colour in colours], dtype=np.float64)
    steps = np.linspace(0, 1, len(colours))
    channels = [np.interp(share, steps, channel) for channel in stops.T]
    rgb: NDArray[np.uint8] = np.rint(np.column_stack(channels)).astype(np.uint8)
    return rgb


def make_skirt(city: City) -> Any:
    """Sides of the block that the city stands on: from the rim of the surface down."""
    import pyvista

    edges = np.concatenate([city.facets[:, [0, 1]], city.facets[:, [1, 2]], city.facets[:, [2, 0]]])
    key = np.sort(edges, axis=1) @ np.array([len(city.points), 1])
    _, first, count = np.unique(key, return_index=True, return_counts=True)
    a, b = edges[first[count == 1]].T
    depth = THICKNESS * np.ptp(city.points[:, :2], axis=0).max()
    foot = city.points * [1, 1, 0] - [0, 0, depth]
    n = len(city.points)
    quads = np.column_stack([b, a, a + n, b + n])
    return pyvista.PolyData.from_regular_faces(np.vstack([city.points, foot]), quads).clean()


def _make_surface(points: NDArray[np.float64], facets: NDArray[np.int32]) -> Any:
    """Make a surface of the points that facets use, in single precision, as VTK draws it."""
    import pyvista

    used, rows = number_used(facets, len(points))
    return pyvista.PolyData.from_regular_faces(points[used].astype(np.float32), rows.astype(np.int32))


def _edge_style(n_facets: int, size: tuple[int, int]) -> dict[str, Any]:
    """Edges of triangles: the fainter the smaller they are on the picture, none when too small."""
    pixels = 0.5 * size[0] * size[1] / n_facets
    if pixels < EDGE_PIXELS:
        return {}
    opacity = EDGE_OPACITY * min(1.0, pixels / (4 * EDGE_PIXELS))
    return {"show_edges": True, "edge_color": LINE_COLOUR, "line_width": 1.0, "edge_opacity": opacity}


def _make_table(colours: tuple[str, ...], limits: tuple[float, ...]) -> Any:
    import pyvista

    rgba = np.column_stack([blend(np.linspace(0, 1, 256), colours), np.full(256, 255, np.uint8)])
    return pyvista.LookupTable(values=rgba, scalar_range=limits, nan_color=UNKNOWN_COLOUR)
