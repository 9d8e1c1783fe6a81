"""Building footprints of vector files: outlines, ids, heights."""
