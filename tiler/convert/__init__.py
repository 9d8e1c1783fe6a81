"""City models of one format as those of another: `citystitch convert`."""

NAMES = ("cityjson", "cityjsonseq", "citygml2", "citygml3", "gpkg", "obj", "glb")
