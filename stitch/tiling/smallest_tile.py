"""The least size of a tile."""

LEAST_TILE = 14.0  # mesh sizes; below, strips would reach beyond a border tile of half a size
