"""What the steps pass to each other: points, city model, meshes, notes, errors."""
