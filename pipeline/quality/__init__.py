"""Measures of a mesh and a model: shapes of cells, distances to the points, facts of each building."""
