"""Step 3.1: the mesh of the plane with the walls as edges."""
