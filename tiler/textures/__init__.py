"""Textures of oriented images on the walls and roofs of city models: `citystitch texture`."""
