"""What a picture of a run shows: terrain, houses, and the air above them."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.mesh import Marker
from tiler.pictures.picture_data import Air, City, read_key

# Edges are drawn while a triangle has this many pixels in the mean, strongest from four times as many.
EDGE_PIXELS = 8.0
EDGE_OPACITY = 0.35
# Facets up to which the outlines of houses are looked for.
OUTLINE_FACETS = 3_000_000
# Height above ground of the warmest roof colour (m).
TALL = 40.0
# Thickness of the block under the city, as a share of its extent.
THICKNESS = 0.015

MATT = {"ambient": 0.35, "diffuse": 0.75, "specular": 0.0}
AIRY = {"ambient": 0.5, "diffuse": 0.6, "specular": 0.0}
GROUND_COLOURS = ("#93ab86", "#b4c3a0", "#d3d3b6", "#e6dfca")
ROOF_COLOURS = ("#efc294", "#e2935f", "#c9583c", "#93303a")
AIR_COLOURS = ("#8db8d8", "#b9d4e6", "#e6eff4")
WALL_COLOURS = ("#fffaf0", "#fffaf0")
# Neighbouring tiles differ in colour: by odd and even column, then by odd and even row. The four are of Tol's
# medium contrast; any two of them are apart for eyes that miss one kind of cone too.
TILE_COLOURS = (("#6699cc", "#994455"), ("#eecc66", "#ee99aa"))
# How much white is mixed into a tile's colour, so that houses stand out from the ground.
TILE_WHITE = {Marker.GROUND: 0.3, Marker.WALL: 0.6, Marker.ROOF: 0.0}
SKIRT_COLOUR = "#c9bfae"
LINE_COLOUR = "#3c3530"


def heights_above_ground(city: City) -> NDArray[np.float64]:
    """Height (m) of the top of each facet's building over the lowest foot of its walls, 0 on the ground."""
    _, row = np.unique(city.building, return_inverse=True)
    z = city.points[city.facets, 2]
    top = np.full(row.max() + 1, -np.inf)
    foot = np.full(row.max() + 1, np.inf)
    np.maximum.at(top, row, z.max(axis=1))
    np.minimum.at(foot, row, z.min(axis=1))
    return np.where(city.building < 0, 0.0, (top - foot)[row])


def tile_keys(city: City) -> NDArray[np.int64]:
    """Column and row of the tile of each piece, int64 (p, 2).

    Raises
    ------
    InputError
        If a piece is not named after a tile.
    """
    return np.array([read_key(name) for name in city.names], np.int64)


def tile_colours(city: City) -> NDArray[np.uint8]:
    """Colour facets by tile: walls paler than the ground, roofs in full colour.

    Raises
    ------
    InputError
        If a piece is not named after a tile.
    """
    odd, white = (tile_keys(city) % 2)[city.piece], np.zeros(max(Marker) + 1)
    white[list(TILE_WHITE)] = list(TILE_WHITE.values())
    colours = np.array([[list(bytes.fromhex(colour[1:])) for colour in row] for row in TILE_COLOURS])
    share = white[city.marker][:, None]
    rgb: NDArray[np.uint8] = np.rint(colours[odd[:, 0], odd[:, 1]] * (1 - share) + 255 * share).astype(np.uint8)
    return rgb


def add_houses(plotter: Any, city: City, size: tuple[int, int], *, by_tile: bool = False) -> None:
    """Add walls, roofs coloured by height above ground or by tile, and their outlines."""
    import pyvista

    built = city.marker != Marker.GROUND
    if not np.any(built):
        return
    houses = pyvista.PolyData.from_regular_faces(city.points, city.facets[built])
    if by_tile:
        rgb = tile_colours(city)[built]
    else:
        rgb = blend(heights_above_ground(city)[built] / TALL, ROOF_COLOURS)
        rgb[city.marker[built] == Marker.WALL] = blend(np.zeros(1), WALL_COLOURS)
    houses.cell_data["rgb"] = rgb
    plotter.add_mesh(houses, rgb=True, scalars="rgb", **MATT, **_edge_style(len(city.facets), size))
    if houses.n_cells <= OUTLINE_FACETS:
        lines = houses.extract_feature_edges(feature_angle=25, manifold_edges=False)
        plotter.add_mesh(lines, color=LINE_COLOUR, line_width=1.2, opacity=0.8)


def add_terrain(plotter: Any, city: City, size: tuple[int, int], *, by_tile: bool = False) -> NDArray[np.float64]:
    """Add the ground, coloured by height or by tile, and the sides of the block below it; returns their points."""
    import pyvista

    edges, open_ground = _edge_style(len(city.facets), size), city.marker == Marker.GROUND
    ground = pyvista.PolyData.from_regular_faces(city.points, city.facets[open_ground])
    if by_tile:
        ground.cell_data["rgb"] = tile_colours(city)[open_ground]
    ground = ground.clean()
    if not by_tile:
        z = ground.points[:, 2]
        ground["rgb"] = blend(z / max(float(np.percentile(z, 98)), 1e-9), GROUND_COLOURS)
    plotter.add_mesh(ground, rgb=True, scalars="rgb", smooth_shading=True, **MATT, **edges)
    skirt = _skirt(city)
    plotter.add_mesh(skirt, color=SKIRT_COLOUR, **MATT)
    return np.asarray(skirt.points)


def add_air(plotter: Any, air: Air, size: tuple[int, int]) -> NDArray[np.float64]:
    """Add the surface of the cells behind the cut; returns its points."""
    import pyvista

    surface = pyvista.PolyData.from_regular_faces(air.points, air.facets).clean()
    z = surface.cell_centers().points[:, 2]
    surface.cell_data["rgb"] = blend(z / z.max(), AIR_COLOURS)
    plotter.add_mesh(surface, rgb=True, scalars="rgb", **AIRY, **_edge_style(surface.n_cells, size))
    points: NDArray[np.float64] = np.asarray(surface.points)
    return points


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


def _skirt(city: City) -> Any:
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


def _edge_style(n_facets: int, size: tuple[int, int]) -> dict[str, Any]:
    """Edges of triangles: the fainter the smaller they are on the picture, none when too small."""
    pixels = 0.5 * size[0] * size[1] / n_facets
    if pixels < EDGE_PIXELS:
        return {}
    opacity = EDGE_OPACITY * min(1.0, pixels / (4 * EDGE_PIXELS))
    return {"show_edges": True, "edge_color": LINE_COLOUR, "line_width": 0.6, "edge_opacity": opacity}
