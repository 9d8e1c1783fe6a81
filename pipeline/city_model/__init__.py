"""Steps 1.4 to 1.7 and 2.3: footprints, the points and heights of each house, houses divided and grouped."""
