"""Steps 3.2 to 3.6: the columns over the plane mesh, their levels, layers and cells."""
