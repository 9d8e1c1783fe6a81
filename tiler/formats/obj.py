"""Wavefront OBJ: the boundary with shared vertices, one group a patch."""

from tiler.export.export import PER_BUILDING, Format
from tiler.export.obj_file import write_obj
from tiler.export.surface import write_surface

FORMAT = Format(
    "the boundary as Wavefront OBJ, one group a patch",
    write_surface(write_obj),
    options=PER_BUILDING,
    suffix=".obj",
)
