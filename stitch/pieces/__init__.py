"""The pieces of tiles as one mesh: numbers of points, faces of cells, conformity."""
