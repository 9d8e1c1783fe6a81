"""Polygons, segments and points in the plane: rings, holes, what lies inside, what is connected."""
