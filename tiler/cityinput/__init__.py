"""City models and rasters of terrain as input: as files have them, and as rows for a store."""
