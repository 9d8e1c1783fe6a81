"""Straight skeletons of polygons, and the roofs that they make: hipped, gabled and others (step 2.0)."""
