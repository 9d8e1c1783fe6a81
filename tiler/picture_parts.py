"""What a picture of a run shows: terrain, houses, and the air above them."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import InputError
from pipeline.mesh import Marker

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
SKIRT_COLOUR = "#c9bfae"
LINE_COLOUR = "#3c3530"


@dataclass(frozen=True, eq=False)
class City:
    """The boundary, moved to the origin.

    Attributes
    ----------
    points : float64, (n, 3)
        Vertices (m) from `origin`, each once.
    facets : int64, (k, 3)
        Ground, walls and roofs, counter-clockwise seen from the air.
    marker : int32, (k,)
        `Marker` of each facet.
    building : int64, (k,)
        Number of the building of each facet, -1 on the ground.
    origin : float64, (3,)
        Middle of the region, at the height of the lowest ground.
    """

    points: NDArray[np.float64]
    facets: NDArray[np.int64]
    marker: NDArray[np.int32]
    building: NDArray[np.int64]
    origin: NDArray[np.float64]


def load_city(directory: Path) -> City:
    """Read ground, walls and roofs from ``boundary.pvtp``; the pieces of tiles are sewn together.

    Raises
    ------
    InputError
        If the file or a piece of it is missing or damaged, or has no ground.
    """
    from vtkmodules.vtkIOXML import vtkXMLPPolyDataReader

    path = directory / "boundary.pvtp"
    surface = _read(vtkXMLPPolyDataReader(), path)
    if not {"marker", "building"} <= set(surface.cell_data.keys()):
        raise InputError(f"{path}: arrays {surface.cell_data.keys()}, need marker and building; run again")
    marker = np.asarray(surface.cell_data["marker"])
    if not np.any(marker == Marker.GROUND):
        raise InputError(f"{path}: none of {len(marker)} facets is marked as ground; run again")
    shown = np.isin(marker, (Marker.GROUND, Marker.WALL, Marker.ROOF))
    points, facets = _sew(np.asarray(surface.points, dtype=np.float64), surface.regular_faces[shown])
    low, high = points.min(axis=0), points.max(axis=0)
    origin = np.array([*(low + high)[:2] / 2, low[2]])
    return City(
        points=points - origin,
        facets=facets[:, ::-1],  # the file's look out of the air, which is where the camera is
        marker=marker[shown],
        building=np.asarray(surface.cell_data["building"])[shown],
        origin=origin,
    )


def load_volume(directory: Path) -> Any:
    """Read ``mesh.pvtu`` as a pyvista grid.

    Raises
    ------
    InputError
        If the file or a piece of it is missing or damaged.
    """
    from vtkmodules.vtkIOXML import vtkXMLPUnstructuredGridReader

    return _read(vtkXMLPUnstructuredGridReader(), directory / "mesh.pvtu")


def heights_above_ground(city: City) -> NDArray[np.float64]:
    """Height (m) of the top of each facet's building over the lowest foot of its walls, 0 on the ground."""
    _, row = np.unique(city.building, return_inverse=True)
    z = city.points[city.facets, 2]
    top = np.full(row.max() + 1, -np.inf)
    foot = np.full(row.max() + 1, np.inf)
    np.maximum.at(top, row, z.max(axis=1))
    np.minimum.at(foot, row, z.min(axis=1))
    return np.where(city.building < 0, 0.0, (top - foot)[row])


def add_houses(plotter: Any, city: City, size: tuple[int, int]) -> None:
    """Add walls, roofs coloured by height above ground, and their outlines."""
    import pyvista

    built = city.marker != Marker.GROUND
    if not np.any(built):
        return
    houses = pyvista.PolyData.from_regular_faces(city.points, city.facets[built])
    rgb = blend(heights_above_ground(city)[built] / TALL, ROOF_COLOURS)
    rgb[city.marker[built] == Marker.WALL] = blend(np.zeros(1), WALL_COLOURS)
    houses.cell_data["rgb"] = rgb
    plotter.add_mesh(houses, rgb=True, scalars="rgb", **MATT, **_edge_style(len(city.facets), size))
    if houses.n_cells <= OUTLINE_FACETS:
        lines = houses.extract_feature_edges(feature_angle=25, manifold_edges=False)
        plotter.add_mesh(lines, color=LINE_COLOUR, line_width=1.2, opacity=0.8)


def add_terrain(plotter: Any, city: City, size: tuple[int, int]) -> NDArray[np.float64]:
    """Add the ground, shaded by height, and the sides of the block below it; returns their points."""
    import pyvista

    edges = _edge_style(len(city.facets), size)
    ground = pyvista.PolyData.from_regular_faces(city.points, city.facets[city.marker == Marker.GROUND]).clean()
    z = ground.points[:, 2]
    ground["rgb"] = blend(z / max(float(np.percentile(z, 98)), 1e-9), GROUND_COLOURS)
    plotter.add_mesh(ground, rgb=True, scalars="rgb", smooth_shading=True, **MATT, **edges)
    skirt = _skirt(city)
    plotter.add_mesh(skirt, color=SKIRT_COLOUR, **MATT)
    return np.asarray(skirt.points)


def add_air(plotter: Any, grid: Any, origin: NDArray[np.float64], size: tuple[int, int]) -> NDArray[np.float64]:
    """Add the whole tetrahedra whose middle is in the northern half; returns their points."""
    grid.points = np.asarray(grid.points, dtype=np.float64) - origin
    middle = grid.points[grid.cell_connectivity.reshape(-1, 4), 1].mean(axis=1)
    air = grid.extract_cells(np.flatnonzero(middle > 0)).extract_surface(algorithm=None)
    z = air.cell_centers().points[:, 2]
    air.cell_data["rgb"] = blend(z / z.max(), AIR_COLOURS)
    plotter.add_mesh(air, rgb=True, scalars="rgb", **AIRY, **_edge_style(air.n_cells, size))
    points: NDArray[np.float64] = np.asarray(air.points)
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


def _read(reader: Any, path: Path) -> Any:
    """Run one of VTK's readers, which tell of damage but go on."""
    import pyvista

    if not path.is_file():
        raise InputError(f"{path}: no such file; run citystitch first, or name its output folder")
    reader.SetFileName(os.fspath(path))
    with pyvista.VtkErrorCatcher(send_to_logging=False) as catcher:
        reader.Update()
    data = pyvista.wrap(reader.GetOutput())
    if catcher.events or data is None or data.n_cells == 0:
        raise InputError(f"{path}: it or a piece of it is missing, damaged or empty; run again")
    return data


def _sew(points: NDArray[np.float64], facets: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Keep the points that facets use, equal ones once."""
    used = np.unique(facets)
    order = used[np.lexsort(points[used].T)]
    new = np.ones(len(order), dtype=np.bool_)
    new[1:] = np.any(points[order[1:]] != points[order[:-1]], axis=1)
    index = np.empty(len(points), dtype=np.int64)
    index[order] = np.cumsum(new) - 1
    return points[order[new]], index[facets]


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
