"""Levels of a city between buildings and blocks: `citystitch generalise`."""

HEIGHTS = ("area", "volume")
