"""The plan of a run from headers alone: CRS, region, tiles, files, forecast."""
