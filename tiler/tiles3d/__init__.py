"""3D Tiles of a run: the city at falling levels of detail on the globe, in files that viewers stream."""
