"""Seams: the vertices, columns and facets that two tiles share, and a tile's mesh between them."""
