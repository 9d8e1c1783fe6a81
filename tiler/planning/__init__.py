"""The plan of a run from headers alone: region, tiles, files, forecast."""
