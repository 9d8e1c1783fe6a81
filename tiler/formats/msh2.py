"""Gmsh's MSH 2.2, text: what `gmshToFoam` reads; written by `tiler.formats.msh`."""

from tiler.export.export import PER_BUILDING, Format
from tiler.formats.msh import export_msh2

FORMAT = Format("Gmsh's MSH 2.2, text, as gmshToFoam reads it", export_msh2, options=PER_BUILDING, suffix=".msh")
