"""Where the input lies on Earth: CRS, units, axes and scale of clouds and footprints, established before a run."""
