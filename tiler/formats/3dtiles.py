"""OGC 3D Tiles 1.1: the city on the globe, streamed at falling levels of detail."""  # noqa: N999

from tiler.export.export import Format
from tiler.tiles3d.tileset import export_tileset

FORMAT = Format(
    "3D Tiles 1.1: a quadtree of glTF with ids and attributes",
    export_tileset,
    options=("geoid_height", "vertical_crs", "slice_height", "slice_line", "generalised", "compression"),
    folder=True,
)
