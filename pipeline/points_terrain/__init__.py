"""Steps 1.1 to 1.3: points of LAS files, their classes, and the terrain's raster."""
